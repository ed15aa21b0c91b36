"""Phases that are each record's own, as of a machine nearby that does not know when a record begins."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["own_phases", "round_the_circle", "synchronised"]

TRIED, TURNED = 8, 0.2
"""Phases that are tried, evenly round the circle; by how much the best is turned further [rad]."""


def own_phases(plant: Plant) -> tuple[str, ...]:
    """Return the qualified names of the phases that each record has of its own."""
    waves = [effect for effect in plant.effects if effect.phase_per_record and effect.wave]
    return tuple(f"{effect.name}.{effect.wave[1]}" for effect in waves if effect.wave)


def round_the_circle(phase: float) -> list[float]:
    """Return phases evenly round the circle from -π to π, `phase` first."""
    turned = phase + 2.0 * np.pi / TRIED * np.arange(TRIED)
    return [float(one) for one in (turned + np.pi) % (2.0 * np.pi) - np.pi]


def synchronised(plant: Plant, miss: Callable[[Plant], float], *, fine: bool = True) -> Plant:
    """Return `plant` with the phases of its own for which it misses a record least; not `fine`, nearly so."""
    for name in own_phases(plant):
        plant = _turned(plant, name, miss, fine=fine)
    return plant


def _turned(plant: Plant, name: str, miss: Callable[[Plant], float], *, fine: bool) -> Plant:
    """Turn one phase: a linear axis misses a record by a trigonometric polynomial of the second degree."""
    index = list(plant.parameters).index(name)

    def missed(phase: float) -> float:
        return miss(_with(plant, index, phase))

    tried = {phase: missed(phase) for phase in round_the_circle(plant.values[index])}
    finite = {phase: error for phase, error in tried.items() if np.isfinite(error)}
    if not finite:
        return plant
    middle = _lowest(finite)
    tried[middle] = missed(middle)
    if fine:
        from scipy.optimize import minimize_scalar

        best = min(tried, key=lambda phase: tried[phase])
        found = minimize_scalar(
            missed, bounds=(best - TURNED, best + TURNED), method="bounded", options={"xatol": 1e-4}
        )
        tried[float(found.x)] = float(found.fun)
    return _with(plant, index, min(tried, key=lambda phase: tried[phase]))


def _lowest(tried: dict[float, float]) -> float:
    """Return where the polynomial through what was `tried` is lowest."""
    phases = np.array(list(tried))
    circle = np.linspace(-np.pi, np.pi, 721)
    least, *_ = np.linalg.lstsq(_waves(phases), np.array(list(tried.values())), rcond=None)
    return float(circle[np.argmin(_waves(circle) @ least)])


def _waves(phases: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones(phases.size), *(f(k * phases) for k in (1, 2) for f in (np.cos, np.sin))], axis=1)


def _with(plant: Plant, index: int, value: float) -> Plant:
    values = list(plant.values)
    values[index] = value
    return plant.with_values(values)
