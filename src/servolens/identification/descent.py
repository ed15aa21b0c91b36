"""The descent to the least error, and what to do where contacts fold that error into many valleys."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.identification.error_problem import COARSE, FINE, Point

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.error_problem import Problem

__all__ = ["NEGLIGIBLE_ON_THE_WAY", "along_the_valley", "descend", "folds_beside"]

NEGLIGIBLE, NEGLIGIBLE_ON_THE_WAY = 1e-8, 1e-6
"""Share of the squared residual whose gain ends the search: with some thousand samples, a hundredth of a standard
error; of hypotheses that are compared, a tenth."""
ALONG = np.concatenate([np.geomspace(0.2, 0.97, 20), np.geomspace(1.03, 5.0, 20)]) - 1.0
"""How far a long valley is looked along, in sizes of the parameter that changes most."""
LOWEST, APART, LOOKS, SHORT = 3, 0.1, 3, 20
"""Places in the valley from which the search goes on, and how far they are apart at least; times at most that it is
looked along; iterations of the first descents."""
BESIDE = (-0.1, -0.03, -0.01, -0.003, 0.003, 0.01, 0.03, 0.1)
"""How far beside the end of a search its neighbours are looked for, in sizes of the parameter that changes most."""
ALIKE, DEEPER = 1.02, 1.0 - 1e-3
"""Times the least error up to which a fold explains as much, for no simulation of contacts is more exact; below which
it explains more."""


def descend(problem: Problem, point: Point, iterations: int, negligible: float = NEGLIGIBLE) -> tuple[Point, bool]:
    """Return where the search ends and whether that is an optimum: a step gains no more than the `negligible`."""
    damping = 1e-3
    for _ in range(iterations):
        blocks, gradient, information = problem.linearise(point)
        for _ in range(12):
            trial = problem.step(point, blocks, gradient, information, damping)
            if trial.cost < point.cost:
                break
            damping *= 5.0
        else:
            return point, bool(np.isfinite(point.cost))
        gained = 1.0 - trial.cost / point.cost
        point, damping = trial, max(damping / 10.0, 1e-12)
        if gained < negligible:
            return point, True
    return point, False


def along_the_valley(problem: Problem, point: Point, iterations: int, *, converged: bool) -> tuple[Point, bool]:
    """Return where the search ends if it is begun again along the direction that the data know least.

    Contacts crumple the error, so a descent ends in the first fold of a long valley; the valley itself is wide. The
    fold may be smooth: that is no sign of its being the deepest.
    """
    for _ in range(LOOKS):
        found, _ = problem.linearised_widely(point)
        direction = problem.softest(point, found.information)
        if not direction.any():
            break
        trials = [(t.cost, share, t) for share in ALONG if (t := problem.moved(point, share * direction)) is not None]
        least = point.cost
        for start in _lowest(trials):
            trial, reached = start, False
            for share in (COARSE, 0.2 * COARSE, FINE):
                problem.share = share
                trial, reached = descend(problem, trial, iterations if share == FINE else SHORT)
            if trial.cost < point.cost:
                point, converged = trial, reached
        if point.cost > (1.0 - NEGLIGIBLE) * least:
            break
    return point, converged


def _lowest(trials: Sequence[tuple[float, float, Point]]) -> list[Point]:
    """Return the trials of the least cost that are apart from each other, of their costs and places."""
    chosen: list[tuple[float, Point]] = []
    for _, place, trial in sorted(trials, key=lambda found: found[0]):
        if len(chosen) < LOWEST and all(abs(place - other) >= APART * (1.0 + other) for other, _ in chosen):
            chosen.append((place, trial))
    return [trial for _, trial in chosen]


def folds_beside(problem: Problem, point: Point) -> tuple[Point, list[NDArray[np.float64]]]:
    """Return the deepest fold beside `point`, and how far from it those are that explain as much.

    Where contacts crumple the error, the data do not tell these apart; where they do not, there are none.
    """
    folds: list[Point] = []
    for _ in range(LOOKS):
        found, crumpled = problem.linearised_widely(point)
        if not crumpled:
            return point, []
        direction = problem.softest(point, found.information)
        starts = [trial for share in BESIDE if (trial := problem.moved(point, share * direction)) is not None]
        problem.share = FINE
        folds = [descend(problem, start, SHORT, NEGLIGIBLE_ON_THE_WAY)[0] for start in starts]
        deepest = min(folds, key=lambda fold: fold.cost, default=point)
        if deepest.cost > DEEPER**2 * point.cost:
            break
        point = deepest
    return point, [fold.values - point.values for fold in folds if fold.cost <= ALIKE**2 * point.cost]
