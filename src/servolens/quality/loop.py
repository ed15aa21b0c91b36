"""Whether the logged voltage is what the stated controller asks for."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.control_law import controller_voltage, differs_by_time_steps, felt_rounding, rms
from servolens.controller import Controller
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.beginning import initial_motion
from servolens.quality.law import GAINS, LawFit, controller_of, remembered, tick_phase, voltage_of
from servolens.quality.limits import FEWEST, NEAR, beyond_limit, voltage_limits, within
from servolens.quality.settings import BETTER, UNITS, find_alternative
from servolens.quality.spikes import of_part
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.quality.settings import Alternative
    from servolens.record import Record

__all__ = ["LoopFit", "fit_loop", "loop_findings"]

RINGING = 0.02
"""Time after an edge of the reference that is not judged [s]: real drives ring there for 5 to 10 ms."""
DIFFERENCE = 0.01
"""Share of the voltage by which stated and fitted gains may differ; it biases the plant's gain by as much."""
NO_LAW = 0.1
"""Share of the voltage that the law may leave and still be one: 1 % of its variance."""

ROUGHLY = 2.0
"""Ratio of voltage to kp e from which on a log slower than its loop contradicts kp: an error of unit is more."""

UNITS_OF = {
    "ki": " {command}/({length} s)",
    "velocity_feedforward": " {command} s/{length}",
    "integral_before": " {command}",
    "control_period": " s",
}
"""Of the controller's settings."""
STATED_AS = {"integral_rate": ("kiv", " {command}/{length}"), "velocity_feedforward": ("feedforward_speed", "")}
"""Settings of a cascade that are stated times or over its kv, and their units."""


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
    limits : tuple of float
        Least and largest voltage that the log shows although the law asks for more; infinite where there is none.
    at_limit : int
        Samples there while the law asks for more.
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
    limits: tuple[float, float]
    at_limit: int
    alternative: Alternative | None
    holds: bool


def fit_loop(record: Record, seen: Sampling, spoilt: NDArray[np.bool_] | None = None) -> LoopFit | None:
    """Fit kp and kd to the logged voltage by least squares; None without voltage or reference.

    None, too, of a log slower than its loop: the noise of the ticks between its samples is in the voltage alone.
    Left out are samples at a limit, the 20 ms after each edge of the reference, the first samples (the loop's past is
    not in the log), those that the sensor has `spoilt`, and, in three rounds, what is off by more than four standard
    deviations.
    """
    if record.voltage is None or record.reference is None or not record.voltage.any() or len(record) < 4:
        return None
    try:
        if record.ticks > 1:
            return None
        aligned = _aligned(record)
        limits, free = _limited(aligned)
        kept = np.ones(len(record), dtype=bool) if spoilt is None else ~spoilt
        kept = of_part(kept, record, aligned)
        free &= kept | ~_quiet(aligned)
        other = find_alternative(aligned, free) or find_alternative(aligned, free & _quiet(aligned))
        if other is not None:
            mended = other.applied(aligned)
            kept, aligned = of_part(kept, aligned, mended), _aligned(mended)
            kept = of_part(kept, mended, aligned)
            limits, free = _limited(aligned)
        free &= kept
        judged = free & _quiet(aligned)
        judged = judged if np.count_nonzero(judged) >= 10 else free
        fit = LawFit.of(aligned, judged)
    except InputError:
        return None
    scale = rms(fit.voltage[judged])
    if np.count_nonzero(judged) < 4 or scale == 0:
        return None
    fit, found = _robust(fit)
    misfit = fit.left(found) / scale
    stated = record.controller
    wrong = 0.0 if stated is None else rms((fit.asked(found) - fit.asked(_with_gains(found, stated)))[judged])
    rounding = felt_rounding(stated or found, seen.step or 0.0, record.sample_time) / scale
    return LoopFit(
        kp=found.kp,
        kd=found.kd,
        misfit=misfit,
        difference=wrong / scale,
        rounding=rounding if misfit > BETTER * rounding else 0.0,  # else the loop saw what the log holds
        limits=limits,
        at_limit=_count_at_limit(voltage_of(aligned), fit.missed(found), limits),
        alternative=other,
        holds=found.kp > 0 and misfit < NO_LAW,
    )


def _count_at_limit(voltage: NDArray[np.float64], missed: NDArray[np.float64], limits: tuple[float, float]) -> int:
    """Return how many samples are at a limit while the law, which misses so much of the voltage, asks for more."""
    low, high = limits
    asked = voltage - missed
    return int(np.count_nonzero(~within(voltage, limits) & ((asked > high) | (asked < low))))


