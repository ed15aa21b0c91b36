"""What disturbs a measurement: the sensor's noise, a shaken axis, samples that are not taken on time.

>>> import numpy as np
>>> from servolens.lab import SensorNoise, Surroundings
>>> slow = Surroundings(noise=SensorNoise(deviation=3e-5, autoregression=(0.95,)))
>>> drawn = slow.drawn(np.arange(1000) * 1e-3, np.random.default_rng(1))
>>> drawn.noise.shape, drawn.shaking is None
((1000,), True)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Generator = np.random.Generator

__all__ = ["Drawn", "Jitter", "SensorNoise", "Shaking", "Surroundings"]

START_FORGOTTEN = 1e-9
"""What is left of the start when autoregressive noise is taken to be stationary."""
SLOWEST_POLE = 0.9999
"""Largest modulus of a pole: slower noise never becomes stationary within a record."""
LATEST = 0.45
"""Largest shift of a sample, as a share of the sample time: instants stay in order."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Noise of the position sensor, before it is rounded to the encoder's step.

    ``e[k] = a₁ e[k−1] + a₂ e[k−2] + … + w[k]`` with white normal w, plus a ripple at the mains frequency and perhaps at
    three times it, with a phase of its own in every run.

    Parameters
    ----------
    deviation : float
        Standard deviation of e [m or rad].
    autoregression : tuple of float
        a₁, a₂, …; none for white noise.
    hum, third_harmonic : float
        Amplitudes of the ripple [m or rad].
    mains : float
        Its frequency [Hz].

    Raises
    ------
    InputError
        If a number is outside its range, or the noise would grow without end.
    """

    deviation: float = 0.0
    autoregression: tuple[float, ...] = ()
    hum: float = 0.0
    third_harmonic: float = 0.0
    mains: float = 50.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "autoregression", tuple(float(a) for a in self.autoregression))
        _check("noise: deviation", self.deviation)
        _check("noise: hum", self.hum)
        _check("noise: third_harmonic", self.third_harmonic)
        _check("noise: mains", self.mains, positive=True)
        if not all(math.isfinite(a) for a in self.autoregression) or self.slowest > SLOWEST_POLE:
            raise InputError(
                f"noise: autoregression {self.autoregression} is not stationary; "
                f"its poles must lie within {SLOWEST_POLE}"
            )

    @property
    def slowest(self) -> float:
        """Largest modulus of the poles; 0 for white noise."""
        return float(np.abs(np.roots([1.0, *(-a for a in self.autoregression)])).max(initial=0.0))

    @property
    def is_silent(self) -> bool:
        """Whether there is none of it."""
        return not (self.deviation or self.hum or self.third_harmonic)

    def drawn(self, instants: Array, rng: Generator) -> Array:
        """Return one run's noise at the `instants` [s]."""
        noise = self._coloured(instants.size, rng)
        if self.hum or self.third_harmonic:
            phases = rng.uniform(-math.pi, math.pi, 2)
            turns = 2.0 * math.pi * self.mains * instants
            noise = noise + self.hum * np.sin(turns + phases[0]) + self.third_harmonic * np.sin(3 * turns + phases[1])
        return noise

    def _coloured(self, n: int, rng: Generator) -> Array:
        if not self.autoregression:
            return self.deviation * rng.standard_normal(n)
        from scipy.signal import lfilter

        lead = math.ceil(math.log(START_FORGOTTEN) / math.log(max(self.slowest, 0.1)))
        poles = [1.0, *(-a for a in self.autoregression)]
        response = lfilter([1.0], poles, np.eye(1, lead)[0])
        noise = lfilter([1.0], poles, rng.standard_normal(lead + n))[lead:]
        return np.asarray(self.deviation / math.sqrt(float(response @ response)) * noise, dtype=np.float64)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Shaking:
    """A random acceleration of the axis that knows no input: normal, with correlation ``exp(−|lag|/correlation_time)``.

    The axis is at rest when a record begins, and is shaken from then on.

    Parameters
    ----------
    deviation : float
        Standard deviation [m/s² or rad/s²].
    correlation_time : float
        [s], positive.

    Raises
    ------
    InputError
        If a number is outside its range.
    """

    deviation: float
    correlation_time: float

    def __post_init__(self) -> None:
        _check("shaking: deviation", self.deviation)
        _check("shaking: correlation_time", self.correlation_time, positive=True)

    def drawn(self, n: int, sample_time: float, rng: Generator) -> Array:
        """Return the acceleration at each of `n` samples; between them it is linear."""
        from scipy.signal import lfilter

        kept = math.exp(-sample_time / self.correlation_time)
        pushes = rng.standard_normal(n)
        pushes[1:] *= math.sqrt(-math.expm1(-2.0 * sample_time / self.correlation_time))
        return np.asarray(self.deviation * lfilter([1.0], [1.0, -kept], pushes), dtype=np.float64)

    def position_error(self, rate: float, damping: float) -> float:
        """Return the r.m.s. position that it causes in the loop ``ÿ + damping·ẏ + rate²·y = a``, once stationary.

        With k = rate², c = damping, T the correlation time and s the deviation, the residue theorem gives
        ``s² T (1 + cT)/(k c (1 + cT + kT²))`` for its square.
        """
        k, c, slow = rate * rate, damping, self.correlation_time
        variance = slow * (1.0 + c * slow) / (k * c * (1.0 + c * slow + k * slow * slow))
        return self.deviation * math.sqrt(variance)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Jitter:
    """Samples are taken a little early or late, and the controller runs at those instants.

    Parameters
    ----------
    share : float
        Standard deviation of an instant, as a share of the sample time; shifts do not add up.
    stated : bool
        Whether the time column shows the true instants; else the nominal ones.

    Raises
    ------
    InputError
        If `share` is not in 0 … 0.2.
    """

    share: float
    stated: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.share <= 0.2:
            raise InputError(f"jitter: share must lie between 0 and 0.2, got {self.share!r}")

    def drawn(self, time: Array, rng: Generator) -> Array:
        """Return the true instants of samples that should be taken at `time`; the first one is."""
        h = float(time[1] - time[0])
        shifts = np.clip(self.share * rng.standard_normal(time.size), -LATEST, LATEST)
        shifts[0] = 0.0
        return np.asarray(time + h * shifts, dtype=np.float64)


