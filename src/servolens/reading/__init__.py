"""Reading records from logs of many forms, DataFrames and time responses.

A reader for each format makes tables of a file (:mod:`~servolens.reading.formats`); one interpreter finds columns,
units and gains in them, with the evidence (:mod:`~servolens.reading.interpret`); the assembly converts them to SI.

A file is refused with one sentence, never with a traceback, and at most 40 characters of it are quoted.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from servolens.errors import InputError, described
from servolens.reading.files import located, printable
from servolens.reading.formats import read_tables
from servolens.reading.guess import Guess
from servolens.reading.interpret import interpret
from servolens.reading.memory import record_from_dataframe, record_from_timeresponse
from servolens.reading.reading import Reading, made
from servolens.reading.settings import KEYS, as_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.record import Record

__all__ = ["KEYS", "Guess", "Reading", "read_log", "read_record", "record_from_dataframe", "record_from_timeresponse"]


def read_record(
    path: str | os.PathLike[str],
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    label: str | None = None,
    **stated: object,
) -> Record:
    """Read one measured run from a log.

    Parameters
    ----------
    path : str or path
        A regular file; what it is, its content says.
    settings : mapping, optional
        ``kp``, ``kd``, ``encoder_resolution`` … (:data:`KEYS`): numbers in SI, or texts with a unit such as
        ``"0.06 V/mm"``; they win over the file's own comment lines.
    columns : mapping, optional
        Signal to the name or the number of its column (variable, channel), e.g. ``{"position": "qm"}``; what is not
        named is guessed.
    units : mapping, optional
        Signal to unit, e.g. ``{"time": "ms"}``; wins over the headings.
    label : str, optional
        What refusals call the file; by default its path.
    **stated
        The same as `settings`, as keywords: ``kp=60``.

    Returns
    -------
    Record
        In SI; its `remarks` hold what was not understood.

    Raises
    ------
    InputError
        With one sentence: what arrived and where, what is admissible, what to do.
    """
    return read_log(path, settings=as_settings(settings, stated), columns=columns, units=units, label=label).record


def read_log(
    path: str | os.PathLike[str],
    *,
    settings: Mapping[str, object] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    label: str | None = None,
) -> Reading:
    """Read one measured run and tell how.

    Parameters
    ----------
    path, settings, columns, units, label
        As in :func:`read_record`.

    Returns
    -------
    Reading
        The record, and the guess of each column, unit and gain with its evidence.

    Raises
    ------
    InputError
        As :func:`read_record` does.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"the path of a log is needed; got {described(path)} (a table: record_from_dataframe)")
    file = Path(path)
    with located(label or os.fspath(path)):
        found = interpret(read_tables(file), columns=columns, units=units, settings=settings)
        name = printable(file.name.removesuffix(".gz").rpartition(".")[0] or file.name)[:80] or "record"
        return made(found, settings=settings, units=units, name=name, source=printable(os.fspath(path)))
