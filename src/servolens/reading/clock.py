"""The clock of a log that states its sample time instead of logging it, and time stamps that fall back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.reading.files import quote
from servolens.reading.guess import Guess
from servolens.reading.scales import DAY
from servolens.reading.table import Column, Table
from servolens.reading.words import unit_behind
from servolens.units import parse_unit, split_number

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.float64]

__all__ = ["unwrapped", "with_clock"]

_INTERVALS = {
    **dict.fromkeys(("sample interval", "sampling interval", "hresolution", "increment"), "s"),
    **dict.fromkeys(("delta_x", "sample_time", "sample time", "sampletime", "sampling time", "dt", "abtastzeit"), "s"),
    "sampletime[ms]": "ms",
}
"""What preambles call the sample time, and its unit where none stands there."""
_STARTS = {"delta_x": "x0", "increment": "start"}
"""What they call the first instant beside it."""
_LABVIEW = ("delta_x", "x_value")
"""What LabVIEW calls the step and the column of its times, both in seconds."""
_PARTS = {
    **dict.fromkeys(("nanoseconds", "nanosecs", "nanosec", "nsecs", "nsec"), 1e-9),
    **dict.fromkeys(("microseconds", "microsecs", "microsec", "usecs", "usec"), 1e-6),
}
"""Ends of the names of columns that hold what is left of a second, longest first."""
_SECONDS = ("seconds", "secs", "sec")
"""Ends of the names of those with the whole seconds."""
COUNTERS = (2.0**32, 2.0**16)
"""Ticks after which a microcontroller's counter begins again."""
LONGEST_STEP = 2.0
"""Longest step over a wrap, in sample times: one sample may be lost there."""


def with_clock(table: Table, settings: Mapping[str, object] | None) -> Table:
    """Add the time to a table that states its sample time instead of logging it, or logs it in two parts.

    LabVIEW's logged time goes before its stated step where they differ by a sample or more: it states 1 s where a
    program writes sample by sample.

    Parameters
    ----------
    table : Table
        Of the file.
    settings : mapping, optional
        From the caller; their ``sample_time`` wins.
    """
    table = _whole_stamps(table)
    found = _interval(table, settings)
    if found is None or not table.columns:
        return table
    interval, origin = found
    start = _number(table.properties.get(_STARTS.get(origin.source, "")))
    instants = start + interval * np.arange(table.columns[0].values.size, dtype=np.float64)
    time = Column("time", instants, "s", origin=origin)
    # a number names the column of the file: the clock takes the place of that which is there, or comes last
    names = [unit_behind(column.name)[0].strip().lower() for column in table.columns]
    logged = [name in ("time", "t", "x_value") for name in names]
    own = [column for column, name in zip(table.columns, names, strict=True) if name == _LABVIEW[1]]
    if origin.source == _LABVIEW[0] and _is_clock_of_its_own(own, instants):
        return _with_own_clock(table, own, origin)
    columns = tuple(time if is_time else column for column, is_time in zip(table.columns, logged, strict=True))
    if sum(logged) != 1:
        columns = (*(column for column, is_time in zip(table.columns, logged, strict=True) if not is_time), time)
    return replace(table, columns=columns)


def _is_clock_of_its_own(logged: Sequence[Column], instants: Values) -> bool:
    """Tell whether logged times [s] increase, count no samples, and are others than those that are stated.

    Times that repeat are times all the same: what reads them refuses them, rather than take a wrong step.
    """
    if not logged or any(not np.array_equal(column.values, logged[0].values, equal_nan=True) for column in logged):
        return False
    known = np.isfinite(logged[0].values)
    values, stated = logged[0].values[known], instants[known]
    steps = np.diff(values)
    if not steps.size or np.any(steps < 0) or values[-1] == values[0]:
        return False
    is_counter = bool(np.all(steps == steps[0]) and steps[0] == np.rint(steps[0]))
    off = float(np.max(np.abs((values - values[0]) - (stated - stated[0]))))
    return not is_counter and off >= instants[1] - instants[0]


