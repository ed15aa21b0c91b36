"""What the gains of a law are called in figures, and their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from servolens.design import PDSpec
    from servolens.plant import Plant

__all__ = ["GainNames", "gain_names"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class GainNames:
    """Names and units of the gains of a law.

    Attributes
    ----------
    kp, free, integral : str
        Symbols: of the proportional gain, of the one that is sought, and of the integral one.
    kp_unit, free_unit, integral_unit : str
        Their units.
    free_meaning : str
        What the gain that is sought is.
    law : str
        What such a controller is called.
    """

    kp: str
    free: str
    integral: str
    kp_unit: str
    free_unit: str
    integral_unit: str
    free_meaning: str
    law: str

    @property
    def kp_label(self) -> str:
        """The proportional gain as "Quantity [unit]"."""
        return f"{self.kp} [{self.kp_unit}]"

    @property
    def free_label(self) -> str:
        """The gain that is sought as "Quantity [unit]"."""
        return f"{self.free_meaning} {self.free} [{self.free_unit}]"


def gain_names(spec: PDSpec, plant: Plant) -> GainNames:
    """Return the names of the gains of the loop that `spec` asks for.

    Examples
    --------
    >>> from servolens import PDSpec, Plant
    >>> names = gain_names(PDSpec(kp=20, settling_time=0.5, controller="cascade"), Plant(gain=1.8, damping=6.0))
    >>> names.kp_label, names.free_label
    ('Kp [1/s]', 'Gain of the speed loop Kv [V s/m]')
    """
    command, length = plant.command_unit, plant.length_unit
    if spec.controller == "cascade":
        return GainNames(
            kp="Kp",
            free="Kv",
            integral="Kiv",
            kp_unit="1/s",
            free_unit=f"{command} s/{length}",
            integral_unit=f"{command}/{length}",
            free_meaning="Gain of the speed loop",
            law="cascade",
        )
    return GainNames(
        kp="Kp",
        free="Kd",
        integral="Ki",
        kp_unit=f"{command}/{length}",
        free_unit=f"{command} s/{length}",
        integral_unit=f"{command}/({length} s)",
        free_meaning="Derivative gain",
        law="PID" if spec.ki else "PD",
    )
