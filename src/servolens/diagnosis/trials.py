"""What hypotheses are tried on: every record driven by its voltage, weakly tied to what was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects import Drive, effect_class
from servolens.errors import InputError, NumericalError
from servolens.identification.options import FitOptions
from servolens.identification.phases import own_phases
from servolens.identification.refine import error_of, lead
from servolens.identification.regressors import regressor
from servolens.identification.runs import ClosedRun, TetheredRun, tether, voltage_runs
from servolens.identification.segments import motion_segments, moving_parts, noise_level
from servolens.identification.starting import Screen, seen_in
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect, Seen
    from servolens.identification.integral import Prior
    from servolens.identification.ranking import Proposals
    from servolens.identification.runs import Run
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["LAST", "LOOSE", "SECOND", "Hypothesis", "Trials", "loop_rate"]

STARTS, TELLING = 3, 2
"""Proposals of an effect from which it is fitted; records, the farthest off, on which they are compared."""
FIRST, SECOND, LAST = 3, 8, 30
"""Iterations from every start, from the best of them, and for a hypothesis that is worth it."""
MOST_SUBSTEPS = 12
"""In a millisecond; plants that need more are left out: what is so fast cannot be told from what is rigid."""
PRICE = 3.0
"""Of a parameter, over that of the Bayesian information criterion: residuals are never quite white."""
LOOSE = 0.5
"""Rate of the tether over that of the loops."""
RUNS_AWAY = 1.15
"""Times the error with the tether from which on an axis is held to run away without it."""
REACHED = 1.02
"""Times the noise at which a start needs no rival."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A plant fitted to the training records, and what it leaves there.

    Attributes
    ----------
    plant : Plant
        The best of its structure.
    error : float
        Root mean square error of the records driven by their voltage [m or rad].
    residuals : tuple of ndarray
        Simulated minus measured position, of a hypothesis that was judged; else none.
    tied : bool
        Whether it could be judged with the tether only.
    by_run : tuple of float
        Root mean square errors of each record, or of each stretch of them [m or rad].
    """

    plant: Plant
    error: float
    residuals: tuple[NDArray[np.float64], ...] = ()
    tied: bool = False
    by_run: tuple[float, ...] = ()

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects, in the order in which they were found."""
        return tuple(effect.name for effect in self.plant.effects)

    @property
    def free(self) -> int:
        """How many parameters were fitted."""
        return len(self.plant.parameters) - len(self.plant.derived)


