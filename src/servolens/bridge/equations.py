"""A plant's equations as fast, picklable callables of the form that python-control wants."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

from servolens.bridge.delay import delay_line, settled
from servolens.dynamics import dynamics, ideal_pd
from servolens.effects import TimeShift
from servolens.errors import InputError, by_name, names_like, number_within

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["Equations"]


@final
class Equations:
    """Right-hand side, outputs and Jacobians, callable as python-control wants them; pickled as what they stem from.

    Parameters
    ----------
    plant : Plant
        The axis. What is absent by its values and would remember something is left out.
    gains : dict of str to float
        ``kp`` and ``kd`` of a PD loop, whose reference then is the input; empty if the input is the voltage.
    prefix : str
        Before the names of the parameters.
    width : float
        Of smoothed dry friction.
    order : int
        States of a delay.

    Attributes
    ----------
    plant : Plant
        What is left of it.
    defaults : dict of str to float
        All parameters by the names used in ``params``, in the order of ``Plant.values``, then those of the loop.
    states : list of str
        Names of the states.
    closed : bool
        Whether the input is a reference.
    width : float
        As given.
    """

    def __init__(self, plant: Plant, gains: dict[str, float], prefix: str, width: float, order: int) -> None:
        self._origin = (plant, gains, prefix, width, order)
        left_out = [effect for effect in plant.effects if _nothing_to_remember(effect)]
        kept = tuple(effect for effect in plant.effects if effect not in left_out)
        self.plant, self.closed, self.width = replace(plant, effects=kept, free_damping=None), bool(gains), width
        values = self.plant.named | gains
        self.defaults = {prefix + key: value for key, value in values.items()}
        self._names = tuple(self.defaults.items())
        self._left_out = {
            f"{prefix}{effect.name}.{spec.name}": value
            for effect in left_out
            for spec, value in zip(effect.parameters(), effect.values, strict=True)
        }
        delays = [effect.name for effect in kept if isinstance(effect, TimeShift)]
        histories = [f"{name}.history_{i}" for name in delays for i in range(order)]
        structure = self.plant.structure
        self.states = ["position", "velocity", *dynamics(structure).state_names, *histories]
        functions = _functions(structure, width, self.closed, len(histories))
        self._values, self._slopes, self._rest = (_Call(function) for function in functions)

    def __reduce__(self) -> tuple[Any, ...]:
        return Equations, self._origin

    def __call__(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the time derivative of the state, shape (number of states,)."""
        return self._values(t, x, u, self.numbers(params))[0]

    def outputs(self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the outputs, shape (2,) or (3,)."""
        return self._values(t, x, u, self.numbers(params))[1]

    def jacobians(
        self, t: float, x: ArrayLike, u: ArrayLike, params: Mapping[str, float]
    ) -> tuple[NDArray[np.float64], ...]:
        """Return A, B, C, D at one point."""
        return self._slopes(t, x, u, self.numbers(params))

    def at_rest(self, t: float, position: float, held: float, params: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the states of an axis that has long been at rest under a held input."""
        return self._rest(t, position, held, self.numbers(params))[0]

    def check(self, params: Mapping[str, float]) -> None:
        """Refuse parameters that are none of the system's own.

        Where all of its own are among them they come from an interconnected system, which hands on everything.

        Raises
        ------
        InputError
            With the names that are.
        """
        by_name("params", params, {"gain": 1.9})
        known = [*self.defaults, *self._left_out]
        for name in () if all(own in params for own in self.defaults) else params:
            if name not in known:
                raise InputError(f"{name[:40]!r} is no parameter of this system; {names_like(name, known, 'it has')}")
            number_within(params[name], -np.inf, np.inf, name)

    def numbers(self, params: Mapping[str, float]) -> list[float]:
        """Return all parameters in the order of `defaults`.

        Raises
        ------
        InputError
            If a parameter of an effect that was left out is to change.
        """
        for name, value in self._left_out.items():
            if params.get(name, value) != value:
                raise InputError(
                    f"{name} cannot become {params[name]:g}: the effect was absent when this system was built, which "
                    "has no state for it; build the system from a plant in which it is present"
                )
        return [params.get(name, default) for name, default in self._names]


class _Call:
    """A CasADi function on buffers of its own: a hundred times faster than its ordinary call."""

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


def _nothing_to_remember(effect: Effect) -> bool:
    """Whether the effect changes nothing, and yet has states: a filter without time constant is infinitely stiff."""
    return effect.absent and (bool(effect.states) or isinstance(effect, TimeShift))


@lru_cache(maxsize=256)
def _functions(structure: tuple[type[Effect], ...], width: float, closed: bool, order: int) -> tuple[Any, Any, Any]:
    """Return CasADi functions: (state rates, outputs) and (A, B, C, D) of time, state, input and parameters; rest.

    Forces and friction levels see the true sign of the velocity, and 0 at rest: so |v| = v·sgn v is exact, and the
    slope of α₁ exp(−α₂|v|) v at rest is α₁. Only what dry friction multiplies, the direction, is smoothed.
    """
    d = dynamics(structure)
    given, history, gains = ca.SX.sym("input"), ca.SX.sym("history", order), ca.SX.sym("gains", 2 if closed else 0)
    asked = ideal_pd(gains[0], gains[1], given, d.shown, d.output_velocity) if closed else given
    late, remembering = delay_line(asked, history, d.delay)
    push, level, rates = ca.substitute([d.push, d.level, d.rates], [d.command], [late])
    smoothed = ca.vertcat(d.velocity, push - level * ca.tanh(d.velocity / width), rates, remembering)
    seen = ca.vertcat(d.shown, d.output_velocity, *([asked] if closed else []))
    flow, outputs = ca.substitute([smoothed, seen], [d.direction], [ca.sign(d.velocity)])
    state, parameters = ca.vertcat(d.position, d.velocity, d.states, history), ca.vertcat(d.parameters, gains)
    inputs = [d.time, state, given, parameters]
    slopes = [ca.jacobian(value, by) for value in (flow, outputs) for by in (state, given)]
    before = ideal_pd(gains[0], gains[1], given, d.position, 0) if closed else given
    beginning = ca.substitute(ca.vertcat(d.position, 0, d.beginning), d.command, before)
    resting = [d.time, d.position, given, parameters]
    return (
        ca.Function("values", inputs, [ca.densify(flow), ca.densify(outputs)]),
        ca.Function("slopes", inputs, [ca.densify(slope) for slope in slopes]),
        ca.Function("rest", resting, [ca.densify(ca.vertcat(beginning, settled(before, order)))]),
    )
