"""Records simulated from their references, beside the noise of the loop: what feedback does to the noise does no harm.

Driven by its voltage, a simulation is fitted with noise in its regressors, for the controller answers to noise and
shaking: beside a wrong noise model it is biased (Ljung 1999, section 13.5). From the reference it is not; what the loop
makes of noise and shaking together is a stationary process, autoregressive here.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.instruments import forces_along
from servolens.identification.minimiser import NEGLIGIBLE_ON_THE_WAY, descend
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.observed import MOVED_IN_GAP
from servolens.identification.refine import Refinement, minimise_error
from servolens.identification.runs import ClosedLoop, OneByOne, as_simulated
from servolens.identification.signals import InitialState
from servolens.identification.smoothing import speed_of
from servolens.identification.structure import is_chance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import FitOptions
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["LoopFit", "fit_loop"]

ROUNDS, ITERATIONS = 3, 15
"""Times that plant and noise are fitted in turn; iterations of each descent."""
FOLLOWED = 0.5
"""Unknowns over samples that are independent of each other, at most: slower noise is not told from structure."""
SHIFT = 1e-5
"""Share of the travel by which an initial state is moved for its sensitivity."""


class LoopFit(NamedTuple):
    """The optimum, the noise beside it, and whether nothing else is left."""

    refined: Refinement
    noise: NoiseModel
    is_enough: bool


@final
class LoopRun(OneByOne):
    """A record in closed loop; what is missed is whitened, and the initial state is held to its prior."""

    def __init__(self, record: Record, group: int, noise: NoiseModel) -> None:
        self.group, self.measured = group, record.position
        self.samples = record.position.size
        speed = speed_of(record.time, record.position)
        self.whiten = Whitener(record.position, speed, noise)
        self._initial = InitialState.of(record, noise.floor)
        self._loop = ClosedLoop(record)
        self.sample_time = self._loop.sample_time
        travel = SHIFT * max(float(np.ptp(record.position)), 1e-12)
        self.start = self._initial.mean
        self.shifts: tuple[float, ...] = (travel, travel / max(record.duration, 1e-3), MOVED_IN_GAP)

    def missed(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return simulated minus measured position, shape (n,) [m or rad]."""
        run = self._loop.simulated(plant, as_simulated(start), substeps)
        return np.asarray(self._loop.logged(run.measured) - self.measured)

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return the same whitened, and how far the initial state is from its prior, in standard deviations."""
        return np.concatenate([self.whiten(self.missed(plant, start, substeps)), self._initial.away(start)])

    def answers(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return what forces of general kinds along the simulation would do to the whitened position, shape (n, k).

        By the loop of gain and damping alone, at the median interval between samples.
        """
        from scipy.signal import bilinear, lfilter

        run, controller = self._loop.simulated(plant, as_simulated(start), substeps), self._loop.controller
        y, v, u = (self._loop.logged(signal) for signal in (run.position, run.velocity, run.voltage))
        forces = forces_along([(y, v, u)])[0]
        kp, kd = controller.kp, controller.kd
        loop = [1.0, plant.damping + plant.gain * kd, plant.gain * kp]
        weights = bilinear([1.0], loop, 1.0 / float(np.median(np.diff(self._loop.time))))
        return self.whiten(np.ascontiguousarray(lfilter(*weights, forces, axis=1).T))


def fit_loop(
    plant: Plant, records: Sequence[Record], options: FitOptions, white: NoiseModel, most_substeps: float
) -> LoopFit | None:
    """Fit `plant` to whole records in closed loop, and the noise of the loop with it; None where that fails.

    Parameters
    ----------
    plant : Plant
        Start and structure.
    records : sequence of Record
        Without a reference or a controller there is no fit.
    options : FitOptions
        What is held, and priors.
    white : NoiseModel
        The sensor's noise, to begin with.
    most_substeps : float
        A sample; a plant that needs more is so fast that it cannot be told from what is rigid, and has no fit.
    """
    if not all(record.has_loop for record in records):
        return None
    noise = white
    try:
        for _ in range(ROUNDS):
            runs = [LoopRun(record, i, noise) for i, record in enumerate(records)]
            problem = Problem(plant, runs, options, 1.0)
            problem.one_sided, problem.most_substeps = True, most_substeps
            point = problem.start()
            if problem.too_stiff(point):
                return None
            point, _ = descend(problem, point, ITERATIONS, NEGLIGIBLE_ON_THE_WAY)
            plant = problem.plant_at(point.values, 0)
            missed = [
                run.missed(plant, start, substeps)
                for run, start, substeps in zip(runs, point.starts, problem.substeps, strict=True)
            ]
            noise = white.estimated(missed, [run.whiten for run in runs], for_errors=True)
        runs = [LoopRun(record, i, noise) for i, record in enumerate(records)]
        refined = minimise_error(plant, runs, options, noise=1.0)
        unknowns = problem.free.size + sum(start.size for start in point.starts)
        refined = replace(refined, covariance=refined.covariance * noise.inflation(problem.samples, unknowns))
        is_known = unknowns * noise.memory() <= FOLLOWED * problem.samples
        return LoopFit(refined, noise, is_known and _is_enough(refined.plant, runs, options))
    except (InputError, NumericalError):
        return None


def _is_enough(plant: Plant, runs: Sequence[LoopRun], options: FitOptions) -> bool:
    """Tell whether forces along the simulation explain no more of the whitened residual than chance."""
    problem = Problem(plant, runs, options, 1.0)
    point, _ = descend(problem, problem.start(), ITERATIONS)
    own: list[NDArray[np.float64]] = []
    other: list[NDArray[np.float64]] = []
    left: list[NDArray[np.float64]] = []
    for i, (residual, jacobian, initial) in enumerate(problem.differences(point)):
        run, start = runs[i], point.starts[i]
        basis, _ = np.linalg.qr(initial)
        answers = run.answers(plant, start, problem.substeps[i])
        columns = np.vstack([answers, np.zeros((residual.size - run.samples, answers.shape[1]))])
        for rows, found in ((own, jacobian), (other, columns), (left, residual[:, None])):
            rows.append(found - basis @ (basis.T @ found))
    return is_chance(np.vstack(other), np.vstack(own), np.vstack(left)[:, 0])