def loop_findings(record: Record, fit: LoopFit | None) -> Iterator[Finding]:
    """Yield findings about voltage and controller."""
    if record.has_loop:
        try:
            controller_voltage(record)
        except InputError as error:
            message = f"the controller cannot have run like this: {str(error).removeprefix(f'{record.name}: ')}."
            yield Finding(code="impossible_controller", severity="error", message=message)
    law = record.controller
    if law is not None and law.ki * law.kp < 0:
        message = f"ki = {law.ki:g} beside kp = {law.kp:g} drives the axis away from its reference; correct its sign."
        yield Finding(code="impossible_controller", severity="warning", message=message)
    if record.reference is None:
        message = "no reference is logged; the loop cannot be simulated, only the axis driven by its voltage."
        yield Finding(code="no_reference", severity="note", message=message)
    yield from _verified(record, fit)
    beyond = beyond_limit(record)
    if beyond:
        message = (
            f"the controller asks for more than the limit of {record.voltage_limit:g} {record.command_unit}"
            f" in {beyond} samples."
        )
        yield Finding(code="voltage_beyond_limit", severity="note", message=message)
    if fit is not None:
        if fit.at_limit >= FEWEST and not _believed(record, fit):
            yield _clipped(record, fit)
        contradiction = fit.alternative and _alternative(record, fit, fit.alternative)
        if contradiction:
            yield contradiction
        yield from _gains(record, fit)


def _verified(record: Record, fit: LoopFit | None) -> Iterator[Finding]:
    """Yield what of the law the log cannot verify, and that it shows time steps that the loop measured."""
    if record.voltage is None:
        message = "no voltage is logged; it is reconstructed from kp and kd, which therefore cannot be verified."
        yield Finding(code="voltage_reconstructed", severity="note", message=message)
    elif record.has_loop and fit is None and _is_slow(record):
        yield _unverified(record)
    elif fit is not None and fit.alternative is None and _measures_time(record):
        message = (
            "the controller computes speeds and integrals with the time that it measured between samples, not with a"
            " fixed period (time_step = measured); simulations do the same."
        )
        yield Finding(code="measured_intervals", severity="note", message=message)


def _measures_time(record: Record) -> bool:
    loop = record.controller
    return loop is not None and loop.time_step == "measured" and differs_by_time_steps(record)


def _unverified(record: Record) -> Finding:
    """Return the finding of a log that is slower than its loop, of which kp alone shows, and roughly."""
    ratio = _ratio_to_kp(record)
    if ratio is not None and not 1.0 / ROUGHLY < ratio < ROUGHLY:
        message = (
            f"while the axis hardly moves, the logged voltage is {ratio:.2g} times kp e; check the unit of kp, and"
            " whether this is the reference."
        )
        return Finding(code="gains_contradict_log", severity="warning", message=message)
    message = (
        "the log is slower than its loop; kd and the settings of the loop cannot be verified, and kp only roughly."
    )
    return Finding(code="law_not_verified", severity="note", message=message)


def _ratio_to_kp(record: Record) -> float | None:
    """Return the logged voltage over kp e, the median where kd hardly counts; None of other laws, or of too few."""
    loop, voltage, reference = record.controller, record.voltage, record.reference
    if loop is None or voltage is None or reference is None or record.feedforward is not None:
        return None
    if loop.is_cascade or loop.ki != 0.0 or loop.initial_integral != 0.0:
        return None
    asked = loop.kp * (reference - record.position)
    slowed = np.abs(loop.kd * np.gradient(record.position, record.time))
    tells = (
        (slowed < NO_LAW * np.abs(asked))
        & (np.abs(asked) > NO_LAW * rms(asked))
        & (np.abs(voltage) < np.abs(voltage).max())
    )
    return float(np.median(voltage[tells] / asked[tells])) if np.count_nonzero(tells) >= 10 else None


def _is_slow(record: Record) -> bool:
    try:
        return record.ticks > 1
    except InputError:  # of an impossible period, which is told by itself
        return False


def _believed(record: Record, fit: LoopFit) -> bool:
    """Tell whether the limits are the stated one."""
    limit = record.voltage_limit
    return limit is not None and all(math.isinf(x) or math.isclose(abs(x), limit, rel_tol=NEAR) for x in fit.limits)


def _clipped(record: Record, fit: LoopFit) -> Finding:
    unit, stated = record.command_unit, record.voltage_limit
    reached = [limit for limit in fit.limits if math.isfinite(limit)]
    one_sided = len(reached) == 1 or math.isclose(-reached[0], reached[1], rel_tol=NEAR)
    largest = max(map(abs, reached))
    known = "" if stated is None else f", whatever the stated limit of {stated:.4g} {unit}"
    what = f"amplifier or controller give no more{known}"
    cure = f"state voltage_limit = {largest:.4g} {unit}, or " if one_sided else ""
    message = (
        f"the logged voltage stays at {' and '.join(f'{limit:.4g}' for limit in reached)} {unit} for {fit.at_limit}"
        f" samples while the control law asks for more: {what}; {cure}log what the controller asks for."
    )
    return Finding(code="clipped_voltage", severity="warning", message=message)


