"""A reference that stands in a file of its own, beside the log: two columns, time and reference."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import located, printable, quote
from servolens.reading.formats import read_tables
from servolens.reading.roles import Choice
from servolens.reading.scales import time_unit
from servolens.reading.words import meaning
from servolens.units import Unit, parse_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.reading.table import Column, Table

    Values = NDArray[np.float64]

__all__ = ["ReferenceFile", "read_reference_file"]

INSTANT_SLACK = 1e-9
"""Share of the record's length by which an instant may miss the record's, for the rounding of decimal texts."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFile:
    """What a file states of the reference.

    Parameters
    ----------
    time : ndarray, shape (n,)
        When each value begins to hold [s], increasing, on the clock of the record.
    values : ndarray, shape (n,)
        In the unit of `unit`.
    unit : (str, Unit) or None
        Of the values; None where the file states none.
    label : str
        What refusals call the file.
    """

    time: Values
    values: Values
    unit: tuple[str, Unit] | None
    label: str

    def held(self, time: Values, factor: float) -> Values:
        """Return the reference at the record's instants [m or rad], each value held until the next one.

        Parameters
        ----------
        time : ndarray, shape (m,)
            Of the record [s].
        factor : float
            Metres or radians in one unit of the values.

        Raises
        ------
        InputError
            If the file says nothing of the record's beginning.
        """
        slack = INSTANT_SLACK * max(float(time[-1] - time[0]), 1.0)
        if self.time[0] > time[0] + slack:
            raise InputError(
                f"{self.label}: the reference begins at {self.time[0]:g} s and the record at {time[0]:g} s; add a row"
                " that says what the reference was before (a log's time stamps count from its first sample)"
            )
        late = np.searchsorted(self.time, time + slack, side="right") - 1
        return factor * self.values[late]


def read_reference_file(path: str | os.PathLike[str]) -> ReferenceFile:
    """Read a reference from a file of any form that logs have.

    Parameters
    ----------
    path : path
        Columns named time and reference, or two columns in this order; others are left alone. A unit stands in the
        heading, as in ``reference [mm]``.

    Raises
    ------
    InputError
        If the columns are not found, hold no numbers, or the time does not increase.
    """
    label = printable(os.fspath(path))
    with located(label):
        found = [columns for table in read_tables(Path(path)) if (columns := _columns(table)) is not None]
        if len(found) != 1:
            raise InputError("is no file of a reference: it needs two columns, time and reference, e.g. 0.5,0.1")
        time, reference = found[0]
        seconds = _seconds(time)
        _check(seconds, reference)
        return ReferenceFile(seconds, reference.values, _unit(reference), label)


def _columns(table: Table) -> tuple[Column, Column] | None:
    """Return the columns of time and reference; None where a table has none."""
    if len(table.columns) == 2 and not table.has_names:
        return table.columns[0], table.columns[1]
    time, reference = (_named(signal, table.columns) for signal in ("time", "reference"))
    if time is not None and reference is None and len(table.columns) == 2:
        reference = next(column for column in table.columns if column is not time)
    return None if time is None or reference is None else (time, reference)


def _named(signal: str, columns: Sequence[Column]) -> Column | None:
    named = [column for column in columns if signal in meaning(column.name, column.unit).roles]
    if len(named) > 1:
        raise InputError(
            f"holds more than one column that may be the {signal}: {quote(', '.join(column.name for column in named))};"
            " keep one"
        )
    return named[0] if named else None


def _seconds(time: Column) -> Values:
    said = meaning(time.name, time.unit)
    unit = parse_unit(said.unit or time_unit(Choice(time, 0, time.name, said))[0] or "s")
    return np.asarray(time.values * (unit.factor if unit else 1.0), dtype=np.float64)


def _unit(reference: Column) -> tuple[str, Unit] | None:
    text = meaning(reference.name, reference.unit).unit
    if text is None:
        return None
    unit = parse_unit(text)
    if unit is None:
        raise InputError(f"column {quote(reference.name)}: {quote(text)} is no unit; write e.g. [mm] or [deg]")
    return text, unit


def _check(time: Values, reference: Column) -> None:
    if reference.switches is not None:
        raise InputError(reference.switches.sentence("reference"))
    for name, values in (("time", time), ("reference", reference.values)):
        if values.size == 0 or not np.isfinite(values).all():
            wrong = int(np.argmin(np.isfinite(values))) if values.size else 0
            raise InputError(f"{name}: row {wrong + 1} of the numbers holds none; fill or leave out such rows")
    falls = np.flatnonzero(np.diff(time) <= 0)
    if falls.size:
        row = int(falls[0])
        raise InputError(
            f"time must increase; row {row + 2} of the numbers ({time[row + 1]:g} s) follows {time[row]:g} s"
        )
