"""Time stamps that are off the even instants at which a log's samples were taken: the motion shows it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.clock import JITTERS, MEDIAN, clock_of, cycles_passed, fitted_cycle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.record import Record

    Signal = NDArray[np.float64]

__all__ = ["with_even_times"]

SIDE = 2
"""Samples before and after one that tell where it is: a cubic through four."""
ODDS = 12.0
"""By how much the log-likelihood of even instants exceeds that of the stamps: odds of 160 000 to one."""


def with_even_times(record: Record) -> Record:
    """Return `record` with even times, where its samples were taken evenly and only their time stamps are not even.

    A computer that stamps what a controller samples is late now by more and now by less, or rounds. The position of a
    sample lies on a cubic through its neighbours at the instants at which they were taken: where even instants leave
    less of the motion than the stamps do, beyond chance, they are the true ones. A log that was sampled as unevenly as
    its stamps say stays as it is, and so does one in which noise hides the difference.

    Parameters
    ----------
    record : Record
        Of one cycle throughout; samples may be lost.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from servolens import lab
    >>> taken = lab.step_record(lab.NLM1, kp=60, noise=1e-6, seed=1)
    >>> stamped = replace(taken, time=taken.time + 2e-4 * np.random.default_rng(1).uniform(size=len(taken)))
    >>> found = with_even_times(stamped)
    >>> bool(np.ptp(np.diff(found.time)) < 1e-9), round(1e3 * found.stamp_error, 2)
    (True, 0.06)
    """
    from scipy.ndimage import median_filter

    time, cycles = record.time, clock_of(record.time).cycles
    if np.ptp(cycles) > 0.0 or time.size <= 2 * SIDE:
        return record
    place = np.concatenate([[0.0], np.cumsum(cycles_passed(time))])
    cycle, error = fitted_cycle(time, place)
    even = cycle * place + float(np.mean(time - cycle * place))
    off = np.abs(median_filter(time - even, size=MEDIAN, mode="nearest"))
    if error <= JITTERS * cycle or float(off.max()) >= 0.5 * cycle:
        return record  # even as they are; or counted wrongly, for stamps in a row are off by as much as a lost sample
    used = _smooth(record, place)
    stamped, taken = (float(np.sum(_missed(at, record.position)[used] ** 2)) for at in (time, even))
    own = np.count_nonzero(used) / (2 * SIDE + 1)  # windows overlap
    if not 0.0 < taken < stamped or 0.5 * own * np.log(stamped / taken) <= ODDS:
        return record
    return replace(record, time=even, jump_leads=None, stamp_error=error)


def _smooth(record: Record, place: Signal) -> NDArray[np.bool_]:
    """Mark samples all of whose neighbours are there, and beside which the reference does not jump."""
    used = np.ones(place.size - 2 * SIDE, dtype=bool)
    used &= place[2 * SIDE :] - place[: -2 * SIDE] == 2 * SIDE
    for edge in record.jumps():
        used[max(int(edge) - 2 * SIDE, 0) : int(edge) + SIDE] = False
    return used


def _missed(time: Signal, position: Signal) -> Signal:
    """Return by how much samples are off the cubic through their four neighbours, as a multiple of noise alike."""
    size = time.size - 2 * SIDE
    others = [k for k in range(2 * SIDE + 1) if k != SIDE]
    at = {k: time[k : k + size] - time[SIDE : SIDE + size] for k in others}
    missed, squares = position[SIDE : SIDE + size].copy(), np.ones(size)
    for k in others:
        share = np.ones(size)
        for j in others:
            if j != k:
                share *= -at[j] / (at[k] - at[j])
        missed -= share * position[k : k + size]
        squares += share**2
    return np.asarray(missed / np.sqrt(squares))
