"""Error bars of parameters that the data hardly tell apart, where the error is flatter beside its minimum than there.

An axis that moves one way shows its friction and a constant force together alone, whatever each is. But where the
friction is just large enough to hold it, the error has a kink: differences over it make the two look known, and noise
may put the minimum there. The error bars are then those of the flattest place that explains as much.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.conditioning import WORST, determined, open_directions
from servolens.identification.error_problem import Point, Problem
from servolens.identification.fit_findings import HARDLY_APART
from servolens.identification.minimiser import NEGLIGIBLE_ON_THE_WAY, SHORT, descend
from servolens.identification.observed import ObservedRun
from servolens.identification.runs import moved_start
from servolens.identification.widths import linearised_widely

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.identification.linear_model import Linearised
    from servolens.identification.noise import NoiseModel
    from servolens.identification.refine import Refinement

__all__ = ["of_flattest_place"]

AWAY = 3.0
"""Standard errors from the minimum to where the error is looked at: nearer it explains nearly as much, and so may what
lies further along."""


def of_flattest_place(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with error bars of the flattest place that explains as much.

    Where the data tell all parameters apart, or contacts leave many minima to allow for, nothing changes.
    Parameters and result are those of :func:`~servolens.identification.fitted.with_error_bars`.
    """
    if refined.plant.has_contacts or not (np.abs(np.tril(refined.correlation, -1)) > HARDLY_APART).any():
        return refined
    runs = likelihood.runs(noise, unpowered=unpowered)
    if refined.usual:
        of_each = zip(runs, refined.usual, strict=True)
        runs = [run.less(usual) if isinstance(run, ObservedRun) else run for run, usual in of_each]
    problem = Problem(refined.plant, runs, likelihood.options(refined.plant), likelihood.weighed_by(noise))
    problem.noise, problem.outlier = refined.weights.noise, refined.weights.outlier
    with suppress(InputError, NumericalError):
        refined = _flattest(problem, refined)
    likelihood.tally.add(problem.simulated)
    return refined


def _flattest(problem: Problem, refined: Refinement) -> Refinement:
    """Return what was `refined` with error bars enlarged as far as one beside the minimum is larger."""
    minimum = problem.at(refined.starts, refined.local)
    found, _ = linearised_widely(problem, minimum)
    seen = (minimum.values > problem.low) & (minimum.values < problem.high) & (np.diag(found.information) > 0.0)
    if not seen.any():
        return refined
    own, is_open = _variances(found, seen), seen & open_directions(found.information)
    largest = own.copy()
    for beside in _beside(problem, minimum, found, np.flatnonzero(seen)):
        other, _ = linearised_widely(problem, beside)
        largest = np.maximum(largest, _variances(other, seen))
        is_open |= seen & open_directions(other.information)
    factors = np.ones(len(refined.covariance))
    ratios = np.divide(largest, own, out=np.ones_like(own), where=own > 0.0)
    factors[problem.free[::-1]] = np.sqrt(ratios)[::-1]  # of parameters of the records' own the first
    unknown = problem.names_of(is_open)
    correlation, lost = refined.correlation.copy(), np.array([name in unknown for name in problem.names])
    correlation[lost], correlation[:, lost] = np.nan, np.nan
    return replace(
        refined,
        covariance=refined.covariance * np.outer(factors, factors),
        correlation=correlation,
        undetermined=tuple(dict.fromkeys((*refined.undetermined, *unknown))),
    )


def _variances(found: Linearised, seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return those of the parameters that are `seen`, if the noise were white and 1, shape (k,); 0 of the others."""
    index = np.flatnonzero(seen & (np.diag(found.information) > 0.0))
    information, variances = found.information[np.ix_(index, index)], np.zeros(seen.size)
    if index.size:
        basis = determined(information)
        variances[index] = np.diag(basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T)
    return variances


def _beside(problem: Problem, minimum: Point, found: Linearised, free: NDArray[np.intp]) -> list[Point]:
    """Return where the minimiser ends from both sides of the `minimum`, along the direction that is determined least.

    Of the parameters that are `free`, as far as that explains more than the linearisation has it.
    """
    information, along = found.information[np.ix_(free, free)], np.zeros(problem.free.size)
    scale, variance = np.sqrt(np.diag(information)), problem.variance(minimum)
    sizes, directions = np.linalg.eigh(information / np.outer(scale, scale))
    least = int(np.argmax(sizes > sizes[-1] / WORST))
    along[free] = directions[:, least] / scale * AWAY * np.sqrt(variance / sizes[least])
    changes = [block.best_change(along, 0.0) for block in found.blocks]
    ends = []
    for side in (-1.0, 1.0):
        starts = [moved_start(start, side * change) for start, change in zip(minimum.starts, changes, strict=True)]
        begun = Point(np.clip(minimum.values + side * along, problem.low, problem.high), starts)
        begun.cost = problem.cost(begun)
        ends.append(descend(problem, begun, SHORT, NEGLIGIBLE_ON_THE_WAY)[0])
    return [end for end in ends if end.cost < minimum.cost + AWAY**2 * variance]
