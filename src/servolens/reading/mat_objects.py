"""MAT files that hold more than plain vectors: structures, Simulink logs, tables and timetables, and MAT v7.3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError
from servolens.reading.nested import tables_of

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.reading.table import Table

__all__ = ["read"]


def read(path: Path) -> list[Table]:
    """Return the arrays of a MAT file as tables.

    Structures of MAT v5 are read by SciPy; objects (table, timetable, timeseries) and v7.3 by mat-io, which needs h5py.

    Raises
    ------
    InputError
        If the file is damaged or holds no arrays of numbers.
    """
    with path.open("rb") as stream:
        start = stream.read(128)
    is_new = start.startswith(b"MATLAB 7.3") or start[124:126] == b"\x00\x02"
    try:
        tree = _by_matio(path) if is_new else _by_scipy(path)
    except ImportError:
        raise
    except Exception as error:
        raise InputError("is a damaged MAT file; save it again with -v7") from error
    return list(tables_of(tree))


def _by_scipy(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    loaded = loadmat(path, simplify_cells=True)
    kept = {name: value for name, value in loaded.items() if not name.startswith("__")}
    if any(isinstance(value, MatlabOpaque) for value in kept.values()):
        return _by_matio(path)
    return kept


def _by_matio(path: Path) -> dict[str, Any]:
    import matio

    loaded = matio.load_from_mat(str(path))
    return {name: _plain(value) for name, value in loaded.items() if not name.startswith("__")}


def _plain(node: Any, depth: int = 0) -> Any:
    """Return structures of arrays as mappings, one-element ones without their brackets."""
    if depth > 12:
        return None
    if isinstance(node, np.ndarray) and node.dtype.names:
        if node.size == 1:
            item = node.ravel()[0]
            return {name: _plain(item[name], depth + 1) for name in node.dtype.names}
        return [{name: _plain(item[name], depth + 1) for name in node.dtype.names} for item in node.ravel()]
    if isinstance(node, np.ndarray) and node.dtype == object and node.size == 1:
        return _plain(node.ravel()[0], depth + 1)
    if isinstance(node, np.ndarray) and node.dtype.kind == "U" and node.size == 1:
        return str(node.ravel()[0])
    if isinstance(node, dict):
        return {name: _plain(value, depth + 1) for name, value in node.items()}
    properties = getattr(node, "properties", None)
    if isinstance(properties, dict):
        return _plain(properties, depth + 1)
    return node
