"""A log's clock: its cycle, and where samples are lost."""

from __future__ import annotations

from functools import lru_cache
from math import log
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "CHANGED",
    "COMMON",
    "JITTERS",
    "MEDIAN",
    "Clock",
    "clock_of",
    "cycle_of",
    "cycles_passed",
    "fitted_cycle",
    "rounded_ticks",
]

CHANGED, LONG = 0.25, 1.5
"""Share by which a cycle changes; cycles from which on a sample may be missing."""
JITTERS = 0.01
"""Share of the cycle by which more than half of the intervals differ from those beside them where a clock jitters."""
COMMON, SLIPPED = 0.1, 2.0
"""Share of the intervals from which on both lengths of rounded stamps are common; steps over which the stamps of a few
samples must drift besides: of a single interval that is too long a line makes one and a half."""
WHOLE = 1e-3
"""Share of a resolution by which a multiple of it is off in floating-point numbers of seconds, as epochs are."""
MEDIAN, SMOOTH = 7, 31
"""Intervals of a running median: three lost samples in a row do not move the short one, and jitter hardly the long."""
HAMPEL = 3.0
"""Robust standard deviations beyond which a running median differs from the usual value (Hampel's filter)."""
SIDE = 6
"""Stamps before and after an interval that tell whether the clock is late from there on."""
WANDERS = -0.25
"""Correlation of neighbouring intervals above which a clock wanders: midway between 0, of intervals that vary by
themselves, and -1/2, of stamps that do."""
COMPARED = 10_000
"""Intervals, about, among which it is looked how far stamps shift where nothing is lost."""


class Clock(NamedTuple):
    """What the time stamps of a log tell.

    Attributes
    ----------
    cycles : ndarray, shape (n - 1,)
        The log's cycle at each interval [s].
    lost : ndarray of bool, shape (n - 1,)
        Intervals in which samples are lost.
    passed : ndarray, shape (n - 1,)
        Cycles of the most usual length that have passed in each interval, at least 1.
    """

    cycles: NDArray[np.float64]
    lost: NDArray[np.bool_]
    passed: NDArray[np.float64]


def clock_of(time: NDArray[np.float64]) -> Clock:
    """Return the clock of time stamps [s], shape (n,), rising, n ≥ 2.

    Samples are lost in an interval of more than one and a half cycles at that time. Not so where the clock jitters: a
    sample that is stamped late makes a long interval as well, but the next is short. There all stamps after the
    interval have to be later by more than half a cycle. Besides, a clock that jitters makes intervals too short as far
    as too long: the interval must be too long by more than the shortest of all is too short; or its stamps must be
    shifted by more than any others are shifted back, and no interval nearby be longer. Stamps that are rounded to
    more than the digits of a cycle are told by :func:`rounded_ticks`.

    Examples
    --------
    >>> clock = clock_of(np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0]))
    >>> clock.lost.tolist(), clock.passed.tolist()
    ([False, False, True, False, False], [1.0, 1.0, 2.0, 1.0, 1.0])
    """
    time = np.ascontiguousarray(time, dtype=np.float64)
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    if np.all(np.abs(intervals - usual) <= CHANGED * usual):
        return Clock(np.full(intervals.size, usual), np.zeros(intervals.size, dtype=bool), np.ones(intervals.size))
    rounded = rounded_ticks(time)
    if rounded is not None:
        cycle, passed = rounded
        return Clock(np.full(intervals.size, cycle), passed > 1.0, passed)
    local, jitters = _beside(intervals, usual)
    if jitters:
        return _jittering(time.tobytes())
    cycles = np.where(np.abs(local - usual) > CHANGED * usual, local, usual)
    return Clock(cycles, intervals > LONG * cycles, np.maximum(np.rint(intervals / usual), 1.0))


def cycle_of(time: NDArray[np.float64]) -> float:
    """Return the cycle of time stamps [s], shape (n,), rising, n ≥ 2: the median interval.

    Of a clock that jitters, of a line through the stamps over the number of cycles that have passed, lost ones
    included; where each interval varies by itself, so that no clock keeps the stamps together, their mean.

    Examples
    --------
    >>> cycle_of(np.array([0.0, 1.0, 2.0, 4.0, 5.0])), cycle_of(np.array([0.0, 1.2, 1.9, 3.1, 3.9, 5.0]))
    (1.0, 1.0)
    """
    rounded = rounded_ticks(time)
    if rounded is not None:
        return rounded[0]
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    if float(np.median(np.abs(intervals - usual))) <= JITTERS * usual or not _beside(intervals, usual)[1]:
        return usual
    passed = cycles_passed(time)
    mean = float((time[-1] - time[0]) / np.sum(passed))
    off = intervals - mean * passed
    if float(off[1:] @ off[:-1]) > WANDERS * float(off @ off):
        return mean
    return fitted_cycle(time, np.concatenate([[0.0], np.cumsum(passed)]))[0]


def rounded_ticks(time: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]] | None:
    """Return cycle [s] and cycles passed in each interval of stamps that are rounded; None where they are not.

    All stamps are multiples of a resolution of at most half the cycle, which is no multiple of it, and off a line over
    whole numbers by no more than that rounding. So intervals have two lengths, both common and neither of them the
    cycle, and which are longer by a lost sample is told together with the cycle. An even clock of which single stamps
    slip has a rare length.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising [s].

    Examples
    --------
    >>> cycle, passed = rounded_ticks(np.array([0.0, 3.0, 5.0, 8.0, 10.0, 13.0, 18.0, 20.0, 23.0, 25.0]))
    >>> round(cycle, 2), passed.tolist()
    (2.5, [1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 1.0, 1.0, 1.0])
    """
    time = np.ascontiguousarray(time, dtype=np.float64)
    return _rounded_ticks(time.tobytes()) if time.size > 2 else None


