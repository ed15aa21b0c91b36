"""The minimiser, and what it does where contacts give the error many local minima."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.error_problem import COARSE, FINE, Point
from servolens.identification.widths import linearised_widely

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.error_problem import Problem
    from servolens.identification.linear_model import Linearised

__all__ = ["NEGLIGIBLE_ON_THE_WAY", "SHORT", "beside", "by_way_of", "descend", "lowest_minimum"]

NEGLIGIBLE, NEGLIGIBLE_ON_THE_WAY = 1e-8, 1e-6
"""Share of the squared residual whose gain ends the search: with some thousand samples, a hundredth of a standard
error; of hypotheses that are compared, a tenth."""
FIRST_DAMPING, LEAST_DAMPING, LEAST_FACTOR = 1e-3, 1e-12, 0.1
"""Of the normal equations, in units of their diagonal: where a descent begins, the least, by what it falls at most with
one step."""
KEPT = 0.25
"""Share of the promised fall below which a step's slopes are no guide to the next (as for trust regions: Nocedal and
Wright, *Numerical Optimization*, 2nd edition 2006, algorithm 4.1)."""
ALONG = np.concatenate([np.geomspace(0.2, 0.97, 20), np.geomspace(1.03, 5.0, 20)]) - 1.0
"""How far to look along the least-determined direction, in sizes of the parameter that changes most."""
LOWEST, APART, LOOKS, SHORT = 3, 0.1, 3, 20
"""Places along it from which the search goes on, and how far they are apart at least; times at most that it is
looked along; iterations of the first descents."""
BESIDE = (-0.1, -0.03, -0.01, -0.003, 0.003, 0.01, 0.03, 0.1)
"""How far beside the end of a search its neighbours are looked for, in sizes of the parameter that changes most."""
AS_DEEP, DEEPER = 1.02, 1.0 - 1e-3
"""Times the least error up to which a local minimum explains as much, for no simulation of contacts is more exact;
below which it explains more."""


def descend(problem: Problem, point: Point, iterations: int, negligible: float = NEGLIGIBLE) -> tuple[Point, bool]:
    """Return where the search ends and whether that is an optimum: no step gains more than the `negligible`.

    Levenberg and Marquardt's method; the damping follows from how much of the promised fall a step brings, and between
    differences the slopes follow from the steps themselves (Madsen, Nielsen and Tingleff, *Methods for Non-Linear
    Least Squares Problems*, 2nd edition 2004, chapter 3). Differences confirm the end. Where ends are only compared, so
    does a step that gains no more than the `negligible`, whatever was promised of it.
    """
    damping, left, slopes, is_exact = FIRST_DAMPING, iterations, None, True
    while left > 0 and not problem.is_spent:
        if slopes is None:
            problem.choose_substeps(point)
            slopes, is_exact = problem.differences(point), True
        found = problem.equations(point, slopes)
        gain = negligible * point.cost
        is_last = found.most(problem.unbounded(point, found.gradient)) < gain
        if is_last and is_exact:
            return _ended(problem, point, found, damping, negligible), True
        lower, needed = (None, damping) if is_last else _lower(problem, point, found, damping, gain, once=not is_exact)
        if lower is None and is_exact:
            return point, bool(np.isfinite(point.cost))
        if lower is None:
            slopes = None
            continue
        fall, left = point.cost - lower.cost, left - 1
        if is_exact and fall < gain and negligible > NEGLIGIBLE:  # what slopes promise of a rough error is not kept
            return lower, False
        kept = fall / lower.promised if lower.promised > 0.0 else 0.0
        damping = _damping(damping, kept) if needed == damping else needed
        slopes = problem.secants(slopes, point, lower) if kept > KEPT and fall >= gain else None
        point, is_exact = lower, False
    return point, False


def _damping(damping: float, kept: float) -> float:
    """Return the damping after a step that kept so much of what was promised."""
    return max(damping * max(LEAST_FACTOR, 1.0 - (2.0 * kept - 1.0) ** 3), LEAST_DAMPING)


def _lower(
    problem: Problem, point: Point, found: Linearised, damping: float, gain: float, *, once: bool
) -> tuple[Point | None, float]:
    """Return the first of several trials, each damped more, that is lower than `point`, and the damping; None if none.

    The last promises less than the `gain` that counts, or moves nothing. Only `once` where the slopes may be to blame.
    """
    factor = 2.0
    while True:
        trial = problem.step(point, found, damping)
        if trial.cost < point.cost:
            return trial, damping
        if once or 0.0 <= trial.promised < gain or not _moves(problem, point, trial):
            return None, damping
        damping, factor = damping * factor, 2.0 * factor


def _moves(problem: Problem, point: Point, trial: Point) -> bool:
    """Return whether a parameter of the `trial` differs from that of the `point` by more than numbers are exact."""
    exact = np.finfo(float).eps * np.maximum(np.abs(point.values), problem.scale)
    return bool((np.abs(trial.values - point.values) > exact).any())


def _ended(problem: Problem, point: Point, found: Linearised, damping: float, negligible: float) -> Point:
    """Return `point`; or the last step from it, if so little is still of interest."""
    if negligible > NEGLIGIBLE:
        return point
    return min(point, problem.step(point, found, damping), key=lambda end: end.cost)


def lowest_minimum(problem: Problem, point: Point, iterations: int, *, converged: bool) -> tuple[Point, bool]:
    """Return where the search ends if it is begun again along the direction that the data know least.

    Contacts give the error many local minima along that direction, and a minimisation ends in the first. A smooth
    error there is no sign that the minimum is the lowest.
    """
    way = ((COARSE, SHORT), (0.2 * COARSE, SHORT), (FINE, iterations))
    for _ in range(LOOKS):
        found, _ = linearised_widely(problem, point)
        direction = _least_determined(problem, point, found.information)
        if not direction.any():
            break
        trials = [(t.cost, share, t) for share in ALONG if (t := _moved(problem, point, share * direction)) is not None]
        least = point.cost
        for start in () if problem.is_spent else _lowest(trials):
            trial, reached = by_way_of(problem, start, way)
            if trial.cost < point.cost:
                point, converged = trial, reached
        if point.cost > (1.0 - NEGLIGIBLE) * least:
            break
    return _begun_again(problem, point, iterations, converged=converged)


def _begun_again(problem: Problem, point: Point, iterations: int, *, converged: bool) -> tuple[Point, bool]:
    """Return where the search ends if each run begins anew, as the plant that was found misses it least.

    Where in the gap the motor began, and at which position, has minima of its own, which another plant ranks otherwise.
    """
    if problem.is_spent or not any(start.size for start in point.starts):
        return point, converged
    trial, reached = by_way_of(problem, problem.begun_again(point), ((FINE, iterations),))
    return (trial, reached) if trial.cost < point.cost else (point, converged)


def beside(
    problem: Problem, point: Point, iterations: int, *, converged: bool, was_stopped: bool = False
) -> tuple[Point, bool, list[NDArray[np.float64]]]:
    """Return where the search ends if lower minima beside its end are followed, and those that explain as much.

    Of the minima the values of the parameters, shape (k,); the lowest is among them as often as a look beside it leads
    back. Where the error is smooth there are none, unless the search for the lowest `was_stopped`: then it may be
    smooth about one of many.
    """
    seen: list[Point] = []
    for _ in range(0 if problem.is_spent else LOOKS):
        found, is_smooth = linearised_widely(problem, point)
        direction = _least_determined(problem, point, found.information)
        if (is_smooth and not was_stopped) or not direction.any():
            break
        starts = [trial for share in BESIDE if (trial := _moved(problem, point, share * direction)) is not None]
        ends = [by_way_of(problem, start, ((FINE, SHORT),), NEGLIGIBLE_ON_THE_WAY)[0] for start in starts]
        seen += [point, *ends]
        lowest = min(seen, key=lambda minimum: minimum.cost)
        if lowest.cost > DEEPER**2 * point.cost:
            break
        point, converged = by_way_of(problem, lowest, ((FINE, iterations),))
    return point, converged, [minimum.values for minimum in seen if minimum.cost <= AS_DEEP**2 * point.cost]


def by_way_of(
    problem: Problem, start: Point, way: Sequence[tuple[float, int]], negligible: float = NEGLIGIBLE
) -> tuple[Point, bool]:
    """Return where descents by these shares and iterations end one after the other, or the last that did not fail."""
    point, converged = start, False
    for problem.share, iterations in way:
        with suppress(NumericalError):
            point, converged = descend(problem, point, iterations, negligible)
    problem.share = FINE
    return point, converged


def _least_determined(problem: Problem, point: Point, information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of which the data say least among what contacts touch, shape (k,).

    As long as one parameter changes by its size. What is at the end of its range stays there.

    Parameters
    ----------
    problem : Problem
        Of which contacts touch some parameters.
    point : Point
        From where.
    information : ndarray, shape (k, k)
        Of wide differences there: where contacts make the error non-smooth, its long directions still show in them.
    """
    direction = np.zeros(problem.free.size)
    index = np.flatnonzero(problem.touched & (point.values > problem.low) & (point.values < problem.high))
    if index.size == 0:
        return direction
    inner = information[np.ix_(index, index)]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    _, directions = np.linalg.eigh(inner / np.outer(scale, scale))
    direction[index] = directions[:, 0] / scale
    return direction / float(np.max(np.abs(direction) / np.maximum(np.abs(point.values), 1e-3 * problem.scale)))


def _moved(problem: Problem, point: Point, change: NDArray[np.float64]) -> Point | None:
    """Return the trial `change` away from `point`; None where that is no plant or cannot be simulated."""
    values = point.values + change
    if ((values < problem.low) | (values > problem.high)).any():
        return None
    trial = Point(values, [start.copy() for start in point.starts])
    trial.cost = np.inf if problem.too_stiff(trial) else problem.cost(trial)
    return trial if np.isfinite(trial.cost) else None


def _lowest(trials: Sequence[tuple[float, float, Point]]) -> list[Point]:
    """Return the trials of the least cost that are apart from each other, of their costs and places."""
    chosen: list[tuple[float, Point]] = []
    for _, place, trial in sorted(trials, key=lambda found: found[0]):
        if len(chosen) < LOWEST and all(abs(place - other) >= APART * (1.0 + other) for other, _ in chosen):
            chosen.append((place, trial))
    return [trial for _, trial in chosen]
