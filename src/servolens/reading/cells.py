"""Cells of text as numbers: decimal points and commas, time stamps, and what is neither."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["fault_of", "is_stamp", "number", "numbers", "stamps"]

_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
_STAMP = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4})?[T ]?"
    r"(?P<clock>\d{1,2}:\d\d:\d\d(?:[.,:]\d{1,9})?)\s?(?:Z|UTC|[+-]\d\d:?\d\d)?"
)


def number(text: str, decimal: str = ".") -> float | None:
    """Return the number that a cell holds, nan and inf included, or None.

    Examples
    --------
    >>> number(" 1.5e3 "), number("0,5", ","), number("0,5"), number("1_0"), number("on")
    (1500.0, 0.5, None, None, None)
    """
    text = text.strip()
    if decimal == "," and _COMMA.fullmatch(text):
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
    if number(text, ",") is not None:
        return f"{quote(text.strip())} has a decimal comma where other numbers have points"
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
