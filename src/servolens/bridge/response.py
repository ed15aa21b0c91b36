"""Simulation of python-control's systems with settings that suit an axis."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np

from servolens.errors import InputError

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
    initial_state: ArrayLike = 0.0,
    params: Mapping[str, float] | None = None,
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
    initial_state : array_like, shape (number of states,), or float
        At the first sample.
    params : mapping, optional
        Parameters that differ from the system's own.

    Returns
    -------
    TimeResponseData
        With states, outputs and inputs at the samples.

    Raises
    ------
    InputError
        If time does not increase or the inputs have another shape.

    Examples
    --------
    >>> from servolens.bridge import held_response, to_control
    >>> from servolens.plant import Plant
    >>> response = held_response(to_control(Plant(gain=2.0, damping=0.0)), [0.0, 1.0, 2.0], [1.0, 0.0, 0.0])
    >>> response.states[0].round(6).tolist()
    [0.0, 1.0, 3.0]
    """
    grid, held = _signals(system, time, inputs)
    states = np.empty((system.nstates, grid.size))
    states[:, 0] = initial_state
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
    return ct.TimeResponseData(
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


def _signals(system: Any, time: ArrayLike, inputs: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    grid, held = np.asarray(time, dtype=np.float64), np.atleast_2d(np.asarray(inputs, dtype=np.float64))
    if grid.ndim != 1 or grid.size < 2 or np.diff(grid).min() <= 0:
        raise InputError(f"time must be one-dimensional, of at least 2 samples, and increase; got shape {grid.shape}")
    if held.shape != (system.ninputs, grid.size):
        raise InputError(f"inputs must have shape ({system.ninputs}, {grid.size}), got {held.shape}")
    return grid, held


def _plain(params: Mapping[str, float] | None) -> dict[str, float] | None:
    return None if params is None else dict(params)
