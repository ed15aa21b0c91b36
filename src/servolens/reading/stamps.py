"""Time stamps: dates with a clock, or a clock alone, in the orders in which programs write them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

__all__ = ["is_stamp", "stamps"]

_STAMP = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4}|\d{1,2}/\d{1,2}/\d{4}"
    r"|\d{1,2}[- ][A-Za-zä]{3}[- ]\d{4})?,?[T ]?"
    r"(?P<clock>\d{1,2}:\d\d:\d\d(?:[.,:]\d{1,9})?|\d{1,2}:\d\d[.,]\d{1,9})\s?(?P<half>[AaPp]\.?[Mm]\.?)?(?:Z|UTC|[+-]\d\d:?\d\d)?"
)
_SLASHED = re.compile(r"(\d{1,2})/(\d{1,2})/\d{4}\b")
_MONTHS = {
    "jan": 1, "jän": 1, "feb": 2, "mar": 3, "mär": 3, "mrz": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6, "jul": 7,
    "aug": 8, "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12,
}  # fmt: skip
"""Months by their three letters, English and German."""
_NOON = 12


def is_stamp(text: str) -> bool:
    """Tell whether a cell is a date with a clock, or a clock: ``2024-05-01T12:00:00.1Z``, ``12:00:00``, ``59:01.5``."""
    return ":" in text and _STAMP.fullmatch(text.strip()) is not None


def stamps(cells: Sequence[str]) -> NDArray[np.datetime64]:
    """Return time stamps, on 1970-01-01 where they have no date, NaT for what is none.

    Raises
    ------
    InputError
        If a stamp's date or clock does not exist, or its date can be read in two ways.

    Examples
    --------
    >>> stamps(["11/28/2026 12:00:00.5 AM", "28-Nov-2026 00:00:00.5"]).astype(str).tolist()
    ['2026-11-28T00:00:00.500000000', '2026-11-28T00:00:00.500000000']
    """
    day_first = _begins_with_day({m.groups() for cell in cells if "/" in cell and (m := _SLASHED.match(cell.strip()))})
    try:
        return np.array([_iso(cell, day_first=day_first) for cell in cells], dtype="datetime64[ns]")
    except ValueError as error:
        raise InputError("a time stamp has a date or a clock that does not exist") from error


def _begins_with_day(dates: Iterable[Sequence[str]]) -> bool:
    """Tell the order of ``28/11/2026`` and ``11/28/2026``; of a single date that may be both, either will do."""
    known = [(int(first), int(second)) for first, second in dates]
    is_day_first = any(first > _NOON for first, _ in known)
    if len(known) > 1 and not is_day_first and all(second <= _NOON for _, second in known):
        raise InputError("the time stamps' dates may begin with the day or the month; write them as 2026-11-28")
    return is_day_first


def _iso(text: str, *, day_first: bool) -> str:
    """Return a stamp as NumPy reads it, ``NaT`` where it is none."""
    match = _STAMP.fullmatch(text.strip())
    if match is None:
        return "NaT"
    clock = match["clock"].replace(",", ".")
    hours, minutes, rest = (f"0:{clock}" if clock.count(":") == 1 else clock).split(":", 2)
    if match["half"]:
        if not 1 <= int(hours) <= _NOON:
            raise ValueError(text)
        hours = str(int(hours) % _NOON + _NOON * (match["half"][0] in "Pp"))
    return f"{_date(match['date'], day_first=day_first)}T{hours:0>2}:{minutes:0>2}:{rest.replace(':', '.')}"


def _date(text: str | None, *, day_first: bool) -> str:
    if text is None:
        return "1970-01-01"
    first, second, last = re.split(r"[-/. ]", text)
    if len(first) > len("31"):
        return f"{first}-{second}-{last}"
    if second.isalpha():
        second = str(_MONTHS.get(second.lower(), ""))
    elif "/" in text and not day_first:
        first, second = second, first
    return f"{last}-{second:0>2}-{first:0>2}"
