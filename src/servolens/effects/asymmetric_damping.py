"""Asymmetric damping: more in one direction than in the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["AsymmetricDamping"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class AsymmetricDamping(Force):
    """Viscous damping is larger in one direction of motion than in the other."""

    name = "asymmetric_damping"
    spoken = "damping that differs by direction"
    sentence = "Viscous damping is larger in one direction of motion than in the other."
    latex = r"\frac{Δ}{2}\,|v|"
    absent_at: ClassVar[dict[str, float]] = {"damping_difference": 0.0}
    typical: ClassVar[dict[str, float]] = {"damping_difference": 1.2}
    looks_like = "Moves up and moves down of the same size differ in speed and overshoot, but both end at the target."
    remedy = (
        "Look for a one-way flow (a hydraulic or pneumatic throttle), a brush or a drive with different gains by sign. "
        "A velocity feedforward with a value for each direction evens it out."
    )
    for_the_gain = "Choose kd for the direction with less damping, and check the settling time in the other."

    damping_difference: float = parameter(
        "Δ", "1/s", "damping while the position grows less that while it falls", low=-1e12, per_mass=1
    )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        return p.damping_difference / 2 * axis.speed

    def is_whole(self, seen: Seen) -> bool:
        """See :meth:`servolens.effects.base.Effect.is_whole`.

        Damping that stops the axis within a sample in one direction, and not in the other, is what holds it: friction.
        """
        return abs(self.damping_difference) * seen.sample_time <= max(1.0, 2.0 * seen.damping * seen.sample_time)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[AsymmetricDamping]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        yield within(cls, damping_difference=0.3 * abs(seen.damping))
