"""One value for what a person is told: the terminal and the HTML page render the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from servolens.findings import Finding

__all__ = ["Summary", "Table"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of text under named columns.

    Parameters
    ----------
    title : str
        What the table shows.
    columns : tuple of str
        Headings, units in brackets.
    rows : tuple of tuple of str
        Cells, ready to be shown; the first is the row's name.
    note : str
        What to know when reading it; may be empty.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What a result says, most important sentence first.

    Parameters
    ----------
    title : str
        A heading.
    sentences : tuple of str
        Plain text.
    tables : tuple of Table
        Numbers.
    findings : tuple of Finding
        Warnings and notes.
    """

    title: str
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __str__(self) -> str:
        from servolens.rendering import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        """Return the summary for a notebook."""
        from servolens.rendering import as_html

        return as_html(self)
