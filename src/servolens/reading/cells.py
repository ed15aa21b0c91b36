"""Cells of text as numbers: decimal points and commas, time stamps, and what is neither."""

from __future__ import annotations

import csv
import math
import re
from typing import TYPE_CHECKING

import numpy as np

from servolens.reading.files import quote
from servolens.reading.stamps import is_stamp
from servolens.reading.table import Fault
from servolens.units import ordinary_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

__all__ = [
    "REWRITE", "amount", "decimal_sign", "fault_in", "fault_of", "fields_of", "grouped_or_decimal", "is_switch",
    "is_value", "kind_of", "number", "numbers", "switched",
]  # fmt: skip

SEARCHED = 250_000
"""Bytes at the beginning and at the end of a long text that are searched for separated thousands: thousands of rows."""
MOST_LINES = 200
"""Lines with separated thousands that are looked at for being rows of numbers: preambles are shorter."""
REWRITE = "write all numbers with one decimal sign and without separators of thousands"
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_AMOUNT = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\s\d.,+-].*)")
_SWITCHES = {"true": 1.0, "on": 1.0, "false": 0.0, "off": 0.0}
_DECIMAL_COMMA = re.compile(rb"\d,\d")
_COMMA_IN_QUOTES = re.compile(rb'"[+-]?\d+,\d+"')
_DECIMAL_POINT = re.compile(rb"(?<![\d:.])-?\d*\.\d+(?![\d.:])")
_GROUPED = {
    ",.": re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d*)?"),
    ".,": re.compile(r"[+-]?\d{1,3}(,\d{3})+(\.\d*)?"),
}
"""Numbers with separated thousands, by the decimal sign and the separator."""
_BOTH = {
    ",.": re.compile(rb"(?<![\d.,])\d{1,3}(?:\.\d{3})+,\d"),
    ".,": re.compile(rb"(?<![\d.,])\d{1,3}(?:,\d{3})+\.\d"),
}
_BOTH_IN_QUOTES = {
    ",.": re.compile(rb'"[+-]?\d{1,3}(?:\.\d{3})+,\d+"'),
    ".,": re.compile(rb'"[+-]?\d{1,3}(?:,\d{3})+\.\d+"'),
}


def decimal_sign(content: bytes, separator: str) -> str:
    """Return the decimal sign of a text, and behind it the separator of thousands where a number has both.

    The decimal sign is a comma where digits stand around commas and in no row of numbers around points. Separated
    thousands are searched for in rows of numbers too, of a long text at its beginning and its end.

    Examples
    --------
    >>> decimal_sign(b"0,5;1,5", ";"), decimal_sign(b"999,5;1.000,5", ";"), decimal_sign(b"0.5,1.5", ",")
    (',', ',.', '.')
    """
    proofs = _BOTH_IN_QUOTES if separator == "," else _BOTH
    searched = _ends(content)
    may_be_quoted = b'"' in searched
    may_be = b"," in searched and b"." in searched and (separator != "," or may_be_quoted)
    proven = [signs for signs, form in proofs.items() if may_be and _stands_in_row(form, searched, separator, signs)]
    if len(proven) == 1:
        return proven[0]
    if separator == ",":
        quoted = may_be_quoted and _stands_in_row(_COMMA_IN_QUOTES, searched, separator, ",")
        return "," if quoted and not _stands_in_row(_DECIMAL_POINT, searched, separator, ",") else "."
    if b"," not in content or not _DECIMAL_COMMA.search(content):
        return "."
    return "." if b"." in searched and _stands_in_row(_DECIMAL_POINT, searched, separator, ",") else ","


def _ends(content: bytes) -> bytes:
    """Return beginning and end of a long text, in whole lines, else all of it."""
    if len(content) <= 2 * SEARCHED:
        return content
    return content[:SEARCHED].rpartition(b"\n")[0] + b"\n" + content[-SEARCHED:].partition(b"\n")[2]


def fields_of(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    if separator == " ":
        return re.sub(r"(?<!\s)\s+(?=[\[(])", "", line.strip()).split()
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator))
    except (csv.Error, StopIteration):
        return line.split(separator)


def _stands_in_row(form: re.Pattern[bytes], text: bytes, separator: str, signs: str) -> bool:
    """Tell whether a form stands in a row of numbers: those are more than one, and most of its cells."""
    end = tried = 0
    while tried < MOST_LINES and (match := form.search(text, end)):
        tried += 1
        start, end = text.rfind(b"\n", 0, match.start()) + 1, text.find(b"\n", match.end())
        end = len(text) if end < 0 else end
        cells = [cell for cell in fields_of(text[start:end].decode(errors="replace"), separator) if cell.strip()]
        good = sum(is_value(cell, signs) for cell in cells)
        if good > 1 and 2 * good > len(cells):
            return True
    return False


