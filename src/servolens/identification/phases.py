"""Phases that are each record's own, as of a machine nearby that does not know when a record begins."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.plant import Plant

__all__ = ["own_phases", "round_the_circle", "synchronised"]

TRIED = 12
"""Phases that are tried, evenly round the circle."""


def own_phases(plant: Plant) -> tuple[str, ...]:
    """Return the qualified names of the phases that each record has of its own."""
    waves = [effect for effect in plant.effects if effect.phase_per_record and effect.wave]
    return tuple(f"{effect.name}.{effect.wave[1]}" for effect in waves if effect.wave)


def round_the_circle(phase: float) -> list[float]:
    """Return phases evenly round the circle from -π to π, `phase` first."""
    turned = phase + 2.0 * np.pi / TRIED * np.arange(TRIED)
    return [float(one) for one in (turned + np.pi) % (2.0 * np.pi) - np.pi]


def synchronised(plant: Plant, miss: Callable[[Plant], float]) -> Plant:
    """Return `plant` with the phases of its own for which it misses a record least."""
    for name in own_phases(plant):
        plant = _turned(plant, name, miss)
    return plant


def _turned(plant: Plant, name: str, miss: Callable[[Plant], float]) -> Plant:
    from scipy.optimize import minimize_scalar

    index = list(plant.parameters).index(name)

    def missed(phase: float) -> float:
        return miss(_with(plant, index, phase))

    best = min(round_the_circle(plant.values[index]), key=missed)
    width = 2.0 * np.pi / TRIED
    found = minimize_scalar(missed, bounds=(best - width, best + width), method="bounded")
    return _with(plant, index, float(found.x) if found.fun < missed(best) else best)


def _with(plant: Plant, index: int, value: float) -> Plant:
    values = list(plant.values)
    values[index] = value
    return plant.with_values(values)
