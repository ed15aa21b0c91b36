"""Stribeck friction: sticking takes more than sliding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import DryFriction
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["StribeckFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class StribeckFriction(DryFriction):
    """Dry friction is larger at rest than in motion and changes over a range of low speeds."""

    name = "stribeck_friction"
    spoken = "Stribeck friction"
    sentence = "Dry friction is larger at rest than in motion and changes over a range of low speeds."
    latex = r"(F + S\,e^{-|v|/v_s})\,\operatorname{sgn} v"
    absent_at: ClassVar[dict[str, float]] = {"level": 0.0, "static_excess": 0.0}
    generalises = ("coulomb_friction",)
    typical: ClassVar[dict[str, float]] = {"level": 0.25, "static_excess": 0.2, "stribeck_speed": 0.025}
    looks_like = (
        "At low speed the axis sticks and jumps (stick-slip); near the target it creeps, stops short, "
        "or hunts when there is integral action."
    )
    remedy = (
        "Change lubricant or guide material, or keep out of the slow range with a faster approach. "
        "Friction compensation helps, but less of it than the breakaway level, or the axis limit-cycles."
    )
    for_the_gain = (
        "Friction that falls with speed acts as negative damping near rest: kd must outweigh it there, "
        "and kp must overcome the breakaway level within the error allowed."
    )

    level: float = parameter("F", "{x}/s^2", "friction in fast motion, per unit of moving mass", per_mass=1)
    static_excess: float = parameter(
        "S",
        "{x}/s^2",
        "what friction at rest has more, negative if less; level + static_excess is at least 0",
        low=-1e12,
        per_mass=1,
    )
    stribeck_speed: float = parameter("v_s", "{x}/s", "speed over which the excess fades", low=1e-6, per_mass=0)

    def __post_init__(self) -> None:
        DryFriction.__post_init__(self)
        if self.level + self.static_excess < 0:
            raise InputError(
                f"{self.name}: level + static_excess is the friction at rest and must not be negative, "
                f"got {self.level:g} + ({self.static_excess:g})"
            )

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        from casadi import exp

        return p.level + p.static_excess * exp(-axis.speed / p.stribeck_speed)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[StribeckFriction]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        size = 0.05 * seen.push
        for excess in (size, -0.5 * size):
            for share in (0.01, 0.05, 0.2):
                yield within(cls, level=size, static_excess=excess, stribeck_speed=share * seen.speed)
