"""What a gain has to achieve, and in which loop."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, final

import numpy as np

from servolens.controller import AntiWindup, Controller
from servolens.errors import InputError, flags, unwrapped

__all__ = ["LINEAR_LIMITS", "PDSpec"]

WORDS = ("control", "controller", "anti_windup", "derivative", "hunting")
LINEAR_LIMITS = ("peak_sensitivity", "peak_complementary", "delay_margin", "noise_gain")
"""What the linearised loop must keep to."""
MOST_SAMPLES = 20_000
"""Samples within a settling time; more would take minutes and show nothing new."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class PDSpec:
    """A step response to be reached with the least derivative gain; in a cascade, the least gain of the speed loop.

    Parameters
    ----------
    kp : float
        Proportional gain [V/m or V/rad], positive; of a cascade's position loop [1/s].
    settling_time : float
        The error stays within the band from this time on [s], positive.
    band : float
        Fraction of the step, in (0, 1).
    reference : float
        Size of the step [m or rad], not zero.
    overshoot : float, optional
        Largest overshoot as a fraction of the step, at least 0 and below 1.
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
    derivative_window : int
        Samples over which the digital loop takes its difference, positive.
    derivative : {"position", "velocity"}
        What the digital loop makes its derivative of: differences of the position, or a velocity signal of its own.
    controller : {"pd", "cascade"}
        The law: PD or PID, whose kd is sought; or P of the position and PI of the speed, whose kv is.
    ki, setpoint_weight : float
        Integral gain [V/(m s) or V/(rad s)], not negative, and set-point weight of a PID.
    kiv : float
        Integral gain of a cascade's speed loop [V/m or V/rad], not negative.
    anti_windup : {"none", "clamping", "back_calculation"}
        What the integral does at the plant's voltage limit (its saturation), where it has one.
    hunting : bool
        Whether a limit cycle around the reference is admissible, see :func:`servolens.design.hunting`.
    peak_sensitivity, peak_complementary : float, optional
        Largest Ms and Mt of the linearised loop, above 1 and positive.
    delay_margin : float, optional
        By how much the command must be able to come later [s], positive.
    noise_gain : float, optional
        Largest r.m.s. of the command of a digital loop for white measurement noise of r.m.s. 1 [V/m], positive.

    Raises
    ------
    InputError
        If a value is outside its range.
    """

    example: ClassVar[str] = "PDSpec(kp=100, settling_time=0.5)"

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
    derivative_window: int = 1
    derivative: Literal["position", "velocity"] = "position"
    controller: Literal["pd", "cascade"] = "pd"
    ki: float = 0.0
    setpoint_weight: float = 1.0
    kiv: float = 0.0
    anti_windup: AntiWindup = "none"
    hunting: bool = True
    peak_sensitivity: float | None = None
    peak_complementary: float | None = None
    delay_margin: float | None = None
    noise_gain: float | None = None

    def __post_init__(self) -> None:
        _check_numbers(self)
        flags(hunting=self.hunting)
        for name in ("kp", "settling_time", "sample_time"):
            _check(name, getattr(self, name), 0.0, np.inf)
        _check("band", self.band, 0.0, 1.0)
        if not (np.isfinite(self.reference) and self.reference != 0):
            raise InputError(f"reference must be finite and not 0, got {self.reference!r}")
        if self.overshoot is not None:
            _check_overshoot(self.overshoot)
        for name in ("voltage_limit", "kd_max", *LINEAR_LIMITS):
            if getattr(self, name) is not None:
                _check(name, getattr(self, name), 1.0 if name == "peak_sensitivity" else 0.0, np.inf)
        if not 0 < self.derivative_filter <= 1:
            raise InputError(f"derivative_filter must lie in (0, 1], got {self.derivative_filter!r}")
        if self.control not in ("sampled", "continuous"):
            raise InputError(f"control must be 'sampled' or 'continuous', got {self.control!r}")
        _check_window(self)
        _check_law(self)
        if self.settling_time > MOST_SAMPLES * self.sample_time:
            raise InputError(
                f"settling_time {self.settling_time:g} s is more than {MOST_SAMPLES} samples of "
                f"{self.sample_time:g} s; choose a longer sample_time"
            )
        if self.settling_time < 3 * self.sample_time:
            raise InputError(
                f"settling_time {self.settling_time:g} s is less than three samples of {self.sample_time:g} s"
            )

    @property
    def free(self) -> Literal["kd", "kv"]:
        """The gain that is sought."""
        return "kv" if self.controller == "cascade" else "kd"

    @property
    def is_pd(self) -> bool:
        """Whether the loop is nothing but kp and kd, of the position and its last difference."""
        is_plain = self.derivative == "position" and self.derivative_window == 1
        return self.controller == "pd" and self.ki == 0 and self.setpoint_weight == 1 and is_plain

    @property
    def derivative_settings(self) -> dict[str, float | str]:
        """What its derivative is made of: the filter, and where they are not the usual ones, window and signal."""
        window = {"derivative_window": self.derivative_window} if self.derivative_window > 1 else {}
        signal = {} if self.derivative == "position" else {"derivative": self.derivative}
        return {"derivative_filter": self.derivative_filter, **window, **signal}

    @property
    def derivative_words(self) -> str:
        """The same as a sentence has it, ``"derivative_filter = 1, derivative_window = 2"``."""
        told = self.derivative_settings.items()
        return ", ".join(f"{name} = {value if isinstance(value, str) else f'{value:.4g}'}" for name, value in told)

    @property
    def noise_remark(self) -> str:
        """What the noise of its command leaves out, as a sentence; empty for nothing."""
        is_signal = self.derivative == "velocity"
        return "The noise of the velocity signal is not known and counts as none here." if is_signal else ""

    @property
    def limits(self) -> dict[str, float]:
        """What the linearised loop must keep to, where that is stated."""
        stated = {name: getattr(self, name) for name in LINEAR_LIMITS}
        return {name: value for name, value in stated.items() if value is not None}

    def loop(self, gain: float) -> Controller:
        """Return the digital loop with the gain that is sought; a cascade without it does nothing."""
        window, derivative = self.derivative_window, self.derivative
        if self.controller == "pd":
            return Controller(
                kp=self.kp,
                kd=gain,
                ki=self.ki,
                setpoint_weight=self.setpoint_weight,
                anti_windup=self.anti_windup if self.ki else "none",
                derivative_filter=self.derivative_filter,
                derivative_window=window,
                derivative=derivative,
            )
        if gain == 0:
            return Controller(kp=0.0)
        return Controller.cascade(
            kp=self.kp,
            kv=gain,
            kiv=self.kiv,
            anti_windup=self.anti_windup if self.kiv else "none",
            derivative_filter=self.derivative_filter,
            derivative_window=window,
            derivative=derivative,
        )

    def gains(self, gain: float | None) -> dict[str, float | None]:
        """Return all gains of the loop by name, with the one that is sought."""
        if self.controller == "cascade":
            return {"kp": self.kp, "kv": gain, "kiv": self.kiv}
        return {"kp": self.kp, "kd": gain, "ki": self.ki or None}

    def scaled(self, factor: float) -> PDSpec:
        """Return the spec of a loop whose command is multiplied by `factor`, and so is the gain that is sought."""
        limit = None if self.voltage_limit is None else factor * self.voltage_limit
        if self.controller == "cascade":
            return replace(self, kiv=factor * self.kiv, voltage_limit=limit)
        return replace(self, kp=factor * self.kp, ki=factor * self.ki, voltage_limit=limit)

    def rate(self, plant_gain: float) -> float:
        """Return how fast the loop is without damping [rad/s], around an axis of so much gain."""
        return self.kp if self.controller == "cascade" else float(np.sqrt(abs(plant_gain) * self.kp))

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def _check_law(spec: PDSpec) -> None:
    words = {
        "controller": ("pd", "cascade"),
        "anti_windup": ("none", "clamping", "back_calculation"),
        "derivative": ("position", "velocity"),
    }
    for name, allowed in words.items():
        if getattr(spec, name) not in allowed:
            raise InputError(f"{name} must be {' or '.join(map(repr, allowed))}, got {getattr(spec, name)!r}")
    for name in ("ki", "kiv"):
        if not (np.isfinite(getattr(spec, name)) and getattr(spec, name) >= 0):
            raise InputError(f"{name} must be finite and not negative, got {getattr(spec, name)!r}")
    if not np.isfinite(spec.setpoint_weight):
        raise InputError(f"setpoint_weight must be finite, got {spec.setpoint_weight!r}")
    if spec.controller == "cascade" and (spec.ki or spec.setpoint_weight != 1):
        raise InputError("a cascade has no ki and no setpoint_weight; the integral of its speed loop is kiv")
    if spec.controller == "pd" and spec.kiv:
        raise InputError("kiv is for a cascade only; ask for a cascade, or give ki")
    if spec.control == "continuous":
        _check_ideal(spec)
    if not (spec.ki or spec.kiv or spec.anti_windup == "none"):
        raise InputError(f"anti_windup = {spec.anti_windup} needs an integral; give ki, or kiv of a cascade")


