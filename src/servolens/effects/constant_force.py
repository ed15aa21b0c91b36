"""Constant force: tilt, gravity or an offset of the amplifier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["ConstantForce"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantForce(Force):
    """A constant force pushes the axis one way: tilt, gravity, or an offset of the amplifier."""

    name = "constant_force"
    spoken = "a constant force"
    sentence = "A constant force pushes the axis one way: tilt, gravity, or an offset of the amplifier."
    latex = r"g"
    absent_at: ClassVar[dict[str, float]] = {"acceleration": 0.0}
    linear = True
    typical: ClassVar[dict[str, float]] = {"acceleration": 0.3}
    looks_like = "The axis rests beside its target by the same distance and to the same side, wherever the target is."
    remedy = (
        "Level the axis, balance the weight or null the amplifier; or add the constant voltage acceleration / gain."
    )
    for_the_gain = "The error at rest is acceleration / (gain kp): only kp or a feedforward changes it, kd does not."

    acceleration: float = parameter(
        "g", "{x}/s^2", "what it takes from the acceleration, of either sign", low=-1e12, per_mass=1
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return p.acceleration

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[ConstantForce]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, acceleration=0.05 * seen.push)
