"""A parabola through what a function of two unknowns is around a place, and the step to its lowest point."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["Parabola"]


class Parabola(NamedTuple):
    """Slope, shape (2,), and curvature, shape (2, 2), of a function at a place, and the places that told them."""

    slope: NDArray[np.float64]
    curvature: NDArray[np.float64]
    places: list[NDArray[np.float64]]

    @classmethod
    def of(cls, function: Callable[[NDArray[np.float64]], float], place: NDArray[np.float64], width: float) -> Parabola:
        """Return the parabola through `place`, its four neighbours this far away, and one aside, down the slope.

        Where a neighbour is infinite, out of range, the function is taken to be as steep as on the other side, level
        if that leads down nowhere.
        """
        centre, slope, curvature = function(place), np.zeros(2), np.eye(2)
        places, is_level = [], False
        for k, axis in enumerate(np.eye(2)):
            sides = [place - width * axis, place + width * axis]
            low, high = (function(side) for side in sides)
            places += sides
            if np.isfinite(low) and np.isfinite(high):
                slope[k] = (high - low) / (2.0 * width)
                curvature[k, k] = (high + low - 2.0 * centre) / width**2
            elif min(low, high) < centre:
                slope[k] = (centre - low if np.isfinite(low) else high - centre) / width
                curvature[k, k] = 0.0
            else:
                is_level = True
        if is_level:
            return cls(slope, curvature, places)
        aside = place - width * np.where(slope > 0.0, 1.0, -1.0)
        places.append(aside)
        left = function(aside) - centre - float(slope @ (aside - place))
        if np.isfinite(left):
            mixed = (left / width**2 - 0.5 * float(np.trace(curvature))) * float(np.prod(np.sign(aside - place)))
            curvature[0, 1] = curvature[1, 0] = mixed
        return cls(slope, curvature, places)

    def falls(self, reach: float) -> float:
        """Return by how much the parabola falls within the `reach` along each of its axes."""
        sizes, axes = np.linalg.eigh(self.curvature)
        way = axes.T @ self.step(reach)
        return -float((axes.T @ self.slope) @ way + 0.5 * np.sum(sizes * way**2))

    def step(self, reach: float) -> NDArray[np.float64]:
        """Return the way to its lowest point within the `reach` along each of its axes; where it bends down, to there.

        Down its slope in any case.
        """
        sizes, axes = np.linalg.eigh(self.curvature)
        along = axes.T @ self.slope
        steepness = np.maximum(np.abs(along) / reach, 1e-300)
        return np.asarray(-axes @ (along / np.maximum(sizes, steepness)))
