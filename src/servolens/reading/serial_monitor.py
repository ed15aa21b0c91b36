"""What a microcontroller prints, as serial monitors show and save it: values with labels, stamps before an arrow."""

from __future__ import annotations

import re

__all__ = ["as_table"]

_ARROW = re.compile(rb"(?m)^(\d\d:\d\d:\d\d\.\d+) -> ")
_WORD = rb"[A-Za-z_][\w.\[\]]{0,40}"
_LABEL = re.compile(rb"(?<![\w.])(" + _WORD + rb"(?: " + _WORD + rb"){0,4})[ \t]{0,3}[:=][ \t]{0,3}(?=[-+]?\.?\d|nan)")
_SEPARATOR = re.compile(rb"[,;\t]")


def as_table(content: bytes) -> bytes:
    r"""Return the text of a serial monitor as a table with a row of names; any other text as it is.

    The line in the middle tells: whether a stamp and an arrow stand before the values, and whether a label before each.
    Labels are only taken off where all lines have the same; the first may be another one, as where it was cut.

    Examples
    --------
    >>> as_table(b"r:1,y:0.5\nr:1,y:0.7\n")
    b'r,y\n1,0.5\n1,0.7\n'
    >>> as_table(b"12:00:00.001 -> 1 0.5\n12:00:00.003 -> 1 0.7\n")
    b'12:00:00.001 1 0.5\n12:00:00.003 1 0.7\n'
    """
    line = _middle(content)
    if arrow := _ARROW.match(line):
        found = _SEPARATOR.search(line, arrow.end())
        separator = found[0] if found else b" "
        content, line = (_ARROW.sub(rb"\1" + separator, part) for part in (content, line))
        line = line.partition(separator)[2]
    labels = _LABEL.findall(line)
    if len(labels) < 2 or not _LABEL.match(line.lstrip()):
        return content
    first, _, rest = content.lstrip().partition(b"\n")
    body = content if _LABEL.findall(first) == labels else rest
    if _LABEL.findall(body) != labels * sum(bool(line.strip()) for line in body.split(b"\n")):
        return content
    found = _SEPARATOR.search(line)
    names = [*([b"time"] if arrow else []), *labels]
    return (found[0] if found else b" ").join(names) + b"\n" + _LABEL.sub(b"", body)


def _middle(content: bytes) -> bytes:
    """Return a line in the middle of a text."""
    start = content.rfind(b"\n", 0, len(content) // 2) + 1
    end = content.find(b"\n", start)
    return content[start:] if end < 0 else content[start:end]
