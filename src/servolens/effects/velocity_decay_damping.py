"""The paper's damping law: extra damping that fades with speed (eq. 20, in |v|)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects._grids import within
from servolens.effects.base import parameter
from servolens.effects.kinds import Force

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.effects.base import Axis, Seen

__all__ = ["VelocityDecayDamping"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityDecayDamping(Force):
    """Damping is higher at low speed and decays exponentially to its base value as the axis moves faster."""

    name = "velocity_decay_damping"
    spoken = "damping that falls with speed"
    sentence = "Damping is higher at low speed and decays exponentially to its base value as the axis moves faster."
    latex = r"\alpha_1 e^{-\alpha_2 |v|}\,v"
    absent_at: ClassVar[dict[str, float]] = {"alpha1": 0.0}
    typical: ClassVar[dict[str, float]] = {"alpha1": 16.0, "alpha2": 12.0}
    looks_like = (
        "Fast moves meet little damping and the last, slow part of each move creeps: "
        "the damping identified from the record varies with the speed."
    )
    remedy = (
        "Grease that stiffens at rest, seals or friction that eases with speed are the usual causes. "
        "Identify with the velocity model; one constant damping fits at one speed only."
    )
    for_the_gain = (
        "A linear design trusts damping that is gone at high speed and overshoots, or creeps with too much kd: "
        "choose kd on this model."
    )

    alpha1: float = parameter(r"\alpha_1", "1/s", "extra damping at standstill", per_mass=1)
    alpha2: float = parameter(r"\alpha_2", "s/{x}", "how fast it fades with speed", per_mass=0)

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.Force.physics`."""
        from casadi import exp

        return p.alpha1 * exp(-p.alpha2 * axis.speed) * axis.velocity

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[VelocityDecayDamping]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        for fades in (3.0, 10.0, 30.0):
            yield within(cls, alpha1=max(abs(seen.damping), 1.0), alpha2=fades / max(seen.speed, 1e-9))