def _with_own_clock(table: Table, logged: Sequence[Column], origin: Guess) -> Table:
    """Return a table with its logged time alone, and that what it states was not taken."""
    message = (
        f"the times in the column {quote(logged[0].name)} are not those of the stated {quote(origin.source)},"
        f" {origin.value}; the column was taken."
    )
    columns = tuple(
        replace(column, name="time", unit="s") if column is logged[0] else column
        for column in table.columns
        if column is logged[0] or all(column is not other for other in logged)
    )
    remark = Finding(code="sample_time_not_taken", severity="note", message=message)
    return replace(table, columns=columns, remarks=(*table.remarks, remark))


def _whole_stamps(table: Table) -> Table:
    """Put a time together whose whole seconds and the rest stand in two columns, as ROS and C's clocks have it.

    They are counted from the first whole second, so that no digit of the nanoseconds is lost.
    """
    columns = list(table.columns)
    for name, (column, scale) in _fractions(table).items():
        seconds = next((c for c in columns if c.name.lower() in (f"{name}{word}" for word in _SECONDS)), None)
        if seconds is None or not (seconds.is_integer and column.is_integer):
            continue
        if seconds.values.size != column.values.size or np.any((column.values < 0) | (column.values * scale >= 1)):
            continue
        instants = seconds.values - seconds.values[0] + column.values * scale
        whole = replace(seconds, name=f"{name}time" if name else "time", values=instants, unit="s")
        columns = [whole if c is seconds else c for c in columns if c is not column]
    return replace(table, columns=tuple(columns))


def _fractions(table: Table) -> dict[str, tuple[Column, float]]:
    """Return the columns that hold parts of a second, and which, by what their names begin with."""
    found: dict[str, tuple[Column, float]] = {}
    for column in table.columns:
        lower = column.name.lower()
        for word, scale in _PARTS.items():
            if lower.endswith(word) and column.fault is None:
                found.setdefault(lower.removesuffix(word), (column, scale))
                break
    return found


def _interval(table: Table, settings: Mapping[str, object] | None) -> tuple[float, Guess] | None:
    """Return the sample time [s] that is stated, and by whom, or None."""
    text, label, source, evidence = (settings or {}).get("sample_time"), "s", "stated", "by you"
    if text is None:
        text, evidence = table.comments.get("sample_time"), "by the file"
    if text is None:
        known = [key for key in _INTERVALS if key in table.properties]
        if not known or any("time" in column.name.lower() for column in table.columns):
            return None
        source, label, evidence = (
            known[0],
            _INTERVALS[known[0]],
            "the sample time that the file states above its numbers",
        )
        text = table.properties[source].replace(",", ".")
    try:
        value, unit = split_number(str(text))
    except InputError:
        return None
    parsed = parse_unit(unit or label)
    if parsed is None or dict(parsed.dimension) != {"s": 1.0} or not value > 0:
        return None
    shown = f"{value:g} {unit or label}"
    return value * parsed.factor, Guess(quantity="time", source=source, value=shown, evidence=evidence, is_stated=True)


def _number(text: str | None) -> float:
    try:
        return split_number((text or "0").replace(",", "."))[0]
    except InputError:
        return 0.0


def unwrapped(time: Values, factor: float) -> tuple[Values, str]:
    """Return time stamps that go on where a counter began again, or the clock at midnight, and what was done.

    Stamps that fall back by anything else are returned as they are, with an empty text.

    Parameters
    ----------
    time : ndarray, shape (n,)
        As logged.
    factor : float
        Seconds of one unit.

    Examples
    --------
    >>> unwrapped(np.array([65534.0, 65535.0, 0.0, 1.0]), 1e-3)[0]
    array([65534., 65535., 65536., 65537.])
    """
    if time.dtype.kind not in "iuf" or not np.isfinite(time).all():
        return time, ""
    steps = np.diff(time.astype(np.float64))
    back, forth = np.flatnonzero(steps < 0), steps[steps > 0]
    if not 0 < back.size < forth.size:
        return time, ""
    longest = LONGEST_STEP * float(np.median(forth))
    for period in (*COUNTERS, DAY / factor):
        jumps = steps[back] + period
        if np.all((jumps > 0) & (jumps <= longest)):
            turns = np.zeros(time.size)
            turns[back + 1] = 1
            what = "as a clock does at midnight" if period not in COUNTERS else "as a counter that begins again"
            where = f"sample {back[0] + 1}" + (f" and {back.size - 1} times later" if back.size > 1 else "")
            said = f"the time stamps fall back by {period:.0f} at {where}, {what}; they were counted on."
            return time + period * np.cumsum(turns), said
    return time, ""
