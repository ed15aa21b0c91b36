"""Gain drift: the same command pushes more or less as time goes by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Actuator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["GainDrift"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class GainDrift(Actuator):
    """The same command pushes less, or more, as the record goes on, by heating or a sagging supply."""

    name = "gain_drift"
    spoken = "a gain that drifts"
    sentence = "The same command pushes less, or more, as the record goes on, by heating or a sagging supply."
    latex = r"a = V\,(1 + r\,t)"
    stage = 50
    absent_at: ClassVar[dict[str, float]] = {"rate": 0.0}
    typical: ClassVar[dict[str, float]] = {"rate": 0.03}
    looks_like = "The first moves of a record fit, later ones are slower or faster; after a pause it begins anew."
    remedy = (
        "Warm the machine up before measuring, stiffen the supply, or let the drive control current, not voltage. "
        "The rate holds for the records' length only: do not extrapolate it."
    )
    for_the_gain = (
        "Stiffness and damping from the controller both go with the gain. "
        "Check kp and kd with the gain at either end of the drift."
    )

    rate: float = parameter("r", "1/s", "relative change of the gain a second", low=-1e3, high=1e3)

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Actuator.physics`."""
        return command * (1 + p.rate * axis.time)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[GainDrift]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for change in (0.1, -0.1):
            yield within(cls, rate=change / max(seen.duration, 1e-9))

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`: what more than doubles the gain, or turns it, is none."""
        return abs(self.rate) * seen.duration <= 1.0
