"""The records of a diagnosis: what is fitted, what is held out, and what the noise in them is."""

from __future__ import annotations

from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar, final

import numpy as np

from servolens.diagnosis.errors import KEPT, Gains, pooled, residual, residual_in_phase
from servolens.diagnosis.logs import apart, beyond
from servolens.diagnosis.trials import Trials
from servolens.effects import ActuatorLag, CoulombFriction
from servolens.errors import InputError, NumericalError
from servolens.identification.bursts import burst_of
from servolens.identification.likelihood import SOME
from servolens.identification.loop_errors import drawn_loop_errors, loop_error
from servolens.identification.observed import least_missed
from servolens.identification.phases import own_phases
from servolens.identification.ripple import Ripple, mains_lines, ripple_in
from servolens.identification.rounding import dominates, is_coarse
from servolens.identification.score import ScoreTest
from servolens.identification.segments import resting_noise
from servolens.identification.signals import clock_error
from servolens.identification.structure import depends_on_inputs
from servolens.model_evidence import MATERIAL
from servolens.processors import in_processes
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.findings import Finding
    from servolens.identification.bursts import Burst
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.options import Prior
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Case"]

T = TypeVar("T")

REFITTED = 5e6
"""Work that a refit without one record may do, or with those held out: it begins at the optimum of the others."""


