"""Limits at which the logged voltage stays although the control law asks for more."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import rms
from servolens.quality.law import PARAMETERS, LawFit, voltage_of
from servolens.quality.settings import BETTER

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.record import Record

    Limits = tuple[float, float]

__all__ = ["NEAR", "UNLIMITED", "beyond_limit", "voltage_limits", "within"]

NEAR = 0.02
"""Share of a limit, or of the voltage's range, within which a voltage is at it: amplifiers err in gain by less."""
FEWEST = 3
"""Samples at a limit that make one."""
ROUNDS = 4
"""Times that gains are fitted to what is within the limits, and these found again."""
STEADY = PARAMETERS[:5]
"""Parameters of the law that are fitted there: none that answers the edges of a reference alone, as overshoot does."""
UNLIMITED: Limits = (-np.inf, np.inf)


def voltage_limits(record: Record) -> Limits:
    """Return the lower and upper limit of the logged voltage; infinite where there is none.

    Raises
    ------
    InputError
        As :func:`~servolens.control_law.controller_voltage`.
    """
    voltage = voltage_of(record)
    found, rows = UNLIMITED, _off_extremes(voltage)
    for free in ((), *ROUNDS * (STEADY,)):
        if np.count_nonzero(rows) < FEWEST:
            return float(voltage.min()), float(voltage.max())
        fit = LawFit.of(record, rows)
        before, found = found, _plateaus(voltage, voltage - fit.missed(fit.fitted(free)))
        rows = within(voltage, found)
        if found == before and free:
            break
    return found


def within(voltage: NDArray[np.float64], limits: Limits) -> NDArray[np.bool_]:
    """Mark the samples that are at neither limit."""
    margin = NEAR * float(np.ptp(voltage))
    if limits == UNLIMITED:
        return np.ones(voltage.size, dtype=bool)
    return (voltage > limits[0] + margin) & (voltage < limits[1] - margin)


def _off_extremes(voltage: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the samples that are not in a run at the largest or least voltage."""
    near = 1e-9 * float(np.ptp(voltage))
    kept = np.ones(voltage.size, dtype=bool)
    for at in (voltage >= voltage.max() - near, voltage <= voltage.min() + near):
        run = at[1:] & at[:-1]
        if np.count_nonzero(run) >= FEWEST:
            kept &= ~at
    return kept


def beyond_limit(record: Record) -> int:
    """Return in how many samples the logged voltage exceeds the stated limit by more than its tolerance."""
    if record.voltage_limit is None or record.voltage is None:
        return 0
    return int(np.count_nonzero(np.abs(record.voltage) > (1.0 + NEAR) * record.voltage_limit))


def _plateaus(voltage: NDArray[np.float64], asked: NDArray[np.float64]) -> Limits:
    """Return the lower and upper limit at which `voltage` stays while more is `asked`; infinite where there is none.

    The upper one is the most frequent voltage of those samples that get less than half of what they ask for beyond the
    median, and the limit is the median of the voltage wherever more than that is asked. There it must leave a tenth of
    what the law alone leaves.
    """
    low, high = UNLIMITED
    margin = NEAR * float(np.ptp(voltage))
    for sign in (1.0, -1.0):
        given, wanted = sign * voltage, sign * asked
        short = (wanted > given + margin) & (given > np.median(given))
        if np.count_nonzero(short) < FEWEST:
            continue
        counts, edges = np.histogram(given[short], bins=round(1 / NEAR))
        there = wanted > float(edges[np.argmax(counts)]) + margin
        limit = float(np.median(given[there]))
        if rms(given[there] - limit) < BETTER * rms(wanted[there] - given[there]):
            low, high = (low, limit) if sign > 0 else (-limit, high)
    return low, high
