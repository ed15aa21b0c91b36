"""The catalogue: everything that a plant can contain and a diagnosis can name, one file each."""

from __future__ import annotations

from servolens.effects.base import Actuator, Axis, DryFriction, Effect, Force, Parameter, parameter
from servolens.effects.coulomb_friction import CoulombFriction
from servolens.effects.saturation import Saturation
from servolens.effects.velocity_decay_damping import VelocityDecayDamping
from servolens.errors import InputError

__all__ = [
    "CATALOGUE",
    "Actuator",
    "Axis",
    "CoulombFriction",
    "DryFriction",
    "Effect",
    "Force",
    "Parameter",
    "Saturation",
    "VelocityDecayDamping",
    "effect_class",
    "parameter",
]

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect for effect in (CoulombFriction, Saturation, VelocityDecayDamping)
}


def effect_class(name: str) -> type[Effect]:
    """Return the effect called `name`.

    Raises
    ------
    InputError
        If the catalogue holds none of that name.
    """
    try:
        return CATALOGUE[name]
    except KeyError:
        raise InputError(
            f"there is no effect {name[:40]!r}; the catalogue holds {', '.join(sorted(CATALOGUE))}"
        ) from None