class Drawn(NamedTuple):
    """What one run meets at each of its n samples.

    Attributes
    ----------
    noise : ndarray, shape (n,) or (n, runs)
        Of the sensor [m or rad].
    shaking : ndarray of the same shape, or None
        Acceleration of the axis, linear between samples [m/s² or rad/s²].
    instants : ndarray, shape (n,), or None
        When the samples are taken [s]; None for the nominal instants.
    """

    noise: Array
    shaking: Array | None = None
    instants: Array | None = None


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """Everything that disturbs a measurement.

    Parameters
    ----------
    noise : SensorNoise
    encoder : float
        Resolution of the position sensor [m or rad], 0 for none.
    shaking : Shaking, optional
    jitter : Jitter, optional
    repeats : int
        How often a hidden campaign does each training run, with fresh noise.

    Raises
    ------
    InputError
        If a number is outside its range.
    """

    noise: SensorNoise = field(default_factory=SensorNoise)
    encoder: float = 1e-5
    shaking: Shaking | None = None
    jitter: Jitter | None = None
    repeats: int = 1

    def __post_init__(self) -> None:
        _check("encoder", self.encoder)
        if self.repeats < 1:
            raise InputError(f"repeats must be at least 1, got {self.repeats}")

    @property
    def is_random(self) -> bool:
        """Whether a run of the same axis differs from the last one."""
        return not self.noise.is_silent or self.shaking is not None or self.jitter is not None

    def drawn(self, time: Array, rng: Generator) -> Drawn:
        """Return what one run meets whose samples should be taken at `time` [s].

        The white noise of a generator stays the same, whatever else disturbs.
        """
        instants = None if self.jitter is None else self.jitter.drawn(time, rng.spawn(1)[0])
        noise = self.noise.drawn(time if instants is None else instants, rng)
        h = float(time[1] - time[0])
        shaking = None if self.shaking is None else self.shaking.drawn(time.size, h, rng)
        return Drawn(noise, shaking, instants)

    def logged(self, time: Array, drawn: Drawn) -> Array:
        """Return the time column of a run: the true instants where they are stated, else those of `time`."""
        return time if self.jitter is None or drawn.instants is None or not self.jitter.stated else drawn.instants


def _check(name: str, value: float, *, positive: bool = False) -> None:
    if not (math.isfinite(value) and value >= 0.0 and (value > 0.0 or not positive)):
        raise InputError(f"{name} must be {'positive' if positive else 'at least 0'} and finite, got {value!r}")
