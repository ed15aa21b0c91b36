"""Plants and their PD loops as nonlinear systems of python-control."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, final

import control as ct
import numpy as np

from servolens.bridge.equations import Equations
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["PlantSystem", "closed_loop", "to_control"]


def to_control(plant: Plant, *, name: str | None = None, prefix: str = "", friction_width: float = 1e-3) -> PlantSystem:
    """Return `plant` as a system of python-control, driven by its voltage.

    Parameters
    ----------
    plant : Plant
        The axis.
    name : str, optional
        Name of the system.
    prefix : str
        Put before the names of the parameters, so that several plants can be interconnected, e.g. ``"x."``.
    friction_width : float
        Speed at which smoothed dry friction has reached 76 % of its level [m/s or rad/s], positive.

    Returns
    -------
    PlantSystem
        Input ``voltage`` [V or the plant's command unit]; outputs and states ``position`` [m or rad] and ``velocity``;
        ``params`` holds every parameter of the plant by qualified name, SI.

    Raises
    ------
    InputError
        If `friction_width` is not positive.

    Examples
    --------
    >>> from servolens.bridge import to_control
    >>> from servolens.plant import Plant
    >>> cart = to_control(Plant(gain=1.9, damping=6.0), name="cart")
    >>> cart.linearize([0.0, 0.0], 0.0).poles().real.tolist()
    [0.0, -6.0]
    """
    return _system(plant, {}, "voltage", ["position", "velocity"], name, prefix, friction_width)


def closed_loop(
    plant: Plant, kp: float, kd: float = 0.0, *, name: str | None = None, prefix: str = "", friction_width: float = 1e-3
) -> PlantSystem:
    """Return `plant` under the ideal continuous PD ``V = kp (r − y) − kd ẏ`` (the paper's eq. 15).

    Parameters
    ----------
    plant : Plant
        The axis.
    kp, kd : float
        Gains [V/m, V s/m], parameters of the system too.
    name, prefix, friction_width
        As in :func:`to_control`.

    Returns
    -------
    PlantSystem
        Input ``reference`` [m or rad]; outputs ``position``, ``velocity`` and ``voltage``, which is what the
        controller asks for; states ``position`` and ``velocity``.

    Raises
    ------
    InputError
        If `friction_width` is not positive or a gain not finite.

    Examples
    --------
    >>> from servolens.bridge import closed_loop
    >>> from servolens.plant import Plant
    >>> loop = closed_loop(Plant(gain=1.9, damping=6.0), kp=100, kd=5)
    >>> loop.linearize([0.1, 0.0], 0.1).A.tolist()
    [[0.0, 1.0], [-190.0, -15.5]]
    """
    if not np.isfinite([kp, kd]).all():
        raise InputError(f"kp and kd must be finite, got {kp!r} and {kd!r}")
    outputs = ["position", "velocity", "voltage"]
    return _system(plant, {"kp": float(kp), "kd": float(kd)}, "reference", outputs, name, prefix, friction_width)


@final
class PlantSystem(ct.NonlinearIOSystem):  # type: ignore[misc]  # control ships no types
    """A ``NonlinearIOSystem`` that knows its derivatives; made by :func:`to_control` and :func:`closed_loop`."""

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
            Position and velocity.
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
    plant: Plant,
    gains: dict[str, float],
    given: Literal["voltage", "reference"],
    outputs: list[str],
    name: str | None,
    prefix: str,
    width: float,
) -> PlantSystem:
    if not (np.isfinite(width) and width > 0):
        raise InputError(f"friction_width must be positive and finite, got {width!r}")
    values = dict(zip(plant.parameters, plant.values, strict=True)) | gains
    params = {prefix + key: value for key, value in values.items()}
    equations = Equations(plant.structure, params, float(width), bool(gains))
    return PlantSystem(
        equations,
        equations.outputs,
        params=params,
        inputs=[given],
        outputs=outputs,
        states=["position", "velocity"],
        name=name,
    )


def _filled(values: Any, size: int) -> NDArray[np.float64]:
    """Return `values` as python-control reads them: a number for all, a short vector padded with zeros."""
    if np.isscalar(values):
        return np.full(size, values, dtype=np.float64)
    flat = np.concatenate([np.ravel(value) for value in values])
    return np.concatenate([flat, np.zeros(size - flat.size)]).astype(np.float64)
