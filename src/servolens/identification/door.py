"""What every identification checks first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.errors import InputError
from servolens.record import Record

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from servolens.identification.integral import Prior

__all__ = ["check_names", "check_priors", "together"]


def together(records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """Return the records of one axis as a tuple.

    Raises
    ------
    InputError
        If there is none, or their units differ.
    """
    runs = (records,) if isinstance(records, Record) else tuple(records)
    if not runs:
        raise InputError("no record was given; identification needs at least one")
    for unit in ("length_unit", "command_unit"):
        kinds = sorted({getattr(run, unit) for run in runs})
        if len(kinds) > 1:
            raise InputError(f"records in {' and '.join(kinds)} cannot be identified together; convert one of them")
    return runs


def check_priors(priors: Mapping[str, Prior], parameters: Iterable[str]) -> None:
    """Refuse a prior on what is no parameter of the model.

    Raises
    ------
    InputError
        With the names that are.
    """
    known = list(parameters)
    for name in priors:
        if name not in known:
            raise InputError(f"a prior on {name[:40]!r} is not possible; known are {', '.join(known)}")


def check_names(names: Iterable[str], parameters: Iterable[str]) -> None:
    """Refuse what is no parameter of the model.

    Raises
    ------
    InputError
        With the names that are.
    """
    known = list(parameters)
    for name in names:
        if name not in known:
            raise InputError(f"{name[:40]!r} is no parameter of this model; those are {', '.join(known)}")
