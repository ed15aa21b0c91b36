"""Tables from trees: JSON documents, MATLAB structures, HDF5 groups, whose leaves are arrays."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.reading.cells import number
from servolens.reading.table import MOST_COLUMNS, Column, Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["tables_of"]

DEEPEST_LEVEL = 12
"""Levels that are followed."""
_EMPTY = ("values", "value", "data", "y", "signals")
"""Names of leaves that say nothing: their parent's name does."""
_VALUES = (*_EMPTY, "samples")
"""Keys of a channel's values."""
_NAMES = ("name", "label", "channel", "id", "title")
"""Keys of what a channel is called."""

Path = tuple[str, ...]


def tables_of(tree: object) -> tuple[Table, ...]:
    """Return the arrays of a tree as tables: those of one parent and one length stand together.

    A mapping of arrays, a sequence of records, rows below named columns, a data frame and Simulink's structure with
    time are understood at every level; scalars and texts become properties.

    Examples
    --------
    >>> (table,) = tables_of({"t": [0, 1], "pos": [0.0, 0.1], "kp": 60})
    >>> [column.name for column in table.columns], table.properties
    (['t', 'pos'], {'kp': '60'})
    """
    properties: dict[str, str] = {}
    leaves = list(_leaves(tree, (), properties))[:MOST_COLUMNS]
    groups: dict[tuple[Path, int], list[tuple[Path, NDArray[np.float64]]]] = {}
    for path, values in leaves:
        groups.setdefault((path[:-1], values.size), []).append((path, values))
    shared = _shared([path[:-1] for path, _ in leaves])
    return tuple(
        Table(
            tuple(Column(_name(path[shared:]), values) for path, values in members),
            ".".join(parent[shared:]),
            properties=properties,
            has_names=all(not path[-1].isdecimal() for path, _ in members),
        )
        for (parent, _), members in groups.items()
    )


def _name(path: Path) -> str:
    """Return a leaf's name: its path, without a last part that says nothing."""
    kept = path[:-1] if len(path) > 1 and path[-1].lower() in _EMPTY else path
    return ".".join(kept)


def _shared(parents: Sequence[Path]) -> int:
    """Return how many parts all paths begin with."""
    if not parents:
        return 0
    count = 0
    for parts in zip(*parents, strict=False):
        if len(set(parts)) > 1:
            break
        count += 1
    return count


def _leaves(node: Any, path: Path, properties: dict[str, str]) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    if len(path) > DEEPEST_LEVEL:
        return
    if hasattr(node, "columns") and hasattr(node, "index"):
        yield from _frame(node, path)
    elif isinstance(node, dict):
        yield from _mapping(node, path, properties)
    elif isinstance(node, list | tuple):
        yield from _sequence(node, path, properties)
    elif isinstance(node, np.ndarray):
        yield from _array(node, path, properties)
    elif isinstance(node, str | int | float | np.number) and path and not isinstance(node, bool):
        properties.setdefault(path[-1].lower(), str(node)[:200])


def _mapping(
    node: Mapping[Any, Any], path: Path, properties: dict[str, str]
) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    names = node.get("columns", node.get("header"))
    rows = node.get("data")
    if isinstance(names, list) and isinstance(rows, list) and all(isinstance(name, str) for name in names):
        yield from _rows(rows, path, names)
        return
    if "time" in node and isinstance(node.get("signals"), dict | list | np.ndarray):
        yield from _simulink(node, path)
        return
    keyed = _keyed(node)
    if keyed is not None:
        yield from _leaves(keyed, path, properties)
        return
    for key, value in node.items():
        yield from _leaves(value, (*path, str(key)), properties)


def _keyed(node: Mapping[Any, Any]) -> dict[str, list[Any]] | None:
    """Return the columns of a table whose cells have their rows' numbers as keys, as ``DataFrame.to_json`` writes it.

    Columns may hold the rows or rows the columns. A row's number that is no plain count stays as the column ``index``.
    """
    inner = list(node.values())
    if len(inner) < 2 or not all(isinstance(one, dict) and one.keys() == inner[0].keys() for one in inner):
        return None
    rows = _counted(inner[0])
    if rows is None and (rows := _counted(node)) is not None:
        node = {name: {row: node[row][name] for row in node} for name in inner[0]}
    if rows is None or not all(_is_cell(cell) for column in node.values() for cell in column.values()):
        return None
    columns = {str(name): list(column.values()) for name, column in node.items()}
    return columns if rows == list(range(len(rows))) else {"index": rows, **columns}


def _counted(keys: Mapping[Any, Any]) -> list[Any] | None:
    """Return keys as the numbers of rows, None where some is none."""
    found = [number(str(key)) for key in keys]
    return found if len(found) > 1 and all(value is not None for value in found) else None


def _is_cell(value: object) -> bool:
    return value is None or isinstance(value, str | int | float)


