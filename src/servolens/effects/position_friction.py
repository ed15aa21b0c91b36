"""Position friction: a tight spot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import DryFriction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["PositionFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PositionFriction(DryFriction):
    """Dry friction is higher around one place of the travel, a tight spot."""

    name = "position_friction"
    spoken = "a tight spot"
    sentence = "Dry friction is higher around one place of the travel, a tight spot."
    latex = r"L\,e^{-((y - y_0)/w)^2}\,\operatorname{sgn} v"
    absent_at: ClassVar[dict[str, float]] = {"level": 0.0}
    typical: ClassVar[dict[str, float]] = {"level": 0.6, "centre": 0.045, "width": 0.022}
    looks_like = (
        "The axis slows down or stops short always at the same place, in both directions; elsewhere it runs free."
    )
    remedy = (
        "Inspect that place: dirt, a dent, a bent rail, a tight seal or cable. "
        "Until then keep targets away from it or compensate friction by position."
    )
    for_the_gain = (
        "A gain chosen elsewhere leaves an error of up to level / (gain kp) for targets at the spot; "
        "repair it rather than raise kp for the whole travel."
    )

    level: float = parameter("L", "{x}/s^2", "friction at the centre of the spot, per unit of moving mass", per_mass=1)
    centre: float = parameter("y_0", "{x}", "where the spot is", low=-1e12, per_mass=0)
    width: float = parameter(
        "w", "{x}", "distance from the centre at which 37 % of the friction is left", low=1e-9, per_mass=0
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        from casadi import exp

        away = (axis.position - p.centre) / p.width
        return p.level * exp(-away * away)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[PositionFriction]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for width in (0.05, 0.15):
            for tenth in range(1, 10):
                centre = seen.low + tenth / 10 * seen.travel
                yield within(cls, level=0.1 * seen.push, centre=centre, width=width * seen.travel)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`."""
        return self.width <= seen.travel and seen.low <= self.centre <= seen.high
