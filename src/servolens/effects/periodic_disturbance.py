"""Periodic disturbance: a machine nearby shakes the axis."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import frequencies, within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["PeriodicDisturbance"]

MAINS = tuple(float(f * k) for k in range(1, 6) for f in (50, 60))
"""[Hz]; the frequencies of public grids, IEC 60196, and their multiples that rectifiers leave."""
FEWEST_PERIODS = 0.5
"""In the longest record; less of it is as good as a drift."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PeriodicDisturbance(Force):
    """A force that swings with time at a fixed frequency shakes the axis, whatever it does."""

    name = "periodic_disturbance"
    spoken = "a periodic disturbance"
    sentence = "A force that swings with time at a fixed frequency shakes the axis, whatever it does."
    latex = r"A\,\sin(2\pi f t + \phi)"
    absent_at: ClassVar[dict[str, float]] = {"amplitude": 0.0}
    wave = ("amplitude", "phase")
    phase_per_record = True
    typical: ClassVar[dict[str, float]] = {"amplitude": 0.25, "frequency": 3.3, "phase": 0.4}
    looks_like = "The position swings at one frequency even at rest, no matter where the axis is or how fast it moves."
    remedy = (
        "Find what turns at that frequency (a pump, fan or neighbouring axis, 50 or 100 Hz of the mains) "
        "and isolate it; a notch in the loop does not remove it."
    )
    for_the_gain = (
        "Below the closed loop's frequency a higher kp shrinks the swing, far above it nothing does. "
        "Keep the closed loop's own frequency away from it."
    )

    amplitude: float = parameter("A", "{x}/s^2", "largest push, per unit of moving mass", per_mass=1)
    frequency: float = parameter("f", "Hz", "swings a second", low=1e-6, per_mass=0)
    phase: float = parameter(r"\phi", "rad", "phase at time 0 of the record", low=-1e3, high=1e3, per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        from casadi import sin

        return p.amplitude * sin(2 * pi * p.frequency * axis.time + p.phase)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[PeriodicDisturbance]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for frequency in frequencies(seen):
            yield within(cls, amplitude=0.05 * seen.push, frequency=frequency, phase=0.0)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`; at a mains frequency it is a ripple of the sensor."""
        is_ripple = any(abs(self.frequency - line) * seen.duration < 1.0 for line in MAINS)
        return not is_ripple and self.frequency * seen.duration >= FEWEST_PERIODS
