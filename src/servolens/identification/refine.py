"""Output-error refinement: simulated minus measured position, minimised over the parameters.

Two kinds of run. Driven by the voltage the axis really got, the residual is the position's noise itself, for that
voltage contains what the controller made of the noise; each stretch then has an initial state of its own, eliminated
stretch by stretch. In closed loop from the reference the controller holds the simulation near the measurement, which
bears what the model lacks (sticking above all) without drifting away.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.descent import NEGLIGIBLE_ON_THE_WAY, along_the_valley, by_way_of, descend, folds_beside
from servolens.identification.error_problem import (
    COARSE,
    FINE,
    Block,
    Point,
    Problem,
    open_directions,
    well_conditioned,
)
from servolens.identification.options import FitOptions
from servolens.identification.phases import synchronised
from servolens.identification.runs import ClosedRun, VoltageRun
from servolens.identification.segments import settled_steps
from servolens.identification.uncertainty import robust_covariance
from servolens.simulation.loop import simulate
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.integral import Prior
    from servolens.identification.runs import Run
    from servolens.identification.segments import Segment
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = [
    "AT_NOISE",
    "DOWN_TO_NOISE",
    "Lead",
    "Refinement",
    "closed_loop_rms",
    "error_of",
    "lead",
    "minimise_error",
    "refine",
    "refine_closed_loop",
    "square_error",
]

MOST_ITERATIONS = 60
NEARLY = 0.9
"""Share of the substeps that are granted from which on a search was stopped by them, and by no optimum."""
AT_NOISE, DOWN_TO_NOISE = 3.0, 1.05
"""Times the noise up to which a residual counts as explained; as fully so, with nothing left to search for."""
HUBER = 2.5
"""Standard deviations from which on a residual counts linearly."""


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
    rms_error : float
        Root mean square of the residual [m or rad].
    residuals : tuple of ndarray
        Simulated minus measured position of each run.
    converged : bool
        Whether no step lowered the residual any more.
    crumpled : bool
        Whether contacts crumple the error: then it has many valleys; error bars are those of wide differences; driven
        by the voltage, they allow for the valleys nearby that explain as much.
    status : str
        One sentence.
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
    converged: bool
    crumpled: bool
    status: str


class Lead(NamedTuple):
    """Where a search leads: the plant, its root mean square error, and simulated minus measured of each run."""

    plant: Plant
    error: float
    residuals: tuple[NDArray[np.float64], ...]


def refine(
    plant: Plant,
    segments: Sequence[Segment],
    *,
    held: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    window: int = 21,
) -> Refinement:
    """Refine `plant` on stretches of motion, each driven by its voltage from an initial state of its own.

    Parameters
    ----------
    plant : Plant
        Start and structure.
    segments : sequence of Segment
        Stretches of motion.
    held : sequence of str
        Qualified names of parameters that stay as they are.
    priors : mapping of str to Prior, optional
        Knowledge from elsewhere, by qualified name.
    window : int
        Samples of the smoothing derivative that gives the initial velocities.
    """
    runs: list[Run] = [VoltageRun(segment, 0, window) for segment in segments]
    options = FitOptions(held=tuple(held), priors=priors or {})
    return minimise_error(plant, runs, options, noise=max(s.noise for s in segments))


def refine_closed_loop(
    plant: Plant,
    records: Sequence[Record],
    *,
    noise: float,
    held: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
) -> Refinement:
    """Refine `plant` on whole steps in closed loop, each from rest at its first measured position.

    Parameters
    ----------
    plant, held, priors
        As :func:`refine`.
    records : sequence of Record
        With reference and controller.
    noise : float
        Standard deviation of the position's noise, against which the priors are weighed.
    """
    steps = [step for record in records for step in settled_steps(record)]
    runs: list[Run] = [ClosedRun(step, 0) for step in steps]
    return minimise_error(plant, runs, FitOptions(held=tuple(held), priors=priors or {}), noise=noise)


def closed_loop_rms(plant: Plant, records: Sequence[Record]) -> float:
    """Return the root mean square closed-loop error of `plant` on the steps [m or rad]; infinite if it is unstable."""
    steps = [step for record in records for step in settled_steps(record)]
    try:
        squares = [float(np.sum((simulate(plant, step).position - step.position) ** 2)) for step in steps]
    except NumericalError:
        return float(np.inf)
    return float(np.sqrt(sum(squares) / sum(len(step) for step in steps)))


def error_of(plant: Plant, runs: Sequence[Run], *, fine: bool = True) -> float:
    """Return the root mean square error of `plant` on `runs` [m or rad]; infinite if it cannot be simulated.

    Phases that are each record's own are chosen for each run; not `fine`, nearly the best.
    """
    squares = 0.0
    for run in runs:
        missed = partial(square_error, run, substeps_for(plant, run.sample_time))
        squares += missed(synchronised(plant, missed, fine=fine))
    return float(np.sqrt(squares / sum(run.samples for run in runs)))


def square_error(run: Run, substeps: int, plant: Plant) -> float:
    """Return the sum of the squared differences between `plant` and what was measured; infinite where it fails."""
    try:
        residual = run.residual(plant, run.start, substeps)
    except (InputError, NumericalError):
        return float(np.inf)
    return float(residual @ residual)


def minimise_error(
    plant: Plant,
    runs: Sequence[Run],
    options: FitOptions,
    *,
    noise: float,
    iterations: int = MOST_ITERATIONS,
    coarse: bool = False,
    valleys: bool = False,
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
    noise : float
        Standard deviation of the position's noise, against which the priors are weighed.
    iterations : int
        Of each descent at most.
    coarse : bool
        Where that does not reach the noise, or there are contacts, begin once more with sensitivities over a twentieth
        of each parameter: for errors that are crumpled on a small scale.
    valleys : bool
        Where there are contacts, look along the direction that the data know least for deeper folds of the error, and
        for others as deep, for which the error bars have to allow.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs.
    """
    problem = Problem(plant, runs, options, noise)
    point = problem.start()
    if problem.too_stiff(point):  # what begins so is followed as it is; nothing else becomes so
        problem.most_substeps = np.inf
    problem.weigh_priors(point)
    begun = point
    point, converged = descend(problem, begun, iterations)
    if coarse and (plant.has_contacts or point.cost > (DOWN_TO_NOISE * noise) ** 2 * problem.samples):
        other, reached = by_way_of(problem, begun, ((COARSE, iterations), (FINE, iterations)))
        if other.cost < point.cost:
            point, converged = other, reached
    if valleys and plant.has_contacts:
        problem.weigh_priors(point)
        point, converged = along_the_valley(problem, point, iterations, converged=converged)
    if problem.weigh_priors(point):
        point, converged = descend(problem, point, iterations)
    for _ in range(2 if options.loss == "huber" else 0):
        problem.outlier = HUBER * problem.spread(point)
        point.cost = problem.cost(point)
        point, converged = descend(problem, point, iterations)
    folds: list[NDArray[np.float64]] = []
    if valleys and plant.has_contacts:
        point, converged, folds = folds_beside(problem, point, iterations, converged=converged)
    return _finished(problem, point, folds, converged=converged and not problem.too_stiff(point, NEARLY))


