"""Output-error refinement: the simulated axis, driven by the voltage it really got, against the measured position.

The measured voltage contains what the controller made of the noise, so the axis is simulated open loop over each
stretch of motion and the residual is the position's noise itself. Each stretch has an initial position and velocity of
its own; they are eliminated stretch by stretch, so the work grows linearly with the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import NumericalError
from servolens.identify.smoothing import smooth
from servolens.identify.uncertainty import robust_covariance
from servolens.simulate.loop import simulate_voltage, substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identify.integral import Prior
    from servolens.identify.segments import Segment
    from servolens.plant import Plant

__all__ = ["Refinement", "refine"]

STEP = 1e-4
MOST_ITERATIONS = 40


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
        Whether the last step was negligible against the standard errors.
    status : str
        One sentence.
    """

    plant: Plant
    covariance: NDArray[np.float64]
    rms_error: float
    converged: bool
    status: str


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """One stretch, its initial state eliminated: what the state did (R, Qᵀ J, Qᵀ r), and what is left (J, r)."""

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
    starts: NDArray[np.float64]
    cost: float = np.inf


def refine(
    plant: Plant,
    segments: Sequence[Segment],
    *,
    held: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    window: int = 21,
) -> Refinement:
    """Minimise simulated minus measured position by Levenberg–Marquardt, within the parameters' bounds.

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
    problem = _Problem(plant, segments, [n not in held for n in plant.parameters], dict(priors or {}))
    point = problem.start(window)
    damping = 1e-3
    converged = False
    for _ in range(MOST_ITERATIONS):
        blocks, gradient, information = problem.linearise(point)
        accepted = False
        for _ in range(12):
            trial = problem.step(point, blocks, gradient, information, damping)
            if trial.cost < point.cost:
                accepted = True
                break
            damping *= 5.0
        if not accepted:
            converged = True
            break
        gain = 1.0 - trial.cost / point.cost
        point, damping = trial, max(damping / 10.0, 1e-12)
        if gain < 1e-10:
            converged = True
            break
    return problem.finish(point, converged=converged)


class _Problem:
    """Residuals of all segments as functions of the free parameters and the initial states."""

    def __init__(self, plant: Plant, segments: Sequence[Segment], free: list[bool], priors: dict[str, Prior]) -> None:
        self.plant, self.segments = plant, segments
        self.free = np.flatnonzero(free)
        specs = list(plant.parameters.values())
        self.low = np.array([specs[i].low for i in self.free])
        self.high = np.array([specs[i].high for i in self.free])
        names = list(plant.parameters)
        self.priors = [(k, priors[names[i]]) for k, i in enumerate(self.free) if names[i] in priors]
        self.scale = np.maximum(np.abs(np.array(plant.values)[self.free]), 1e-3)
        self.substeps = substeps_for(plant, max(s.record.sample_time for s in segments))
        self.samples = sum(s.time.size for s in segments)
        self.noise = max(max(s.noise for s in segments), 1e-12)

    def start(self, window: int) -> _Point:
        """Begin at the given plant, each stretch from its smoothed position and velocity."""
        starts = np.empty((len(self.segments), 2))
        for start, segment in zip(starts, self.segments, strict=True):
            value, slope = smooth(segment.time, segment.position, window)
            start[:] = value[0], slope[0]
        point = _Point(values=np.array(self.plant.values)[self.free], starts=starts)
        point.cost = self.cost(point)
        return point

    def simulated(self, values: NDArray[np.float64], i: int, start: NDArray[np.float64]) -> NDArray[np.float64]:
        full = np.array(self.plant.values)
        full[self.free] = values
        segment = self.segments[i]
        plant = self.plant.with_values(full.tolist())
        run = simulate_voltage(
            plant, segment.time, segment.voltage, start=(float(start[0]), float(start[1])), substeps=self.substeps
        )
        return run.position

    def cost(self, point: _Point) -> float:
        try:
            parts = [self.simulated(point.values, i, point.starts[i]) - s.position for i, s in enumerate(self.segments)]
        except NumericalError:
            return float(np.inf)
        return float(sum(r @ r for r in parts)) + self._prior_cost(point.values)

    def linearise(self, point: _Point) -> tuple[list[_Block], NDArray[np.float64], NDArray[np.float64]]:
        """Return each stretch's block, and gradient and information of the parameters."""
        k = self.free.size
        blocks = []
        gradient, information = np.zeros(k), np.zeros((k, k))
        for i, segment in enumerate(self.segments):
            residual = self.simulated(point.values, i, point.starts[i]) - segment.position
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
        n = self.segments[i].time.size
        jacobian, initial = np.empty((n, self.free.size)), np.empty((n, 2))
        for k in range(self.free.size):
            h = STEP * max(abs(point.values[k]), 1e-3 * self.scale[k])
            up, down = point.values.copy(), point.values.copy()
            up[k], down[k] = min(up[k] + h, self.high[k]), max(down[k] - h, self.low[k])
            change = self.simulated(up, i, point.starts[i]) - self.simulated(down, i, point.starts[i])
            jacobian[:, k] = change / (up[k] - down[k])
        travel = max(float(np.ptp(self.segments[i].position)), 1e-9)
        for k, h in enumerate((1e-4 * travel, 1e-4 * travel / max(float(self.segments[i].time[-1]), 1e-3))):
            shift = np.zeros(2)
            shift[k] = h
            above = self.simulated(point.values, i, point.starts[i] + shift)
            initial[:, k] = (above - self.simulated(point.values, i, point.starts[i] - shift)) / (2 * h)
        return jacobian, initial

    def step(
        self,
        point: _Point,
        blocks: list[_Block],
        gradient: NDArray[np.float64],
        information: NDArray[np.float64],
        damping: float,
    ) -> _Point:
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        normal = information / np.outer(scale, scale) + damping * np.eye(scale.size)
        change = -np.linalg.lstsq(normal, gradient / scale, rcond=None)[0] / scale
        reach = 0.5 * np.maximum(np.abs(point.values), self.scale)
        change = np.clip(change, -reach, reach)
        values = np.clip(point.values + change, self.low, self.high)
        moved = values - point.values
        starts = point.starts.copy()
        for start, block in zip(starts, blocks, strict=True):
            start -= np.linalg.solve(block.factor, block.missed + block.along @ moved)
        trial = _Point(values=values, starts=starts)
        trial.cost = self.cost(trial)
        return trial

    def finish(self, point: _Point, *, converged: bool) -> Refinement:
        blocks, _, information = self.linearise(point)
        full = np.array(self.plant.values)
        full[self.free] = point.values
        covariance = np.full((full.size, full.size), np.nan)
        inside = (point.values > self.low) & (point.values < self.high) & self._determined(information)
        if inside.any():
            kept = np.ix_(inside, inside)
            scores = [(b.jacobian * b.residual[:, None])[:, inside] for b in blocks]
            degrees = self.samples / max(self.samples - point.values.size - 2 * len(self.segments), 1)
            index = self.free[inside]
            covariance[np.ix_(index, index)] = degrees * robust_covariance(scores, information[kept])
        rms = float(np.sqrt(max(point.cost - self._prior_cost(point.values), 0.0) / self.samples))
        status = "the refinement reached its optimum" if converged else "the refinement stopped before its optimum"
        return Refinement(
            plant=self.plant.with_values(full.tolist()),
            covariance=covariance,
            rms_error=rms,
            converged=converged,
            status=status,
        )

    def _determined(self, information: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which parameters the data determine: no column vanishes, none depends on the others."""
        scale = np.sqrt(np.diag(information))
        alive = scale > 0
        normal = information[np.ix_(alive, alive)] / np.outer(scale[alive], scale[alive])
        if alive.all() and np.linalg.cond(normal) < 1e14:
            return alive
        return alive & False

    def _prior_cost(self, values: NDArray[np.float64]) -> float:
        return float(sum((self.noise / p.deviation * (values[k] - p.value)) ** 2 for k, p in self.priors))
