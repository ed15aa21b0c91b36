"""Excel and OpenDocument workbooks, by python-calamine: a table for each sheet that holds one."""

from __future__ import annotations

import datetime
import zipfile
from typing import TYPE_CHECKING

from python_calamine import CalamineError, CalamineWorkbook

from servolens.errors import InputError
from servolens.reading.cells import REWRITE, decimal_sign, grouped_or_decimal
from servolens.reading.column_cells import ColumnCells
from servolens.reading.files import quote
from servolens.reading.layout import find_layout
from servolens.reading.settings import comment_settings
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["read"]

MOST_SHEETS = 50
LAYOUT_ROWS = 400
_PARTS = {"[Content_Types].xml", "mimetype", "content.xml"}
"""Files that workbooks of Excel and OpenDocument hold, and no other ZIP archive has to."""


def read(path: Path) -> list[Table]:
    """Return the sheets of a workbook that hold rows of numbers.

    Raises
    ------
    InputError
        If the file is damaged or holds no such sheet.
    """
    try:
        with CalamineWorkbook.from_path(path) as book:
            names = book.sheet_names[:MOST_SHEETS]
            tables = [
                table for name in names if (table := _table(name, book.get_sheet_by_name(name).to_python())) is not None
            ]
    except (CalamineError, OSError, ValueError) as error:
        raise (error if isinstance(error, InputError) else InputError(_other(path))) from error
    if not tables:
        raise InputError("is a workbook without a sheet of numbers")
    return tables


def _other(path: Path) -> str:
    """Return what a file is that cannot be opened as a workbook."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.endswith("/")]
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, EOFError):
        names = []
    if not names or _PARTS & set(names):
        return "is a damaged workbook, or another kind of ZIP file; save it again as .xlsx"
    what = quote(names[0]) if len(names) == 1 else f"{len(names)} files, the first of them {quote(names[0])}"
    return f"is a ZIP archive of {what}; unpack it first"


def _table(name: str, rows: Sequence[Sequence[object]]) -> Table | None:
    cells = [[_text(cell) for cell in row] for row in rows]
    lines = [(k + 1, row) for k, row in enumerate(cells) if any(row)]
    head = [row for _, row in lines[:LAYOUT_ROWS]]
    layout, decimal = find_layout(head), "."
    if layout is None:  # numbers stored as texts, as an import with the wrong settings does
        decimal = decimal_sign(_joined(head), ";")
        layout = find_layout(head, decimal)
    if layout is None:
        return None
    body = lines[layout.first :]
    if decimal != "." and (cell := grouped_or_decimal(_joined([row for _, row in body]), ";", decimal)):
        raise InputError(f"{quote(cell)} may be a whole number with separated thousands; {REWRITE}")
    columns = [
        _column(heading, [row[j] for _, row in body], [line for line, _ in body], layout.units[j], decimal)
        for j, heading in enumerate(layout.names)
        if heading or j in layout.typed
    ]
    above = (", ".join(row).rstrip(", ") for _, row in lines[: layout.first])
    comments = comment_settings(line for line in above if line.startswith("#"))
    return Table(tuple(columns), name, comments, layout.properties, has_names=layout.has_names)


def _joined(rows: Sequence[Sequence[str]]) -> bytes:
    return "\n".join(";".join(row) for row in rows).encode()


def _text(cell: object) -> str:
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    return str(cell).strip()


def _column(name: str, cells: Sequence[str], lines: Sequence[int], unit: str | None, decimal: str) -> Column:
    column = ColumnCells(decimal)
    column.add(cells, [f"row {line}" for line in lines])
    return column.column(name, unit)
