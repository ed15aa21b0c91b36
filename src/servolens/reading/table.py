"""What every format is turned into: named columns of numbers with the texts that stood beside them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.findings import Finding
    from servolens.reading.guess import Guess

__all__ = ["MOST_COLUMNS", "Column", "Fault", "Table"]

MOST_COLUMNS = 1000
"""Columns of one table that are read; an array is no wider."""


@final
@dataclass(frozen=True, slots=True)
class Fault:
    """Why a column cannot be used: its first cell that is no number and where that stands, or what the column is.

    With `is_blank` all such cells are blank.
    """

    where: str
    what: str
    remedy: str = "fill or leave out such rows"
    is_blank: bool = False

    def sentence(self, signal: str) -> str:
        """Return the refusal of the column for a signal."""
        return f"{self.where}, {signal}: {self.what}; {self.remedy}" if self.where else self.what


@final
@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One column of a table.

    Parameters
    ----------
    name : str
        As the file calls it, a unit in brackets included.
    values : ndarray, shape (n,)
        As logged; nan where a cell is no number.
    unit : str or None
        Where the file states it beside the name, as a row of units does.
    fault : Fault or None
        Of the first cell that is no number.
    switches : Fault or None
        Of the first cell that says on or off, for every signal but one that is on or off; None without such cells.
    origin : Guess or None
        What the column was made of, where the file does not log it.
    """

    name: str
    values: NDArray[np.float64]
    unit: str | None = None
    fault: Fault | None = None
    switches: Fault | None = None
    origin: Guess | None = None

    @property
    def is_integer(self) -> bool:
        """Whether it holds whole numbers and nothing else."""
        values = self.values
        is_finite = values.dtype.kind in "iuf" and bool(values.size and np.isfinite(values).all())
        return is_finite and np.array_equal(values, np.round(values))


@final
@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of one length, sampled together: a file, a sheet, a group of channels or a topic.

    Parameters
    ----------
    columns : tuple of Column
        In the order of the file.
    name : str
        Of the sheet, group or topic; empty where the file holds one table.
    comments : mapping of str to str
        ``# key = value`` lines: settings, of which unknown ones are told.
    properties : mapping of str to str
        Other texts beside the numbers, of which only known ones are taken.
    has_names : bool
        False where the file names no columns; they are called by their numbers.
    remarks : tuple of Finding
        What was left out.
    """

    columns: tuple[Column, ...]
    name: str = ""
    comments: Mapping[str, str] = field(default_factory=dict)
    properties: Mapping[str, str] = field(default_factory=dict)
    has_names: bool = True
    remarks: tuple[Finding, ...] = ()
