"""One record as a prediction-error problem: an observer under the applied voltage, from an uncertain initial state."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.late_inputs import jumps_of
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.observer import observer_of
from servolens.identification.runs import ClosedLoop, as_simulated, begun, moved_start, rest, within_reach
from servolens.identification.segments import applied_at, applied_before, begins_with_its_step
from servolens.identification.smoothing import speed_of
from servolens.quality.beginning import initial_motion
from servolens.simulation.circumstances import plant_in
from servolens.simulation.rates import substeps_for
from servolens.simulation.trial import Trial, observed_trial

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = ["MOVED_IN_GAP", "InitialState", "ObservedRun", "Signals", "SimulatedRun", "clock_error", "least_missed"]

FIRST = 12
"""Samples, at least, from which an initial velocity is read: as many as a cubic's smoothing derivative needs."""
WIDE = 3.0
"""Standard errors of what the first samples show that the initial state may be away: that is a prior."""
COARSE = 1e-4
"""Share of the noise by which a simulated sample may be wrong."""
FOLLOWS = 8.0
"""Rate of the observer that tells the speed, in units of the loops' own: of a plant that is only about the axis."""
MOVED = 1e-5
"""Share of the travel by which an initial state is moved for its sensitivity."""
MOVED_IN_GAP = 1e-2
"""Step of the unknown of a place within a gap for its sensitivity; the unknown is -1 and 1 at the ends."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class InitialState:
    """Position and velocity at the first sample: mean and standard deviation, each of shape (2,).

    With backlash an initial state has a third number, from which the place of the motor within the gap follows; see
    :func:`servolens.identification.runs.begun`. Before it is fitted, its mean is 0 and its standard deviation 1.
    """

    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @classmethod
    def of(cls, record: Record, noise: float) -> InitialState:
        """Read it off the first samples of `record`, whose noise has the standard deviation `noise`."""
        still = rest(record)
        count = min(max(still, FIRST), len(record))
        span = record.time[:count] - record.time[0]
        duration = max(float(span[-1]), 1e-9)
        floor = 1e-6 * max(float(np.ptp(record.position)), 1e-12)
        slope_error = np.sqrt(12.0 / count) * max(noise, floor) / duration
        velocity = 0.0 if still > 1 else initial_motion(record)
        if still == 1:  # cubics disagree: at rest and pushed off at once, or cut out of a motion
            slope_error += abs(_slope(record, count) - velocity) / WIDE
        level = float(np.mean(record.position[:still]))
        return cls(np.array([level, velocity]), WIDE * np.array([max(noise, floor), slope_error]))

    def away(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far initial states, shape (…, 2 or 3), are from this one, in standard deviations."""
        return np.concatenate([(start[..., :2] - self.mean) / self.deviation, start[..., 2:]], axis=-1)


def _slope(record: Record, count: int) -> float:
    """Return the velocity at the first sample, of a parabola through the first `count`."""
    span = record.time[:count] - record.time[0]
    return float(np.polyfit(span, record.position[:count], min(2, count - 1))[-2])


@final
@dataclass(frozen=True, eq=False)
class Signals:
    """What of a record is simulated, and which of its samples are compared: every few of a long one.

    Attributes
    ----------
    record : Record
        Where it comes from.
    ticks : Ticks
        At which it is simulated.
    voltage, position : ndarray, shape (n,)
        At the ticks.
    index : ndarray of int or None
        Ticks that are compared; None if all are.
    corrects : ndarray of bool, shape (n,), or None
        Ticks whose position corrects an observer; None if all do.
    initial : InitialState
        Of the first sample.
    may_be_unpowered : bool
        Whether the record begins with its step and does not say what was applied before: that may be nothing.
    speed_on_grid : ndarray, shape (n,)
        Of the axis at all samples that are simulated [m/s or rad/s].
    mistimed : ndarray, shape (n,), or None
        Error of its velocity, a standard deviation, for the voltage jumped a tick sooner or later than it is said to
        in a log slower than its loop [m/s or rad/s].
    """

    record: Record
    ticks: Ticks
    voltage: NDArray[np.float64]
    position: NDArray[np.float64]
    index: NDArray[np.intp] | None
    corrects: NDArray[np.bool_] | None
    initial: InitialState
    may_be_unpowered: bool
    speed_on_grid: NDArray[np.float64]
    mistimed: NDArray[np.float64] | None

    @classmethod
    def of(cls, record: Record, noise: float, plant: Plant, rate: float, every: int = 1) -> Signals:
        """Prepare `record`, every so many samples of it; its axis is about like `plant`, its loop as fast as `rate`."""
        ticks = record.loop_ticks()
        index, corrects = ticks.index, _correcting(ticks, every)
        if every > 1:
            index = (np.arange(ticks.time.size) if index is None else index)[::every]
        voltage, position = applied_at(record, ticks), ticks.motion(record.position)
        initial = InitialState.of(record, noise)
        speed = _observed_speed(plant, rate, ticks.time, voltage, position, initial)
        kicks = _mistimed(plant, ticks, voltage)
        is_unknown = begins_with_its_step(record)
        return cls(record, ticks, voltage, position, index, corrects, initial, is_unknown, speed, kicks)

    def unpowered(self) -> Signals:
        """Return the same record as one before which nothing was applied, where it does not say what was."""
        is_open = self.record.voltage_before is None
        return replace(self, record=replace(self.record, voltage_before=0.0)) if is_open else self

    def measured_as(self, position: NDArray[np.float64], voltage: NDArray[np.float64]) -> Signals:
        """Return the same record with another `position` and applied `voltage` at its samples, shape (n,) each."""
        other = replace(self.record, position=position, voltage=voltage)
        return replace(self, position=self.ticks.motion(position), voltage=applied_at(other, self.ticks))

    @property
    def time(self) -> NDArray[np.float64]:
        """Of the ticks [s]."""
        return self.ticks.time

    @property
    def longest_step(self) -> float:
        """From one tick to the next [s]."""
        return float(np.max(np.diff(self.time)))

    @property
    def speed(self) -> NDArray[np.float64]:
        """Of the axis at the samples that were measured [m/s or rad/s]."""
        return self.speed_on_grid if self.index is None else self.speed_on_grid[self.index]

    @property
    def instants(self) -> NDArray[np.float64]:
        """Of the samples that are compared [s]."""
        return self.time if self.index is None else self.time[self.index]

    @property
    def measured(self) -> NDArray[np.float64]:
        """Positions that were measured."""
        return self.position if self.index is None else self.position[self.index]


