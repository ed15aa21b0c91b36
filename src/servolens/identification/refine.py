"""Output-error refinement: simulated minus measured position, minimised over the parameters.

Two kinds of run. Driven by the voltage the axis really got, the residual is the position's noise itself, for that
voltage contains what the controller made of the noise; each stretch then has an initial state of its own, eliminated
stretch by stretch. In closed loop from the reference the controller holds the simulation near the measurement, which
bears what the model lacks (sticking above all) without drifting away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.options import FitOptions
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
    "Refinement",
    "closed_loop_rms",
    "error_of",
    "minimise_error",
    "refine",
    "refine_closed_loop",
]

FINE, COARSE = 1e-4, 5e-2
"""Share of a parameter by which it is moved for a sensitivity; the coarse one sees past what contacts and sticking
crumple."""
MOST_ITERATIONS = 60
NEGLIGIBLE = 1e-8
"""Share of the squared residual whose gain ends the search: some thousandths of a standard error."""
AT_NOISE, DOWN_TO_NOISE = 3.0, 1.05
"""Times the noise up to which a residual counts as explained; as fully so, with nothing left to search for."""
CRUMPLED = 1.5
"""Ratio of standard errors by wide and by narrow differences that betrays an error crumpled on a small scale."""
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
    rms_error : float
        Root mean square of the residual [m or rad].
    residuals : tuple of ndarray
        Simulated minus measured position of each run.
    converged : bool
        Whether no step lowered the residual any more.
    status : str
        One sentence.
    """

    plant: Plant
    covariance: NDArray[np.float64]
    correlation: NDArray[np.float64]
    colour: NDArray[np.float64]
    local: Mapping[str, NDArray[np.float64]]
    at_bound: tuple[str, ...]
    rms_error: float
    residuals: tuple[NDArray[np.float64], ...]
    converged: bool
    status: str


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
    runs: list[Run] = [ClosedRun(step, 0, len(step), 0) for step in steps]
    return minimise_error(plant, runs, FitOptions(held=tuple(held), priors=priors or {}), noise=noise)


def closed_loop_rms(plant: Plant, records: Sequence[Record]) -> float:
    """Return the root mean square closed-loop error of `plant` on the steps [m or rad]; infinite if it is unstable."""
    steps = [step for record in records for step in settled_steps(record)]
    try:
        squares = [float(np.sum((simulate(plant, step).position - step.position) ** 2)) for step in steps]
    except NumericalError:
        return float(np.inf)
    return float(np.sqrt(sum(squares) / sum(len(step) for step in steps)))


def error_of(plant: Plant, runs: Sequence[Run]) -> float:
    """Return the root mean square error of `plant` on `runs` [m or rad]; infinite if it cannot be simulated."""
    try:
        residuals = [
            run.simulated(plant, run.start, substeps_for(plant, run.sample_time)) - run.measured for run in runs
        ]
    except (InputError, NumericalError):
        return float(np.inf)
    return float(np.sqrt(sum(float(r @ r) for r in residuals) / sum(r.size for r in residuals)))


