"""Whether the logged voltage is what the stated controller asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.control_law import law_columns
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.shifts import find_shift, fit_gains, realigned, remembered, rms
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.quality.shifts import Shift
    from servolens.record import Record

__all__ = ["LoopFit", "fit_loop", "loop_findings"]

RINGING = 0.02
"""Time after an edge of the reference that is not judged [s]: real drives ring there for 5 to 10 ms."""
MISFIT = 0.1
"""Share of the voltage beyond which no gains are said to fit it."""
DIFFERENCE = 0.01
"""Share of the voltage by which stated and fitted gains may differ; it biases the plant's gain by as much."""
SAME = 0.01
"""Relative difference up to which a factor is a power of ten."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFit:
    """Gains that the logged voltage fits.

    Attributes
    ----------
    kp, kd : float
        Fitted gains.
    misfit : float
        What they leave, as a share of the voltage's root mean square.
    difference : float
        What the stated gains ask for otherwise, as the same share; 0 where none are stated.
    rounding : float
        What a position rounded in the log to the step seen there can change, as the same share.
    clipped : int
        Samples at which the voltage sits at a limit.
    limits : tuple of float
        Least and largest logged voltage.
    shift : Shift or None
        Of the column that is logged late or early; the gains are those that fit without it.
    """

    kp: float
    kd: float
    misfit: float
    difference: float
    rounding: float
    clipped: int
    limits: tuple[float, float]
    shift: Shift | None


def fit_loop(record: Record, seen: Sampling) -> LoopFit | None:
    """Fit kp and kd to the logged voltage by least squares; None without voltage or reference.

    Left out are clipped samples, the 20 ms after each edge of the reference, the first samples (the loop's past is
    not in the log), and, in three rounds, what is off by more than four standard deviations.
    """
    if record.voltage is None or record.reference is None or not record.voltage.any():
        return None
    aligned = _aligned(record)
    try:
        shift = find_shift(aligned, _clipped(aligned, seen))
        aligned = aligned if shift is None else _aligned(realigned(aligned, shift))
        error, derivative = law_columns(aligned)
    except InputError:
        return None
    assert aligned.voltage is not None  # noqa: S101 - as record.voltage
    target = aligned.voltage if aligned.feedforward is None else aligned.voltage - aligned.feedforward
    clipped = _clipped(aligned, seen)
    judged = _judged(aligned, clipped)
    if np.count_nonzero(judged) < 4:
        return None
    kp, kd, kept = _robust_fit(error, derivative, target, judged)
    scale = rms(target[judged])
    if scale == 0 or not kept.any():
        return None
    left = target - kp * error + kd * derivative
    enough = np.count_nonzero(kept) >= 0.8 * np.count_nonzero(judged)
    return LoopFit(
        kp=kp,
        kd=kd,
        misfit=rms(left[kept] if enough else left[judged]) / scale,
        difference=_difference(record.controller, kp, kd, error[judged], derivative[judged]) / scale,
        rounding=abs(kp) * (seen.step or 0.0) / math.sqrt(12.0) / scale,
        clipped=int(np.count_nonzero(clipped)),
        limits=(float(record.voltage.min()), float(record.voltage.max())),
        shift=shift,
    )


def loop_findings(record: Record, fit: LoopFit | None) -> Iterator[Finding]:
    """Yield doubts about voltage and controller."""
    if record.controller is not None and record.reference is not None:
        try:
            law_columns(record)
        except InputError as error:
            message = f"the controller cannot have run like this: {str(error).removeprefix(f'{record.name}: ')}."
            yield Finding(code="impossible_controller", severity="error", message=message)
    if record.reference is None:
        message = "no reference is logged; the loop cannot be simulated, only the axis driven by its voltage."
        yield Finding(code="no_reference", severity="note", message=message)
    if record.voltage is None:
        message = "no voltage is logged; it is reconstructed from kp and kd, which therefore cannot be verified."
        yield Finding(code="voltage_reconstructed", severity="note", message=message)
    if fit is not None:
        yield from _limits(record, fit)
        yield from _law(record, fit)


def _limits(record: Record, fit: LoopFit) -> Iterator[Finding]:
    unit = record.command_unit
    if fit.clipped:
        low, high = fit.limits
        message = (
            f"the logged voltage sits at its limits {low:.4g} and {high:.4g} {unit} for {fit.clipped} samples while the"
            " axis moves; log what the controller asks for, or state voltage_limit."
        )
        yield Finding(code="clipped_voltage", severity="warning", message=message)
    limit = record.voltage_limit
    if limit is not None and record.voltage is not None:
        beyond = int(np.count_nonzero(np.abs(record.voltage) > 1.001 * limit))
        if beyond:
            message = f"the controller asks for more than the limit of {limit:g} {unit} in {beyond} samples."
            yield Finding(code="voltage_beyond_limit", severity="note", message=message)


def _law(record: Record, fit: LoopFit) -> Iterator[Finding]:
    stated = record.controller
    fits = f"kp = {fit.kp:.4g}, kd = {0.0 if abs(fit.kd) < 1e-9 * abs(fit.kp) else fit.kd:.4g}"
    if fit.shift is not None:
        yield _shifted(fit.shift, fits)
    if stated is None:
        if fit.misfit < 0.02:
            message = f"the gains are not stated; the logged voltage fits {fits}."
            yield Finding(code="gains_unknown", severity="note", message=message)
    elif fit.misfit > MISFIT:
        message = (
            f"the logged voltage is not kp e − kd d: even {fits} leave {100 * fit.misfit:.0f} % of it;"
            " check sign, unit and derivative settings, or whether something is added to it."
        )
        yield Finding(code="law_contradicts_log", severity="warning", message=message)
    elif fit.difference > max(DIFFERENCE, 0.5 * fit.misfit, 2 * fit.rounding):
        power = round(math.log10(abs(fit.kp / stated.kp))) if fit.kp * stated.kp > 0 else 0
        cure = "correct the stated gains"
        if power and abs(fit.kp / stated.kp / 10.0**power - 1.0) < SAME:
            cure = f"the voltage is 10^{power} times that of the law: state its unit, as mV, or that of the gains"
        message = f"the logged voltage fits {fits}, not kp = {stated.kp:.4g}, kd = {stated.kd:.4g}; {cure}."
        yield Finding(code="gains_contradict_log", severity="warning", message=message)


def _shifted(shift: Shift, fits: str) -> Finding:
    count = f"{abs(shift.samples)} sample{'s' if abs(shift.samples) > 1 else ''}"
    late = shift.samples > 0
    if shift.column == "voltage":
        message = f"the voltage is logged {count} {'after' if late else 'before'} its position; shift the column."
    else:
        other = "reference" if shift.column == "position" else "position"
        message = (
            f"the {shift.column} is logged {count} {'late' if late else 'early'} against {other} and voltage; shift the"
            f" column, and the voltage fits {fits}."
        )
    return Finding(code=f"{shift.column}_shifted", severity="warning", message=message)


def _aligned(record: Record) -> Record:
    """Return the record with some controller, and from a tick of a slow loop on: there its voltage changes."""
    if record.controller is None:
        return replace(record, controller=Controller(kp=1.0))
    period = record.controller.control_period
    ratio = 1 if period is None else round(period / record.sample_time)
    if ratio <= 1 or record.voltage is None or len(record) < 4 * ratio:
        return record
    changes = np.flatnonzero(np.diff(record.voltage)) + 1
    phase = int(np.argmax(np.bincount(changes % ratio, minlength=ratio)))
    return record.slice(float(record.time[phase]), float(record.time[-1]))


def _clipped(record: Record, seen: Sampling) -> NDArray[np.bool_]:
    """Mark runs of three and more samples at the least or largest voltage in which the position moves visibly."""
    assert record.voltage is not None  # noqa: S101 - fit_loop has refused records without
    marked = np.zeros(len(record), dtype=bool)
    voltage, y = record.voltage, record.position
    near = 1e-9 * float(np.ptp(voltage))
    period = None if record.controller is None else record.controller.control_period
    held = 1 if period is None else max(round(period / record.sample_time), 1)
    visible = 5 * seen.level + 2 * (seen.step or 0.0)
    for at in (voltage >= voltage.max() - near, voltage <= voltage.min() + near):
        bounds = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
        starts, ends = bounds[::2], bounds[1::2] - 1
        flat = (ends - starts + 1 >= 3 * held) & (np.abs(y[ends] - y[starts]) > visible)
        for first, last in zip(starts[flat].tolist(), ends[flat].tolist(), strict=True):
            marked[first : last + 1] = True
    return marked


def _judged(record: Record, clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    judged = ~clipped
    judged[: remembered(record)] = False
    edges = record.edges()
    span = math.ceil(RINGING / record.sample_time)
    if edges.size * span < 0.3 * len(record):
        quiet = judged.copy()
        for edge in edges.tolist():
            quiet[edge : edge + span] = False
        judged = quiet
    return judged if np.count_nonzero(judged) >= 10 else ~clipped


def _robust_fit(
    error: NDArray[np.float64], derivative: NDArray[np.float64], target: NDArray[np.float64], judged: NDArray[np.bool_]
) -> tuple[float, float, NDArray[np.bool_]]:
    kept = judged
    kp, kd = fit_gains(error[kept], derivative[kept], target[kept])
    for _ in range(3):
        left = np.abs(target - kp * error + kd * derivative)
        bound = max(4 * 1.4826 * float(np.median(left[kept])), 1e-9 * float(np.max(np.abs(target))))
        within = judged & (left <= bound)
        if np.count_nonzero(within) < 0.8 * np.count_nonzero(judged):
            break
        done = np.array_equal(within, kept)
        kept = within
        if done:
            break
        kp, kd = fit_gains(error[kept], derivative[kept], target[kept])
    return kp, kd, kept


def _difference(
    stated: Controller | None, kp: float, kd: float, error: NDArray[np.float64], derivative: NDArray[np.float64]
) -> float:
    if stated is None:
        return 0.0
    return rms((kp - stated.kp) * error - (kd - stated.kd) * derivative)