def _alternative(record: Record, fit: LoopFit, other: Alternative) -> Finding | None:
    """Return the finding of what the voltage fits instead of what is stated; None where that is as stated."""
    unit = record.command_unit
    before, after = (readable(voltage, unit) for voltage in (other.before, other.left))
    left = f"unexplained voltage {before} r.m.s. as stated, {after} with this"
    if other.kind == "shift":
        return _shifted(other, _named(record, fit.kp, fit.kd))
    if other.kind == "scale":
        return _scaled(other, left)
    if other.kind == "unsigned":
        message = (
            f"the {other.column} has one sign throughout, and is the magnitude of what the control law asks for"
            f" ({left}); log it with its sign, or give it the sign of the direction that was logged beside it."
        )
        return Finding(code="unsigned_voltage", severity="error", message=message)
    loop = other.controller
    settings = [name for name in other.changed if name not in GAINS and not _is_alike(record, loop, name)]
    if loop.time_step == "measured" and settings != ["time_step"]:  # it is read off the log once the others are right
        settings = [name for name in settings if name != "time_step"]
    if not (settings or other.kind):
        return None
    if settings == ["integral_before"] and loop.ki == loop.integral_rate == 0:
        message = (
            f"the log fits with a constant {loop.initial_integral:.3g} {unit} added to the control law"
            f" ({left}); log what is added as feedforward."
        )
        return Finding(code="added_to_law", severity="warning", message=message)
    fits = [f"{_name(record, name)} = {_shown(record, loop, name)}" for name in settings]
    was = [_shown(record, record.controller, name, unit=False) for name in settings]
    message = f"the log fits {', '.join(fits)}, not {', '.join(was)} ({left}); correct what is stated."
    return Finding(code="settings_contradict_log", severity="warning", message=message)


def _is_alike(record: Record, loop: Controller, name: str) -> bool:
    """Tell whether a setting that was found is as it is stated, to the digits that are shown."""
    return _shown(record, loop, name) == _shown(record, record.controller, name)


def _name(record: Record, name: str) -> str:
    """Return what a setting is called where the record's law is stated."""
    return STATED_AS[name][0] if controller_of(record).is_cascade and name in STATED_AS else name


def _as_stated(controller: Controller, name: str) -> Any:
    """Return the value of a setting as the law states it: a cascade's integral gain, its share of the velocity."""
    value = controller.initial_integral if name == "integral_before" else getattr(controller, name)
    kv = controller.kd
    if not controller.is_cascade or name not in STATED_AS or kv == 0.0:
        return value
    return value * kv if name == "integral_rate" else value / kv


def _shown(record: Record, controller: Controller | None, name: str, *, unit: bool = True) -> str:
    """Return the value of a setting as it would be stated."""
    found, stated = (_as_stated(loop or Controller(kp=1.0), name) for loop in (controller, record.controller))
    if found is None:
        return "every sample"
    if not isinstance(found, float):
        return str(found)
    size = max(abs(found), abs(stated or 0.0))
    shown = f"{size * round(found / size, 3) + 0.0:.3g}" if size else "0"
    own = UNITS_OF.get(name, "") if _name(record, name) == name else STATED_AS[name][1]
    own = own if unit else ""
    return shown + own.format(command=record.command_unit, length=record.length_unit)


def _shifted(other: Alternative, fits: str) -> Finding:
    count = f"{abs(other.value):.0f} sample{'s' if abs(other.value) > 1 else ''}"
    late = other.value > 0
    if other.column == "voltage":
        message = f"the voltage is logged {count} {'after' if late else 'before'} its position; shift the column."
    else:
        against = "reference" if other.column == "position" else "position"
        message = (
            f"the {other.column} is logged {count} {'late' if late else 'early'} against {against} and voltage; shift"
            f" the column, and the voltage fits {fits}."
        )
    return Finding(code=f"{other.column}_shifted", severity="warning", message=message)


def _scaled(other: Alternative, left: str) -> Finding:
    """Return the finding of a column of the wrong sign or in the wrong unit."""
    column = "time stamps" if other.column == "time" else other.column
    if other.value < 0:
        message = f"the control law holds only with the other sign of the {column} ({left}); change the sign of it."
        return Finding(code="wrong_sign", severity="error", message=message)
    power = round(math.log10(other.value))
    match other.column:
        case "time":
            message = (
                f"the time stamps are 10^{power} times what the loop used ({left}); state their unit, as ms or us."
            )
        case "voltage":
            message = (
                f"the voltage is 10^{power} times what the control law asks for ({left}); state its unit, as mV, or"
                " that of the gains."
            )
        case _:
            message = (
                f"the control law holds only if the {column} is {UNITS[other.value]} ({left}); state the unit of each"
                " column."
            )
    return Finding(code="units_contradict", severity="error", message=message)


