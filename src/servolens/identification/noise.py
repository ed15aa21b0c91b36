"""What the records contain beside the motion: sensor noise and its colour, rounding, mains ripple, and shaking.

One noise model serves fits, decisions and error bars. Position as measured is ``y = h(x, θ) + e``, where ``e`` is an
autoregressive process (white noise is of order 0) plus the encoder's rounding; an axis that is shaken moves with an
acceleration of its own, ``ẍ = model + w``. An observer whose gain follows from the ratio of both predicts each sample
from those before it; without shaking the gain is 0 and the observer is a simulation. What it misses, filtered to be
white, is what every fit minimises (prediction errors: Ljung, *System Identification*, 1999, chapter 7).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["NoiseModel", "Whitener", "burg", "observer_gains"]

SHORT_RUN = 2
"""Samples that an encoder shows the same, on average, up to which noise smears its rounding to noise of its own."""
SEEN = 5.0
"""Standard errors from which on a jitter is one: overlapping differences are worth about a third as many."""
MOST_ORDER = 24
"""Highest order of the autoregressive noise: at 1 kHz it reaches over one period of the mains."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """The noise of a campaign, as one model of gain, damping and effects leaves it.

    Attributes
    ----------
    rate : float
        Of the observer [rad/s]; 0 where nothing shakes the axis, then it is a simulation.
    filters : tuple of ndarray
        Prediction-error filters of order 0, 1 … p, each beginning with 1.
    scales : ndarray, shape (p + 1,)
        Standard deviation of what each of them leaves [m or rad].
    rounding : float
        Step of the encoder [m or rad]; 0 where it is not known.
    share : float
        Of the noise's variance that is rounding, 0 to 1: within a run of equal readings it does not average out.
    spread : float
        Standard deviation of the noise [m or rad].
    jitter : float
        Standard deviation of the sampling instants about those that are stated [s].
    floor : float
        Standard deviation of its white part and the rounding, from the highest frequencies [m or rad].
    """

    rate: float
    filters: tuple[NDArray[np.float64], ...]
    scales: NDArray[np.float64]
    rounding: float
    share: float
    spread: float
    floor: float
    jitter: float = 0.0

    @classmethod
    def white(cls, deviation: float, rounding: float = 0.0) -> NoiseModel:
        """Return white noise of a standard `deviation`, with the encoder's `rounding`."""
        step = rounding**2 / 12.0
        total = max(deviation**2, step, 1e-300)
        return cls(
            rate=0.0,
            filters=(np.ones(1),),
            scales=np.array([np.sqrt(total)]),
            rounding=rounding,
            share=min(step / total, 1.0),
            spread=float(np.sqrt(total)),
            floor=float(np.sqrt(total)),
        )

    @property
    def order(self) -> int:
        """Of the autoregressive process."""
        return len(self.filters) - 1

    @property
    def innovation(self) -> float:
        """Standard deviation of what no sample before tells [m or rad]."""
        return float(self.scales[-1])

    def memory(self) -> float:
        """Return for how many samples the noise remembers: the sum of its autocorrelation from −∞ to ∞, at least 1."""
        total = float(np.sum(self.filters[-1]))
        return max((self.innovation / max(abs(total), 1e-12)) ** 2 / max(self.spread**2, 1e-300), 1.0)

    def estimated(self, residuals: Sequence[NDArray[np.float64]], whiteners: Sequence[Whitener]) -> NoiseModel:
        """Return the model whose autoregressive part suits `residuals`, one array a record."""
        timed = replace(self, jitter=_jitter(residuals, [whitener.speed for whitener in whiteners]))
        if timed.jitter > 0.0:
            return timed._coloured(residuals, [Whitener(w.position, w.speed, timed) for w in whiteners])
        return self._coloured(residuals, whiteners)

    def _coloured(self, residuals: Sequence[NDArray[np.float64]], whiteners: Sequence[Whitener]) -> NoiseModel:
        evened = [whitener.evened(r) for whitener, r in zip(whiteners, residuals, strict=True)]
        filters, scales = burg(evened, MOST_ORDER)
        samples = sum(r.size for r in residuals)
        spread = float(np.sqrt(sum(float(r @ r) for r in residuals) / samples))
        return replace(self, filters=filters, scales=scales, spread=spread)


