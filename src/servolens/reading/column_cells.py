"""A column of text cells while it is read: its numbers, its instants, or what it says of on and off."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.reading.cells import fault_in, is_switch, kind_of, numbers, stamps, switched
from servolens.reading.table import Column, Fault

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["ColumnCells"]


@final
@dataclass(slots=True)
class ColumnCells:
    """The cells of one column, added piece by piece.

    A column that says on or off somewhere and 0, 1, on or off everywhere is one of switches: its numbers are only for
    a signal that is on or off. In any other column such a word is a fault as any text.

    Parameters
    ----------
    decimal : {".", ",", ",.", ".,"}
        The decimal sign, and behind it the separator of thousands where there is one.
    """

    decimal: str = "."
    _kind: str = ""
    _parts: list[NDArray[Any]] = field(default_factory=list)
    _words: list[NDArray[np.bool_]] = field(default_factory=list)
    _faults: dict[str, Fault] = field(default_factory=dict)

    def add(self, cells: Sequence[str], places: Sequence[str]) -> None:
        """Add cells; `places` says where each stands."""
        self._kind = self._kind or kind_of(next((cell for cell in cells if cell.strip()), ""))
        if self._kind == "stamp":
            values: NDArray[Any] = stamps(cells)
            words = np.zeros(values.size, dtype=bool)
        else:
            values = numbers(cells, self.decimal)
            words = np.zeros(values.size, dtype=bool)
            for i in np.flatnonzero(~np.isfinite(values)).tolist():
                words[i] = is_switch(cells[i])
                values[i] = switched(cells[i]) if words[i] else values[i]
        self._parts.append(values)
        self._words.append(words)
        odd = ~np.isfinite(values)
        for which, found in (("any", odd | words), ("word", words), ("other", odd)):
            if which not in self._faults and found.any():
                at = int(np.argmax(found))
                self._faults[which] = fault_in(cells[at], places[at], self._kind, self.decimal)

    def column(self, name: str, unit: str | None) -> Column:
        """Return the column; time stamps as seconds from the first one."""
        values, words = np.concatenate(self._parts), np.concatenate(self._words)
        if values.dtype.kind == "M":
            first = values[np.argmin(np.isnat(values))]
            seconds = np.asarray((values - first) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64)
            return Column(name, seconds, "s", self._faults.get("other"))
        if words.any() and np.isin(values[np.isfinite(values)], (0.0, 1.0)).all():
            return Column(name, values, unit, self._faults.get("other"), switches=self._faults["word"])
        values[words] = np.nan
        return Column(name, values, unit, self._faults.get("any"))
