"""Tables in text: any separator, decimal points or commas, preambles, rows of units, time stamps."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.cells import (
    REWRITE,
    decimal_sign,
    fields_of,
    grouped_or_decimal,
    is_switch,
    is_value,
    number,
)
from servolens.reading.column_cells import ColumnCells
from servolens.reading.files import quote
from servolens.reading.layout import Layout, find_layout, properties_of, units_above
from servolens.reading.lines import unbroken, unified
from servolens.reading.serial_monitor import as_table
from servolens.reading.settings import comment_settings
from servolens.reading.stamps import is_stamp
from servolens.reading.table import MOST_COLUMNS, Column, Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

__all__ = ["read_text"]

SEPARATORS = ("\t", ";", ",", "|", " ")
LAYOUT_LINES = 400
"""Lines that are looked at to find the layout; preambles of known programs have up to about 60."""
LINES_AT_ONCE = 50_000
"""Lines that are split at once, so that memory stays bounded."""
LARGE_FILE = 4 * 2**20
"""From this size on [bytes] importing pyarrow's reader pays, where it is installed."""
FILETIME = 1e16
"""Times of a scope from which on they count 100 ns since 1601: such of this century begin with 1.2e17."""
LAST_TEXTS = 5
"""Lines at the end that may hold one text, as ``EOF``."""
LAST_WORDS = 20
"""Lines at the end that may be a table's statistics, of which there are ten or so."""
_WORD = re.compile(r"[^\W\d_]{2,}(?: [^\W\d_]+)*:?")
_COMMENT = re.compile(rb'(?m)^[ \t]*(?:#|%|//|"#+[ \t]*[A-Za-z_]\w*[ \t]*=)[^\n]*')
_SIGNS = (b"#", b"%", b"//")
_END_OF_HEADER = "***End_of_Header***"


@final
@dataclass(frozen=True, slots=True)
class _Form:
    """How the lines of numbers are to be read: separator, decimal sign, layout, index of the first line.

    `moved` is by how many lines they stand further down than in the file.
    """

    separator: str
    decimal: str
    layout: Layout
    first: int
    moved: int = 0


def read_text(content: bytes) -> tuple[Table, ...]:
    """Read a file of text: comment lines, perhaps a preamble, a row of names, perhaps one of units, numbers.

    The numbers are parsed by NumPy's or pyarrow's C reader; only where those fail are the lines split one by one.
    ``# key = value`` lines are honoured wherever they stand.

    Raises
    ------
    InputError
        With one sentence that names the line.
    """
    plain, comments = _without_comments(unified(content))
    plain, breaks = unbroken(plain, LAYOUT_LINES)
    plain, cut, moved = as_table(plain)
    form = replace(_form(plain, comments, moved - breaks), moved=moved - breaks)
    columns, remarks = _columns(plain, form)
    table = Table(
        columns=columns,
        comments=comment_settings(_as_written(line, form.separator) for line in comments if line[0] in '#"'),
        properties=form.layout.properties,
        has_names=form.layout.has_names,
        remarks=(*cut, *remarks),
    )
    return _by_clock(table) if form.layout.has_clocks else (table,)


def _as_written(line: str, separator: str) -> str:
    """Return a comment line without what a spreadsheet adds to it: quotation marks, and blank cells up to the width."""
    if separator == " " or not (line.startswith('"') or line.endswith((separator, '"'))):
        return line
    return separator.join(fields_of(line, separator)).rstrip(f"{separator} ")


def _by_clock(table: Table) -> tuple[Table, ...]:
    """Split a table whose columns have times of their own before them; columns of one clock stay together.

    Slower channels end above the last row, and times may be FILETIME: both are how TwinCAT Scope exports.
    """
    label = table.columns[0].name
    clocks = [column.values for column in table.columns if column.name == label]
    start = min((float(clock[0]) for clock in clocks if clock.size), default=0.0)
    groups: list[list[Column]] = []
    for column in table.columns:
        if column.name != label:
            groups[-1].append(column)
            continue
        clock = replace(column, values=_milliseconds(column.values, start))
        same = next((group for group in groups if np.array_equal(group[0].values, clock.values, equal_nan=True)), None)
        groups = [group for group in groups if group is not same] + [same or [clock]]
    return tuple(replace(table, columns=_ended(group)) for group in groups)


def _milliseconds(clock: Matrix, start: float) -> Matrix:
    """Return the times of a scope from its `start` [ms]; FILETIME counts 100 ns since 1601, even in part."""
    if not start >= FILETIME:
        return clock
    known = np.isfinite(clock)
    ticks = clock - start
    count = int(np.count_nonzero(known))
    even = ticks[0] + (ticks[known][-1] - ticks[0]) / max(count - 1, 1) * np.arange(clock.size)
    rounding = np.spacing(start)  # of numbers as large as FILETIME: 1.6 µs
    if np.all(np.abs(even - ticks)[known] <= rounding):
        ticks = np.where(known, np.round(even), np.nan)
    return ticks * 1e-4


