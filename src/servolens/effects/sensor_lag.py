"""Sensor lag: the position shown runs after the true one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Sensor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["SensorLag"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class SensorLag(Sensor):
    """The position shown is filtered and lags behind the true one."""

    name = "sensor_lag"
    spoken = "a lag of the sensor"
    sentence = "The position shown is filtered and lags behind the true one."
    latex = r"\tau\,\dot y_m = y - y_m"
    absent_at: ClassVar[dict[str, float]] = {"time_constant": 0.0}
    states = (State("lag", "{x}", relaxes=True),)
    linear = True
    twin = "actuator_lag"
    typical: ClassVar[dict[str, float]] = {"time_constant": 0.006}
    looks_like = (
        "The measured position starts after the motor and the loop rings more than its gains suggest; "
        "with voltage and position alone it looks the same as a lag of the actuator."
    )
    remedy = "Shorten the filter of the sensor or of its electronics, or measure the motor's speed separately for kd."
    for_the_gain = (
        "The lag turns damping into delay: count kp times the time constant against kd, "
        "and keep the closed loop slower than a few time constants."
    )

    time_constant: float = parameter(r"\tau", "s", "time after which 63 % of a step is shown", high=100.0)

    @staticmethod
    def physics(position: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Sensor.physics`."""
        return position - axis.state.lag

    @staticmethod
    def rates(position: Any, axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Sensor.rates`."""
        from casadi import fmax

        return (axis.velocity - axis.state.lag / fmax(p.time_constant, 1e-15),)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[SensorLag]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for samples in (3.0, 10.0, 30.0, 1.0):
            yield within(cls, time_constant=samples * seen.sample_time)
