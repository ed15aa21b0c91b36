"""Prove what a search for gains found: cells on both sides of each end, as wide as their enclosures allow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.design.enclosure import FEASIBLE_CELL, INFEASIBLE, OPEN, LoopMaps, prove

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.design.found import Design
    from servolens.plant import Plant

    Array = NDArray[np.float64]

__all__ = ["proven_gap"]

ROUNDS = 6
"""How often cells that stay open are halved."""
REACH = 0.125
"""Width of a cell over its distance from the nearest end of an interval, at first."""


def proven_gap(
    models: tuple[Plant, ...],
    design: Design,
    scale: float,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[float, str | None]:
    """Return the widest stretch of gains of which nothing was proven, and where a proof contradicts the design.

    Parameters
    ----------
    models : tuple of Plant
        Smooth ones.
    design : Design
        What the search found.
    scale : float
        Of the loop [V s/m]; cells are no wider than this or than a quarter of their gain.
    progress : callable, optional
        Called with (description, done, total).

    Raises
    ------
    InputError
        If a plant is not smooth.
    """
    maps = [LoopMaps(model, design.spec) for model in models]
    gap, top = design.certificate.gap, design.certificate.searched[1]
    ends = np.array(sorted({end for span in design.intervals for end in span if 0.0 < end < top}))
    low, high = _cells(ends, top, scale, gap)
    left: list[tuple[float, float]] = [(end - 0.25 * gap, end + 0.25 * gap) for end in ends]
    for i in range(ROUNDS):
        if progress is not None:
            progress("proving", i, ROUNDS)
        verdicts = np.array([prove(each, low, high) for each in maps])
        verdict = np.where((verdicts == INFEASIBLE).any(axis=0), INFEASIBLE, verdicts.min(axis=0))
        middles = 0.5 * (low + high)
        inside = np.array([any(a <= kd <= b for a, b in design.intervals) for kd in middles], dtype=bool)
        wrong = ((verdict == FEASIBLE_CELL) & ~inside) | ((verdict == INFEASIBLE) & inside)
        if wrong.any():
            return gap, f"an enclosure contradicts the search at kd = {middles[wrong][0]:.6g}"
        still = verdict == OPEN
        narrow = still & (high - low <= 0.25 * gap)
        left += list(zip(low[narrow], high[narrow], strict=True))
        still &= ~narrow
        low, high = np.concatenate([low[still], middles[still]]), np.concatenate([middles[still], high[still]])
        if low.size == 0:
            break
    left += list(zip(low, high, strict=True))
    return _widest(left), None


def _cells(ends: Array, top: float, scale: float, gap: float) -> tuple[Array, Array]:
    """Return cells from 0 to `top`, narrow beside the `ends`, which stay free."""
    low, high = [], []
    borders = [0.0, *(end + s * 0.25 * gap for end in ends for s in (-1.0, 1.0)), top]
    for a, b in zip(borders[::2], borders[1::2], strict=True):
        kd = a
        while kd < b:
            distance = float(np.abs(ends - kd).min(initial=np.inf))
            ahead = min((end - kd for end in ends if end > kd), default=np.inf)
            width = min(REACH * max(distance, 2.0 * gap), 0.25 * max(scale, kd), max(0.5 * ahead, gap))
            after = min(kd + width, b)
            low.append(kd)
            high.append(after)
            kd = after
    return np.array(low), np.array(high)


def _widest(spans: list[tuple[float, float]]) -> float:
    """Return the length of the longest of the stretches that touching spans make."""
    longest, start, end = 0.0, -np.inf, -np.inf
    for low, high in sorted(spans):
        start, end = (start, max(end, high)) if low <= end + 1e-12 * abs(end) else (low, high)
        longest = max(longest, end - start)
    return float(longest)
