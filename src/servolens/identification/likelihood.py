"""The likelihood of records: a plant and the noise beside it, fitted in turn until they agree."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import COARSE, FINE, Problem
from servolens.identification.hypothesis import NO_BETTER, Hypothesis
from servolens.identification.minimiser import NEGLIGIBLE_ON_THE_WAY, by_way_of, descend
from servolens.identification.noise import TOLD_APART, NoiseModel
from servolens.identification.noise_search import NoiseTrials
from servolens.identification.observed import ObservedRun, SimulatedRun, least_missed
from servolens.identification.phases import own_phases, synchronised
from servolens.identification.segments import loop_rate, noise_level
from servolens.identification.signals import Signals
from servolens.processors import Tally
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.identification.error_problem import Point
    from servolens.identification.options import FitOptions
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["FEW", "FULL", "SOME", "Likelihood", "found_last"]

RATES = (0.0, 0.5, 2.0, 8.0)
"""Rates of the observer that are compared, in units of the loops' own: none, slower, about as fast, faster."""
REMEMBERS, SLOW_RATE = 1.0, 0.5
"""Time constants of a loop, 1/ω, over which its errors are correlated; rate at which a record without a reference is
observed where the model is not the axis, in units of the loops' own."""
FEW, SOME, FULL = 4, 10, 30
"""Iterations to see where a start leads, to compare effects, and to end at the optimum."""
MOST_SUBSTEPS = 12
"""In a millisecond; plants that need more are left out: what is so fast cannot be told from what is rigid."""
MOST_SAMPLES = 16_000
"""Of all records together; of longer ones every few samples are compared."""
MOST_ROUNDS = 6
"""Times that plant and noise are fitted in turn."""


