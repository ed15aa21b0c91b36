"""What a PD gain has to achieve, and what was found."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, final

import numpy as np

from servolens.errors import InputError

__all__ = ["Comparison", "Design", "PDSpec", "Response"]


MOST_SAMPLES = 20_000
"""Samples within a settling time; more would take minutes and show nothing new."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PDSpec:
    """A step response to be reached with the least derivative gain.

    Parameters
    ----------
    kp : float
        Proportional gain [V/m or V/rad], positive.
    settling_time : float
        The error stays within the band from this time on [s], positive.
    band : float
        Fraction of the step, in (0, 1).
    reference : float
        Size of the step [m or rad], not zero.
    overshoot : float, optional
        Largest overshoot as a fraction of the step, not negative.
    voltage_limit : float, optional
        Largest voltage that the controller may ask for [V], positive.
    kd_max : float
        End of the search, which begins at 0 [V s/m], positive.
    control : {"sampled", "continuous"}
        The digital loop, or the paper's ideal continuous PD (eq. 15).
    sample_time : float
        Of the digital loop [s], positive.
    derivative_filter : float
        Of the digital loop, in (0, 1]; 1 is no filter.

    Raises
    ------
    InputError
        If a value is outside its range.
    """

    kp: float
    settling_time: float
    band: float = 0.01
    reference: float = 0.1
    overshoot: float | None = None
    voltage_limit: float | None = None
    kd_max: float = 20.0
    control: Literal["sampled", "continuous"] = "sampled"
    sample_time: float = 1e-3
    derivative_filter: float = 1.0

    def __post_init__(self) -> None:
        _check_numbers(self)
        for name in ("kp", "settling_time", "kd_max", "sample_time"):
            _check(name, getattr(self, name), 0.0, np.inf)
        _check("band", self.band, 0.0, 1.0)
        if not (np.isfinite(self.reference) and self.reference != 0):
            raise InputError(f"reference must be finite and not 0, got {self.reference!r}")
        if self.overshoot is not None and not (np.isfinite(self.overshoot) and self.overshoot >= 0):
            raise InputError(f"overshoot must not be negative, got {self.overshoot!r}")
        if self.voltage_limit is not None:
            _check("voltage_limit", self.voltage_limit, 0.0, np.inf)
        if not 0 < self.derivative_filter <= 1:
            raise InputError(f"derivative_filter must lie in (0, 1], got {self.derivative_filter!r}")
        if self.control not in ("sampled", "continuous"):
            raise InputError(f"control must be 'sampled' or 'continuous', got {self.control!r}")
        if self.settling_time > MOST_SAMPLES * self.sample_time:
            raise InputError(
                f"settling_time {self.settling_time:g} s is more than {MOST_SAMPLES} samples of "
                f"{self.sample_time:g} s; choose a longer sample_time"
            )
        if self.settling_time < 3 * self.sample_time:
            raise InputError(
                f"settling_time {self.settling_time:g} s is less than three samples of {self.sample_time:g} s"
            )

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


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
    final_error : float
        Fraction of the step.
    meets : bool
        Whether all of the spec holds.
    """

    kd: float
    settling_time: float | None
    overshoot: float
    peak_voltage: float
    final_error: float
    meets: bool

    def to_json(self) -> dict[str, Any]:
        """Return the fields; a settling time that is not reached is null with a reason."""
        result: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        if self.settling_time is None:
            result["reason"] = "the error does not stay within the band before the simulation's horizon"
        return result


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """The least derivative gain that meets a spec.

    Attributes
    ----------
    spec : PDSpec
        What was asked.
    kd : float or None
        The least gain; None if none meets the spec.
    intervals : tuple of (float, float)
        All feasible gains in the searched range, for all models at once.
    gap : float
        Width within which each end of an interval is known, and of the narrowest interval that is not overlooked
        while the margin changes no faster than its measured sensitivity.
    candidates : tuple of float or None
        The local optimum of CasADi's nonlinear program in each interval, None where it found none. The program smooths
        dry friction; the ends of `intervals` are the exact loop's.
    verified : tuple of Response
        Exact simulation at `kd`, a model each.
    reason : str or None
        Why there is none.
    """

    spec: PDSpec
    kd: float | None
    intervals: tuple[tuple[float, float], ...]
    gap: float
    candidates: tuple[float | None, ...] = ()
    verified: tuple[Response, ...] = ()
    reason: str | None = None

    @property
    def feasible(self) -> bool:
        """Whether any gain meets the spec."""
        return self.kd is not None

    @property
    def margin(self) -> float | None:
        """How far the gain may rise before the spec breaks [V s/m]."""
        return None if self.kd is None else self.intervals[0][1] - self.kd

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.design/1`` without the file's header."""
        worst = max(self.verified, key=lambda r: np.inf if r.settling_time is None else r.settling_time, default=None)
        result: dict[str, Any] = {
            "feasible": self.feasible,
            "kd": self.kd,
            "kp": self.spec.kp,
            "settling_time": None if worst is None else worst.settling_time,
            "intervals": [list(interval) for interval in self.intervals],
            "certificate": {"searched": [0.0, self.spec.kd_max], "gap": self.gap},
            "candidates": list(self.candidates),
            "margin": self.margin,
            "verified": None if worst is None else worst.to_json(),
            "models": [response.to_json() for response in self.verified],
            "spec": self.spec.to_json(),
        }
        if self.reason is not None:
            result["reason"] = self.reason
        return result


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Linear and nonlinear recommendation side by side.

    Attributes
    ----------
    linear, nonlinear : Design
        Each designed on its own model.
    linear_on_nonlinear : Response or None
        The linear recommendation run on the nonlinear plant; None if there is none.
    """

    linear: Design
    nonlinear: Design
    linear_on_nonlinear: Response | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.comparison/1`` without the file's header."""
        on = self.linear_on_nonlinear
        own = self.nonlinear.verified[0].to_json() if self.nonlinear.verified else None
        return {
            "linear": {**self.linear.to_json(), "on_nonlinear": None if on is None else on.to_json()},
            "nonlinear": {**self.nonlinear.to_json(), "on_nonlinear": own},
        }


def _check_numbers(spec: PDSpec) -> None:
    for field in fields(spec):
        value = getattr(spec, field.name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if field.name != "control" and not (is_number or (value is None and field.default is None)):
            raise InputError(f"{field.name} must be a number, got {value!r}")


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (np.isfinite(value) and low < value < high):
        limits = f"between {low:g} and {high:g}" if np.isfinite(high) else "positive and finite"
        raise InputError(f"{name} must be {limits}, got {value!r}")
