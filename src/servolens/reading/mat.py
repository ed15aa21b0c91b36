"""MATLAB's MAT v5 files: the vectors that are asked for, and nothing else of them."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError
from servolens.reading.csv_text import Table
from servolens.reading.files import LARGEST, quote
from servolens.reading.headings import select

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

__all__ = ["read_mat"]

NUMERIC = ("double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "logical")
_HEADER = 128
_COMPRESSED = 15
_DAMAGED = "is a damaged MAT file; save it again with -v7"


def read_mat(content: bytes, columns: Mapping[str, str] | None) -> Table:
    """Read the vectors of a MAT v5 file that are signals.

    Raises
    ------
    InputError
        If a signal is missing or no real vector, or if the file is damaged.
    """
    _check_inflated(content)
    variables = _variables(content)
    chosen = select(list(variables), columns)
    names = {signal: list(variables)[index] for signal, (index, _) in chosen.items()}
    for name in names.values():
        _check_variable(name, *variables[name])
    loaded = _quietly("loadmat", content, variable_names=list(names.values()))
    return Table(
        signals={signal: _vector(name, loaded.get(name)) for signal, name in names.items()},
        units={signal: heading.unit for signal, (_, heading) in chosen.items()},
        comments={},
    )


def _check_inflated(content: bytes) -> None:
    """Refuse a file whose compressed parts would fill the memory."""
    order = "<" if content[126:128] == b"IM" else ">"
    total, at = 0, _HEADER
    while at + 8 <= len(content):
        kind, size = struct.unpack(f"{order}II", content[at : at + 8])
        if kind == _COMPRESSED:
            total += _inflated_size(content[at + 8 : at + 8 + size], LARGEST - total)
        at += 8 + size


def _inflated_size(data: bytes, limit: int) -> int:
    inflater, total = zlib.decompressobj(), 0
    try:
        while data and not inflater.eof:
            piece = inflater.decompress(data, 2**20)
            total += len(piece)
            if total > limit:
                raise InputError(f"holds more than {LARGEST / 2**20:.0f} MiB of numbers, the most that is read")
            data = inflater.unconsumed_tail
    except zlib.error as error:
        raise InputError(_DAMAGED) from error
    return total


def _variables(content: bytes) -> dict[str, tuple[tuple[int, ...], str]]:
    variables = {str(name): (tuple(shape), str(kind)) for name, shape, kind in _quietly("whosmat", content)}
    nested = [name for name, (_, kind) in variables.items() if kind not in NUMERIC]
    if nested and len(nested) == len(variables):
        kind = variables[nested[0]][1]
        raise InputError(
            f"holds only a {kind} {quote(nested[0])}; save its fields as plain vectors (save with -struct in MATLAB)"
        )
    return variables


def _check_variable(name: str, shape: tuple[int, ...], kind: str) -> None:
    if kind not in NUMERIC:
        raise InputError(f"variable {quote(name)} is a {kind}, not a vector of numbers; save it as a plain vector")
    if math.prod(shape) != max(shape, default=1):
        raise InputError(f"variable {quote(name)} has shape {_times(shape)}; a signal is a vector, one column of it")


def _vector(name: str, value: Any) -> NDArray[np.float64]:
    array = np.asarray(value)
    if array.dtype.kind == "c":
        raise InputError(f"variable {quote(name)} is complex; a signal is real")
    if array.dtype.kind not in "fiub":
        raise InputError(f"variable {quote(name)} is not a vector of numbers; save it as a plain vector")
    return array.astype(np.float64).ravel()


def _quietly(function: str, content: bytes, **options: Any) -> Any:
    import scipy.io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return getattr(scipy.io, function)(io.BytesIO(content), **options)
    except MemoryError as error:
        raise InputError("is too large for this computer's memory") from error
    except Exception as error:  # noqa: BLE001, RUF100 - SciPy raises whatever a damaged file makes it stumble over
        raise InputError(_DAMAGED) from error


def _times(shape: tuple[int, ...]) -> str:
    return " × ".join(str(size) for size in shape)
