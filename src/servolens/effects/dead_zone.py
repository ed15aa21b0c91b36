"""Dead zone: small commands do nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Actuator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["DeadZone"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class DeadZone(Actuator):
    """Commands smaller than the dead zone move nothing, and larger ones lose its width."""

    name = "dead_zone"
    spoken = "a dead zone"
    sentence = "Commands smaller than the dead zone move nothing, and larger ones lose its width."
    latex = r"a = \operatorname{sgn}(V)\,\max(|V| - w,\ 0)"
    stage = 20
    absent_at: ClassVar[dict[str, float]] = {"width": 0.0}
    typical: ClassVar[dict[str, float]] = {"width": 0.25}
    looks_like = (
        "Near the target the motor gets a voltage but does not push: the axis coasts to a stop anywhere "
        "within width / kp, without sticking."
    )
    remedy = "Add the width to the command with the sign of the command (a dead-band inverse), or trim the amplifier."
    for_the_gain = (
        "Inside the zone neither kp nor kd acts: the error at rest is up to width / kp and nothing brakes there. "
        "Compensate first, choose the gains then."
    )

    width: float = parameter("w", "{u}", "command that is lost, of either sign")

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Actuator.physics`."""
        from casadi import fmax, fmin

        return fmax(command - p.width, 0) + fmin(command + p.width, 0)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[DeadZone]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for share in (0.02, 0.1, 5e-3, 1e-3, 2e-4):
            yield within(cls, width=share * seen.command)
