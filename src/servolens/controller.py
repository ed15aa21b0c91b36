"""The digital controller of a loop: one frozen law, of which P, PD, PID and the cascade of drives are cases."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np

from servolens.errors import InputError, as_number, number_within, unwrapped

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["AntiWindup", "Controller", "as_limit"]

AntiWindup = Literal["none", "clamping", "back_calculation"]
TEXT_CHOICES = {
    "law": ("pd", "cascade"),
    "derivative_on": ("measurement", "error"),
    "derivative": ("position", "velocity"),
    "anti_windup": ("none", "clamping", "back_calculation"),
    "time_step": ("cycle", "measured"),
}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Controller:
    """A digital loop with zero-order hold: P, PD or PID, with two degrees of freedom, or a cascade.

    With e = r − y, and ṙ the backward difference of the reference, at every tick, h apart::

        s[k] = kp (setpoint_weight·r[k] − y[k]) + velocity_feedforward·ṙ[k] − kd d[k]
        I[k] = I[k−1] + h (ki e[k] + integral_rate·s[k])
        V[k] = s[k] + I[k]

    with ``d[k] = d[k−1] + derivative_filter ((y[k] − y[k−w])/(w h) − d[k−1])``. PID has the integral `ki`, the cascade
    of drives (:meth:`cascade`) is a PD with its own output integrated as well. Before the first sample the axis and the
    reference were where they are first seen, and d was 0.

    Parameters
    ----------
    kp : float
        Proportional gain [V/m or V/rad], finite.
    kd : float
        Derivative gain [V s/m or V s/rad], finite.
    ki : float
        Integral gain [V/(m s) or V/(rad s)], finite.
    setpoint_weight : float
        Share of the reference that the proportional part sees, finite; 1 is all of it, 0 is I-PD.
    velocity_feedforward : float
        Voltage for the reference's velocity [V s/m or V s/rad], finite.
    integral_rate : float
        How fast the law's own output s is integrated [1/s], not negative: kiv/kv of a cascade.
    anti_windup : {"none", "clamping", "back_calculation"}
        What the integral does while V is beyond the command's limit. Clamping: it does not grow further beyond.
        Back-calculation: h (sat V − V)/tracking_time is added to it, from the next tick on.
    tracking_time : float or None
        Of back-calculation [s], positive; None is √(kd/ki), kp/ki where kd = 0, 1/integral_rate where ki = 0.
    integral_before : float or None
        I before the first sample [V], finite. None is unstated: 0, unless the log shows it.
    derivative_filter : float
        Share of the new difference in the derivative, in (0, 1]; 1 is no filter.
    derivative_window : int
        Ticks ``w`` that the raw difference spans, at least 1.
    derivative_on : {"measurement", "error"}
        What is differentiated; the measurement is velocity feedback.
    derivative : {"position", "velocity"}
        ``"velocity"``: the loop used a velocity signal of its own instead of a difference.
    control_period : float or None
        Period of the loop [s] where it is slower or faster than the log; None means every sample.
    time_step : {"cycle", "measured"}
        What h is: the loop's cycle, or the time that it measured since its last tick (``dt = now - last``); these
        differ where it runs unevenly.
    law : {"pd", "cascade"}
        By which names its gains are stated and told: those of PD and PID, or of a drive's cascade.

    Raises
    ------
    InputError
        If a value is outside its range.

    References
    ----------
    .. [1] K. J. Åström and T. Hägglund, *Advanced PID Control*, ISA 2006, sections 3.4 (set-point weighting) and 3.5
       (windup; the default tracking time is that of √(Ti Td)).
    """

    example: ClassVar[str] = "Controller(kp=60, kd=1)"

    kp: float
    kd: float = 0.0
    ki: float = 0.0
    setpoint_weight: float = 1.0
    velocity_feedforward: float = 0.0
    integral_rate: float = 0.0
    anti_windup: AntiWindup = "none"
    tracking_time: float | None = None
    integral_before: float | None = None
    derivative_filter: float = 1.0
    derivative_window: int = 1
    derivative_on: Literal["measurement", "error"] = "measurement"
    derivative: Literal["position", "velocity"] = "position"
    control_period: float | None = None
    time_step: Literal["cycle", "measured"] = "cycle"
    law: Literal["pd", "cascade"] = "pd"

    def __post_init__(self) -> None:
        for name in NUMBERS:
            object.__setattr__(self, name, unwrapped(getattr(self, name)))
            _check_number(name, getattr(self, name), optional=name in OPTIONAL)
        for name, allowed in TEXT_CHOICES.items():
            value = getattr(self, name)
            if value not in allowed:
                raise InputError(f"{name} must be {' or '.join(map(repr, allowed))}, got {value!r}")
        if not 0 < self.derivative_filter <= 1:
            raise InputError(f"derivative_filter must lie in (0, 1], got {self.derivative_filter!r}")
        if not (self.derivative_window >= 1 and self.derivative_window == int(self.derivative_window)):
            raise InputError(
                f"derivative_window must be a whole number of samples, at least 1, got {self.derivative_window!r}"
            )
        if self.integral_rate < 0:
            raise InputError(f"integral_rate must not be negative, got {self.integral_rate!r}")
        for name in TIMES:
            value = getattr(self, name)
            if not (value is None or value > 0):
                raise InputError(f"{name} must be positive, got {value!r}")
        if self.anti_windup == "back_calculation" and self.integrates and not self.tracking > 0:
            raise InputError("the default tracking time needs kd and ki, or kp and ki, of one sign; give tracking_time")

    @classmethod
    def cascade(  # noqa: PLR0913 - as the contract of a record names them, all by keyword
        cls,
        *,
        kp: float,
        kv: float,
        kiv: float = 0.0,
        feedforward_speed: float = 0.0,
        anti_windup: AntiWindup = "none",
        tracking_time: float | None = None,
        integral_before: float | None = None,
        derivative_filter: float = 1.0,
        derivative_window: int = 1,
        derivative: Literal["position", "velocity"] = "position",
        control_period: float | None = None,
        time_step: Literal["cycle", "measured"] = "cycle",
    ) -> Controller:
        """Return the cascade of drives: P of the position, PI of the speed.

        ``w = kp (r − y) + feedforward_speed·ṙ`` and ``V = kv (w − d) + kiv Σ h (w − d)``: that is the PD law with kv·kp
        and kv, its output integrated at the rate kiv/kv.

        Parameters
        ----------
        kp : float
            Of the position loop [1/s], finite.
        kv : float
            Of the speed loop [V s/m or V s/rad], not 0.
        kiv : float
            Its integral gain [V/m or V/rad], of the sign of `kv`.
        feedforward_speed : float
            Share of the reference's velocity that the speed loop is given, finite.
        anti_windup, tracking_time, integral_before
            As of the class; the default tracking time is kv/kiv.
        derivative_filter, derivative_window, derivative, control_period, time_step
            As of the class.

        Raises
        ------
        InputError
            If a value is outside its range.

        Examples
        --------
        >>> drive = Controller.cascade(kp=20.0, kv=5.0, kiv=50.0)
        >>> drive.kp, drive.kd, drive.integral_rate
        (100.0, 5.0, 10.0)
        """
        kp, kv, kiv, feedforward_speed = map(unwrapped, (kp, kv, kiv, feedforward_speed))
        for name, value in (("kp", kp), ("kv", kv), ("kiv", kiv), ("feedforward_speed", feedforward_speed)):
            _check_number(name, value)
        if kv == 0:
            raise InputError("kv must not be 0: the speed loop of a cascade needs it")
        if kiv * kv < 0:
            raise InputError(f"kiv must have the sign of kv, got {kiv!r}")
        return cls(
            kp=kv * kp,
            kd=kv,
            velocity_feedforward=kv * feedforward_speed,
            integral_rate=kiv / kv,
            anti_windup=anti_windup,
            tracking_time=tracking_time,
            integral_before=integral_before,
            derivative_filter=derivative_filter,
            derivative_window=derivative_window,
            derivative=derivative,
            control_period=control_period,
            time_step=time_step,
            law="cascade",
        )

    @property
    def is_cascade(self) -> bool:
        """Whether its gains are those of a cascade: stated as one, or of a form that no PID has."""
        return self.law == "cascade" or self.integral_rate != 0

    @property
    def integrates(self) -> bool:
        """Whether the law has an integral."""
        return self.ki != 0 or self.integral_rate != 0 or self.initial_integral != 0

    @property
    def initial_integral(self) -> float:
        """I before the first sample [V]: as stated, else 0."""
        return 0.0 if self.integral_before is None else self.integral_before

    @property
    def is_limited(self) -> bool:
        """Whether the integral depends on the command's limit."""
        return self.integrates and self.anti_windup != "none"

    @property
    def is_pd(self) -> bool:
        """Whether it is nothing but ``V = kp e − kd d``."""
        return not self.integrates and self.setpoint_weight == 1 and self.velocity_feedforward == 0

    @property
    def tracking(self) -> float:
        """The tracking time of back-calculation, its default where none is given [s]; infinite without an integral."""
        if self.tracking_time is not None:
            return self.tracking_time
        if self.ki != 0:
            square = self.kd / self.ki
            return math.copysign(math.sqrt(abs(square)), square) if self.kd != 0 else self.kp / self.ki
        return 1.0 / self.integral_rate if self.integral_rate > 0 else math.inf

    def reference_path(self, frequency: NDArray[np.float64], period: float) -> NDArray[np.complex128]:
        """Return the law from reference to voltage, within its limits, at each `frequency` [Hz].

        Parameters
        ----------
        frequency : ndarray, shape (n,)
            Positive, below half the sampling frequency where the law integrates.
        period : float
            Of the loop [s], where the law has none of its own.
        """
        period = self.control_period or period
        back = np.exp(-2j * np.pi * period * np.asarray(frequency))
        change = (1.0 - back) / period
        proportional = self.kp * self.setpoint_weight + self.velocity_feedforward * change
        if self.derivative_on == "error":
            window, share = self.derivative_window, self.derivative_filter
            raw = (1.0 - back**window) / (window * period)
            proportional = proportional + self.kd * share * raw / (1.0 - (1.0 - share) * back)
        slope = self.ki + self.integral_rate * proportional
        return np.asarray(proportional + (slope / change if self.integrates else 0.0), dtype=np.complex128)

    def scaled(self, factor: float) -> Controller:
        """Return the loop whose whole command is multiplied by `factor`, as by an amplifier's gain."""
        return replace(
            self,
            **{name: factor * getattr(self, name) for name in ("kp", "kd", "ki", "velocity_feedforward")},
            integral_before=None if self.integral_before is None else factor * self.integral_before,
        )


def as_limit(limit: float | None) -> float:
    """Return the `limit` of a command, infinite where it is None.

    Raises
    ------
    InputError
        If it is not positive.
    """
    if limit is None or as_number(limit) == math.inf:
        return math.inf
    return number_within(limit, 0.0, math.inf, "limit", above=True)


def _check_number(name: str, value: object, *, optional: bool = False) -> None:
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InputError(f"{name} must be a number, got {value!r}")
    if not math.isfinite(value):
        raise InputError(f"{name} must be finite, got {value!r}")


NUMBERS = tuple(name for name in Controller.__slots__ if name not in TEXT_CHOICES)
TIMES = ("tracking_time", "control_period")
OPTIONAL = (*TIMES, "integral_before")
