"""What a virtual axis may do that no effect of the catalogue does: where a foreign law gets in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.laws import Instant

__all__ = ["UnmodelledEffect"]


def _nothing(instant: Instant) -> float:
    return 0.0


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnmodelledEffect:
    """One foreign law of one run, in plain floats; what is not given does nothing. It may remember: one for each run.

    Attributes
    ----------
    push : callable
        Instant → acceleration that is subtracted.
    level : callable
        Instant → level of dry friction.
    command : callable, optional
        (time, command asked for, position) → command that the actuator gets, held for the sample.
    sensor : callable, optional
        (time, shown position, velocity) → position that is shown, before noise and quantisation.
    sample : callable, optional
        (time, position, velocity), called at each sample before anything else: for what must be remembered.
    """

    push: Callable[[Instant], float] = _nothing
    level: Callable[[Instant], float] = _nothing
    command: Callable[[float, float, float], float] | None = None
    sensor: Callable[[float, float, float], float] | None = None
    sample: Callable[[float, float, float], None] | None = None

    def force(self, instant: Instant, p: Any, m: Any) -> float:
        """Return the acceleration that is subtracted, as a law of the laboratory is asked for it."""
        return self.push(instant)

    def friction(self, instant: Instant, p: Any, m: Any) -> float:
        """Return the level of dry friction, as a law of the laboratory is asked for it."""
        return self.level(instant)

    def shows(self, t: float, shown: float, position: float, velocity: float) -> float:
        """Return what the sensor shows at the sample at `t`."""
        if self.sample is not None:
            self.sample(t, position, velocity)
        return shown if self.sensor is None else self.sensor(t, shown, velocity)

    def turns(self, t: float, asked: float, position: float) -> float:
        """Return what the actuator gets of the command asked for."""
        return asked if self.command is None else self.command(t, asked, position)
