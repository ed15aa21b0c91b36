"""Speed servo: the drive runs a speed loop of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Drive
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["SpeedServo"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedServo(Drive):
    """The drive runs a PI speed loop of its own and takes the voltage as the speed to hold."""

    name = "speed_servo"
    spoken = "a speed loop in the drive"
    sentence = "The drive runs a PI speed loop of its own and takes the voltage as the speed to hold."
    latex = r"p\,(s\,V - v) + i\int(s\,V - v)\,dt"
    states = (State("position_error", "{x}"),)
    linear = True
    typical: ClassVar[dict[str, float]] = {"speed_per_volt": 0.1, "proportional": 38.0, "integral": 280.0}
    looks_like = (
        "A constant voltage gives a constant speed that load and friction hardly change; "
        "steps end with little error even at low kp, and a hand cannot push the axis away."
    )
    remedy = (
        "Nothing is wrong: tell the model so. For a stiffer axis tune the drive's own loop first, "
        "or switch it to current (torque) mode."
    )
    for_the_gain = (
        "The voltage is a speed, so kp speed_per_volt is the rate at which the error decays and kd is of little use; "
        "keep that rate several times below proportional, the drive's own."
    )

    speed_per_volt: float = parameter(
        "s", "{x}/s/{u}", "speed that the drive holds per unit of command", low=-1e12, per_mass=0
    )
    proportional: float = parameter("p", "1/s", "acceleration per speed error", low=1e-3, high=1e6, per_mass=1)
    integral: float = parameter("i", "1/s^2", "acceleration per summed speed error", per_mass=1)

    def __post_init__(self) -> None:
        Drive.__post_init__(self)
        if self.gain == 0:
            raise InputError(f"{self.name}: speed_per_volt must not be 0, the command would move nothing")

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Drive.physics`."""
        return p.proportional * (p.speed_per_volt * command - axis.velocity) + p.integral * axis.state.position_error

    @staticmethod
    def rates(command: Any, axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Drive.rates`."""
        return (p.speed_per_volt * command - axis.velocity,)

    @property
    def gain(self) -> float:
        """See :meth:`servolens.effects.kinds.Drive.gain`."""
        return self.proportional * self.speed_per_volt

    @property
    def damping(self) -> float:
        """See :meth:`servolens.effects.kinds.Drive.damping`."""
        return self.proportional

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[SpeedServo]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        steady = seen.gain / seen.damping if seen.damping > 0 else seen.speed / max(seen.command, 1e-9)
        for proportional in (20.0, 60.0, 200.0, 0.5 * seen.damping, seen.damping):
            for slower in (8.0, 100.0):  # the integral's rate beside the proportional one
                yield within(
                    cls,
                    speed_per_volt=steady or 1.0,
                    proportional=proportional,
                    integral=proportional * proportional / slower,
                )
        if seen.damping > 0:  # half of the damping is the drive's, and its integral does next to nothing
            own = 0.5 * seen.damping
            yield within(cls, speed_per_volt=seen.gain / own, proportional=own, integral=own * own / 1000.0)
