"""The digital controller as a discrete-time system of python-control."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import control as ct
import numpy as np

from servolens.controller import Controller, as_limit
from servolens.errors import InputError, as_text, needed, number_within

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray


__all__ = ["ControllerSystem", "digital_controller"]


def digital_controller(
    controller: Controller, sample_time: float, *, limit: float | None = None, name: str | None = None
) -> ControllerSystem:
    """Return `controller` as a system in discrete time, for ``interconnect`` and for margins.

    Without anti-windup it is linear, and ``linearize(0, 0)`` gives it as a state space. A continuous axis goes with it
    as ``ct.sample_system(to_control(plant).linearize(0, 0), sample_time)``, its hold included.

    Parameters
    ----------
    controller : Controller
        Its law.
    sample_time : float
        h [s], positive; a stated period of the controller goes before.
    limit : float, optional
        Of the command [V], needed against windup. The output is what is asked for, beyond the limit too.
    name : str, optional
        Name of the system.

    Returns
    -------
    ControllerSystem
        Inputs ``reference`` and ``position`` [m or rad], and ``velocity`` if the loop has one of its own; output
        ``voltage`` [V or the command's unit].

    Raises
    ------
    InputError
        If `sample_time` is not positive, or a limit is needed and not given.

    Examples
    --------
    >>> from servolens.bridge import digital_controller
    >>> from servolens.controller import Controller
    >>> law = digital_controller(Controller(kp=60.0, kd=2.0, ki=300.0), 1e-3)
    >>> law.input_labels, law.output_labels, law.state_labels
    (['reference', 'position'], ['voltage'], ['integral', 'derivative', 'reference', 'signal_1'])
    """
    needed(controller, Controller)
    sample_time = number_within(sample_time, 0.0, np.inf, "sample_time", above=True)
    if controller.is_limited and limit is None:
        raise InputError(f"anti_windup = {controller.anti_windup} needs the limit of the command; give it")
    period = controller.control_period or sample_time
    law = _Law(controller, period, as_limit(limit))
    return ControllerSystem(
        law.next_state,
        law.output,
        inputs=law.inputs,
        outputs=["voltage"],
        states=law.states,
        dt=period,
        name=None if name is None else as_text(name, "name", without="."),
    )


@final
class ControllerSystem(ct.NonlinearIOSystem):  # type: ignore[misc]  # control ships no types
    """A discrete ``NonlinearIOSystem``, made by :func:`digital_controller`."""

    def at_rest(self, position: float = 0.0, reference: float = 0.0) -> NDArray[np.float64]:
        """Return the state of a controller that has seen nothing else until now than these [m or rad]."""
        law: _Law = self.updfcn.__self__
        return law.at_rest(position, reference)


@final
@dataclass(frozen=True, slots=True)
class _Law:
    """One tick of the controller; the state is [integral, derivative, last reference, last signals, newest first].

    It runs at even ticks, where a time step that is measured is the cycle.
    """

    controller: Controller
    period: float
    limit: float

    @property
    def inputs(self) -> list[str]:
        own = ["velocity"] if self.controller.derivative == "velocity" else []
        return ["reference", "position", *own]

    @property
    def states(self) -> list[str]:
        past = [f"signal_{i}" for i in range(1, self.controller.derivative_window + 1)]
        return ["integral", "derivative", "reference", *past]

    def at_rest(self, position: float, reference: float) -> NDArray[np.float64]:
        signal = position - reference if self.controller.derivative_on == "error" else position
        before = self.controller.initial_integral
        return np.array([before, 0.0, reference, *([signal] * self.controller.derivative_window)])

    def next_state(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        return self._tick(np.asarray(x), np.asarray(u))[0]

    def output(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        return np.array([self._tick(np.asarray(x), np.asarray(u))[1]])

    def _tick(self, x: NDArray[np.float64], u: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        c, h = self.controller, self.period
        reference, position = u[0], u[1]
        signal = position - reference if c.derivative_on == "error" else position
        raw: Any = u[2] if c.derivative == "velocity" else (signal - x[-1]) / (c.derivative_window * h)
        slope = x[1] + c.derivative_filter * (raw - x[1])
        direct = c.kp * (c.setpoint_weight * reference - position) - c.kd * slope
        direct += c.velocity_feedforward * (reference - x[2]) / h
        growth = h * (c.ki * (reference - position) + c.integral_rate * direct)
        asked = direct + x[0] + growth
        if c.anti_windup == "clamping" and abs(asked) > self.limit and growth * asked > 0:
            growth = 0.0
        integral, asked = x[0] + growth, direct + x[0] + growth
        if c.anti_windup == "back_calculation" and c.integrates:
            integral += h / c.tracking * (np.clip(asked, -self.limit, self.limit) - asked)
        return np.array([integral, slope, reference, signal, *x[3:-1]]), float(asked)
