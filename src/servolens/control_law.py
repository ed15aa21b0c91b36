"""What the digital PD loop of a record asked for, computed from the position as measured."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.record import Controller, Record

__all__ = ["controller_voltage", "law_columns", "samples_a_period", "with_history"]

FORGOTTEN = 1e-3
"""Share of the derivative's memory that no longer matters."""


def controller_voltage(record: Record) -> NDArray[np.float64]:
    """Return the command that the record's controller asks for at each sample, before any limit.

    ``V[k] = kp (r[k] − y[k]) − kd d[k] + feedforward[k]`` with the derivative of :class:`~servolens.record.Controller`;
    before the record the axis and the reference were where they are first seen, and the derivative was 0.

    Parameters
    ----------
    record : Record
        With reference and controller; with velocity, if the loop used a velocity of its own.

    Returns
    -------
    ndarray, shape (n,)
        [`record.command_unit`]

    Raises
    ------
    InputError
        If reference, gains or a needed velocity are missing, or if the control period is no multiple of the sample
        time.

    Examples
    --------
    >>> from servolens.record import Controller, Record
    >>> record = Record(time=[0, 1, 2], position=[0, 1, 3], reference=[5, 5, 5], controller=Controller(kp=10, kd=1))
    >>> controller_voltage(record)
    array([50., 39., 18.])
    """
    controller = _controller(record)
    error, derivative = law_columns(record)
    voltage = controller.kp * error - controller.kd * derivative
    return voltage if record.feedforward is None else voltage + record.feedforward


def with_history(record: Record) -> Record:
    """Return the record with what its controller remembered from before the first sample, as feedforward.

    For a log that begins in motion: the past that the law lacks (see :func:`controller_voltage`) is read off the logged
    voltage of the first samples. Unchanged where no voltage is logged.

    Parameters
    ----------
    record : Record
        With reference, controller and voltage.

    Raises
    ------
    InputError
        As :func:`controller_voltage`.
    """
    if record.voltage is None:
        return record
    controller, asked = _controller(record), controller_voltage(record)
    remembered = controller.derivative_window
    if controller.derivative_filter < 1.0:
        remembered += math.ceil(math.log(FORGOTTEN) / math.log(1.0 - controller.derivative_filter))
    remembered *= samples_a_period(controller, record.sample_time)  # it forgets as often as it runs
    added = np.zeros(len(record)) if record.feedforward is None else record.feedforward.copy()
    added[:remembered] += (record.voltage - asked)[:remembered]
    return record.with_({"feedforward": added})


def law_columns(record: Record) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return error and derivative as the loop sees them, so that ``V = kp error − kd derivative + feedforward``.

    Both have shape (n,) and are held between the ticks of a loop slower than the log. A difference across lost
    samples is divided by the time that really passed.

    Raises
    ------
    InputError
        As :func:`controller_voltage`.
    """
    controller = _controller(record)
    if record.reference is None:
        raise InputError(f"{record.name}: the control law needs the reference; log it")
    ticks = _ticks(record, controller)
    if ticks is None:
        return _on_grid(record, controller, slice(None), record.sample_time)
    error, derivative = _on_grid(record, controller, ticks, float(controller.control_period or 0.0))
    held = np.searchsorted(ticks, np.arange(len(record)), side="right") - 1
    return error[held], derivative[held]


def _controller(record: Record) -> Controller:
    if record.controller is None:
        raise InputError(f"{record.name}: the control law needs the gains; give kp and kd")
    return record.controller


def _ticks(record: Record, controller: Controller) -> NDArray[np.intp] | None:
    """Return the samples at which a slow loop runs, the first included; None for a loop that runs at every sample."""
    if controller.control_period is None:
        return None
    try:
        count = samples_a_period(controller, record.sample_time)
    except InputError as error:
        raise InputError(f"{record.name}: {error}") from None
    if count == 1:
        return None
    period = np.rint((record.time - record.time[0]) / record.sample_time).astype(np.int64) // count
    return np.concatenate(([0], np.flatnonzero(np.diff(period)) + 1))


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
    if round(ratio) < 1 or abs(ratio - round(ratio)) > min(0.01 * ratio, 0.2):
        raise InputError(
            f"control_period is {controller.control_period:g} s and the sample time {sample_time:g} s;"
            " the period must be a whole multiple of the sample time"
        )
    return round(ratio)


def _on_grid(
    record: Record, controller: Controller, ticks: NDArray[np.intp] | slice, period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    assert record.reference is not None  # noqa: S101 - law_columns has refused records without
    reference, position = record.reference[ticks], record.position[ticks]
    if controller.derivative == "velocity":
        if record.velocity is None:
            raise InputError(f"{record.name}: the loop used a velocity of its own (derivative = velocity); log it")
        raw = record.velocity[ticks]
    else:
        signal = position - reference if controller.derivative_on == "error" else position
        raw = _differences(signal, record.time[ticks], controller.derivative_window, period)
    return reference - position, _filtered(raw, controller.derivative_filter)


def _differences(
    signal: NDArray[np.float64], time: NDArray[np.float64], window: int, period: float
) -> NDArray[np.float64]:
    """Return ``(s[k] − s[k−w]) / (w h)`` with s[−1] = s[0], over the true time where samples are lost."""
    n = signal.size
    rise = signal - signal[0]
    span = np.full(n, window * period)
    if window < n:
        rise[window:] = signal[window:] - signal[:-window]
        passed = time[window:] - time[:-window]
        span[window:] = np.where(passed > (window + 0.5) * period, passed, window * period)
    return np.asarray(rise / span)


def _filtered(raw: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Return ``d[k] = d[k−1] + share (raw[k] − d[k−1])`` from d[−1] = 0."""
    if share == 1.0:
        return raw
    from scipy.signal import lfilter

    return np.asarray(lfilter([share], [1.0, share - 1.0], raw), dtype=np.float64)
