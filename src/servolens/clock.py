"""A log's clock: its cycle at each interval, and where samples are lost."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["CHANGED", "EVEN", "Clock", "clock_of", "cycle_of"]

CHANGED, LONG = 0.25, 1.5
"""Share by which a cycle changes; cycles from which on a sample may be missing."""
EVEN = 0.01
"""Share of the median interval within which half of all intervals are where it is the cycle."""
WINDOW, HAMPEL = 31, 3.0
"""Intervals of the running median: half of them may be wrong; robust standard deviations by which what differs from it
differs for good (Hampel's filter)."""
SIDE, USUAL = 6, 10_000
"""Stamps before and after an interval that tell whether the clock is late from there on; about how many intervals are
looked at so."""


class Clock(NamedTuple):
    """What the time stamps of a log tell.

    Attributes
    ----------
    cycles : ndarray, shape (n - 1,)
        The log's cycle at each interval [s].
    lost : ndarray of bool, shape (n - 1,)
        Intervals in which samples are lost.
    """

    cycles: NDArray[np.float64]
    lost: NDArray[np.bool_]


def clock_of(time: NDArray[np.float64]) -> Clock:
    """Return the clock of time stamps [s], shape (n,), rising, n ≥ 2.

    A sample that is stamped late makes a long interval as a lost one does, but the next is short. Samples are lost in
    an interval after which all stamps are later by more than half a cycle, and which is too long by more than any other
    is too short, for a clock that jitters does both alike. Where the interval does not tell, the shift of the stamps is
    compared in the same way, and the place is the longest interval nearby.

    Examples
    --------
    >>> clock = clock_of(np.array([0.0, 1.0, 2.0, 3.4, 4.0, 5.0, 7.0, 8.0, 9.0, 10.0]))
    >>> clock.lost.nonzero()[0].tolist(), set(clock.cycles.tolist())
    ([5], {1.0})
    """
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    if np.all(np.abs(intervals - usual) <= CHANGED * usual):
        return Clock(np.full(intervals.size, usual), np.zeros(intervals.size, dtype=bool))
    return _uneven(time.tobytes())


@lru_cache(maxsize=16)  # the law of one log is tried with many settings
def _uneven(stamps: bytes) -> Clock:
    time = np.frombuffer(stamps)
    intervals = np.diff(time)
    cycles = _cycles(time, intervals)
    lost = intervals > LONG * cycles
    if lost.any():
        from scipy.ndimage import maximum_filter1d

        long = np.flatnonzero(lost)
        shifts = _shifts(time, cycles, long)
        usual = _shifts(time, cycles, np.arange(0, intervals.size, max(intervals.size // USUAL, 1)))
        by_itself = (intervals / cycles)[long] > 2.0 - np.min(intervals / cycles)
        longest = intervals[long] == maximum_filter1d(intervals, 2 * SIDE + 1)[long]
        lost[long] = (shifts > LONG) & (by_itself | (longest & (shifts > 2.0 - np.min(usual))))
    cycles.setflags(write=False)
    lost.setflags(write=False)
    return Clock(cycles, lost)


def cycle_of(time: NDArray[np.float64]) -> float:
    """Return the cycle of time stamps [s], shape (n,), rising, n ≥ 2: the median interval, where most are like it.

    Of a clock that jitters, what has passed in all by the number of cycles, lost ones included.

    Examples
    --------
    >>> cycle_of(np.array([0.0, 1.0, 2.0, 4.0, 5.0])), cycle_of(np.array([0.0, 1.2, 1.9, 3.1, 3.9, 5.0]))
    (1.0, 1.0)
    """
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    if float(np.median(np.abs(intervals - usual))) <= EVEN * usual:
        return usual
    cycles, lost = clock_of(time)
    if np.ptp(cycles) > 0.0:
        return float(np.median(cycles))
    return float((time[-1] - time[0]) / np.sum(np.where(lost, np.rint(intervals / cycles), 1.0)))


def _cycles(time: NDArray[np.float64], intervals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cycle at each interval: a running median where that differs from the median of all.

    A bus that changes its cycle keeps the new one. Where hardly more than half of the intervals are like the median
    beside them, long and short ones alternate: then two together make two cycles.
    """
    from scipy.ndimage import median_filter, uniform_filter1d

    pairs = np.append(0.5 * (time[2:] - time[:-2]), intervals[-1])
    local, even = (median_filter(one, size=WINDOW, mode="nearest") for one in (intervals, pairs))
    alike = uniform_filter1d(np.where(np.abs(intervals - local) <= CHANGED * local, 1.0, 0.0), WINDOW, mode="nearest")
    alternates = np.median(alike) * WINDOW < 0.5 * WINDOW + 1.0
    seen, local = (pairs, even) if alternates else (intervals, local)
    varies = 1.4826 * float(np.median(np.abs(seen - local)))
    usual = float(np.median(local))
    return np.where(np.abs(local - usual) > max(CHANGED * usual, HAMPEL * varies), local, usual)


def _shifts(time: NDArray[np.float64], cycles: NDArray[np.float64], chosen: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the `chosen` intervals as the median of several stamps before and after them tell, in cycles."""
    steps, far, ends = np.arange(SIDE), SIDE // 2 + 1, []
    for sign, place in ((-1, chosen), (1, chosen + 1)):
        at = place[:, None] + sign * steps
        cycle = cycles[np.clip(chosen + sign * far, 0, cycles.size - 1)]
        stamps = time[np.clip(at, 0, time.size - 1)] - sign * steps * cycle[:, None]
        ends.append(np.nanmedian(np.where((at >= 0) & (at < time.size), stamps, np.nan), axis=1))
    return np.asarray((ends[1] - ends[0]) / cycles[chosen])
