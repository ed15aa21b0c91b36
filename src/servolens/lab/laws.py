"""What a virtual axis can do, each effect as a function of one instant.

A law is written with operators and the functions of the namespace ``m``: :data:`FLOATS` for one run, :data:`ARRAYS` for
many at once. The names and parameters are those of the toolbox; the physics is this module's own. Effects that have a
memory of their own or split the axis in two have no function here: :mod:`servolens.lab.axis` carries them.

To add a force or a friction: write its function, add its line to :data:`LAWS`.
"""

from __future__ import annotations

import math
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

__all__ = [
    "ARRAYS",
    "EXTERNAL",
    "FADED",
    "FLOATS",
    "KNOTS",
    "LAWS",
    "LOAD_DRAG",
    "Instant",
    "Law",
    "Range",
    "across",
    "contact_pace",
]

USUAL_CONTACT = {"contact_frequency": 1000.0 / math.pi, "contact_damping": 1.0}
"""Of hard contacts: frequency [Hz], free–free, of two masses pressed together at the end of the lost motion; of the
whole mass in an end stop; and damping ratio."""
EXTERNAL = frozenset(
    {"return_spring", "hardening_spring", "constant_force", "pendulum_gravity", "cogging", "periodic_disturbance"}
)
"""Forces that depend on position and time only: a gear transmits them."""
KNOTS = 5
"""Of a friction map."""
LOAD_DRAG = 2.0
"""Viscous drag of a load behind lost motion, per unit of its own mass [1/s]."""
FADED = 12.0
"""exp(−12) is 6e-6: what fades like this no longer needs short steps."""

FLOATS = SimpleNamespace(
    exp=math.exp,
    sin=math.sin,
    copysign=math.copysign,
    floor=math.floor,
    maximum=max,
    minimum=min,
    where=lambda condition, yes, no: yes if condition else no,
    sign=lambda value: 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0,
    any=bool,
)
"""The functions that laws are written with, for plain floats."""
ARRAYS = SimpleNamespace(
    exp=np.exp,
    sin=np.sin,
    copysign=np.copysign,
    floor=np.floor,
    maximum=np.maximum,
    minimum=np.minimum,
    where=np.where,
    sign=np.sign,
    any=np.any,
)
"""The same for arrays, one element a run."""


class Instant(NamedTuple):
    """Position, velocity, speed |v|, direction of motion ±1 (0 at rest) and time of the motor, SI.

    `speed` is direction·velocity: it goes on smoothly, below 0, where a trial step oversteps a reversal.
    """

    position: Any
    velocity: Any
    speed: Any
    direction: Any
    time: Any


class Range(NamedTuple):
    """What a parameter may be: from `low` to `high`, or strictly between them where `within`."""

    low: float = -math.inf
    high: float = math.inf
    within: bool = False

    def holds(self, value: float) -> bool:
        """Tell whether `value` is admissible."""
        return self.low < value < self.high if self.within else self.low <= value <= self.high

    def __str__(self) -> str:
        if math.isfinite(self.high):
            return f"lie between {self.low:g} and {self.high:g}"
        return f"be {'above' if self.within else 'at least'} {self.low:g}"


ANY, NOT_NEGATIVE, POSITIVE, SHARE = Range(), Range(0.0), Range(0.0, within=True), Range(0.0, 1.0, within=True)
FRACTION = Range(0.0, 0.999)
CONTACT = {"contact_frequency": POSITIVE, "contact_damping": NOT_NEGATIVE}


class Law(NamedTuple):
    """One effect: where it acts, its numbers, its function.

    Attributes
    ----------
    kind : str
        ``"force"``: function (instant, p, m) → acceleration that is subtracted. ``"friction"``: the same → level of dry
        friction. ``"command"``: (command, p, m) → what is left of the held command; these act in the order of
        :data:`LAWS`. ``"memory"``: carried by the axis, no function.
    parameters : mapping of str to Range
        SI.
    pace : callable, optional
        p → the quickest rate that the effect brings in [1/s].
    haste : callable, optional
        (p, |x|, |v|, |acceleration|, m) → the rate at which it changes just now [1/s], where that hangs on the motion.
    usual : mapping of str to float
        Values of the parameters that need not be given.
    """

    kind: Literal["force", "friction", "command", "memory"]
    parameters: Mapping[str, Range]
    function: Callable[[Any, Any, Any], Any] | None = None
    pace: Callable[[Any], float] | None = None
    haste: Callable[[Any, Any, Any, Any, Any], Any] | None = None
    usual: Mapping[str, float] = MappingProxyType({})

    def numbers(self, given: Mapping[str, float]) -> SimpleNamespace:
        """Return all numbers of the effect, of which some are `given`."""
        return SimpleNamespace(**{**self.usual, **given})


