"""The least-squares problem of a refinement: residuals of all runs as functions of parameters and initial states."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.conditioning import is_touched
from servolens.identification.linear_model import Block, Linearised, Slopes
from servolens.identification.phases import own_phases, round_the_circle
from servolens.identification.runs import AT_MOST, IN_GAP, at_place, begun, moved_start, one_by_one, within_reach
from servolens.identification.uncertainty import apparent_noise
from servolens.processors import in_parallel
from servolens.simulation.rates import MOST_SUBSTEPS, substeps_for, work_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import FitOptions
    from servolens.identification.runs import Run
    from servolens.plant import Plant

__all__ = ["COARSE", "FINE", "Known", "Point", "Problem"]

FINE, COARSE = 1e-4, 5e-2
"""Share of a parameter by which it is moved for a sensitivity; the coarse one sees past what contacts and sticking do
on a small scale."""
UNSTABLE = "the plant to start from cannot be simulated on these records: its loop is unstable"
MOST_PLANTS = 256
"""Plants that are remembered."""
WORTH_THREADS = 200_000
"""Work of all simulations of one linearisation, in samples with one substep, from which on the runs are shared among
threads."""


@final
@dataclass(slots=True, eq=False)
class Point:
    """A trial: parameters, initial states, and the cost there, with each run's substeps and residual of that cost.

    And the fall of the cost that was promised of it.
    """

    values: NDArray[np.float64]
    starts: list[NDArray[np.float64]]
    cost: float = np.inf
    substeps: tuple[int, ...] = ()
    residuals: Sequence[NDArray[np.float64] | None] = ()
    promised: float = 0.0


class Known(NamedTuple):
    """Of each run an initial state, and parameters of each record's own, that another fit ended with."""

    starts: Sequence[NDArray[np.float64]] = ()
    local: Mapping[str, NDArray[np.float64]] | None = None


class _Trial(NamedTuple):
    """Parameters and the initial state of one simulation."""

    values: NDArray[np.float64]
    start: NDArray[np.float64]

    def at(self, k: int) -> float:
        """Return unknown `k`: a parameter, or after those an element of the initial state."""
        return float(self.values[k] if k < self.values.size else self.start[k - self.values.size])


