"""What the chosen model misses beyond the noise, and what the records say for and against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.errors import pooled, residual_in_phase
from servolens.identification.data_range import data_range
from servolens.identification.model_error import model_error
from servolens.identification.phases import own_phases
from servolens.identification.segments import applied_voltage
from servolens.model_evidence import MATERIAL, Evidence, Missed, Remainder
from servolens.quality import fatal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.errors import Gains
    from servolens.findings import Finding
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.noise import NoiseModel
    from servolens.model_evidence import How, Verdict
    from servolens.plant import Plant
    from servolens.record import Record

    Array = NDArray[np.float64]

__all__ = ["Remainder", "evidence_of", "held_errors", "remainder_of", "unexplained_acceleration"]


def remainder_of(case: Case, chosen: Hypothesis, gains: Gains) -> Remainder:
    """Return what `chosen`, the last of `gains`, misses of the training records, or of others if that is more.

    More of their own travel. What shakes an axis, and whether the inputs tell of what is left, is of those that were
    fitted.
    """
    noise = gains.noise
    trained = case.records, gains.fitted[-1]
    groups = [trained, (case.heldout, held_errors(case, chosen, gains))] if case.heldout else [trained]
    records, errors = max(groups, key=lambda group: _beyond(pooled(group[1]), noise) / _travel(case, group[0]))
    error, travel = pooled(errors), _travel(case, records)
    commands = (float(np.abs(applied_voltage(record)).max()) for record in (*case.records, *case.heldout))
    push = max(commands) * abs(chosen.plant.gain)
    is_finite = bool(np.isfinite(error))
    rms = _beyond(error, noise)
    depends = not case.is_enough(chosen)
    if chosen.noise.rate > 0.0 and not depends:  # simulations miss what the loops make of it; the noise model knows it
        missed, lasts = _shaking(chosen.noise, case.records[0].sample_time)
    else:
        missed, lasts = unexplained_acceleration(chosen.plant, records, errors, rate=case.likelihood.rate, noise=noise)
        in_loop = case.noise_in_loop(chosen)
        if is_finite and in_loop > noise:  # no force has to make up for what the noise does
            missed *= _beyond(error, in_loop) / max(rms, 1e-300)
        missed = missed if is_finite else error
    return Remainder(
        rms=rms,
        times_noise=error / noise if noise > 0.0 else None,
        of_travel=rms / travel,
        acceleration_rms=missed,
        correlation_time=lasts,
        of_motor=missed / max(push, 1e-300),
        depends_on_inputs=depends,
        material=rms > MATERIAL * travel,
        heldout=records is not case.records,
    )


def _beyond(error: float, noise: float) -> float:
    return float(np.sqrt(max(error**2 - noise**2, 0.0))) if np.isfinite(error) else error


def _travel(case: Case, records: Sequence[Record]) -> float:
    """Return the largest range of the position, that of the records that were fitted at least [m or rad]."""
    return max(case.travel, 1e-300, *(float(np.ptp(record.position)) for record in records))


def _shaking(noise: NoiseModel, sample_time: float) -> tuple[float, float]:
    """Return what shakes an axis, r.m.s. [m/s² or rad/s²], and its correlation time [s].

    That of the correlation exp(−τ²/2T²) with as much at low frequencies, which a loop answers to, as that of the first
    order has, whose integral is 2/corner.
    """
    _, power = noise.shaking(sample_time)
    return noise.spread * float(np.sqrt(power)), float(np.sqrt(2.0 / np.pi)) / noise.corner


def evidence_of(
    case: Case, chosen: Hypothesis, gains: Gains, verdict: Verdict, remainder: Remainder, findings: Sequence[Finding]
) -> Evidence:
    """Return what the records say for and against `chosen`, the last of `gains`."""
    missed = _missed(case, held_errors(case, chosen, gains))
    against = [f"{finding.record}: {finding.message}" for finding in fatal(findings)]
    if not np.isfinite([*(one.rms for one in missed), remainder.rms]).all():
        against.append("a record cannot be simulated with this model, or its simulation diverges")
    return Evidence(
        range=data_range((*case.records, *case.heldout)),
        verdict=verdict,
        remainder=remainder,
        heldout_of_step=max((one.of_step for one in missed), default=None),
        fatal=tuple(against),
        model_error=model_error(chosen.plant, (*case.records, *case.heldout)),
        noise=case.likelihood.white.spread,
        missed=missed,
    )


def _missed(case: Case, errors: Sequence[Array]) -> tuple[Missed, ...]:
    """Return what is missed of each record where it was not fitted."""
    hows: list[How] = ["held_out" for _ in case.heldout] or ["end" if cut else "left_out" for cut in case.cuts]
    return tuple(
        Missed(record=record.name, how=how, rms=pooled([error]), step=record.step_size)
        for record, how, error in zip(case.heldout or case.records, hows, errors, strict=True)
        if record.step_size > 0.0
    )


def held_errors(case: Case, chosen: Hypothesis, gains: Gains) -> Sequence[Array]:
    """Return the residuals where the plant was not fitted, but for phases of a record's own."""
    if not own_phases(chosen.plant):
        return gains.held[-1]
    if case.heldout:
        return [residual_in_phase(chosen.plant, record) for record in case.heldout]
    left_out = zip(case.left_out(chosen), case.records, case.cuts, strict=True)
    return [residual_in_phase(plant, record)[cut:] for plant, record, cut in left_out]


