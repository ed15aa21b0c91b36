"""Pendulum gravity: an arm whose weight turns with it."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, cos
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force
from servolens.effects.return_spring import ReturnSpring

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["PendulumGravity"]

LEAST_TRAVEL, STANDS = 0.5, 0.1
"""[rad] Within less a weight is a constant force and a spring: sin φ differs from φ by 1 % at half of it. Unless it
stands, which no spring does: cosine of the angle from there on."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PendulumGravity(Force):
    """The weight of an unbalanced arm pulls with the sine of its angle."""

    name = "pendulum_gravity"
    spoken = "gravity on a pendulum"
    sentence = "The weight of an unbalanced arm pulls with the sine of its angle."
    latex = r"A\,\sin(y + \phi)"
    absent_at: ClassVar[dict[str, float]] = {"amplitude": 0.0}
    wave = ("amplitude", "phase")
    is_rotary = True
    typical: ClassVar[dict[str, float]] = {"amplitude": 1.2, "phase": 0.4}
    looks_like = (
        "The error at rest depends on the angle: none where the arm hangs or stands, largest where it is level."
    )
    remedy = "Balance the arm with a counterweight or spring, or feed forward its weight at the reference's angle."
    for_the_gain = (
        "Near upright the weight pushes away from the target, so gain kp must exceed the amplitude by a margin; "
        "near hanging it helps. Choose kp and kd for the upright side."
    )

    amplitude: float = parameter(
        "A", "{x}/s^2", "the weight's pull with the arm level, per unit of moving inertia", per_mass=1
    )
    phase: float = parameter(
        r"\phi", "rad", "angle from the arm hanging down to position 0", low=-1e3, high=1e3, per_mass=0
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        from casadi import sin

        return p.amplitude * sin(axis.position + p.phase)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`."""
        spring = copysign(1.0, self.amplitude) * cos(0.5 * (seen.low + seen.high) + self.phase)
        return seen.travel >= LEAST_TRAVEL or spring < -STANDS

    def simplified(self, seen: Seen) -> Iterator[ReturnSpring]:
        """See :meth:`servolens.effects.base.Effect.simplified`: a spring as stiff as it is at position 0."""
        stiffness = self.amplitude * cos(self.phase)
        if stiffness > 0.0:
            yield ReturnSpring(stiffness=stiffness)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[PendulumGravity]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, amplitude=0.2 * seen.push, phase=0.0)
