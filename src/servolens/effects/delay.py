"""Delay: the command acts later than it was given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import TimeShift

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Seen

__all__ = ["Delay"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Delay(TimeShift):
    """The command acts later than it was given."""

    name = "delay"
    spoken = "a delay"
    sentence = "The command acts later than it was given."
    latex = r"a(t)=V(t-\tau)"
    absent_at: ClassVar[dict[str, float]] = {"time": 0.0}
    linear = True
    typical: ClassVar[dict[str, float]] = {"time": 0.0035}
    looks_like = (
        "Everything happens as expected but a few samples late; the loop rings at high gains, and with more kd too."
    )
    remedy = (
        "Write the output in the sample in which the position was read, shorten bus cycles and filters, "
        "or sample faster."
    )
    for_the_gain = (
        "The delay takes away about gain × kp × delay of the damping; gain × kd × delay has to stay well below 1, "
        "so the delay sets a largest kd."
    )

    time: float = parameter(r"\tau", "s", "computation, bus and amplifier together", high=100.0)

    @staticmethod
    def physics(p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.TimeShift.physics`."""
        return p.time

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Delay]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for samples in (1.0, 3.0, 10.0):
            yield within(cls, time=samples * seen.sample_time)
