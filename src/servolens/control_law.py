"""What the digital loop of a record asked for, computed from the position as measured."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_arithmetic import answer, samples_a_tick
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.control_arithmetic import Answer
    from servolens.controller import Controller
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = ["command_at", "controller_voltage", "with_history"]

FORGOTTEN_SHARE = 1e-3
"""Share of the derivative's memory that no longer matters."""
AVERAGED = 9
"""Samples over which what a log shows beside its law is averaged, so that a third of its noise is left."""


def controller_voltage(record: Record) -> NDArray[np.float64]:
    """Return the command that the record's controller asks for at each sample, before any limit.

    ``V = kp e − kd d`` and what else the law of :class:`~servolens.controller.Controller` has, plus the feedforward;
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
    controller, found = _controller(record), _answer(record)
    voltage = found.command(controller)
    return voltage if record.feedforward is None else voltage + record.feedforward


def command_at(record: Record, ticks: Ticks) -> NDArray[np.float64]:
    """Return the command at the ticks of the record's loop [`record.command_unit`], before any limit.

    Held from sample to sample. Of a loop that ran faster than the log it is what its law, where that is known, makes
    of the motion between the samples, and what the log shows beside the law, on average over a few of these: the noise
    of a logged sample was in the command for one tick alone. Without a law it is interpolated.

    Raises
    ------
    InputError
        As :func:`controller_voltage`.
    """
    if record.voltage is not None and not (ticks.is_faster and record.has_loop):
        return ticks.command(record.voltage)
    asked = _asked(record, _controller(record), ticks)
    if record.voltage is None or ticks.index is None:
        return asked
    from scipy.ndimage import uniform_filter1d

    beside = uniform_filter1d(record.voltage - asked[ticks.index], AVERAGED, mode="nearest")
    asked = asked + ticks.motion(beside)
    asked[ticks.index] = record.voltage
    return asked


def _asked(record: Record, controller: Controller, ticks: Ticks) -> NDArray[np.float64]:
    """Return what the law asks for at the ticks."""
    found = answer(controller, ticks.seen(record.signals_seen())).command(controller)
    return found if record.feedforward is None else found + ticks.command(record.feedforward)


def with_history(record: Record) -> Record:
    """Return the record with what its controller remembered from before the first sample.

    For a log that begins in motion: the past that the law lacks (see :func:`controller_voltage`) is read off the logged
    voltage of the first samples, that of an integral as its initial value, the rest as feedforward. Unchanged where no
    voltage is logged.

    Parameters
    ----------
    record : Record
        With reference, controller and voltage.

    Raises
    ------
    InputError
        As :func:`controller_voltage`.
    """
    voltage = record.voltage
    if voltage is None:
        return record
    controller = _controller(record)
    remembered = controller.derivative_window
    if controller.derivative_filter < 1.0:
        remembered += math.ceil(math.log(FORGOTTEN_SHARE) / math.log(1.0 - controller.derivative_filter))
    ratio = samples_a_tick(controller, record.sample_time)  # it forgets as often as it runs
    remembered *= ratio
    if controller.ki != 0 or controller.integral_rate != 0:
        lacking = (voltage - controller_voltage(record))[remembered : 2 * remembered + ratio]
        begun = controller.integral_before + (float(np.median(lacking)) if lacking.size else 0.0)
        record = record.with_({"controller": replace(controller, integral_before=begun)})
    added = np.zeros(len(record)) if record.feedforward is None else record.feedforward.copy()
    added[:remembered] += (voltage - controller_voltage(record))[:remembered]
    return record.with_({"feedforward": added})


def _answer(record: Record) -> Answer:
    controller = _controller(record)
    if record.reference is None:
        raise InputError(f"{record.name}: the control law needs the reference; log it")
    try:
        return record.answer(controller)
    except InputError as error:
        raise InputError(f"{record.name}: {error}") from None


def _controller(record: Record) -> Controller:
    if record.controller is None:
        raise InputError(
            f"{record.name}: the control law needs the gains; give kp and kd (on the command line --record-kp and"
            " --record-kd)"
        )
    return record.controller
