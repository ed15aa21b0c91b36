"""What an encoder's rounding does to whitened residuals, simulated: it is not Gaussian, and does not average out.

Where rounding is a good part of the noise, what is compared with chance is compared with such draws (parametric
bootstrap: Efron and Tibshirani 1993, chapter 6).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.identification.noise import Whitener
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.plant import Plant

__all__ = ["DRAWS", "dominates", "is_rounded", "limit_of", "rounded"]

DOMINATES = 0.5
"""Share of rounding in the noise's variance from which on it is what decides: an axis at rest shows no noise."""

DRAWS = 40
"""Draws of a noise that is rounded: its variance in a direction is then known to 20 %."""


def is_rounded(noise: NoiseModel) -> bool:
    """Tell whether an encoder's rounding is part of the noise of a simulation."""
    return noise.rate == 0.0 and noise.share > 0.0 and noise.rounding > 0.0


def dominates(noise: NoiseModel) -> bool:
    """Tell whether rounding is most of the noise."""
    return noise.share > DOMINATES


def rounded(
    runs: Sequence[ObservedRun | SimulatedRun], plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return draws of each run's whitened residual if its plant is the axis, shape (n, draws).

    The simulated position, with noise as the model has it, rounded to a grid that lies anywhere.

    Parameters
    ----------
    runs : sequence of ObservedRun or SimulatedRun
        Without an observer's correction.
    plants, starts : sequence
        The plant of each run and its initial state.
    """
    stream = np.random.default_rng(0)
    found = []
    for run, plant, start in zip(runs, plants, starts, strict=True):
        missed = run.missed(plant, start, substeps_for(plant, run.sample_time))
        found.append(_drawn(run, run.whiten.position + missed, stream))
    return found


def _drawn(
    run: ObservedRun | SimulatedRun, position: NDArray[np.float64], stream: np.random.Generator
) -> NDArray[np.float64]:
    from scipy.signal import lfilter

    noise = run.noise
    scale = noise.innovation * float(np.sqrt(max(1.0 - noise.share, 0.0)))
    innovations = scale * stream.standard_normal((position.size, DRAWS))
    place = stream.uniform(0.0, noise.rounding, DRAWS)  # where the encoder's steps lie
    exact = position[:, None] + np.asarray(lfilter([1.0], noise.filters[-1], innovations, axis=0)) + place
    shown = noise.rounding * np.round(exact / noise.rounding) - place
    return np.column_stack([Whitener(one, run.whiten.speed, noise)(position - one) for one in shown.T])


def limit_of(draws: NDArray[np.float64], level: float) -> float:
    """Return what a sum of squares, of which there are `draws`, exceeds with probability `level`.

    Of a multiple of χ² with their mean and variance (Satterthwaite 1946, doi:10.2307/3002019).
    """
    from scipy.stats import chi2

    mean, variance = float(np.mean(draws)), float(np.var(draws))
    scale = max(variance / (2.0 * mean), 1e-300) if mean > 0.0 else 1e-300
    return scale * float(chi2.isf(level, max(mean / scale, 1e-3)))