def _ended(group: Sequence[Column]) -> tuple[Column, ...]:
    """Return the columns of a clock up to its last instant."""
    known = np.flatnonzero(np.isfinite(group[0].values))
    end = int(known[-1]) + 1 if known.size else 0
    cut = [replace(column, values=column.values[:end]) for column in group]
    return tuple(replace(c, fault=None) if np.isfinite(c.values).all() else c for c in cut)


def _without_comments(content: bytes) -> tuple[bytes, list[str]]:
    """Blank the comment lines and return them; below the head they are only looked for where their signs stand."""
    end = sum(len(line) + 1 for line in content.split(b"\n", LAYOUT_LINES)[:LAYOUT_LINES])
    parts = [content[:end], content[end:]]
    found: list[str] = []
    for k, part in enumerate(parts):
        if any(sign in part for sign in _SIGNS):
            found += [line.strip().decode() for line in _COMMENT.findall(part)]
            parts[k] = _COMMENT.sub(b"", part)
    return b"".join(parts), found


def _form(content: bytes, comments: Sequence[str], moved: int) -> _Form:
    """Find separator, decimal sign and layout from the first lines.

    Of several separators the one that leaves the largest share of cells that are numbers, blank ones left out; of equal
    ones one by which the head names as many columns as there are, then the one that leaves the most numbers.
    """
    lines = [(i, line) for i, line in enumerate(content.split(b"\n", LAYOUT_LINES)[:LAYOUT_LINES]) if line.strip()]
    if not lines:
        raise InputError("holds no header row and no numbers")
    texts = [line.decode(errors="replace") for _, line in lines]
    skipped = max((k + 1 for k, text in enumerate(texts) if text.startswith(_END_OF_HEADER)), default=0)
    found: list[tuple[tuple[float, bool, bool, int], str, str, Layout]] = []
    for separator in SEPARATORS:
        decimal = decimal_sign(content, separator)
        rows = [fields_of(text, separator) for text in texts[skipped:]]
        layout = find_layout(rows, decimal)
        if layout is not None:
            row = [cell for cell in rows[layout.first] if cell.strip()]
            good = sum(is_value(cell, decimal) for cell in row)
            rank = (good / max(len(row), 1), layout.has_names, not layout.other_width, good)
            found.append((rank, separator, decimal, layout))
    if not found:
        raise InputError(_nothing(texts))
    _, separator, decimal, layout = max(found, key=lambda item: item[0])
    if len(layout.names) > MOST_COLUMNS:
        raise InputError(f"the table has {len(layout.names)} columns; at most {MOST_COLUMNS} are read")
    if layout.other_width:
        hint = "; where commas are decimal too, separate the columns by semicolons" if separator == "," else ""
        raise InputError(
            f"the rows have {len(layout.names)} values where the header row has {layout.other_width}{hint}"
        )
    above = skipped + layout.first - 1
    if above > skipped and (odd := _odd_number(fields_of(texts[above], separator), layout, decimal)):
        raise InputError(
            f"line {lines[above][0] + 1 - moved} holds {quote(odd)}, no number as those below it; {REWRITE}"
        )
    head = [fields_of(text, separator) for text in texts[:skipped]]
    units = units_above(head, layout.units)
    layout = replace(layout, units=units, properties={**properties_of(head), **layout.properties})
    if not layout.has_names and above >= skipped:
        layout = _names_otherwise(layout, texts[above], separator)
    if not layout.has_names and comments:
        layout = _names_in_comment(layout, comments[-1], separator)
    return _Form(separator, decimal, layout, lines[skipped + layout.first][0])


def _odd_number(cells: Sequence[str], layout: Layout, decimal: str) -> str:
    """Return a cell that is a number in other signs than those below, of a row without any letter; empty without."""
    given = [cell.strip() for cell in cells if cell.strip()]
    is_row = len(cells) == len(layout.names) and all(re.search(r"\d", cell) for cell in given)
    if not is_row or any(c.isalpha() for cell in given for c in cell) or is_stamp(given[0]):
        return ""
    return next((cell for cell in given if not is_value(cell, decimal)), "")


def _nothing(texts: Sequence[str]) -> str:
    if any(len(fields_of(text, separator)) > 1 for text in texts[-1:] for separator in SEPARATORS[:3]):
        return "the header row is not followed by numbers"
    return "is text without a table of numbers; a record has a row of names and rows of numbers below it"


