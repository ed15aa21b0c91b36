"""A plant refined by simulation: what it misses of the records, minimised over the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.conditioning import determined, open_directions
from servolens.identification.error_problem import COARSE, FINE, Known, Point, Problem
from servolens.identification.minimiser import NEGLIGIBLE_ON_THE_WAY, beside, by_way_of, descend, lowest_minimum
from servolens.identification.observed import ObservedRun
from servolens.identification.rounding import draws_for, has_mean, own_spectra, parted, rounded
from servolens.identification.uncertainty import robust_covariance
from servolens.identification.widths import linearised_widely

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.linear_model import Block
    from servolens.identification.options import FitOptions
    from servolens.identification.runs import ClosedRun, Run
    from servolens.plant import Plant

__all__ = [
    "AT_NOISE",
    "DOWN_TO_NOISE",
    "Refinement",
    "Weights",
    "beside_draws",
    "followed",
    "minimise_error",
]

MOST_ITERATIONS = 60
NEARLY = 0.9
"""Share of the substeps that are granted from which on a search was stopped by them, and by no optimum."""
AT_NOISE, DOWN_TO_NOISE = 3.0, 1.05
"""Times the noise up to which a residual counts as explained; as fully so, with nothing left to search for."""
CORRECTED = 2
"""Times that what rounding leaves is drawn: of the optimum, then of the optimum beside its mean."""
MOST_FOLLOWED = 0.1
"""Share of a sample's variance that is left at least: beyond, its residual says nothing of its noise."""
HUBER = 2.5
"""Standard deviations from which on a residual counts linearly."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """What a misfit is measured by beside the residuals: the noise that priors are weighed against, and outliers.

    Attributes
    ----------
    noise : float
        Standard deviation of white noise that says as little of a mean as the residual does.
    outlier : float
        Size from which on a residual counts linearly.
    """

    noise: float
    outlier: float


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """Where the refinement ended.

    Attributes
    ----------
    plant : Plant
        The best plant found; the start if nothing better was. Parameters of each record's own are the first's.
    covariance : ndarray, shape (k, k)
        Of ``plant.values``; NaN for parameters that were held or that the data do not determine.
    correlation : ndarray, shape (k, k)
        Of the estimates if the residuals were white: what the data cannot tell apart. NaN for what was held.
    colour : ndarray, shape (k,)
        By how much coloured residuals enlarge each variance; NaN for what was held.
    local : mapping of str to ndarray, shape (records,)
        Parameters that each record has of its own.
    at_bound : tuple of str
        Parameters that ended at the end of their range.
    undetermined : tuple of str
        Parameters that were searched for and of which the data say nothing, or nothing of each alone.
    unfelt : tuple of str
        Those of them that change nothing at all.
    rms_error : float
        Root mean square of the residuals [m or rad, or the command's unit].
    residuals : tuple of ndarray
        Simulated minus measured of each run.
    starts : tuple of ndarray
        Initial state of each run, as far as it is free.
    misfit : float
        What was minimised: squares of the whitened residuals, or their robust loss, with priors.
    weights : Weights
        With which.
    variance : float
        Of what was minimised, for each degree of freedom.
    converged : bool
        Whether no step lowered the misfit any more.
    is_smooth : bool
        False where contacts give the error many local minima close together: error bars are those of wide differences
        and, driven by the voltage, allow for the minima nearby that explain as much.
    status : str
        One sentence.
    usual : tuple of ndarray
        What of the whitened residual of each run noise or an encoder's rounding leaves on average, where that may
        be much: it was taken off. Else empty.
    """

    plant: Plant
    covariance: NDArray[np.float64]
    correlation: NDArray[np.float64]
    colour: NDArray[np.float64]
    local: Mapping[str, NDArray[np.float64]]
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    rms_error: float
    residuals: tuple[NDArray[np.float64], ...]
    starts: tuple[NDArray[np.float64], ...]
    misfit: float
    weights: Weights
    variance: float
    converged: bool
    is_smooth: bool
    status: str
    usual: tuple[NDArray[np.float64], ...] = ()
    unfelt: tuple[str, ...] = ()

    def plant_of(self, group: int) -> Plant:
        """Return the plant of one record, with the parameters of its own."""
        return self.plant.with_named({name: float(found[group]) for name, found in self.local.items()})


def minimise_error(
    plant: Plant,
    runs: Sequence[Run],
    options: FitOptions,
    *,
    noise: float | None,
    coarse: bool = False,
    local_minima: bool = False,
    known: Known | None = None,
    allowance: float = np.inf,
) -> Refinement:
    """Minimise the residual of `runs` by Levenberg and Marquardt's method within the parameters' bounds.

    Parameters
    ----------
    plant : Plant
        Start and structure.
    runs : sequence of Run
        What is simulated and compared.
    options : FitOptions
        What is held, what each record has of its own, priors, and the loss: with ``"huber"`` residuals beyond 2.5
        robust standard deviations count linearly (Huber 1964, doi:10.1214/aoms/1177703732).
    noise : float or None
        Least standard deviation of the residual, against which priors are weighed; 1 of whitened ones. None where a
        noise model that was fitted whitens them: then priors are weighed as they stand.
    coarse : bool
        Where that does not reach the noise, or there are contacts, begin once more with sensitivities over a twentieth
        of each parameter: for errors that are not smooth on a small scale.
    local_minima : bool
        Where there are contacts, look along the least-determined direction for lower minima of the error, and for
        others as low, for which the error bars have to allow.
    known : Known, optional
        What another fit ended with: each run begins so, if that misses less.
    allowance : float
        Work after which no further minimum is looked for, see :func:`~servolens.simulation.rates.work_of`. What error
        bars need, the minima beside the end, may take as much again.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs.
    """
    problem = Problem(plant, runs, options, noise)
    problem.allowance = allowance
    point = problem.start(*(known or ()))
    if problem.too_stiff(point):  # what begins so is followed as it is; nothing else becomes so
        problem.most_substeps = np.inf
    searched = local_minima and plant.has_contacts
    problem.weigh_priors(point)
    point, converged = _lowest(problem, point, coarse=coarse, searched=searched)
    if problem.weigh_priors(point):
        point, converged = descend(problem, point, MOST_ITERATIONS)
    for _ in range(2 if options.loss == "huber" else 0):
        problem.outlier = HUBER * problem.spread(point)
        point.cost = problem.cost(point)
        point, converged = descend(problem, point, MOST_ITERATIONS)
    others: list[NDArray[np.float64]] = []
    if searched:
        point, converged, others = _beside_end(problem, point, allowance, converged=converged)
    is_optimum = converged and not problem.too_stiff(point, NEARLY)
    observed = [run for run in problem.runs if isinstance(run, ObservedRun)]
    if len(observed) == len(problem.runs) and has_mean(observed):
        point, rounding = _less_rounding(problem, point)
        return _finished(problem, point, others, converged=is_optimum, rounding=rounding)
    return _finished(problem, point, others, converged=is_optimum)


def minimise_likewise(plant: Plant, runs: Sequence[Run], options: FitOptions, weights: Weights) -> Refinement:
    """Minimise the residual of whitened `runs`, weighed as that of another fit, with whose misfit this is compared.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs.
    """
    problem = Problem(plant, runs, options, 1.0)
    problem.noise, problem.outlier = weights.noise, weights.outlier
    point = problem.start()
    if problem.too_stiff(point):
        problem.most_substeps = np.inf
    point, converged = descend(problem, point, MOST_ITERATIONS)
    return _finished(problem, point, [], converged=converged)


def beside_draws(
    refined: Refinement, runs: Sequence[ClosedRun], options: FitOptions, drawn: Sequence[NDArray[np.float64]]
) -> Refinement:
    """Return what was `refined` on `runs` with error bars of the noise that was `drawn`.

    Parameters
    ----------
    drawn : sequence of ndarray, shape (m, draws)
        What the noise adds to the residual of each run.

    Raises
    ------
    NumericalError
        If the plant cannot be simulated any more.
    """
    problem = Problem(refined.plant, runs, options, 1.0)
    problem.noise, problem.outlier = refined.weights.noise, refined.weights.outlier
    point = problem.at(refined.starts, refined.local)
    problem.choose_substeps(point)
    point.cost = problem.cost(point)
    noise = _Rounding(means=tuple(run.usual for run in runs), drawn=tuple(drawn), moved=np.zeros(problem.free.size))
    return _finished(problem, point, [], converged=refined.converged, rounding=noise)


def followed(
    plant: Plant, runs: Sequence[Run], options: FitOptions, *, noise: float, iterations: int
) -> tuple[Plant, float]:
    """Return where a few iterations from `plant` lead, with sensitivities over a twentieth, and the misfit there.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs.
    """
    problem = Problem(plant, runs, options, noise)
    start = problem.start()
    problem.weigh_priors(start)
    point, _ = by_way_of(problem, start, ((COARSE, iterations), (FINE, iterations)), NEGLIGIBLE_ON_THE_WAY)
    return problem.plant_at(point.values, 0), point.cost


def _lowest(problem: Problem, begun: Point, *, coarse: bool, searched: bool) -> tuple[Point, bool]:
    """Return where minimisation from `begun` ends, and whether that is an optimum."""
    plant, enough = problem.plant, (DOWN_TO_NOISE * problem.least_noise) ** 2 * problem.samples
    point, converged = descend(problem, begun, MOST_ITERATIONS)
    if coarse and (plant.has_contacts or point.cost > enough):
        other, reached = by_way_of(problem, begun, ((COARSE, MOST_ITERATIONS), (FINE, MOST_ITERATIONS)))
        if other.cost < point.cost:
            point, converged = other, reached
    if searched:
        problem.weigh_priors(point)
        point, converged = lowest_minimum(problem, point, MOST_ITERATIONS, converged=converged)
    return point, converged


def _beside_end(
    problem: Problem, point: Point, allowance: float, *, converged: bool
) -> tuple[Point, bool, list[NDArray[np.float64]]]:
    """Return what :func:`beside` finds at the end of a search, whatever of its `allowance` the search has left.

    A search that was stopped knows less, and its error bars must not be narrower for that. It is also led to the
    optimum that it was on the way to.
    """
    was_stopped, problem.allowance = problem.is_spent, problem.simulated + allowance
    if was_stopped and not converged:
        point, converged = descend(problem, point, MOST_ITERATIONS)
    return beside(problem, point, MOST_ITERATIONS, converged=converged, was_stopped=was_stopped)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rounding:
    """What an encoder's rounding leaves of whitened residuals: their mean, the rest of each draw, both run by run.

    And by how much the last correction by the mean moved the parameters: as well as that it is known.
    """

    means: tuple[NDArray[np.float64], ...]
    drawn: tuple[NDArray[np.float64], ...]
    moved: NDArray[np.float64]


def _less_rounding(problem: Problem, begun: Point) -> tuple[Point, _Rounding]:
    """Return the optimum beside the mean of what rounding leaves, drawn of the plant that is found, and the draws.

    Rounding moves the estimates by more than it scatters them, for a loop seeks one side of a step (bias by the
    parametric bootstrap: Efron and Tibshirani 1993, section 10.6). From here on the `problem` is without that mean.
    """
    runs = [run for run in problem.runs if isinstance(run, ObservedRun)]
    point, before = begun, begun.values
    for _ in range(CORRECTED):
        before, plants = point.values, [problem.plant_at(point.values, i) for i in range(len(runs))]
        own, count = own_spectra(runs, plants, point.starts), draws_for(problem.samples)
        draws = rounded(runs, plants, point.starts, own[np.arange(count) * len(own) // count])
        means, drawn = zip(*map(parted, runs, draws), strict=True)
        problem.runs = [run.less(mean) for run, mean in zip(runs, means, strict=True)]
        point = replace(point, cost=problem.cost(point))
        point, _ = descend(problem, point, MOST_ITERATIONS)
    return point, _Rounding(means=means, drawn=drawn, moved=point.values - before)


def _finished(
    problem: Problem,
    point: Point,
    others: Sequence[NDArray[np.float64]],
    *,
    converged: bool,
    rounding: _Rounding | None = None,
) -> Refinement:
    """Return the result of a search that ended at `point`; at the values of `others` as much is explained."""
    (blocks, _, information), is_smooth = linearised_widely(problem, point)
    within = (point.values > problem.low) & (point.values < problem.high)
    undetermined = within & open_directions(information)
    count = len(problem.names)
    covariance, correlation = (np.full((count, count), np.nan) for _ in range(2))
    colour = np.full(count, np.nan)
    index = np.flatnonzero(within & (np.diag(information) > 0))
    if index.size:
        inner, white = _covariances(problem, blocks, information, index, rounding)
        if others:
            away = (np.array(others) - point.values)[:, index]
            inner = inner + away.T @ away / len(others)
        first = problem.slots[0][1]
        kept = [i for i, k in enumerate(index) if problem.slots[k][1] in (0, first) and not undetermined[k]]
        chosen = problem.free[index[kept]]
        place, spread = np.ix_(chosen, chosen), np.sqrt(np.diag(white))
        covariance[place] = inner[np.ix_(kept, kept)]
        correlation[place] = (white / np.outer(spread, spread))[np.ix_(kept, kept)]
        plain = problem.variance(point) * np.diag(white)
        colour[chosen] = (np.diag(inner) / np.maximum(plain, 1e-300))[kept]
    states = list(enumerate(point.starts))
    residuals = [problem.runs[i].missed(problem.plant_at(point.values, i), s, problem.substeps[i]) for i, s in states]
    return Refinement(
        plant=problem.plant_at(point.values, 0),
        covariance=covariance,
        correlation=correlation,
        colour=colour,
        local=problem.local_values(point),
        at_bound=problem.at_bound(point),
        undetermined=problem.names_of(undetermined),
        unfelt=problem.names_of(within & ~(np.diag(information) > 0.0)),
        rms_error=float(np.sqrt(sum(float(r @ r) for r in residuals) / problem.samples)),
        residuals=tuple(residuals),
        misfit=point.cost,
        starts=tuple(point.starts),
        weights=Weights(noise=problem.noise, outlier=problem.outlier),
        variance=problem.variance(point),
        converged=converged,
        is_smooth=is_smooth,
        status="the refinement reached its optimum" if converged else "the refinement stopped before its optimum",
        usual=() if rounding is None else rounding.means,
    )


def _covariances(
    problem: Problem,
    blocks: list[Block],
    information: NDArray[np.float64],
    index: NDArray[np.intp],
    rounding: _Rounding | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the covariance of the parameters of this `index`, and what it would be of white residuals.

    In the directions that the data determine; what is not of them has no error of its own, and costs the others none.
    """
    basis = determined(information[np.ix_(index, index)])
    inner = basis.T @ information[np.ix_(index, index)] @ basis
    inverse = np.asarray(np.linalg.inv(inner), dtype=np.float64)
    known = np.zeros(problem.free.size)
    for k, prior in problem.priors:
        known[k] = (problem.noise / prior.deviation * problem.noise) ** 2
    held = (basis.T * known[index]) @ basis
    if rounding is None:
        scores = [_scores(block, block.jacobian[:, index] @ basis, inverse) for block in blocks]
        robust = robust_covariance(scores, inner, held)
    else:
        of_runs = zip(rounding.drawn, blocks, strict=True)
        drawn = sum(draws.T @ block.jacobian[: draws.shape[0], index] for draws, block in of_runs)
        moved, last = inverse @ (drawn @ basis).T, basis.T @ rounding.moved[index]
        robust = moved @ moved.T / moved.shape[1] + inverse @ held @ inverse + np.outer(last, last)
    return basis @ robust @ basis.T, basis @ inverse @ basis.T


def _scores(block: Block, rows: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `rows` times the residual, as large as the noise was of which parameters and initial state took a share.

    A residual has the variance 1 − h of the noise, h its leverage (HC2 of MacKinnon and White 1985,
    doi:10.1016/0304-4076(85)90158-7).
    """
    leverage = block.leverage + np.sum((rows @ inverse) * rows, axis=1)
    return np.asarray(rows * (block.residual / np.sqrt(np.maximum(1.0 - leverage, MOST_FOLLOWED)))[:, None])
