"""Backlash: lost motion between motor and load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._contact import CONTACT_RATE, contact_damping, contact_force, contact_frequency, other_contacts
from servolens.effects._grids import within
from servolens.effects.base import State, parameter
from servolens.effects.kinds import Transmission

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["LOAD_DRAG", "Backlash"]

LOAD_DRAG = 2.0  # [1/s] per unit of the load's mass, so that a load between the flanks does not float for ever


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Backlash(Transmission):
    """Between motor and measured load there is play; they touch only at its ends.

    The contact can only push. Its frequency and damping are those of a stiff one that is critically damped, unless the
    records show others.
    """

    name = "backlash"
    sentence = "Between motor and measured load there is play; they touch only at its ends."
    latex = r"\max(0,\ k\delta + d\dot\delta)\,\operatorname{sgn}(x - y),\ \delta = |x - y| - g/2"
    contact_rate = CONTACT_RATE
    states = (State("position", "{x}"), State("velocity", "{x}/s"))
    typical: ClassVar[dict[str, float]] = {"gap": 0.0012, "load_share": 0.35}
    looks_like = (
        "After each reversal the load waits while the motor crosses the gap, then is hit; "
        "at the target it may hunt in a small steady swing about as wide as the gap."
    )
    remedy = (
        "Preload or replace the gear, belt or coupling. In the controller approach targets from one side, "
        "or add the gap to the reference at each reversal."
    )
    for_the_gain = (
        "High kp with the load measured makes the loop hunt in the gap: lower kp or add kd until it stops. "
        "No gain makes the position better than the gap."
    )

    gap: float = parameter("g", "{x}", "all of the lost motion", per_mass=0)
    load_share: float = parameter(r"\mu", "1", "load over total moving mass", low=1e-6, high=1 - 1e-6, per_mass=0)
    contact_frequency: float = contact_frequency()
    contact_damping: float = contact_damping()

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Transmission.physics`."""
        reduced = p.load_share * (1 - p.load_share)
        ahead, speed = axis.position - axis.state.position, axis.velocity - axis.state.velocity
        above, below = ahead - p.gap / 2, -ahead - p.gap / 2
        return contact_force(above, speed, p, reduced) - contact_force(below, -speed, p, reduced)

    @staticmethod
    def rates(axis: Axis, p: Any) -> tuple[Any, ...]:
        """See :meth:`servolens.effects.kinds.Transmission.rates`."""
        velocity = axis.state.velocity
        return velocity, Backlash.physics(axis, p) / p.load_share - LOAD_DRAG * velocity

    @staticmethod
    def share(p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Transmission.share`."""
        return p.load_share

    @property
    def play(self) -> float:
        """See :attr:`servolens.effects.kinds.Transmission.play`."""
        return 0.5 * self.gap

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`: without a gap it is a stiff coupling, and has no play."""
        return self.gap > 0.0

    def freed(self) -> Iterator[Backlash]:
        """See :meth:`servolens.effects.base.Effect.freed`: with another contact."""
        yield from other_contacts(self)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Backlash]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for gap in (1e-3, 3e-3, 1e-2, 3e-2, 3e-4, 1e-4):
            for load in (0.3, 0.6):
                yield within(cls, gap=gap * seen.travel, load_share=load)
