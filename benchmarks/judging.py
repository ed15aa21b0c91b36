"""Whether what was found is what was hidden: errors of parameters, and whether their intervals hold the truth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.lab.laws import KNOTS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = ["judged_parameters"]


def judged_parameters(
    effect: str, truth: Mapping[str, float], quantities: Mapping[str, Any]
) -> tuple[dict[str, float], dict[str, bool | None]]:
    """Return relative errors (of a phase in rad), and whether 95 % intervals hold the truth; None without interval.

    `truth` and `quantities` are those of one effect, by the name of the parameter.
    """
    errors: dict[str, float] = {}
    held: dict[str, bool | None] = {}
    for name, true, quantity, sign in _compared(effect, truth, quantities):
        unit = 1.0 if name == "phase" else abs(true) or 1.0
        errors[name] = abs(sign * quantity.value - true) / unit
        interval = quantity.interval
        ends = None if interval is None else sorted(sign * end for end in interval)
        held[name] = None if ends is None else bool(ends[0] <= true <= ends[1])
    return errors, held


def _compared(
    effect: str, truth: Mapping[str, float], quantities: Mapping[str, Any]
) -> Iterator[tuple[str, float, Any, float]]:
    """Yield name, true value, quantity found, and the sign to read it with."""
    own = dict(truth)
    if effect == "friction_map" and own:
        own = _map_of(own, quantities["low"], quantities["high"])
    turned = "phase" in own and quantities["amplitude"].value * own["amplitude"] < 0
    for name, value in own.items():
        quantity, sign = quantities[name], 1.0
        if name == "amplitude" and turned:  # −A sin(x + π) is A sin x
            sign = -1.0
        if name == "phase":  # the same angle, as near as can be to the one found
            value += math.pi * turned
            value += 2.0 * math.pi * round((quantity.value - value) / (2.0 * math.pi))
        yield name, value, quantity, sign


def _map_of(truth: Mapping[str, float], low: Any, high: Any) -> dict[str, float]:
    """Return the true parameters of a friction map, or its levels at knots that were not estimated.

    Levels and the places of their knots are estimated together: the interval of a level allows for its place. The true
    level at the place that was found is another number, off by the slope of the map times the error of the place.
    """
    if low.stderr is not None and high.stderr is not None:
        return dict(truth)
    return _map_at(truth, low.value, high.value)


def _map_at(truth: Mapping[str, float], low: float, high: float) -> dict[str, float]:
    """Return the true levels of a friction map at knots from `low` to `high`."""
    knots, wanted = np.linspace(truth["low"], truth["high"], KNOTS), np.linspace(low, high, KNOTS)
    levels = {}
    for side in ("positive", "negative"):
        own = np.interp(wanted, knots, [truth[f"{side}_{i}"] for i in range(KNOTS)])
        levels |= {f"{side}_{i}": float(level) for i, level in enumerate(own)}
    return levels
