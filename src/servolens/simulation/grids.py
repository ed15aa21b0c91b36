"""The instants at which an axis is simulated: those of a log, lost samples put back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.record import as_numbers

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["as_floats", "as_grid", "sample_time_of", "without_gaps"]


def without_gaps(
    time: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp] | None]:
    """Return a grid on which the loop ran, lost samples put back.

    With the record's sample that is held at each of its instants, and where the record's samples stand in it; None if
    none are lost.
    """
    steps = np.diff(time)
    nominal = float(np.median(steps))
    if steps.max() < 1.5 * nominal:
        return time, np.arange(time.size), None
    counts = np.maximum(np.rint(steps / nominal).astype(np.intp), 1)
    index = np.concatenate([[0], np.cumsum(counts)])
    grid = np.interp(np.arange(index[-1] + 1), index, time)
    return grid, np.searchsorted(time, grid + 0.5 * nominal, side="right") - 1, index


def sample_time_of(grid: NDArray[np.float64]) -> float:
    """Median of the first intervals; a few suffice, and this runs for every simulated step."""
    steps = np.sort(grid[1:64] - grid[:63][: grid[1:64].size])
    return float(steps[steps.size // 2]) if steps.size else 1.0


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
    return np.ascontiguousarray(as_numbers(values, what))