def _names_otherwise(layout: Layout, line: str, separator: str) -> Layout:
    """Take the names from the line above the numbers where another separator makes as many texts of it."""
    for other in SEPARATORS[: SEPARATORS.index(" ")]:
        cells = [cell.strip().strip('"').strip() for cell in fields_of(line, other)]
        is_text = all(any(c.isalpha() for c in cell) for cell in cells)
        if other != separator and len(cells) == len(layout.names) and is_text:
            return replace(layout, names=tuple(cells), has_names=True, other_width=0)
    return layout


def _names_in_comment(layout: Layout, line: str, separator: str) -> Layout:
    """Take the names from a comment line, as ``numpy.savetxt`` writes them."""
    cells = [cell.strip() for cell in fields_of(line.lstrip("#%/ \t"), separator)]
    if len(cells) != len(layout.names) or "=" in line or any(number(cell) is not None for cell in cells):
        return layout
    return replace(layout, names=tuple(cells), has_names=True)


def _columns(content: bytes, form: _Form) -> tuple[tuple[Column, ...], tuple[Finding, ...]]:
    """Return the columns, and what was left out below them."""
    at = 0
    for _ in range(form.first):
        at = content.index(b"\n", at) + 1
    body, remarks = _without_last_words(_trimmed(content[at:]), form)
    if form.decimal in (",", ".") and (cell := grouped_or_decimal(body, form.separator, form.decimal)):
        raise InputError(
            f"{quote(cell)} may be a whole number with separated thousands, as may all numbers with a"
            f" {quote(form.decimal)} here; {REWRITE}"
        )
    matrix = _fast(body, form)
    if matrix is None or not np.isfinite(matrix).all():
        return _slow(body, form), remarks
    layout = form.layout
    columns = tuple(
        Column(name, matrix[:, j].copy(), layout.units[j]) for j, name in enumerate(layout.names) if j in layout.typed
    )
    return columns, remarks


def _without_last_words(body: bytes, form: _Form) -> tuple[bytes, tuple[Finding, ...]]:
    """Leave out what a program has written below the numbers, and say so: a text alone, or rows that begin with a word.

    Rows that begin with one (``Mean,50.1,30.2``) are none of the table's only where its first column counts on in every
    row, as a time does; a word in any other column may be a reading, as ``off`` and ``OL`` are.
    """
    kept = _cut(body, form, LAST_TEXTS, with_rows=False)
    statistics = _cut(body, form, LAST_WORDS, with_rows=True)
    if len(statistics) < len(kept) and _counts_on(statistics, form):
        kept = statistics
    below = [line.strip() for line in body[len(kept) :].decode(errors="replace").split("\n") if line.strip()]
    if not below:
        return kept, ()
    begins = quote(fields_of(below[0], form.separator)[0].strip() or below[0])
    what = f"{len(below)} lines below the table were" if len(below) > 1 else "a line below the table was"
    message = f"{what} left out; {'the first' if len(below) > 1 else 'it'} begins with {begins}."
    return kept, (Finding(code="lines_below_left_out", severity="note", message=message),)


def _cut(body: bytes, form: _Form, most: int, *, with_rows: bool) -> bytes:
    """Return the text without up to `most` lines of one text at its end, and without rows that begin with a word."""
    end = len(body)
    for _ in range(most):
        at = body.rfind(b"\n", 0, end)
        cells = fields_of(body[at + 1 : end].decode(errors="replace").strip(), form.separator)
        given = [cell for cell in cells if cell.strip()]
        is_alone = len(given) == 1 and not is_value(given[0], form.decimal)
        is_row = with_rows and _WORD.fullmatch(cells[0].strip()) is not None and not is_value(cells[0], form.decimal)
        if at < 0 or (given and not is_alone and (not is_row or is_switch(cells[0]))):
            break
        end = at
    return _trimmed(body[:end])


def _counts_on(body: bytes, form: _Form) -> bool:
    """Tell whether the first column holds numbers or time stamps that increase in every row."""
    lines = [line for line in body.decode(errors="replace").split("\n") if line.strip()]
    cells = ColumnCells(form.decimal)
    cells.add([fields_of(line, form.separator)[0] for line in lines], [""] * len(lines))
    column = cells.column("", None)
    return column.fault is None and column.switches is None and bool(np.all(np.diff(column.values) > 0))


def _trimmed(body: bytes) -> bytes:
    """Leave out blank lines at the end; blank cells at the end of the last row stay."""
    while body and not body[body.rfind(b"\n") + 1 :].strip():
        body = body[: max(body.rfind(b"\n"), 0)]
    return body.rstrip(b" ")


