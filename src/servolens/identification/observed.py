"""One record as a prediction-error problem: an observer under the applied voltage, from an uncertain initial state."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.noise import Whitener
from servolens.identification.observer import observer_of
from servolens.identification.rounding import is_coarse
from servolens.identification.runs import ClosedLoop, as_simulated, begun, moved_start, within_reach
from servolens.identification.segments import applied_before
from servolens.simulation.circumstances import plant_in
from servolens.simulation.rates import substeps_for
from servolens.simulation.settings import COARSE
from servolens.simulation.trial import Trial, observed_trial

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.identification.signals import Signals
    from servolens.plant import Plant

__all__ = ["MOVED_IN_GAP", "ObservedRun", "SimulatedRun", "least_missed"]

MOVED = 1e-5
"""Share of the travel by which an initial state is moved for its sensitivity."""
MOVED_IN_GAP = 1e-2
"""Step of the unknown of a place within a gap for its sensitivity; the unknown is -1 and 1 at the ends."""


@final
class ObservedRun:
    """A record predicted sample by sample; what is missed is whitened, and the initial state is held to its prior.

    Parameters
    ----------
    signals : Signals
        The record.
    group : int
        Its number.
    noise : NoiseModel
        Gives the observer's rate and the whitening.
    unpowered : bool
        Whether nothing was applied before a record that does not say it; else its first voltage was.
    """

    def __init__(self, signals: Signals, group: int, noise: NoiseModel, *, unpowered: bool = False) -> None:
        signals = signals.unpowered() if unpowered else signals
        self.group, self.signals, self.noise = group, signals, noise
        self._observe()
        self.samples, self.simulated, self.instants = signals.measured.size, signals.time.size, signals.instants
        self.sample_time = signals.longest_step
        self.start = signals.initial.mean
        self._usual: NDArray[np.float64] | float = 0.0
        travel = MOVED * max(float(np.ptp(signals.position)), 1e-12)
        duration = max(float(signals.time[-1] - signals.time[0]), 1e-3)
        self.shifts = (travel, travel / duration, MOVED_IN_GAP)
        self._before = applied_before(signals.record)

    def _observe(self) -> None:
        """Choose the gains of the observer, and how what it misses is whitened."""
        signals, noise = self.signals, self.noise
        instants = (signals.time, signals.speed_on_grid, signals.voltage)
        rests = None if is_coarse(noise) else signals.rests_beside(noise)
        self._observer = observer_of(noise, *instants, signals.corrects, signals.mistimed, rests)
        weight = None if self._observer is None else self._observer.weight
        if weight is not None and signals.index is not None:
            weight = weight[signals.index]
        self.whiten = Whitener(signals.measured, signals.speed, noise, weight, time=signals.instants)

    def missed(
        self,
        plant: Plant,
        start: NDArray[np.float64],
        substeps: int,
        *,
        push: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return predicted minus measured position [m or rad], shape (n,); with a voltage `push` added, if any."""
        signals = self.signals
        trial = self._trial(signals.voltage if push is None else signals.voltage + push)
        run = trial.simulated(self._as_it_was(plant), as_simulated(start), substeps)
        found = run.measured - signals.position
        return found if signals.index is None else found[signals.index]

    def _trial(self, voltage: NDArray[np.float64]) -> Trial:
        observer, signals = self._observer, self.signals
        return observed_trial(
            signals.time,
            voltage,
            signals.position,
            gains=None if observer is None else observer.gains,
            remembered=0.0 if observer is None else observer.remembered,
            before=self._before,
            coarse=COARSE * self.noise.floor / self.sample_time,
        )

    def _as_it_was(self, plant: Plant) -> Plant:
        record = self.signals.record
        return plant if record.inertia is None and record.enabled is None else plant_in(plant, record)

    def less(self, usual: NDArray[np.float64]) -> ObservedRun:
        """Return the same run, of whose whitened difference so much is known beforehand, shape (n,)."""
        other = copy(self)
        other._usual = usual
        return other

    def measured_as(self, position: NDArray[np.float64], voltage: NDArray[np.float64]) -> ObservedRun:
        """Return the same run, observed alike, with another log of position and applied voltage, shape (n,) each."""
        other = copy(self)
        other.signals = self.signals.measured_as(position, voltage)
        return other

    def observed_anew(self) -> ObservedRun:
        """Return the same run, observed where its own log rests: another log of an axis rests elsewhere."""
        other = copy(self)
        other.signals = self.signals.at_rest_anew()
        other._observe()
        return other

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return the whitened difference, and how far the initial state is from its prior, in standard deviations."""
        away = self.signals.initial.away(start)
        return np.concatenate([self.whiten(self.missed(plant, start, substeps)) - self._usual, away])

    def residuals(
        self, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], substeps: int
    ) -> NDArray[np.float64]:
        """Return those of several plants of one structure, a row each; NaN where one cannot be simulated."""
        signals = self.signals
        those = [self._as_it_was(plant) for plant in plants]
        missed = self._trial(signals.voltage).measured(those, as_simulated(starts), substeps) - signals.position
        white = self.whiten((missed if signals.index is None else missed[:, signals.index]).T).T - self._usual
        return np.hstack([white, signals.initial.away(np.array(starts))])


@final
class SimulatedRun:
    """A record simulated in closed loop from its reference, as gains are predicted: for models that are not the axis.

    Parameters
    ----------
    signals : Signals
        Of a record with reference and controller.
    group : int
        Its number.
    noise : NoiseModel
        White, with the number of samples that count as one.
    unpowered : bool
        See :class:`ObservedRun`.
    """

    def __init__(self, signals: Signals, group: int, noise: NoiseModel, *, unpowered: bool = False) -> None:
        signals = signals.unpowered() if unpowered else signals
        self.group, self.signals, self.noise = group, signals, noise
        record = signals.record
        self.whiten = Whitener(record.position, np.zeros(len(record)), noise, time=record.time)
        self.samples = self.simulated = len(record)
        self.instants = record.time
        self._loop = ClosedLoop(record, COARSE * noise.floor)
        self.sample_time = self._loop.sample_time
        self.start: NDArray[np.float64] = np.empty(0)
        self.shifts: tuple[float, ...] = ()
        self._begin = (float(signals.initial.mean[0]), float(signals.initial.mean[1]))

    def missed(
        self,
        plant: Plant,
        start: NDArray[np.float64],
        substeps: int,
        *,
        push: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return simulated minus measured position [m or rad], shape (n,); with a voltage `push` added, if any.

        It begins as the first samples show; `start` is empty.
        """
        run = self._loop.simulated(plant, self._begin, substeps, push)
        return np.asarray(self._loop.logged(run.measured) - self.signals.record.position)

    def measured_as(self, position: NDArray[np.float64], voltage: NDArray[np.float64]) -> SimulatedRun:
        """Return the same run with another log of its position, shape (n,); no voltage drives it."""
        other = copy(self)
        other.signals = replace(self.signals, record=replace(self.signals.record, position=position))
        return other

    def observed_anew(self) -> SimulatedRun:
        """Return the same run: nothing observes it."""
        return self

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return the difference in standard deviations."""
        return self.whiten(self.missed(plant, start, substeps))

    def residuals(
        self, plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]], substeps: int
    ) -> NDArray[np.float64]:
        """Return those of several plants of one structure, a row each; NaN where one cannot be simulated."""
        missed = self._loop.measured(plants, self._begin, substeps) - self.signals.record.position
        return self.whiten(missed.T).T


def least_missed(run: ObservedRun | SimulatedRun, plant: Plant, begin: int) -> tuple[float, NDArray[np.float64]]:
    """Return the squared residual of `run` from sample `begin` on, from the best initial state of all, and that."""
    substeps, starts = substeps_for(plant, run.sample_time), begun(run, plant)

    def residual(start: NDArray[np.float64]) -> NDArray[np.float64] | None:
        try:
            return run.residual(plant, start, substeps)
        except (InputError, NumericalError):
            return None

    if len(starts) > 1:
        tried = run.residuals([plant] * len(starts), starts, substeps)[:, begin:]
        starts = [starts[int(np.argmin(np.nan_to_num(np.sum(tried**2, axis=1), nan=np.inf)))]]
    start, found = starts[0], residual(starts[0])
    while found is not None and start.size and (lower := _lower_start(residual, start, found, run.shifts)):
        start, found = lower
    least = np.inf if found is None else float(found[begin:] @ found[begin:])
    return least if np.isfinite(least) else np.inf, start


def _lower_start(
    residual: Callable[[NDArray[np.float64]], NDArray[np.float64] | None],
    start: NDArray[np.float64],
    found: NDArray[np.float64],
    shifts: Sequence[float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return an initial state that misses less than `start`, which misses `found`, and by what; None if none is seen.

    From rest dry friction swallows a small change of the velocity, so that its slope promises too much of far too long
    a step: that is shortened until it keeps something, or promises nothing any more. What changes −2 log-likelihood by
    less than one, with the size of the noise fitted as well, is nothing.
    """
    moves = [shift * unit for shift, unit in zip(shifts, np.eye(start.size), strict=False)]
    moved = [other for other in (residual(start + move) for move in moves) if other is not None]
    if len(moved) < len(moves):
        return None
    slopes = np.column_stack([(other - found) / move.sum() for other, move in zip(moved, moves, strict=True)])
    step, size = -np.linalg.lstsq(slopes, found, rcond=None)[0], float(found @ found)
    gain = size - float(np.sum((found + slopes @ step) ** 2))
    nothing = size / found.size
    while gain > nothing:
        trial = moved_start(start, within_reach(step))
        other = residual(trial)
        if other is not None and float(other @ other) < size - nothing:
            return trial, other
        step, gain = 0.5 * step, 0.5 * gain
    return None
