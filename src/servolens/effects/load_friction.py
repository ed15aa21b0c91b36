"""Load friction: dry friction that grows with the transmitted force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import DryFriction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["LoadFriction"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class LoadFriction(DryFriction):
    """Dry friction grows with the force that the gear transmits.

    That force is ``β·a(V)`` plus the sum of the subtracted forces that depend on position and time only: a motor that
    holds a weight transmits twice it, one that the weight drives transmits the difference.
    """

    name = "load_friction"
    spoken = "friction that grows with the load"
    sentence = "Dry friction grows with the force that the gear transmits."
    latex = r"\rho\,|\beta\,a(V) + f(y, t)|\,\operatorname{sgn} v"
    absent_at: ClassVar[dict[str, float]] = {"share": 0.0}
    typical: ClassVar[dict[str, float]] = {"share": 0.2}
    looks_like = (
        "Friction is small without load and large under load: the axis starts easily, "
        "yet with a weight or a large command it needs more force to lift than to lower."
    )
    remedy = (
        "Gears with much sliding do this (worm, screw, harmonic drive): lubricate them, reduce the preload, "
        "or balance the load. Friction compensation must follow the commanded force, not only the sign of the speed."
    )
    for_the_gain = (
        "The axis answers with gain (1 - share) while the motor drives it and with gain (1 + share) while it brakes: "
        "choose kp for the smaller and check overshoot with the larger."
    )

    share: float = parameter(r"\rho", "1", "friction over transmitted force", high=0.999, per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        from casadi import fabs

        return p.share * fabs(axis.load)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[LoadFriction]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for share in (0.1, 0.3, 0.03):
            yield within(cls, share=share)
