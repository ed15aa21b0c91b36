"""What of a record is simulated and compared, and what its first samples say of its initial state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.late_inputs import jumps_of
from servolens.identification.noise import NoiseModel
from servolens.identification.observer import observer_of
from servolens.identification.resting import resting
from servolens.identification.runs import rest
from servolens.identification.segments import applied_at, begins_with_its_step
from servolens.identification.smoothing import speed_of
from servolens.quality.beginning import initial_motion
from servolens.simulation.rates import substeps_for
from servolens.simulation.trial import observed_trial

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = ["WIDE", "InitialState", "Signals", "clock_error"]

FIRST = 12
"""Samples, at least, from which an initial velocity is read: as many as a cubic's smoothing derivative needs."""
WIDE = 3.0
"""Standard errors of what the first samples show that the initial state may be away: that is a prior."""
FOLLOWS = 8.0
"""Rate of the observer that tells the speed, in units of the loops' own: of a plant that is only about the axis."""


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
    sensor, rate : float
        Standard deviation of the sensor's white noise [m or rad], and rate of the loop [1/s].
    rests : ndarray of bool, shape (n,), or None
        Ticks at which something holds the axis; None of a log slower than its loop.
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
    sensor: float
    rate: float
    rests: NDArray[np.bool_] | None = None

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
        seen = cls(record, ticks, voltage, position, index, corrects, initial, is_unknown, speed, kicks, noise, rate)
        return seen.at_rest_anew()

    def at_rest_anew(self) -> Signals:
        """Return the same with where its position shows that something holds the axis; not where samples are lost."""
        if self.ticks.is_faster:
            return self
        rests = resting(self.position, self.sensor, self.rate * self.ticks.step)
        if self.ticks.index is not None:
            rests[np.setdiff1d(np.arange(rests.size), self.ticks.index)] = False
        return replace(self, rests=rests)

    def rests_beside(self, noise: NoiseModel) -> NDArray[np.bool_] | None:
        """Return where something holds the axis, if the shaking of `noise` would move one that nothing holds visibly.

        By more than the sensor's noise: ``ÿ + 2ω·ẏ + ω²·y = w`` turns a spectral density q into the variance q/(4·ω³).
        """
        moved = noise.rate**4 * self.ticks.step / (4.0 * self.rate**3)
        return self.rests if moved > 1.0 else None

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
