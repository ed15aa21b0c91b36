"""The physics of laws that are not in the catalogue, see :mod:`servolens.lab.foreign`.

Each is made for one run: ``(scene, size, axis, run)`` draws what belongs to the axis from `axis`, what differs from run
to run from `run`, and remembers nothing of other runs. Sizes are in units of the axis's motion, as in
:mod:`servolens.lab.sizes`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servolens.lab.scene import log_uniform
from servolens.lab.unmodelled import UnmodelledEffect

if TYPE_CHECKING:
    from servolens.lab.scene import Scene

    Dice = np.random.Generator

__all__ = [
    "actuator_resonance",
    "changing_damping",
    "coarse_command",
    "cubic_gain",
    "direction_gain",
    "elastic_buffer",
    "encoder_ripple",
    "even_gain",
    "growing_friction",
    "hanging_load",
    "hysteretic_spring",
    "imbalance",
    "lost_commands",
    "missed_counts",
    "one_sided_dead_zone",
    "position_damping",
    "position_gain",
    "position_inertia",
    "random_drift",
    "random_knocks",
    "root_drag",
    "sample_jitter",
    "second_order_actuator",
    "slew_limit",
    "step_force",
    "supply_ripple",
    "sweeping_force",
    "switching_friction",
    "two_slope_spring",
]


def _sign(value: float) -> float:
    return math.copysign(1.0, value) if value else 0.0


def hysteretic_spring(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    reach, k = 0.3 * scene.step, size * scene.push / (0.3 * scene.step)
    bent, last, slope = 0.0, None, 1.0

    def sample(t: float, x: float, v: float) -> None:  # Bouc–Wen with n = 2, not Dahl's
        nonlocal bent, last, slope
        if last is not None:
            bent += (x - last) * slope
        last, share = x, bent / reach
        slope = 1.0 - share**2 * (0.7 * _sign(v) * _sign(bent) + 0.3)

    return UnmodelledEffect(sample=sample, push=lambda now: k * (bent + slope * (now.position - (last or 0.0))))


def growing_friction(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    travel, last = 0.0, None

    def sample(t: float, x: float, v: float) -> None:
        nonlocal travel, last
        travel, last = travel + (0.0 if last is None else abs(x - last)), x

    return UnmodelledEffect(sample=sample, level=lambda now: size * scene.push * travel / (5.0 * scene.step))


def even_gain(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    return UnmodelledEffect(command=lambda t, u, x: u * (1.0 + size * u / scene.volts))


def cubic_gain(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    return UnmodelledEffect(command=lambda t, u, x: u * (1.0 + size * (u / scene.volts) ** 2))


def position_gain(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    return UnmodelledEffect(command=lambda t, u, x: u * (1.0 + size * x / scene.step))


def direction_gain(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    return UnmodelledEffect(command=lambda t, u, x: u * (1.0 + size * _sign(u)))


def position_damping(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    share = size * scene.damping / scene.step
    return UnmodelledEffect(push=lambda now: share * now.position * now.velocity)


def random_knocks(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    width = 0.1 / scene.rate
    times = run.uniform(0.05, 0.95, 5) * scene.duration
    sizes = size * scene.push * run.choice([-1.0, 1.0], 5) * run.uniform(0.5, 1.5, 5)
    knocks = list(zip(times.tolist(), sizes.tolist(), strict=True))
    return UnmodelledEffect(push=lambda now: sum(a for start, a in knocks if start <= now.time < start + width))


def switching_friction(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    period, phase = scene.duration / float(axis.uniform(2.0, 4.0)), float(run.uniform(0.0, 1.0))
    return UnmodelledEffect(level=lambda now: size * scene.push * ((now.time / period + phase) % 1.0 < 0.5))


def random_drift(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    rates = scene.rate * np.geomspace(0.05, 1.0, 12)
    table = list(zip(rates.tolist(), run.uniform(0.0, 2.0 * math.pi, 12).tolist(), strict=True))
    return UnmodelledEffect(
        push=lambda now: 0.4 * size * scene.push * sum(math.sin(w * now.time + p) for w, p in table)
    )


def imbalance(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    radius, phase = scene.step * log_uniform(axis, 0.02, 0.08), float(axis.uniform(0.0, 6.0))
    share = size * scene.push / scene.speed**2
    return UnmodelledEffect(push=lambda now: share * now.velocity**2 * math.sin(now.position / radius + phase))


def sweeping_force(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    low, high, phase = 0.2 * scene.rate, 3.0 * scene.rate, float(run.uniform(0.0, 6.0))
    slope = (high - low) / scene.duration
    return UnmodelledEffect(
        push=lambda now: size * scene.push * math.sin((low + 0.5 * slope * now.time) * now.time + phase)
    )


def changing_damping(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    share = size * scene.damping / scene.duration
    return UnmodelledEffect(push=lambda now: share * (now.time - 0.5 * scene.duration) * now.velocity)


def two_slope_spring(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    corner, stiffness = float(axis.uniform(0.1, 0.3)) * scene.step, size * scene.rate**2
    return UnmodelledEffect(push=lambda now: stiffness * max(now.position - corner, 0.0))


def elastic_buffer(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    stop, stiffness = float(axis.uniform(0.85, 0.95)) * scene.step, size * scene.rate**2
    return UnmodelledEffect(push=lambda now: stiffness * max(now.position - stop, 0.0))


def root_drag(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    slow = 0.01 * scene.speed
    share = size * scene.push / math.sqrt(scene.speed)
    return UnmodelledEffect(push=lambda now: share * now.velocity / math.sqrt(abs(now.velocity) + slow))


def one_sided_dead_zone(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    width = size * scene.volts
    return UnmodelledEffect(command=lambda t, u, x: max(u - width, 0.0) + min(u, 0.0))


def slew_limit(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    most = scene.volts * scene.rate * scene.sample_time / size
    felt: float | None = None

    def command(t: float, u: float, x: float) -> float:
        nonlocal felt
        felt = 0.0 if felt is None else felt
        felt += min(max(u - felt, -most), most)
        return felt

    return UnmodelledEffect(command=command)


def coarse_command(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    step = size * scene.volts
    return UnmodelledEffect(command=lambda t, u, x: step * math.floor(u / step + 0.5))


def encoder_ripple(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    pitch, phase = scene.step * log_uniform(axis, 0.03, 0.1), float(axis.uniform(0.0, 6.0))
    return UnmodelledEffect(sensor=lambda t, x, v: x + size * scene.step * math.sin(2.0 * math.pi * x / pitch + phase))


def missed_counts(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    times = (run.uniform(0.1, 0.9, 3) * scene.duration).tolist()
    jumps = (size * scene.step * run.choice([-1.0, 1.0], 3)).tolist()
    events = list(zip(times, jumps, strict=True))
    return UnmodelledEffect(sensor=lambda t, x, v: x + sum(jump for since, jump in events if t >= since))


def sample_jitter(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    return UnmodelledEffect(sensor=lambda t, x, v: x + v * size * scene.sample_time * float(run.standard_normal()))


def actuator_resonance(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    turn = min(scene.rate / size * scene.sample_time, 2.5)  # angle of the resonance per sample
    decay = math.exp(-log_uniform(axis, 0.05, 0.2) * turn)
    first, second = 2.0 * decay * math.cos(turn), -decay * decay
    past: list[float] = []

    def command(t: float, u: float, x: float) -> float:
        if not past:
            past.extend([u, u])
        felt = first * past[0] + second * past[1] + (1.0 - first - second) * u
        past[:] = [felt, past[0]]
        return felt

    return UnmodelledEffect(command=command)


def second_order_actuator(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    rate, ratio = scene.rate / size, float(axis.uniform(0.3, 0.9))
    decay, turn = ratio * rate, rate * math.sqrt(1.0 - ratio * ratio)
    # time of the last sample, level of the command since then, and how far the actuator was from it, with its slope
    since, level, off, slope = 0.0, None, 0.0, 0.0

    def ahead(t: float) -> tuple[float, float]:
        fade, angle = math.exp(-decay * (t - since)), turn * (t - since)
        sine = (slope + decay * off) / turn
        return (
            fade * (off * math.cos(angle) + sine * math.sin(angle)),
            fade * (slope * math.cos(angle) - (decay * sine + turn * off) * math.sin(angle)),
        )

    def command(t: float, u: float, x: float) -> float:
        nonlocal since, level, off, slope
        before = u if level is None else level
        off, slope = ahead(t)
        since, level, off = t, u, off + before - u
        return u

    return UnmodelledEffect(command=command, push=lambda now: -scene.gain * ahead(now.time)[0])


def step_force(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    since = float(run.uniform(0.2, 0.8)) * scene.duration
    return UnmodelledEffect(push=lambda now: size * scene.push * (now.time >= since))


def lost_commands(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    held: float | None = None

    def command(t: float, u: float, x: float) -> float:
        nonlocal held
        held = u if held is None or run.random() >= size else held
        return held

    return UnmodelledEffect(command=command)


def position_inertia(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    share = size / scene.step
    return UnmodelledEffect(
        command=lambda t, u, x: u * (1.0 - share * x),
        push=lambda now: -scene.damping * share * now.position * now.velocity,
    )


def supply_ripple(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    rate, phase = scene.rate * log_uniform(axis, 1.0, 4.0), float(run.uniform(0.0, 6.0))
    return UnmodelledEffect(command=lambda t, u, x: u * (1.0 + size * math.sin(rate * t + phase)))


def hanging_load(scene: Scene, size: float, axis: Dice, run: Dice) -> UnmodelledEffect:
    rate, past = scene.rate * float(axis.uniform(0.3, 0.6)), [0.0, 0.0, 0.0]

    def sample(t: float, x: float, v: float) -> None:  # semi-implicit Euler: slow against the samples
        h, swing, speed = scene.sample_time, past[0], past[1]
        speed += h * (-rate * rate * swing - 0.1 * rate * speed - (v - past[2]) / h)
        past[:] = [swing + h * speed, speed, v]

    return UnmodelledEffect(sample=sample, push=lambda now: -size * rate * rate * past[0])