@final
class Problem:
    """Residuals of all runs as functions of the free parameters and the initial states.

    Parameters
    ----------
    plant : Plant
        Start and structure.
    runs : sequence of Run
        What is simulated and compared.
    options : FitOptions
        What is held, what each record has of its own, and priors.
    noise : float or None
        Least standard deviation of the residual, against which priors are weighed; None where a noise model that was
        fitted whitens the residual: then priors are weighed as they stand.
    """

    def __init__(self, plant: Plant, runs: Sequence[Run], options: FitOptions, noise: float | None) -> None:
        held, local, priors = options.held, options.local, options.priors
        names, specs = list(plant.parameters), list(plant.parameters.values())
        self.plant, self.runs, self.names = plant, runs, names
        estimated = [name for name in names if name not in (*held, *plant.derived, *plant.usual)]
        shared = [(names.index(name), 0) for name in estimated if name not in local]
        groups = sorted({run.group for run in runs})
        own = [(names.index(name), group) for name in estimated if name in local for group in groups]
        self.slots, self.local = shared + own, local
        self.free = np.array([index for index, _ in self.slots], dtype=np.intp)
        self.columns = [
            [k for k, (_, group) in enumerate(self.slots) if k < len(shared) or group == run.group] for run in runs
        ]
        lowest = {n: min(0.0, plant.named[n]) for n in ("damping", "free_damping") if n in names}  # passive
        bounds = [options.bounds.get(names[i], (-np.inf, np.inf)) for i in self.free]
        admitted = [(lowest.get(names[i], specs[i].low), specs[i].high) for i in self.free]
        self.low = np.array([max(low, least) for (low, _), (least, _) in zip(admitted, bounds, strict=True)])
        self.high = np.array([min(high, most) for (_, high), (_, most) in zip(admitted, bounds, strict=True)])
        self.signed = (self.low < 0) & (self.high > 0) & (self.free > 1)
        self.priors = [(k, priors[names[i]]) for k, i in enumerate(self.free) if names[i] in priors]
        self.touched = np.array([plant.has_contacts and is_touched(plant, names[i]) for i in self.free], dtype=bool)
        self.scale = np.maximum(np.abs(np.array(plant.values)[self.free]), 1e-3)
        self.samples = sum(run.samples for run in runs)
        self.is_whitened = noise is None
        self.noise = self.least_noise = 1.0 if noise is None else max(noise, 1e-12)
        self.outlier, self.share = np.inf, FINE
        self.least_shift = np.zeros(self.free.size)
        self.substeps = [substeps_for(plant, run.sample_time) for run in runs]
        self.most_substeps: float = MOST_SUBSTEPS - 1
        self.one_sided = False
        self.simulated, self.allowance = 0, np.inf
        self._plants: dict[bytes, Plant] = {}

    @property
    def is_spent(self) -> bool:
        """Whether as much was simulated as is allowed."""
        return self.simulated >= self.allowance

    def at(self, starts: Sequence[NDArray[np.float64]], local: Mapping[str, NDArray[np.float64]]) -> Point:
        """Return the plant with these initial states of the runs and parameters of the records' own, not evaluated."""
        values = np.clip(np.array(self.plant.values)[self.free], self.low, self.high)
        for k, (index, group) in enumerate(self.slots):
            if self.names[index] in local:
                values[k] = local[self.names[index]][group]
        return Point(values, [start.copy() for start in starts])

    def start(
        self,
        known: Sequence[NDArray[np.float64]] = (),
        local: Mapping[str, NDArray[np.float64]] | None = None,
    ) -> Point:
        """Return where the search begins: each run as it is missed least.

        Parameters
        ----------
        known : sequence of ndarray, optional
            Initial states that may suit the runs, from another fit.
        local : mapping of str to ndarray, optional
            Parameters of each record's own, from the same.
        """
        local = local or {}
        point = self.at([run.start for run in self.runs], local)
        others = known if len(known) == len(self.runs) else point.starts
        point.starts = [self._least_missed(point, i, other) for i, other in enumerate(others)]
        unknown = (set(self.local) & set(own_phases(self.plant))) - set(local)
        for k, (index, group) in enumerate(self.slots):
            if self.names[index] in unknown:
                point.values[k] = self._phase(point, k, group)
        point.cost = self.cost(point)
        return point

    def begun_again(self, point: Point) -> Point:
        """Return the parameters of `point` where each run begins as they miss it least, see :meth:`start`."""
        again = Point(point.values, [self._least_missed(point, i, run.start) for i, run in enumerate(self.runs)])
        again.cost = self.cost(again)
        return again

    def _least_missed(self, point: Point, i: int, known: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the initial state of run `i` by which it is missed least: a guess, at rest there, or a known one.

        Dry friction and cogging part them by ridges.
        """
        guess, *places = begun(self.runs[i], self.plant_at(point.values, i))
        if guess.size < 2:
            return guess
        others = [np.array([guess[0], 0.0, *guess[2:]]), np.append(known, guess[known.size :])[: guess.size]]
        starts = [guess, *places, *(s for s in others if not np.array_equal(s, guess))]
        if len(starts) == 1:
            return guess
        missed = self._missed_from(point, i, starts)
        if places:
            between = guess.copy()
            between[2] = at_place(_lowest(IN_GAP, missed[: len(IN_GAP)]))
            starts.append(between)
            missed += self._missed_from(point, i, [between])
        return starts[int(np.argmin(missed))]

    def _missed_from(self, point: Point, i: int, starts: Sequence[NDArray[np.float64]]) -> list[float]:
        """Return the cost of run `i` from each initial state."""
        found = self._evaluate([(i, _Trial(point.values, start)) for start in starts])
        return [np.inf if residual is None else self._loss(residual) for residual in found]

    def _phase(self, point: Point, k: int, group: int) -> float:
        """Return the value of the phase `k` from which the runs of one record are missed least."""
        values, missed = point.values.copy(), []
        phases = round_the_circle(float(values[k]))
        for phase in phases:
            values[k] = phase
            trial = [(i, _Trial(values, point.starts[i])) for i, run in enumerate(self.runs) if run.group == group]
            missed.append(sum(np.inf if r is None else self._loss(r) for r in self._evaluate(trial)))
        return phases[int(np.argmin(missed))]

    def plant_at(self, values: NDArray[np.float64], i: int) -> Plant:
        """Return the plant of run `i`."""
        key = values[self.columns[i]].tobytes() + (i if self.local else 0).to_bytes(4)
        found = self._plants.get(key)
        if found is None:
            if len(self._plants) > MOST_PLANTS:
                self._plants.clear()
            found = self._plants[key] = self._plant_at(values, i)
        return found

    def _plant_at(self, values: NDArray[np.float64], i: int) -> Plant:
        full = np.array(self.plant.values)
        full[self.free[self.columns[i]]] = values[self.columns[i]]
        return self.plant.with_values(full.tolist())

    def residual(self, values: NDArray[np.float64], i: int, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return simulated minus measured position of run `i`."""
        run = self.runs[i]
        return run.residual(self.plant_at(values, i), start, self.substeps[i])

    def cost(self, point: Point) -> float:
        """Return the sum of the losses, priors included; infinite where a run cannot be simulated."""
        point.residuals = self._evaluate([(i, _Trial(point.values, start)) for i, start in enumerate(point.starts)])
        point.substeps = tuple(self.substeps)
        losses = [np.inf if r is None else self._loss(r) for r in point.residuals]
        return sum(losses) + self.prior_cost(point.values)

    def weigh_priors(self, point: Point) -> bool:
        """Weigh the priors against the residual at `point`; return whether that changes their weight. Renews its cost.

        What a model gets wrong is no white noise: it must not count as thousands of independent witnesses against
        a data sheet. A sample counts as one over its correlation time.
        """
        if not self.priors or self.is_whitened or not np.isfinite(point.cost):
            return False
        self.choose_substeps(point)
        residuals = [self.residual(point.values, i, start) for i, start in enumerate(point.starts)]
        before, self.noise = self.noise, max(self.least_noise, apparent_noise(residuals))
        point.cost = self.cost(point)
        return self.noise != before

    def too_stiff(self, point: Point, share: float = 1.0) -> bool:
        """Tell whether a run would need more than this `share` of the substeps that are granted, or is no plant's."""
        try:
            return any(
                substeps_for(self.plant_at(point.values, i), run.sample_time) > share * self.most_substeps
                for i, run in enumerate(self.runs)
            )
        except InputError:
            return True

    def choose_substeps(self, point: Point) -> None:
        """Simulate each run from here on as the plant at `point` needs it."""
        for i, run in enumerate(self.runs):
            self.substeps[i] = substeps_for(self.plant_at(point.values, i), run.sample_time)

    def spread(self, point: Point) -> float:
        """Return the robust standard deviation of the residuals, from their median size."""
        parts = [self.residual(point.values, i, point.starts[i]) for i in range(len(self.runs))]
        return float(1.4826 * np.median(np.abs(np.concatenate(parts))))

    def linearise(self, point: Point, widths: NDArray[np.float64] | None = None) -> Linearised:
        """Return each run's block, and gradient and information of the parameters; renews the cost of `point`.

        With differences of at least these `widths`, shape (k,).
        """
        self.choose_substeps(point)
        return self.equations(point, self.differences(point, widths))

    def equations(self, point: Point, slopes: Sequence[Slopes]) -> Linearised:
        """Return what `linearise` does of these slopes of each run at `point`."""
        k = self.free.size
        blocks = []
        gradient, information = np.zeros(k), np.zeros((k, k))
        point.cost = self.prior_cost(point.values)
        for run in slopes:
            point.cost += self._loss(run.residual)
            block = Block.of(run, self._weight(run.residual))
            blocks.append(block)
            gradient += block.jacobian.T @ block.residual
            information += block.jacobian.T @ block.jacobian
        for index, prior in self.priors:
            weight_of_prior = (self.noise / prior.deviation) ** 2
            gradient[index] += weight_of_prior * (point.values[index] - prior.value)
            information[index, index] += weight_of_prior
        return Linearised(blocks, gradient, information)

    def secants(self, slopes: Sequence[Slopes], before: Point, point: Point) -> list[Slopes] | None:
        """Return the slopes at `point` as the step there from `before` shows them; None where none can be told.

        Contacts leave steps that short no smooth slope, and a plant that needs other substeps is simulated anew.
        """
        self.choose_substeps(point)
        if self.plant.has_contacts or not before.substeps == point.substeps == tuple(self.substeps):
            return None
        change = point.values - before.values
        left = [residual for residual in point.residuals if residual is not None]  # all of a point that was reached
        there = zip(slopes, before.starts, point.starts, left, strict=True)
        return [run.moved(change, new - old, residual) for run, old, new, residual in there]

    def differences(self, point: Point, widths: NDArray[np.float64] | None = None) -> list[Slopes]:
        """Return each run's residual and its slopes by the parameters and by the initial state, of differences.

        Central, one-sided at a bound and where one side is no plant; of parameters at least these `widths`, shape (k,).
        """
        self.least_shift = np.zeros(self.free.size) if widths is None else widths
        centres = [_Trial(point.values, start) for start in point.starts]
        plans = [self._moves(centre, i) for i, centre in enumerate(centres)]
        if point.substeps != tuple(self.substeps):
            self.cost(point)
        trials = [(i, side) for i, plan in enumerate(plans) for _, *pair in plan for side in pair]
        found = iter(self._evaluate(trials))
        sets = []
        for centre, plan, residual in zip(centres, plans, point.residuals, strict=True):
            if residual is None:
                raise NumericalError(UNSTABLE)
            slopes = np.zeros((residual.size, self.free.size + centre.start.size))
            for k, *pair in plan:
                sides = [(trial, r) for trial, r in [(trial, next(found)) for trial in pair] if r is not None]
                (a, high), (b, low) = (*sides, (centre, residual), (centre, residual))[:2]
                if a.at(k) != b.at(k):
                    slopes[:, k] = (high - low) / (a.at(k) - b.at(k))
            sets.append(Slopes(residual, slopes[:, : self.free.size], slopes[:, self.free.size :]))
        return sets

    def _moves(self, centre: _Trial, i: int) -> list[Any]:
        """Return, for each unknown of run `i`, its number among parameters and initial state, and one or two trials."""
        plan: list[Any] = []
        for k in self.columns[i]:
            up, down = self._moved(centre.values, k)
            sides = ((up if up[k] != centre.values[k] else down),) if self.one_sided else (up, down)
            plan.append((k, *(centre._replace(values=side) for side in sides)))
        for k, h in zip(range(centre.start.size), self.runs[i].shifts, strict=False):
            shift = h * (np.arange(centre.start.size) == k)
            above, below = centre._replace(start=centre.start + shift), centre._replace(start=centre.start - shift)
            plan.append((self.free.size + k, above) if self.one_sided else (self.free.size + k, above, below))
        return plan

    def _moved(self, values: NDArray[np.float64], k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        h = max(self.share * max(abs(values[k]), 1e-3 * self.scale[k]), self.least_shift[k])
        up, down = values.copy(), values.copy()
        up[k], down[k] = min(up[k] + h, self.high[k]), max(down[k] - h, self.low[k])
        return up, down

    def _evaluate(self, trials: list[tuple[int, _Trial]]) -> list[NDArray[np.float64] | None]:
        """Return the residuals; None where a trial is no plant or cannot be simulated."""
        found: list[NDArray[np.float64] | None] = [None] * len(trials)
        jobs: list[tuple[int, list[int], list[Plant]]] = []
        for i in dict.fromkeys(i for i, _ in trials):
            plants = {}
            for k, (_, trial) in enumerate(trials):
                if trials[k][0] == i:
                    with suppress(InputError):
                        plants[k] = self.plant_at(trial.values, i)
            halves = [*plants][::2], [*plants][1::2]  # a few long jobs are shared badly
            jobs += [(i, those, [plants[k] for k in those]) for those in halves if those]

        def several(job: tuple[int, list[int], list[Plant]]) -> None:
            i, those, plants = job
            starts = [trials[k][1].start for k in those]
            try:
                rows = self.runs[i].residuals(plants, starts, self.substeps[i])
            except InputError:  # one of the plants does not go with the record
                rows = one_by_one(self.runs[i], plants, starts, self.substeps[i])
            for k, row in zip(those, rows, strict=True):
                found[k] = row if np.isfinite(row).all() else None

        of_each = [(self.runs[i], self.substeps[i], plants) for i, _, plants in jobs]
        self.simulated += (work := sum(len(p) * work_of(p[0], r.simulated, r.sample_time, n) for r, n, p in of_each))
        in_parallel(several, jobs, 1 if work < WORTH_THREADS else None)
        return found

    def _loss(self, residual: NDArray[np.float64]) -> float:
        if not np.isfinite(self.outlier):
            with np.errstate(over="ignore"):  # a trial may be as far off
                return float(residual @ residual)
        size = np.abs(residual)
        return float(np.sum(np.where(size <= self.outlier, size**2, self.outlier * (2.0 * size - self.outlier))))

    def _weight(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the square root of the weights with which least squares follow the loss."""
        return np.sqrt(np.minimum(1.0, self.outlier / np.maximum(np.abs(residual), 1e-300)))

    def unbounded(self, point: Point, gradient: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which parameters no end of their range keeps from going down the `gradient`, shape (k,)."""
        at_end = ((point.values <= self.low) & (gradient > 0)) | ((point.values >= self.high) & (gradient < 0))
        return np.asarray(~at_end)

    def step(self, point: Point, found: Linearised, damping: float) -> Point:
        """Return the trial that the damped normal equations propose, at most half of each parameter away."""
        gradient, information = found.gradient, found.information
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        free = self.unbounded(point, gradient)
        normal = (information / np.outer(scale, scale) + damping * np.eye(scale.size))[np.ix_(free, free)]
        change = np.zeros(scale.size)
        change[free] = -np.linalg.lstsq(normal, (gradient / scale)[free], rcond=None)[0] / scale[free]
        reach = AT_MOST * np.maximum(
            np.abs(point.values), np.where(self.free == 0, 0.0, self.scale)
        )  # β keeps its sign
        reach[self.signed] *= 4.0
        back = np.where(self.low > 0, AT_MOST * np.abs(point.values), reach)  # what may not vanish shrinks by degrees
        values = np.clip(point.values + np.clip(change, -back, reach), self.low, self.high)
        moved = values - point.values
        changes = [within_reach(block.best_change(moved, damping)) for block in found.blocks]
        starts = [moved_start(start, change) for start, change in zip(point.starts, changes, strict=True)]
        trial = Point(values, starts, promised=found.promised(moved, changes))
        trial.cost = np.inf if self.too_stiff(trial) else self.cost(trial)
        return trial

    def share_of(self, point: Point, share: float) -> NDArray[np.float64]:
        """Return this `share` of each free parameter, of its scale where it is small."""
        return np.asarray(share * np.maximum(np.abs(point.values), 1e-3 * self.scale))

    def variance(self, point: Point) -> float:
        """Return the variance of the residuals at `point`, the more the fewer samples there are for the unknowns."""
        unknowns = point.values.size + sum(start.size for start in point.starts)
        return point.cost / max(self.samples - unknowns, 1)

    def local_values(self, point: Point) -> dict[str, NDArray[np.float64]]:
        """Return the parameters that each record has of its own."""
        own: dict[str, list[float]] = {}
        for (index, _), value in zip(self.slots, point.values, strict=True):
            if self.names[index] in self.local:
                own.setdefault(self.names[index], []).append(float(value))
        return {name: np.array(values) for name, values in own.items()}

    def at_bound(self, point: Point) -> tuple[str, ...]:
        """Return the names of the parameters that are at an end of their range."""
        return self.names_of((point.values <= self.low) | (point.values >= self.high))

    def names_of(self, chosen: NDArray[np.bool_]) -> tuple[str, ...]:
        """Return the names of the `chosen` among the free parameters."""
        return tuple(dict.fromkeys(self.names[self.free[k]] for k in np.flatnonzero(chosen)))

    def prior_cost(self, values: NDArray[np.float64]) -> float:
        """Return what the priors add to the cost."""
        return float(sum((self.noise / p.deviation * (values[k] - p.value)) ** 2 for k, p in self.priors))


def _lowest(places: Sequence[float], missed: Sequence[float]) -> float:
    """Return where between three `places` the parabola through what is `missed` is lowest, within them."""
    if not np.isfinite(missed).all():
        return places[int(np.argmin(missed))]
    curvature, slope, _ = np.polyfit(places, missed, 2)
    least = -0.5 * slope / curvature if curvature > 0.0 else places[int(np.argmin(missed))]
    return float(np.clip(least, np.min(places), np.max(places)))
