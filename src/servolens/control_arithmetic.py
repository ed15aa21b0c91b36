"""What a digital controller makes of sampled signals: error, derivative, integral, command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.clock import cycles_passed
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.controller import Controller

    Signal = NDArray[np.float64]

__all__ = ["Answer", "LoopSignals", "answer", "samples_a_period", "samples_a_tick", "steps_of", "ticks_a_sample"]

MOST_TICKS = 1000
"""Of a loop from one sample to the next: a log a thousand times slower than its loop shows nothing of it."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopSignals:
    """What a loop was given, sample by sample.

    Attributes
    ----------
    time, reference, position : ndarray, shape (n,)
        [s], [m or rad].
    sample_time : float
        Nominal interval [s].
    velocity : ndarray, shape (n,), or None
        A velocity of the loop's own [m/s or rad/s].
    added : ndarray, shape (n,), or None
        Added to the command [V].
    limit : float or None
        Of the command, for a law against windup [V].
    """

    time: Signal
    reference: Signal
    position: Signal
    sample_time: float
    velocity: Signal | None = None
    added: Signal | None = None
    limit: float | None = None


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What the law makes of it, held between the ticks of a loop slower than the log.

    ``V = kp error − kd derivative + ahead + integral``, without what is added to it.

    Attributes
    ----------
    error, derivative : ndarray, shape (n,)
        Reference less position [m or rad]; [m/s or rad/s].
    ahead : ndarray, shape (n,)
        What the reference alone is given beside kp r: set-point weight and feedforward of its velocity [V].
    integral : ndarray, shape (n,)
        As it is in V [V].
    remembered : ndarray, shape (n,)
        The integral that each sample leaves to the next, corrected by back-calculation [V].
    """

    error: Signal
    derivative: Signal
    ahead: Signal
    integral: Signal
    remembered: Signal

    def command(self, controller: Controller) -> Signal:
        """Return V, without what is added to it [V]."""
        return controller.kp * self.error - controller.kd * self.derivative + self.ahead + self.integral


def answer(controller: Controller, seen: LoopSignals) -> Answer:
    """Return what `controller` makes of `seen`.

    A difference across lost samples is divided by the time that really passed.

    Raises
    ------
    InputError
        If the loop needs a velocity that was not seen, or its period is no multiple of the sample time.
    """
    ticks = _ticks(controller, seen)
    period = seen.sample_time if controller.control_period is None else controller.control_period
    period = seen.sample_time if ticks is None else period
    at = slice(None) if ticks is None else ticks
    time, reference, position = seen.time[at], seen.reference[at], seen.position[at]
    error = reference - position
    measures = controller.time_step == "measured"
    slope = _differences(reference, time, 1, period, measures=measures)
    if controller.derivative == "velocity":
        if seen.velocity is None:
            raise InputError("the loop used a velocity of its own (derivative = velocity); log it")
        raw = seen.velocity[at]
    else:
        signal = position - reference if controller.derivative_on == "error" else position
        raw = _differences(signal, time, controller.derivative_window, period, measures=measures)
    derivative = _filtered(raw, controller.derivative_filter)
    ahead = controller.kp * (controller.setpoint_weight - 1.0) * reference + controller.velocity_feedforward * slope
    command = controller.kp * error - controller.kd * derivative + ahead
    added = None if seen.added is None else seen.added[at]
    integral, left = _integral(controller, steps_of(controller, time, period), (error, command), added, seen.limit)
    found = {"error": error, "derivative": derivative, "ahead": ahead, "integral": integral, "remembered": left}
    if ticks is not None:
        held = np.searchsorted(ticks, np.arange(seen.time.size), side="right") - 1
        found = {name: signal[held] for name, signal in found.items()}
    return Answer(**found)


def steps_of(controller: Controller, time: Signal, period: float) -> Signal:
    """Return h of the law at the ticks `time`, shape (n,): the `period`, or what the loop measured since its last tick.

    Ticks that a log has lost are counted in.
    """
    steps = np.full(time.size, period)
    steps[1:] = np.diff(time) if controller.time_step == "measured" else period * cycles_passed(time)
    return steps


def samples_a_period(controller: Controller, sample_time: float) -> int:
    """Return how many samples of `sample_time` [s] the controller's period holds.

    Raises
    ------
    InputError
        If it is no whole number of them.
    """
    if controller.control_period is None:
        return 1
    ratio = controller.control_period / sample_time
    if not _is_whole(ratio):
        raise InputError(
            f"control_period is {controller.control_period:g} s and the sample time {sample_time:g} s;"
            " the longer must be a whole multiple of the shorter"
        )
    return round(ratio)


def samples_a_tick(controller: Controller, sample_time: float) -> int:
    """Return how many samples of a log the controller's period holds, 1 where the log is slower than its loop.

    Raises
    ------
    InputError
        If neither is a whole multiple of the other.
    """
    return (
        1 if ticks_a_sample(controller.control_period, sample_time) > 1 else samples_a_period(controller, sample_time)
    )


def ticks_a_sample(control_period: float | None, sample_time: float) -> int:
    """Return how often a loop of that period [s], if it has one of its own, runs in each of its samples, at least 1.

    Raises
    ------
    InputError
        If it is faster than its samples, and these hold no whole number of periods.
    """
    if control_period is None or control_period > 0.75 * sample_time:
        return 1
    ratio = sample_time / control_period
    if not (_is_whole(ratio) and ratio < MOST_TICKS + 0.5):
        raise InputError(
            f"control_period is {control_period:g} s and the sample time {sample_time:g} s;"
            f" the longer must be a whole multiple of the shorter, and at most {MOST_TICKS} times as long"
        )
    return round(ratio)


def _is_whole(ratio: float) -> bool:
    return round(ratio) >= 1 and abs(ratio - round(ratio)) <= min(0.01 * ratio, 0.2)


def _ticks(controller: Controller, seen: LoopSignals) -> NDArray[np.intp] | None:
    """Return the samples at which a slow loop runs, the first included; None for a loop that runs at every sample."""
    count = samples_a_period(controller, seen.sample_time)
    if count == 1:
        return None
    period = np.rint((seen.time - seen.time[0]) / seen.sample_time).astype(np.int64) // count
    return np.concatenate(([0], np.flatnonzero(np.diff(period)) + 1))


def _differences(signal: Signal, time: Signal, window: int, period: float, *, measures: bool) -> Signal:
    """Return ``(s[k] − s[k−w]) / (w h)`` with s[−1] = s[0], over the true time if measured or across lost samples."""
    n = signal.size
    rise = signal - signal[0]
    span = np.full(n, window * period)
    if window < n:
        rise[window:] = signal[window:] - signal[:-window]
        counts = np.concatenate(([0.0], np.cumsum(cycles_passed(time))))
        passed, lost = time[window:] - time[:-window], counts[window:] - counts[:-window] > window
        span[window:] = np.where(lost | measures, passed, window * period)
    return np.asarray(rise / span)


def _filtered(raw: Signal, share: float) -> Signal:
    """Return ``d[k] = d[k−1] + share (raw[k] − d[k−1])`` from d[−1] = 0."""
    if share == 1.0:
        return raw
    from scipy.signal import lfilter

    return np.asarray(lfilter([share], [1.0, share - 1.0], raw), dtype=np.float64)


def _integral(
    controller: Controller, steps: Signal, columns: tuple[Signal, Signal], added: Signal | None, limit: float | None
) -> tuple[Signal, Signal]:
    """Return the integral as it is in the command, and as it is left to the next tick."""
    error, command = columns
    if not controller.integrates:
        nothing = np.zeros_like(error)
        return nothing, nothing
    growth = steps * (controller.ki * error + controller.integral_rate * command)
    if controller.anti_windup == "none" or limit is None:
        found = controller.initial_integral + np.cumsum(growth)
        return found, found
    total = command if added is None else command + added
    clamps = controller.anti_windup == "clamping"
    pulls = np.zeros_like(steps) if clamps else steps / controller.tracking
    integral, left, state = np.empty_like(error), np.empty_like(error), controller.initial_integral
    each = zip(growth.tolist(), total.tolist(), pulls.tolist(), strict=True)
    for k, (grown, rest, pull) in enumerate(each):
        asked = rest + state + grown
        if not (clamps and abs(asked) > limit and grown * asked > 0.0):
            state += grown
        asked = rest + state
        integral[k] = state
        state += pull * (min(max(asked, -limit), limit) - asked)
        left[k] = state
    return integral, left