@final
class Whitener:
    """Filters the residual of one record to white noise of variance 1.

    Parameters
    ----------
    position : ndarray, shape (n,)
        As measured: it tells how long the encoder shows the same.
    speed : ndarray, shape (n,)
        Of the axis [m/s or rad/s]: by it a jitter of the sampling instants matters.
    noise : NoiseModel
        What to whiten.
    """

    def __init__(self, position: NDArray[np.float64], speed: NDArray[np.float64], noise: NoiseModel) -> None:
        self.position, self.speed = position, speed
        self._weight: NDArray[np.float64] | None = None
        if noise.jitter > 0.0:
            self._weight = 1.0 / np.sqrt(1.0 + (noise.jitter * speed / max(noise.floor, 1e-300)) ** 2)
        self.noise, self.samples, self._first = noise, position.size, np.empty(0, dtype=np.intp)
        first = _steady_runs(position) if noise.share > 0.0 else self._first
        if noise.share > 0.0 and position.size > SHORT_RUN * first.size:  # else its own noise smears the rounding
            self._first, self._counts = first, np.diff(first, append=position.size)
            self._kept = 1.0 / np.sqrt(1.0 + self._counts * noise.share)
        begun = min(noise.order, position.size)
        self._begin = np.zeros((begun, begun))
        for k in range(begun):  # the first samples have no past as long as the filter
            self._begin[k, : k + 1] = noise.filters[k][::-1] / noise.scales[k]
        self._filter = noise.filters[-1] / noise.innovation

    def evened(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), with equal weight for each run of equal readings.

        Rounding is the same error all through such a run: its mean counts as few samples, not as many.
        """
        if self._weight is not None:
            rows = (rows.T * self._weight).T
        if self._first.size == 0:
            return rows
        weight = (1.0 - self._kept) / self._counts
        sums = np.add.reduceat(rows, self._first, axis=0)
        lowered = np.repeat((sums.T * weight).T, self._counts, axis=0)
        return np.asarray(rows - lowered)

    def __call__(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), whitened."""
        evened = self.evened(rows)
        if rows.ndim == 1:
            white = np.convolve(evened, self._filter)[: rows.size]
        else:
            from scipy.signal import lfilter

            white = np.asarray(lfilter(self._filter, [1.0], evened, axis=0))
        begun = self._begin.shape[0]
        white[:begun] = self._begin @ evened[:begun]
        return white

    @property
    def log_determinant(self) -> float:
        """−2 log of the determinant of the filter: what its scale costs in the likelihood."""
        noise, samples = self.noise, self.samples
        begun = min(noise.order, samples)
        found = float(np.sum(np.log(noise.scales[:begun]))) + (samples - begun) * float(np.log(noise.innovation))
        if self._weight is not None:
            found -= float(np.sum(np.log(self._weight)))
        return 2.0 * (found - (float(np.sum(np.log(self._kept))) if self._first.size else 0.0))


def _jitter(residuals: Sequence[NDArray[np.float64]], speeds: Sequence[NDArray[np.float64]]) -> float:
    """Return the standard deviation of the sampling instants [s] that the residuals show; 0 where it may be chance.

    Third differences, to which what is smooth adds nothing, grow with the speed: their squares are regressed on its.
    """
    third = np.concatenate([np.diff(r, 3) ** 2 / 20.0 for r in residuals])
    squares = np.concatenate([v[1:-2] ** 2 for v in speeds])
    centred = squares - squares.mean()
    energy = float(centred @ centred)
    if energy <= 0.0:
        return 0.0
    slope = float(centred @ third) / energy
    level = float(third.mean()) - slope * float(squares.mean())
    error = float(np.sqrt(np.sum((centred * (third - level - slope * squares)) ** 2))) / energy
    if slope < SEEN * error or slope * float(squares.mean()) < 0.1 * float(third.mean()):
        return 0.0
    return float(np.sqrt(slope))


def _steady_runs(position: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return where runs of equal readings begin; a reading that goes to a neighbour and back is one run."""
    first = np.concatenate([[0], np.flatnonzero(np.diff(position)) + 1])
    values = position[first]
    returns = np.flatnonzero(values[2:] == values[:-2])
    kept = np.ones(first.size, dtype=bool)
    kept[returns + 1] = kept[returns + 2] = False
    return first[kept]


def burg(
    signals: Sequence[NDArray[np.float64]], most: int
) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Return the prediction-error filters of order 0 … p of an autoregressive process, and what each leaves.

    Burg's method over all `signals` together; p by the Bayesian information criterion.

    Parameters
    ----------
    signals : sequence of ndarray
        Realisations of one process with mean 0.
    most : int
        Highest order.

    References
    ----------
    J. P. Burg, *Maximum entropy spectral analysis*, PhD thesis, Stanford, 1975.
    """
    samples = sum(signal.size for signal in signals)
    forward, backward = list(signals), list(signals)
    power = max(sum(float(s @ s) for s in signals) / samples, 1e-300)
    filters, powers = [np.ones(1)], [power]
    for _ in range(min(most, min(signal.size for signal in signals) // 4)):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True)]
        both = sum(float(f @ b) for f, b in pairs)
        reflection = 2.0 * both / max(sum(float(f @ f + b @ b) for f, b in pairs), 1e-300)
        forward = [f - reflection * b for f, b in pairs]
        backward = [b - reflection * f for f, b in pairs]
        longer = np.append(filters[-1], 0.0)
        filters.append(longer - reflection * longer[::-1])
        powers.append(max(powers[-1] * (1.0 - reflection**2), 1e-300))
    price = np.log(samples) * np.arange(len(powers))
    order = int(np.argmin(samples * np.log(powers) + price))
    return tuple(filters[: order + 1]), np.sqrt(powers[: order + 1])


def observer_gains(rate: float, sample_time: float) -> tuple[float, float]:
    """Return the steady gains of position [1] and velocity [1/s] of an observer of `rate` [rad/s]; 0 where it is 0.

    Of an axis shaken by white acceleration between samples; the rate is the fourth root of the ratio of the power
    densities of that acceleration and of the sensor's noise.

    References
    ----------
    P. R. Kalata, *The tracking index: a generalized parameter for α-β and α-β-γ target trackers*, IEEE Transactions on
    Aerospace and Electronic Systems 20 (1984), doi:10.1109/TAES.1984.310438.
    """
    if rate == 0.0:
        return 0.0, 0.0
    index = (rate * sample_time) ** 2
    root = 0.25 * (4.0 + index - np.sqrt(8.0 * index + index**2))
    alpha = float(1.0 - root**2)
    return alpha, float(2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha)) / sample_time
