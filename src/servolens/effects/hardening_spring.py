"""Hardening spring: stiffer the farther it goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["HardeningSpring"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class HardeningSpring(Force):
    """A spring pulls back that gets stiffer with the distance."""

    name = "hardening_spring"
    spoken = "a hardening spring"
    sentence = "A spring pulls back that gets stiffer with the distance."
    latex = r"k_3\,y^3"
    absent_at: ClassVar[dict[str, float]] = {"cubic_stiffness": 0.0}
    typical: ClassVar[dict[str, float]] = {"cubic_stiffness": 600.0}
    looks_like = (
        "Small moves look free; far from the middle the axis falls short, more than in proportion to the distance."
    )
    remedy = "Stay away from the ends of a flexure, bellows or cable chain, or feed forward the force at the reference."
    for_the_gain = (
        "The loop gets stiffer with the distance: choose kd at the far end, where oscillation is fastest, "
        "and kp by the error allowed there."
    )

    cubic_stiffness: float = parameter(
        "k_3", "1/s^2/{x}^2", "force over the cube of the position, per unit of moving mass", per_mass=1
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return p.cubic_stiffness * axis.position * axis.position * axis.position

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[HardeningSpring]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, cubic_stiffness=0.1 * seen.push / max(abs(seen.low), abs(seen.high), 1e-3) ** 3)
