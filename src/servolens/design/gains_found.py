"""What was found of several gains that were chosen together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    from servolens.design.margins import LoopMargins
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.design.wishes import GainWishes

__all__ = ["GainsFound"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class GainsFound:
    """Gains that meet a spec and its wishes, the best that were found.

    Attributes
    ----------
    spec : PDSpec
        With the kp and the derivative filter that were found; as asked where none were.
    wishes : GainWishes
        What was asked beside it.
    kd : float or None
        Derivative gain, or kv of a cascade [V s/m]; None where no gains meet it all.
    value : float or None
        Of the objective.
    verified : tuple of Response
        Exact simulation with these gains, a model each; again on released axes where an integral gain is free and
        something pulls.
    margins : LoopMargins or None
        Of the linearised loop, the worst of models and scenarios.
    probability : float or None
        Share of 200 other scenarios in which they meet the spec; None where no scenarios were asked for.
    interval : (float, float) or None
        Of that probability, 95 % (Clopper and Pearson).
    voltage_noise : float or None
        R.m.s. of the command for the measurement noise [V]; None where that is not known.
    from_program : bool
        Whether they are others than the best of the grid.
    reason : str or None
        Why there are none.
    """

    spec: PDSpec
    wishes: GainWishes
    kd: float | None
    value: float | None = None
    verified: tuple[Response, ...] = ()
    margins: LoopMargins | None = None
    probability: float | None = None
    interval: tuple[float, float] | None = None
    voltage_noise: float | None = None
    from_program: bool = False
    reason: str | None = None

    def __repr__(self) -> str:
        """Return one line: the gains, or why there are none."""
        if self.kd is None:
            return f"<GainsFound: none, as {self.reason or 'none were found'}>"
        gains = (f"{name} = {value:.4g}" for name, value in self.gains.items() if isinstance(value, float | int))
        return f"<GainsFound: {', '.join(gains)}>"

    @property
    def gains(self) -> dict[str, float | str | None]:
        """The gains by name, and what the derivative is made of, with the integral where the loop has one."""
        found = self.kd is not None
        gains: dict[str, float | str | None] = {
            "kp": self.spec.kp if found else None,
            self.spec.free: self.kd,
            **(self.spec.derivative_settings if found else {"derivative_filter": None}),
        }
        integral = {name: value for name in ("ki", "kiv") if (value := getattr(self.spec, name)) and found}
        return gains | integral

    def to_json(self) -> dict[str, Any]:
        """Return what was asked and found."""
        result = {
            **self.gains,
            "wishes": self.wishes.to_json(),
            "value": self.value,
            "models": [response.to_json() for response in self.verified],
            "margins": None if self.margins is None else self.margins.to_json(),
            "probability": None if self.probability is None else {"value": self.probability, "interval": self.interval},
            "voltage_noise": self.voltage_noise,
            "from_program": self.from_program,
        }
        return result if self.reason is None else {**result, "reason": self.reason}
