"""Hypotheses, each a plant and the noise beside it, and the likelihood that the training records give them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects import Actuator, Delay, Drive, Sensor, Transmission, effect_class
from servolens.errors import InputError, NumericalError
from servolens.identification.descent import NEGLIGIBLE_ON_THE_WAY, along_the_valley, by_way_of, descend
from servolens.identification.error_problem import COARSE, FINE, Problem
from servolens.identification.noise import NoiseModel
from servolens.identification.observed import ObservedRun, Signals
from servolens.identification.options import FitOptions
from servolens.identification.phases import own_phases, synchronised
from servolens.identification.regressors import regressor
from servolens.identification.segments import applied_voltage, motion_segments, moving_parts, noise_level
from servolens.identification.starting import Screen, seen_in
from servolens.quality.beginning import initial_motion
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.diagnosis.score import ScoreTest
    from numpy.typing import NDArray

    from servolens.effects import Effect, Seen
    from servolens.identification.error_problem import Point
    from servolens.identification.integral import Prior
    from servolens.identification.ranking import Proposals
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["FEW", "FULL", "SOME", "Hypothesis", "Start", "Trials", "begins_with_its_step", "loop_rate"]

RATES = (0.0, 0.5, 2.0, 8.0)
"""Rates of the observer that are compared, in units of the loops' own: none, slower, about as fast, faster."""
FEW, SOME, FULL = 4, 10, 30
"""Iterations to see where a start leads, to compare effects, and to end at the optimum."""
STARTS = 3
"""Proposals of an effect, ranked in the integral equation, that are simulated."""
MOST_SUBSTEPS = 12
"""In a millisecond; plants that need more are left out: what is so fast cannot be told from what is rigid."""
MOST_SAMPLES = 16_000
"""Of all records together; longer ones are simulated every few samples only."""
MOST_ROUNDS, NO_BETTER = 6, 0.5
"""Times that plant and noise are fitted in turn; fall of −2 log-likelihood below which they agree."""
FALSE_ALARM = 1e-3
"""Familywise error rate: probability that any effect of the catalogue enters a model that lacks none."""
CONTRADICTS = 4.0
"""Standard deviations of a prior from which on a parameter contradicts it."""


def fixed(cls: type[Effect]) -> tuple[str, ...]:
    """Return the parameters of an effect that a fit holds at what its start gives them."""
    return tuple(getattr(cls, "fixed", ()))


@final
@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A plant fitted to the training records beside its own noise model.

    Attributes
    ----------
    plant : Plant
        The best of its structure.
    noise : NoiseModel
        That makes what the plant leaves likeliest.
    starts : tuple of ndarray
        Initial state of each record.
    misfit : float
        −2 log-likelihood, priors included.
    total : float
        The same plus the price of its effects; the least is the best.
    unpowered : bool
        Whether nothing was applied before records that begin with their step.
    local : mapping of str to ndarray
        Parameters that each record has of its own.
    """

    plant: Plant
    noise: NoiseModel
    starts: tuple[NDArray[np.float64], ...]
    misfit: float
    total: float
    unpowered: bool
    local: Mapping[str, NDArray[np.float64]]

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects, in the order in which they were found."""
        return tuple(effect.name for effect in self.plant.effects)

    def plant_of(self, group: int) -> Plant:
        """Return the plant of one record, with the parameters of its own."""
        if not self.local:
            return self.plant
        values = dict(zip(self.plant.parameters, self.plant.values, strict=True))
        return self.plant.with_values([float(self.local[n][group]) if n in self.local else v for n, v in values.items()])


@final
@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """An effect beside a hypothesis, from where its fit begins, and the score test for it.

    Attributes
    ----------
    plant : Plant
        With the effect.
    gain : float
        By how much −2 log-likelihood falls to first order, all sizes free: the score statistic.
    """

    plant: Plant
    gain: float

    @property
    def effect(self) -> str:
        """Name of the effect that was added."""
        return self.plant.effects[-1].name


