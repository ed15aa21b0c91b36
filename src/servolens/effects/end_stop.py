"""End stop: a hard limit of travel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nextafter
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._contact import CONTACT_RATE, contact_damping, contact_force, contact_frequency, other_contacts
from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from servolens.effects.base import Axis, Seen

__all__ = ["EndStop"]

NEAR_STOP = 0.02
"""Share of the travel within which of a stop the axis may be in contact."""
NOISE_DEVIATIONS = 4.0
"""How many standard deviations of the noise the largest of a few thousand samples may be off."""
NOT_REACHED = 100.0
"""Travels beyond the positions seen, where a stop is put that the axis does not reach: other records do not, either."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class EndStop(Force):
    """The axis runs into a hard limit of its travel.

    The contact can only push. Its frequency with the moving mass and its damping are those of a stiff one that is
    critically damped, unless the records show others: a push of 10 m/s² enters that by 2.5 µm.
    """

    name = "end_stop"
    spoken = "an end stop"
    sentence = "The axis runs into a hard limit of its travel."
    latex = r"\max(0,\ k\delta + d\dot\delta)\ \mathrm{inwards},\ \delta = \mathrm{depth\ in\ the\ stop}"
    absent_at: ClassVar[dict[str, float]] = {"low": -1e12, "high": 1e12}
    contact_rate = CONTACT_RATE
    typical: ClassVar[dict[str, float]] = {"low": -0.05, "high": 0.04}
    looks_like = (
        "Moves end abruptly always at the same position, whatever the reference asks; "
        "there the command stays large and the axis stands still."
    )
    remedy = (
        "Keep references inside the travel, or move the stop or the zero of the encoder. "
        "Do not identify from records that hit the stop if others are at hand."
    )
    for_the_gain = (
        "No gain helps beyond the stop. Leave room for overshoot: with less kd the axis may hit the stop "
        "though the target lies before it."
    )

    low: float = parameter(r"y_\mathrm{min}", "{x}", "position of the lower stop", low=-1e12, per_mass=0)
    high: float = parameter(r"y_\mathrm{max}", "{x}", "position of the upper stop", low=-1e12, per_mass=0)
    contact_frequency: float = contact_frequency()
    contact_damping: float = contact_damping()

    def __post_init__(self) -> None:
        Force.__post_init__(self)
        if not self.low < self.high:
            raise InputError(f"{self.name}: low must be less than high, got low {self.low:g} and high {self.high:g}")

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        above, below = axis.position - p.high, p.low - axis.position
        return contact_force(above, axis.velocity, p) - contact_force(below, -axis.velocity, p)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[EndStop]:
        """See :meth:`servolens.effects.base.Effect.starts`: where the positions end, at one side or at both.

        At the ends, and inside, for a stop that the axis does not reach changes nothing; the other one is far away.
        """
        low, high = seen.low, max(seen.low + seen.travel, nextafter(seen.low, inf))
        for inside in (0.0, NEAR_STOP):
            room = min(inside * seen.travel + NOISE_DEVIATIONS * seen.noise, 0.25 * seen.travel)
            for first, last in (
                (low + room, high - room),
                (low - NOT_REACHED * seen.travel, high - room),
                (low + room, high + NOT_REACHED * seen.travel),
            ):
                if first < last:
                    yield within(cls, low=first, high=last)

    def freed(self) -> Iterator[EndStop]:
        """See :meth:`servolens.effects.base.Effect.freed`: with another contact."""
        yield from other_contacts(self)

    def simplified(self, seen: Seen) -> Iterator[EndStop]:
        """See :meth:`servolens.effects.base.Effect.simplified`: with one of two stops that may never be reached."""
        away = NOT_REACHED * seen.travel
        if self.low > seen.low - away and self.high < seen.high + away:
            yield replace(self, low=seen.low - away)
            yield replace(self, high=seen.high + away)

    def shifted(self, by: float) -> EndStop:
        """See :meth:`servolens.effects.base.Effect.shifted`: both stops, but for one that is not there."""
        low, high = (v if v == none else v + by for v, none in zip(self.values, self.absent_at.values(), strict=False))
        return replace(self, low=low, high=high)

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`: whether the axis reaches one of the stops."""
        noise = NOISE_DEVIATIONS * seen.noise
        return self.high <= seen.high + noise or self.low >= seen.low - noise

    def is_free(self, position: NDArray[np.float64], seen: Seen) -> NDArray[np.bool_]:
        """See :meth:`servolens.effects.base.Effect.is_free`: between the stops, not near them."""
        room = NEAR_STOP * seen.travel + NOISE_DEVIATIONS * seen.noise
        return (position > max(self.low, seen.low) + room) & (position < min(self.high, seen.high) - room)
