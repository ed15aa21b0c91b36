"""A ripple of the sensor at the mains frequency or a multiple of it: noise, with a finding, and taken out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects.periodic_disturbance import MAINS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.observed import ObservedRun, Signals, SimulatedRun

__all__ = ["Ripple", "mains_ripple"]

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
    amplitude : float
        Of the largest [m or rad].
    waves : tuple of ndarray
        Their sum in each record, on the samples that are simulated [m or rad].
    """

    frequencies: tuple[float, ...]
    amplitude: float
    waves: tuple[NDArray[np.float64], ...]

    def with_more(self, other: Ripple) -> Ripple:
        """Return both ripples together."""
        return Ripple(
            tuple(dict.fromkeys([*self.frequencies, *other.frequencies])),
            max(self.amplitude, other.amplitude),
            tuple(a + b for a, b in zip(self.waves, other.waves, strict=True)),
        )

    def __bool__(self) -> bool:
        return bool(self.frequencies)

    @property
    def rms(self) -> float:
        """Root mean square over all records [m or rad]."""
        return float(np.sqrt(np.mean(np.concatenate(self.waves) ** 2)))


def mains_ripple(runs: Sequence[ObservedRun | SimulatedRun], white: Sequence[NDArray[np.float64]]) -> Ripple:
    """Return the ripple that the whitened residuals show beyond chance.

    White noise of variance 1 explains χ²₂ of each line in each record (Fisher's test of a known frequency). The waves
    are then fitted to what is whitened, record by record: the mains do not know when a record begins.

    Parameters
    ----------
    runs : sequence of ObservedRun
        The records.
    white : sequence of ndarray
        Whitened residual of each, predicted minus measured, of variance about 1.
    """
    from scipy.stats import chi2

    fastest = 0.5 / max(float(np.median(np.diff(run.signals.time[:64]))) for run in runs)
    lines = sorted({line for line in MAINS if line < 0.9 * fastest})
    limit = float(chi2.isf(RIPPLE_LEVEL / max(len(lines), 1), 2 * len(runs)))
    shown = [f for f in lines if sum(_power(run.signals, r, f) for run, r in zip(runs, white, strict=True)) > limit]
    fits = [_fitted(run, residual, shown) for run, residual in zip(runs, white, strict=True)]
    amplitude = max((a for amplitudes, _ in fits for a in amplitudes), default=0.0)
    return Ripple(tuple(shown), amplitude, tuple(wave for _, wave in fits))


def _power(signals: Signals, residual: NDArray[np.float64], frequency: float) -> float:
    """Return the squared length of the residual along the wave, over that of its neighbours' mean."""
    time = signals.time if signals.index is None else signals.time[signals.index]
    window = np.hanning(residual.size)
    window = window / np.sqrt(np.mean(window**2))
    width = 1.0 / max(float(time[-1] - time[0]), 1e-9)
    around = [frequency + k * width for k in (-9, -7, -5, 5, 7, 9)]
    sizes = [
        2.0 * abs(np.vdot(np.exp(2j * np.pi * f * time), window * residual)) ** 2 / residual.size
        for f in (frequency, *around)
    ]
    return float(sizes[0]) / max(float(np.mean(sizes[1:])) / 2.0, 1.0)


def _fitted(
    run: ObservedRun | SimulatedRun, residual: NDArray[np.float64], frequencies: Sequence[float]
) -> tuple[list[float], NDArray[np.float64]]:
    """Return amplitude of each frequency and the sum of the waves in the measured position."""
    signals = run.signals
    if not frequencies:
        return [], np.zeros(signals.time.size)
    waves = np.column_stack([w(2.0 * np.pi * f * signals.time) for f in frequencies for w in (np.cos, np.sin)])
    seen = waves if signals.index is None else waves[signals.index]
    sizes, *_ = np.linalg.lstsq(run.whiten(seen), -residual, rcond=None)
    return [float(np.hypot(*pair)) for pair in sizes.reshape(-1, 2)], waves @ sizes
