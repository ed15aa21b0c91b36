"""What a PD gain has to achieve."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, final

import numpy as np

from servolens.errors import InputError

__all__ = ["PDSpec"]


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
    kd_max : float, optional
        End of the search, which begins at 0 [V s/m], positive. Where it is not given it follows from the plant, and the
        spec of a design states it.
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
    kd_max: float | None = None
    control: Literal["sampled", "continuous"] = "sampled"
    sample_time: float = 1e-3
    derivative_filter: float = 1.0

    def __post_init__(self) -> None:
        _check_numbers(self)
        for name in ("kp", "settling_time", "sample_time"):
            _check(name, getattr(self, name), 0.0, np.inf)
        _check("band", self.band, 0.0, 1.0)
        if not (np.isfinite(self.reference) and self.reference != 0):
            raise InputError(f"reference must be finite and not 0, got {self.reference!r}")
        if self.overshoot is not None and not (np.isfinite(self.overshoot) and self.overshoot >= 0):
            raise InputError(f"overshoot must not be negative, got {self.overshoot!r}")
        for name in ("voltage_limit", "kd_max"):
            if getattr(self, name) is not None:
                _check(name, getattr(self, name), 0.0, np.inf)
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