def contact_pace(p: Any) -> float:
    """Return the quickest rate of a contact [1/s]."""
    return float(2.0 * math.pi * p.contact_frequency * max(1.0, 2.0 * p.contact_damping - 1.0))


def _saturation(command: Any, p: Any, m: Any) -> Any:
    over = abs(command) - p.limit
    return command - (over > 0.0) * m.copysign(over, command)


def _dead_zone(command: Any, p: Any, m: Any) -> Any:
    over = abs(command) - p.width
    return (over > 0.0) * m.copysign(over, command)


def _velocity_decay_damping(instant: Instant, p: Any, m: Any) -> Any:
    return p.alpha1 * m.exp(m.minimum(-p.alpha2 * instant.speed, 1.0)) * instant.velocity


def _asymmetric_damping(instant: Instant, p: Any, m: Any) -> Any:
    return 0.5 * p.damping_difference * instant.direction * instant.velocity


def _quadratic_drag(instant: Instant, p: Any, m: Any) -> Any:
    return p.drag * instant.speed * instant.velocity


def _return_spring(instant: Instant, p: Any, m: Any) -> Any:
    return p.stiffness * instant.position


def _hardening_spring(instant: Instant, p: Any, m: Any) -> Any:
    return p.cubic_stiffness * instant.position * instant.position * instant.position


def _constant_force(instant: Instant, p: Any, m: Any) -> Any:
    return p.acceleration


def _pendulum_gravity(instant: Instant, p: Any, m: Any) -> Any:
    return p.amplitude * m.sin(instant.position + p.phase)


def _cogging(instant: Instant, p: Any, m: Any) -> Any:
    return p.amplitude * m.sin(2.0 * math.pi / p.pitch * instant.position + p.phase)


def _periodic_disturbance(instant: Instant, p: Any, m: Any) -> Any:
    return p.amplitude * m.sin(2.0 * math.pi * p.frequency * instant.time + p.phase)


def _coulomb_friction(instant: Instant, p: Any, m: Any) -> Any:
    return p.level


def _asymmetric_friction(instant: Instant, p: Any, m: Any) -> Any:
    return m.where(instant.direction > 0.0, p.level_positive, p.level_negative)


def _stribeck_friction(instant: Instant, p: Any, m: Any) -> Any:
    return p.level + p.static_excess * m.exp(m.minimum(-instant.speed / p.stribeck_speed, 1.0))


def _position_friction(instant: Instant, p: Any, m: Any) -> Any:
    away = (instant.position - p.centre) / p.width
    return p.level * m.exp(-away * away)


def _friction_map(instant: Instant, p: Any, m: Any) -> Any:
    place = (KNOTS - 1) * (instant.position - p.low) / (p.high - p.low)
    levels = []
    for side in ("positive", "negative"):
        knots = [getattr(p, f"{side}_{i}") for i in range(KNOTS)]
        level = knots[0]
        for i in range(KNOTS - 1):
            level = level + (knots[i + 1] - knots[i]) * m.minimum(m.maximum(place - i, 0.0), 1.0)
        levels.append(level)
    return m.where(instant.direction > 0.0, *levels)


def across(length: float, speed: Any, acceleration: Any, m: Any) -> Any:
    """Return the rate at which `length` is crossed, from rest too."""
    return m.maximum(speed / length, (acceleration / length) ** 0.5)


def _stribeck_haste(p: Any, x: Any, speed: Any, acceleration: Any, m: Any) -> Any:
    beyond = m.maximum(speed - FADED * p.stribeck_speed, 0.0)
    return 0.4 * acceleration / (p.stribeck_speed + 4.0 * beyond)


def _root(*names: str) -> Callable[[Any], float]:
    """Return p → the square root of the product of the parameters `names`, without their signs."""
    return lambda p: math.sqrt(math.prod(abs(getattr(p, name)) for name in names))


