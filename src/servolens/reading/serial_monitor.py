"""What a microcontroller prints, as serial monitors show and save it: values with labels, stamps before an arrow."""

from __future__ import annotations

import re

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.files import quote

__all__ = ["as_table"]

_ARROW = re.compile(rb"(?m)^(\d\d:\d\d:\d\d\.\d+) -> ")
_WORD = rb"[A-Za-z_][\w.\[\]]{0,40}"
_LABEL = re.compile(rb"(?<![\w.])(" + _WORD + rb"(?: " + _WORD + rb"){0,4})[ \t]{0,3}[:=][ \t]{0,3}(?=[-+]?\.?\d|nan)")
_CELL = re.compile(rb"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan)\s*([^\s\d,;:=][^\s,;:=]*)?\s*[,;]?\s*")
_COMMA = re.compile(rb"(?<![\w.,])([-+]?\d+),(\d+)(?![.,]?\d)")
"""A number with a decimal comma: labels begin with letters, so what stands before a digit separates no values."""
_POINT = re.compile(rb"(?<![\w.,])[-+]?\d*\.\d")
_SEPARATOR = re.compile(rb"[,;\t]")


def as_table(content: bytes) -> tuple[bytes, tuple[Finding, ...], int]:
    r"""Return the text of a serial monitor as a table with a row of names, and remarks; others as they are.

    The third value is by how many lines the rows of numbers stand further down than they did. The line in the middle
    tells: whether a stamp and an arrow stand before the values, and whether each value has a label. Labels are taken
    off where most lines are nothing but the same labels with values. The first line and the last may be parts of such
    a line; what stands above is a preamble, of which settings are taken. Decimal commas become points where no value
    has a point.

    Raises
    ------
    InputError
        If another line stands among those with labels.

    Examples
    --------
    >>> as_table(b"r:1,y:0.5\nr:1,y:0.7\n")[0]
    b'r,y\n1,0.5\n1,0.7\n'
    >>> as_table(b"12:00:00.001 -> 1 0.5\n12:00:00.003 -> 1 0.7\n")[0]
    b'12:00:00.001 1 0.5\n12:00:00.003 1 0.7\n'
    """
    line = _middle(content)
    labels, _ = _labelled(_COMMA.sub(rb"\1.\2", _ARROW.sub(b"", line)))
    if len(labels) > 1:
        lines, remarks = _pointed(content.split(b"\n"), labels)
        has_arrow = _ARROW.match(line) is not None
        rows = [_row(line, labels, has_arrow=has_arrow) for line in lines]
        if 2 * sum(row is not None for row in rows) > sum(bool(line.strip()) for line in lines):
            return _written(lines, rows, [*([b"time"] if has_arrow else []), *labels], remarks)
    if arrow := _ARROW.match(line):
        found = _SEPARATOR.search(line, arrow.end())
        content = _ARROW.sub(rb"\1" + (found[0] if found else b" "), content)
    return content, (), 0


def _pointed(lines: list[bytes], labels: list[bytes]) -> tuple[list[bytes], list[Finding]]:
    """Return the lines with points for decimal commas of labelled values, and that these were read.

    As they are where a value has a point. What stands above the values, a date or settings, tells nothing of that.
    """

    def names(line: bytes) -> list[bytes]:
        return _labelled(_ARROW.sub(b"", line))[0]

    pointed = {i: _COMMA.sub(rb"\1.\2", line) for i, line in enumerate(lines) if _COMMA.search(_ARROW.sub(b"", line))}
    changed = {i: line for i, line in pointed.items() if names(line)}
    is_needed = any(names(line) == labels for line in changed.values())
    has_points = any(names(line) == labels for line in lines if _POINT.search(_ARROW.sub(b"", line)))
    if not is_needed or has_points:
        return lines, []
    found = _COMMA.search(_ARROW.sub(b"", lines[min(changed)]))
    message = f"numbers such as {found[0].decode() if found else ''} were read with a decimal comma."
    remark = Finding(code="decimal_commas", severity="note", message=message)
    return [changed.get(i, line) for i, line in enumerate(lines)], [remark]


def _labelled(line: bytes) -> tuple[list[bytes], list[bytes]]:
    """Return labels and values of a line that is made of nothing else, values with their units; else nothing."""
    before, *parts = _LABEL.split(line)
    cells = [_CELL.fullmatch(text) for text in parts[1::2]]
    if before.strip() or not all(cells):
        return [], []
    return parts[::2], [b" ".join(filter(None, cell.groups())) for cell in cells if cell]


def _row(line: bytes, labels: list[bytes], *, has_arrow: bool) -> list[bytes] | None:
    """Return the cells of a line with these labels, None of any other."""
    arrow = _ARROW.match(line) if has_arrow else None
    found, cells = _labelled(line[arrow.end() :] if arrow else line)
    if found != labels or (has_arrow and arrow is None):
        return None
    return [*([arrow[1]] if arrow else []), *cells]


def _written(
    lines: list[bytes], rows: list[list[bytes] | None], names: list[bytes], remarks: list[Finding]
) -> tuple[bytes, tuple[Finding, ...], int]:
    """Return the table, with the settings above it, remarks with what was left out, and how far the rows moved."""
    given = [i for i, line in enumerate(lines) if line.strip()]
    first = next(i for i in given if rows[i] is not None)
    head: list[bytes] = []
    body = [b""] * (len(lines) - first)
    for i in given:
        row, line = rows[i], lines[i].strip()
        settings = _settings(line)
        if row is not None:
            body[i - first] = b",".join(row)
        elif i == given[-1] or (i == given[0] and _is_end(line, names)):
            remarks.append(_left_out("last" if i == given[-1] else "first", line))
        elif i < first and not set(settings) & set(names) and (settings or not _LABEL.search(line)):
            head += [b": ".join(pair) for pair in settings.items()]
        else:
            raise InputError(
                f"line {i + 1} reads {quote(line.decode(errors='replace'))}, where the others hold values with the"
                f" labels {quote(', '.join(name.decode(errors='replace') for name in names))}; leave it out"
            )
    return b"\n".join([*head, b",".join(names), *body]), tuple(remarks), len(head) + 1 - first


def _settings(line: bytes) -> dict[bytes, bytes]:
    """Return the labels with values of a line in a preamble; a value that stands alone may have any unit."""
    labels, values = _labelled(line)
    before, *parts = _LABEL.split(line)
    if len(parts) == len(("label", "value")) and not before.strip():
        labels, values = parts[:1], parts[1:]
    return dict(zip(labels, values, strict=True))


def _is_end(line: bytes, names: list[bytes]) -> bool:
    """Tell whether a line is the end of one with labels, of which the first may have lost its beginning."""
    _, *parts = _LABEL.split(line)
    found = parts[::2]
    begun = names[-len(found)] if 0 < len(found) <= len(names) else b""
    return not found or (begun.endswith(found[0]) and found[1:] == names[len(names) - len(found) + 1 :])


def _left_out(which: str, line: bytes) -> Finding:
    message = f"the {which} line, {quote(line.decode(errors='replace'))}, was left out: it does not hold all values."
    return Finding(code="lines_left_out", severity="note", message=message)


def _middle(content: bytes) -> bytes:
    """Return a line in the middle of a text."""
    start = content.rfind(b"\n", 0, len(content) // 2) + 1
    end = content.find(b"\n", start)
    return content[start:] if end < 0 else content[start:end]
