"""Saturation: the amplifier gives no more than its limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Actuator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["Saturation"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Saturation(Actuator):
    """The amplifier clips the command at its limit."""

    name = "saturation"
    sentence = "The amplifier clips the command at its limit."
    latex = r"\operatorname{clip}(V, \pm V_\mathrm{max})"
    stage = 10
    absent_at: ClassVar[dict[str, float]] = {"limit": 1e12}
    typical: ClassVar[dict[str, float]] = {"limit": 3.2}
    looks_like = (
        "Large steps all begin with the same slope whatever kp, and the axis reaches the same top speed; "
        "small steps fit."
    )
    remedy = (
        "Enter the amplifier's limit with the record if it is known. Use a stronger supply, "
        "or give the reference as a profile whose acceleration the limit allows."
    )
    for_the_gain = (
        "More kp does not make large steps faster. The brake is limited too: choose kd by the largest step "
        "that must not overshoot."
    )

    limit: float = parameter(r"V_\mathrm{max}", "{u}", "largest command that the amplifier passes on")

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Actuator.physics`."""
        from casadi import fmax, fmin

        return fmin(fmax(command, -p.limit), p.limit)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Saturation]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for share in (0.5, 0.7, 0.9, 0.35, 0.2, 0.1):
            yield within(cls, limit=share * seen.command)