@final
class Case:
    """Training and held-out records, prepared, and gain and damping alone fitted to the former.

    Parameters
    ----------
    records, heldout : tuple of Record
        For training, and for the test.
    priors : mapping of str to Prior
        Knowledge from elsewhere.
    candidates : int
        Effects that will be tried.

    Raises
    ------
    InputError
        If the axis moves in none.
    NumericalError
        If gain and damping alone cannot be simulated on them.
    """

    def __init__(
        self,
        records: tuple[Record, ...],
        heldout: tuple[Record, ...],
        priors: Mapping[str, Prior],
        candidates: int,
    ) -> None:
        self.records, self.heldout = records, heldout
        self.trials = Trials(records, priors, candidates)
        self.likelihood = self.trials.likelihood
        self.base = self.trials.base()
        self._held: Likelihood | None = None
        self._with_strong_draws = False
        self._dependent: dict[int, tuple[Hypothesis, bool]] = {}
        self._everywhere: dict[int, tuple[Hypothesis, bool]] = {}
        self._bursts: dict[int, tuple[Hypothesis, Burst | None]] = {}
        self._loop_noise: dict[int, tuple[Hypothesis, float]] = {}
        self._ripples: dict[int, tuple[Hypothesis, Ripple]] = {}
        self._left_out: dict[int, tuple[Hypothesis, list[Plant]]] = {}
        self._simulating: Case | None = None
        self.learn_ripple(self.base)

    def simulating(self) -> Case:
        """Return the case by simulations in closed loop, for models that are known not to be the axis; made once.

        Raises
        ------
        NumericalError
            If gain and damping alone cannot be simulated in closed loop.
        """
        if self._simulating is not None:
            return self._simulating
        other = copy(self)
        other.trials = self.trials.simulating()
        other.likelihood = other.trials.likelihood
        other.base = other.trials.base()
        other._dependent, other._bursts, other._loop_noise = {}, {}, {}
        other._left_out, other._ripples, other._everywhere, other._held = {}, {}, {}, None
        self._simulating = other
        return other

    def fitted_to_simulations(self, plants: Sequence[Plant], work: float) -> list[Hypothesis]:
        """Return `plants` as fitted, from where they are and as much heavier or lighter as the base is.

        All together may do at most about `work`.
        """
        begun = list(plants)
        for plant in plants:
            with suppress(InputError, ZeroDivisionError):  # a gain that is next to nothing makes no such axis
                begun.append(replace(plant.scaled(self.base.plant.gain / plant.gain), inertia=plant.inertia))
        share = work / max(len(begun), 1)
        fits = in_processes(
            partial(self.likelihood.judged, iterations=SOME, allowance=share), begun, self.likelihood.tally
        )
        return [h for h in fits if h is not None]

    def ripple_beside(self, hypothesis: Hypothesis) -> Ripple:
        """Return the ripple of the mains that a simulation of `hypothesis` shows; none where that is impossible.

        An observer would follow the ripple, and so hide it.
        """
        return _once(self._ripples, hypothesis, self._ripple)

    def _ripple(self, hypothesis: Hypothesis) -> Ripple:
        likelihood = self.likelihood
        runs = likelihood.runs(likelihood.white, unpowered=hypothesis.unpowered)
        times = [run.instants for run in runs]
        with suppress(InputError, NumericalError):
            lines = likelihood.white.lines if likelihood.simulates else self._lines_beside(hypothesis)
            if lines:
                plants = [hypothesis.plant_of(i) for i in range(len(runs))]
                missed = [
                    run.missed(plant, start, substeps_for(plant, run.sample_time))
                    for run, plant, start in zip(runs, plants, hypothesis.starts, strict=True)
                ]
                return ripple_in(times, missed, lines)
        return ripple_in(times, [], ())

    def learn_ripple(self, hypothesis: Hypothesis) -> bool:
        """Count lines of the mains that show beside `hypothesis` as noise, and tell whether there are new ones."""
        white = self.likelihood.white
        new = set(self._lines_beside(hypothesis)) - set(white.lines)
        if new:
            self.likelihood.white = replace(white, lines=tuple(sorted({*white.lines, *new})))
            self.base = self.trials.base()
            self._dependent, self._ripples, self._everywhere = {}, {}, {}
        return bool(new)

    def _lines_beside(self, hypothesis: Hypothesis) -> tuple[float, ...]:
        """Return the lines of the mains that `hypothesis` leaves beside white noise.

        Coloured noise would whiten them, and an observer follow them: looked at is a simulation.
        """
        likelihood = self.likelihood
        if hypothesis.noise.rate > 0.0:
            hypothesis = likelihood.tried(hypothesis.plant, likelihood.white, SOME, like=hypothesis) or hypothesis
        noise = replace(hypothesis.noise.bleached(likelihood.white), lines=())
        test = ScoreTest(likelihood, replace(hypothesis, noise=noise))
        ends = np.cumsum([run.samples for run in test.runs])[:-1]
        return mains_lines(test.runs, np.split(test.left, ends))

    def is_enough(self, hypothesis: Hypothesis) -> bool:
        """Tell whether what `hypothesis` leaves does not depend on the inputs."""
        if self.likelihood.simulates:
            return False
        return not _once(self._dependent, hypothesis, self._depends)

    def is_enough_everywhere(self, hypothesis: Hypothesis) -> bool:
        """Tell whether what `hypothesis` leaves of all records, those held out as well, does not depend on the inputs.

        A second family of tests, at the rate of the first; its answer counts from then on. All records are asked
        together, for each may show a little, by strong draws: weak ones make a test too strict, and more so the more
        records there are. Where the noise is white it hides nothing, and they are not asked; nor of a wave, which has
        another phase in each; nor those that have no loop to simulate where the others have.
        """
        noise = hypothesis.noise
        is_white = noise.rate == 0.0 and noise.order == 0
        closed = all(record.has_loop for record in self.records)
        others = tuple(record for record in self.heldout if record.has_loop or not closed)
        is_asked = bool(others) and not is_white and not own_phases(hypothesis.plant)
        if is_asked and self.is_enough(hypothesis):
            holds = _once(self._everywhere, hypothesis, lambda h: self._beside(h, others))
            if not holds:
                self._dependent[id(hypothesis)] = hypothesis, True
        return self.is_enough(hypothesis)

    def _beside(self, hypothesis: Hypothesis, others: tuple[Record, ...]) -> bool:
        """Tell whether `hypothesis`, fitted to the `others` too, leaves nothing of all that depends on the inputs.

        Others that it cannot simulate say nothing of that.
        """
        every, held = copy(self), self.likelihood.on(others)
        every.records, every._with_strong_draws = (*self.records, *others), True
        every.likelihood = self.likelihood.on(every.records)
        every._dependent, every._ripples = {}, {}
        runs = held.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
        try:
            begun = [least_missed(run, hypothesis.plant, 0)[1] for run in runs]
        except (InputError, NumericalError):
            return True
        like = replace(hypothesis, starts=(*hypothesis.starts, *begun))
        found = every.likelihood.judged(hypothesis.plant, like, SOME, allowance=REFITTED) or like
        holds = every.is_enough(found)
        self.likelihood.tally.add(every.likelihood.work)
        return holds

    def explains(self, hypothesis: Hypothesis) -> bool:
        """Tell whether what `hypothesis` leaves is the noise that it claims: steady, and independent of the inputs."""
        return self.is_enough(hypothesis) and self.burst(hypothesis) is None

    def burst(self, hypothesis: Hypothesis) -> Burst | None:
        """Return the strongest burst of what `hypothesis` takes for shaking or slow noise; None where that is steady.

        Of a hypothesis that leaves nothing that depends on the inputs: the noise that it claims must be noise. Coarse
        steps of an encoder, which show no noise at rest, are not steady beside an observer either.
        """
        noise = hypothesis.noise
        is_steady = is_coarse(noise) if noise.rate > 0.0 else noise.order == 0
        if is_steady or not self.is_enough(hypothesis):
            return None
        likelihood = self.likelihood
        return _once(self._bursts, hypothesis, lambda h: burst_of(ScoreTest(likelihood, likelihood.whitened_well(h))))

    def _depends(self, hypothesis: Hypothesis) -> bool:
        """Ask the innovations; and the loops where the noise may have taken up what the model lacks.

        An observer that follows a shaken axis is an approximation, and so is rounding as an autoregressive process:
        what they leave is whitened as well as can be. Noise that moves the axis by a material part of its travel has to
        be shown, which only a loop that can be simulated can do; where there is none, simulations that miss as much may
        lack anything. Rounding is simulated, and hides nothing. Axes of which simulations diverge, as with cogging, are
        observed although nothing shakes them, and so are logs slower than their loops: the loop is asked as well.
        """
        noise = hypothesis.noise
        if noise.rate == 0.0 and noise.spread <= noise.least:
            return False
        closed = all(record.has_loop for record in self.records)
        is_rough = noise.rate > 0.0 or dominates(self.likelihood.white)
        asked = self.likelihood.whitened_well(hypothesis) if is_rough else hypothesis
        try:
            test = ScoreTest(self.likelihood, asked, with_strong_draws=self._with_strong_draws)
            if noise.is_model_error or depends_on_inputs(test):
                return True
        except NumericalError:  # what cannot be asked is not shown
            return True
        is_timed = all(record.ticks == 1 for record in self.records)
        if closed and noise.rate == 0.0 and noise.order == 0 and is_timed:
            return False
        plants = [hypothesis.plant_of(i) for i in range(len(self.records))]
        errors = [residual(plant, record) for plant, record in zip(plants, self.records, strict=True)]
        own = noise.spread if noise.rate == 0.0 and noise.order == 0 else self.likelihood.white.spread
        before = np.inf if test.unrounded is None else float(np.sqrt(np.mean(test.unrounded)))
        is_material = before > MATERIAL * self.travel and self.is_material(errors, own)
        if not closed:
            return is_material
        ripple = self.ripple_beside(hypothesis)
        ripples = [ripple.at(i, record.time) for i, record in enumerate(self.records)]
        of = plants, self.records, errors
        found = loop_error(*of, noise, self.likelihood.rate, ripples, test.unrounded)
        depends = found.depends or ((noise.rate > 0.0 or is_material) and not found.is_seen)
        if not depends or noise.rate == 0.0:
            return depends
        still = loop_error(*of, self.likelihood.white, self.likelihood.rate, ripples)
        return still.depends or still.is_larger

    def is_material(self, errors: Sequence[NDArray[np.float64]], noise: float) -> bool:
        """Tell whether `errors` of the training records are material, beyond a `noise` [m or rad]."""
        return pooled(errors) > float(np.hypot(noise, MATERIAL * self.travel))

    def noise_in_loop(self, hypothesis: Hypothesis) -> float:
        """Return what the sensor's noise makes simulations in closed loop miss if `hypothesis` is the axis, r.m.s.

        [m or rad]. The loop hands the noise on to the motor, and where a dead zone, dry friction or a play acts it
        moves the axis otherwise than without. Only of a model that leaves nothing else is the noise known; else 0.
        """
        if not (hypothesis.causes and all(r.has_loop for r in self.records) and self.is_enough(hypothesis)):
            return 0.0
        return _once(self._loop_noise, hypothesis, self._noise_in_loop)

    def _noise_in_loop(self, hypothesis: Hypothesis) -> float:
        plants = [hypothesis.plant_of(i) for i in range(len(self.records))]
        with suppress(InputError, NumericalError):  # what the records state of their loop may be wrong
            draws = drawn_loop_errors(plants, self.records, replace(hypothesis.noise, rate=0.0, corner=0.0))
            return float(np.sqrt(np.mean([pooled(draw) ** 2 for draw in draws]))) if draws else 0.0
        return 0.0

    def contradiction(self) -> Finding | None:
        """Return a finding if each record by itself is explained, but by gains that no single axis has.

        Explained by gain and damping, or with dry friction or a lag of the actuator beside them, the commonest of what
        a single step shows: more effects would explain anything.
        """
        if len(self.records) < 2 or (self.base.noise.rate == 0.0 and self.is_enough(self.base)):
            return None
        test = ScoreTest(self.likelihood, self.base)
        begun = [self.trials.starts(test, name)[:1] for name in (CoulombFriction.name, ActuatorLag.name)]
        structures = [self.base.plant, *(start.plant for starts in begun for start in starts)]
        plants = in_processes(partial(self._by_itself, structures), self.records, self.likelihood.tally)
        return apart([p for p in plants if p], [r.name for r in self.records]) if all(plants) else None

    def _by_itself(self, structures: Sequence[Plant], record: Record) -> Plant | None:
        """Return the first of the plants that explains one record, as a simulation; None where none does."""
        likelihood = self.likelihood.on([record])
        for plant in structures:
            with suppress(InputError, NumericalError):
                found = likelihood.judged(plant)
                is_simulation = found is not None and found.noise.rate == 0.0 and not found.noise.is_model_error
                if found is not None and is_simulation and not depends_on_inputs(ScoreTest(likelihood, found)):
                    return found.plant
        return None

    def gains(self, path: Sequence[Hypothesis], ends: Sequence[Plant] = ()) -> Gains:
        """Return the errors of the hypotheses, as `predict` has them, on training and held-out records.

        If there are any `ends`, those are the plants with which the fits of the first and the last hypothesis ended.
        """
        plants = [h.plant for h in path]
        if ends:
            plants[0], plants[-1] = ends[0], ends[-1]
        trained = tuple(tuple(residual(plant, record) for record in self.records) for plant in plants)
        in_phase = tuple(
            tuple(residual_in_phase(plant, record) for record in self.records) if own_phases(plant) else row
            for plant, row in zip(plants, trained, strict=True)
        )
        if self.heldout:
            held = tuple(tuple(residual(plant, record) for record in self.heldout) for plant in plants)
        else:
            held = tuple(
                tuple(
                    residual(plant, record)[cut:]
                    for plant, record, cut in zip(self.left_out(h), self.records, self.cuts, strict=True)
                )
                for h in path
            )
        return Gains(self.records, self.heldout, trained, held, self.noise_floor(path[-1]), in_phase)

    def misfit(self, hypothesis: Hypothesis) -> float:
        """Return −2 log-likelihood of the records, or ends of records, to which `hypothesis` was not fitted.

        Nothing is fitted there but initial states, and phases that each record has of its own.
        """
        if self.heldout:
            return self._on_heldout().misfit(hypothesis, [hypothesis.plant] * len(self.heldout))
        return self.left_out_misfit(hypothesis)

    def left_out_misfit(self, hypothesis: Hypothesis) -> float:
        """Return −2 log-likelihood of the training records, each predicted from the others or from its beginning."""
        return self.likelihood.misfit(hypothesis, self.left_out(hypothesis), self.cuts)

    def _on_heldout(self) -> Likelihood:
        """Return the likelihood of the records held out; made once."""
        if self._held is None:
            self._held = self.likelihood.on(self.heldout)
        return self._held

    def difference(self, one: Hypothesis, other: Hypothesis) -> float:
        """Return how far apart two hypotheses are on the records, or ends of records, to which they were not fitted.

        The squared distance of what they predict there, whitened: by about so much −2 log-likelihood would tell them
        apart if either were the axis.
        """
        likelihood = self._on_heldout() if self.heldout else self.likelihood
        cuts = [0] * len(self.heldout) or self.cuts
        pairs = [[h.plant] * len(self.heldout) if self.heldout else self.left_out(h) for h in (one, other)]
        total = 0.0
        for run, a, b, cut in zip(likelihood.runs(one.noise, unpowered=one.unpowered), *pairs, cuts, strict=True):
            seen = [run.missed(plant, run.start, substeps_for(plant, run.sample_time)) for plant in (a, b)]
            apart_by = run.whiten(seen[0] - seen[1])[cut // likelihood.every :]
            total += float(apart_by @ apart_by)
        return total

    @property
    def travel(self) -> float:
        """Largest range of the position [m or rad]."""
        return max(float(np.ptp(record.position)) for record in self.records)

    @property
    def cuts(self) -> list[int]:
        """First sample of each record that is held out where no record is: 0, or of one that is parted a later one."""
        return [
            max(int(KEPT * len(record)), 2) if len(self.records) == 1 or beyond(self._others(i), [record]) else 0
            for i, record in enumerate(self.records)
        ]

    def left_out(self, hypothesis: Hypothesis) -> list[Plant]:
        """Return, for each training record, the plant of `hypothesis` refitted without it."""
        jobs = list(zip(range(len(self.records)), self.cuts, strict=True))
        tally = self.likelihood.tally
        return _once(
            self._left_out, hypothesis, lambda h: in_processes(lambda job: self._without(h, *job), jobs, tally)
        )

    def _without(self, hypothesis: Hypothesis, i: int, cut: int) -> Plant:
        kept = [k for k in range(len(self.records)) if k != i]
        others = [self.records[k] for k in kept]
        if cut:
            record = self.records[i]
            others.append(record.slice(float(record.time[0]), float(record.time[cut - 1])))
            kept.append(i)
        try:
            found = self.likelihood.on(others).tried(
                hypothesis.plant,
                hypothesis.noise,
                SOME,
                like=hypothesis.of(kept),
                unpowered=hypothesis.unpowered,
                allowance=REFITTED,
            )
        except (InputError, NumericalError):
            found = None
        return hypothesis.plant if found is None else found.plant

    def _others(self, i: int) -> tuple[Record, ...]:
        return tuple(record for k, record in enumerate(self.records) if k != i)

    def noise_floor(self, chosen: Hypothesis) -> float:
        """Return the r.m.s. of sensor noise, a ripple of the mains and rounding together [m or rad].

        Of a model that leaves nothing else, what it leaves; what shakes the axis is not the sensor's. Else what a
        settled axis shows at the end of its steps, but no less than third differences do, and no more than the model
        leaves where nothing shakes the axis: one with play never settles.
        """
        ripple = self.ripple_beside(chosen).rms
        if self.is_enough(chosen):
            clock = float(np.mean([clock_error(chosen.noise, signals) ** 2 for signals in self.likelihood.signals]))
            return max(float(np.sqrt(chosen.noise.spread**2 + clock + ripple**2)), 1e-300)
        left = chosen.noise.spread if chosen.noise.rate == 0.0 and not self.likelihood.simulates else np.inf
        return max(self.likelihood.floor, ripple, min(resting_noise(self.records), left))


def _once(known: dict[int, tuple[Hypothesis, T]], hypothesis: Hypothesis, make: Callable[[Hypothesis], T]) -> T:
    """Return what is made of a hypothesis, or was made of it before."""
    found = known.get(id(hypothesis))
    if found is None:
        found = hypothesis, make(hypothesis)
        known[id(hypothesis)] = found
    return found[1]
