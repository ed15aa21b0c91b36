"""Flexible coupling: the load hangs on a spring."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2, pi
from typing import TYPE_CHECKING, Any, ClassVar, final

from numpy import geomspace

from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Transmission

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["FlexibleCoupling"]

PER_OCTAVE, SHOWN = 2, 0.4
"""Starts per octave; frequency times the sample time up to which a log shows how a coupling rings."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class FlexibleCoupling(Transmission):
    """The measured load is coupled to the motor by a spring and a damper."""

    name = "flexible_coupling"
    spoken = "a flexible coupling"
    sentence = "The measured load is coupled to the motor by a spring and a damper."
    latex = r"k(x-y)+d(\dot x-\dot y)"
    states = (State("position", "{x}"), State("velocity", "{x}/s"))
    linear = True
    same_structure = ("second_order_actuator",)
    typical: ClassVar[dict[str, float]] = {"frequency": 14.0, "damping_ratio": 0.04, "load_ratio": 0.35}
    looks_like = (
        "The load swings on after the motor has stopped, at one frequency that the gains hardly move; "
        "with higher gains it grows into a hum."
    )
    remedy = (
        "Stiffen the belt, shaft or mount, or take mass off the load. In the controller: smooth the reference, "
        "put a notch at the resonance or feed the motor's own position back."
    )
    for_the_gain = (
        "Keep the closed loop's frequency below about a third of the resonance. "
        "With the load measured, more kd excites the resonance rather than damping it: there is a largest kd."
    )

    frequency: float = parameter("f", "Hz", "free-free resonance", low=0.1, high=1e5, per_mass=0.5)
    damping_ratio: float = parameter(r"\zeta", "1", "damping of the resonance", high=10.0, per_mass=0.5)
    load_ratio: float = parameter(r"\mu", "1", "load over total moving mass", low=1e-6, high=1 - 1e-6, per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Transmission.physics`."""
        rate, reduced = 2 * pi * p.frequency, p.load_ratio * (1 - p.load_ratio)
        stretch, speed = axis.position - axis.state.position, axis.velocity - axis.state.velocity
        return reduced * (rate * rate * stretch + 2 * p.damping_ratio * rate * speed)

    @staticmethod
    def rates(axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Transmission.rates`."""
        return axis.state.velocity, FlexibleCoupling.physics(axis, p) / p.load_ratio

    @staticmethod
    def share(p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Transmission.share`."""
        return p.load_ratio

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`. Beyond half the sampling rate no log shows it ring."""
        return self.frequency * seen.sample_time < 0.5

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[FlexibleCoupling]:
        """See :meth:`servolens.effects.base.Effect.starts`. From as slow as the axis moves, to what a log shows."""
        lowest, highest = max(seen.speed, 1e-9) / seen.travel / (2 * pi), SHOWN / max(seen.sample_time, 1e-9)
        octaves = log2(max(highest / lowest, 1.0))
        for frequency in geomspace(highest / 2.0**octaves, highest, 1 + ceil(PER_OCTAVE * octaves)):
            yield within(cls, frequency=frequency, damping_ratio=0.03, load_ratio=0.4)