def _gains(record: Record, fit: LoopFit) -> Iterator[Finding]:
    """Yield that the voltage fits no gains, or other gains than stated."""
    stated, fits = record.controller, _named(record, fit.kp, fit.kd)
    if fit.misfit < NO_LAW and fit.kp * (1.0 if stated is None else stated.kp) < 0:
        message = f"the logged voltage fits {fits}: it has the other sign than the control law; change the sign of it."
        yield Finding(code="wrong_sign", severity="error", message=message)
    elif stated is None:
        if fit.misfit < 2 * DIFFERENCE:
            message = f"the gains are not stated; the logged voltage fits {fits}."
            yield Finding(code="gains_unknown", severity="note", message=message)
    elif fit.misfit > NO_LAW:
        message = (
            f"the logged voltage is not kp e − kd d: even {fits} leave {100 * fit.misfit:.0f} % of it;"
            " check sign, unit and derivative settings, or whether something is added to it."
        )
        yield Finding(code="law_contradicts_log", severity="warning", message=message)
    elif fit.difference > max(DIFFERENCE, 0.5 * fit.misfit, 2 * fit.rounding):
        cure = "correct the stated gains"
        if fit.misfit > DIFFERENCE:
            cure += f", or the settings of the derivative: {100 * fit.misfit:.2g} % of the voltage is left"
        if record.length_unit == "rad" and stated.kp:
            cure = _degrees(fit.kp / stated.kp) + cure
        message = f"the logged voltage fits {fits}, not {_named(record, stated.kp, stated.kd)}; {cure}."
        yield Finding(code="gains_contradict_log", severity="warning", message=message)


def _degrees(ratio: float) -> str:
    """Return what the ratio of fitted to stated gains says of degrees in place of radians; empty if nothing."""
    if math.isclose(ratio, math.radians(1.0), rel_tol=DIFFERENCE):
        return "position and reference seem to be in degrees: state their unit, or "
    return (
        "the stated gains seem to be per degree: " if math.isclose(ratio, math.degrees(1.0), rel_tol=DIFFERENCE) else ""
    )


def _named(record: Record, kp: float, kd: float) -> str:
    """Return the gains as the law at hand states them: of a cascade those of its position and of its speed."""
    volt, length, law = record.command_unit, record.length_unit, controller_of(record)
    if kd and law.is_cascade:
        return f"kp = {kp / kd:.4g} 1/s, kv = {kd:.4g} {volt} s/{length}"
    return f"kp = {kp:.4g} {volt}/{length}, kd = {0.0 if abs(kd) < 1e-9 * abs(kp) else kd:.4g} {volt} s/{length}"


def _with_gains(fitted: Controller, stated: Controller) -> Controller:
    return replace(fitted, kp=stated.kp, kd=stated.kd)


def _aligned(record: Record) -> Record:
    """Return the record from a tick of a slow loop on: there its voltage changes."""
    first = tick_phase(record)
    return record.slice(float(record.time[first]), float(record.time[-1])) if first else record


def _limited(record: Record) -> tuple[tuple[float, float], NDArray[np.bool_]]:
    """Return the limits of the logged voltage, and the samples that tell of the law."""
    limits = voltage_limits(record)
    free = within(voltage_of(record), limits)
    if initial_motion(record):
        free[: remembered(controller_of(record), record)] = False
    return limits, free


def _quiet(record: Record) -> NDArray[np.bool_]:
    """Mark the samples after what the loop remembers, and off the edges of the reference."""
    judged = np.ones(len(record), dtype=bool)
    edges = record.edges()
    span = math.ceil(RINGING / record.sample_time)
    if edges.size * span < 0.3 * len(record):
        for edge in edges.tolist():
            judged[edge : edge + span] = False
    judged[: remembered(controller_of(record), record)] = False
    return judged


def _robust(fit: LawFit) -> tuple[LawFit, Controller]:
    """Return the fit to the samples that are not off by more than four standard deviations, and its gains."""
    judged, found = fit.rows, fit.fitted(GAINS)
    for _ in range(3):
        left = np.abs(fit.missed(found))
        bound = max(4 * 1.4826 * float(np.median(left[fit.rows])), 1e-9 * float(np.max(np.abs(fit.voltage))))
        kept = judged & (left <= bound)
        if np.count_nonzero(kept) < 0.8 * np.count_nonzero(judged) or np.array_equal(kept, fit.rows):
            break
        fit = fit.over(kept)
        found = fit.fitted(GAINS)
    return fit, found