def lead(
    plant: Plant,
    runs: Sequence[Run],
    options: FitOptions,
    *,
    noise: float,
    iterations: int,
    coarse: bool,
    most_substeps: float = np.inf,
    valleys: bool = False,
) -> Lead:
    """Return where a few iterations lead; parameters as :func:`minimise_error`.

    Differences are one-sided unless `plant` has contacts. Plants that need more than `most_substeps` in a sample are
    left out.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs, or only so.
    """
    problem = Problem(plant, runs, options, noise)
    problem.share, problem.most_substeps = (COARSE if coarse else FINE), most_substeps
    problem.one_sided = not plant.has_contacts
    start = problem.start()
    if problem.too_stiff(start):
        raise NumericalError("the plant to start from is too stiff to be worth its time")
    problem.weigh_priors(start)
    point, _ = descend(problem, start, iterations, NEGLIGIBLE_ON_THE_WAY)
    if valleys:
        point, _ = along_the_valley(problem, point, iterations, converged=True)
    problem.choose_substeps(point)
    residuals = tuple(problem.residual(point.values, i, point.starts[i]) for i in range(len(problem.runs)))
    return Lead(problem.plant_at(point.values, 0), float(np.sqrt(point.cost / problem.samples)), residuals)


def _finished(problem: Problem, point: Point, folds: Sequence[NDArray[np.float64]], *, converged: bool) -> Refinement:
    """Return the result of a search that ended at `point`; at the values of `folds` as much is explained."""
    (blocks, _, information), crumpled = problem.linearised_widely(point)
    within = (point.values > problem.low) & (point.values < problem.high)
    inside = within & (np.diag(information) > 0)
    covariance = np.full((len(problem.names), len(problem.names)), np.nan)
    correlation, colour = covariance.copy(), np.full(len(problem.names), np.nan)
    shared = [k for k, (_, group) in enumerate(problem.slots) if group == problem.slots[0][1] or group == 0]
    if inside.any() and well_conditioned(information[np.ix_(inside, inside)]):
        index = np.flatnonzero(inside)
        inner = _covariance(problem, point, blocks, information, index)
        white = np.linalg.inv(information[np.ix_(index, index)])
        spread = np.sqrt(np.diag(white))
        kept = [i for i, k in enumerate(index) if k in shared]
        place = np.ix_(problem.free[index[kept]], problem.free[index[kept]])
        scatter = np.zeros_like(inner)
        if crumpled and folds:
            away = (np.array(folds) - point.values)[:, index]
            scatter = away.T @ away / len(folds)
        covariance[place] = (inner + scatter)[np.ix_(kept, kept)]
        correlation[place] = (white / np.outer(spread, spread))[np.ix_(kept, kept)]
        plain = point.cost / max(problem.samples - point.values.size, 1) * np.diag(white)
        colour[problem.free[index[kept]]] = (np.diag(inner) / np.maximum(plain, 1e-300))[kept]
    residuals = [problem.residual(point.values, i, point.starts[i]) for i in range(len(problem.runs))]
    return Refinement(
        plant=problem.plant_at(point.values, 0),
        covariance=covariance,
        correlation=correlation,
        colour=colour,
        local=problem.local_values(point),
        at_bound=problem.at_bound(point),
        undetermined=problem.names_of(within & open_directions(information)),
        rms_error=float(np.sqrt(sum(float(r @ r) for r in residuals) / problem.samples)),
        residuals=tuple(residuals),
        converged=converged,
        crumpled=crumpled,
        status="the refinement reached its optimum" if converged else "the refinement stopped before its optimum",
    )


def _covariance(
    problem: Problem, point: Point, blocks: list[Block], information: NDArray[np.float64], index: NDArray[np.intp]
) -> NDArray[np.float64]:
    scores = [(b.jacobian * b.residual[:, None])[:, index] for b in blocks]
    unknowns = point.values.size + sum(start.size for start in point.starts)
    degrees = problem.samples / max(problem.samples - unknowns, 1)
    known = np.zeros(point.values.size)
    for k, prior in problem.priors:
        known[k] = (problem.noise / prior.deviation * problem.noise) ** 2
    return degrees * robust_covariance(scores, information[np.ix_(index, index)], np.diag(known[index]))
