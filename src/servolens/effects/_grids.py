"""Grids from which effects with a shape parameter start their fits."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from servolens.effects.base import Effect, Seen

__all__ = ["frequencies", "pitches", "within"]

E = TypeVar("E", bound="Effect")
COUNT = 24


def within(cls: type[E], **values: float) -> E:
    """Return the effect with `values` clipped into their bounds."""
    return cls(**{spec.name: float(np.clip(values[spec.name], spec.low, spec.high)) for spec in cls.parameters()})


def pitches(seen: Seen) -> list[float]:
    """Return lengths that repeat along the travel, from two thirds of it down to what the noise lets one see."""
    return _geometric(seen.travel / 1.5, max(seen.travel / 60, 6 * seen.noise))


def frequencies(seen: Seen) -> list[float]:
    """Return frequencies [Hz] from half a period in the longest record up to ten samples a period."""
    return _geometric(0.5 / max(seen.duration, 1e-9), 0.1 / max(seen.sample_time, 1e-9), rising=True)


def _geometric(first: float, last: float, *, rising: bool = False) -> list[float]:
    """Return `COUNT` values from `first` to `last`, or `first` alone where nothing lies between."""
    if (last > first) != rising:
        return [first]
    return [float(value) for value in np.geomspace(first, last, COUNT)]
