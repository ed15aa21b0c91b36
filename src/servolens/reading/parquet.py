"""Parquet files, by pyarrow; column units from the fields' metadata."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read"]


def read(path: Path) -> list[Table]:
    """Return the columns of numbers, times and lists of numbers of a Parquet file.

    Raises
    ------
    InputError
        If the file is damaged or too large.
    """
    try:
        with pq.ParquetFile(path) as file:
            schema = file.schema_arrow
            wanted = [field.name for field in schema if _is_wanted(field.type)]
            files.check_numbers(file.metadata.num_rows * max(len(wanted), 1))
            table = file.read(columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise InputError("is a damaged Parquet file; write it again") from error
    columns = [column for name in wanted for column in _columns(name, schema.field(name), table[name])]
    return [Table(tuple(columns))]


def _is_wanted(kind: Any) -> bool:
    types = pa.types
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return bool(
        types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind) or types.is_decimal(kind)
        or types.is_timestamp(kind) or types.is_duration(kind)
    )  # fmt: skip


def _columns(name: str, field: Any, values: Any) -> list[Column]:
    unit = (field.metadata or {}).get(b"unit", b"").decode(errors="replace") or None
    kind = field.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        array = np.asarray(values.to_numpy()).astype(
            "datetime64[ns]" if pa.types.is_timestamp(kind) else "timedelta64[ns]"
        )
        return [Column(name, np.asarray((array - array[:1]) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64), "s")]
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        rows = values.to_pylist()
        width = len(rows[0] or []) if rows else 0
        if not width or any(row is None or len(row) != width for row in rows):
            return []
        matrix = np.array(rows, dtype=np.float64)
        return [Column(f"{name}[{j}]", matrix[:, j].copy(), unit) for j in range(width)]
    return [Column(name, np.asarray(values.cast(pa.float64()).to_numpy(), dtype=np.float64), unit)]