def _check_window(spec: PDSpec) -> None:
    window = spec.derivative_window
    if not (window >= 1 and window % 1 == 0):
        raise InputError(f"derivative_window must be a whole number of samples, at least 1, got {window!r}")
    if window > 1 and spec.derivative == "velocity":
        raise InputError(
            f"derivative_window = {window:g} is for differences of the position, and derivative = velocity has none;"
            " leave one of them out"
        )
    object.__setattr__(spec, "derivative_window", int(window))


def _check_ideal(spec: PDSpec) -> None:
    if not spec.is_pd:
        raise InputError(
            "control = continuous is the ideal PD; an integral, a cascade, a velocity signal and a difference over"
            " several samples need control = sampled"
        )
    if spec.noise_gain is not None:
        raise InputError("the noise of an ideal continuous PD is not finite, so noise_gain needs control = sampled")


def _check_numbers(spec: PDSpec) -> None:
    """Convert and check what has to be a number."""
    for field in (f for f in fields(spec) if f.name not in WORDS):
        value = unwrapped(getattr(spec, field.name))
        object.__setattr__(spec, field.name, value)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not (is_number or (value is None and field.default is None)):
            raise InputError(f"{field.name} must be a number, got {value!r}")


def _check_overshoot(overshoot: float) -> None:
    if not (np.isfinite(overshoot) and overshoot >= 0):
        raise InputError(f"overshoot must not be negative, got {overshoot!r}")
    if overshoot >= 1:
        raise InputError(
            f"overshoot is a fraction of the step, below 1; got {overshoot!r} ({overshoot:g} % is {overshoot / 100:g})"
        )


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (np.isfinite(value) and low < value < high):
        least = f"larger than {low:g} and finite" if low else "positive and finite"
        limits = f"between {low:g} and {high:g}" if np.isfinite(high) else least
        raise InputError(f"{name} must be {limits}, got {value!r}")