def _fast(body: bytes, form: _Form) -> Matrix | None:
    """Return all cells as numbers, shape (rows, columns), or None where some cell is none or rows differ in length."""
    separator, width = form.separator.encode(), len(form.layout.names)
    if len(form.layout.typed) < width or b'"' in body or b"_" in body or not body.isascii():
        return None
    if len(form.decimal) > 1:
        return None  # thousands are separated
    if form.decimal == ",":
        body = body.replace(b",", b".")
    if body.count(separator + b"\n") == body.count(b"\n") > 0 and form.separator != " ":
        return None  # a separator at every line's end: the last column is blank
    if len(body) >= LARGE_FILE and form.separator != " ":
        matrix = _arrow(body, form.separator, width)
        if matrix is not None:
            return matrix
    if form.separator == " ":
        return _spaced(body, width)
    return _separated(body, separator, width)


def _separated(body: bytes, separator: bytes, width: int) -> Matrix | None:
    signs = np.frombuffer(body, dtype=np.uint8)
    ends = signs[np.flatnonzero((signs == ord(separator)) | (signs == ord("\n")))] == ord("\n")
    if (ends.size + 1) % width or not np.append(ends, True).reshape(-1, width)[:, -1].all():
        return None
    if int(ends.sum()) + 1 != (ends.size + 1) // width:
        return None
    if separator == b"\t":  # NumPy takes tabs for white space, and would skip blank cells
        if b"," in body:
            return None
        body, separator = body.replace(b"\t", b","), b","
    matrix = _parsed(body.replace(b"\n", separator), separator.decode(), width)
    return matrix if matrix is not None and matrix.size == ends.size + 1 else None


def _spaced(body: bytes, width: int) -> Matrix | None:
    lines = body.split(b"\n")
    if any(len(line.split()) != width for line in lines):
        return None
    return _parsed(body, " ", width)


def _parsed(body: bytes, separator: str, width: int) -> Matrix | None:
    try:
        values = np.fromstring(body, sep=separator)
    except (ValueError, DeprecationWarning):
        return None
    return values.reshape(-1, width) if values.size and values.size % width == 0 else None


def _arrow(body: bytes, separator: str, width: int) -> Matrix | None:
    """Return what pyarrow's reader makes of the numbers, or None without it or where it finds something else."""
    try:
        import pyarrow as pa
        from pyarrow import csv as reader
    except ImportError:
        return None
    names = [str(j) for j in range(width)]
    try:
        table = reader.read_csv(
            pa.BufferReader(body),
            read_options=reader.ReadOptions(column_names=names),
            parse_options=reader.ParseOptions(delimiter=separator, quote_char=False),
            convert_options=reader.ConvertOptions(column_types=dict.fromkeys(names, pa.float64()), null_values=[]),
        )
    except pa.ArrowInvalid:
        return None
    return np.column_stack([column.to_numpy() for column in table.columns])


def _slow(body: bytes, form: _Form) -> tuple[Column, ...]:
    """Split the lines, and remember for each column the first cell that is no number."""
    layout = form.layout
    columns = [ColumnCells(form.decimal) for _ in layout.names]
    for lines, rows in _rows(body, form):
        places = [f"line {line}" for line in lines]
        for column, cells in zip(columns, zip(*rows, strict=True), strict=True):
            column.add(cells, places)
    return tuple(
        column.column(name, unit) for column, name, unit in zip(columns, layout.names, layout.units, strict=True)
    )


def _rows(body: bytes, form: _Form) -> Iterator[tuple[list[int], list[list[str]]]]:
    """Yield chunks of rows with the numbers of their lines."""
    width = len(form.layout.names)
    at, line = 0, form.first - form.moved
    while at < len(body):
        end = at
        for _ in range(LINES_AT_ONCE):
            end = body.find(b"\n", end) + 1
            if end == 0:
                end = len(body)
                break
        places: list[int] = []
        rows: list[list[str]] = []
        texts = body[at:end].decode(errors="replace").removesuffix("\n").split("\n")
        for i, text in enumerate(texts, start=1):
            line += 1
            if text.strip():
                fields = fields_of(text, form.separator)
                rows.append(_whole(fields, width, line, is_last=end == len(body) and i == len(texts)))
                places.append(line)
        yield places, rows
        at = end


def _whole(fields: list[str], width: int, line: int, *, is_last: bool) -> list[str]:
    """Return a row of `width` cells, or refuse the line; the last one may be a log's that was cut off."""
    if len(fields) == width or (len(fields) == width + 1 and not fields[-1].strip()):
        return fields[:width]
    hint = "; if the log was cut off there, delete this last line" if is_last and len(fields) < width else ""
    count = f"{len(fields)} value{'s' if len(fields) > 1 else ''}"
    raise InputError(f"line {line} has {count} where the header row has {width}{hint}")
