"""Score tests: what each effect would explain to first order, at the cost of one linearisation of the null."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.phases import own_phases
from servolens.identification.restricted import parts_of
from servolens.identification.rounding import DRAWS, LOOPS, has_mean, is_rounded, logged, own_spectra, parted, rounded
from servolens.identification.shaken import at_least_white, shaken
from servolens.identification.signals import WIDE
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.identification.restricted import Part
    from servolens.plant import Plant

__all__ = ["FALSE_ALARM", "PERTURBED", "ScoreTest", "free_of"]

FALSE_ALARM = 1e-3
"""Familywise error rate: probability that any of all that is tried enters a model that lacks none."""

PERTURBED = 0.05
"""Share of its largest by which sizes are moved: dry friction's effect on a standing axis comes in steps."""


@final
class ScoreTest:
    """The whitened residual of a hypothesis, and the directions that its own parameters and initial states explain.

    Rao's score (Lagrange multiplier) test of Gaussian regression: the statistic of a direction z is the squared length
    of the residual along what of z is at right angles to the hypothesis' own directions (Rao 1948; Engle 1984).

    Parameters
    ----------
    likelihood : Likelihood
        Of the records.
    hypothesis : Hypothesis
        The null, at its optimum.
    with_strong_draws : bool
        Whether draws of a shaken axis are made no weaker than white noise (:attr:`strong`).

    Attributes
    ----------
    left : ndarray, shape (n,)
        The whitened residual at right angles to the hypothesis' own directions, less the draws' mean.
    """

    def __init__(self, likelihood: Likelihood, hypothesis: Hypothesis, *, with_strong_draws: bool = False) -> None:
        self._with_strong_draws = with_strong_draws
        self.hypothesis, self.rate, self._count = hypothesis, likelihood.rate, likelihood.tally.add
        self.runs = likelihood.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
        self._ends = np.cumsum([0, *(run.samples for run in self.runs)])
        self._options = likelihood.options(hypothesis.plant)
        parts = self._linearised(self.runs)
        self.residual = np.concatenate([part.left for part in parts])
        self._own = _basis(parts)
        self._draws: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None
        self.left = self._less_mean(self.residual)  # now: jobs that share a test shall not wait for its draws

    def _linearised(self, runs: Sequence[ObservedRun | SimulatedRun]) -> list[Part]:
        """Return what the hypothesis leaves of `runs`, and how that answers to its parameters and initial states."""
        problem = Problem(self.hypothesis.plant, runs, self._options, 1.0)
        parts = parts_of(problem, problem.at(self.hypothesis.starts, self.hypothesis.local))
        self._count(problem.simulated)
        return parts

    @property
    def is_drawn(self) -> bool:
        """Whether chance is not that of white noise, and is drawn: rounding or shaking are part of the noise."""
        return is_rounded(self.hypothesis.noise) or self.hypothesis.noise.rate > 0.0

    @cached_property
    def unrounded(self) -> NDArray[np.float64] | None:
        """Spectra of the sensor's noise before the encoder rounds it, of each draw; None where it does not."""
        if not is_rounded(self.hypothesis.noise):
            return None
        plants = [self.hypothesis.plant_of(i) for i in range(len(self.runs))]
        return own_spectra(self.runs, plants, self.hypothesis.starts)

    @property
    def drawn(self) -> NDArray[np.float64]:
        """Draws of the whitened residual if the hypothesis is the axis, as :attr:`left` is, shape (n, draws)."""
        return self.strong if self._with_strong_draws else self._parts_of_draws[1]

    @property
    def strong(self) -> NDArray[np.float64]:
        """The draws, of a shaken axis no weaker than white noise in any octave, shape (n, draws).

        An observer finds less shaking than there is where friction holds the axis part of the time: then draws of it
        have too little power at low frequencies.
        """
        return self._parts_of_draws[2]

    @property
    def _parts_of_draws(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        if self._draws is None:
            self._draws = self._drawn()
        return self._draws

    def _drawn(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the draws' mean, shape (n,), 0 where they have none, what else is in each, and that made strong."""
        noise, starts = self.hypothesis.noise, self.hypothesis.starts
        if not self.is_drawn:
            white = self.free_of_own(np.random.default_rng(4).standard_normal((self.residual.size, DRAWS)))
            return np.zeros(self.residual.size), white, white
        plants = [self.hypothesis.plant_of(i) for i in range(len(self.runs))]
        if self.unrounded is not None:
            drawn = rounded(self.runs, plants, starts, self.unrounded)
        else:
            drawn = shaken(self.runs, plants, starts)
        means = [np.zeros(draws.shape[0]) for draws in drawn]
        if has_mean(self.runs):
            means, drawn = map(list, zip(*map(parted, self.runs, drawn), strict=True))
        self._count(self.residual.size * (LOOPS if is_rounded(noise) else 2 * DRAWS))  # a loop, and an observer of it
        mean, rest = (self.free_of_own(np.concatenate(parts)) for parts in (means, drawn))
        if noise.rate == 0.0:
            return mean, rest, rest
        return mean, rest, self.free_of_own(np.concatenate([at_least_white(draws) for draws in drawn]))

    def _less_mean(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        free = self.free_of_own(residual)
        return free - self._parts_of_draws[0] if has_mean(self.runs) else free

    def free_of_own(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `columns`, shape (n,) or (n, k), without what the hypothesis' own parameters explain."""
        return free_of(self._own, columns)

    def own_along(self, runs: Sequence[ObservedRun | SimulatedRun]) -> NDArray[np.float64]:
        """Return an orthonormal basis, shape (n, p), of what the hypothesis' own parameters do along other `runs`.

        Of the same records, with another log of position and voltage.
        """
        return _basis(self._linearised(runs))

    def gain(self, plant: Plant) -> float:
        """Return the score statistic of the direction from the hypothesis to `plant`; 0 where it has no simulation.

        Or what `plant` gains as it is, where that is more: an effect as large as friction that holds the axis for
        seconds is far from what a first order tells. Then each record begins as its own first samples show, if it is
        missed less so: the initial states of the hypothesis make up for what it lacks.
        """
        try:
            missed = self._missed(plant)
            columns = self._columns(plant, missed)
            reached = self._less_mean(self._missed_least(plant, self._split(missed), self.runs))
        except (InputError, NumericalError):
            return 0.0
        gained = float(self.left @ self.left) - float(reached @ reached)
        return float(np.fmax(self.explained(columns), gained))

    def free_columns(self, plant: Plant) -> NDArray[np.float64]:
        """Return what the change to `plant` would do, without what the hypothesis explains itself, shape (n, k).

        Nothing, shape (n, 0), where it has no simulation.
        """
        try:
            return self._beside_own(self._columns(plant, self._missed(plant)))
        except (InputError, NumericalError):
            return np.empty((self.residual.size, 0))

    def gain_of_sizes(self, plant: Plant, sizes: Sequence[str]) -> float:
        """Return the score statistic of the last effect's `sizes`, each free, about where `plant` is; else 0.

        Of an effect that generalises one of the hypothesis: there `plant` does what the hypothesis does.
        """
        effect, index = plant.effects[-1], len(plant.driven_values) - len(plant.effects[-1].values)
        names = [spec.name for spec in effect.parameters()]
        step = PERTURBED * max((abs(getattr(effect, name)) for name in sizes), default=0.0)
        try:
            here = self._missed(plant)
            columns = []
            for name in sizes:
                values = list(plant.values)
                values[index + names.index(name)] += step
                columns.append(self._missed(plant.with_values(values)) - here)
        except (InputError, NumericalError):
            return 0.0
        return self.explained(np.column_stack(columns)) if columns else 0.0

    def may_be_chance(self, plant: Plant, paid: float) -> bool:
        """Tell whether what the direction to `plant` gains is no more than is `paid` for it, or than chance may gain.

        By Student's t of the draws, at the level of all decisions.

        Raises
        ------
        NumericalError
            If `plant` has no simulation.
        """
        from scipy.stats import t

        drawn = self._gains_drawn(plant)
        if drawn.size > DRAWS // 2:
            limit = float(t.isf(0.5 * FALSE_ALARM, drawn.size - 1)) ** 2
            return self._beyond(plant, drawn) < max(paid, limit)
        return self.gain(plant) / self._inflation(plant) < max(paid, float(t.isf(0.5 * FALSE_ALARM, DRAWS)) ** 2)

    def _gains_drawn(self, plant: Plant) -> NDArray[np.float64]:
        """Return what `plant` gains of logs of the hypothesis, where an encoder rounds what its loops see; else none.

        A loop answers to its encoder's rounding, and the voltage knows of it: at rest the axis goes to and fro where
        the encoder shows nothing, and a plant that answers less to the voltage misses less. So each draw is a log of
        its own (Cox 1961, tests of separate families of hypotheses; with simulated logs, Williams 1970).
        """
        found: list[float] = []
        if self.unrounded is None or not all(run.signals.record.has_loop for run in self.runs):
            return np.array(found)
        plants = [self.hypothesis.plant_of(i) for i in range(len(self.runs))]
        for runs in logged(self.runs, plants, self.hypothesis.starts, self.unrounded):
            with suppress(InputError, NumericalError):
                parts = self._linearised(runs)
                of_each = enumerate(zip(runs, self.hypothesis.starts, strict=True))
                reached = self._missed_least(
                    plant, [self._part(plant, i, start, run) for i, (run, start) in of_each], runs
                )
                own = _basis(parts)
                left, other = free_of(own, np.concatenate([part.left for part in parts])), free_of(own, reached)
                found.append(float(left @ left - other @ other))
        return np.array([gain for gain in found if np.isfinite(gain)])

    def _beyond(self, plant: Plant, drawn: NDArray[np.float64]) -> float:
        """Return by how many standard deviations, squared, `plant` gains more than was `drawn`; less than none is none.

        The draws scatter no less than what white noise does to it.

        Raises
        ------
        NumericalError
            If `plant` has no simulation.
        """
        missed = self._missed(plant)
        left, reached = (
            self.free_of_own(self.residual),
            self.free_of_own(self._missed_least(plant, self._split(missed), self.runs)),
        )
        least = 2.0 * float(np.linalg.norm(self.free_of_own(missed - self.residual)))
        spread = max(float(np.std(drawn, ddof=1)) * np.sqrt(1.0 + 1.0 / drawn.size), least, 1e-300)
        return float(max(left @ left - reached @ reached - np.mean(drawn), 0.0) / spread) ** 2

    def _inflation(self, plant: Plant) -> float:
        """Return the variance of rounded noise along the direction to `plant`, in units of white noise's; at least 1.

        Raises
        ------
        NumericalError
            If `plant` has no simulation.
        """
        direction = self.free_of_own(self._missed(plant) - self.residual)
        along = direction @ self.drawn
        return max(float(np.mean(along**2)) / max(float(direction @ direction), 1e-300), 1.0)

    def pushed(self, forces: Sequence[NDArray[np.float64]], size: float) -> NDArray[np.float64]:
        """Return what `forces`, one array a record, would do to the residual, to first order, shape (n,).

        Parameters
        ----------
        forces : sequence of ndarray
            On the grid that is simulated, of size about 1.
        size : float
            Voltage by which a force of 1 is stood for.
        """
        parts, first = [], 0
        for i, (run, start, force) in enumerate(zip(self.runs, self.hypothesis.starts, forces, strict=True)):
            plant = self.hypothesis.plant_of(i)
            missed = run.missed(plant, start, substeps_for(plant, run.sample_time), push=size * force)
            parts.append(run.whiten(missed) - self.residual[first : first + run.samples])
            first += run.samples
        return np.concatenate(parts)

    def explained(self, columns: NDArray[np.float64]) -> float:
        """Return how much of the squared residual the `columns`, shape (n, k), explain beside the hypothesis."""
        free = self._beside_own(columns)
        if free.shape[1] == 0:
            return 0.0
        q, _ = np.linalg.qr(free / np.linalg.norm(free, axis=0))
        along = q.T @ self.left
        return float(along @ along)

    def _beside_own(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what the hypothesis does not explain itself of `columns`, without those of which that is nothing."""
        free = self.free_of_own(columns)
        sizes = np.linalg.norm(free, axis=0)
        return free[:, sizes > 1e-9 * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)]

    def _columns(self, plant: Plant, missed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the differences of what `plant` and the hypothesis miss; of a wave, for each record and two phases."""
        names = own_phases(plant)
        new = [name for name in names if name not in own_phases(self.hypothesis.plant)]
        if not new or len(self.runs) == 1:
            return np.asarray((missed - self.residual)[:, None])
        index = list(plant.parameters).index(new[0])
        turned = list(plant.values)
        turned[index] += 0.5 * np.pi if turned[index] < 0.0 else -0.5 * np.pi
        found = [one - self.residual for one in (missed, self._missed(plant.with_values(turned)))]
        columns = np.zeros((self.residual.size, 2 * len(self.runs)))
        for i in range(len(self.runs)):
            rows = slice(self._ends[i], self._ends[i + 1])
            columns[rows, 2 * i], columns[rows, 2 * i + 1] = found[0][rows], found[1][rows]
        return columns

    def _missed_least(
        self, plant: Plant, missed: list[NDArray[np.float64]], runs: Sequence[ObservedRun | SimulatedRun]
    ) -> NDArray[np.float64]:
        """Return what is `missed` of all `runs` from the hypothesis' initial states, or less from a run's own guess."""
        found = list(missed)
        for i in self._begun_elsewhere:
            with suppress(InputError, NumericalError):
                other = self._part(plant, i, runs[i].start, runs[i])
                found[i] = found[i] if float(found[i] @ found[i]) <= float(other @ other) else other
        return np.concatenate(found)

    def _split(self, missed: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return what is `missed` of all, shape (n,), of each run."""
        return np.split(missed, self._ends[1:-1])

    @cached_property
    def _begun_elsewhere(self) -> list[int]:
        """Which runs the hypothesis begins elsewhere than their first samples show, by more than chance."""
        from scipy.stats import chi2

        far = []
        for i, (run, start) in enumerate(zip(self.runs, self.hypothesis.starts, strict=True)):
            if run.start.size:
                away = WIDE * run.signals.initial.away(start)[:2]
                far += [i] if float(away @ away) > chi2.isf(FALSE_ALARM, away.size) else []
        return far

    def _parts(self, plant: Plant, starts: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        return [self._part(plant, i, start) for i, start in enumerate(starts)]

    def _part(
        self, plant: Plant, i: int, start: NDArray[np.float64], run: ObservedRun | SimulatedRun | None = None
    ) -> NDArray[np.float64]:
        """Return what `plant` misses of a run that begins at `start`, or of another log of it, whitened."""
        run = run or self.runs[i]
        return run.whiten(run.missed(self._of_record(plant, i), start, substeps_for(plant, run.sample_time)))

    def _missed(self, plant: Plant) -> NDArray[np.float64]:
        found = np.concatenate(self._parts(plant, self.hypothesis.starts))
        if not np.isfinite(found).all():
            raise NumericalError("the simulation of the axis diverges")
        return found

    def _of_record(self, plant: Plant, group: int) -> Plant:
        """Return `plant` with what the hypothesis knows of this record alone."""
        local = self.hypothesis.local
        if not local:
            return plant
        values = plant.named
        own = {name: float(found[group]) for name, found in local.items() if name in values}
        return plant.with_values(list({**values, **own}.values()))


def free_of(basis: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `columns`, shape (n,) or (n, k), at right angles to an orthonormal `basis`, shape (n, p)."""
    once = columns - basis @ (basis.T @ columns)
    return np.asarray(once - basis @ (basis.T @ once))


def _basis(parts: Sequence[Part]) -> NDArray[np.float64]:
    """Return an orthonormal basis of the sensitivities, shape (n, p)."""
    columns = np.concatenate([part.sensitivity for part in parts])
    sizes = np.linalg.norm(columns, axis=0)
    return np.asarray(np.linalg.qr(columns[:, sizes > 0.0] / sizes[sizes > 0.0])[0])
