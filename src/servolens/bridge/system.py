"""Plants and their PD loops as nonlinear systems of python-control."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

import control as ct
import numpy as np

from servolens.bridge.delay import HIGHEST_ORDER
from servolens.bridge.equations import Equations
from servolens.effects import TimeShift
from servolens.errors import InputError, as_text, number_within
from servolens.inputs import as_plant

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.inputs import Plants
    from servolens.plant import Plant

__all__ = ["PlantSystem", "closed_loop", "to_control"]


def to_control(
    plant: Plants,
    *,
    name: str | None = None,
    prefix: str = "",
    friction_width: float = 1e-3,
    delay_order: int | None = None,
) -> PlantSystem:
    """Return `plant` as a system of python-control, driven by its voltage.

    Parameters
    ----------
    plant : Plant, model, fit, diagnosis, or path of a model's file
        The axis. An effect that has states or delays, and is absent by its values (a time constant of 0), is left out:
        it would be infinitely stiff. Its parameters are then no parameters of the system.
    name : str, optional
        Name of the system.
    prefix : str
        Put before the names of the parameters, so that several plants can be interconnected, e.g. ``"x."``.
    friction_width : float
        Speed at which smoothed dry friction has reached 76 % of its level [m/s or rad/s], positive.
    delay_order : int, optional
        1 to 10: a delay τ becomes as many states, Padé's approximation, good up to about ``delay_order / τ`` rad/s.
        None refuses a plant with a delay.

    Returns
    -------
    PlantSystem
        Input ``voltage`` [V or the plant's command unit]. Outputs ``position``, as the sensor shows it [m or rad], and
        ``velocity``, both of the load. States ``position`` and ``velocity``, which behind a transmission are the
        motor's, then those of the effects (``flexible_coupling.position``), then those of a delay
        (``delay.history_0``). ``params`` holds every parameter of the plant by qualified name, SI.

    Raises
    ------
    InputError
        If `friction_width` is not positive, or the plant has a delay and `delay_order` is None.

    Examples
    --------
    >>> from servolens.bridge import to_control
    >>> from servolens.effects import ActuatorLag
    >>> from servolens.plant import Plant
    >>> cart = to_control(Plant(gain=1.9, damping=6.0), name="cart")
    >>> cart.linearize([0.0, 0.0], 0.0).poles().real.tolist()
    [0.0, -6.0]
    >>> to_control(Plant(gain=1.9, damping=6.0, effects=(ActuatorLag(time_constant=0.01),))).state_labels
    ['position', 'velocity', 'actuator_lag.command']
    """
    return _system(as_plant(plant), {}, name, prefix, friction_width, delay_order)


def closed_loop(
    plant: Plants,
    kp: float,
    kd: float = 0.0,
    *,
    name: str | None = None,
    prefix: str = "",
    friction_width: float = 1e-3,
    delay_order: int | None = None,
) -> PlantSystem:
    """Return `plant` under the ideal continuous PD ``V = kp (r − y) − kd ẏ`` (the paper's eq. 15).

    The controller is given the position that the sensor shows and the load's velocity.

    Parameters
    ----------
    plant : Plant, model, fit, diagnosis, or path of a model's file
        The axis.
    kp, kd : float
        Gains [V/m, V s/m], parameters of the system too.
    name, prefix, friction_width, delay_order
        As in :func:`to_control`.

    Returns
    -------
    PlantSystem
        Input ``reference`` [m or rad]; outputs ``position``, ``velocity`` and ``voltage``, which is what the
        controller asks for; states as in :func:`to_control`.

    Raises
    ------
    InputError
        As in :func:`to_control`, or if a gain is not finite.

    Examples
    --------
    >>> from servolens.bridge import closed_loop
    >>> from servolens.plant import Plant
    >>> loop = closed_loop(Plant(gain=1.9, damping=6.0), kp=100, kd=5)
    >>> loop.linearize([0.1, 0.0], 0.1).A.tolist()
    [[0.0, 1.0], [-190.0, -15.5]]
    """
    gains = {name: number_within(gain, -np.inf, np.inf, name) for name, gain in (("kp", kp), ("kd", kd))}
    return _system(as_plant(plant), gains, name, prefix, friction_width, delay_order)


@final
class PlantSystem(ct.NonlinearIOSystem):  # type: ignore[misc]  # control ships no types
    """A ``NonlinearIOSystem`` that knows its derivatives; made by :func:`to_control` and :func:`closed_loop`.

    ``params`` that are none of its own are refused wherever python-control takes them, but for those of the whole where
    several systems are interconnected: each is given the others' as well.
    """

    def _update_params(self, params: Mapping[str, float] | None) -> None:
        """Take the parameters of a response; python-control's own hook."""
        self.updfcn.check(params or {})
        super()._update_params(params)

    def at_rest(
        self,
        position: float = 0.0,
        held: float = 0.0,
        *,
        time: float = 0.0,
        params: Mapping[str, float] | None = None,
    ) -> NDArray[np.float64]:
        """Return the states of an axis that stands still, whatever follows its input having caught up with it.

        Where nothing is remembered that is `position` and 0. Lags, sensors and delays are filled; a second mass stands
        where the motor does; a force that would move the axis is not asked.

        Parameters
        ----------
        position : float
            Of motor and load [m or rad].
        held : float
            The input until now: voltage, or reference of a loop [m or rad].
        time : float
            [s]; matters to effects that drift.
        params : mapping, optional
            Parameters that differ from the system's own.

        Returns
        -------
        ndarray, shape (number of states,)
            For ``initial_state`` or ``linearize``.

        Examples
        --------
        >>> from servolens.bridge import to_control
        >>> from servolens.effects import ActuatorLag
        >>> from servolens.plant import Plant
        >>> cart = to_control(Plant(gain=1.9, damping=6.0, effects=(ActuatorLag(time_constant=0.01),)))
        >>> cart.at_rest(0.1, held=2.0).tolist()
        [0.1, 0.0, 2.0]
        """
        self.updfcn.check(params or {})
        found: NDArray[np.float64] = self.updfcn.at_rest(time, position, held, {**self.params, **(params or {})})
        return found[:, 0]

    def linearize(
        self,
        x0: Any,
        u0: Any = None,
        t: float = 0,
        params: Mapping[str, float] | None = None,
        eps: float = 1e-6,
        copy_names: bool = False,
        **kwargs: Any,
    ) -> Any:
        """Return the exact linearisation at state `x0` and input `u0` as a ``StateSpace`` system.

        Parameters
        ----------
        x0 : array_like or OperatingPoint
            All states; missing ones are 0.
        u0 : array_like, optional
            The input; 0, or that of the operating point.
        t : float
            Time [s].
        params : mapping, optional
            Parameters that differ from the system's own.
        eps : float
            Not needed here; part of python-control's signature.
        copy_names : bool
            Take over the names of the signals.
        **kwargs
            What else python-control's ``linearize`` takes: name, inputs, outputs, states.
        """
        linear = super().linearize(x0, u0, t=t, params=params, eps=eps, copy_names=copy_names, **kwargs)
        if isinstance(x0, ct.OperatingPoint):
            x0, u0 = x0.states, x0.inputs if u0 is None else u0
        state, command = _filled(x0, self.nstates), _filled(0.0 if u0 is None else u0, self.ninputs)
        jacobians = self.updfcn.jacobians(t, state, command, self._current_params)
        linear.A, linear.B, linear.C, linear.D = jacobians
        return linear


def _system(
    plant: Plant, gains: dict[str, float], name: str | None, prefix: str, width: float, order: int | None
) -> PlantSystem:
    width = number_within(width, 0.0, np.inf, "friction_width", above=True)
    if order is not None and order not in range(1, HIGHEST_ORDER + 1):
        raise InputError(f"delay_order must be a whole number from 1 to {HIGHEST_ORDER}, got {order!r}")
    equations = Equations(plant, gains, as_text(prefix, "prefix"), width, int(order or 0))
    if order is None and any(issubclass(cls, TimeShift) for cls in equations.plant.structure):
        raise InputError(
            f"the plant has a delay of {plant.delay:g} s, which differential equations cannot hold: "
            "pass delay_order=3, say, for Padé's approximation, or simulate it with servolens.simulation"
        )
    return PlantSystem(
        equations,
        equations.outputs,
        params=equations.defaults,
        inputs=["reference" if gains else "voltage"],
        outputs=["position", "velocity", "voltage"] if gains else ["position", "velocity"],
        states=equations.states,
        name=None if name is None else as_text(name, "name", without="."),
    )


def _filled(values: Any, size: int) -> NDArray[np.float64]:
    """Return `values` as python-control reads them: a number for all, a short vector padded with zeros."""
    if np.isscalar(values):
        return np.full(size, values, dtype=np.float64)
    flat = np.concatenate([np.ravel(value) for value in values])
    return np.concatenate([flat, np.zeros(size - flat.size)]).astype(np.float64)
