"""Force limit: the current stops growing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import MotorForce

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["ForceLimit"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ForceLimit(MotorForce):
    """The motor's force, its current, stops growing at a limit, whatever the voltage."""

    name = "force_limit"
    spoken = "a limit of force"
    sentence = "The motor's force, its current, stops growing at a limit, whatever the voltage."
    latex = r"\operatorname{clip}(\beta a - c v,\ \pm a_\mathrm{max})"
    absent_at: ClassVar[dict[str, float]] = {"acceleration": 1e12}
    typical: ClassVar[dict[str, float]] = {"acceleration": 5.0}
    looks_like = (
        "Large steps start and brake with the same constant acceleration, whatever kp; "
        "unlike a voltage limit, braking is limited too and the top speed is not."
    )
    remedy = (
        "Raise the drive's current limit if motor and gears allow, or give the reference as a profile "
        "whose acceleration stays below the limit."
    )
    for_the_gain = (
        "A kp that asks for more than the limit only adds overshoot: the brake is as weak as the push. "
        "Choose kd by the largest step that must not overshoot."
    )

    acceleration: float = parameter(
        r"a_\mathrm{max}", "{x}/s^2", "largest acceleration that the motor gives", per_mass=1
    )

    @staticmethod
    def physics(push: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.MotorForce.physics`."""
        from casadi import fmax, fmin

        return fmin(fmax(push, -p.acceleration), p.acceleration)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[ForceLimit]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for share in (0.5, 0.7, 0.9, 0.35, 0.2, 0.1):
            yield within(cls, acceleration=share * seen.push)
