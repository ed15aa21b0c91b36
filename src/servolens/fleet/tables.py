"""The rows of a fleet as one table: Parquet where pyarrow is installed, else CSV."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Any

from servolens.fleet.rows import columns_of
from servolens.reading.files import printable
from servolens.results import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from servolens.fleet.result import Fleet
    from servolens.fleet.rows import Row

__all__ = ["table_file", "to_csv", "write_table"]

TABLE_NAMES = ("summary.parquet", "summary.csv")
FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")
"""What a spreadsheet takes for the beginning of a formula (OWASP, CSV injection)."""


def write_table(fleet: Fleet, *, plain: bool = False) -> Path:
    """Write the rows beside the results as one table, in place of an older one, and return its file.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    name, content = table_file(fleet.rows, plain=plain)
    write_atomically(fleet.out / name, content, durable=True)
    for other in {*TABLE_NAMES} - {name}:
        (fleet.out / other).unlink(missing_ok=True)
    return fleet.out / name


def table_file(rows: Sequence[Row], *, plain: bool = False) -> tuple[str, bytes]:
    """Return name and content of the table: ``summary.parquet``, or ``summary.csv`` where that cannot be or is asked.

    Columns are those of :func:`~servolens.fleet.columns_of`.
    """
    if not plain:
        try:
            import pyarrow as pa
            from pyarrow import parquet
        except ImportError:
            return "summary.csv", to_csv(rows)
        columns = columns_of(rows)
        fields = [pa.field(name, _kind(pa, [row.get(name) for row in rows])) for name in columns]
        arrays = [pa.array([_clean(row.get(f.name)) for row in rows], type=f.type) for f in fields]
        buffer = io.BytesIO()
        parquet.write_table(pa.table(arrays, schema=pa.schema(fields)), buffer)
        return "summary.parquet", buffer.getvalue()
    return "summary.csv", to_csv(rows)


def to_csv(rows: Sequence[Row]) -> bytes:
    """Return the table as CSV in UTF-8, without formulas.

    Control characters are escaped, and text that a spreadsheet would take for a formula begins with an apostrophe.

    Examples
    --------
    >>> to_csv([{"axis": "=1+1", "kp": -3.0}]).decode().splitlines()[1][:12]
    "'=1+1,,,,,,,"
    """
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    columns = columns_of(rows)
    writer.writerow([_cell(name) for name in columns])
    writer.writerows([_cell(row.get(name)) for name in columns] for row in rows)
    return buffer.getvalue().encode("utf-8", "backslashreplace")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float | int):
        return repr(value)
    text = printable(str(value))
    return f"'{text}" if text.lstrip(" ").startswith(FORMULA) else text


def _kind(pa: Any, values: Sequence[Any]) -> Any:
    """Return the type of a column."""
    known = [value for value in values if value is not None]
    if known and all(isinstance(value, bool) for value in known):
        return pa.bool_()
    return pa.float64() if known and all(isinstance(value, float | int) for value in known) else pa.string()


def _clean(value: Any) -> Any:
    """Return text that UTF-8 can hold."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
