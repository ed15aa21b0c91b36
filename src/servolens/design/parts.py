"""Parts of intervals of gains where something holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Span = tuple[float, float]

__all__ = ["parts_where"]


def parts_where(
    holds: Callable[[float], bool], spans: Iterable[Span], gap: float, tried: int, scale: float | None = None
) -> tuple[Span, ...]:
    """Return the parts of intervals of gains where something holds.

    Parameters
    ----------
    holds : callable
        Tells of a gain.
    spans : iterable of (float, float)
        Intervals.
    gap : float
        Within which a border between two gains that differ is located.
    tried : int
        Gains that are tried in each interval.
    scale : float, optional
        They lie evenly in asinh(gain / scale); evenly in the gain without it.
    """
    return tuple(piece for span in spans for piece in _within(holds, span, gap, tried, scale))


def _within(holds: Callable[[float], bool], span: Span, gap: float, tried: int, scale: float | None) -> list[Span]:
    gains = _between(*span, tried, scale)
    does = [holds(gain) for gain in gains]
    pieces: list[Span] = []
    for i, gain in enumerate(gains):
        if not does[i]:
            continue
        begin = gain if i == 0 else gains[i - 1]
        if i > 0 and not does[i - 1]:
            begin = _border(holds, gain, gains[i - 1], gap)
        end = gain if i + 1 == len(gains) or does[i + 1] else _border(holds, gain, gains[i + 1], gap)
        if pieces and i > 0 and does[i - 1]:
            pieces[-1] = (pieces[-1][0], end)
        else:
            pieces.append((begin, end))
    return pieces


def _between(low: float, high: float, tried: int, scale: float | None) -> list[float]:
    """Return gains from `low` to `high`, these themselves exactly."""
    if not high > low:
        return [low]
    if scale is None:
        return [float(gain) for gain in np.linspace(low, high, tried)]
    places = np.linspace(np.arcsinh(low / scale), np.arcsinh(high / scale), tried)
    return [low, *(float(gain) for gain in scale * np.sinh(places[1:-1])), high]


def _border(holds: Callable[[float], bool], inside: float, outside: float, gap: float) -> float:
    """Return the gain nearest to `outside` for which it holds, within `gap`."""
    while abs(outside - inside) > gap:
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside
