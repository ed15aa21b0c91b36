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

from servolens.identification.autoregression import burg
from servolens.identification.late_inputs import instants
from servolens.identification.slow_noise import slow_filters

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["MOST_ORDER", "TOLD_APART", "NoiseModel", "Whitener"]

WANDERS = 12.0
"""Standard deviations of its innovation by which no sensor's noise spreads: that needs a pole at 0.9965, whose time
constant is 290 samples."""
SWINGS, LINES = 0.5, 2048
"""Share of its variance that no noise of a sensor has about one frequency: its spectrum falls. Of what swings the mains
are taken out before, and the rest is the axis. Frequencies at which a spectrum is looked at."""
NEGLIGIBLE = 2e-5
"""Share of the travel below which a residual is no matter: what ten thousand steps of an encoder tell apart at best."""
BELOW_NYQUIST, DISTINCT = 0.9, 1e-3
"""Share of half the sampling rate up to which a line of the mains can be told from its alias; ratio of singular values
below which waves look the same."""
TOLD_APART = 1e-8
"""Share of the travel by which exact simulations of one axis differ: less is no structure of a log without noise."""
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
    parameters : int
        Of the autoregressive part, beside its size: its order, or those of slow noise beside white noise.
    rounding : float
        Step of the encoder [m or rad]; 0 where it is not known.
    spread : float
        Standard deviation of the noise [m or rad]; of an observer's innovations in units of what it expects of a
        sensor's noise of 1.
    jitter : float
        Standard deviation of the sampling instants about those that are stated [s].
    corner : float
        Above which what shakes the axis fades [rad/s].
    gain, damping : float
        Of the axis, about: with them its velocity errs after a late input, and forgets it. A gain of 0 where the input
        is on time, and the reading alone late.
    pushed : Plant or None
        The axis, of the effects by which a voltage pushes it otherwise than in proportion; None where there are none.
    discount : float
        Samples that count as one. Errors of a model that is not the axis are no noise: they go on for as long as the
        loop remembers, and the likelihood is tempered by it (Miller and Dunson 2019,
        doi:10.1080/01621459.2018.1469995).
    floor : float
        Standard deviation of its white part and the rounding, from the highest frequencies [m or rad].
    least : float
        Standard deviation below which nothing is told apart: what simulations are off by [m or rad].
    lines : tuple of float
        Frequencies of the mains that the sensor shows, in each record with an amplitude and a phase of its own [Hz].
    is_fitted : bool
        Whether it was estimated from what a model leaves: then it whitens that.
    counts_followed : bool
        Whether what the fit has followed of it is part of it; see :mod:`servolens.identification.restricted`.
    is_model_error : bool
        Whether it is what the model lacks, and no noise: white of the same size, for a filter would hide every effect.
    """

    rate: float
    filters: tuple[NDArray[np.float64], ...]
    scales: NDArray[np.float64]
    rounding: float
    spread: float
    floor: float
    least: float = 0.0
    jitter: float = 0.0
    corner: float = 0.0
    gain: float = 0.0
    damping: float = 0.0
    pushed: Plant | None = None
    discount: float = 1.0
    parameters: int = 0
    lines: tuple[float, ...] = ()
    is_fitted: bool = False
    counts_followed: bool = False
    is_model_error: bool = False

    @classmethod
    def white(cls, deviation: float, rounding: float = 0.0) -> NoiseModel:
        """Return white noise of a standard `deviation`, with the encoder's `rounding`."""
        total = float(np.sqrt(max(deviation**2, rounding**2 / 12.0, 1e-300)))
        return cls(
            rate=0.0,
            filters=(np.ones(1),),
            scales=np.array([total]),
            rounding=rounding,
            spread=total,
            floor=total,
        )

    @property
    def is_observed(self) -> bool:
        """Whether the axis is observed, for something shakes it or its instants are not those that are stated."""
        return self.rate > 0.0 or self.jitter > 0.0

    @property
    def share(self) -> float:
        """Of the noise's variance that is rounding, 0 to 1: at rest it does not average out. 0 of innovations."""
        total = max(self.spread, self.floor, 1e-150)
        return 0.0 if self.is_observed else min(self.rounding**2 / 12.0 / total**2, 1.0)

    def shaking(self, sample_time: float) -> tuple[float, float]:
        """Return which share of the acceleration that shakes the axis is left a sample later, and its variance.

        The variance [1/s⁴] is the stationary one, in units of that of the sensor's noise. A first-order process with
        the spectral density ``rate⁴`` times the sensor's at low frequencies.
        """
        left = float(np.exp(-self.corner * sample_time))
        return left, (self.rate**4 * (1.0 - left) / (1.0 + left) if self.rate > 0.0 else 0.0)

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
        return replace(
            self,
            filters=white.filters,
            scales=white.scales,
            spread=white.spread,
            floor=white.floor,
            parameters=0,
            is_fitted=False,
            counts_followed=False,
        )

    @property
    def wanders(self) -> bool:
        """Whether it spreads farther than any sensor's: that is what the model lacks, taken up by the filter."""
        return self.rate == 0.0 and self.spread > WANDERS * self.innovation

    @property
    def swings(self) -> bool:
        """Whether most of it is about one frequency, and more than rounding is: what the model lacks, again.

        Most of its spectrum is above all that is lower in frequency.
        """
        if self.order < 2:
            return False
        spectrum = 1.0 / np.abs(np.fft.rfft(self.filters[-1], LINES)) ** 2
        above = float(np.sum(spectrum - np.minimum.accumulate(spectrum)) / np.sum(spectrum))
        return above > SWINGS and above > self.share

    def memory(self) -> float:
        """Return for how many samples the noise remembers: the sum of its autocorrelation from −∞ to ∞, at least 1."""
        total = float(np.sum(self.filters[-1]))
        return max((self.innovation / max(abs(total), 1e-12)) ** 2 / max(self.spread**2, 1e-300), 1.0)

    def time_constant(self) -> float:
        """Return how many samples its slow part takes to change: till its autocorrelation falls by a factor of e.

        White noise beside it takes part at lag 0 only, and so the fall is counted from the next sample on.

        Examples
        --------
        >>> round(replace(NoiseModel.white(1.0), filters=(np.array([1.0, -0.9]),)).time_constant(), 1)
        9.5
        """
        spectrum = 1.0 / np.maximum(np.abs(np.fft.rfft(self.filters[-1], LINES)), 1e-12) ** 2
        after = np.fft.irfft(spectrum)[1 : LINES // 2]
        fallen = int(np.argmax(after < after[0] / np.e))
        if fallen == 0:
            return float(after.size)
        before, now = after[fallen - 1 : fallen + 1] * np.e / after[0]
        return float(fallen - 1 + (before - 1.0) / (before - now))

    def spread_error(self, samples: int) -> float:
        """Return the standard error of `spread` from so many `samples` [m or rad].

        The variance of a sample variance of correlated normal values is 2 σ⁴ Σρ²/n, with the autocorrelations ρ of all
        lags, which sum to mean(S²)/mean(S)² of the spectrum S (Priestley, *Spectral Analysis and Time Series*, 1981,
        section 5.3.3).
        """
        spectrum = 1.0 / np.maximum(np.abs(np.fft.rfft(self.filters[-1], LINES)), 1e-12) ** 2
        correlated = float(np.mean(spectrum**2) / np.mean(spectrum) ** 2)
        return self.spread * float(np.sqrt(0.5 * correlated / max(samples, 1)))

    def inflation(self, samples: int, unknowns: int) -> float:
        """Return by how much variances are larger than with a noise that is known: n/(n − p), n without its memory.

        The `unknowns` follow slow noise, so that less of it is left in the residual; at most tenfold. Not where that is
        counted as noise already.
        """
        if self.counts_followed:
            return 1.0
        return 1.0 / max(1.0 - unknowns * self.memory() / samples, 0.1)

    def estimated(
        self, residuals: Sequence[NDArray[np.float64]], whiteners: Sequence[Whitener], *, for_errors: bool = False
    ) -> NoiseModel:
        """Return the model whose autoregressive part suits `residuals`, one array a record.

        For a decision its order is that of the Bayesian criterion; for error bars that of Akaike's, which leaves less
        of the slow noise out.
        """
        steady = [whitener.steady(r) for whitener, r in zip(whiteners, residuals, strict=True)]
        jitter, floor = instants(steady, [whitener.speed for whitener in whiteners])
        timed = replace(self, jitter=jitter, floor=min(floor, self.floor) if jitter > 0.0 else self.floor)
        if jitter > 0.0:
            whiteners = [Whitener(w.position, w.speed, timed, time=w.time) for w in whiteners]
        return timed.coloured(residuals, whiteners, for_errors=for_errors)

    def scaled(self, residuals: Sequence[NDArray[np.float64]]) -> NoiseModel:
        """Return white noise of the size of `residuals`."""
        samples = sum(r.size for r in residuals)
        spread = float(np.sqrt(sum(float(r @ r) for r in residuals) / samples))
        own = np.array([max(spread, self.floor)])
        return replace(self, scales=own, spread=spread, is_fitted=False, counts_followed=False)

    def coloured(
        self,
        residuals: Sequence[NDArray[np.float64]],
        whiteners: Sequence[Whitener],
        *,
        for_errors: bool = False,
        most_order: int = MOST_ORDER,
    ) -> NoiseModel:
        """Return the model whose autoregressive part suits `residuals` beside the observer that left them."""
        weighed = [w.weighed(w.steady(r)) for w, r in zip(whiteners, residuals, strict=True)]
        samples = sum(r.size for r in residuals)
        price = 2.0 if for_errors else float(np.log(samples))
        filters, scales = burg(weighed, most_order, price)
        parameters = len(filters) - 1
        if parameters:
            others = [(parameters, filters, scales), *slow_filters(weighed, MOST_ORDER)]
            parameters, filters, scales = min(others, key=lambda o: 2.0 * samples * np.log(o[2][-1]) + price * o[0])
        spread = float(np.sqrt(sum(float(w @ w) for w in weighed) / samples))
        if spread <= self.least:
            parameters, filters, scales = 0, (np.ones(1),), np.zeros(1)
        scales = np.maximum(scales, self.least)
        return replace(
            self,
            filters=filters,
            scales=scales,
            parameters=parameters,
            spread=spread,
            is_fitted=True,
            counts_followed=False,
        )


@final
class Whitener:
    """Filters the residual of one record to white noise of variance 1, at right angles to waves of the mains.

    So amplitude and phase of each wave count as fitted, whatever the model is.

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
    time : ndarray, shape (n,), optional
        Of each sample [s]; needed where the noise has lines of the mains.
    """

    def __init__(
        self,
        position: NDArray[np.float64],
        speed: NDArray[np.float64],
        noise: NoiseModel,
        weight: NDArray[np.float64] | None = None,
        *,
        time: NDArray[np.float64] | None = None,
    ) -> None:
        self.position, self.speed, self.time = position, speed, time
        self._weight = weight
        if noise.jitter > 0.0 and weight is None:
            self._weight = 1.0 / np.sqrt(1.0 + (noise.jitter * speed / max(noise.floor, 1e-300)) ** 2)
        self.noise, self.samples = noise, position.size
        begun = min(noise.order, position.size)
        self._begin = np.zeros((begun, begun))
        for k in range(begun):  # the first samples have no past as long as the filter
            self._begin[k, : k + 1] = noise.filters[k][::-1] / noise.scales[k] / np.sqrt(noise.discount)
        self._filter = noise.filters[-1] / noise.innovation / np.sqrt(noise.discount)
        self._lines = visible(time, noise.lines) if time is not None else ()
        self._waves = waves_at(time, self._lines) if time is not None and self._lines else None
        self._basis = None if self._waves is None else _spanned(self._filtered(self._waves))

    def beside(self, noise: NoiseModel) -> Whitener:
        """Return the whitener of the same record beside `noise` with other filters, but no other observer or jitter."""
        return Whitener(self.position, self.speed, noise, self._weight, time=self.time)

    def of(self, position: NDArray[np.float64]) -> Whitener:
        """Return the whitener of the same motion, measured as another `position`."""
        return Whitener(position, self.speed, self.noise, time=self.time)

    def steady(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a `residual`, shape (n,), without waves of the mains."""
        return residual if self._waves is None else residual - self._waves @ waves_in(residual, self._waves)

    def ripple(self, residual: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the waves of the mains in a `residual`, shape (n,), at any `time` [s], shape (m,)."""
        if self._waves is None:
            return np.zeros(time.size)
        return np.asarray(waves_at(time, self._lines) @ waves_in(residual, self._waves))

    def weighed(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), each by its weight."""
        return rows if self._weight is None else np.asarray((rows.T * self._weight).T)

    def __call__(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `rows`, shape (n,) or (n, k), whitened."""
        white = self._filtered(rows)
        return white if self._basis is None else white - self._basis @ (self._basis.T @ white)

    def _filtered(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        weighed = self.weighed(rows)
        if rows.size == 0:
            return weighed
        if self._filter.size == 1:
            white = np.asarray(weighed * self._filter)
        elif rows.ndim == 1:
            white = np.convolve(weighed, self._filter)[: rows.size]
        else:
            from scipy.signal import lfilter

            white = np.asarray(lfilter(self._filter, [1.0], weighed, axis=0))
        begun = self._begin.shape[0]
        white[:begun] = self._begin @ weighed[:begun]
        return white

    def deviations(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows D, shape (n, k), so that DᵀD is the covariance of the noise's sums with `weights`, shape (n, k).

        The adjoint of the inverse filter: what is whitened by it has these variances before.
        """
        from scipy.signal import lfilter

        if self._weight is not None:
            weights = (weights.T / self._weight).T
        return np.asarray(lfilter([1.0], self._filter, weights[::-1], axis=0))[::-1]

    @property
    def log_determinant(self) -> float:
        """−2 log of the determinant of the filter: what its scale costs in the likelihood."""
        noise, samples = self.noise, self.samples
        begun = min(noise.order, samples)
        found = float(np.sum(np.log(noise.scales[:begun]))) + (samples - begun) * float(np.log(noise.innovation))
        if self._weight is not None:
            found -= float(np.sum(np.log(self._weight)))
        return 2.0 * found / noise.discount


def visible(time: NDArray[np.float64], lines: Sequence[float]) -> tuple[float, ...]:
    """Return those of the `lines` [Hz] that samples at `time` [s] can show: clearly below half their rate."""
    if not lines:
        return ()
    highest = BELOW_NYQUIST * 0.5 / float(np.median(np.diff(time))) if time.size > 1 else 0.0
    return tuple(line for line in lines if line < highest)


def waves_at(time: NDArray[np.float64], lines: Sequence[float]) -> NDArray[np.float64]:
    """Return cosine and sine of each of the `lines` [Hz] at `time` [s], shape (n, 2k)."""
    return np.column_stack([wave(2.0 * np.pi * line * time) for line in lines for wave in (np.cos, np.sin)])


def waves_in(residual: NDArray[np.float64], waves: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the amplitude of each wave in a `residual`, shape (2k,).

    Weighed by a Hann window, so that what a model misses slowly does not leak into them.
    """
    weight = np.sqrt(np.hanning(residual.size + 2)[1:-1])
    return np.asarray(np.linalg.lstsq(weight[:, None] * waves, weight * residual, rcond=DISTINCT)[0])


def _spanned(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of what `columns` span: in less than a period two lines look the same."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, singular > DISTINCT * singular[0]])