def _correcting(ticks: Ticks, every: int) -> NDArray[np.bool_] | None:
    """Return which ticks correct an observer, where every so many samples are compared; None if all do.

    Then those that are compared and no others, so that a simulation and an observer are judged by the same samples: of
    slow noise an observer that sees more of it would miss less. Where more samples were lost than lie between two that
    are compared the voltage is not known for long: there the axis is led along what was measured, interpolated.
    """
    if every == 1 and not ticks.is_faster:
        return None
    count = ticks.time.size
    logged = np.arange(count) if ticks.index is None else ticks.index
    found = np.zeros(count, dtype=np.bool_)
    if not ticks.is_faster:
        found[:-1] = np.repeat(np.diff(logged) > every, np.diff(logged))
    found[logged] = False
    found[logged[::every]] = True
    return found


def _mistimed(plant: Plant, ticks: Ticks, voltage: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return by how much a tick of a jump's voltage moves the velocity of about such a plant; None without any."""
    if ticks.jumps is None or not ticks.jumps.size:
        return None
    came = ticks.jumps[:, 1]
    found = np.zeros(ticks.time.size)
    found[came] = ticks.step * np.abs(plant.gain * (voltage[came] - voltage[came - 1]))
    return found


def _observed_speed(
    plant: Plant,
    rate: float,
    time: NDArray[np.float64],
    voltage: NDArray[np.float64],
    position: NDArray[np.float64],
    initial: InitialState,
) -> NDArray[np.float64]:
    """Return the velocity of an observer, which knows when the voltage steps: smoothing the position does not."""
    noise = replace(NoiseModel.white(1.0), rate=FOLLOWS * rate, corner=1e3 * rate, damping=max(plant.damping, 0.0))
    observer = observer_of(noise, time, time, voltage)
    assert observer is not None  # noqa: S101 - of this noise there is one
    try:
        trial = observed_trial(time, voltage, position, gains=observer.gains)
        return trial.simulated(plant, initial.mean.tolist(), substeps_for(plant, float(np.max(np.diff(time))))).velocity
    except (InputError, NumericalError):
        return speed_of(time, position)


def clock_error(noise: NoiseModel, signals: Signals) -> float:
    """Return the r.m.s. position error that instants which are not stated cause in a simulated loop [m or rad].

    A late reading is off by the way of the axis; a late input changes its velocity, which the loop
    ``ÿ + C·ẏ + K·y = w`` turns into the variance q/(2·C·K) where w is white with the spectral density q (S. H. Crandall
    and W. D. Mark, *Random Vibration in Mechanical Systems*, 1963, section 2.2).
    """
    read = noise.jitter**2 * float(np.mean(signals.speed**2))
    controller = signals.record.controller
    if controller is None or noise.jitter == 0.0 or noise.gain == 0.0:
        return float(np.sqrt(read))
    jumps = jumps_of(noise, signals.time, signals.speed_on_grid, signals.voltage)
    density = noise.jitter**2 * float(np.sum(jumps**2)) / float(signals.time[-1] - signals.time[0])
    stiffness, damping = noise.gain * controller.kp, noise.damping + noise.gain * controller.kd
    if not stiffness * damping > 0.0:  # nothing calls it back
        return float(np.sqrt(read))
    return float(np.sqrt(read + density / (2.0 * stiffness * damping)))


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
        instants = (signals.time, signals.speed_on_grid, signals.voltage)
        self._observer = observer_of(noise, *instants, signals.corrects, signals.mistimed)
        weight = None if self._observer is None else self._observer.weight
        if weight is not None and signals.index is not None:
            weight = weight[signals.index]
        self.whiten = Whitener(signals.measured, signals.speed, noise, weight, time=signals.instants)
        self.samples, self.simulated, self.instants = signals.measured.size, signals.time.size, signals.instants
        self.sample_time = signals.longest_step
        self.start = signals.initial.mean
        self._usual: NDArray[np.float64] | float = 0.0
        travel = MOVED * max(float(np.ptp(signals.position)), 1e-12)
        duration = max(float(signals.time[-1] - signals.time[0]), 1e-3)
        self.shifts = (travel, travel / duration, MOVED_IN_GAP)
        self._before = applied_before(signals.record)

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
        self._loop = ClosedLoop(record)
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