def _channels(node: Sequence[Any]) -> dict[str, list[Any]] | None:
    """Return the values of channels by name and unit, of objects such as ``{"name": …, "unit": …, "values": […]}``.

    Messages with a text and a list are none: their list has a name of its own, or a number differs from one to the
    next, as a time does. A channel's further lists are shorter than its values, as limits are.
    """
    found: dict[str, list[Any]] = {}
    scalars: dict[str, set[float]] = {}
    for item in node:
        small = {str(key).lower(): value for key, value in item.items()}
        name = next((small[key] for key in _NAMES if isinstance(small.get(key), str)), None)
        lists = {key: value for key, value in small.items() if isinstance(value, list)}
        longest = max(map(len, lists.values()), default=0)
        long = [key for key, value in lists.items() if len(value) == longest > 1]
        if name is None or len(long) != 1 or long[0] not in _VALUES:
            return None
        unit = next((small[key] for key in ("unit", "units") if isinstance(small.get(key), str)), "")
        title = f"{name} [{unit}]" if unit else name
        if title in found:
            return None
        found[title] = lists[long[0]]
        for key, value in small.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                scalars.setdefault(key, set()).add(value)
    is_one_length = len({len(values) for values in found.values()}) == 1
    return found if is_one_length and all(len(values) == 1 for values in scalars.values()) else None


def _sequence(
    node: Sequence[Any], path: Path, properties: dict[str, str]
) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    if node and all(isinstance(item, dict) for item in node):
        if (channels := _channels(node)) is not None:
            yield from _leaves(channels, path, properties)
            return
        keys = list(dict.fromkeys(key for item in node for key in item))
        for key in keys[:MOST_COLUMNS]:
            values = [item.get(key) for item in node]
            if any(isinstance(value, dict) for value in values):
                yield from _sequence(
                    [value if isinstance(value, dict) else {} for value in values], (*path, str(key)), properties
                )
            elif all(isinstance(value, list) for value in values):
                yield from _rows(values, (*path, str(key)), None)
            else:
                array = _numbers(values)
                if array is not None:
                    yield (*path, str(key)), array
    elif node and all(isinstance(item, list | tuple) for item in node):
        yield from _rows(node, path, None)
    elif (array := _numbers(node)) is not None:
        yield path or ("1",), array


def _rows(rows: Sequence[Any], path: Path, names: Sequence[str] | None) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    lengths = {len(row) for row in rows if isinstance(row, list | tuple)}
    if len(lengths) != 1 or not all(isinstance(row, list | tuple) for row in rows):
        return
    for j in range(min(lengths.pop(), MOST_COLUMNS)):
        array = _numbers([row[j] for row in rows])
        if array is not None:
            yield (*path, names[j] if names and j < len(names) else str(j + 1)), array


def _numbers(values: Sequence[Any]) -> NDArray[np.float64] | None:
    """Return numbers, also those in quotation marks, nan for null, or None for anything else."""
    if len(values) < 2:
        return None
    if any(isinstance(value, str) for value in values):
        values = [number(value) if isinstance(value, str) else value for value in values]
        if any(value is None for value in values):
            return None
    if not all(value is None or isinstance(value, int | float) for value in values):
        return None
    try:
        array = np.array([math.nan if value is None else float(value) for value in values])
    except OverflowError:
        return None
    return None if np.isnan(array).all() else array


def _array(node: NDArray[Any], path: Path, properties: dict[str, str]) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    if node.dtype.names:
        for name in node.dtype.names:
            yield from _leaves(node[name], (*path, name), properties)
        return
    if node.dtype == object:
        yield from _sequence([item for item in node.ravel()[:MOST_COLUMNS] if isinstance(item, dict)], path, properties)
        return
    if node.dtype.kind in "mM":
        first = node.ravel()[:1]
        node = (node - (first if node.dtype.kind == "M" else np.timedelta64(0, "ns"))) / np.timedelta64(1, "ns") * 1e-9
    if node.dtype.kind not in "biuf":
        return
    if node.size == 1 and path:
        properties.setdefault(path[-1].lower(), repr(float(node.ravel()[0])))
        return
    if node.ndim and node.size == max(node.shape) and node.size > 1:
        yield path or ("1",), np.array(node.ravel(), dtype=np.float64)
    elif node.ndim == 2 and min(node.shape) <= MOST_COLUMNS:
        tall = node if node.shape[0] >= node.shape[1] else node.T
        for j in range(tall.shape[1]):
            yield (*path, str(j + 1)), np.array(tall[:, j], dtype=np.float64)


def _simulink(node: Mapping[str, Any], path: Path) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    """Return Simulink's "structure with time": one time, and signals with values and labels."""
    time = np.asarray(node["time"], dtype=np.float64).ravel()
    yield (*path, "time"), time
    signals = node["signals"]
    for k, signal in enumerate(
        [signals] if isinstance(signals, dict) else list(np.ravel(np.asarray(signals, dtype=object)))
    ):
        if not isinstance(signal, dict) or "values" not in signal:
            continue
        values = np.asarray(signal["values"], dtype=np.float64)
        label = next(
            (str(signal[key]) for key in ("label", "blockName") if isinstance(signal.get(key), str) and signal[key]),
            str(k + 1),
        )
        label = label.rpartition("/")[2]
        if values.size == time.size:
            yield (*path, label), values.ravel()
        elif values.ndim == 2 and values.shape[0] == time.size:
            for j in range(values.shape[1]):
                yield (*path, f"{label}({j + 1})"), values[:, j].copy()


def _frame(node: Any, path: Path) -> Iterator[tuple[Path, NDArray[np.float64]]]:
    index = np.asarray(node.index)
    if index.dtype.kind in "mM":
        yield from _array(index, (*path, "time"), {})
    for name in node.columns:
        values = np.asarray(node[name])
        if values.dtype.kind in "biufmM":
            yield from _array(values, (*path, str(name)), {})
