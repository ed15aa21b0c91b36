"""The catalogue: everything that a plant can contain and a diagnosis can name, one file each.

Effects of other packages are found by the entry point group ``servolens.effects``.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.metadata import entry_points

from servolens.effects._admission import check_admissible
from servolens.effects.actuator_lag import ActuatorLag
from servolens.effects.asymmetric_damping import AsymmetricDamping
from servolens.effects.asymmetric_friction import AsymmetricFriction
from servolens.effects.backlash import Backlash
from servolens.effects.base import Axis, Effect, Parameter, Seen, State, parameter
from servolens.effects.cogging import Cogging
from servolens.effects.constant_force import ConstantForce
from servolens.effects.coulomb_friction import CoulombFriction
from servolens.effects.dead_zone import DeadZone
from servolens.effects.delay import Delay
from servolens.effects.end_stop import EndStop
from servolens.effects.flexible_coupling import FlexibleCoupling
from servolens.effects.force_limit import ForceLimit
from servolens.effects.friction_map import FrictionMap
from servolens.effects.gain_drift import GainDrift
from servolens.effects.hardening_spring import HardeningSpring
from servolens.effects.kinds import (
    Actuator,
    Drive,
    DryFriction,
    Force,
    MotorForce,
    Sensor,
    TimeShift,
    Transmission,
)
from servolens.effects.load_friction import LoadFriction
from servolens.effects.pendulum_gravity import PendulumGravity
from servolens.effects.periodic_disturbance import PeriodicDisturbance
from servolens.effects.position_friction import PositionFriction
from servolens.effects.presliding import Presliding
from servolens.effects.quadratic_drag import QuadraticDrag
from servolens.effects.return_spring import ReturnSpring
from servolens.effects.saturation import Saturation
from servolens.effects.sensor_lag import SensorLag
from servolens.effects.speed_servo import SpeedServo
from servolens.effects.stribeck_friction import StribeckFriction
from servolens.effects.velocity_decay_damping import VelocityDecayDamping
from servolens.errors import InputError

__all__ = [
    "CATALOGUE",
    "Actuator",
    "ActuatorLag",
    "AsymmetricDamping",
    "AsymmetricFriction",
    "Axis",
    "Backlash",
    "Cogging",
    "ConstantForce",
    "CoulombFriction",
    "DeadZone",
    "Delay",
    "Drive",
    "DryFriction",
    "Effect",
    "EndStop",
    "FlexibleCoupling",
    "Force",
    "ForceLimit",
    "FrictionMap",
    "GainDrift",
    "HardeningSpring",
    "LoadFriction",
    "MotorForce",
    "Parameter",
    "PendulumGravity",
    "PeriodicDisturbance",
    "PositionFriction",
    "Presliding",
    "QuadraticDrag",
    "ReturnSpring",
    "Saturation",
    "Seen",
    "Sensor",
    "SensorLag",
    "SpeedServo",
    "State",
    "StribeckFriction",
    "TimeShift",
    "Transmission",
    "VelocityDecayDamping",
    "catalogue",
    "check_effect",
    "effect_class",
    "parameter",
]

GROUP = "servolens.effects"
CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        ActuatorLag,
        AsymmetricDamping,
        AsymmetricFriction,
        Backlash,
        Cogging,
        ConstantForce,
        CoulombFriction,
        DeadZone,
        Delay,
        EndStop,
        FlexibleCoupling,
        ForceLimit,
        FrictionMap,
        GainDrift,
        HardeningSpring,
        LoadFriction,
        PendulumGravity,
        PeriodicDisturbance,
        PositionFriction,
        Presliding,
        QuadraticDrag,
        ReturnSpring,
        Saturation,
        SensorLag,
        SpeedServo,
        StribeckFriction,
        VelocityDecayDamping,
    )
}


def catalogue() -> dict[str, type[Effect]]:
    """Return every effect by its name: those of servolens, then those that installed packages offer.

    Packages are asked once for each state of ``sys.path``; where a name is taken by servolens, its own effect stands.

    Raises
    ------
    InputError
        If what a package offers does not load, or is no admissible effect.
    """
    return CATALOGUE | {name: effect_class(name) for name in _offered_names(tuple(sys.path)) if name not in CATALOGUE}


def check_effect(cls: type[Effect]) -> None:
    """Refuse a class whose physics is not what its kind takes and gives; those of the catalogue are known to be good.

    Raises
    ------
    InputError
        With one sentence: what the class does, what is admissible.
    """
    if CATALOGUE.get(getattr(cls, "name", "")) is not cls:
        check_admissible(cls)


def effect_class(name: str) -> type[Effect]:
    """Return the effect called `name`: of the catalogue, or of an installed package that offers it.

    A package offers an effect by an entry point of the group ``servolens.effects`` whose name is the effect's.

    Raises
    ------
    InputError
        If there is none of that name, or the package's entry point does not load an admissible effect of that name.
    """
    found = CATALOGUE.get(name) or _offered(name, tuple(sys.path))
    if found is None:
        raise InputError(f"there is no effect {name[:40]!r}; the catalogue holds {', '.join(sorted(CATALOGUE))}")
    return found


@lru_cache(maxsize=16)
def _offered_names(_: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted({point.name for point in entry_points(group=GROUP)}))


@lru_cache(maxsize=256)
def _offered(name: str, _: tuple[str, ...]) -> type[Effect] | None:
    for point in entry_points(group=GROUP, name=name):
        try:
            loaded = point.load()
        except Exception as failure:
            raise InputError(f"the effect {name[:40]!r} of {point.value[:80]} does not load: {failure}") from failure
        if not (isinstance(loaded, type) and issubclass(loaded, Effect) and loaded.name == name):
            raise InputError(f"{point.value[:80]} is no effect called {name[:40]!r}")
        check_admissible(loaded)
        return loaded
    return None
