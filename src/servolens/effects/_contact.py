"""Contacts that open and close: their force, how stiff they are, and how much of a blow they throw back."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import TYPE_CHECKING, Any, TypeVar

from servolens.effects.base import Effect, parameter

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["CONTACT_RATE", "contact_damping", "contact_force", "contact_frequency", "other_contacts"]

CONTACT_RATE = 2000.0
"""Of a contact of which nothing is known [rad/s]: far above any loop, and not rigid."""
CONTACTS: tuple[dict[str, float], ...] = (
    {"contact_frequency": 150.0, "contact_damping": 0.7},
    {"contact_damping": 0.3},
    {"contact_damping": 8.0},
)
"""Others, from which a fit begins: one that gives way, one that throws back nearly half of the speed, a dead one."""

E = TypeVar("E", bound=Effect)


def contact_force(depth: Any, speed: Any, p: Any, mass: Any = 1) -> Any:
    """Return the force of a spring and damper that can only push, in contact where `depth` is positive.

    Parameters
    ----------
    depth, speed : symbol
        How deep one is in the other, and how fast it gets deeper.
    p : namespace
        With ``contact_frequency`` and ``contact_damping``.
    mass : symbol
        That swings on the contact, as a share of all that moves.
    """
    from casadi import fmax, if_else

    rate = 2 * pi * p.contact_frequency
    stiffness, damper = rate * rate * mass, 2 * p.contact_damping * rate * mass
    return if_else(depth > 0, fmax(0, stiffness * depth + damper * speed), 0)


def other_contacts(effect: E) -> Iterator[E]:
    """Yield an `effect` whose contact is the usual one with contacts that give way, bounce, or are dead."""
    if {"contact_frequency", "contact_damping"} <= set(effect.usual):
        yield from (replace(effect, **contact) for contact in CONTACTS)


def contact_frequency() -> Any:
    """Declare a contact's frequency as a parameter of an effect."""
    meaning = "undamped, of the contact with the masses it joins: how far it gives way"
    return parameter(r"\nu", "Hz", meaning, low=10.0, high=2000.0, per_mass=0.5, usual=CONTACT_RATE / (2.0 * pi))


def contact_damping() -> Any:
    """Declare a contact's damping ratio as a parameter of an effect.

    A contact that can only push throws back a share of the speed at which it is hit that depends on this ratio alone
    (Schwager and Pöschel 2007, doi:10.1007/s10035-007-0065-z).
    """
    meaning = "damping ratio of the contact: 0.3 throws back 45 % of the speed, 1 14 %, 8 none"
    return parameter(r"\chi", "1", meaning, low=0.05, high=20.0, per_mass=0.5, usual=1.0)
