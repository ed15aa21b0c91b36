"""What the digital loop of a record asked for, computed from the position as measured."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.clock import cycles_passed
from servolens.control_arithmetic import answer, samples_a_tick
from servolens.encoder import quantisation_step
from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.control_arithmetic import Answer
    from servolens.controller import Controller
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = [
    "HOLDS",
    "command_at",
    "controller_voltage",
    "differs_by_time_steps",
    "felt_rounding",
    "noise_gain",
    "rms",
    "with_history",
    "with_seen_integral",
    "with_seen_time_step",
]

FORGOTTEN_SHARE = 1e-3
"""Share of the derivative's memory that no longer matters."""
HOLDS = 1e-3
"""Share of the voltage up to which the law holds as it stands: it biases the plant's gain by as much."""
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
    controller, remembered = _controller(record), _remembered(record)
    ratio = samples_a_tick(controller, record.sample_time)
    if controller.ki != 0 or controller.integral_rate != 0:
        lacking = (voltage - controller_voltage(record))[remembered : 2 * remembered + ratio]
        begun = controller.initial_integral + (float(np.median(lacking)) if lacking.size else 0.0)
        record = record.with_({"controller": replace(controller, integral_before=begun)})
    added = np.zeros(len(record)) if record.feedforward is None else record.feedforward.copy()
    added[:remembered] += (voltage - controller_voltage(record))[:remembered]
    return record.with_({"feedforward": added})


def with_seen_integral(record: Record) -> Record:
    """Return the record with the integral with which its loop began, where its voltage shows one and none is stated.

    It is no setting but a state: an axis that is held against a load has charged it before the log begins. It is
    read off the samples before the first that reaches the limit, with it or without, and believed where the law
    then holds for all samples to what rounding leaves.

    Parameters
    ----------
    record : Record
        Of a loop that integrates and ran once a sample; others are returned as they are.

    Examples
    --------
    >>> import numpy as np
    >>> from servolens.record import Controller, Record
    >>> loop, still = Controller(kp=10, ki=5), np.zeros(50)
    >>> held = Record(time=0.01 * np.arange(50), position=still, reference=still, voltage=still + 3, controller=loop)
    >>> with_seen_integral(held).controller.integral_before
    3.0
    """
    controller, voltage = record.controller, record.voltage
    if controller is None or voltage is None or not record.has_loop:
        return record
    if not controller.integrates or controller.integral_before is not None:
        return record
    try:
        if record.ticks > 1:
            return record
        asked = controller_voltage(record)
        missed, limit = voltage - asked, np.inf if record.voltage_limit is None else record.voltage_limit
        seen = np.flatnonzero(np.maximum(np.abs(voltage), np.abs(asked)) >= limit)
        first = _remembered(record)
        last = int(seen[0]) if seen.size else voltage.size  # an integral that stands at the limit goes on otherwise
        if first >= last:
            return record
        begun = replace(controller, integral_before=float(np.median(missed[first:last])))
        found = record.with_({"controller": begun})
        return found if _holds(found) and not _holds(record) else record
    except InputError:  # of a law that the record contradicts, which is told elsewhere
        return record


def with_seen_time_step(record: Record) -> Record:
    """Return the record of a loop that measured its time steps, where its voltage shows that and the cycle is stated.

    A small computer's loop often divides by the time that it measured from tick to tick. Believed where the law then
    holds to what rounding leaves, and does not with its cycle; the integral with which the loop began is read off
    beside either (:func:`with_seen_integral`).

    Parameters
    ----------
    record : Record
        Of a loop that is no faster than its log; others are returned as they are.

    Examples
    --------
    >>> import numpy as np
    >>> from servolens.record import Controller, Record
    >>> time = np.cumsum(np.random.default_rng(1).uniform(0.009, 0.011, 50))
    >>> loop, speed = Controller(kp=10, kd=1), np.where(time > time[0], 1.0, 0.0)
    >>> run = Record(time=time, position=time, reference=time, voltage=-speed, controller=loop)
    >>> with_seen_time_step(run).controller.time_step
    'measured'
    """
    stated = with_seen_integral(record)
    loop = record.controller
    if loop is None or record.voltage is None or not record.has_loop or loop.time_step == "measured":
        return stated
    try:
        if record.ticks > 1 or _holds(stated):
            return stated
        found = with_seen_integral(record.with_({"controller": replace(loop, time_step="measured")}))
        return found if _holds(found) else stated
    except InputError:  # as above
        return stated


def _holds(record: Record) -> bool:
    """Tell whether the law asks for the logged voltage, to what rounding leaves, once it has forgotten its past."""
    voltage, controller = record.voltage, _controller(record)
    if voltage is None:
        return False
    limit = np.inf if record.voltage_limit is None else record.voltage_limit
    asked = np.clip(controller_voltage(record), -limit, limit)
    rounding = (quantisation_step(voltage) or 0.0) / math.sqrt(6.0)  # of the samples, and of their median
    felt = felt_rounding(controller, quantisation_step(record.position) or 0.0, record.sample_time)
    missed, remembered = np.clip(voltage, -limit, limit) - asked, _remembered(record)
    known = np.ones(missed.size, dtype=bool)
    for first in (0, *(np.flatnonzero(cycles_passed(record.time) > 1.0) + 1).tolist()):
        known[first : first + remembered] = False  # nor is what was lost known to the law
    return rms(missed[known]) <= max(HOLDS * rms(voltage), math.hypot(rounding, felt))


def differs_by_time_steps(record: Record) -> bool:
    """Tell whether a law with measured time steps asks for another voltage than one with its cycle."""
    controller = _controller(record)
    one, other = (
        controller_voltage(record.with_({"controller": replace(controller, time_step=kind)}))
        for kind in ("cycle", "measured")
    )
    return rms(other - one) > HOLDS * rms(one)


def felt_rounding(controller: Controller, step: float, sample_time: float) -> float:
    """Return the voltage, r.m.s., that the law makes of a position rounded to a `step`, as white noise."""
    return step / math.sqrt(12.0) * noise_gain(controller, sample_time)


def noise_gain(controller: Controller, sample_time: float) -> float:
    """Return the r.m.s. voltage for white noise of r.m.s. 1 in the measured position [V/m], from the law alone.

    The digital PD answers to one sample by kp and by a = kd/(w h) times the derivative filter's response φ(1−φ)ʲ, less
    the same w samples later: the squares sum to kp² + 2 a φ kp + 2 a² φ (1 − (1−φ)ʷ)/(2 − φ). Without an integral,
    which sums up noise slowly, and without the noise of a velocity signal, which is not known.

    Parameters
    ----------
    controller : Controller
        The law.
    sample_time : float
        Between its ticks [s], if it has no period of its own.
    """
    share, window, kp = controller.derivative_filter, controller.derivative_window, controller.kp
    period = controller.control_period or sample_time
    slope = controller.kd / (window * period) if controller.derivative == "position" else 0.0
    own = 2.0 * slope**2 * share * (1.0 - (1.0 - share) ** window) / (2.0 - share)
    return math.sqrt(kp**2 + 2.0 * slope * share * kp + own)


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square, 0 of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _remembered(record: Record) -> int:
    """Return for how many samples the derivative remembers what was before the record."""
    controller = _controller(record)
    remembered = controller.derivative_window
    if controller.derivative_filter < 1.0:
        remembered += math.ceil(math.log(FORGOTTEN_SHARE) / math.log(1.0 - controller.derivative_filter))
    return remembered * samples_a_tick(controller, record.sample_time)  # it forgets as often as it runs


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
