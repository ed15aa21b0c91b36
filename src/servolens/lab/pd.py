"""The digital PD controller of a virtual bench, sample by sample, for one run or for many."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

from servolens.control_law import samples_a_period

if TYPE_CHECKING:
    from servolens.record import Controller

__all__ = ["DigitalPD"]


@final
class DigitalPD:
    """What :class:`~servolens.record.Controller` describes, with the memory that it needs."""

    def __init__(self, controller: Controller, sample_time: float) -> None:
        self._settings = controller
        # NumPy's numbers, as gains may be, would make the plain floats of a single run slow
        self._kp, self._kd, self._share = (
            float(gain) for gain in (controller.kp, controller.kd, controller.derivative_filter)
        )
        self._every = samples_a_period(controller, sample_time)
        self._period = sample_time if self._every == 1 else controller.control_period or sample_time
        self._signals: list[Any] = []
        self._derivative: Any = 0.0
        self._held: Any = 0.0

    def ask(self, k: int, reference: float, seen: Any, velocity: Any) -> Any:
        """Return the voltage asked for at sample `k`, held between the ticks of a slow loop, without feedforward."""
        if k % self._every == 0:
            raw = velocity if self._settings.derivative == "velocity" else self._slope(reference, seen)
            self._derivative = self._derivative + self._share * (raw - self._derivative)
            self._held = self._kp * (reference - seen) - self._kd * self._derivative
        return self._held

    def _slope(self, reference: float, seen: Any) -> Any:
        """Return the raw difference over the window; before the record all was as at its first sample."""
        window = int(self._settings.derivative_window)
        self._signals.append(seen - reference if self._settings.derivative_on == "error" else seen)
        del self._signals[: -window - 1]
        if len(self._signals) <= window:
            self._signals = [self._signals[0]] * window + self._signals[-1:]
        return (self._signals[-1] - self._signals[-1 - window]) / (window * self._period)