@final
class Likelihood:
    """Records as prediction-error problems, and what any plant makes of them beside its own noise.

    Parameters
    ----------
    records : sequence of Record
        Runs of the same axis, each with its voltage or with what it is computed from.
    plant : Plant
        About like the axis: it tells how fast the loops are.
    options : FitOptions
        What is held, what each record has of its own, and priors, as far as a plant has such parameters.
    price : callable, optional
        Of a plant and the number of samples: what its effects add to −2 log-likelihood.
    is_admissible : callable, optional
        Tells whether a plant may be the answer.
    rates : sequence of float
        Of the observer that are compared, in units of the loops' own; ``(0.0,)`` where nothing shakes the axis.
    are_phases_own : bool
        Whether each record has phases of its own, of waves that do not know when a record begins.
    """

    def __init__(
        self,
        records: Sequence[Record],
        plant: Plant,
        options: FitOptions,
        *,
        price: Callable[[Plant, float], float] = lambda _plant, _samples: 0.0,
        is_admissible: Callable[[Plant], bool] = lambda _: True,
        rates: Sequence[float] = RATES,
        are_phases_own: bool = True,
    ) -> None:
        self.records, self._options = tuple(records), options
        self.rates, self._are_phases_own = tuple(rates), are_phases_own and len(self.records) > 1
        self._asks_white = True  # whether what seems shaken is also fitted as if it were not
        self._price, self.is_admissible = price, is_admissible
        self.floor = float(np.sqrt(np.mean([noise_level(record) ** 2 for record in records])))
        self.every = max(-(-sum(len(record) for record in records) // MOST_SAMPLES), 1)
        self._like, self.rate = plant, loop_rate(plant, records)
        self.signals = self._signals(records)
        self.travel = max(float(np.ptp(record.position)) for record in self.records)
        self.samples = sum(signals.measured.size for signals in self.signals)
        rounding = max(record.encoder_resolution or 0.0 for record in records)
        self.white = replace(NoiseModel.white(self.floor, rounding), least=TOLD_APART * self.travel)
        longest = 1e3 * max(signals.longest_step for signals in self.signals)
        self.most_substeps = MOST_SUBSTEPS * max(longest, 1.0)
        self.may_be_unpowered = any(signals.may_be_unpowered for signals in self.signals)
        self.knows_beginning, self.simulates = True, False
        self.tally = Tally()

    def _signals(self, records: Sequence[Record]) -> tuple[Signals, ...]:
        return tuple(Signals.of(record, self.floor, self._like, self.rate, self.every) for record in records)

    def simulating(self) -> Likelihood:
        """Return the likelihood of simulations in closed loop, for models that are known not to be the axis.

        The error is that of `predict`; it counts once in the time that a loop remembers. Records without a reference
        are observed as slowly as that.
        """
        other = copy(self)
        other.white = replace(self.white, rounding=0.0, discount=self.remembered)
        other.simulates, other.tally = True, Tally()
        return other

    @property
    def remembered(self) -> float:
        """Samples over which the errors of a loop are correlated, at least 1."""
        steps = [signals.record.sample_time for signals in self.signals]
        return max(REMEMBERS / self.rate / float(np.median(steps)), 1.0)

    def unshaken(self) -> Likelihood:
        """Return the likelihood of an axis that nothing shakes: no observer follows what a model lacks."""
        other = copy(self)
        other.rates, other.tally = (), Tally()
        return other

    def shaken(self) -> Likelihood:
        """Return the likelihood of an axis that was searched before as if nothing shook it: that is not tried again."""
        other = copy(self)
        other._asks_white, other.tally = False, Tally()
        return other

    def without_priors(self) -> Likelihood:
        """Return the likelihood of the records alone, whatever else is known of the axis."""
        other = copy(self)
        other._options = replace(self._options, priors={}, bounds={})
        other.tally, other.is_admissible = Tally(), lambda _: True
        return other

    @property
    def work(self) -> int:
        """Work of all simulations (:func:`~servolens.simulation.rates.work_of`)."""
        return self.tally.value

    def runs(self, noise: NoiseModel, *, unpowered: bool = False) -> list[ObservedRun | SimulatedRun]:
        """Return the records as prediction-error problems, or as simulations."""
        found: list[ObservedRun | SimulatedRun] = []
        for i, signals in enumerate(self.signals):
            record = signals.record
            kind = SimulatedRun if self.simulates and record.has_loop else ObservedRun
            found.append(kind(signals, i, noise, unpowered=unpowered and signals.may_be_unpowered))
        return found

    @property
    def counted(self) -> float:
        """How many samples count by themselves, at least 2."""
        return max(self.samples / self.white.discount, 2.0)

    def price(self, plant: Plant) -> float:
        """Return what the effects of `plant` add to −2 log-likelihood, phases of each record's own included."""
        phases = (len(self.signals) - 1) * len(own_phases(plant))
        return self._price(plant, max(self.samples, 2.0)) + phases * float(np.log(self.counted))

    def weighed_by(self, noise: NoiseModel) -> float | None:
        """Return the least deviation of the residual by which priors are weighed; None where `noise` whitens it.

        Only a noise model that was estimated does, and none whitens the error of a model that is not the axis.
        """
        return None if noise.is_fitted and not noise.is_model_error and not self.simulates else 1.0

    def options(self, plant: Plant, *, is_rough: bool = False) -> FitOptions:
        """Return how `plant` is fitted: options on its own parameters, and phases of each record's own.

        Roughly, without the parameters that are found last.
        """
        asked = self._options.of(plant.parameters).holding(*(found_last(plant) if is_rough else ()))
        local = own_phases(plant) if self._are_phases_own else ()
        return replace(asked, local=tuple(dict.fromkeys([*asked.local, *local])))

    def judged(
        self, plant: Plant, like: Hypothesis | None = None, iterations: int = FULL, *, allowance: float = np.inf
    ) -> Hypothesis | None:
        """Return `plant` fitted beside the noise that makes it likeliest; None where it cannot be simulated.

        Parameters
        ----------
        plant : Plant
            Start and structure.
        like : Hypothesis, optional
            Whose noise model and initial states to begin with.
        iterations : int
            Of each descent at most.
        allowance : float
            Work after which no descent goes on.
        """
        choices = (False, True) if self.may_be_unpowered and plant.remembers_voltage else (False,)
        share = allowance / len(choices)
        found = [h for h in (self._in_turn(plant, like, iterations, share, unpowered=u) for u in choices) if h]
        return min(found, key=lambda h: h.total, default=None)

    def _in_turn(
        self, plant: Plant, like: Hypothesis | None, iterations: int, allowance: float, *, unpowered: bool
    ) -> Hypothesis | None:
        """Return `plant` fitted, the parameters that are found last after the others."""
        if not found_last(plant):
            return self._judged(plant, like, iterations, allowance, unpowered=unpowered)
        begun = self._judged(plant, like, iterations, 0.5 * allowance, unpowered=unpowered, is_rough=True)
        if begun is None:
            return None
        found = self._judged(begun.plant, begun, iterations, 0.5 * allowance, unpowered=unpowered)
        return begun if found is None or begun.total <= found.total else found

    def _judged(
        self,
        plant: Plant,
        like: Hypothesis | None,
        iterations: int,
        allowance: float,
        *,
        unpowered: bool,
        is_rough: bool = False,
    ) -> Hypothesis | None:
        noise = self._first_noise(plant, unpowered=unpowered) if like is None else like.noise
        follow = partial(self.led, iterations=iterations, unpowered=unpowered, is_rough=is_rough)
        best, left = self._agreed(follow, plant, noise, like, allowance, unpowered=unpowered)
        # nothing may shake it, and the plant be another
        if self._asks_white and best is not None and best.noise.rate > 0.0:
            other, _ = self._agreed(follow, best.plant, self.white, best, left, unpowered=unpowered, known=best)
            best = best if other is None or other.total >= best.total else other
        return best if best is not None and self.is_admissible(best.plant) else None

    def _agreed(
        self,
        follow: Callable[..., tuple[Problem, Point]],
        plant: Plant,
        noise: NoiseModel,
        like: Hypothesis | None,
        allowance: float,
        *,
        unpowered: bool,
        known: Hypothesis | None = None,
    ) -> tuple[Hypothesis | None, float]:
        """Return where plant and noise, fitted in turn, agree, and what is left of the allowance; None if nowhere.

        What seems shaken, as `known` does, and is no likelier ends it: it is no better place to go on from.
        """
        best: Hypothesis | None = None
        for _ in range(MOST_ROUNDS):
            if allowance <= 0.0:
                break
            try:
                problem, point = follow(plant, noise, like=best or like, allowance=allowance)
            except (InputError, NumericalError):
                break
            allowance -= problem.simulated
            found = self._profiled(problem, point, noise, unpowered=unpowered)
            if found is None or (best is not None and found.total >= best.total - NO_BETTER):
                break
            best, plant, noise = found, found.plant, found.noise
            if known is not None and noise.rate > 0.0 and best.total >= known.total:
                break
        return best, allowance

    def tried(
        self,
        plant: Plant,
        noise: NoiseModel | None,
        iterations: int,
        *,
        like: Hypothesis | None = None,
        unpowered: bool = False,
        allowance: float = np.inf,
    ) -> Hypothesis | None:
        """Return where a few iterations beside `noise` lead, judged by its own noise; None where that fails.

        Without a `noise` beside the likeliest for this start. The records begin as in `like`, if that misses less.
        """
        if noise is None:
            noise = self._first_noise(plant, unpowered=unpowered)
        try:
            problem, point = self.led(
                plant,
                noise,
                iterations,
                like=like,
                unpowered=unpowered,
                is_coarse=True,
                is_rough=True,
                allowance=allowance,
            )
        except (InputError, NumericalError):
            return None
        return self._profiled(problem, point, noise, unpowered=unpowered, is_screened=True)

    def led(
        self,
        plant: Plant,
        noise: NoiseModel,
        iterations: int,
        *,
        like: Hypothesis | None = None,
        unpowered: bool = False,
        is_coarse: bool = False,
        is_rough: bool = False,
        allowance: float = np.inf,
    ) -> tuple[Problem, Point]:
        """Return where a descent from `plant` beside this noise leads; records begin as in `like`, if that is better.

        Raises
        ------
        NumericalError
            If `plant` cannot be simulated, or only with very small steps.
        """
        runs, options = self.runs(noise, unpowered=unpowered), self.options(plant, is_rough=is_rough)
        problem = Problem(plant, runs, options, self.weighed_by(noise))
        problem.allowance = allowance
        problem.most_substeps, problem.one_sided = self.most_substeps, not plant.has_contacts
        start = problem.start() if like is None else problem.start(like.starts, like.local)
        if problem.too_stiff(start) or not np.isfinite(start.cost):
            raise NumericalError("the plant to start from cannot be simulated on these records")
        problem.weigh_priors(start)
        if plant.has_contacts:
            way = ((COARSE, iterations),) if is_coarse else ((COARSE, iterations), (FINE, iterations))
            point, _ = by_way_of(problem, start, way, NEGLIGIBLE_ON_THE_WAY)
        else:
            point, _ = descend(problem, start, iterations, NEGLIGIBLE_ON_THE_WAY)
        if problem.weigh_priors(point):  # beside what was left at the start they weigh more
            point, _ = descend(problem, point, iterations, NEGLIGIBLE_ON_THE_WAY)
        self.tally.add(problem.simulated)
        return problem, point

    def _first_noise(self, plant: Plant, *, unpowered: bool) -> NoiseModel:
        """Return the noise model of a plant that was not fitted yet."""
        starts = [s.initial.mean for s in self.signals]
        found = self._noises([plant] * len(self.signals), starts, self.white, unpowered=unpowered)
        return self.white if found is None else found[0]

    def _profiled(
        self, problem: Problem, point: Point, noise: NoiseModel, *, unpowered: bool, is_screened: bool = False
    ) -> Hypothesis | None:
        """Return the plant at `point`, fitted beside `noise`, beside the likeliest of the noise models.

        To screen many, of those whose shaking is that of `noise`, or none.
        """
        plants = [problem.plant_at(point.values, i) for i in range(len(self.signals))]
        found = self._noises(plants, point.starts, noise, unpowered=unpowered, is_screened=is_screened)
        if found is None:
            return None
        noise, misfit = found
        misfit += problem.prior_cost(point.values)
        total, own = misfit + self.price(plants[0]), problem.local_values(point)
        return Hypothesis(plants[0], noise, tuple(point.starts), misfit, total, unpowered, own)

    def _noises(
        self,
        plants: Sequence[Plant],
        starts: Sequence[NDArray[np.float64]],
        like: NoiseModel,
        *,
        unpowered: bool,
        is_screened: bool = False,
    ) -> tuple[NoiseModel, float] | None:
        """Return the noise model that makes what the plants leave likeliest, with −2 log-likelihood beside it.

        Compared are a simulation; one whose sampling instants move as much as its residual shows; and observers of an
        axis that is shaken, from the rate of `like`, beside which `starts` were fitted, or from all rates.
        """
        trials = NoiseTrials(self, plants, starts, like, unpowered=unpowered)
        if self.simulates:
            closed = all(s.record.has_loop for s in self.signals)
            trials.look(trials.first if closed else trials.shaken(trials.first, SLOW_RATE))
        else:
            trials.search(trials.first, () if is_screened else self.rates)
        return trials.best

    def whitened_well(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` beside noise of the order that Akaike's criterion chooses: nothing of it is left out."""
        runs = self.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
        missed = []
        for i, (run, start) in enumerate(zip(runs, hypothesis.starts, strict=True)):
            plant = hypothesis.plant_of(i)
            missed.append(run.missed(plant, start, substeps_for(plant, run.sample_time)))
        noise = hypothesis.noise.coloured(missed, [run.whiten for run in runs], for_errors=True)
        return replace(hypothesis, noise=noise)

    def on(self, records: Sequence[Record]) -> Likelihood:
        """Return the likelihood of other `records` of the same axis, with what is known of it."""
        other = copy(self)
        other.records, other.tally = tuple(records), Tally()
        other.signals = self._signals(records)
        other.may_be_unpowered = any(signals.may_be_unpowered for signals in other.signals)
        other.knows_beginning = self.may_be_unpowered
        return other

    def misfit(self, hypothesis: Hypothesis, plants: Sequence[Plant], cuts: Sequence[int] | None = None) -> float:
        """Return −2 log-likelihood of the records, each by its own of the `plants`, but for samples before its cut.

        Initial states, phases of each record's own and the size of its noise are fitted; nothing else is. What was
        applied before them is asked of these records where those that were fitted could not tell.
        """
        if not self.simulates and not any(cuts or ()):
            is_open = self.may_be_unpowered and not self.knows_beginning and hypothesis.plant.remembers_voltage
            choices = (False, True) if is_open else (hypothesis.unpowered,)
            return min(self._profiled_misfit(replace(hypothesis, unpowered=u), plants) for u in choices)
        total = 0.0
        first = cuts or [0] * len(self.signals)
        for run, plant, cut in zip(
            self.runs(hypothesis.noise, unpowered=hypothesis.unpowered), plants, first, strict=True
        ):
            begin = cut // self.every

            def missed(plant: Plant, run: ObservedRun | SimulatedRun = run, begin: int = begin) -> float:
                return least_missed(run, plant, begin)[0]

            compared = max(run.samples - begin, 1)
            size = missed(synchronised(plant, missed)) / compared
            total += compared / hypothesis.noise.discount * float(np.log(max(size, 1e-300)))
            total += run.whiten.log_determinant * compared / run.samples
        return total

    def _profiled_misfit(self, hypothesis: Hypothesis, plants: Sequence[Plant]) -> float:
        """Return −2 log-likelihood of whole records beside the noise that suits each hypothesis there.

        An observer that was tuned where a model was fitted would favour the model that it follows most closely.
        """
        own = []
        for run, plant in zip(self.runs(self.white, unpowered=hypothesis.unpowered), plants, strict=True):

            def missed(plant: Plant, run: ObservedRun | SimulatedRun = run) -> float:
                return least_missed(run, plant, 0)[0]

            own.append(synchronised(plant, missed))
        runs = self.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
        starts = [least_missed(run, plant, 0)[1] for run, plant in zip(runs, own, strict=True)]
        found = self._noises(
            own, starts, replace(hypothesis.noise, filters=self.white.filters), unpowered=hypothesis.unpowered
        )
        return np.inf if found is None else found[1]

    def is_too_stiff(self, plant: Plant) -> bool:
        """Tell whether `plant` would not be fitted, so that its simulation, which may take long, is for nothing."""
        return any(substeps_for(plant, signals.longest_step) > self.most_substeps for signals in self.signals)


def found_last(plant: Plant) -> list[str]:
    """Return the parameters of the plant's effects that a fit holds until it has found the others."""
    return [f"{effect.name}.{name}" for effect in plant.effects for name in effect.found_last]
