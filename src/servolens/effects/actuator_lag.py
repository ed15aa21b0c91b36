"""Actuator lag: the amplifier or the motor's current follows the command as a first-order filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Actuator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["ActuatorLag"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorLag(Actuator):
    """The motor's force follows the command as a first-order filter."""

    name = "actuator_lag"
    spoken = "a lag of the actuator"
    sentence = "The motor's force follows the command as a first-order filter."
    latex = r"\tau\,\dot a = V - a"
    stage = 40
    absent_at: ClassVar[dict[str, float]] = {"time_constant": 0.0}
    states = (State("command", "{u}", relaxes=True),)
    linear = True
    twin = "sensor_lag"
    passes_for_damping = True
    typical: ClassVar[dict[str, float]] = {"time_constant": 0.006}
    looks_like = (
        "The acceleration after a step of the command begins gently, not at once, and the loop rings more "
        "than its gains suggest, more so the higher they are."
    )
    remedy = "Tune or speed up the current loop, remove filters from the command, or use a faster amplifier."
    for_the_gain = (
        "The lag takes away phase, as if about gain × kp × time constant of the damping were lost. "
        "Raise kd or lower kp; too much kd rings as well."
    )

    time_constant: float = parameter(r"\tau", "s", "time after which 63 % of a step has arrived", high=100.0)

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Actuator.physics`."""
        return axis.state.command

    @staticmethod
    def rates(command: Any, axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Actuator.rates`."""
        from casadi import fmax

        return ((command - axis.state.command) / fmax(p.time_constant, 1e-15),)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[ActuatorLag]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for samples in (3.0, 10.0, 30.0, 1.0):
            yield within(cls, time_constant=samples * seen.sample_time)
