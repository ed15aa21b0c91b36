"""Cells of text as numbers: decimal points and commas, time stamps, and what is neither."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.reading.table import Fault

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = [
    "REWRITE", "decimal_sign", "fault_in", "fault_of", "grouped_or_decimal", "is_stamp", "kind_of", "number", "numbers",
    "stamps", "values_of",
]  # fmt: skip

SEARCHED = 250_000
"""Bytes at the beginning and at the end of a long text that are searched for separated thousands: thousands of rows."""
REWRITE = "write all numbers with one decimal sign and without separators of thousands"
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_STAMP = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4})?[T ]?"
    r"(?P<clock>\d{1,2}:\d\d:\d\d(?:[.,:]\d{1,9})?)\s?(?:Z|UTC|[+-]\d\d:?\d\d)?"
)
_SWITCHES = {"true": 1.0, "on": 1.0, "false": 0.0, "off": 0.0}
_DECIMAL_COMMA = re.compile(rb"\d,\d")
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

    The decimal sign is a comma where digits stand around commas and nowhere around points. Of a long text beginning and
    end are searched for separated thousands.

    Examples
    --------
    >>> decimal_sign(b"0,5;1,5", ";"), decimal_sign(b"999,5;1.000,5", ";"), decimal_sign(b"0.5,1.5", ",")
    (',', ',.', '.')
    """
    proofs = _BOTH_IN_QUOTES if separator == "," else _BOTH
    searched = content if len(content) <= 2 * SEARCHED else content[:SEARCHED] + b"\n" + content[-SEARCHED:]
    may_be = b"," in searched and b"." in searched and (separator != "," or b'"' in searched)
    proven = [signs for signs, form in proofs.items() if may_be and form.search(searched)]
    if len(proven) == 1:
        return proven[0]
    if separator == "," or not _DECIMAL_COMMA.search(content):
        return "."
    return "." if b"." in content and _DECIMAL_POINT.search(content) else ","


def grouped_or_decimal(body: bytes, separator: str, decimal: str) -> str:
    r"""Return a number of which nobody can tell whether its decimal sign separates thousands, empty without such.

    So it is where whole numbers of up to three digits stand beside numbers with just three digits behind the sign, and
    none has a leading zero, another count of digits or an exponent.

    Examples
    --------
    >>> grouped_or_decimal(b"0;998\n1;1.002", ";", "."), grouped_or_decimal(b"0;0.998\n1;1.002", ";", ".")
    ('1.002', '')
    """
    sign, between = re.escape(decimal).encode(), re.escape(separator).encode()
    plain = rb"\b0\d*S\d|(?<!\d)S\d|\dS(?!\d{3}(?!\d))|(?<![\dS])\d{4}|\d[eE]".replace(b"S", sign)
    if decimal.encode() not in body or re.search(plain, body):
        return ""
    grouped = re.search(rb"(?<![\dS])[1-9]\d{0,2}(?:S\d{3})+(?![\dS])".replace(b"S", sign), body)
    whole = re.search(rb"(?:^|[\nB])[+-]?\d{1,3}(?=[\nB]|$)".replace(b"B", between), body)
    return grouped[0].decode() if grouped and whole else ""


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


def is_stamp(text: str) -> bool:
    """Tell whether a cell is a date with a clock, or a clock: ``2024-05-01T12:00:00.001Z``, ``12:00:00,001``."""
    return ":" in text and _STAMP.fullmatch(text.strip()) is not None


def kind_of(cell: str) -> str:
    """Return what a column holds by its first cell that is not blank: a stamp, a switch or a number.

    Examples
    --------
    >>> kind_of("12:00:00"), kind_of("True"), kind_of("off"), kind_of("0.1"), kind_of("")
    ('stamp', 'switch', 'switch', 'number', '')
    """
    if not cell.strip():
        return ""
    return "stamp" if is_stamp(cell) else "switch" if cell.strip().lower() in _SWITCHES else "number"


def values_of(cells: Sequence[str], kind: str, decimal: str = ".") -> NDArray[Any]:
    """Return a column's instants, its numbers, or 1 for on and 0 for off; nan or NaT for what is none."""
    if kind == "stamp":
        return stamps(cells)
    if kind == "switch":
        return np.array([_SWITCHES.get(cell.strip().lower(), math.nan) for cell in cells])
    return numbers(cells, decimal)


def fault_in(cell: str, where: str, kind: str, decimal: str = ".") -> Fault:
    """Return what is wrong with a cell of a column of some kind, and what to do."""
    what = fault_of(cell, decimal) or ""
    if kind != "number" and cell.strip():
        return Fault(where, f"{quote(cell.strip())} is {'no time stamp' if kind == 'stamp' else 'neither on nor off'}")
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


def stamps(cells: Sequence[str]) -> NDArray[np.datetime64]:
    """Return time stamps, on 1970-01-01 where they have no date, NaT for what is none.

    Raises
    ------
    InputError
        If a stamp's date or clock does not exist.
    """
    try:
        return np.array([_iso(cell) for cell in cells], dtype="datetime64[ns]")
    except ValueError as error:
        raise InputError("a time stamp has a date or a clock that does not exist") from error


def _iso(text: str) -> str:
    """Return a stamp as NumPy reads it, ``NaT`` where it is none."""
    match = _STAMP.fullmatch(text.strip())
    if match is None:
        return "NaT"
    date = (match["date"] or "1970-01-01").replace("/", "-")
    if "." in date:
        day, month, year = date.split(".")
        date = f"{year}-{month:0>2}-{day:0>2}"
    hours, minutes, rest = match["clock"].replace(",", ".").split(":", 2)
    return f"{date}T{hours:0>2}:{minutes}:{rest.replace(':', '.')}"