@lru_cache(maxsize=16)  # one log is asked about its clock again and again
def _rounded_ticks(stamps: bytes) -> tuple[float, NDArray[np.float64]] | None:
    time = np.frombuffer(stamps)
    intervals = np.diff(time)
    step = _resolution(intervals)
    least = float(intervals.min())
    if step is None or least < 2.0 * step - WHOLE * step:
        return None
    # a single cycle takes at most a step longer than the shortest; the mean of these is off by far less than a step
    passed = np.maximum(np.rint(intervals / np.mean(intervals[intervals < least + 1.5 * step])), 1.0)
    place = np.concatenate([[0.0], np.cumsum(passed)])
    cycle = fitted_cycle(time, place)[0]
    drift = abs(cycle - step * np.rint(cycle / step)) * place[-1]
    line_error = 4.0 / float(np.sqrt(time.size))  # four of its deviations at both ends together, in steps
    is_long = intervals[passed == 1.0] > least + 0.5 * step
    if drift <= SLIPPED * step or not COMMON < np.mean(is_long) < 1.0 - COMMON:
        return None
    if float(np.ptp(time - cycle * place)) > step * (1.0 + line_error):
        return None
    passed.setflags(write=False)
    return cycle, passed


def _resolution(intervals: NDArray[np.float64]) -> float | None:
    """Return the least by which intervals differ if all are whole multiples of that [s], else None."""
    usual = float(np.median(intervals))
    ordered = np.sort(intervals)
    steps = np.diff(ordered)
    steps = steps[steps > JITTERS * usual]
    if not steps.size:
        return None
    step = float(steps.min())
    multiples = intervals / step
    return step if np.all(np.abs(multiples - np.rint(multiples)) < WHOLE) else None


def fitted_cycle(time: NDArray[np.float64], place: NDArray[np.float64]) -> tuple[float, float]:
    """Return the cycle [s], and how far the stamps are off whole ones (r.m.s.) [s].

    It is rounded as far as the stamps allow, a digit for odds of ten to one: controllers run at round cycles, and
    records of one axis are to agree.

    Parameters
    ----------
    time, place : ndarray, shape (n,)
        Stamps [s]; how many cycles have passed at each.
    """
    centred = place - np.mean(place)
    found = float(centred @ time / (centred @ centred))
    error = float(np.std(time - found * place))
    own = error / float(np.linalg.norm(centred))
    if error <= JITTERS * found:
        return found, error

    def unlikely(digits: int) -> float:
        return 0.5 * ((float(f"{found:.{digits}g}") - found) / own) ** 2 + digits * log(10.0)

    return float(f"{found:.{min(range(1, 16), key=unlikely)}g}"), error


def cycles_passed(time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many cycles have passed in each interval of time stamps [s], shape (n - 1,): 1 but across gaps."""
    intervals = np.diff(time)
    if not intervals.size or intervals.max() < LONG * float(np.median(intervals)):
        return np.ones(intervals.size)
    return clock_of(time).passed


def _beside(intervals: NDArray[np.float64], usual: float) -> tuple[NDArray[np.float64], bool]:
    """Return the median of the intervals beside each, and whether most differ so much from it that the log jitters."""
    from scipy.ndimage import median_filter

    local = median_filter(intervals, size=MEDIAN, mode="nearest")
    return local, float(np.median(np.abs(intervals - local))) > JITTERS * usual


@lru_cache(maxsize=4)  # the law of one log is tried with many settings
def _jittering(stamps: bytes) -> Clock:
    """Return the clock of stamps that jitter, see :func:`clock_of`."""
    from scipy.ndimage import maximum_filter1d

    time = np.frombuffer(stamps)
    intervals = np.diff(time)
    cycles = _cycles(intervals)
    lost = intervals > LONG * cycles
    if lost.any():
        long = np.flatnonzero(lost)
        shifts = _shifts(time, cycles, long)
        others = _shifts(time, cycles, np.arange(0, intervals.size, max(intervals.size // COMPARED, 1)))
        is_too_long = (intervals / cycles)[long] > 2.0 - np.min(intervals / cycles)
        is_longest = intervals[long] == maximum_filter1d(intervals, 2 * SIDE + 1)[long]
        lost[long] = (shifts > LONG) & (is_too_long | (is_longest & (shifts > 2.0 - np.min(others))))
    passed = np.where(lost, np.maximum(np.rint(intervals / cycles), 2.0), 1.0)
    found = Clock(cycles, lost, passed)
    for array in found:
        array.setflags(write=False)
    return found


def _cycles(intervals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cycle at each interval of a clock that jitters: the median of all, unless it changes for good."""
    from scipy.ndimage import median_filter

    usual, local = float(np.median(intervals)), median_filter(intervals, size=SMOOTH, mode="reflect")
    varies = 1.4826 * float(np.median(np.abs(intervals - local)))
    return np.where(np.abs(local - usual) > max(CHANGED * usual, HAMPEL * varies), local, usual)


def _shifts(time: NDArray[np.float64], cycles: NDArray[np.float64], chosen: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the `chosen` intervals as the median of several stamps before and after them tell, in cycles."""
    steps, ends = np.arange(SIDE), []
    for sign, place in ((-1, chosen), (1, chosen + 1)):
        at = place[:, None] + sign * steps
        cycle = cycles[np.clip(chosen + sign * SIDE, 0, cycles.size - 1)]
        stamps = time[np.clip(at, 0, time.size - 1)] - sign * steps * cycle[:, None]
        ends.append(np.nanmedian(np.where((at >= 0) & (at < time.size), stamps, np.nan), axis=1))
    return np.asarray((ends[1] - ends[0]) / cycles[chosen])
