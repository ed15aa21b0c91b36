"""Quadratic drag: a fluid or a fan in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["QuadraticDrag"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class QuadraticDrag(Force):
    """A resistance grows with the square of the speed, as in air or liquid."""

    name = "quadratic_drag"
    sentence = "A resistance grows with the square of the speed, as in air or liquid."
    latex = r"d\,v\,|v|"
    absent_at: ClassVar[dict[str, float]] = {"drag": 0.0}
    typical: ClassVar[dict[str, float]] = {"drag": 2.5}
    looks_like = (
        "The top speed stays behind what slow moves promise; slow moves fit well, fast ones are too quick in the model."
    )
    remedy = "Reduce the surface that is exposed or the speed; feed forward the drag at the reference's speed."
    for_the_gain = (
        "Drag fades near the target, so it brakes long moves only: kd has to be chosen by small steps, "
        "where there is none to help."
    )

    drag: float = parameter("d", "1/{x}", "resistance over speed squared, per unit of moving mass", per_mass=1)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return p.drag * axis.velocity * axis.speed

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[QuadraticDrag]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, drag=0.2 * seen.push / max(seen.speed, 1e-9) ** 2)
