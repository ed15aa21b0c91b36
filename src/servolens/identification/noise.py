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

__all__ = ["NoiseModel", "Whitener", "burg", "instants"]

SHORT_RUN = 2
"""Samples that an encoder shows the same, on average, up to which noise smears its rounding to noise of its own."""
SEEN = 5.0
"""Standard errors from which on a jitter is one: overlapping differences are worth about a third as many."""
REWEIGHTED, LEAST = 8, 1e-4
"""Times that the regression of squares is weighed by what it found, and share of their mean that the sensor's is."""
WANDERS = 50.0
"""Standard deviations of its innovation by which no sensor's noise spreads: that needs a pole at 0.9998, whose time
constant is 5000 samples."""
MOST_ORDER = 24
"""Highest order of the autoregressive noise: at 1 kHz it reaches over one period of the mains."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseModel:
    """The noise of a campaign, as one model of gain, damping and effects leaves it.

    Attributes
    ----------
    rate : float
        Of the observer [rad/s]: the fourth root of the ratio of the spectral densities, at low frequencies, of what
        shakes the axis and of the sensor's noise; 0 where nothing shakes it.
    filters : tuple of ndarray
        Prediction-error filters of order 0, 1 … p, each beginning with 1.
    scales : ndarray, shape (p + 1,)
        Standard deviation of what each of them leaves [m or rad].
    rounding : float
        Step of the encoder [m or rad]; 0 where it is not known.
    share : float
        Of the noise's variance that is rounding, 0 to 1: within a run of equal readings it does not average out.
    spread : float
        Standard deviation of the noise [m or rad]; of an observer's innovations in units of what it expects of a
        sensor's noise of 1.
    jitter : float
        Standard deviation of the sampling instants about those that are stated [s].
    corner : float
        Above which what shakes the axis fades [rad/s].
    gain, damping : float
        Of the axis, about: with them its velocity errs after a late input, and forgets it.
    discount : float
        Samples that count as one. Errors of a model that is not the axis are no noise: they go on for as long as the
        loop remembers, and the likelihood is tempered by it (Miller and Dunson 2019,
        doi:10.1080/01621459.2018.1469995).
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
    corner: float = 0.0
    gain: float = 0.0
    damping: float = 0.0
    discount: float = 1.0

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
    def is_observed(self) -> bool:
        """Whether the axis is observed, for something shakes it or its instants are not those that are stated."""
        return self.rate > 0.0 or self.jitter > 0.0

    @property
    def order(self) -> int:
        """Of the autoregressive process."""
        return len(self.filters) - 1

    @property
    def innovation(self) -> float:
        """Standard deviation of what no sample before tells [m or rad]."""
        return float(self.scales[-1])

    def bleached(self, white: NoiseModel) -> NoiseModel:
        """Return the same observer beside `white` noise."""
        return replace(self, filters=white.filters, scales=white.scales, share=white.share)

    @property
    def wanders(self) -> bool:
        """Whether it spreads farther than any sensor's: that is what the model lacks, taken up by the filter."""
        return self.rate == 0.0 and self.spread > WANDERS * self.innovation

    def memory(self) -> float:
        """Return for how many samples the noise remembers: the sum of its autocorrelation from −∞ to ∞, at least 1."""
        total = float(np.sum(self.filters[-1]))
        return max((self.innovation / max(abs(total), 1e-12)) ** 2 / max(self.spread**2, 1e-300), 1.0)

    def inflation(self, samples: int, unknowns: int) -> float:
        """Return by how much variances are larger than with a noise that is known: n/(n − p), n without its memory.

        The `unknowns` follow slow noise, so that less of it is left in the residual; at most tenfold.
        """
        return 1.0 / max(1.0 - unknowns * self.memory() / samples, 0.1)

    def estimated(
        self, residuals: Sequence[NDArray[np.float64]], whiteners: Sequence[Whitener], *, for_errors: bool = False
    ) -> NoiseModel:
        """Return the model whose autoregressive part suits `residuals`, one array a record.

        For a decision its order is that of the Bayesian criterion; for error bars that of Akaike's, which leaves less
        of the slow noise out.
        """
        jitter, floor = instants(residuals, [whitener.speed for whitener in whiteners])
        timed = replace(self, jitter=jitter, floor=min(floor, self.floor) if jitter > 0.0 else self.floor)
        if jitter > 0.0:
            whiteners = [Whitener(w.position, w.speed, timed) for w in whiteners]
        return timed.coloured(residuals, whiteners, for_errors=for_errors)

    def scaled(self, residuals: Sequence[NDArray[np.float64]]) -> NoiseModel:
        """Return white noise of the size of `residuals`."""
        samples = sum(r.size for r in residuals)
        spread = float(np.sqrt(sum(float(r @ r) for r in residuals) / samples))
        return replace(self, scales=np.array([max(spread, self.floor)]), spread=spread)

    def coloured(
        self, residuals: Sequence[NDArray[np.float64]], whiteners: Sequence[Whitener], *, for_errors: bool = False
    ) -> NoiseModel:
        """Return the model whose autoregressive part suits `residuals` beside the observer that left them."""
        evened = [whitener.evened(r) for whitener, r in zip(whiteners, residuals, strict=True)]
        filters, scales = burg(evened, MOST_ORDER, price=2.0 if for_errors else None)
        samples = sum(r.size for r in residuals)
        squares = [w.weighed(r) ** 2 for w, r in zip(whiteners, residuals, strict=True)]
        spread = float(np.sqrt(sum(float(np.sum(s)) for s in squares) / samples))
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
    weight : ndarray, shape (n,), optional
        Of each sample, where an observer tells how much it misses.
    """

    def __init__(
        self,
        position: NDArray[np.float64],
        speed: NDArray[np.float64],
        noise: NoiseModel,
        weight: NDArray[np.float64] | None = None,
    ) -> None:
        self.position, self.speed = position, speed
        self._weight = weight
        if noise.jitter > 0.0 and weight is None:
            self._weight = 1.0 / np.sqrt(1.0 + (noise.jitter * speed / max(noise.floor, 1e-300)) ** 2)
        self.noise, self.samples, self._first = noise, position.size, np.empty(0, dtype=np.intp)
        first = _steady_runs(position) if noise.share > 0.0 else self._first
        if noise.share > 0.0 and position.size > SHORT_RUN * first.size:  # else its own noise smears the rounding
            self._first, self._counts = first, np.diff(first, append=position.size)
            self._kept = 1.0 / np.sqrt(1.0 + self._counts * noise.share)
        begun = min(noise.order, position.size)
        self._begin = np.zeros((begun, begun))
        for k in range(begun):  # the first samples have no past as long as the filter
            self._begin[k, : k + 1] = noise.filters[k][::-1] / noise.scales[k] / np.sqrt(noise.discount)
        self._filter = noise.filters[-1] / noise.innovation / np.sqrt(noise.discount)

    @property
    def evening(self) -> float:
        """By how much evening lowers the variance of what lasts as long as equal readings; 1 where none is evened."""
        return float(np.sum(self._counts / self._kept**2) / self.samples) if self._first.size else 1.0

    def weighed(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), each by its weight."""
        return rows if self._weight is None else np.asarray((rows.T * self._weight).T)

    def evened(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), with equal weight for each run of equal readings.

        Rounding is the same error all through such a run: its mean counts as few samples, not as many.
        """
        rows = self.weighed(rows)
        if self._first.size == 0:
            return rows
        weight = (1.0 - self._kept) / self._counts
        sums = np.add.reduceat(rows, self._first, axis=0)
        lowered = np.repeat((sums.T * weight).T, self._counts, axis=0)
        return np.asarray(rows - lowered)

    def __call__(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), whitened."""
        evened = self.evened(rows)
        if rows.size == 0:
            return evened
        if rows.ndim == 1:
            white = np.convolve(evened, self._filter)[: rows.size]
        else:
            from scipy.signal import lfilter

            white = np.asarray(lfilter(self._filter, [1.0], evened, axis=0))
        begun = self._begin.shape[0]
        white[:begun] = self._begin @ evened[:begun]
        return white

    def deviations(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows D, shape (n, k), so that DᵀD is the covariance of the noise's sums with `weights`, shape (n, k).

        The adjoint of the inverse filter: what is whitened by it has these variances before.
        """
        from scipy.signal import lfilter

        if self._weight is not None:
            weights = (weights.T / self._weight).T
        spread = np.asarray(lfilter([1.0], self._filter, weights[::-1], axis=0))[::-1]
        if self._first.size == 0:
            return spread
        sums = np.add.reduceat(spread, self._first, axis=0)
        raised = np.repeat((sums.T * ((1.0 / self._kept - 1.0) / self._counts)).T, self._counts, axis=0)
        return np.asarray(spread + raised)

    @property
    def log_determinant(self) -> float:
        """−2 log of the determinant of the filter: what its scale costs in the likelihood."""
        noise, samples = self.noise, self.samples
        begun = min(noise.order, samples)
        found = float(np.sum(np.log(noise.scales[:begun]))) + (samples - begun) * float(np.log(noise.innovation))
        if self._weight is not None:
            found -= float(np.sum(np.log(self._weight)))
        return 2.0 * (found - (float(np.sum(np.log(self._kept))) if self._first.size else 0.0)) / noise.discount


def instants(residuals: Sequence[NDArray[np.float64]], speeds: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """Return the standard deviation of the sampling instants [s] that the residuals show, and of the sensor's noise.

    The first is 0 where it may be chance. Third differences, to which what is smooth adds nothing, grow with the speed:
    their squares are regressed on its, each in units of what is expected of it.
    """
    third = np.concatenate([np.diff(r, 3) ** 2 / 20.0 for r in residuals])
    squares = np.concatenate([v[1:-2] ** 2 for v in speeds])
    level, slope, error = float(third.mean()), 0.0, np.inf
    for _ in range(REWEIGHTED):
        weight = 1.0 / (level + slope * squares) ** 2
        centred = squares - float(weight @ squares) / float(weight.sum())
        energy = float(weight @ centred**2)
        if not energy > 0.0:
            break
        slope = max(float((weight * centred) @ third) / energy, 0.0)
        level = max(float(weight @ (third - slope * squares)) / float(weight.sum()), LEAST * float(third.mean()))
        error = float(np.sqrt(np.sum((weight * centred * (third - level - slope * squares)) ** 2))) / energy
    return (float(np.sqrt(slope)) if slope > SEEN * error else 0.0), float(np.sqrt(level))


def _steady_runs(position: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return where runs of equal readings begin; a reading that goes to a neighbour and back is one run."""
    first = np.concatenate([[0], np.flatnonzero(np.diff(position)) + 1])
    values = position[first]
    returns = np.flatnonzero(values[2:] == values[:-2])
    kept = np.ones(first.size, dtype=bool)
    kept[returns + 1] = kept[returns + 2] = False
    return first[kept]


def burg(
    signals: Sequence[NDArray[np.float64]], most: int, price: float | None = None
) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Return the prediction-error filters of order 0 … p of an autoregressive process, and what each leaves.

    Burg's method over all `signals` together; p by the Bayesian information criterion, or by another price.

    Parameters
    ----------
    signals : sequence of ndarray
        Realisations of one process with mean 0.
    most : int
        Highest order.
    price : float, optional
        Of an order, in −2 log-likelihood; the logarithm of the number of samples when None.

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
    costs = (np.log(samples) if price is None else price) * np.arange(len(powers))
    order = int(np.argmin(samples * np.log(powers) + costs))
    return tuple(filters[: order + 1]), np.sqrt(powers[: order + 1])
