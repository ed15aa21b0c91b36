"""How fast a plant is, and so how many substeps a sample needs."""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isfinite
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["MOST_SUBSTEPS", "rate_of", "rate_within", "substeps_for", "work_of"]

STEP_TIMES_RATE = 0.02
"""Largest product of substep and the plant's fastest rate: about 20 nm on a 0.1 m step."""
FINE_SUBSTEPS = 8
STIFF_STEP_TIMES_RATE = 0.25
"""The same where more than eight substeps would be needed: so fast a mode dies out within the sample."""
STAMP_ROUNDING = 1e-9
"""Of a substep: what rounding makes of differences between the instants of a log asks for no further one."""
MOST_SUBSTEPS = 400
"""What needs more is simulated with as many, and no longer exactly."""
BESIDE_SUBSTEPS = 2
"""Substeps that take as long as all else that is done for a sample, whitening and sums of squares most of it: measured
over diagnoses, 28 ns each beside 56 ns."""
PROBES = ((0.0, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.1, 0.0), (0.1, 1.0, 0.0), (1.0, 0.0, 1.0), (-1.0, 0.0, -1.0))
"""Positions, speeds and values of the states at which the rates are looked at, SI."""


def substeps_for(plant: Plant, step: float, extra: float = 0.0) -> int:
    """Return how many substeps a sample of `step` seconds needs; `extra` [1/s] is a rate beside the plant's own."""
    rate = rate_of(plant) + extra
    if not isfinite(step * rate):
        return MOST_SUBSTEPS
    fine, coarse = (ceil(step * rate / most - STAMP_ROUNDING) for most in (STEP_TIMES_RATE, STIFF_STEP_TIMES_RATE))
    return min(max(min(fine, FINE_SUBSTEPS), coarse, 1), MOST_SUBSTEPS)


def rate_within(substeps: float, step: float) -> float:
    """Return the fastest rate [1/s] that so many `substeps` of a sample of `step` seconds allow, eight or more."""
    return substeps * STIFF_STEP_TIMES_RATE / step


def work_of(samples: int, substeps: int) -> int:
    """Return the cost of simulating and comparing samples; 1 is a sample with one substep."""
    return samples * (BESIDE_SUBSTEPS + substeps) // (BESIDE_SUBSTEPS + 1)


def rate_of(plant: Plant) -> float:
    """Return the fastest rate of a plant [1/s], or one beyond it."""
    return _fastest_rate(plant.structure)(plant.values)


@lru_cache(maxsize=256)
def _fastest_rate(structure: tuple[type[Effect], ...]) -> Callable[[tuple[float, ...]], float]:
    """Return a function of the parameters: the fastest rate [1/s] of the axis in a few conditions."""
    from servolens.simulation.native import native

    code = native(structure)
    contact = max((cls.contact_rate for cls in structure), default=0.0)
    smooth, relaxing = code.sizes
    n = 2 + smooth + relaxing
    probes = [_probe(n + relaxing, *probe) for probe in PROBES]
    exact = np.array([2 + i for i, place in enumerate(code.order) if place >= smooth], dtype=np.intp)

    def jacobian(x: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.empty(n * n)
        code.slopes(x.ctypes.data, p.ctypes.data, out.ctypes.data)
        return out.reshape(n, n).T

    @lru_cache(maxsize=1024)
    def rate(values: tuple[float, ...]) -> float:
        p = np.array(values)
        slopes = np.array([jacobian(probe, p) for probe in probes])
        return max(contact, _rate(slopes, exact, quick=contact == 0.0))

    return rate


def _probe(size: int, position: float, velocity: float, state: float) -> NDArray[np.float64]:
    """Return the kernel's [y, v, t, u, d, moving, shaking, states, ramps]."""
    return np.array([position, velocity, 0.0, 0.0, 1.0, 1.0, 0.0, *([state] * (size - 2))])


def _rate(slopes: NDArray[np.float64], exact: NDArray[np.intp], *, quick: bool) -> float:
    """Return the fastest rate of the Jacobians `slopes`, shape (k, n, n); how fast relaxing states forget is no matter.

    With `quick` a bound of it does, which is three times too large for a critically damped contact.
    """
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    if quick and slopes.shape[1] == 2:
        return float(np.max(np.abs(slopes[:, 1, 1]) + np.sqrt(np.abs(slopes[:, 1, 0])), initial=0.0))
    slopes[:, exact, exact] = 0.0
    return float(np.max(np.abs(np.linalg.eigvals(slopes)), initial=0.0))
