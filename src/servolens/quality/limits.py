"""Samples at which the logged voltage sits at a limit: there it is not what the control law asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.control_arithmetic import samples_a_period
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["NEAR", "at_limit", "beyond_limit", "plateaus"]

NEAR = 0.02
"""Share of a limit, or of the voltage's range, within which a voltage is at it: amplifiers err in gain by less."""


def at_limit(record: Record, seen: Sampling) -> NDArray[np.bool_]:
    """Mark the samples with a voltage at the stated limit, and runs at its least or largest value.

    A run lasts three periods of the loop and more, and the position moves visibly in it. A stated limit that the log
    exceeds marks nothing: then the log holds what the controller asks for.
    """
    assert record.voltage is not None  # noqa: S101 - the caller has refused records without
    voltage, limit = record.voltage, record.voltage_limit
    if limit is not None:
        within = not beyond_limit(record)
        return np.asarray(within & (np.abs(voltage) >= (1.0 - NEAR) * limit), dtype=np.bool_)
    y, near = record.position, 1e-9 * float(np.ptp(voltage))
    visible = 5 * seen.level + 2 * (seen.step or 0.0)
    marked = np.zeros(len(record), dtype=bool)
    for at in (voltage >= voltage.max() - near, voltage <= voltage.min() + near):
        bounds = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
        starts, ends = bounds[::2], bounds[1::2] - 1
        flat = (ends - starts + 1 >= 3 * _held(record)) & (np.abs(y[ends] - y[starts]) > visible)
        for first, last in zip(starts[flat].tolist(), ends[flat].tolist(), strict=True):
            marked[first : last + 1] = True
    return marked


def beyond_limit(record: Record) -> int:
    """Return in how many samples the logged voltage exceeds the stated limit by more than its tolerance."""
    if record.voltage_limit is None or record.voltage is None:
        return 0
    return int(np.count_nonzero(np.abs(record.voltage) > (1.0 + NEAR) * record.voltage_limit))


def plateaus(voltage: NDArray[np.float64], asked: NDArray[np.float64]) -> tuple[float, float]:
    """Return the lower and upper limit at which `voltage` stays while more is `asked`; infinite where there is none.

    The upper one is the most frequent voltage of those samples that get less than half of what they ask for beyond the
    median, and the limit is the median of the voltage wherever more than that is asked.
    """
    low, high = -np.inf, np.inf
    for sign in (1.0, -1.0):
        given, wanted = sign * voltage, sign * asked
        short = (wanted > given + NEAR * np.ptp(voltage)) & (given > np.median(given))
        if np.count_nonzero(short) < 3:
            continue
        counts, edges = np.histogram(given[short], bins=round(1 / NEAR))
        level = float(edges[np.argmax(counts)])
        limit = sign * float(np.median(given[wanted > level + NEAR * np.ptp(voltage)]))
        low, high = (low, limit) if sign > 0 else (limit, high)
    return low, high


def _held(record: Record) -> int:
    """Return for how many samples the loop holds a voltage."""
    try:
        return 1 if record.controller is None else samples_a_period(record.controller, record.sample_time)
    except InputError:
        return 1
