"""Records as a script has them: read already, as files and folders, or in memory."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from servolens.campaign import read_records
from servolens.errors import InputError
from servolens.reading import record_from_dataframe, record_from_timeresponse
from servolens.record import Record

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["are_records", "listed", "records_from"]


def listed(source: Any) -> tuple[Any, ...]:
    """Return one source, of records or a model, or several of them, as a tuple."""
    is_one = isinstance(source, str | os.PathLike) or are_records(source) or not isinstance(source, Iterable)
    return (source,) if is_one else tuple(source)


def are_records(source: object) -> bool:
    """Tell whether records can be read from a source: a Record, a path, a DataFrame, a time response.

    A path that ends in ``.json`` is a model's.
    """
    if isinstance(source, str | os.PathLike):
        return not os.fspath(source).lower().endswith(".json")
    return isinstance(source, Record) or _is_frame(source) or _is_response(source)


def records_from(sources: Iterable[Any], settings: Mapping[str, object]) -> tuple[Record, ...]:
    """Return the records of the sources, in their order.

    Parameters
    ----------
    sources : iterable
        Records, files, folders, campaigns, DataFrames and time responses.
    settings : mapping
        What sources that are not records yet do not state themselves, as ``kp`` and ``kd``; it wins over what they say.

    Raises
    ------
    InputError
        If a source cannot be read, or `settings` are given for records.
    """
    given = list(sources)
    if settings and given and all(isinstance(source, Record) for source in given):
        raise InputError(f"{', '.join(settings)} cannot be given for records that are read already; set it in these")
    found: list[Record] = []
    for source in given:
        if isinstance(source, Record):
            found.append(source)
        elif _is_frame(source):
            found.append(record_from_dataframe(source, settings=settings))
        elif _is_response(source):
            found.append(record_from_timeresponse(source, settings=settings))
        else:
            found += read_records(source, settings=settings)
    return tuple(found)


def _is_frame(source: object) -> bool:
    return hasattr(source, "columns") and hasattr(source, "iloc")


def _is_response(source: object) -> bool:
    return all(hasattr(source, part) for part in ("time", "outputs", "inputs"))
