"""Numbers in text: comment lines, one header row, rows of numbers."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.reading.headings import Heading, select
from servolens.reading.settings import comment_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["Table", "read_text"]

DELIMITERS = (",", ";", "\t")
MOST_COLUMNS = 1000


@final
@dataclass(frozen=True, slots=True)
class Table:
    """The needed columns of a file: values as logged, their stated units, and the settings of the file."""

    signals: dict[str, NDArray[np.float64]]
    units: dict[str, str | None]
    comments: dict[str, str]


@final
@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the numbers stand: separator, width of a row, line of the first row, and each signal's column."""

    delimiter: str
    width: int
    first: int
    chosen: Mapping[str, tuple[int, Heading]]


def read_text(content: bytes, columns: Mapping[str, str] | None) -> Table:
    """Read a CSV file's bytes.

    The numbers are parsed by NumPy's C reader; only when that fails are the lines read one by one, to name the one
    that is wrong. Comment lines are honoured wherever they stand.

    Raises
    ------
    InputError
        With one sentence that names line and column.
    """
    lines = _lines(content)
    comments = [line for line in lines if line.lstrip().startswith("#")] if b"#" in content else []
    if comments:
        lines = ["" if line.lstrip().startswith("#") else line for line in lines]
    top = next((k for k, line in enumerate(lines) if line.strip()), None)
    if top is None:
        raise InputError("holds no header row and no numbers")
    layout = _layout(lines[top], top, columns)
    numbers = _numbers(lines[layout.first :], layout)
    return Table(
        signals={signal: numbers[:, i].copy() for i, signal in enumerate(layout.chosen)},
        units={signal: heading.unit for signal, (_, heading) in layout.chosen.items()},
        comments=comment_settings(comments),
    )


def _lines(content: bytes) -> list[str]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start}); save it as UTF-8 CSV") from error
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.split("\n")


def _layout(header: str, top: int, columns: Mapping[str, str] | None) -> _Layout:
    delimiter = max(DELIMITERS, key=header.count)
    texts = _fields(header, delimiter)
    if len(texts) > MOST_COLUMNS:
        raise InputError(f"line {top + 1}: the header row has {len(texts)} columns; at most {MOST_COLUMNS} are read")
    if all(_float(text) is not None for text in texts):
        raise InputError(
            f"line {top + 1}: numbers stand where the header row should; name the columns, e.g. time [s],position [m]"
        )
    return _Layout(delimiter, len(texts), top + 1, select(texts, columns))


def _numbers(lines: Sequence[str], layout: _Layout) -> NDArray[np.float64]:
    """Return the values, shape (rows, signals)."""
    rows = sum(1 for line in lines if line)
    if not any(line.strip() for line in lines):
        raise InputError("the header row is not followed by numbers")
    wide = sum(line.count(layout.delimiter) for line in lines) != rows * (layout.width - 1)
    values = None if wide else _fast(lines, layout)
    if values is None or not np.isfinite(values).all():
        return _slow(lines, layout)
    return values


def _fast(lines: Sequence[str], layout: _Layout) -> NDArray[np.float64] | None:
    indices = [index for index, _ in layout.chosen.values()]
    try:
        return np.loadtxt(lines, delimiter=layout.delimiter, usecols=indices, comments=None, ndmin=2, quotechar='"')
    except (ValueError, OverflowError):
        return None


def _slow(lines: Sequence[str], layout: _Layout) -> NDArray[np.float64]:
    """Read line by line what the fast reader refused, and say which line is wrong."""
    rows = []
    for number, line in enumerate(lines, start=layout.first + 1):
        if not line.strip():
            continue
        fields = _fields(line, layout.delimiter)
        _check_width(fields, number, layout)
        rows.append([_value(fields[i], signal, number, layout) for signal, (i, _) in layout.chosen.items()])
    return np.array(rows, dtype=np.float64)


def _check_width(fields: Sequence[str], number: int, layout: _Layout) -> None:
    if len(fields) == layout.width or (len(fields) == layout.width + 1 and not fields[-1].strip()):
        return
    hint = "; decimal commas are not read, write points" if len(fields) > layout.width else ""
    raise InputError(f"line {number} has {len(fields)} values where the header row has {layout.width}{hint}")


def _value(text: str, signal: str, number: int, layout: _Layout) -> float:
    value = _float(text)
    where = f"line {number}, {signal}"
    if value is None and layout.delimiter != "," and _float(text.replace(",", ".", 1)) is not None:
        raise InputError(f"{where}: {quote(text.strip())} has a decimal comma; write points")
    if value is None:
        what = quote(text.strip()) + " is not a number" if text.strip() else "the value is missing"
        raise InputError(f"{where}: {what}; fill or leave out such rows")
    if not math.isfinite(value):
        raise InputError(f"{where}: {quote(text.strip())} is not a finite number; fill or leave out such rows")
    return value


def _fields(line: str, delimiter: str) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter))
    except (csv.Error, StopIteration):
        return line.split(delimiter)


def _float(text: str) -> float | None:
    if "_" in text or not text.isascii():
        return None
    try:
        return float(text)
    except ValueError:
        return None
