"""The instants at which an axis is simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.clock import JITTERS, cycle_of
from servolens.errors import InputError
from servolens.record_signals import as_numbers

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["as_floats", "as_grid", "sample_time_of"]


def sample_time_of(grid: NDArray[np.float64]) -> float:
    """Return the cycle [s]: median of the first intervals if these are alike, for this runs for every simulation."""
    steps = np.sort(grid[1:64] - grid[:63][: grid[1:64].size])
    usual = float(steps[steps.size // 2]) if steps.size else 1.0
    if steps.size < 2 or steps[-1] - steps[0] <= JITTERS * usual:
        return usual
    return cycle_of(grid)


def as_grid(time: ArrayLike) -> NDArray[np.float64]:
    """Return `time` [s] as an array, shape (n,).

    Raises
    ------
    InputError
        If it is empty or does not increase.
    """
    grid = as_floats(time, "time")
    if grid.size == 0 or (not (grid[1:] > grid[:-1]).all()):
        raise InputError("time must hold at least one sample and increase")
    return grid


def as_floats(values: ArrayLike, what: str) -> NDArray[np.float64]:
    """Return `values` as the compiled rule reads them; `what` they are is told in a refusal."""
    array = as_numbers(values, what)
    if array.ndim != 1:
        raise InputError(f"{what} must be one-dimensional, got shape {array.shape}")
    return np.ascontiguousarray(array)
