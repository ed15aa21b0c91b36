"""Coulomb friction: the same level at every speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import DryFriction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["CoulombFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class CoulombFriction(DryFriction):
    """Dry friction of constant size opposes the motion; the axis sticks where the push is smaller."""

    name = "coulomb_friction"
    spoken = "Coulomb friction"
    sentence = "Dry friction of constant size opposes the motion; the axis sticks where the push is smaller."
    latex = r"F\,\operatorname{sgn} v"
    absent_at: ClassVar[dict[str, float]] = {"level": 0.0}
    typical: ClassVar[dict[str, float]] = {"level": 0.35}
    looks_like = (
        "The axis stops short of its target and stays there: anywhere within level / (gain kp), "
        "most of it after small steps; it does not move until the command passes a threshold."
    )
    remedy = (
        "Reduce preload, clean or lubricate the guide; or add friction compensation, level / gain volts "
        "with the sign of the reference's speed, a little less than all of it."
    )
    for_the_gain = (
        "Friction brakes for free: the least kd is smaller than a linear model says, above all for small steps. "
        "The error left at rest is kp's affair, kd does not change it."
    )

    level: float = parameter("F", "{x}/s^2", "friction per unit of moving mass", per_mass=1)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        return p.level

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[CoulombFriction]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, level=0.1 * seen.push)
