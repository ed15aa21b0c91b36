"""What is drawn: labelled lines, thinned to what a page can show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Curve", "Role", "curve"]

Role = Literal[
    "measured",
    "reference",
    "command",
    "constant",
    "varying",
    "velocity",
    "diagnosed",
    "truth",
    "pieces",
    "first",
    "second",
    "third",
]
"""What a line stands for; its look follows from it, the same in every figure."""
MOST_POINTS = 900


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """One line of a figure.

    Parameters
    ----------
    label : str
        In the legend; empty for none.
    x, y : ndarray, shape (n,)
        NaN breaks the line.
    role : Role
        What it stands for.
    """

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    role: Role

    def thinned(self, most: int = MOST_POINTS) -> Curve:
        """Return at most about `most` points: of each run of samples the smallest and the largest, in their order."""
        size = self.x.size
        if size <= most:
            return self
        bounds = np.linspace(0, size, most // 2 + 1).astype(np.intp)
        kept = {0, size - 1}
        for first, stop in pairwise(bounds):
            part = self.y[first:stop]
            if np.isfinite(part).all():
                kept |= {int(first + part.argmin()), int(first + part.argmax())}
            else:
                kept |= {int(first), int(stop - 1)}
        index = np.array(sorted(kept))
        return replace(self, x=self.x[index], y=self.y[index])


def curve(label: str, x: ArrayLike, y: ArrayLike, role: Role) -> Curve:
    """Return the curve, its values as float64 arrays."""
    return Curve(label=label, x=np.asarray(x, dtype=np.float64), y=np.asarray(y, dtype=np.float64), role=role)
