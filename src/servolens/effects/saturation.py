"""Saturation: the amplifier gives no more than its limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from servolens.effects.base import Actuator, parameter

if TYPE_CHECKING:
    from servolens.effects.base import Axis

__all__ = ["Saturation"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Saturation(Actuator):
    """The amplifier clips the command at its limit."""

    name = "saturation"
    sentence = "The amplifier clips the command at its limit."
    latex = r"\operatorname{clip}(V, \pm V_\mathrm{max})"
    stage = 10

    limit: float = parameter(r"V_\mathrm{max}", "{u}", "largest command that the amplifier passes on")

    @staticmethod
    def physics(command: Any, axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.base.Actuator.physics`."""
        from casadi import fmax, fmin

        return fmin(fmax(command, -p.limit), p.limit)