@final
class Trials:
    """Training records made ready to try many hypotheses.

    Parameters
    ----------
    records : sequence of Record
        Runs of the same axis, each with its voltage or with what it is computed from.
    priors : mapping of str to Prior
        Knowledge from elsewhere, by qualified parameter name.
    seen : Seen, optional
        What all records of the campaign show, where `records` are a part of it.
    """

    def __init__(self, records: Sequence[Record], priors: Mapping[str, Prior], seen: Seen | None = None) -> None:
        self.records, self.priors = tuple(records), priors
        self.noise = float(np.sqrt(np.mean([noise_level(record) ** 2 for record in records])))
        segments = motion_segments(records)
        moving = moving_parts(segments)
        self.screen = Screen.of(moving)
        self.samples = sum(len(record) for record in records)
        bare, _ = self.screen.solve(())
        self.start = replace(
            bare,
            damping=max(bare.damping, 0.0),
            length_unit=records[0].length_unit,
            command_unit=records[0].command_unit,
        )
        self.seen = seen or seen_in(moving, self.start)
        self.tether = tether(self.start, LOOSE * loop_rate(self.start, records))
        self.runs: list[Run]
        if moving != segments and all(r.reference is not None and r.controller is not None for r in records):
            # an axis that sticks drifts off under its voltage alone
            self.runs = [ClosedRun(record, group) for group, record in enumerate(records)]
        else:
            self.runs = [TetheredRun(record, group, self.tether) for group, record in enumerate(records)]
        self.most_substeps = MOST_SUBSTEPS * max(1e3 * max(run.sample_time for run in self.runs), 1.0)
        self.untied = False
        self._free: list[Run] | None = None
        self._proposals: dict[str, Proposals] = {}

    def score(self, hypothesis: Hypothesis) -> float:
        """Return −2 log-likelihood plus the price of its parameters; the least is the best."""
        free = hypothesis.free + (len(self.records) - 1) * len(own_phases(hypothesis.plant))
        return self.samples * (hypothesis.error / self.noise) ** 2 + free * PRICE * float(np.log(self.samples))

    def fitted(self, plant: Plant, iterations: int = LAST) -> Hypothesis | None:
        """Return `plant` fitted; None where it cannot be simulated."""
        found = self._led(plant, self.runs, iterations)
        return None if found is None else replace(found, residuals=())

    def judged(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` fitted to the records driven by the voltage alone, where that can be.

        Only then is the residual of the right plant the sensor's noise and nothing else. An axis that runs away by
        itself stays tied; but once one hypothesis explains the records untied, all have to.
        """
        if hypothesis.residuals and not (hypothesis.tied and self.untied):
            return hypothesis
        if self._free is None:
            self._free = [*voltage_runs(self.records)]
        free = self._led(hypothesis.plant, self._free, LAST)
        if free is not None and free.error <= RUNS_AWAY * hypothesis.error:
            self.untied = True
        if free is not None and self.untied:
            return free
        tied = self._led(hypothesis.plant, self.runs, LAST)
        return hypothesis if tied is None else replace(tied, tied=True)

    def deepened(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis`, which was judged and has contacts, at the deepest fold of its valley that is found."""
        runs = self.runs if hypothesis.tied or self._free is None else self._free
        found = self._led(hypothesis.plant, runs, LAST, valleys=True)
        if found is None or found.error >= hypothesis.error:
            return hypothesis
        return replace(found, tied=hypothesis.tied)

    def _led(self, plant: Plant, runs: Sequence[Run], iterations: int, *, valleys: bool = False) -> Hypothesis | None:
        """Return `plant` fitted to the runs; None where it cannot be simulated, or one of its effects is hardly shown.

        Contacts crumple the error on a small scale: there wide differences find the way, and fine ones its end; with
        `valleys` they look for a deeper one.
        """
        found = None
        for coarse in ((True,) if iterations == FIRST else (True, False)) if plant.has_contacts else (False,):
            try:
                further = lead(
                    plant if found is None else found.plant,
                    runs,
                    self.options(plant),
                    noise=self.noise,
                    iterations=iterations,
                    coarse=coarse,
                    most_substeps=self.most_substeps,
                    valleys=valleys and not coarse,
                )
            except (InputError, NumericalError):
                break
            found = further if found is None or further.error < found.error else found
        if found is None or not all(effect.is_whole(self.seen) for effect in found.plant.effects):
            return None
        by_run = tuple(float(np.sqrt(np.mean(residual**2))) for residual in found.residuals)
        return Hypothesis(found.plant, found.error, found.residuals, by_run=by_run)

    def options(self, plant: Plant) -> FitOptions:
        """Return how `plant` is fitted: with the priors on its own parameters, and phases of each record's own."""
        names = plant.parameters
        priors = {name: prior for name, prior in self.priors.items() if name in names}
        return FitOptions(priors=priors, local=own_phases(plant) if len(self.records) > 1 else ())

    def extended(self, hypothesis: Hypothesis, name: str) -> Hypothesis | None:
        """Return `hypothesis` with the effect `name` beside its own, fitted from the effect's best starts.

        None where the two do not go together.
        """
        plant = hypothesis.plant
        cls = effect_class(name)
        if any(name in type(effect).generalises or effect.name == name for effect in plant.effects):
            return None
        for special in cls.generalises:
            plant = plant.without_effect(special)
        try:
            starts = [(start, FIRST) for start in self._starts(plant, cls)]
        except (InputError, NumericalError):
            return None
        best: Hypothesis | None = None
        for start, iterations in (
            *starts,
            *((start, SECOND) for start in _swapped(plant, cls, loop_rate(plant, self.records))),
        ):
            found = self.fitted(start, iterations)
            if found is not None and (best is None or found.error < best.error):
                best = found
            if best is not None and best.error < REACHED * self.noise:
                return best
        if best is not None and best.error > hypothesis.error and not best.plant.has_contacts:  # not there yet
            best = self.fitted(best.plant, SECOND) or best
        return best

    def _starts(self, plant: Plant, cls: type[Effect]) -> list[Plant]:
        """Return the plants with the effect that come closest as they are."""
        proposals = self.screen.proposals_of(plant, cls)
        if regressor(cls).sizes:
            tried = self._solved(plant, cls, proposals)
        else:
            tried = [plant.with_effect(effect) for effect in proposals]
            if issubclass(cls, Drive):  # its own loop takes over most of what seemed damping
                tried += [replace(start, damping=0.2 * plant.damping) for start in tried]
        tried = [start for start in tried if not self._is_too_stiff(start)]
        worst = sorted(self.runs, key=lambda run: -error_of(plant, [run], fine=False))[:TELLING]
        ranked = sorted((error_of(candidate, worst, fine=False), i) for i, candidate in enumerate(tried))
        return [tried[i] for _, i in ranked[:STARTS]]

    def _is_too_stiff(self, plant: Plant) -> bool:
        """Tell whether `plant` would not be fitted, so that its simulation, which may take long, is for nothing."""
        return any(substeps_for(plant, run.sample_time) > self.most_substeps for run in self.runs)

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


def loop_rate(plant: Plant, records: Sequence[Record]) -> float:
    """Return about how fast the loops are [rad/s]; of records without gains, how fast they are logged to be."""
    rates = [abs(plant.gain * r.controller.kp) ** 0.5 for r in records if r.controller is not None]
    return float(np.median(rates)) if rates else 10.0 / float(np.median([r.duration for r in records]))
