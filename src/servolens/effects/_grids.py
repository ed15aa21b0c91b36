"""Grids from which effects with a shape parameter start their fits."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from servolens.effects.base import Effect, Seen

__all__ = ["frequencies", "pitches", "within"]

E = TypeVar("E", bound="Effect")
COUNT, DENSE = 60, 200


def within(cls: type[E], **values: float) -> E:
    """Return the effect with `values` clipped into their bounds."""
    specs = [spec for spec in cls.parameters() if spec.usual is None or spec.name in values]
    return cls(**{spec.name: float(np.clip(values[spec.name], spec.low, spec.high)) for spec in specs})


def pitches(seen: Seen) -> list[float]:
    """Return lengths that repeat along the travel, so dense that none lies more than a fifth of a period off."""
    most = min(seen.travel / max(6 * seen.noise, 1e-12), 150.0)
    periods = np.arange(0.5, max(most, 0.6), 0.4)
    return [float(seen.travel / count) for count in periods]


def frequencies(seen: Seen) -> list[float]:
    """Return frequencies [Hz] up to ten samples a period, the lower ones as dense as the longest record resolves."""
    resolved, highest = 0.4 / max(seen.duration, 1e-9), 0.1 / max(seen.sample_time, 1e-9)
    dense = resolved * np.arange(1, DENSE + 1)
    sparse = np.geomspace(dense[-1], max(highest, dense[-1]), COUNT)[1:]
    return [float(value) for value in np.unique([*dense[dense <= highest], *sparse[sparse <= highest]])] or [highest]
