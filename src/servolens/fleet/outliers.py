"""Axes whose parameters lie far from those of the others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.fleet.rows import parameters_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.fleet.rows import Row

__all__ = ["Outlier", "outliers_of"]

OUTLIER_DEVIATIONS = 3.5
"""Robust standard deviations from the median (Iglewicz and Hoaglin 1993)."""
FEWEST_VALUES = 8
"""Values without which nobody can tell what is usual."""
NORMAL = 1.4826
"""The standard deviation of normal values over their median absolute deviation."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Outlier:
    """A value that is unlike those of the other axes.

    Attributes
    ----------
    axis, measured, parameter, unit : str
        Whose value it is; `measured` may be empty.
    value, median : float
        The value, and the median of all.
    distance : float
        From the median, in robust standard deviations that include the value's own standard error.
    """

    axis: str
    measured: str
    parameter: str
    unit: str
    value: float
    median: float
    distance: float

    def to_json(self) -> dict[str, Any]:
        """Return the outlier as it stands in ``servolens.fleet/1``."""
        return {name: getattr(self, name) for name in self.__slots__}


def outliers_of(rows: Sequence[Row]) -> tuple[Outlier, ...]:
    """Return the values far from the median of their parameter, for parameters with eight values or more."""
    found = []
    for (parameter, unit), those in parameters_of(rows).items():
        if len(those) < FEWEST_VALUES:
            continue
        values = np.array([value for _, value, _ in those])
        median = float(np.median(values))
        spread = NORMAL * float(np.median(np.abs(values - median)))
        for row, value, error in those:
            scale = math.hypot(spread, error or 0.0)
            if abs(value - median) > OUTLIER_DEVIATIONS * scale and abs(value - median) > np.finfo(float).eps * abs(
                median
            ):
                distance = (value - median) / scale if scale > 0 else math.copysign(math.inf, value - median)
                found.append(
                    Outlier(
                        axis=str(row["axis"]), measured=str(row["measured"] or ""), parameter=parameter, unit=unit,
                        value=value, median=median, distance=distance,
                    )
                )  # fmt: skip
    return tuple(sorted(found, key=lambda one: (-abs(one.distance), one.axis, one.measured, one.parameter)))