def minimise_error(
    plant: Plant,
    runs: Sequence[Run],
    options: FitOptions,
    *,
    noise: float,
    iterations: int = MOST_ITERATIONS,
    coarse: bool = False,
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
        At most.
    coarse : bool
        Begin with sensitivities over a twentieth of each parameter: for errors that are crumpled on a small scale.

    Raises
    ------
    NumericalError
        If `plant` cannot be simulated on the runs.
    """
    problem = _Problem(plant, runs, options, noise)
    point = problem.start()
    if coarse:
        problem.share = COARSE
        point, _ = _descend(problem, point, iterations)
        problem.share = FINE
    point, converged = _descend(problem, point, iterations)
    for _ in range(2 if options.loss == "huber" else 0):
        problem.outlier = HUBER * problem.spread(point)
        point.cost = problem.cost(point)
        point, converged = _descend(problem, point, iterations)
    return problem.finish(point, converged=converged)


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """One run, its initial state eliminated: what the state did (R, Qᵀ J, Qᵀ r), and what is left (J, r)."""

    factor: NDArray[np.float64]
    along: NDArray[np.float64]
    missed: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    residual: NDArray[np.float64]


@final
@dataclass(slots=True, eq=False)
class _Point:
    """A trial: parameters, initial states, and the cost there."""

    values: NDArray[np.float64]
    starts: list[NDArray[np.float64]]
    cost: float = np.inf


def _descend(problem: _Problem, point: _Point, iterations: int) -> tuple[_Point, bool]:
    """Return where the search ends and whether that is an optimum."""
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
        if gained < NEGLIGIBLE:
            return point, True
    return point, False


@final
class _Problem:
    """Residuals of all runs as functions of the free parameters and the initial states."""

    def __init__(
        self,
        plant: Plant,
        runs: Sequence[Run],
        options: FitOptions,
        noise: float,
    ) -> None:
        held, local, priors = options.held, options.local, options.priors
        names, specs = list(plant.parameters), list(plant.parameters.values())
        self.plant, self.runs, self.names = plant, runs, names
        estimated = [name for name in names if name not in held and name not in plant.derived]
        shared = [(names.index(name), 0) for name in estimated if name not in local]
        groups = sorted({run.group for run in runs})
        own = [(names.index(name), group) for name in estimated if name in local for group in groups]
        self.slots = shared + own
        self.free = np.array([index for index, _ in self.slots], dtype=np.intp)
        self.columns = [
            [k for k, (_, group) in enumerate(self.slots) if k < len(shared) or group == run.group] for run in runs
        ]
        lowest = {"damping": min(0.0, plant.damping)}  # a passive axis; only a start below stays there
        self.low = np.array([lowest.get(names[i], specs[i].low) for i in self.free])
        self.high = np.array([specs[i].high for i in self.free])
        self.priors = [(k, priors[names[i]]) for k, i in enumerate(self.free) if names[i] in priors]
        self.scale = np.maximum(np.abs(np.array(plant.values)[self.free]), 1e-3)
        self.samples = sum(run.measured.size for run in runs)
        self.noise = max(noise, 1e-12)
        self.outlier, self.share = np.inf, FINE
        self.least_shift = np.zeros(self.free.size)
        self.substeps = [substeps_for(plant, run.sample_time) for run in runs]

    def start(self) -> _Point:
        point = _Point(np.array(self.plant.values)[self.free], [run.start.copy() for run in self.runs])
        point.cost = self.cost(point)
        return point

    def plant_at(self, values: NDArray[np.float64], i: int) -> Plant:
        full = np.array(self.plant.values)
        full[self.free[self.columns[i]]] = values[self.columns[i]]
        return self.plant.with_values(full.tolist())

    def residual(self, values: NDArray[np.float64], i: int, start: NDArray[np.float64]) -> NDArray[np.float64]:
        run = self.runs[i]
        return run.simulated(self.plant_at(values, i), start, self.substeps[i]) - run.measured

    def cost(self, point: _Point) -> float:
        try:
            parts = [self.residual(point.values, i, point.starts[i]) for i in range(len(self.runs))]
        except (InputError, NumericalError):
            return float(np.inf)
        return sum(self._loss(r) for r in parts) + self._prior_cost(point.values)

    def spread(self, point: _Point) -> float:
        """Return the robust standard deviation of the residuals, from their median size."""
        parts = [self.residual(point.values, i, point.starts[i]) for i in range(len(self.runs))]
        return float(1.4826 * np.median(np.abs(np.concatenate(parts))))

    def linearise(self, point: _Point) -> tuple[list[_Block], NDArray[np.float64], NDArray[np.float64]]:
        """Return each run's block, and gradient and information of the parameters."""
        for i, run in enumerate(self.runs):
            self.substeps[i] = substeps_for(self.plant_at(point.values, i), run.sample_time)
        point.cost = self.cost(point)
        k = self.free.size
        blocks = []
        gradient, information = np.zeros(k), np.zeros((k, k))
        for i in range(len(self.runs)):
            residual = self.residual(point.values, i, point.starts[i])
            jacobian, initial = self._sensitivities(point, i)
            weight = self._weight(residual)[:, None]
            q, r = np.linalg.qr(weight * initial)
            jacobian, residual = weight * jacobian, weight[:, 0] * residual
            along, missed = q.T @ jacobian, q.T @ residual
            jacobian, residual = jacobian - q @ along, residual - q @ missed
            blocks.append(_Block(r, along, missed, jacobian, residual))
            gradient += jacobian.T @ residual
            information += jacobian.T @ jacobian
        for index, prior in self.priors:
            weight_of_prior = (self.noise / prior.deviation) ** 2
            gradient[index] += weight_of_prior * (point.values[index] - prior.value)
            information[index, index] += weight_of_prior
        return blocks, gradient, information

    def _loss(self, residual: NDArray[np.float64]) -> float:
        if not np.isfinite(self.outlier):
            return float(residual @ residual)
        size = np.abs(residual)
        return float(np.sum(np.where(size <= self.outlier, size**2, self.outlier * (2.0 * size - self.outlier))))

    def _weight(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the square root of the weights with which least squares follow the loss."""
        return np.sqrt(np.minimum(1.0, self.outlier / np.maximum(np.abs(residual), 1e-300)))

    def _sensitivities(self, point: _Point, i: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Central differences by the parameters and by the initial state; one-sided at a bound."""
        n, start, shifts = self.runs[i].measured.size, point.starts[i], self.runs[i].shifts
        jacobian, initial = np.zeros((n, self.free.size)), np.empty((n, len(shifts)))
        for k in self.columns[i]:
            h = max(self.share * max(abs(point.values[k]), 1e-3 * self.scale[k]), self.least_shift[k])
            up, down = point.values.copy(), point.values.copy()
            up[k], down[k] = min(up[k] + h, self.high[k]), max(down[k] - h, self.low[k])
            change = self.residual(up, i, start) - self.residual(down, i, start)
            jacobian[:, k] = change / (up[k] - down[k])
        for k, h in enumerate(shifts):
            shift = np.zeros(start.size)
            shift[k] = h
            above, below = self.residual(point.values, i, start + shift), self.residual(point.values, i, start - shift)
            initial[:, k] = (above - below) / (2 * h)
        return jacobian, initial

    def step(
        self,
        point: _Point,
        blocks: list[_Block],
        gradient: NDArray[np.float64],
        information: NDArray[np.float64],
        damping: float,
    ) -> _Point:
        """Return the trial that the damped normal equations propose, at most half of each parameter away."""
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        held = ((point.values <= self.low) & (gradient > 0)) | ((point.values >= self.high) & (gradient < 0))
        free = ~held
        normal = (information / np.outer(scale, scale) + damping * np.eye(scale.size))[np.ix_(free, free)]
        change = np.zeros(scale.size)
        change[free] = -np.linalg.lstsq(normal, (gradient / scale)[free], rcond=None)[0] / scale[free]
        reach = 0.5 * np.maximum(np.abs(point.values), np.where(self.free == 0, 0.0, self.scale))  # β keeps its sign
        values = np.clip(point.values + np.clip(change, -reach, reach), self.low, self.high)
        moved = values - point.values
        starts = [
            start - np.linalg.solve(block.factor, block.missed + block.along @ moved) if start.size else start
            for start, block in zip(point.starts, blocks, strict=True)
        ]
        trial = _Point(values, starts)
        trial.cost = self.cost(trial)
        return trial

    def finish(self, point: _Point, *, converged: bool) -> Refinement:
        if not np.isfinite(point.cost):
            raise NumericalError("the plant to start from cannot be simulated on these records: its loop is unstable")
        blocks, _, information = self._linearised_as_wide_as_the_errors(point)
        inside = (point.values > self.low) & (point.values < self.high) & (np.diag(information) > 0)
        covariance = np.full((len(self.names), len(self.names)), np.nan)
        correlation, colour = covariance.copy(), np.full(len(self.names), np.nan)
        shared = [k for k, (_, group) in enumerate(self.slots) if group == self.slots[0][1] or group == 0]
        if inside.any() and _well_conditioned(information[np.ix_(inside, inside)]):
            index = np.flatnonzero(inside)
            inner = self._covariance(point, blocks, information, index)
            white = np.linalg.inv(information[np.ix_(index, index)])
            spread = np.sqrt(np.diag(white))
            kept = [i for i, k in enumerate(index) if k in shared]
            place = np.ix_(self.free[index[kept]], self.free[index[kept]])
            covariance[place] = inner[np.ix_(kept, kept)]
            correlation[place] = (white / np.outer(spread, spread))[np.ix_(kept, kept)]
            plain = point.cost / max(self.samples - point.values.size, 1) * np.diag(white)
            colour[self.free[index[kept]]] = (np.diag(inner) / np.maximum(plain, 1e-300))[kept]
        residuals = [self.residual(point.values, i, point.starts[i]) for i in range(len(self.runs))]
        return Refinement(
            plant=self.plant_at(point.values, 0),
            covariance=covariance,
            correlation=correlation,
            colour=colour,
            local=self._local(point),
            at_bound=self._at_bound(point),
            rms_error=float(np.sqrt(sum(float(r @ r) for r in residuals) / self.samples)),
            residuals=tuple(residuals),
            converged=converged,
            status="the refinement reached its optimum" if converged else "the refinement stopped before its optimum",
        )

    def _linearised_as_wide_as_the_errors(
        self, point: _Point
    ) -> tuple[list[_Block], NDArray[np.float64], NDArray[np.float64]]:
        """Linearise over a standard error of each parameter: over less, crumples would count as information.

        Where the two disagree, the width is approached from above, for an error crumpled on a small scale has many
        small widths that confirm themselves.
        """
        found = self.linearise(point)
        fine = self._widths(point, found[2])
        if fine is None:
            return found
        found = self._over(point, np.minimum(fine, 0.1 * np.abs(point.values)))
        wide = self._widths(point, found[2])
        if wide is None or (wide < CRUMPLED * fine).all():
            return found
        widths = COARSE * np.maximum(np.abs(point.values), 1e-3 * self.scale)
        for _ in range(4):
            found = self._over(point, widths)
            errors = self._widths(point, found[2])
            if errors is None or (errors > 0.5 * widths).all():
                break
            widths = np.minimum(widths, errors)
        return found

    def _over(
        self, point: _Point, widths: NDArray[np.float64]
    ) -> tuple[list[_Block], NDArray[np.float64], NDArray[np.float64]]:
        self.least_shift = widths
        found = self.linearise(point)
        self.least_shift = np.zeros(self.free.size)
        return found

    def _widths(self, point: _Point, information: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the standard errors if the noise were white; None where the data do not determine all parameters."""
        if not ((np.diag(information) > 0).all() and _well_conditioned(information)):
            return None
        unknowns = point.values.size + sum(start.size for start in point.starts)
        variance = point.cost / max(self.samples - unknowns, 1) * np.diag(np.linalg.inv(information))
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def _covariance(
        self, point: _Point, blocks: list[_Block], information: NDArray[np.float64], index: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        scores = [(b.jacobian * b.residual[:, None])[:, index] for b in blocks]
        unknowns = point.values.size + sum(start.size for start in point.starts)
        degrees = self.samples / max(self.samples - unknowns, 1)
        known = np.zeros(point.values.size)
        for k, prior in self.priors:
            known[k] = (self.noise / prior.deviation * self.noise) ** 2
        return degrees * robust_covariance(scores, information[np.ix_(index, index)], np.diag(known[index]))

    def _local(self, point: _Point) -> dict[str, NDArray[np.float64]]:
        own: dict[str, list[float]] = {}
        for (index, _), value in zip(self.slots, point.values, strict=True):
            own.setdefault(self.names[index], []).append(float(value))
        return {name: np.array(values) for name, values in own.items() if len(values) > 1}

    def _at_bound(self, point: _Point) -> tuple[str, ...]:
        ends = (point.values <= self.low) | (point.values >= self.high)
        return tuple(dict.fromkeys(self.names[self.free[k]] for k in np.flatnonzero(ends)))

    def _prior_cost(self, values: NDArray[np.float64]) -> float:
        return float(sum((self.noise / p.deviation * (values[k] - p.value)) ** 2 for k, p in self.priors))


def _well_conditioned(information: NDArray[np.float64]) -> bool:
    """Tell whether the data determine all parameters: no column depends on the others."""
    scale = np.sqrt(np.diag(information))
    return bool(np.linalg.cond(information / np.outer(scale, scale)) < 1e14)
