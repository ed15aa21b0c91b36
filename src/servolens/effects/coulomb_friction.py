"""Coulomb friction: the same level at every speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from servolens.effects.base import DryFriction, parameter

if TYPE_CHECKING:
    from servolens.effects.base import Axis

__all__ = ["CoulombFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class CoulombFriction(DryFriction):
    """Dry friction of constant size opposes the motion; the axis sticks where the push is smaller."""

    name = "coulomb_friction"
    sentence = "Dry friction of constant size opposes the motion; the axis sticks where the push is smaller."
    latex = r"F\,\operatorname{sgn} v"

    level: float = parameter("F", "{x}/s^2", "friction per unit of moving mass")

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.base.DryFriction.physics`."""
        return p.level
