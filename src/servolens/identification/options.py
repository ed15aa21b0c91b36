"""What is wanted of a fit."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - dataclass fields are looked at by tools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, final, get_args

from servolens.errors import InputError

if TYPE_CHECKING:
    from servolens.identification.integral import Prior

__all__ = ["FitOptions"]

Loss = Literal["squares", "huber"]
Driven = Literal["auto", "closed_loop", "voltage"]
Compared = Literal["position", "voltage"]
Begin = Literal["rest", "motion"]
CHOICES = {"loss": Loss, "driven": Driven, "compared": Compared, "begin": Begin}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """How a plant is fitted.

    Parameters
    ----------
    held : tuple of str
        Qualified names of parameters that stay as given.
    local : tuple of str
        Parameters that each record has of its own, e.g. ``"periodic_disturbance.phase"``.
    priors : mapping of str to Prior
        Knowledge from elsewhere, by qualified name.
    bounds : mapping of str to tuple of float
        Least and largest value of parameters, by qualified name, within what their effects admit.
    loss : {"squares", "huber"}
        Whether outliers count as squares or linearly.
    driven : {"auto", "closed_loop", "voltage"}
        Whether the runs are simulated in closed loop from the reference, or driven by the voltage; ``"auto"`` begins
        in closed loop where it can, but for contacts, and lets the voltage have the last word where the model then
        reaches the noise.
    compared : {"position", "voltage"}
        What of a closed loop is compared. A stiff loop hides in its position what its voltage shows; with ``"voltage"``
        all runs are simulated in closed loop.
    begin : {"rest", "motion"}
        Whether the records begin at rest; where the logged voltage drives them, but for what a loop that already works
        makes of the sensor's noise. With ``"motion"`` each record's initial position and velocity are free, and the
        controller's memory of the time before is read off the logged voltage.

    Raises
    ------
    InputError
        If a choice is none of these, choices do not go together, or a bound is no range.
    """

    held: tuple[str, ...] = ()
    local: tuple[str, ...] = ()
    priors: Mapping[str, Prior] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    loss: Loss = "squares"
    driven: Driven = "auto"
    compared: Compared = "position"
    begin: Begin = "rest"

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value, known = getattr(self, name), get_args(choices)
            if value not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}; got {value!r}")
        for name in ("held", "local"):
            if isinstance(getattr(self, name), str):
                raise InputError(f"{name} must be a tuple of names; write ({getattr(self, name)!r},)")
        for name, (low, high) in self.bounds.items():
            if not low < high:
                raise InputError(f"the bounds of {name} must be a least and a larger value; got {low} and {high}")
        if self.compared == "voltage" and self.driven == "voltage":
            raise InputError(
                "a run that is driven by the voltage cannot be compared by it; choose driven='closed_loop'"
            )
