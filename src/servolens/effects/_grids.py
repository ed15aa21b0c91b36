"""Grids from which effects with a shape parameter start their fits."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from servolens.effects.base import Effect, Seen

__all__ = ["frequencies", "pitches", "within"]

E = TypeVar("E", bound="Effect")
PER_PEAK = 10
"""Trials per peak of a periodogram, which is as wide as one period more or less over all data: 5 to 10 are needed to
lock on (VanderPlas 2018, doi:10.3847/1538-4365/aab766)."""
COUNT, DENSE = 60, 80 * PER_PEAK
"""Frequencies far from one another, and near."""


def within(cls: type[E], **values: float) -> E:
    """Return the effect with `values` clipped into their bounds."""
    specs = [spec for spec in cls.parameters() if spec.usual is None or spec.name in values]
    return cls(**{spec.name: float(np.clip(values[spec.name], spec.low, spec.high)) for spec in specs})


def pitches(seen: Seen) -> list[float]:
    """Return lengths that repeat along the travel, so dense that a fit locks on to any in between."""
    most = min(seen.travel / max(6 * seen.noise, 1e-12), 150.0)
    periods = np.arange(0.5, max(most, 0.6), 1.0 / PER_PEAK)
    return [float(seen.travel / count) for count in periods]


def frequencies(seen: Seen) -> list[float]:
    """Return frequencies [Hz] up to ten samples a period, the lower ones as dense as the longest record resolves."""
    resolved, highest = 1.0 / PER_PEAK / max(seen.duration, 1e-9), 0.1 / max(seen.sample_time, 1e-9)
    dense = resolved * np.arange(1, DENSE + 1)
    sparse = np.geomspace(dense[-1], max(highest, dense[-1]), COUNT)[1:]
    return [float(value) for value in np.unique([*dense[dense <= highest], *sparse[sparse <= highest]])] or [highest]
