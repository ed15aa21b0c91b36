"""What people call effects, causes and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.wording import value_and_error

if TYPE_CHECKING:
    from servolens.diagnosis.result import Cause

__all__ = ["cause_phrase", "spoken", "spoken_parameter"]

NAMES = {
    "gain_and_damping": "gain and damping alone",
    "coulomb_friction": "Coulomb friction",
    "stribeck_friction": "Stribeck friction",
    "presliding": "presliding friction",
    "asymmetric_friction": "friction that differs by direction",
    "asymmetric_damping": "damping that differs by direction",
    "position_friction": "a tight spot",
    "velocity_decay_damping": "damping that falls with speed",
    "pendulum_gravity": "gravity on a pendulum",
    "constant_force": "a constant force",
    "return_spring": "a spring",
    "hardening_spring": "a hardening spring",
    "periodic_disturbance": "a periodic disturbance",
    "gain_drift": "a gain that drifts",
    "dead_zone": "a dead zone",
    "delay": "a delay",
    "actuator_lag": "a lag of the actuator",
    "sensor_lag": "a lag of the sensor",
    "force_limit": "a limit of force",
    "load_friction": "friction that grows with the load",
    "friction_map": "friction that differs over the travel",
    "end_stop": "an end stop",
    "speed_servo": "a speed loop in the drive",
    "flexible_coupling": "a flexible coupling",
}
"""Where the effect's name, with spaces for underscores, is not what people say."""
SIDES = {"level_positive": "level forward", "level_negative": "level backward"}
"""Of parameters whose name is no phrase."""


def spoken(name: str) -> str:
    """Return an effect's name, or those of effects joined by a plus, as people say it.

    Examples
    --------
    >>> spoken("coulomb_friction"), spoken("backlash"), spoken("without delay"), spoken("delay + coulomb_friction")
    ('Coulomb friction', 'backlash', 'without delay', 'a delay together with Coulomb friction')
    """
    return " together with ".join(NAMES.get(part, part.replace("_", " ")) for part in name.split(" + "))


def spoken_parameter(name: str) -> str:
    """Return a parameter's name as people say it.

    Examples
    --------
    >>> spoken_parameter("level_positive"), spoken_parameter("load_share")
    ('level forward', 'load share')
    """
    return SIDES.get(name, name.replace("_", " "))


def cause_phrase(cause: Cause) -> str:
    """Return a cause with its parameters but for a phase: name and value ± error, each with its unit."""
    phase = cause.kind.wave[1] if cause.kind.wave else ""
    told = {name: value_and_error(quantity) for name, quantity in cause.quantities.items() if name != phase}
    if len(told) == 1:
        return f"{spoken(cause.effect)}, {next(iter(told.values()))}"
    named = [f"{spoken_parameter(name)} {value}" for name, value in told.items()]
    return f"{spoken(cause.effect)} ({', '.join(named)})"
