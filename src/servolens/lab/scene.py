"""An axis and its experiments as an engineer might have met them, all drawn from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.lab.linear_view import LoggedLoop, linear_response
from servolens.lab.loop import Bench
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.record import LengthUnit

    Generator = np.random.Generator

__all__ = ["NOISES", "Scene", "draw_scene", "log_uniform"]

NOISES = {"low": 1e-5, "medium": 3e-5, "high": 1e-4}
"""Standard deviation of the sensor's noise, as a share of the largest step."""
PEAK_SHARE = 0.05
"""Largest product of the loops' frequency and an integration step."""
STEP_TIMES_QUICKER_RATE = 0.25
"""The same of whatever is quicker, a coupling or a contact: errors stay far below the noise."""

AT_END = 0.999
"""Place within a gap of a motor that rests at an end of it."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A linear axis, its loops and the sizes of its motion, which sizes of effects are measured by.

    Attributes
    ----------
    gain, damping : float
        β [m/s²/V] and c [1/s].
    rate : float
        Typical natural frequency of the loops [rad/s].
    step : float
        Largest level of the references [m or rad].
    speed, push, volts : float
        Peaks of |ẏ|, of the motor's |acceleration| and of |V| in the training runs of the linear axis.
    length_unit, command_unit : str
    noise, encoder : float
        Standard deviation and resolution of the position sensor [m or rad].
    training, heldout : tuple of Bench
    """

    gain: float
    damping: float
    rate: float
    step: float
    speed: float
    push: float
    volts: float
    length_unit: LengthUnit
    command_unit: str
    noise: float
    encoder: float
    training: tuple[Bench, ...]
    heldout: tuple[Bench, ...]

    @property
    def sample_time(self) -> float:
        """Of every record [s]."""
        return float(self.training[0].time[1])

    @property
    def duration(self) -> float:
        """Of the longest training record [s]."""
        return max(float(bench.time[-1]) for bench in self.training)

    @property
    def floor(self) -> float:
        """R.m.s. of noise and quantisation [m or rad]."""
        return math.hypot(self.noise, self.encoder / math.sqrt(12.0))


def draw_scene(
    rng: Generator,
    *,
    records: int | None,
    heldout: int | None,
    noise: str | float | None,
    length_unit: LengthUnit | None,
    smooth: bool = False,
) -> Scene:
    """Draw what is not asked for."""
    unit: LengthUnit = length_unit or ("m" if rng.random() < 0.7 else "rad")
    command_unit = str(rng.choice(["V", "V", "V", "A", "%"]))
    step = _rounded(log_uniform(rng, 0.02, 0.5) if unit == "m" else log_uniform(rng, 0.4, 3.0), 2)
    gain = log_uniform(rng, 0.5, 50.0) * (0.1 if command_unit == "%" else 1.0)
    h = float(rng.choice([5e-4, 1e-3, 1e-3, 2e-3]))
    samples = int(rng.integers(1700, 3500))
    rate = float(rng.uniform(14.0, 26.0)) / (samples * h / 2.5)
    damping = 2.0 * float(rng.uniform(0.25, 0.55)) * rate
    level, resolution = _sensor(rng, noise, step)
    count = int(rng.integers(2, 5)) if records is None else records
    held = int(rng.integers(1, 3)) if heldout is None else heldout
    share = 1.0 if rng.random() < 0.6 else _rounded(float(rng.uniform(0.2, 0.8)), 2)
    benches = [
        _bench(rng, i, gain=gain, damping=damping, rate=rate * factor, step=step, h=h, samples=samples, share=share,
               encoder=resolution, smooth=smooth)
        for i, factor in enumerate(_factors(rng, count + held))
    ]  # fmt: skip
    benches = [replace(bench, place=place) for bench, place in zip(benches, _places(rng, len(benches)), strict=True)]
    training, kept = tuple(benches[:count]), tuple(benches[count:])
    speed, push, volts = _peaks(training, gain, damping, h)
    return Scene(
        gain=gain,
        damping=damping,
        rate=rate,
        step=step,
        speed=speed,
        push=push,
        volts=volts,
        length_unit=unit,
        command_unit=command_unit,
        noise=level,
        encoder=resolution,
        training=training,
        heldout=kept,
    )


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is evenly distributed."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _sensor(rng: Generator, noise: str | float | None, step: float) -> tuple[float, float]:
    """Return noise and resolution, comparable in size."""
    if isinstance(noise, str):
        level = step * NOISES[noise] * float(rng.uniform(0.8, 1.25))
    else:
        level = step * log_uniform(rng, 1e-5, 1e-4) if noise is None else noise
    return level, _rounded(level * log_uniform(rng, 0.5, 2.0), 1)


