"""The digital controller of a virtual bench, sample by sample, for one run or for many."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from servolens.control_arithmetic import samples_a_period

if TYPE_CHECKING:
    from servolens.controller import Controller

__all__ = ["DigitalController"]


@final
class DigitalController:
    """What :class:`~servolens.controller.Controller` describes, with the memory that it needs.

    Parameters
    ----------
    controller : Controller
        Its settings.
    sample_time : float
        Of the bench [s].
    limit : float or None
        Of the command, as an integral knows it [V].
    m : namespace
        Functions of floats or of arrays.
    """

    def __init__(self, controller: Controller, sample_time: float, limit: float | None, m: Any) -> None:
        # NumPy's numbers, as gains may be, would make the plain floats of a single run slow
        c = controller
        self._settings, self._m, self._limit = c, m, limit
        self._kp, self._kd, self._ki, self._share = (float(x) for x in (c.kp, c.kd, c.ki, c.derivative_filter))
        self._weight, self._forward = float(c.setpoint_weight), float(c.velocity_feedforward)
        self._rate = float(c.integral_rate)
        self._every = samples_a_period(c, sample_time)
        self._period = sample_time if self._every == 1 else c.control_period or sample_time
        self._step, self._signals, self._instants = self._period, list[Any](), list[float]()
        self._before: float | None = None
        self._derivative: Any = 0.0
        self._stored: Any = float(c.initial_integral)
        self._held: Any = 0.0

    def ask(self, k: int, time: float, reference: float, seen: Any, velocity: Any, added: float) -> Any:
        """Return the voltage asked for at sample `k`, held between the ticks of a slow loop, with what is `added`."""
        if k % self._every == 0:
            if self._settings.time_step == "measured" and self._instants:
                self._step = time - self._instants[-1]
            self._instants = [*self._instants, time][-1 - int(self._settings.derivative_window) :]
            raw = velocity if self._settings.derivative == "velocity" else self._slope(reference, seen)
            self._derivative = self._derivative + self._share * (raw - self._derivative)
            direct = self._kp * (self._weight * reference - seen) - self._kd * self._derivative
            direct = direct + self._forward * self._speed(reference)
            self._held = direct + self._integral(reference - seen, direct, added)
        return self._held + added

    def _integral(self, error: Any, direct: Any, added: float) -> Any:
        """Return the integral part of this sample, and store what the next one begins with."""
        candidate = self._stored + self._step * (self._ki * error + self._rate * direct)
        if not self._settings.is_limited or self._limit is None:
            self._stored = candidate
            return candidate
        m, limit = self._m, self._limit
        if self._settings.anti_windup == "clamping":
            upwards = candidate - self._stored
            asked = direct + candidate + added
            too_high, too_low = m.minimum(asked - limit, upwards), m.minimum(-limit - asked, -upwards)
            self._stored = m.where(too_high > 0.0, self._stored, m.where(too_low > 0.0, self._stored, candidate))
            return self._stored
        asked = direct + candidate + added
        given = m.minimum(m.maximum(asked, -limit), limit)
        self._stored = candidate + self._step / self._settings.tracking * (given - asked)
        return candidate

    def _speed(self, reference: float) -> float:
        """Return how fast the reference moves, by its last two values."""
        before = reference if self._before is None else self._before
        self._before = reference
        return (reference - before) / self._step

    def _slope(self, reference: float, seen: Any) -> Any:
        """Return the raw difference over the window; before the record all was as at its first sample."""
        window = int(self._settings.derivative_window)
        self._signals.append(seen - reference if self._settings.derivative_on == "error" else seen)
        del self._signals[: -window - 1]
        if len(self._signals) <= window:
            self._signals = [self._signals[0]] * window + self._signals[-1:]
        span = window * self._period
        if self._settings.time_step == "measured" and len(self._instants) > window:
            span = self._instants[-1] - self._instants[0]
        return (self._signals[-1] - self._signals[-1 - window]) / span