def unexplained_acceleration(
    plant: Plant, records: Sequence[Record], residuals: Sequence[Array], *, rate: float, noise: float
) -> tuple[float, float]:
    """Return the acceleration, r.m.s. [m/s² or rad/s²], that would make up the residuals, and its correlation time [s].

    In a loop whose axis has gain β and damping c, an error e that nothing else makes is that of the acceleration
    ë + (c + β kd)ė + β kp e; in a simulation that the voltage drives, of ë + cė. The derivatives are those of local
    cubics over the time in which the loop acts, 2/`rate`; the share that white noise of the sensor alone would have is
    taken off. The correlation time is the root of the ratio of the mean squares of the acceleration and of its rate:
    T of the correlation exp(−τ²/2T²), and 1/(2πf) of a sine; no more than the longest record.

    Parameters
    ----------
    plant : Plant
        That was simulated.
    records : sequence of Record
        The measurements.
    residuals : sequence of ndarray, shape (n,)
        Simulated minus measured position of each [m or rad].
    rate : float
        Of the loops [rad/s].
    noise : float
        Standard deviation of the sensor's noise [m or rad].
    """
    squares, samples = np.zeros(2), 0
    for record, error in zip(records, residuals, strict=True):
        window = int(min(max(2.0 / rate / record.sample_time, 7), len(record) // 2)) // 2 * 2 + 1
        if window < 5 or error.size <= window or not np.isfinite(error).all():
            continue
        squares += _mean_squares(plant.for_record(record), record, error, window, noise) * error.size
        samples += error.size
    longest = max(record.duration for record in records)
    if samples == 0 or squares[0] == 0.0:
        return 0.0, longest
    lasts = np.sqrt(squares[0] / max(squares[1], 1e-300))
    return float(np.sqrt(squares[0] / samples)), float(min(lasts, longest))


def _mean_squares(plant: Plant, record: Record, error: Array, window: int, noise: float) -> Array:
    """Return the mean squares, shape (2,), of the acceleration and of its rate without the noise's share."""
    from scipy.signal import savgol_coeffs, savgol_filter

    controller = record.controller if record.reference is not None else None
    stiffness, drag = 0.0, plant.damping
    if controller is not None:
        stiffness, drag = plant.gain * controller.kp, plant.damping + plant.gain * controller.kd
    step = record.sample_time
    curves = [savgol_filter(error, window, 3, deriv=k, delta=step) for k in range(4)]
    weights = [savgol_coeffs(window, 3, deriv=k, delta=step) for k in range(4)]
    found = []
    for k in range(2):
        curve, weight = (stiffness * s[k] + drag * s[k + 1] + s[k + 2] for s in (curves, weights))
        found.append(max(float(np.mean(curve**2)) - noise**2 * float(weight @ weight), 0.0))
    return np.array(found)