def grouped_or_decimal(body: bytes, separator: str, decimal: str) -> str:
    r"""Return a number of which nobody can tell whether its decimal sign separates thousands, empty without such.

    So it is where one column holds whole numbers of up to three digits, numbers with just three digits behind the sign
    and no leading zero, and nothing else. Of a long text beginning and end are looked at.

    Examples
    --------
    >>> grouped_or_decimal(b"0;998\n1;1.002", ";", "."), grouped_or_decimal(b"0;0.998\n1;1.002", ";", ".")
    ('1.002', '')
    """
    if decimal.encode() not in body:
        return ""
    form = re.compile(r"[+-]?(?:\d{1,3}|([1-9]\d{0,2}(?:S\d{3})+))".replace("S", re.escape(decimal)))
    rows = [fields_of(line, separator) for line in _ends(body).decode().split("\n")]
    for cells in zip(*(row for row in rows if len(row) == len(rows[0])), strict=True):
        given = (cell.strip('" \t') for cell in cells)
        found = _all_matches(form, (cell for cell in given if cell))
        grouped = next((match[1] for match in found if match[1]), "")
        if grouped and any(match[1] is None for match in found):
            return grouped
    return ""


def _all_matches(form: re.Pattern[str], cells: Iterable[str]) -> list[re.Match[str]]:
    """Return the matches of a form, none where some cell does not match it."""
    found: list[re.Match[str]] = []
    for cell in cells:
        match = form.fullmatch(cell)
        if match is None:
            return []
        found.append(match)
    return found


def number(text: str, decimal: str = ".") -> float | None:
    """Return the number that a cell holds, nan and inf included, or None.

    Parameters
    ----------
    text : str
        The cell.
    decimal : {".", ",", ",.", ".,"}
        The decimal sign, and behind it the separator of thousands where there is one.

    Examples
    --------
    >>> number(" 1.5e3 "), number("0,5", ","), number("0,5"), number("1_0"), number("on"), number("1.000,5", ",.")
    (1500.0, 0.5, None, None, None, 1000.5)
    """
    text = text.strip()
    if decimal in _GROUPED and decimal[1] in text:
        if not _GROUPED[decimal].fullmatch(text):
            return None
        text = text.replace(decimal[1], "")
    if decimal.startswith(",") and _COMMA.fullmatch(text):
        text = text.replace(",", ".")
    if "_" in text or not text.isascii():
        return None
    try:
        return float(text)
    except ValueError:
        return None


def amount(text: str, decimal: str = ".") -> tuple[float, str] | None:
    """Return number and unit of a cell that holds both, or None.

    Examples
    --------
    >>> amount("12.3 mm"), amount("0,5V", ","), amount("3 of"), amount("0.5")
    ((12.3, 'mm'), (0.5, 'V'), None, None)
    """
    match = _AMOUNT.fullmatch(text.strip())
    value = None if match is None else number(match[1], decimal)
    return None if match is None or value is None or ordinary_unit(match[2]) is None else (value, match[2])


def is_value(cell: str, decimal: str = ".") -> bool:
    """Tell whether a cell is a number, with its unit or without, or a time stamp."""
    return number(cell, decimal) is not None or is_stamp(cell) or amount(cell, decimal) is not None


def kind_of(cell: str, decimal: str = ".") -> str:
    """Return what a column holds by its first cell that is not blank: a stamp, a switch, an amount or a number.

    Examples
    --------
    >>> kind_of("12:00:00"), kind_of("True"), kind_of("off"), kind_of("3 mm"), kind_of("0.1"), kind_of("")
    ('stamp', 'switch', 'switch', 'amount', 'number', '')
    """
    if not cell.strip():
        return ""
    if is_stamp(cell):
        return "stamp"
    return "switch" if is_switch(cell) else "amount" if amount(cell, decimal) else "number"


def is_switch(cell: str) -> bool:
    """Tell whether a cell says on or off in a word."""
    return cell.strip().lower() in _SWITCHES


def switched(cell: str) -> float:
    """Return 1 for on and 0 for off."""
    return _SWITCHES[cell.strip().lower()]


def fault_in(cell: str, where: str, kind: str, decimal: str = ".") -> Fault:
    """Return what is wrong with a cell of a column of some kind, and what to do."""
    what = fault_of(cell, decimal) or ""
    if kind == "stamp" and cell.strip():
        return Fault(where, f"{quote(cell.strip())} is no time stamp")
    if kind == "switch" and cell.strip() and not is_switch(cell):
        return Fault(where, f"{quote(cell.strip())} is neither on nor off")
    if kind == "amount" and cell.strip():
        return Fault(where, f"{quote(cell.strip())} is no number in a unit as the cells above it")
    is_comma = decimal == "." and number(cell) is None and number(cell, ",") is not None
    return Fault(where, what, REWRITE) if is_comma else Fault(where, what)


def numbers(cells: Sequence[str], decimal: str = ".") -> NDArray[np.float64]:
    """Return the numbers of cells, nan where there is none."""
    if decimal == ".":
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            pass
        else:
            text = "".join(cells)
            if "_" not in text and text.isascii():
                return values
    return np.array([math.nan if (value := number(cell, decimal)) is None else value for cell in cells])


def fault_of(text: str, decimal: str = ".") -> str | None:
    """Return what is wrong with a cell that should hold a finite number, as the end of a sentence."""
    value = number(text, decimal)
    if value is not None and math.isfinite(value):
        return None
    if not text.strip():
        return "the value is missing"
    if value is not None:
        return f"{quote(text.strip())} is not a finite number"
    if decimal == "." and number(text, ",") is not None:
        return f"{quote(text.strip())} has a comma where other numbers have points"
    return f"{quote(text.strip())} is not a number"
