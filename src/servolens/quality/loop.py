"""Whether the logged voltage is what the stated controller asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.control_law import law_columns, law_rest
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.law import (
    BETTER,
    HOLDS,
    UNITS,
    find_alternative,
    fit_gains,
    remembered,
    rms,
    tick_phase,
)
from servolens.quality.limits import NEAR, at_limit, beyond_limit
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.law import Alternative
    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["LoopFit", "fit_loop", "loop_findings"]

RINGING = 0.02
"""Time after an edge of the reference that is not judged [s]: real drives ring there for 5 to 10 ms."""
DIFFERENCE = 0.01
"""Share of the voltage by which stated and fitted gains may differ; it biases the plant's gain by as much.

Also the relative difference up to which a ratio is that of two units.
"""


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
        Samples at which the voltage is at a limit that is not stated, and the law asks for more.
    limits : tuple of float
        Least and largest voltage of these samples.
    alternative : Alternative or None
        What else than stated the voltage fits; the gains are those that fit with it.
    holds : bool
        Whether the law holds with a positive gain, as stated or with the alternative.
    """

    kp: float
    kd: float
    misfit: float
    difference: float
    rounding: float
    clipped: int
    limits: tuple[float, float]
    alternative: Alternative | None
    holds: bool


def fit_loop(record: Record, seen: Sampling) -> LoopFit | None:
    """Fit kp and kd to the logged voltage by least squares; None without voltage or reference.

    Left out are clipped samples, the 20 ms after each edge of the reference, the first samples (the loop's past is
    not in the log), and, in three rounds, what is off by more than four standard deviations.
    """
    if record.voltage is None or record.reference is None or not record.voltage.any():
        return None
    try:
        aligned = _aligned(record)
        clipped = at_limit(aligned, seen)
        other = find_alternative(aligned, clipped, gains_stated=record.controller is not None)
        if other is not None:
            aligned = _aligned(other.applied(aligned))
            clipped = at_limit(aligned, seen) if other.kind != "limit" else _reached(aligned, other)
        error, derivative = law_columns(aligned)
        rest = law_rest(aligned)
    except InputError:
        return None
    assert aligned.voltage is not None  # noqa: S101 - as record.voltage
    target = aligned.voltage - rest
    judged = _judged(aligned, clipped)
    if np.count_nonzero(judged) < 4:
        return None
    kp, kd, kept = _robust_fit(error, derivative, target, judged)
    scale = rms(target[judged])
    if scale == 0 or not kept.any():
        return None
    left = target - kp * error + kd * derivative
    enough = np.count_nonzero(kept) >= 0.8 * np.count_nonzero(judged)
    misfit = rms(left[kept] if enough else left[judged])
    short = np.zeros_like(clipped) if record.voltage_limit else clipped & (np.abs(left) > misfit + HOLDS * scale)
    stated = record.controller
    wrong = 0.0 if stated is None else rms(((kp - stated.kp) * error - (kd - stated.kd) * derivative)[judged])
    return LoopFit(
        kp=kp,
        kd=kd,
        misfit=misfit / scale,
        difference=wrong / scale,
        rounding=abs(kp) * (seen.step or 0.0) / math.sqrt(12.0) / scale,
        clipped=int(np.count_nonzero(short)),
        limits=_sides(aligned.voltage[short]),
        alternative=other,
        holds=kp > 0 and misfit < BETTER * scale,
    )


def loop_findings(record: Record, fit: LoopFit | None) -> Iterator[Finding]:
    """Yield findings about voltage and controller."""
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
    beyond = beyond_limit(record)
    if beyond:
        message = (
            f"the controller asks for more than the limit of {record.voltage_limit:g} {record.command_unit}"
            f" in {beyond} samples."
        )
        yield Finding(code="voltage_beyond_limit", severity="note", message=message)
    if fit is not None:
        if fit.clipped >= 3:
            yield _clipped(record, fit)
        if fit.alternative is not None and fit.alternative.kind != "limit":
            yield _alternative(record, fit, fit.alternative)
        yield from _gains(record, fit)


def _clipped(record: Record, fit: LoopFit) -> Finding:
    low, high = fit.limits
    unit, largest = record.command_unit, max(abs(low), abs(high))
    one_sided = low * high >= 0 or math.isclose(-low, high, rel_tol=NEAR)
    where = f"{low:.4g} {unit}" if math.isclose(low, high, rel_tol=NEAR) else f"{low:.4g} and {high:.4g} {unit}"
    cure = f"state voltage_limit = {largest:.4g} {unit}, or " if one_sided else ""
    message = (
        f"the logged voltage stays at {where} for {fit.clipped} samples while the control law asks for more: it is what"
        f" the amplifier gave; {cure}log what the controller asks for."
    )
    return Finding(code="clipped_voltage", severity="warning", message=message)


