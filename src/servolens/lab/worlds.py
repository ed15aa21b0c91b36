"""The worlds of the laboratory: what may disturb a measurement, each with its sizes drawn from a seed."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.errors import InputError, names_like
from servolens.lab.disturbances import Jitter, SensorNoise, Shaking, Surroundings

if TYPE_CHECKING:
    from collections.abc import Callable

    Generator = np.random.Generator

__all__ = ["WORLDS", "Usual", "checked_world", "draw_surroundings", "surroundings"]


class Usual(NamedTuple):
    """A usual sensor, white noise and resolution [m or rad]; travel; rate [rad/s] and damping [1/s] of the loop."""

    noise: float
    encoder: float
    travel: float
    rate: float
    damping: float


def surroundings(
    world: str,
    seed: int,
    *,
    noise: float = 1e-5,
    encoder: float = 1e-5,
    travel: float = 0.1,
    rate: float = 11.0,
    damping: float = 10.0,
) -> Surroundings:
    """Draw the surroundings of a world.

    Parameters
    ----------
    world : str
        A name of :data:`WORLDS`.
    seed : int
        At least 0. The same call gives the same surroundings.
    noise, encoder : float
        Standard deviation and resolution of a usual sensor [m or rad], which the world's are measured by.
    travel : float
        Of the axis [m or rad]; a coarse encoder shows a share of it.
    rate, damping : float
        Natural frequency [rad/s] and damping [1/s] of the closed loop, ``√(gain·kp)`` and ``damping + gain·kd``: the
        axis is shaken so hard that its position errs by some times the noise.

    Returns
    -------
    Surroundings

    Raises
    ------
    InputError
        If there is no such world, or a number is outside its range.

    Examples
    --------
    >>> from servolens import lab
    >>> slow = lab.surroundings("coloured", seed=1)
    >>> 0.8 <= slow.noise.slowest <= 0.99
    True
    >>> record = lab.step_record(lab.NLM3, kp=60, seed=1, setup=lab.Setup(surroundings=slow))
    """
    checked_world(world)
    for name, value in (("travel", travel), ("rate", rate), ("damping", damping)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be positive and finite, got {value!r}")
    return draw_surroundings(world, np.random.default_rng(seed), Usual(noise, encoder, travel, rate, damping))


def draw_surroundings(world: str, rng: Generator, usual: Usual) -> Surroundings:
    """Return a world's surroundings, measured by what is `usual`."""
    return _MAKERS[world](rng, usual)


def checked_world(world: str) -> str:
    """Return the name of a world; refuse what is none."""
    if world not in WORLDS:
        raise InputError(f"no world {world[:40]!r}; {names_like(world, WORLDS, 'there are')}")
    return world


def _white(rng: Generator, usual: Usual) -> Surroundings:
    return Surroundings(noise=SensorNoise(deviation=usual.noise), encoder=usual.encoder)


def _coloured(rng: Generator, usual: Usual) -> Surroundings:
    """One pole whose distance from 1 is log-uniform; in a third of the draws a second, quicker one."""
    slow = 1.0 - _log_uniform(rng, 0.01, 0.2)
    quick = float(rng.uniform(0.2, 0.7))
    own = (slow + quick, -slow * quick) if rng.random() < 1 / 3 else (slow,)
    return Surroundings(noise=SensorNoise(deviation=usual.noise, autoregression=own), encoder=usual.encoder)


def _hum(rng: Generator, usual: Usual) -> Surroundings:
    mains, hum = float(rng.choice([50.0, 60.0])), usual.noise * _log_uniform(rng, 0.7, 5.0)
    third = hum * float(rng.uniform(0.2, 0.6)) if rng.random() < 0.5 else 0.0
    noise = SensorNoise(deviation=usual.noise, hum=hum, third_harmonic=third, mains=mains)
    return Surroundings(noise=noise, encoder=usual.encoder)


def _coarse(rng: Generator, usual: Usual) -> Surroundings:
    encoder = usual.travel * _log_uniform(rng, 5e-5, 4e-4)
    return Surroundings(noise=SensorNoise(deviation=encoder / float(rng.uniform(10.0, 30.0))), encoder=encoder)


def _jittered(rng: Generator, usual: Usual) -> Surroundings:
    jitter = Jitter(share=float(rng.uniform(0.01, 0.05)), stated=bool(rng.random() < 0.5))
    return Surroundings(noise=SensorNoise(deviation=usual.noise), encoder=usual.encoder, jitter=jitter)


def _shaken(rng: Generator, usual: Usual) -> Surroundings:
    error = usual.noise * _log_uniform(rng, 3.0, 20.0)
    unit = Shaking(deviation=1.0, correlation_time=_log_uniform(rng, 0.2, 5.0) / usual.rate)
    strength = error / unit.position_error(usual.rate, usual.damping)
    shaking = Shaking(deviation=strength, correlation_time=unit.correlation_time)
    return Surroundings(noise=SensorNoise(deviation=usual.noise), encoder=usual.encoder, shaking=shaking)


def _repeated(rng: Generator, usual: Usual) -> Surroundings:
    repeats = int(rng.integers(2, 4))
    own = (_white if rng.random() < 0.5 else _coloured)(rng, usual)
    return Surroundings(noise=own.noise, encoder=own.encoder, repeats=repeats)


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


_MAKERS: dict[str, Callable[[Generator, Usual], Surroundings]] = {
    "white": _white,
    "coloured": _coloured,
    "hum": _hum,
    "coarse": _coarse,
    "jittered": _jittered,
    "shaken": _shaken,
    "repeated": _repeated,
}
WORLDS = MappingProxyType(
    {
        "white": "White sensor noise and an encoder about as coarse.",
        "coloured": "Sensor noise that changes slowly: autoregressive, with a pole between 0.8 and 0.99.",
        "hum": "A ripple of the sensor at 50 or 60 Hz, half of the time with its third harmonic, beside white noise.",
        "coarse": "An encoder ten to thirty times coarser than its noise.",
        "jittered": "Samples that are 1 to 5 % of their interval early or late; half of the logs state when.",
        "shaken": "A random force on the axis, which moves it by 3 to 20 times the sensor's noise.",
        "repeated": "Each training run done two or three times, with white or with slow noise.",
    }
)
"""Every world by its name, with a sentence about it."""
