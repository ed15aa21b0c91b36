"""Simulation of python-control's systems with settings that suit an axis."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import control as ct
import numpy as np

from servolens.bridge.checking import TOLERANCE, judge
from servolens.bridge.system import PlantSystem
from servolens.errors import InputError, by_name, described, flags
from servolens.record_signals import as_finite

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

__all__ = ["SOLVER", "held_response"]

SOLVER: dict[str, Any] = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-10, "max_step": 0.01}
"""Arguments for ``solve_ivp`` that suit these systems: ``input_output_response(..., solve_ivp_kwargs=SOLVER)``.

LSODA turns to a stiff method where smoothed friction needs one; `max_step` [s] keeps it from stepping over an input.
"""


def held_response(
    system: Any,
    time: ArrayLike,
    inputs: ArrayLike,
    *,
    initial_state: ArrayLike | Literal["at rest"] = 0.0,
    params: Mapping[str, float] | None = None,
    check: bool = False,
) -> Any:
    """Simulate a continuous system of python-control under inputs that are held from sample to sample.

    Calls ``input_output_response`` with :data:`SOLVER` from one change of the inputs to the next, so that no pulse is
    stepped over and no jump becomes a ramp.

    Parameters
    ----------
    system : NonlinearIOSystem
        With states, in continuous time.
    time : array_like, shape (n,)
        Increasing [s], at least 2.
    inputs : array_like, shape (n,) or (m, n)
        Of each sample.
    initial_state : array_like, shape (number of states,), or float, or "at rest"
        At the first sample. ``"at rest"``, for one plant or loop: standing at 0 under the first input, which has been
        there for ever; for another position pass ``system.at_rest(position, held)``.
    params : mapping, optional
        Parameters that differ from the system's own.
    check : bool
        Simulate with the kernel too, and warn if the two are apart, see :func:`check_response`.

    Returns
    -------
    TimeResponseData
        With states, outputs and inputs at the samples.

    Raises
    ------
    InputError
        If time does not increase, inputs or initial state have another shape, or `check` or ``"at rest"`` is asked of
        a system that is not one of :func:`to_control` or :func:`closed_loop`.

    Warns
    -----
    ResponseWarning
        As :func:`check_response`.

    Examples
    --------
    >>> from servolens.bridge import held_response, to_control
    >>> from servolens.plant import Plant
    >>> response = held_response(to_control(Plant(gain=2.0, damping=0.0)), [0.0, 1.0, 2.0], [1.0, 0.0, 0.0])
    >>> response.states[0].round(6).tolist()
    [0.0, 1.0, 3.0]
    """
    flags(check=check)
    grid, held = _signals(system, time, inputs)
    states = np.empty((system.nstates, grid.size))
    states[:, 0] = _begin(system, initial_state, grid, held, params)
    changes = 1 + np.flatnonzero((np.diff(held[:, :-1], axis=1) != 0).any(axis=0))
    edges = [0, *changes.tolist(), grid.size - 1]
    for a, b in pairwise(edges):
        piece = grid[a : b + 1]
        constant = np.tile(held[:, a : a + 1], piece.size)
        done = ct.input_output_response(
            system, piece, constant, states[:, a], params=_plain(params), solve_ivp_kwargs=SOLVER
        )
        states[:, a + 1 : b + 1] = done.states[:, 1:]
    outputs = [system.output(t, x, u, params=_plain(params)) for t, x, u in zip(grid, states.T, held.T, strict=True)]
    response = ct.TimeResponseData(
        grid,
        np.transpose(outputs),
        states,
        held,
        issiso=system.issiso(),
        params=_plain(params),
        sysname=system.name,
        input_labels=system.input_labels,
        output_labels=system.output_labels,
        state_labels=system.state_labels,
        title=f"Response of {system.name} to held inputs",
    )
    if check:
        judge(system, response, TOLERANCE, held=True)
    return response


def _signals(system: Any, time: ArrayLike, inputs: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if not isinstance(system, ct.InputOutputSystem):
        raise InputError(f"a system of python-control is needed, such as to_control(plant); got {described(system)}")
    grid, held = as_finite(time, "time"), np.atleast_2d(as_finite(inputs, "inputs"))
    if grid.ndim != 1 or grid.size < 2 or np.diff(grid).min() <= 0:
        raise InputError(f"time must be one-dimensional, of at least 2 samples, and increase; got shape {grid.shape}")
    if held.shape != (system.ninputs, grid.size):
        raise InputError(f"inputs must have shape ({system.ninputs}, {grid.size}), got {held.shape}")
    return grid, held


def _begin(
    system: Any,
    asked: ArrayLike | Literal["at rest"],
    grid: NDArray[np.float64],
    held: NDArray[np.float64],
    params: Mapping[str, float] | None,
) -> NDArray[np.float64]:
    if isinstance(asked, str):
        if asked != "at rest" or not isinstance(system, PlantSystem):
            raise InputError(
                f'initial_state must be numbers, or "at rest" of one plant or loop; got {asked!r} of {system.name}'
            )
        return system.at_rest(0.0, float(held[0, 0]), time=float(grid[0]), params=params)
    state = as_finite(asked, "initial_state")
    if state.shape not in ((), (system.nstates,)):
        raise InputError(f"initial_state must be one number or have shape ({system.nstates},), got {state.shape}")
    return np.broadcast_to(state, system.nstates)


def _plain(params: Mapping[str, float] | None) -> dict[str, float] | None:
    return None if params is None else dict(by_name("params", params, {"gain": 1.9}))
