"""A column of text cells while it is read: its numbers, its instants, or what it says of on and off."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.reading.cells import amount, fault_in, is_switch, kind_of, numbers, switched
from servolens.reading.files import quote
from servolens.reading.stamps import stamps
from servolens.reading.table import Column, Fault
from servolens.reading.words import unit_behind
from servolens.units import ordinary_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["ColumnCells"]

BLANK = ("", "nan")
"""What programs write into a cell that has no value, in small letters."""


@final
@dataclass(slots=True)
class ColumnCells:
    """The cells of one column, added piece by piece.

    A column that says on or off somewhere and 0, 1, on or off everywhere is one of switches: its numbers are only for
    a signal that is on or off. In any other column such a word is a fault as any text. A column whose first cell holds
    a unit behind its number is in that unit; other multiples of it are converted.

    Parameters
    ----------
    decimal : {".", ",", ",.", ".,"}
        The decimal sign, and behind it the separator of thousands where there is one.
    """

    decimal: str = "."
    _kind: str = ""
    _unit: str | None = None
    _parts: list[NDArray[Any]] = field(default_factory=list)
    _words: list[NDArray[np.bool_]] = field(default_factory=list)
    _faults: dict[str, Fault] = field(default_factory=dict)

    def add(self, cells: Sequence[str], places: Sequence[str]) -> None:
        """Add cells; `places` says where each stands."""
        self._kind = self._kind or kind_of(next((cell for cell in cells if cell.strip()), ""), self.decimal)
        values: NDArray[Any]
        words = np.zeros(len(cells), dtype=bool)
        if self._kind == "stamp":
            values = stamps(cells)
        elif self._kind == "amount":
            values = self._amounts(cells)
        else:
            values = numbers(cells, self.decimal)
            for i in np.flatnonzero(~np.isfinite(values)).tolist():
                words[i] = is_switch(cells[i])
                values[i] = switched(cells[i]) if words[i] else values[i]
        self._parts.append(values)
        self._words.append(words)
        odd = ~np.isfinite(values)
        given = odd.copy()
        given[odd] = [cells[i].strip().lower() not in BLANK for i in np.flatnonzero(odd).tolist()]
        for which, found in (("any", odd | words), ("word", words), ("other", odd), ("text", given | words)):
            if which not in self._faults and found.any():
                at = int(np.argmax(found))
                self._faults[which] = fault_in(cells[at], places[at], self._kind, self.decimal)

    def _amounts(self, cells: Sequence[str]) -> NDArray[np.float64]:
        """Return the numbers of cells that hold units too, in the unit of the column's first, nan for what is none."""
        values = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            found = amount(cell, self.decimal)
            unit = ordinary_unit(found[1]) if found else None
            if found is None or unit is None:
                continue
            self._unit = self._unit or found[1]
            own = ordinary_unit(self._unit)
            if own is not None and own.dimension == unit.dimension:
                values[i] = found[0] if found[1] == self._unit else found[0] * (unit.factor / own.factor)
        return values

    def column(self, name: str, unit: str | None) -> Column:
        """Return the column; time stamps as seconds from the first one."""
        values, words = np.concatenate(self._parts), np.concatenate(self._words)
        fault = self._faults.get("other")
        if values.dtype.kind == "M":
            first = values[np.argmin(np.isnat(values))]
            seconds = np.asarray((values - first) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64)
            return Column(name, seconds, "s", fault)
        if self._unit is not None:
            return _in_one_unit(Column(name, values, unit, self._blank(fault)), self._unit)
        if words.any() and np.isin(values[np.isfinite(values)], (0.0, 1.0)).all():
            return Column(name, values, unit, fault, switches=self._faults["word"])
        values[words] = np.nan
        return Column(name, values, unit, self._blank(self._faults.get("any")))

    def _blank(self, fault: Fault | None) -> Fault | None:
        """Return a fault, with whether all that is wrong with the column is that cells are blank."""
        return replace(fault, is_blank=True) if fault is not None and "text" not in self._faults else fault


def _in_one_unit(column: Column, unit: str) -> Column:
    """Return a column whose cells are in `unit`, with a fault where its heading states another one."""
    stated = unit_behind(column.name)[1] or column.unit
    if stated is None or stated == unit:
        return replace(column, unit=unit)
    what = f"column {quote(column.name)} states {quote(stated)} in its heading and {quote(unit)} in its cells; keep one"
    return replace(column, fault=Fault("", what))