LAWS = {
    "saturation": Law("command", {"limit": NOT_NEGATIVE}, _saturation),
    "dead_zone": Law("command", {"width": NOT_NEGATIVE}, _dead_zone),
    "delay": Law("memory", {"time": NOT_NEGATIVE}),
    "actuator_lag": Law("memory", {"time_constant": NOT_NEGATIVE}),
    "gain_drift": Law("memory", {"rate": ANY}),
    "force_limit": Law("memory", {"acceleration": NOT_NEGATIVE}),
    "speed_servo": Law(
        "memory",
        {"speed_per_volt": ANY, "proportional": POSITIVE, "integral": NOT_NEGATIVE},
        pace=lambda p: p.proportional + math.sqrt(p.integral),
    ),
    "velocity_decay_damping": Law(
        "force",
        {"alpha1": ANY, "alpha2": NOT_NEGATIVE},
        _velocity_decay_damping,
        pace=lambda p: abs(p.alpha1),
    ),
    "asymmetric_damping": Law(
        "force", {"damping_difference": ANY}, _asymmetric_damping, pace=lambda p: 0.5 * abs(p.damping_difference)
    ),
    "quadratic_drag": Law(
        "force",
        {"drag": ANY},
        _quadratic_drag,
        haste=lambda p, x, speed, acceleration, m: 2.0 * abs(p.drag) * speed,
    ),
    "return_spring": Law("force", {"stiffness": ANY}, _return_spring, pace=_root("stiffness")),
    "hardening_spring": Law(
        "force",
        {"cubic_stiffness": ANY},
        _hardening_spring,
        haste=lambda p, x, speed, acceleration, m: (3.0 * abs(p.cubic_stiffness)) ** 0.5 * x,
    ),
    "constant_force": Law("force", {"acceleration": ANY}, _constant_force),
    "pendulum_gravity": Law("force", {"amplitude": ANY, "phase": ANY}, _pendulum_gravity, pace=_root("amplitude")),
    "cogging": Law(
        "force",
        {"amplitude": ANY, "pitch": POSITIVE, "phase": ANY},
        _cogging,
        pace=lambda p: math.sqrt(2.0 * math.pi * abs(p.amplitude) / p.pitch),
        haste=lambda p, x, speed, acceleration, m: 0.4 * across(p.pitch / (2.0 * math.pi), speed, acceleration, m),
    ),
    "periodic_disturbance": Law(
        "force",
        {"amplitude": ANY, "frequency": NOT_NEGATIVE, "phase": ANY},
        _periodic_disturbance,
        pace=lambda p: 2.0 * math.pi * p.frequency,
    ),
    "presliding": Law(
        "memory",
        {"stiffness": NOT_NEGATIVE, "level": NOT_NEGATIVE},
        pace=_root("stiffness"),
    ),
    "coulomb_friction": Law("friction", {"level": NOT_NEGATIVE}, _coulomb_friction),
    "asymmetric_friction": Law(
        "friction", {"level_positive": NOT_NEGATIVE, "level_negative": NOT_NEGATIVE}, _asymmetric_friction
    ),
    "stribeck_friction": Law(
        "friction",
        {"level": NOT_NEGATIVE, "static_excess": ANY, "stribeck_speed": POSITIVE},
        _stribeck_friction,
        pace=lambda p: abs(p.static_excess) / p.stribeck_speed,
        haste=_stribeck_haste,
    ),
    "position_friction": Law(
        "friction",
        {"level": NOT_NEGATIVE, "centre": ANY, "width": POSITIVE},
        _position_friction,
        haste=lambda p, x, speed, acceleration, m: 0.4 * across(p.width, speed, acceleration, m),
    ),
    "load_friction": Law("memory", {"share": FRACTION}),
    "friction_map": Law(
        "friction",
        {f"{side}_{i}": NOT_NEGATIVE for side in ("positive", "negative") for i in range(KNOTS)}
        | {"low": ANY, "high": ANY},
        _friction_map,
        haste=lambda p, x, speed, acceleration, m: 0.4 * across((p.high - p.low) / 4.0, speed, acceleration, m),
    ),
    "end_stop": Law("memory", {"low": ANY, "high": ANY, **CONTACT}, usual=USUAL_CONTACT),
    "backlash": Law(
        "memory",
        {"gap": NOT_NEGATIVE, "load_share": SHARE, **CONTACT},
        pace=lambda p: contact_pace(p) / 2.5,
        usual=USUAL_CONTACT,
    ),
    "flexible_coupling": Law(
        "memory",
        {"frequency": POSITIVE, "damping_ratio": NOT_NEGATIVE, "load_ratio": SHARE},
        pace=lambda p: 2.0 * math.pi * p.frequency * max(1.0, 2.0 * p.damping_ratio),
    ),
    "sensor_lag": Law("memory", {"time_constant": NOT_NEGATIVE}),
}
"""Every effect of the laboratory; commands act in this order."""
