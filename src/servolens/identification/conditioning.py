"""Whether data determine what is asked of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Transmission

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["WORST", "determined", "is_touched", "open_directions", "well_conditioned"]

WORST, PART = 1e14, 1e-3
"""Condition from which on parameters count as not determined; share in such a direction from which on one is of it."""


def well_conditioned(information: NDArray[np.float64]) -> bool:
    """Tell whether the data determine all parameters: no column depends on the others."""
    scale = np.sqrt(np.diag(information))
    return bool(np.linalg.cond(information / np.outer(scale, scale)) < WORST)


def determined(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a basis of the directions that the data determine, shape (k, m); none of the diagonal may be 0."""
    scale = np.sqrt(np.diag(information))
    sizes, directions = np.linalg.eigh(information / np.outer(scale, scale))
    return np.asarray(directions[:, sizes >= sizes.max() / WORST] / scale[:, None])


def open_directions(information: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which parameters can be moved, alone or with others, without a trace in the data, shape (k,)."""
    seen = np.diag(information) > 0
    scale = np.sqrt(np.diag(information)[seen])
    sizes, directions = np.linalg.eigh(information[np.ix_(seen, seen)] / np.outer(scale, scale))
    free = sizes < sizes.max(initial=0.0) / WORST
    found = ~seen
    found[seen] = np.sum(directions[:, free] ** 2, axis=1) > PART
    return found


def is_touched(plant: Plant, name: str) -> bool:
    """Tell whether contacts disturb how the error depends on the parameter: their own, and those of the whole axis."""
    effect = plant.effect(name.rpartition(".")[0])
    return effect is None or isinstance(effect, Transmission)