def _alternative(record: Record, fit: LoopFit, other: Alternative) -> Finding:
    """Return the finding of what the voltage fits instead of what is stated."""
    unit = record.command_unit
    gains = "these settings" if record.controller is None else "the stated setting"
    left = f"unexplained voltage {other.before:.2g} {unit} r.m.s. with {gains}, {other.left:.2g} {unit} with this one"
    match other.kind:
        case "shift":
            return _shifted(other, _named(fit))
        case "sign":
            message = f"the control law holds only with the other sign of the position ({left}); change the sign of it."
            return Finding(code="wrong_sign", severity="error", message=message)
        case "unit":
            message = (
                f"the control law holds only if the position is {UNITS[other.value]} ({left}); state the unit of each"
                " column."
            )
            return Finding(code="units_contradict", severity="error", message=message)
        case "added":
            constant, integral = other.value
            what, cure = f"a constant {constant:.3g} {unit}", "log what is added as feedforward"
            if integral:
                what = f"an integral action with ki = {integral:.3g} {unit}/({record.length_unit} s)"
                cure = "state ki, and the anti_windup of the loop if it has one"
                if record.voltage is not None and abs(constant) > HOLDS * rms(record.voltage):
                    cure += f"; the integral begins at {constant:.3g} {unit} (integral_before)"
            message = f"the log fits with {what} added to the control law ({left}); {cure}."
            return Finding(code="added_to_law", severity="warning", message=message)
    stated = record.controller or Controller(kp=1.0)
    fits = ", ".join(f"{name} = {_shown(value)}" for name, value in other.value)
    was = ", ".join(_shown(getattr(stated, name)) for name, _ in other.value)
    message = f"the log fits {fits}, not {was} ({left}); correct what is stated."
    return Finding(code="settings_contradict_log", severity="warning", message=message)


def _shown(value: object) -> str:
    if value is None:
        return "every sample"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _gains(record: Record, fit: LoopFit) -> Iterator[Finding]:
    """Yield that the voltage fits no gains, or other gains than stated."""
    stated, fits = record.controller, _named(fit)
    if stated is None:
        if fit.misfit < 2 * DIFFERENCE:
            message = f"the gains are not stated; the logged voltage fits {fits}."
            yield Finding(code="gains_unknown", severity="note", message=message)
        if fit.kp < 0 and fit.misfit < BETTER:
            yield _mirrored(fits)
    elif fit.misfit > BETTER:
        message = (
            f"the logged voltage is not kp e − kd d: even {fits} leave {100 * fit.misfit:.0f} % of it;"
            " check sign, unit and derivative settings, or whether something is added to it."
        )
        yield Finding(code="law_contradicts_log", severity="warning", message=message)
    elif fit.difference > max(DIFFERENCE, 0.5 * fit.misfit, 2 * fit.rounding):
        yield _other_gains(stated, fit, fits)


def _other_gains(stated: Controller, fit: LoopFit, fits: str) -> Finding:
    """Return the finding of other gains than stated, by a sign or a unit where that explains them."""
    proportional, derivative = (
        math.nan if own == 0 else found / own for found, own in ((fit.kp, stated.kp), (fit.kd, stated.kd))
    )
    message = f"the logged voltage fits {fits}, not kp = {stated.kp:.4g}, kd = {stated.kd:.4g}"
    if math.isclose(proportional, -1.0, rel_tol=DIFFERENCE):
        return _mirrored(fits)
    power = _power(proportional)
    if power:
        cure = f"the voltage is 10^{power} times that of the law: state its unit, as mV, or that of the gains"
        return Finding(code="units_contradict", severity="error", message=f"{message}; {cure}.")
    power = _power(derivative)
    if math.isclose(proportional, 1.0, rel_tol=DIFFERENCE) and power in (-6, -3, 3, 6):
        cure = f"the time stamps are 10^{power} times what the derivative used: state their unit, as ms, or that of kd"
        return Finding(code="units_contradict", severity="error", message=f"{message}; {cure}.")
    cure = "correct the stated gains"
    if fit.misfit > DIFFERENCE:
        cure += f", or the settings of the derivative: {100 * fit.misfit:.2g} % of the voltage is left"
    return Finding(code="gains_contradict_log", severity="warning", message=f"{message}; {cure}.")


def _power(ratio: float) -> int:
    """Return the power of ten that a ratio is, other than 0; 0 if it is none."""
    if not ratio > 0:
        return 0
    power = round(math.log10(ratio))
    return power if math.isclose(ratio / 10.0**power, 1.0, rel_tol=DIFFERENCE) else 0


def _mirrored(fits: str) -> Finding:
    message = f"the logged voltage fits {fits}: it has the other sign than the control law; change the sign of it."
    return Finding(code="wrong_sign", severity="error", message=message)


def _named(fit: LoopFit) -> str:
    return f"kp = {fit.kp:.4g}, kd = {0.0 if abs(fit.kd) < 1e-9 * abs(fit.kp) else fit.kd:.4g}"


def _shifted(shift: Alternative, fits: str) -> Finding:
    count = f"{abs(shift.value)} sample{'s' if abs(shift.value) > 1 else ''}"
    late = shift.value > 0
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
    first = tick_phase(record)
    return record.slice(float(record.time[first]), float(record.time[-1])) if first else record


def _reached(record: Record, limit: Alternative) -> NDArray[np.bool_]:
    """Mark the samples at the limits that were found."""
    assert record.voltage is not None  # noqa: S101 - fit_loop has refused records without
    margin = NEAR * float(np.ptp(record.voltage))
    low, high = limit.value
    return np.asarray((record.voltage < low + margin) | (record.voltage > high - margin))


def _sides(clipped: NDArray[np.float64]) -> tuple[float, float]:
    """Return the voltage at the lower and at the upper limit, by the median; one of them twice if there is no other."""
    if not clipped.size:
        return 0.0, 0.0
    upper = clipped > 0.5 * (clipped.min() + clipped.max())
    if np.ptp(clipped) <= 0.5 * np.abs(clipped).max():
        return (level := float(np.median(clipped))), level
    return float(np.median(clipped[~upper])), float(np.median(clipped[upper]))


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
