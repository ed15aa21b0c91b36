"""Contacts that open and close: how stiff they are, and how much of a blow they throw back."""

from __future__ import annotations

from math import pi
from typing import Any

from servolens.effects.base import parameter

__all__ = ["CONTACTS", "CONTACT_RATE", "contact_damping", "contact_frequency"]

CONTACT_RATE = 2000.0
"""Of a contact of which nothing is known [rad/s]: far above any loop, and not rigid."""
CONTACTS: tuple[dict[str, float], ...] = (
    {"contact_frequency": 150.0, "contact_damping": 0.7},
    {"contact_damping": 0.3},
    {"contact_damping": 8.0},
)
"""Others, from which a fit begins: one that gives way, one that throws back nearly half of the speed, a dead one."""


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
