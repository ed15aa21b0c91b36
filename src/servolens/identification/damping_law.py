"""Damping against speed, C(v) = α₁ exp(−α₂|v|) + γ (paper section III.A.5), by two routes.

:func:`law_from_pieces` is the paper's: through the damping of each piece (eqs. 19–22). :func:`fit_law` puts the law
itself into the integral equation, y = y₀ + v₀t + β∬V − γ∫(y − y₀) − α₁∬exp(−α₂|v|)v, linear for given α₂ (variable
projection: Golub and Pereyra 1973, doi:10.1137/0710036).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import VelocityDecayDamping
from servolens.errors import InputError
from servolens.identification.integral import assemble, constraints_on, solve_integral
from servolens.identification.regressors import regressor
from servolens.identification.smoothing import smooth
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.identification.options import FitOptions
    from servolens.identification.segments import Segment
    from servolens.identification.varying import VaryingDamping

__all__ = ["SHAPE", "SIZE", "fit_law", "law_from_pieces"]

SLOWEST_DECAY, FASTEST_DECAY = 0.3, 300.0
"""Range of α₂ times the highest speed: below, the law is a straight line; above, it acts at standstill only."""
GRID = 24
SIZE, SHAPE = (f"{VelocityDecayDamping.name}.{name}" for name in ("alpha1", "alpha2"))
UNKNOWNS = ("damping", "gain", SIZE)
NOT_NEGATIVE = {"damping": 0.0, SIZE: 0.0}
"""Damping is not negative at any speed, and falls with it or does not depend on it."""


def law_from_pieces(varying: VaryingDamping) -> Plant:
    """Return the plant whose C(v) passes closest to the damping of the pieces at their mean speeds.

    Minimises F of eq. 22; α₁ and γ are linear for given α₂, so one scalar is searched.

    Raises
    ------
    InputError
        If there are fewer than three pieces.
    """
    if varying.damping.size < 3:
        raise InputError(
            f"the damping law needs at least 3 pieces, the step holds {varying.damping.size}; choose shorter pieces"
        )

    def solve(alpha2: float) -> tuple[float, float, float]:
        basis = np.column_stack([np.exp(-alpha2 * varying.speed), np.ones(varying.speed.size)])
        (alpha1, gamma), *_ = np.linalg.lstsq(basis, varying.damping, rcond=None)
        if alpha1 < 0.0:
            alpha1, gamma = 0.0, varying.damping.mean()
        return float(np.sum((basis @ [alpha1, gamma] - varying.damping) ** 2)), float(alpha1), float(gamma)

    fastest = max(float(varying.speed.max()), 1e-12)
    alpha2 = _search(lambda a: solve(a)[0], SLOWEST_DECAY / fastest, FASTEST_DECAY / fastest)
    _, alpha1, gamma = solve(alpha2)
    law = VelocityDecayDamping(alpha1=alpha1, alpha2=alpha2)
    return Plant(gain=varying.gain, damping=gamma, effects=(law,), inertia=varying.inertia)


def fit_law(segments: Sequence[Segment], window: int, options: FitOptions) -> Plant:
    """Fit the law in the integral equation of all `segments` at once.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion.
    window : int
        Samples of the smoothing derivative that gives |v|.
    options : FitOptions
        What is fixed or bounded; priors on γ and β.
    """
    priors = {index: options.priors[name] for index, name in enumerate(UNKNOWNS[:2]) if name in options.priors}
    constraints = constraints_on(UNKNOWNS, options, NOT_NEGATIVE)
    velocities = [smooth(s.time, s.position, window)[1] for s in segments]
    law = regressor(VelocityDecayDamping)

    def solve(alpha2: float) -> tuple[float, list[float]]:
        forces = [law.columns(s.time, s.position, v, alpha2) for s, v in zip(segments, velocities, strict=True)]
        factor = assemble(segments, forces=forces)
        noise = abs(float(factor[-1, -1])) / np.sqrt(sum(s.time.size for s in segments))
        solution = solve_integral(factor, priors, noise, constraints)
        misfit = np.linalg.norm(factor[:-1, :-1] @ solution.x - factor[:-1, -1]) ** 2 + factor[-1, -1] ** 2
        return float(misfit), [float(v) for v in solution.x]

    fastest = max(*(float(np.abs(v).max()) for v in velocities), 1e-12)
    alpha2 = _search(lambda a: solve(a)[0], *options.range_of(SHAPE, SLOWEST_DECAY / fastest, FASTEST_DECAY / fastest))
    gamma, gain, alpha1 = solve(alpha2)[1]
    law_found = VelocityDecayDamping(alpha1=max(alpha1, 0.0), alpha2=alpha2)  # 0 is met to rounding
    return segments[0].plant(gain, max(gamma, 0.0), (law_found,))


def _search(cost: Callable[[float], float], slowest: float, quickest: float) -> float:
    """Minimise over α₂: a logarithmic grid, then Brent's method around its best point."""
    from scipy.optimize import minimize_scalar

    if slowest >= quickest:
        return slowest
    grid = np.geomspace(slowest, quickest, GRID)
    values = [cost(float(a)) for a in grid]
    best = int(np.argmin(values))
    low, high = np.log(grid[max(best - 1, 0)]), np.log(grid[min(best + 1, GRID - 1)])
    found = minimize_scalar(
        lambda x: cost(float(np.exp(x))), bounds=(low, high), method="bounded", options={"xatol": 1e-7}
    )
    return float(np.exp(found.x)) if found.fun <= values[best] else float(grid[best])
