"""Output-error refinement: simulated minus measured position, minimised over the parameters.

Two kinds of run. Driven by the voltage the axis really got, the residual is the position's noise itself, for that
voltage contains what the controller made of the noise; each stretch of motion then has an initial position and
velocity of its own, eliminated stretch by stretch. In closed loop from the reference the controller holds the
simulation near the measurement, which bears what the model lacks (sticking above all) without drifting away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.segments import settled_steps
from servolens.identification.smoothing import smooth
from servolens.identification.uncertainty import robust_covariance
from servolens.simulation.loop import simulate, simulate_voltage
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.integral import Prior
    from servolens.identification.segments import Segment
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["AT_NOISE", "Refinement", "closed_loop_rms", "refine", "refine_closed_loop"]

STEP = 1e-4
MOST_ITERATIONS = 60
NEGLIGIBLE = 1e-8
"""Share of the squared residual whose gain ends the search: some thousandths of a standard error."""
AT_NOISE = 3.0
"""Times the noise up to which a residual counts as explained."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """Where the refinement ended.

    Attributes
    ----------
    plant : Plant
        The best plant found; the start if nothing better was.
    covariance : ndarray, shape (k, k)
        Of ``plant.values``; NaN for parameters that were held or that the data do not determine.
    rms_error : float
        Root mean square of the residual [m or rad].
    converged : bool
        Whether no step lowered the residual any more.
    status : str
        One sentence.
    """

    plant: Plant
    covariance: NDArray[np.float64]
    rms_error: float
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
    substeps = substeps_for(plant, max(s.record.sample_time for s in segments))
    runs = [_VoltageRun(segment, window, substeps) for segment in segments]
    return _minimise(_Problem(plant, runs, held, dict(priors or {}), max(s.noise for s in segments)))


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
    runs = [_ClosedRun(step) for record in records for step in settled_steps(record)]
    return _minimise(_Problem(plant, runs, held, dict(priors or {}), noise))


def closed_loop_rms(plant: Plant, records: Sequence[Record]) -> float:
    """Return the root mean square closed-loop error of `plant` on the steps [m or rad]; infinite if it is unstable."""
    steps = [step for record in records for step in settled_steps(record)]
    try:
        squares = [float(np.sum((simulate(plant, step).position - step.position) ** 2)) for step in steps]
    except NumericalError:
        return float(np.inf)
    return float(np.sqrt(sum(squares) / sum(len(step) for step in steps)))


class _Run(Protocol):
    """A simulation to be compared with a measurement; `start` is its initial state, of size 0 if that is known."""

    measured: NDArray[np.float64]
    start: NDArray[np.float64]
    shifts: tuple[float, ...]

    def simulated(self, plant: Plant, start: NDArray[np.float64]) -> NDArray[np.float64]: ...


@final
class _VoltageRun:
    def __init__(self, segment: Segment, window: int, substeps: int) -> None:
        self.segment, self.substeps, self.measured = segment, substeps, segment.position
        value, slope = smooth(segment.time, segment.position, window)
        self.start = np.array([value[0], slope[0]])
        travel = 1e-4 * max(float(np.ptp(segment.position)), 1e-9)
        self.shifts: tuple[float, ...] = (travel, travel / max(float(segment.time[-1]), 1e-3))

    def simulated(self, plant: Plant, start: NDArray[np.float64]) -> NDArray[np.float64]:
        begin = (float(start[0]), float(start[1]))
        run = simulate_voltage(plant, self.segment.time, self.segment.voltage, start=begin, substeps=self.substeps)
        return run.position


@final
class _ClosedRun:
    def __init__(self, record: Record) -> None:
        self.record, self.measured = record, record.position
        self.start = np.empty(0)
        self.shifts: tuple[float, ...] = ()

    def simulated(self, plant: Plant, start: NDArray[np.float64]) -> NDArray[np.float64]:
        return simulate(plant, self.record).position


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


def _minimise(problem: _Problem) -> Refinement:
    """Levenberg–Marquardt within the parameters' bounds."""
    point = problem.start()
    damping = 1e-3
    for _ in range(MOST_ITERATIONS):
        blocks, gradient, information = problem.linearise(point)
        for _ in range(12):
            trial = problem.step(point, blocks, gradient, information, damping)
            if trial.cost < point.cost:
                break
            damping *= 5.0
        else:
            return problem.finish(point, converged=True)
        gained = 1.0 - trial.cost / point.cost
        point, damping = trial, max(damping / 10.0, 1e-12)
        if gained < NEGLIGIBLE:
            return problem.finish(point, converged=True)
    return problem.finish(point, converged=False)


