"""How much of a residual is not noise: what of it goes on from sample to sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["remainder"]

BLOCKS = (8, 32, 128, 512)
"""Samples over which residuals are averaged."""
CERTAIN = 4.0
"""Standard deviations by which a mean square of averages must exceed that of white noise."""


def remainder(residuals: Sequence[NDArray[np.float64]], rounding: float = 0.0) -> float:
    """Return the r.m.s. of the smooth part of `residuals` that is certainly there, 0 where it may be noise [m or rad].

    White noise of deviation σ, averaged over b samples, has the variance σ²/b. What averages have beyond that, and
    beyond what chance gives them, is smooth. σ comes from third differences, to which smooth parts add nothing.

    Parameters
    ----------
    residuals : sequence of ndarray, shape (n,)
        Of each record.
    rounding : float
        Step of a sensor that rounds without noise to smear it: what it adds at rest goes on for long [m or rad].
    """
    third = np.concatenate([np.diff(r, 3) for r in residuals])
    white = float(np.mean(third**2)) / 20.0
    most = 0.0
    for size in BLOCKS:
        means = np.concatenate([_means(r, size) for r in residuals])
        if means.size < 6:
            continue
        chance = 1.0 + CERTAIN * np.sqrt(2.0 / means.size)
        beyond = float(np.mean(means**2)) - chance * white / size - rounding**2 / 12.0
        most = max(most, beyond)
    return float(np.sqrt(most))


def _means(residual: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    count = residual.size // size
    return np.asarray(residual[: count * size].reshape(count, size).mean(axis=1))
