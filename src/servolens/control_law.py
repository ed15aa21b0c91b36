"""What the digital loop of a record asked for, computed from the position as measured."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_arithmetic import samples_a_period
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.control_arithmetic import Answer
    from servolens.controller import Controller
    from servolens.record import Record

__all__ = ["controller_voltage", "with_history"]

FORGOTTEN_SHARE = 1e-3
"""Share of the derivative's memory that no longer matters."""


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
    voltage = controller.kp * found.error - controller.kd * found.derivative
    return voltage + _rest(record, found)


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
    ratio = samples_a_period(controller, record.sample_time)  # it forgets as often as it runs
    remembered *= ratio
    if controller.ki != 0 or controller.integral_rate != 0:
        lacking = (voltage - controller_voltage(record))[remembered : 2 * remembered + ratio]
        begun = controller.integral_before + (float(np.median(lacking)) if lacking.size else 0.0)
        record = record.with_({"controller": replace(controller, integral_before=begun)})
    added = np.zeros(len(record)) if record.feedforward is None else record.feedforward.copy()
    added[:remembered] += (voltage - controller_voltage(record))[:remembered]
    return record.with_({"feedforward": added})


def _rest(record: Record, found: Answer) -> NDArray[np.float64]:
    rest = found.ahead + found.integral
    return rest if record.feedforward is None else rest + record.feedforward


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