@final
class _Problem:
    """Residuals of all runs as functions of the free parameters and the initial states."""

    def __init__(
        self, plant: Plant, runs: Sequence[_Run], held: Sequence[str], priors: dict[str, Prior], noise: float
    ) -> None:
        names, specs = list(plant.parameters), list(plant.parameters.values())
        self.plant, self.runs = plant, runs
        self.free = np.flatnonzero([name not in held for name in names])
        lowest = {"damping": min(0.0, plant.damping)}  # a passive axis; only a start below stays there
        self.low = np.array([lowest.get(names[i], specs[i].low) for i in self.free])
        self.high = np.array([specs[i].high for i in self.free])
        self.priors = [(k, priors[names[i]]) for k, i in enumerate(self.free) if names[i] in priors]
        self.scale = np.maximum(np.abs(np.array(plant.values)[self.free]), 1e-3)
        self.samples = sum(run.measured.size for run in runs)
        self.noise = max(noise, 1e-12)

    def start(self) -> _Point:
        point = _Point(np.array(self.plant.values)[self.free], [run.start.copy() for run in self.runs])
        point.cost = self.cost(point)
        return point

    def residual(self, values: NDArray[np.float64], i: int, start: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.array(self.plant.values)
        full[self.free] = values
        return self.runs[i].simulated(self.plant.with_values(full.tolist()), start) - self.runs[i].measured

    def cost(self, point: _Point) -> float:
        try:
            parts = [self.residual(point.values, i, point.starts[i]) for i in range(len(self.runs))]
        except (InputError, NumericalError):
            return float(np.inf)
        return float(sum(r @ r for r in parts)) + self._prior_cost(point.values)

    def linearise(self, point: _Point) -> tuple[list[_Block], NDArray[np.float64], NDArray[np.float64]]:
        """Return each run's block, and gradient and information of the parameters."""
        k = self.free.size
        blocks = []
        gradient, information = np.zeros(k), np.zeros((k, k))
        for i in range(len(self.runs)):
            residual = self.residual(point.values, i, point.starts[i])
            jacobian, initial = self._sensitivities(point, i)
            q, r = np.linalg.qr(initial)
            along, missed = q.T @ jacobian, q.T @ residual
            jacobian, residual = jacobian - q @ along, residual - q @ missed
            blocks.append(_Block(r, along, missed, jacobian, residual))
            gradient += jacobian.T @ residual
            information += jacobian.T @ jacobian
        for index, prior in self.priors:
            weight = (self.noise / prior.deviation) ** 2
            gradient[index] += weight * (point.values[index] - prior.value)
            information[index, index] += weight
        return blocks, gradient, information

    def _sensitivities(self, point: _Point, i: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Central differences by the parameters and by the initial state."""
        n, start, shifts = self.runs[i].measured.size, point.starts[i], self.runs[i].shifts
        jacobian, initial = np.empty((n, self.free.size)), np.empty((n, len(shifts)))
        for k in range(self.free.size):
            h = STEP * max(abs(point.values[k]), 1e-3 * self.scale[k])
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
        blocks, _, information = self.linearise(point)
        full = np.array(self.plant.values)
        full[self.free] = point.values
        covariance = np.full((full.size, full.size), np.nan)
        inside = (point.values > self.low) & (point.values < self.high) & (np.diag(information) > 0)
        if inside.any() and _well_conditioned(information[np.ix_(inside, inside)]):
            scores = [(b.jacobian * b.residual[:, None])[:, inside] for b in blocks]
            unknowns = point.values.size + sum(start.size for start in point.starts)
            degrees = self.samples / max(self.samples - unknowns, 1)
            index = self.free[inside]
            known = np.zeros(inside.size)
            for k, prior in self.priors:
                known[k] = (self.noise / prior.deviation * self.noise) ** 2
            inner = robust_covariance(scores, information[np.ix_(inside, inside)], np.diag(known[inside]))
            covariance[np.ix_(index, index)] = degrees * inner
        rms = float(np.sqrt(max(point.cost - self._prior_cost(point.values), 0.0) / self.samples))
        return Refinement(
            plant=self.plant.with_values(full.tolist()),
            covariance=covariance,
            rms_error=rms,
            converged=converged,
            status="the refinement reached its optimum" if converged else "the refinement stopped before its optimum",
        )

    def _prior_cost(self, values: NDArray[np.float64]) -> float:
        return float(sum((self.noise / p.deviation * (values[k] - p.value)) ** 2 for k, p in self.priors))


def _well_conditioned(information: NDArray[np.float64]) -> bool:
    """Tell whether the data determine all parameters: no column depends on the others."""
    scale = np.sqrt(np.diag(information))
    return bool(np.linalg.cond(information / np.outer(scale, scale)) < 1e14)
