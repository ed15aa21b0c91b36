"""Cogging: a force that repeats along the travel."""

from __future__ import annotations

from dataclasses import dataclass
from math import isclose, pi
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import pitches, within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force
from servolens.effects.pendulum_gravity import PendulumGravity

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["Cogging"]

MOST_PITCH = 1.5
"""Share of the travel from which on a wave is as good as a spring."""
ONE_TURN = 0.1
"""By how much of a turn a pitch that is one may be off: a fit has begun within that."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Cogging(Force):
    """A force repeats along the travel, as of a motor's magnets or a screw's pitch."""

    name = "cogging"
    sentence = "A force repeats along the travel, as of a motor's magnets or a screw's pitch."
    latex = r"A\,\sin(2\pi\,y/p + \phi)"
    absent_at: ClassVar[dict[str, float]] = {"amplitude": 0.0}
    wave = ("amplitude", "phase")
    typical: ClassVar[dict[str, float]] = {"amplitude": 0.25, "pitch": 0.024, "phase": 0.7}
    looks_like = (
        "The speed ripples in step with the position, at slow moves most; "
        "targets a fraction of a pitch apart end with errors of different size and sign."
    )
    remedy = (
        "Use a motor with skewed or no slots, check a bent screw or an eccentric pulley; "
        "or feed forward the ripple from a table over the position."
    )
    for_the_gain = (
        "Each cog is a spring of stiffness 2 pi amplitude / pitch: gain kp must be well above it "
        "or the axis settles in the nearest detent. More kd does not move it out."
    )

    amplitude: float = parameter("A", "{x}/s^2", "largest pull, per unit of moving mass", per_mass=1)
    pitch: float = parameter("p", "{x}", "distance after which it repeats", low=1e-9, per_mass=0)
    phase: float = parameter(r"\phi", "rad", "where in the period position 0 lies", low=-1e3, high=1e3, per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        from casadi import sin

        return p.amplitude * sin(2 * pi * axis.position / p.pitch + p.phase)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Cogging]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for pitch in pitches(seen):
            yield within(cls, amplitude=0.05 * seen.push, pitch=pitch, phase=0.0)

    def simplified(self, seen: Seen) -> Iterator[PendulumGravity]:
        """See :meth:`servolens.effects.base.Effect.simplified`: a weight, if it repeats about once a turn."""
        if isclose(self.pitch, 2.0 * pi, rel_tol=ONE_TURN):
            yield PendulumGravity(amplitude=self.amplitude, phase=self.phase)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`."""
        return self.pitch <= MOST_PITCH * seen.travel
