"""Sizes of the catalogue's effects that make sense on a given axis: their shape is drawn, one size is left to choose.

The size is the effect's strength in units of the axis's own motion: of the motor's peak acceleration, of the peak
voltage, of the step, of the loop's time scale. The larger it is, the more of the effect there is.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.lab.laws import KNOTS
from servolens.lab.linear_view import LoggedLoop, linear_response
from servolens.lab.scene import log_uniform

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from servolens.lab.scene import Scene

    Values = Mapping[str, float]
    Dice = np.random.Generator

__all__ = ["SIZES", "Sizes", "dice_number"]


class Sizes(NamedTuple):
    """What an effect may be on a scene.

    Attributes
    ----------
    low, high : float
        The smallest and largest size that make sense.
    per_mille : float
        Size at which the best linear model misses about a thousandth of the step.
    shape : callable
        (scene, dice) → (size → parameters): draws all but the size.
    """

    low: float
    high: float
    per_mille: float
    shape: Callable[[Scene, Dice], Callable[[float], Values]]


def dice_number(name: str) -> int:
    """Return the number of an effect that its shape is drawn by; it does not change when effects are added."""
    return sorted(SIZES, key=lambda one: (one in ADDED_LATER, one)).index(name)


def _side(dice: Dice) -> float:
    return 1.0 if dice.random() < 0.5 else -1.0


def _phase(dice: Dice) -> float:
    return float(dice.uniform(-math.pi, math.pi))


def _asymmetric_friction(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    tilt = _side(dice) * float(dice.uniform(0.25, 0.8))
    return lambda s: {
        "level_positive": s * scene.push * (1.0 + tilt),
        "level_negative": s * scene.push * (1.0 - tilt),
    }


def _stribeck_friction(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    share = float(dice.uniform(0.5, 1.5)) if dice.random() < 0.8 else float(dice.uniform(-0.8, -0.5))
    speed = scene.speed * log_uniform(dice, 0.01, 0.08)
    return lambda s: {
        "level": s * scene.push,
        "static_excess": s * scene.push * share,
        "stribeck_speed": speed,
    }


def _velocity_decay_damping(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    fade = float(dice.uniform(3.0, 8.0)) / scene.speed
    return lambda s: {"alpha1": s * scene.rate, "alpha2": fade}


def _asymmetric_damping(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    side = _side(dice)
    return lambda s: {"damping_difference": side * s * 2.0 * scene.damping}


def _pendulum_gravity(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    phase = _phase(dice)
    return lambda s: {"amplitude": s * scene.push, "phase": phase}


def _cogging(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    pitch, phase = scene.step * log_uniform(dice, 0.06, 0.5), _phase(dice)
    return lambda s: {"amplitude": s * scene.push, "pitch": pitch, "phase": phase}


def _position_friction(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    centre, width = scene.step * float(dice.uniform(0.1, 0.6)), scene.step * float(dice.uniform(0.05, 0.2))
    return lambda s: {"level": s * scene.push, "centre": centre, "width": width}


def _presliding(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    bend = scene.step * log_uniform(dice, 0.005, 0.05)
    return lambda s: {"stiffness": s * scene.push / bend, "level": s * scene.push}


def _periodic_disturbance(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    frequency, phase = scene.rate / (2.0 * math.pi) * log_uniform(dice, 0.3, 2.5), _phase(dice)
    return lambda s: {"amplitude": s * scene.push, "frequency": frequency, "phase": phase}


def _gain_drift(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    side = 1.0 if dice.random() < 0.3 else -1.0
    return lambda s: {"rate": side * s / scene.duration}


def _constant_force(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    side = _side(dice)
    return lambda s: {"acceleration": side * s * scene.push}


def _speed_servo(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    proportional = scene.damping * float(dice.uniform(0.7, 0.95))
    per_volt = scene.gain / proportional
    return lambda s: {"speed_per_volt": per_volt, "proportional": proportional, "integral": s * proportional**2}


def _backlash(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    share = float(dice.uniform(0.15, 0.5))
    return lambda s: {"gap": s * scene.step, "load_share": share}


def _flexible_coupling(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    ratio, share = log_uniform(dice, 0.02, 0.1), float(dice.uniform(0.2, 0.6))
    return lambda s: {"frequency": scene.rate / (2.0 * math.pi * s), "damping_ratio": ratio, "load_ratio": share}


def _friction_map(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    shares = dice.uniform(0.3, 1.7, 2 * KNOTS).tolist()
    names = [f"{side}_{i}" for side in ("positive", "negative") for i in range(KNOTS)]
    low, high = _reach(scene, reference=True)
    return lambda s: {
        **{name: s * scene.push * share for name, share in zip(names, shares, strict=True)},
        "low": low,
        "high": high,
    }


def _end_stop(scene: Scene, dice: Dice) -> Callable[[float], Values]:
    low, high = _reach(scene)
    if dice.random() < 0.5:
        return lambda s: {"low": low - scene.step, "high": high - s * scene.step}
    return lambda s: {"low": low + s * scene.step, "high": high + scene.step}


def _reach(scene: Scene, *, reference: bool = False) -> tuple[float, float]:
    """Return the ends of the travel of the linear axis, or of its references, in the training runs."""
    ends = []
    for bench in scene.training:
        seen = LoggedLoop(bench.controller, scene.sample_time, np.array([bench.start]), bench.reference, closed=True)
        run = bench.reference if reference else linear_response(seen, scene.gain, scene.damping)
        ends += [float(np.min(run)), float(np.max(run))]
    return min(ends), max(ends)


SIZES = {
    "coulomb_friction": Sizes(1e-4, 0.35, 0.0005, lambda scene, _: lambda s: {"level": s * scene.push}),
    "asymmetric_friction": Sizes(1e-4, 0.25, 0.00043, _asymmetric_friction),
    "stribeck_friction": Sizes(1e-4, 0.2, 0.00046, _stribeck_friction),
    "velocity_decay_damping": Sizes(1e-3, 4.0, 0.046, _velocity_decay_damping),
    "asymmetric_damping": Sizes(1e-4, 0.7, 0.008, _asymmetric_damping),
    "quadratic_drag": Sizes(1e-3, 3.0, 0.034, lambda scene, _: lambda s: {"drag": s * scene.rate / scene.speed}),
    "return_spring": Sizes(1e-4, 0.6, 0.0011, lambda scene, _: lambda s: {"stiffness": s * scene.rate**2}),
    "hardening_spring": Sizes(
        1e-4, 1.5, 0.0013, lambda scene, _: lambda s: {"cubic_stiffness": s * (scene.rate / scene.step) ** 2}
    ),
    "constant_force": Sizes(1e-5, 0.2, 0.00032, _constant_force),
    "pendulum_gravity": Sizes(1e-4, 0.4, 0.00049, _pendulum_gravity),
    "cogging": Sizes(1e-4, 0.3, 0.00051, _cogging),
    "position_friction": Sizes(1e-4, 0.5, 0.0019, _position_friction),
    "presliding": Sizes(1e-4, 0.3, 0.00057, _presliding),
    "periodic_disturbance": Sizes(1e-5, 0.2, 0.0018, _periodic_disturbance),
    "gain_drift": Sizes(1e-4, 0.6, 0.022, _gain_drift),
    "dead_zone": Sizes(1e-4, 0.3, 0.00047, lambda scene, _: lambda s: {"width": s * scene.volts}),
    "saturation": Sizes(1e-3, 0.6, 0.14, lambda scene, _: lambda s: {"limit": (1.0 - s) * scene.volts}),
    "force_limit": Sizes(1e-3, 0.6, 0.19, lambda scene, _: lambda s: {"acceleration": (1.0 - s) * scene.push}),
    "delay": Sizes(0.05, 20.0, 0.41, lambda scene, _: lambda s: {"time": s * scene.sample_time}),
    "actuator_lag": Sizes(1e-3, 0.3, 0.012, lambda scene, _: lambda s: {"time_constant": s / scene.rate}),
    "speed_servo": Sizes(1e-3, 2.0, 0.034, _speed_servo),
    "load_friction": Sizes(1e-4, 0.5, 0.004, lambda scene, _: lambda s: {"share": s}),
    "friction_map": Sizes(1e-4, 0.25, 0.0005, _friction_map),
    "end_stop": Sizes(1e-4, 0.35, 0.02, _end_stop),
    "backlash": Sizes(1e-5, 0.06, 0.0034, _backlash),
    "flexible_coupling": Sizes(0.01, 0.4, 0.054, _flexible_coupling),
    "sensor_lag": Sizes(1e-3, 0.3, 0.013, lambda scene, _: lambda s: {"time_constant": s / scene.rate}),
}
"""Each effect of the catalogue."""
ADDED_LATER = ("end_stop", "friction_map", "load_friction")
"""Effects that are numbered behind the others, so that older seeds still give the same campaigns."""