@final
class Trials:
    """Training records made ready to try many hypotheses.

    Parameters
    ----------
    records : sequence of Record
        Runs of the same axis, each with its voltage or with what it is computed from.
    priors : mapping of str to Prior
        Knowledge from elsewhere, by qualified parameter name.
    candidates : int
        Effects that are tried, for the price of each.
    seen : Seen, optional
        What all records of the campaign show, where `records` are a part of it.
    """

    def __init__(
        self, records: Sequence[Record], priors: Mapping[str, Prior], candidates: int, seen: Seen | None = None
    ) -> None:
        self.records, self.priors, self.candidates = tuple(records), priors, candidates
        self.floor = float(np.sqrt(np.mean([noise_level(record) ** 2 for record in records])))
        self.every = max(-(-sum(len(record) for record in records) // MOST_SAMPLES), 1)
        self.signals = tuple(Signals.of(record, self.floor, self.every) for record in records)
        self.screen = Screen.of(moving_parts(motion_segments(records)))
        bare, _ = self.screen.solve(())
        self.bare = replace(
            bare,
            damping=max(bare.damping, 0.0),
            length_unit=records[0].length_unit,
            command_unit=records[0].command_unit,
        )
        self.seen = seen or seen_in(self.screen.segments, self.bare)
        self.rate = loop_rate(self.bare, records)
        self.white = NoiseModel.white(self.floor, max(record.encoder_resolution or 0.0 for record in records))
        longest = 1e3 * max(float(np.max(np.diff(s.time))) for s in self.signals)
        self.most_substeps = MOST_SUBSTEPS * max(longest, 1.0)
        self.may_be_unpowered = any(begins_with_its_step(record) for record in records)
        self.work = 0
        self._proposals: dict[str, Proposals] = {}

    def on(self, records: Sequence[Record]) -> Trials:
        """Return trials of other `records` of the same axis, with what is known of it."""
        other = copy(self)
        other.records = tuple(records)
        other.signals = tuple(Signals.of(record, self.floor, self.every) for record in records)
        other.may_be_unpowered = any(begins_with_its_step(record) for record in records)
        return other

    def misfit(self, hypothesis: Hypothesis, plants: Sequence[Plant], cuts: Sequence[int] | None = None) -> float:
        """Return −2 log-likelihood of the records, each by its own of the `plants`, but for samples before its cut.

        Initial states and phases of each record's own are fitted; nothing else is.
        """
        total = 0.0
        first = cuts or [0] * len(self.signals)
        for run, plant, cut in zip(self.runs(hypothesis.noise, unpowered=hypothesis.unpowered), plants, first, strict=True):
            begin = cut // self.every

            def missed(plant: Plant, run: ObservedRun = run, begin: int = begin) -> float:
                return self._least(run, plant, begin)

            total += missed(synchronised(plant, missed)) + run.whiten.log_determinant
        return total

    def _least(self, run: ObservedRun, plant: Plant, begin: int) -> float:
        """Return the squared residual of `run` from sample `begin` on, from its best initial state."""
        substeps, start = substeps_for(plant, run.sample_time), run.start
        least = np.inf
        for _ in range(3):
            try:
                found = run.residual(plant, start, substeps)
            except (InputError, NumericalError):
                return least
            size = float(found[begin:] @ found[begin:])
            if not size < least:
                break
            least = size
            moves = [np.eye(2)[k] * h for k, h in enumerate(run.shifts)]
            slopes = np.column_stack([(run.residual(plant, start + m, substeps) - found) / m.sum() for m in moves])
            start = start - np.linalg.lstsq(slopes, found, rcond=None)[0]
        return least

    def price(self, cls: type[Effect]) -> float:
        """Return by how much −2 log-likelihood must fall for an effect to enter.

        The quantile of χ² with as many degrees of freedom as the effect has parameters (Wilks 1938), at the familywise
        error rate shared evenly among the candidates (Bonferroni); for an effect of many parameters the Bayesian
        information criterion asks for more (Schwarz 1978).
        """
        from scipy.stats import chi2

        free = max(len(cls.parameters()) - len(fixed(cls)), 1)
        entry = float(chi2.isf(FALSE_ALARM / max(self.candidates, 1), free))
        return max(entry, free * float(np.log(sum(s.measured.size for s in self.signals))))

    def runs(self, noise: NoiseModel, *, unpowered: bool = False) -> list[ObservedRun]:
        """Return the records as prediction-error problems."""
        return [
            ObservedRun(signals, i, noise, unpowered=unpowered and begins_with_its_step(signals.record))
            for i, signals in enumerate(self.signals)
        ]

    def options(self, plant: Plant) -> FitOptions:
        """Return how `plant` is fitted: with the priors on its own parameters, and phases of each record's own."""
        names = plant.parameters
        held = tuple(f"{effect.name}.{name}" for effect in plant.effects for name in fixed(type(effect)))
        priors = {name: prior for name, prior in self.priors.items() if name in names}
        return FitOptions(held=held, priors=priors, local=own_phases(plant) if len(self.records) > 1 else ())

    def base(self) -> Hypothesis:
        """Return gain and damping alone.

        Raises
        ------
        NumericalError
            If no start can be simulated.
        """
        starts = [self.bare, *(replace(self.bare, gain=s * self.bare.gain) for s in (0.5, 2.0))]
        if "gain" in self.priors:
            starts = [replace(self.bare, gain=self.priors["gain"].value), *starts]
        for start in starts:
            found = self.judged(start)
            if found is not None:
                return found
        raise NumericalError("gain and damping alone cannot be simulated on these records; check sign and units")

    def judged(self, plant: Plant, like: Hypothesis | None = None, iterations: int = FULL) -> Hypothesis | None:
        """Return `plant` fitted beside the noise that makes it likeliest; None where it cannot be simulated.

        Parameters
        ----------
        plant : Plant
            Start and structure.
        like : Hypothesis, optional
            Whose noise model and initial states to begin with.
        iterations : int
            Of each descent at most.
        """
        choices = (False, True) if self.may_be_unpowered and _remembers(plant) else (False,)
        found = [h for h in (self._judged(plant, like, iterations, unpowered=u) for u in choices) if h]
        return min(found, key=lambda h: h.total, default=None)

    def _judged(self, plant: Plant, like: Hypothesis | None, iterations: int, *, unpowered: bool) -> Hypothesis | None:
        noise = self._first_noise(plant, unpowered=unpowered) if like is None else like.noise
        best: Hypothesis | None = None
        waiting = [noise]
        for _ in range(MOST_ROUNDS):
            if not waiting:
                break
            noise = waiting.pop()
            try:
                problem, point = self.led(plant, noise, iterations, unpowered=unpowered)
            except (InputError, NumericalError):
                continue
            found = self._profiled(problem, point, unpowered=unpowered)
            if found is None or (best is not None and found.total >= best.total - NO_BETTER):
                continue
            best, plant = found, found.plant
            waiting = [found.noise] if found.noise.rate == 0.0 else [self.white, found.noise]
        return best if best is not None and self._is_admissible(best.plant) else None

    def tried(self, plant: Plant, noise: NoiseModel, iterations: int, *, unpowered: bool = False) -> Hypothesis | None:
        """Return where a few iterations beside `noise` lead, judged by its own noise; None where that fails."""
        try:
            problem, point = self.led(plant, noise, iterations, unpowered=unpowered, coarse=True)
        except (InputError, NumericalError):
            return None
        return self._profiled(problem, point, unpowered=unpowered)

    def led(
        self, plant: Plant, noise: NoiseModel, iterations: int, *, unpowered: bool = False, coarse: bool = False
    ) -> tuple[Problem, Point]:
        """Return where a descent from `plant` beside this noise leads.

        Raises
        ------
        NumericalError
            If `plant` cannot be simulated, or only with very small steps.
        """
        problem = Problem(plant, self.runs(noise, unpowered=unpowered), self.options(plant), 1.0)
        problem.most_substeps, problem.one_sided = self.most_substeps, not plant.has_contacts
        start = problem.start()
        if problem.too_stiff(start) or not np.isfinite(start.cost):
            raise NumericalError("the plant to start from cannot be simulated on these records")
        problem.weigh_priors(start)
        if plant.has_contacts:
            way = ((COARSE, iterations),) if coarse else ((COARSE, iterations), (FINE, iterations))
            point, _ = by_way_of(problem, start, way, NEGLIGIBLE_ON_THE_WAY)
        else:
            point, _ = descend(problem, start, iterations, NEGLIGIBLE_ON_THE_WAY)
        self.work += problem.simulated
        return problem, point

    def _first_noise(self, plant: Plant, *, unpowered: bool) -> NoiseModel:
        """Return the noise model of a plant that was not fitted yet."""
        best, least = self.white, np.inf
        starts = [s.initial.mean for s in self.signals]
        for noise, misfit in self._noises([plant] * len(self.signals), starts, unpowered=unpowered):
            if misfit < least:
                best, least = noise, misfit
        return best

    def _profiled(self, problem: Problem, point: Point, *, unpowered: bool) -> Hypothesis | None:
        """Return the plant at `point` beside the likeliest of the noise models."""
        plants = [problem.plant_at(point.values, i) for i in range(len(self.signals))]
        found = self._noises(plants, point.starts, unpowered=unpowered)
        if not found:
            return None
        noise, misfit = min(found, key=lambda pair: pair[1])
        misfit += problem.prior_cost(point.values)
        plant = plants[0]
        paid = sum(self.price(type(e)) for e in plant.effects)
        extra = (len(self.signals) - 1) * len(own_phases(plant)) * float(np.log(sum(r.samples for r in problem.runs)))
        return Hypothesis(
            plant, noise, tuple(point.starts), misfit, misfit + paid + extra, unpowered, problem.local_values(point)
        )

    def _noises(
        self, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], *, unpowered: bool
    ) -> list[tuple[NoiseModel, float]]:
        """Return a noise model for each rate of the observer, with −2 log-likelihood beside it."""
        found = []
        for rate in RATES:
            first = replace(self.white, rate=rate * self.rate)
            runs = self.runs(first, unpowered=unpowered)
            begun = starts if rate == 0.0 else [run.start for run in runs]
            try:
                missed = [
                    run.missed(plant, start, substeps_for(plant, run.sample_time))
                    for run, plant, start in zip(runs, plants, begun, strict=True)
                ]
            except (InputError, NumericalError):
                continue
            noise = first.estimated(missed, [run.whiten for run in runs])
            if not np.isfinite(noise.innovation) or noise.innovation <= 0.0:
                continue
            misfit = 0.0
            for run, error, start in zip(self.runs(noise, unpowered=unpowered), missed, begun, strict=True):
                white, initial = run.whiten(error), run.signals.initial
                misfit += run.whiten.log_determinant + float(white @ white)
                misfit += float(np.sum(((start - initial.mean) / initial.deviation) ** 2))
            parameters = noise.order + (rate > 0.0)
            found.append((noise, misfit + parameters * float(np.log(sum(run.samples for run in runs)))))
        return found

    def _is_admissible(self, plant: Plant) -> bool:
        """Tell whether the records show the effects as a whole, and no prior is contradicted."""
        values = dict(zip(plant.parameters, plant.values, strict=True))
        contradicted = any(
            abs(values[name] - prior.value) > CONTRADICTS * prior.deviation
            for name, prior in self.priors.items()
            if name in values
        )
        return not contradicted and all(effect.is_whole(self.seen) for effect in plant.effects)

    def starts(self, test: ScoreTest, name: str) -> list[Start]:
        """Return where fits of the effect `name` beside the hypothesis of `test` begin, the likeliest first.

        None where the two do not go together.
        """
        plant, cls = test.hypothesis.plant, effect_class(name)
        if any(name in type(effect).generalises or effect.name == name for effect in plant.effects):
            return []
        for special in cls.generalises:
            plant = plant.without_effect(special)
        try:
            tried = self._proposed(plant, cls)
        except (InputError, NumericalError):
            return []
        found = [Start(p, test.gain(p)) for p in tried if not self._is_too_stiff(p)]
        return sorted(found, key=lambda start: -start.gain)

    def _proposed(self, plant: Plant, cls: type[Effect]) -> list[Plant]:
        """Return the plants with the effect that the integral equation, or the effect itself, proposes."""
        proposals = self.screen.proposals_of(plant, cls)
        if regressor(cls).sizes:
            return self._solved(plant, cls, proposals)
        tried = [plant.with_effect(effect) for effect in proposals]
        if issubclass(cls, Drive):  # its own loop takes over most of what seemed damping
            tried += [replace(start, damping=0.2 * plant.damping) for start in tried]
        return [*tried, *_swapped(plant, cls, self.rate)]

    def _is_too_stiff(self, plant: Plant) -> bool:
        """Tell whether `plant` would not be fitted, so that its simulation, which may take long, is for nothing."""
        return any(substeps_for(plant, float(np.max(np.diff(s.time)))) > self.most_substeps for s in self.signals)

    def _solved(self, plant: Plant, cls: type[Effect], proposals: list[Effect]) -> list[Plant]:
        """Return plants with the likeliest of the proposed forces: beside `plant` as it is, and all solved for."""
        if cls.name not in self._proposals:
            self._proposals[cls.name] = self.screen.thinned.proposals(proposals)
        starts = []
        for effect in self.screen.best(plant.effects, self._proposals[cls.name], STARTS):
            alone = plant.with_effect(effect)
            starts.append(alone)
            try:
                solved, _ = self.screen.solve(alone.effects)
            except (InputError, NumericalError):
                continue
            starts.append(replace(alone, gain=solved.gain, damping=max(solved.damping, 0.0), effects=solved.effects))
        return starts


def _swapped(plant: Plant, cls: type[Effect], loop: float) -> list[Plant]:
    """Return plants in which a lag is what seemed to be damping, and the damping is quicker.

    A linear axis is the same with the two exchanged; not so one whose force is limited. The way from here is long.
    Where no damping is left to be seen, the lag is as slow as the `loop` [rad/s].
    """
    if not cls.passes_for_damping or all(effect.linear for effect in plant.effects):
        return []
    found = []
    for rate in (plant.damping,) if plant.damping > 0.1 * loop else (loop, 4.0 * loop):
        lag = cls(**{spec.name: 1.0 / rate for spec in cls.parameters()})
        quicker = ((times * plant.gain, times * rate) for times in (5.0, 50.0))
        found += [replace(plant, gain=gain, damping=damping).with_effect(lag) for gain, damping in quicker]
    return found


def _remembers(plant: Plant) -> bool:
    """Tell whether the voltage before a record still shows in it."""
    late = (Delay, Transmission, Sensor)
    return any(isinstance(e, late) or (isinstance(e, Actuator) and e.states) for e in plant.effects)


def begins_with_its_step(record: Record) -> bool:
    """Tell whether `record` begins at full voltage, and does not say what was applied before."""
    if record.voltage_before is not None or initial_motion(record) != 0.0:
        return False
    voltage = np.abs(applied_voltage(record))
    return bool(voltage[0] > 0.1 * voltage.max())


def loop_rate(plant: Plant, records: Sequence[Record]) -> float:
    """Return about how fast the loops are [rad/s]; of records without gains, how fast they are logged to be."""
    rates = [abs(plant.gain * r.controller.kp) ** 0.5 for r in records if r.controller is not None]
    return float(np.median(rates)) if rates else 10.0 / float(np.median([r.duration for r in records]))
