"""Return spring: a spring or a cable pulls back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["ReturnSpring"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ReturnSpring(Force):
    """A spring or a cable pulls the axis back in proportion to the position."""

    name = "return_spring"
    spoken = "a spring"
    sentence = "A spring or a cable pulls the axis back in proportion to the position."
    latex = r"k\,y"
    absent_at: ClassVar[dict[str, float]] = {"stiffness": 0.0}
    linear = True
    typical: ClassVar[dict[str, float]] = {"stiffness": 6.0}
    looks_like = (
        "The axis rests short of its target by an error that grows with the distance from one place, "
        "and the motor must push to stay there."
    )
    remedy = (
        "Route the cable with more slack or add a counter-spring; feed forward stiffness / gain times the reference."
    )
    for_the_gain = (
        "The error at rest is stiffness / (gain kp + stiffness) of the distance: kp sets it, kd does not. "
        "The spring raises the closed loop's frequency, so a given kd damps slightly less."
    )

    stiffness: float = parameter("k", "1/s^2", "stiffness per unit of moving mass", per_mass=1)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return p.stiffness * axis.position

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[ReturnSpring]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, stiffness=0.1 * seen.push / seen.travel)
