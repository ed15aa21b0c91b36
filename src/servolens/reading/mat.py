"""MATLAB's MAT v5 files: their vectors and matrices.

The format is MathWorks' *MAT-File Format*, "Level 5 MAT-Files". It is read here and not by ``scipy.io.loadmat``, which
a damaged file can crash together with the interpreter; every offset is checked, and compressed parts are inflated only
as far as they are needed.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.reading import files
from servolens.reading.files import quote
from servolens.reading.table import MOST_COLUMNS, Column, Fault, Table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

__all__ = ["read_mat"]

_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_KINDS = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse matrix", 16: "function", 17: "object"}
_NUMERIC = range(6, 16)
_COMPLEX = 0x800
_HEADER = 128
_BEGINNING = 4096
"""Bytes of a variable that are inflated to learn its name, its kind and its shape."""
_DAMAGED = "is a damaged MAT file; save it again with -v7"


def read_mat(content: bytes) -> Table:
    """Read the vectors and the columns of the matrices of a MAT v5 file.

    What is neither is kept by its name, with the reason why it is no signal; a file of nothing else has no columns of
    numbers (:func:`~servolens.reading.nested.read_mat_deep` reads those).

    Raises
    ------
    InputError
        If the file is damaged or holds more numbers than are read.
    """
    try:
        variables = [variable for variable in _variables(content) if variable.name]
        files.check_numbers(sum(math.prod(v.shape) for v in variables if _reason(v) is None))
        columns = tuple(column for variable in variables for column in _columns(variable))
    except (struct.error, zlib.error, IndexError) as error:
        raise InputError(_DAMAGED) from error
    numeric = [variable for variable in variables if _reason(variable) is None]
    is_bare = len(numeric) == 1 and len(columns) > 1 and not _is_vector(numeric[0])
    return Table(columns, has_names=not is_bare)


def _columns(variable: _Variable) -> Iterator[Column]:
    reason = _reason(variable)
    if reason is not None:
        yield Column(variable.name, np.empty(0), fault=Fault("", reason))
        return
    values = _values(variable)
    if _is_vector(variable):
        yield Column(variable.name, values)
        return
    matrix = values.reshape(variable.shape, order="F")
    for j in range(matrix.shape[1]):
        yield Column(f"{variable.name}(:,{j + 1})", matrix[:, j].copy())


def _is_vector(variable: _Variable) -> bool:
    return math.prod(variable.shape) == max(variable.shape)


@final
@dataclass(frozen=True, slots=True)
class _Variable:
    """A variable's name, class and shape, and where its bytes are; `order` is the file's byte order."""

    name: str
    kind: int
    is_complex: bool
    shape: tuple[int, ...]
    body: memoryview
    compressed: bool
    order: str


@final
@dataclass(frozen=True, slots=True)
class _Element:
    """One tagged piece: its type, its bytes (perhaps cut short), its stated size, where the next one begins."""

    kind: int
    data: memoryview
    size: int
    end: int


def _variables(content: bytes) -> Iterator[_Variable]:
    order = "<" if content[126:128] == b"IM" else ">"
    whole, at = memoryview(content), _HEADER
    while at < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        body = whole[at : at + 8 + size]
        if len(body) < 8 + size:
            raise InputError(_DAMAGED)
        if kind == _COMPRESSED:
            inflated = zlib.decompressobj().decompress(body[8:], _BEGINNING)
            yield _described(memoryview(inflated), body[8:], True, order)
        elif kind == _MATRIX:
            yield _described(body, body, False, order)
        at += 8 + size


def _described(beginning: memoryview, body: memoryview, compressed: bool, order: str) -> _Variable:
    """Read flags, shape and name, which stand before a variable's values."""
    if struct.unpack_from(f"{order}I", beginning, 0)[0] != _MATRIX:
        raise InputError(_DAMAGED)
    flags = _element(beginning, 8, order)
    word = struct.unpack_from(f"{order}I", flags.data)[0]
    kind = word & 0xFF
    shape: tuple[int, ...] = ()
    following = _element(beginning, flags.end, order)
    if kind != 17:  # an object of MATLAB's newer classes has no shape
        shape = struct.unpack(f"{order}{len(following.data) // 4}i", following.data[: len(following.data) // 4 * 4])
        following = _element(beginning, following.end, order)
    name = bytes(following.data).decode("ascii", "replace")
    return _Variable(name, kind, bool(word & _COMPLEX), shape, body, compressed, order)


def _element(buffer: memoryview, at: int, order: str) -> _Element:
    """Read the tag at `at`; up to four bytes of data may stand in the tag itself."""
    word, size = struct.unpack_from(f"{order}II", buffer, at)
    if word >> 16:
        size = word >> 16
        return _Element(word & 0xFFFF, buffer[at + 4 : at + 4 + min(size, 4)], size, at + 8)
    return _Element(word, buffer[at + 8 : at + 8 + size], size, at + 8 + -(-size // 8) * 8)


def _reason(variable: _Variable) -> str | None:
    """Return why a variable is neither a real vector nor a table of such, None if it is."""
    name, shape = quote(variable.name), variable.shape
    if variable.kind not in _NUMERIC:
        return f"variable {name} is a {_kind(variable)}, not a vector of numbers; save it as a plain vector"
    if variable.is_complex:
        return f"variable {name} is complex; a signal is real"
    if min(shape, default=-1) < 0 or len(shape) > 32:
        raise InputError(_DAMAGED)
    if math.prod(shape) != max(shape) and (len(shape) > 2 or shape[1] > MOST_COLUMNS):
        sizes = " × ".join(str(size) for size in shape)
        return f"variable {name} has shape {sizes}; a signal is a vector, one column of it"
    return None


def _values(variable: _Variable) -> NDArray[np.float64]:
    """Return the values as float64, in whatever type they are stored."""
    order, count = variable.order, math.prod(variable.shape)
    buffer = variable.body
    if variable.compressed:
        buffer = memoryview(zlib.decompressobj().decompress(buffer, _BEGINNING + 8 * count))
    at = 8
    for _ in range(3):  # flags, shape, name
        at = _element(buffer, at, order).end
    numbers = _element(buffer, at, order)
    stored = _STORED.get(numbers.kind)
    if stored is None:
        raise InputError(_DAMAGED)
    dtype = np.dtype(order + stored)
    if numbers.size != count * dtype.itemsize or len(numbers.data) != numbers.size:
        raise InputError(_DAMAGED)
    return np.frombuffer(numbers.data, dtype=dtype).astype(np.float64)


def _kind(variable: _Variable) -> str:
    return _KINDS.get(variable.kind, "value of an unknown class")
