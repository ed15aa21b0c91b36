"""HDF5 files, by h5py: their data sets, and never a file that they point to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.nested import DEEPEST_LEVEL, tables_of
from servolens.reading.table import Column, Table

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read"]

MOST_ITEMS = 10_000
_UNITS = ("unit", "units", "Unit", "Units")


def read(path: Path) -> list[Table]:
    """Return the numeric data sets of an HDF5 file, with units from their attributes.

    Only what is linked hard is followed: links to other files, and data sets that are stored in other files, are left
    out.

    Raises
    ------
    InputError
        If the file is damaged or too large.
    """
    units: dict[str, str] = {}
    left = [MOST_ITEMS, files.MAX_BYTES]
    try:
        with h5py.File(path, "r") as file:
            tree = _group(file, (), units, left)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise (
            error if isinstance(error, InputError) else InputError("is a damaged HDF5 file; write it again")
        ) from error
    return [_with_units(table, units) for table in tables_of(tree)]


def _group(group: h5py.Group, path: tuple[str, ...], units: dict[str, str], left: list[int]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key in group:
        left[0] -= 1
        if left[0] < 0 or len(path) > DEEPEST_LEVEL:
            raise InputError(f"holds more than {MOST_ITEMS} groups and data sets, or nests them too deep")
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        item = group[key]
        if isinstance(item, h5py.Group):
            found[key] = _group(item, (*path, key), units, left)
        elif isinstance(item, h5py.Dataset) and not item.is_virtual and item.external is None:
            value = _values(item, left)
            if value is not None:
                found[key] = value
                unit = next((str(item.attrs[name]) for name in _UNITS if name in item.attrs), "")
                if unit:
                    units[key] = unit
    for key, value in group.attrs.items():
        if isinstance(value, str | int | float | np.number):
            found.setdefault(key, value.item() if isinstance(value, np.number) else value)
    return found


def _values(item: h5py.Dataset, left: list[int]) -> np.ndarray | None:
    if item.dtype.kind not in "biufV" or item.size is None:
        return None
    left[1] -= item.size * max(item.dtype.itemsize, 8)
    if left[1] < 0:
        raise InputError(f"holds more than {files.MAX_BYTES / 2**20:.0f} MiB of numbers, the most that is read")
    return np.asarray(item[()])


def _with_units(table: Table, units: dict[str, str]) -> Table:
    columns = [
        Column(column.name, column.values, column.unit or units.get(column.name.rpartition(".")[2]))
        for column in table.columns
    ]
    return Table(tuple(columns), table.name, properties=table.properties, has_names=table.has_names)
