"""The catalogue: everything that a plant can contain and a diagnosis can name, one file each.

Effects of other packages are found by the entry point group ``servolens.effects``.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.metadata import entry_points

from servolens.effects._admission import check_admissible
from servolens.effects.base import Axis, Effect, Parameter, Seen, State, parameter
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
from servolens.errors import InputError, names_like

# The catalogue, a line each. The names are exported as they stand: that is what `as` says to type checkers.
# isort: off
from servolens.effects.actuator_lag import ActuatorLag as ActuatorLag
from servolens.effects.asymmetric_damping import AsymmetricDamping as AsymmetricDamping
from servolens.effects.asymmetric_friction import AsymmetricFriction as AsymmetricFriction
from servolens.effects.backlash import Backlash as Backlash
from servolens.effects.cogging import Cogging as Cogging
from servolens.effects.constant_force import ConstantForce as ConstantForce
from servolens.effects.coulomb_friction import CoulombFriction as CoulombFriction
from servolens.effects.dead_zone import DeadZone as DeadZone
from servolens.effects.delay import Delay as Delay
from servolens.effects.end_stop import EndStop as EndStop
from servolens.effects.flexible_coupling import FlexibleCoupling as FlexibleCoupling
from servolens.effects.force_limit import ForceLimit as ForceLimit
from servolens.effects.friction_map import FrictionMap as FrictionMap
from servolens.effects.gain_drift import GainDrift as GainDrift
from servolens.effects.hardening_spring import HardeningSpring as HardeningSpring
from servolens.effects.load_friction import LoadFriction as LoadFriction
from servolens.effects.pendulum_gravity import PendulumGravity as PendulumGravity
from servolens.effects.periodic_disturbance import PeriodicDisturbance as PeriodicDisturbance
from servolens.effects.position_friction import PositionFriction as PositionFriction
from servolens.effects.presliding import Presliding as Presliding
from servolens.effects.quadratic_drag import QuadraticDrag as QuadraticDrag
from servolens.effects.return_spring import ReturnSpring as ReturnSpring
from servolens.effects.saturation import Saturation as Saturation
from servolens.effects.sensor_lag import SensorLag as SensorLag
from servolens.effects.speed_servo import SpeedServo as SpeedServo
from servolens.effects.stribeck_friction import StribeckFriction as StribeckFriction
from servolens.effects.velocity_decay_damping import VelocityDecayDamping as VelocityDecayDamping
# isort: on

GROUP = "servolens.effects"
CATALOGUE: dict[str, type[Effect]] = {
    one.name: one
    for one in tuple(globals().values())
    if isinstance(one, type) and issubclass(one, Effect) and one.__module__ not in (Effect.__module__, Force.__module__)
}

__all__ = [
    "CATALOGUE",
    "Actuator",
    "Axis",
    "Drive",
    "DryFriction",
    "Effect",
    "Force",
    "MotorForce",
    "Parameter",
    "Seen",
    "Sensor",
    "State",
    "TimeShift",
    "Transmission",
    "catalogue",
    "check_effect",
    "effect_class",
    "parameter",
]
__all__ += [effect.__name__ for effect in CATALOGUE.values()]


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
        raise InputError(f"there is no effect {name[:40]!r}; {names_like(name, CATALOGUE, 'the catalogue holds')}")
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
