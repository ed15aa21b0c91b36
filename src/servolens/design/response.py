"""A simulated step response, measured against a spec."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.decoding import read_fields

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Response"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """A simulated step response with one gain, measured against a spec.

    Attributes
    ----------
    kd : float
        Derivative gain [V s/m].
    settling_time : float or None
        When the error enters the band for good [s]; None if it does not within the horizon.
    overshoot : float
        Fraction of the step.
    peak_voltage : float
        Largest |V| that the controller asks for [V].
    peak_speed : float
        Largest |velocity| [m/s or rad/s].
    final_error : float
        Fraction of the step.
    meets : bool
        Whether all of the spec holds.
    stable : bool
        Whether the axis stays within all bounds; if not, overshoot, voltage, speed and error are infinite.
    """

    kd: float
    settling_time: float | None
    overshoot: float
    peak_voltage: float
    peak_speed: float
    final_error: float
    meets: bool
    stable: bool = True

    def to_json(self) -> dict[str, Any]:
        """Return the fields; what is not reached, or grows without bound, is null with a reason."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        result = {name: value if value is None or np.isfinite(value) else None for name, value in values.items()}
        if not self.stable:
            result["reason"] = "the loop is unstable with this gain"
        elif self.settling_time is None:
            result["reason"] = "the error does not stay within the band before the simulation's horizon"
        return result

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Response:
        """Build the response from what :meth:`to_json` returned."""
        return read_fields(cls, {**data, "stable": data.get("peak_voltage") is not None})
