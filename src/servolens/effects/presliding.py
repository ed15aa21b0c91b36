"""Presliding friction (Dahl): contacts bend like springs before they slip."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["Presliding"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Presliding(Force):
    """Friction builds up elastically over a short travel before the axis slips (Dahl's model)."""

    name = "presliding"
    spoken = "presliding friction"
    sentence = "Friction builds up elastically over a short travel before the axis slips (Dahl's model)."
    latex = r"f,\ \dot f = \sigma v\,(1 - \frac{f}{F}\operatorname{sgn} v)"
    absent_at: ClassVar[dict[str, float]] = {"level": 0.0}
    states = (State("force", "{x}/s^2", relaxes=True),)
    generalises = ("coulomb_friction",)
    typical: ClassVar[dict[str, float]] = {"stiffness": 1800.0, "level": 0.35}
    looks_like = (
        "At rest the axis gives way elastically by a small travel and springs back; "
        "small steps ring or end short, and reversals show a rounded corner instead of a stop."
    )
    remedy = (
        "Rolling guides and preloaded bearings do this and it is no fault. Compensate the friction over the travel "
        "after each reversal rather than by the sign of the speed."
    )
    for_the_gain = (
        "Near the target the contact's stiffness adds to gain kp and raises the frequency: "
        "check kd on the smallest step, where the axis never slips."
    )

    stiffness: float = parameter(
        r"\sigma", "1/s^2", "stiffness of the contacts per unit of moving mass", high=1e9, per_mass=1
    )
    level: float = parameter("F", "{x}/s^2", "friction once it slips, per unit of moving mass", per_mass=1)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return axis.state.force

    @staticmethod
    def rates(axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Force.rates`."""
        from casadi import fmax

        return (p.stiffness * (axis.velocity - axis.speed * axis.state.force / fmax(p.level, 1e-12)),)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`.

        Elastic displacement below the noise is not seen; beyond the travel it never slips and is a spring.
        """
        return seen.noise * self.stiffness <= self.level <= seen.travel * self.stiffness

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Presliding]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        slips = dict.fromkeys(max(share * seen.travel, 2.0 * seen.noise) for share in (1e-4, 1e-3, 1e-2, 5e-2))
        for share, slip in product((0.2, 0.05, 0.01, 0.002, 5e-4, 1e-4), slips):
            level = share * seen.push
            yield within(cls, stiffness=level / slip, level=level)
