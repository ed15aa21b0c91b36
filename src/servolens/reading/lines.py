"""Text as lines of UTF-8, whatever the encoding, the line ends and the breaks within headings were."""

from __future__ import annotations

from servolens.errors import InputError
from servolens.reading.cells import fields_of, is_value
from servolens.reading.plain_numbers import plain_numbers

__all__ = ["encoding_of", "unbroken", "unified"]

MARKS = (
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
"""What files of other encodings begin with; the longer mark first, as one begins with the other."""
LOOKED_AT = 400
"""Bytes that tell an encoding without a mark: of ASCII letters in two bytes each, every other byte is zero."""
_SEPARATORS = (",", ";", "\t", "|")


def encoding_of(content: bytes) -> str | None:
    """Return the encoding of a text in UTF-16 or UTF-32, with its mark or, of UTF-16, without; None of another one.

    Examples
    --------
    >>> encoding_of("time".encode("utf-16")), encoding_of("time".encode("utf-16-be")), encoding_of(b"time")
    ('utf-16', 'utf-16-be', None)
    """
    for mark, encoding in MARKS:
        if content.startswith(mark):
            return encoding
    even, odd = content[:LOOKED_AT:2], content[1:LOOKED_AT:2]
    if len(odd) > 1 and not any(odd) and all(even):
        return "utf-16-le"
    return "utf-16-be" if len(odd) > 1 and not any(even) and all(odd) else None


def unified(content: bytes) -> bytes:
    """Return UTF-8 with line feeds, whatever the encoding and the line ends were.

    Raises
    ------
    InputError
        If it is text in none of these encodings.
    """
    if encoding := encoding_of(content):
        content = _recoded(content, encoding)
    content = content.removeprefix(b"\xef\xbb\xbf")
    if not content.isascii():
        try:
            content.decode()
        except UnicodeDecodeError:
            content = _recoded(content, "cp1252")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return plain_numbers(content)


def _recoded(content: bytes, encoding: str) -> bytes:
    try:
        return content.decode(encoding).encode()
    except UnicodeError as error:
        raise InputError("is not text in UTF-8, UTF-16, UTF-32 or Latin-1; save it as UTF-8 CSV") from error


def unbroken(content: bytes, head: int) -> tuple[bytes, int]:
    r"""Return a text without line breaks within quotation marks above its numbers, and how many there were.

    So spreadsheets write headings of several lines. A mark in a row of numbers is no such one: ``"`` there says ditto.

    Parameters
    ----------
    content : bytes
        With line feeds.
    head : int
        How many lines are looked at.

    Examples
    --------
    >>> unbroken(b'"time\n[s]",pos\n0,1\n', 400)
    (b'"time [s]",pos\n0,1\n', 1)
    """
    lines = content.split(b"\n", head)
    lines, rest = lines[:head], lines[head:]
    if not any(map(_is_open, lines)):
        return content, 0
    numbers = [_numbers(line) for line in lines]
    end = next((k for k, (_, is_row) in enumerate(numbers) if is_row), len(lines))
    whole: list[bytes] = []
    at = 0
    while at < len(lines):
        last = at
        if at < end and _is_open(lines[at]) and not numbers[at][0]:
            last = next((k for k in range(at + 1, end) if lines[k].count(b'"') % 2), at)
        whole.append(b" ".join(lines[at : last + 1]))
        at = last + 1
    return b"\n".join([*whole, *rest]), len(lines) - len(whole)


def _is_open(line: bytes) -> bool:
    """Tell whether a cell in quotation marks goes on in the next line; a mark behind a number is one of inches."""
    before = line[: line.rfind(b'"')].rstrip(b" ").decode(errors="replace")
    return line.count(b'"') % 2 == 1 and before[-1:] in ("", *_SEPARATORS)


def _numbers(line: bytes) -> tuple[bool, bool]:
    """Tell of a line whether it has cells that are numbers, and whether it is a row of numbers: most of its cells."""
    text, has, is_row = line.decode(errors="replace"), False, False
    for separator in (*_SEPARATORS, " "):
        cells = [cell.strip() for cell in fields_of(text, separator) if cell.strip()]
        good = sum(is_value(cell, ".") or is_value(cell, ",") for cell in cells)
        has = has or (good > 0 and separator != " ")
        is_row = is_row or (good > 1 and 2 * good > len(cells))
    return has, is_row
