"""A ripple of the sensor at the mains frequency or a multiple of it: noise, with a finding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects.periodic_disturbance import MAINS
from servolens.identification.noise import visible, waves_at, waves_in

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.observed import ObservedRun, SimulatedRun

__all__ = ["Ripple", "mains_lines", "ripple_in"]

RIPPLE_LEVEL = 1e-6
"""Probability that noise shows a line as high by chance, all lines that are looked at together."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Ripple:
    """Waves of the mains in the measured position.

    Attributes
    ----------
    frequencies : tuple of float
        [Hz].
    sizes : tuple of ndarray, shape (2k,)
        Of each record the cosine and the sine of each frequency [m or rad].
    """

    frequencies: tuple[float, ...]
    sizes: tuple[NDArray[np.float64], ...]

    def __bool__(self) -> bool:
        return bool(self.frequencies)

    @property
    def amplitude(self) -> float:
        """Of the largest wave [m or rad]."""
        return max((float(np.hypot(*pair)) for size in self.sizes for pair in size.reshape(-1, 2)), default=0.0)

    @property
    def rms(self) -> float:
        """Root mean square over all records [m or rad]."""
        return float(np.sqrt(np.mean([0.5 * float(size @ size) for size in self.sizes])))

    def at(self, group: int, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum of the waves of one record at `time` [s], shape (n,)."""
        if not self.frequencies:
            return np.zeros(time.size)
        return np.asarray(waves_at(time, self.frequencies) @ self.sizes[group])


def mains_lines(runs: Sequence[ObservedRun | SimulatedRun], white: Sequence[NDArray[np.float64]]) -> tuple[float, ...]:
    """Return the frequencies of the mains that the whitened residuals show beyond chance [Hz].

    White noise of variance 1 explains χ²₂ of each line in each record (Fisher's test of a known frequency).

    Parameters
    ----------
    runs : sequence of ObservedRun
        The records.
    white : sequence of ndarray
        Whitened residual of each, predicted minus measured, of variance about 1.
    """
    from scipy.stats import chi2

    times = [run.instants for run in runs]
    lines = sorted(set(MAINS).intersection(*(visible(time, MAINS) for time in times)))
    limit = float(chi2.isf(RIPPLE_LEVEL / max(len(lines), 1), 2 * len(runs)))
    return tuple(f for f in lines if sum(_power(t, r, f) for t, r in zip(times, white, strict=True)) > limit)


def ripple_in(
    times: Sequence[NDArray[np.float64]], missed: Sequence[NDArray[np.float64]], lines: Sequence[float]
) -> Ripple:
    """Return the waves of the mains in what simulations miss, with an amplitude and a phase of each record's own.

    Parameters
    ----------
    times : sequence of ndarray, shape (n,)
        Of each record [s].
    missed : sequence of ndarray, shape (n,)
        Simulated minus measured position [m or rad].
    lines : sequence of float
        Frequencies [Hz].
    """
    if not lines:
        return Ripple((), tuple(np.zeros(0) for _ in times))
    sizes = (-waves_in(error, waves_at(time, lines)) for time, error in zip(times, missed, strict=True))
    return Ripple(tuple(lines), tuple(sizes))


def _power(time: NDArray[np.float64], residual: NDArray[np.float64], frequency: float) -> float:
    """Return the squared length of the residual along the wave, over that of its neighbours' mean."""
    window = np.hanning(residual.size)
    window = window / np.sqrt(np.mean(window**2))
    width = 1.0 / max(float(time[-1] - time[0]), 1e-9)
    around = [frequency + k * width for k in (-9, -7, -5, 5, 7, 9)]
    sizes = [
        2.0 * abs(np.vdot(np.exp(2j * np.pi * f * time), window * residual)) ** 2 / residual.size
        for f in (frequency, *around)
    ]
    return float(sizes[0]) / max(float(np.mean(sizes[1:])) / 2.0, 1.0)
