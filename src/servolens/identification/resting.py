"""Where a record shows that the axis rests: dry friction or a brake holds it, and nothing shakes it there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["resting"]

LOOPS = 8.0
"""Time constants of the loop over which an axis has to stand still. One that nothing holds and that is shaken by some
times the noise is moved meanwhile: each time constant tells anew, so that about e⁻⁸ = 0.03 % of its samples seem to
rest; of axes of the laboratory 0.015 %."""
FEWEST = 9
"""Samples of a window."""
CHANCE = 1e-3
"""Probability that an axis at rest is not seen to be, by one of three tests."""


def resting(position: NDArray[np.float64], sensor: float, step: float) -> NDArray[np.bool_]:
    """Return where the `position` shows neither slope nor bend nor more than the sensor's noise, shape (n,).

    Asked are windows of a few samples; each tells of the sample in its middle, so that the beginning and the end of a
    motion, which are not seen at once, do not count as rest.

    Parameters
    ----------
    position : ndarray, shape (n,)
        As measured, in even steps [m or rad].
    sensor : float
        Standard deviation of the sensor's white noise [m or rad]; of next to none nothing is told.
    step : float
        Of the samples, in time constants of the loop.
    """
    from scipy.signal import oaconvolve
    from scipy.stats import chi2, norm

    count = max(int(np.ceil(LOOPS / step)) | 1, FEWEST)
    exact = np.sqrt(100.0 * np.finfo(float).eps) * float(np.ptp(position))  # squares to a hundredth of the noise's
    if position.size < count or sensor <= exact:
        return np.zeros(position.size, dtype=np.bool_)
    away, time = (position - np.mean(position)) / sensor, np.arange(count) - 0.5 * (count - 1)
    level, slope, bend = np.ones(count), time, time**2 - np.mean(time**2)
    total, *along = (oaconvolve(away, shape / np.linalg.norm(shape), mode="valid") for shape in (level, slope, bend))
    is_calm = oaconvolve(away**2, level, mode="valid") - total**2 < chi2.isf(CHANCE / 3.0, count - 1)
    for one in along:
        is_calm &= np.abs(one) < norm.isf(0.5 * CHANCE / 3.0)
    return np.pad(is_calm, count // 2, mode="edge")
