"""Asymmetric friction: a level for each direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.constant_force import ConstantForce
from servolens.effects.coulomb_friction import CoulombFriction
from servolens.effects.kinds import DryFriction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Effect, Seen

__all__ = ["AsymmetricFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class AsymmetricFriction(DryFriction):
    """Dry friction has one level when the axis moves up and another when it moves down."""

    name = "asymmetric_friction"
    spoken = "friction that differs by direction"
    sentence = "Dry friction has one level when the axis moves up and another when it moves down."
    latex = r"\left(\frac{F_+ + F_-}{2}\,\operatorname{sgn} v + \frac{F_+ - F_-}{2}\right)"
    absent_at: ClassVar[dict[str, float]] = {"level_positive": 0.0, "level_negative": 0.0}
    generalises = ("coulomb_friction",)
    unites = ("coulomb_friction", "constant_force")
    typical: ClassVar[dict[str, float]] = {"level_positive": 0.35, "level_negative": 0.2}
    looks_like = (
        "The axis stops short of its target on both sides, but by a different distance after moves up and moves down."
    )
    remedy = (
        "Look for a one-sided load: a wiper, a cable, a misaligned guide or one-sided preload. "
        "Friction compensation with a value for each direction removes most of it."
    )
    for_the_gain = (
        "Choose kp by the larger of the two levels: the error at rest is up to level / (gain kp) on that side."
    )

    level_positive: float = parameter(
        "F_+", "{x}/s^2", "friction while the position grows, per unit of moving mass", per_mass=1
    )
    level_negative: float = parameter(
        "F_-", "{x}/s^2", "friction while the position falls, per unit of moving mass", per_mass=1
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        mean, half = (p.level_positive + p.level_negative) / 2, (p.level_positive - p.level_negative) / 2
        return mean + half * axis.direction

    @classmethod
    def united(cls, *parts: Effect) -> AsymmetricFriction | None:
        """See :meth:`servolens.effects.base.Effect.united`: a constant force adds to one level what it takes away."""
        (level,), (force,) = (part.values for part in parts)
        return cls(level_positive=level + force, level_negative=level - force) if abs(force) <= level else None

    def parts(self) -> tuple[CoulombFriction, ConstantForce]:
        """See :meth:`servolens.effects.base.Effect.parts`."""
        up, down = self.level_positive, self.level_negative
        return CoulombFriction(level=0.5 * (up + down)), ConstantForce(acceleration=0.5 * (up - down))

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[AsymmetricFriction]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, level_positive=0.1 * seen.push, level_negative=0.05 * seen.push)