def _factors(rng: Generator, count: int) -> Sequence[float]:
    """Return how much quicker than the typical loop each is; no two alike, and in no order."""
    spread = np.exp(np.linspace(math.log(0.7), math.log(1.45), count)) if count > 1 else np.ones(1)
    return [float(factor) for factor in rng.permutation(spread * rng.uniform(0.96, 1.04, count))]


def _places(rng: Generator, count: int) -> Sequence[float]:
    """Return where the motor of each run rests within a gap: anywhere, and in one of three runs at an end."""
    found = np.clip(rng.uniform(-1.5, 1.5, count), -AT_END, AT_END)
    return [float(place) for place in found]


def _bench(rng: Generator, i: int, *, gain: float, damping: float, rate: float, h: float, **own: Any) -> Bench:
    """Draw gains, levels and length of one run; every second one at least is left underdamped, without kd."""
    ratio = float(rng.uniform(0.6, 1.0)) if i % 2 else float(rng.uniform(0.2, 0.5))
    wanted = 2.0 * ratio * rate - damping
    kp, kd = _rounded(rate * rate / gain, 3), _rounded(max(wanted, 0.0) / gain, 2)
    reference, start = _staircase(rng, i, own["step"], round(own["samples"] * float(rng.uniform(0.88, 1.14))))
    if own["smooth"]:
        reference = _smooth(rng, reference, start)
    time = h * np.arange(reference.size, dtype=np.float64)
    time.flags.writeable = reference.flags.writeable = False
    return Bench(
        controller=Controller(kp=kp, kd=kd, derivative_filter=own["share"]),
        time=time,
        reference=reference,
        feedforward=None,
        start=start,
        encoder=own["encoder"],
        voltage_limit=None,
        substep=min(h, PEAK_SHARE / rate),
        angle=STEP_TIMES_QUICKER_RATE,
    )


def _staircase(rng: Generator, i: int, step: float, samples: int) -> tuple[Any, float]:
    """Return a square wave of two or three levels in both directions, perhaps after a rest, and where it starts."""
    side = 1.0 if i % 2 == 0 else -1.0
    size = step * (1.0 if i == 0 else float(rng.uniform(0.45, 1.0)))
    shares = [1.0, float(rng.uniform(-0.5, 0.2)), float(rng.uniform(0.55, 0.95))][: int(rng.integers(2, 4))]
    start = 0.0 if rng.random() < 0.75 else -0.2 * side * size
    rest = round(samples * float(rng.uniform(0.03, 0.1))) if rng.random() < 0.5 else 0
    each = (samples - rest) // len(shares)
    levels = [_rounded(side * size * share, 3) for share in shares]
    return np.concatenate([np.full(rest, start), np.repeat(levels, each)]), start


def _smooth(rng: Generator, steps: Any, start: float) -> Any:
    """Return a reference that never jumps, about as large: ramps or S-curves between the levels, or a sine."""
    kind = str(rng.choice(["ramps", "s-curves", "sine"]))
    if kind == "sine":
        turns = float(rng.uniform(1.5, 4.0)) * np.linspace(0.0, 1.0, steps.size)
        return start + (float(np.max(steps)) - float(np.min(steps))) / 2.0 * np.sin(2.0 * np.pi * turns)
    wide = round(steps.size * float(rng.uniform(0.08, 0.2)))
    for width in (wide,) if kind == "ramps" else (wide, max(wide // 3, 2)):
        before = np.concatenate([np.full(width - 1, start), steps])
        steps = np.convolve(before, np.full(width, 1.0 / width), mode="valid")
    return steps


def _peaks(benches: Sequence[Bench], gain: float, damping: float, h: float) -> tuple[float, float, float]:
    """Return the largest speed, acceleration by the motor, and command of the linear axis."""
    speed = volts = 0.0
    for bench in benches:
        still = np.array([bench.start])
        response = linear_response(LoggedLoop(bench.controller, h, still, bench.reference, closed=True), gain, damping)
        speed = max(speed, float(np.abs(np.diff(response)).max()) / h)
        volts = max(volts, float(np.abs(bench.controller.kp * (bench.reference - response)).max()))
    return speed, abs(gain) * volts, volts


def _rounded(value: float, digits: int) -> float:
    """Return the number as people set it, with so many significant digits."""
    return float(f"{value:.{digits - 1}e}")
