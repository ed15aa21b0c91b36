"""A plant's equations as fast, picklable callables of the form that python-control wants."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

from servolens.dynamics import dynamics, ideal_pd

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

    from servolens.effects import Effect

__all__ = ["Equations"]


@final
class Equations:
    """Right-hand side, outputs and Jacobians, callable as python-control wants them; pickled as what they stem from.

    Parameters
    ----------
    structure : tuple of type
        The plant's effects.
    defaults : dict of str to float
        All parameters by the names used in ``params``, in the order of ``Plant.values``, then those of the loop.
    width : float
        Of smoothed dry friction.
    closed : bool
        Whether the input is the reference of a PD loop, its gains the last two parameters.
    """

    def __init__(
        self, structure: tuple[type[Effect], ...], defaults: dict[str, float], width: float, closed: bool
    ) -> None:
        self._origin = (structure, defaults, width, closed)
        self._names = tuple(defaults.items())
        self._values, self._slopes = (_Call(function) for function in _functions(structure, width, closed))

    def __reduce__(self) -> tuple[Any, ...]:
        return Equations, self._origin

    def __call__(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the time derivative of the state, shape (2,)."""
        return self._values(t, x, u, self._numbers(params))[0]

    def outputs(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the outputs, shape (2,) or (3,)."""
        return self._values(t, x, u, self._numbers(params))[1]

    def jacobians(
        self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]
    ) -> tuple[NDArray[np.float64], ...]:
        """Return A, B, C, D at one point."""
        return self._slopes(t, x, u, self._numbers(params))

    def _numbers(self, params: Mapping[str, float]) -> list[float]:
        return [params.get(name, default) for name, default in self._names]


class _Call:
    """A CasADi function of (t, x, u, p) on buffers of its own: a hundred times faster than its ordinary call."""

    def __init__(self, function: Any) -> None:
        self._buffer, self._run = function.buffer()
        self._inputs = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self._outputs = [np.zeros(function.size_out(i), order="F") for i in range(function.n_out())]
        for i, array in enumerate(self._inputs):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self._outputs):
            self._buffer.set_res(i, array.reshape(-1, order="F").data)

    def __call__(self, *values: ArrayLike) -> tuple[NDArray[np.float64], ...]:
        for array, value in zip(self._inputs, values, strict=True):
            array[:] = value
        self._run()
        return tuple(array.copy() for array in self._outputs)


@lru_cache(maxsize=256)
def _functions(structure: tuple[type[Effect], ...], width: float, closed: bool) -> tuple[Any, Any]:
    """Return (state rates, outputs) and (A, B, C, D) as CasADi functions of time, state, input and parameters.

    Forces and friction levels see the true sign of the velocity, and 0 at rest: so |v| = v·sgn v is exact, and the
    slope of α₁ exp(−α₂|v|) v at rest is α₁. Only what dry friction multiplies, the direction, is smoothed.
    """
    d = dynamics(structure)
    state, given = ca.vertcat(d.position, d.velocity), ca.SX.sym("input")
    gains = ca.SX.sym("gains", 2 if closed else 0)
    asked = ideal_pd(gains[0], gains[1], given, d.position, d.velocity) if closed else given
    push, level = ca.substitute([d.push, d.level], [d.command, d.direction], [asked, ca.sign(d.velocity)])
    rates = ca.vertcat(d.velocity, push - level * ca.tanh(d.velocity / width))
    outputs = ca.vertcat(state, asked) if closed else state
    inputs = [d.time, state, given, ca.vertcat(d.parameters, gains)]
    slopes = [ca.jacobian(value, by) for value in (rates, outputs) for by in (state, given)]
    return (
        ca.Function("values", inputs, [ca.densify(rates), ca.densify(outputs)]),
        ca.Function("slopes", inputs, [ca.densify(slope) for slope in slopes]),
    )
