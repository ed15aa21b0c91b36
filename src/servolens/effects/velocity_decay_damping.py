"""The paper's damping law: extra damping that fades with speed (eq. 20, in |v|)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from servolens.effects.base import Force, parameter

if TYPE_CHECKING:
    from servolens.effects.base import Axis

__all__ = ["VelocityDecayDamping"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityDecayDamping(Force):
    """Damping is higher at low speed and decays exponentially to its base value as the axis moves faster."""

    name = "velocity_decay_damping"
    sentence = "Damping is higher at low speed and decays exponentially to its base value as the axis moves faster."
    latex = r"\alpha_1 e^{-\alpha_2 |v|}\,v"

    alpha1: float = parameter(r"\alpha_1", "1/s", "extra damping at standstill")
    alpha2: float = parameter(r"\alpha_2", "s/{x}", "how fast it fades with speed")

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.base.Force.physics`."""
        from casadi import exp

        return p.alpha1 * exp(-p.alpha2 * axis.speed) * axis.velocity
