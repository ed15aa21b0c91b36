"""Numbers as keyboards write them: with their own minus, and nothing between their thousands."""

from __future__ import annotations

import re
from itertools import pairwise

__all__ = ["plain_numbers"]

_MINUS = re.compile("\N{MINUS SIGN}(?=[\\d.,])".encode())
_NUMBERS = re.compile(rb"[-+.\deE]+")
_APOSTROPHES = ("'", "\N{RIGHT SINGLE QUOTATION MARK}")
_SPACES = ("\N{NO-BREAK SPACE}", "\N{NARROW NO-BREAK SPACE}", "\N{THIN SPACE}")


def plain_numbers(content: bytes) -> bytes:
    r"""Write a typographic minus as that of keyboards, and thousands without what stands between them.

    That is an apostrophe or a space that does not break, behind the one to three digits that begin a number and before
    just three; never where the same sign stands between cells.

    Examples
    --------
    >>> plain_numbers(b"1'234.5;12'345"), plain_numbers("0.5\N{NO-BREAK SPACE}100".encode()).decode()
    (b'1234.5;12345', '0.5\xa0100')
    """
    if not content.isascii():
        content = _MINUS.sub(b"-", content)
    for signs, behind in ((_APOSTROPHES, rb"[\d.]"), (_SPACES, rb"[\d.,]")):
        for sign in (one.encode() for one in signs):
            if sign in content:
                content = _joined(content, sign, behind)
    return content


def _joined(content: bytes, sign: bytes, behind: bytes) -> bytes:
    """Return the text without a sign in numbers; as it is where the sign also stands where it cannot be in one.

    A comma before a space that does not break is a decimal one, before an apostrophe it may separate columns.
    """
    grouped = re.compile(rb"(?<!%s)(?<!%s)[1-9]\d{0,2}(?:%s\d{3})+(?!%s?\d)" % (behind, sign, sign, sign))
    plain = grouped.sub(lambda match: match[0].replace(sign, b""), content)
    between = re.search(rb"[\d.,]%s[-+.\d]" % sign, plain)
    return content if between or _heads_cells(content, sign) else plain


def _heads_cells(content: bytes, sign: bytes) -> bool:
    """Tell whether a row of names with this sign alone has as many cells as the row of numbers below it."""
    lines = [line for line in content.split(b"\n") if sign in line and not re.search(rb"[;,\t|]", line)]
    return any(
        re.search(rb"[A-Za-z]", head)
        and head.count(sign) == row.count(sign)
        and _NUMBERS.fullmatch(row.replace(sign, b""))
        for head, row in pairwise(lines)
    )
