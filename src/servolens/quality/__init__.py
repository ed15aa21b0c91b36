"""The health of a record: what its sampling, sensor, voltage and motion allow, told as findings.

Every check is linear in the number of samples, and every threshold follows from the noise and the encoder step seen
in the record itself, so that clean logs raise none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Unpack, final

from servolens.inputs import as_record
from servolens.quality.beginning import beginning_findings
from servolens.quality.jumps import jump_findings
from servolens.quality.loop import LoopFit, fit_loop, loop_findings
from servolens.quality.motion import motion_findings
from servolens.quality.sampling import Sampling, measure, sampling_findings
from servolens.quality.senses import exchanged_columns, sense_findings
from servolens.quality.spikes import spike_findings, spoilt, without_spikes
from servolens.results import with_reasons

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from servolens.findings import Finding
    from servolens.inputs import Records, RecordSettings
    from servolens.record import Record

__all__ = ["RecordQuality", "against_model", "assess", "fatal", "of_the_loop"]

FATAL = ("wrong_sign", "columns_exchanged", "unsigned_voltage", "units_contradict")
"""Errors with which a model can be computed, but is worthless: a model of them is written by force alone."""
OF_THE_LOOP = (
    "gains_contradict_log", "settings_contradict_log", "added_to_law", "law_contradicts_log", "impossible_controller",
    "position_shifted", "reference_shifted", "voltage_shifted", *FATAL,
)  # fmt: skip
"""Findings that what a log states of its loop is wrong: neither a simulation of that loop nor a gain for it is sure."""
REASONS = {
    "quantisation_step": "the position shows no steps beyond its noise",
    "voltage_range": "no voltage is logged",
    **dict.fromkeys(("fitted_kp", "fitted_kd", "law_misfit"), "no control law can be compared with a logged voltage"),
}
"""Why a field is null."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RecordQuality:
    """How good a record is.

    Attributes
    ----------
    name : str
        The record's.
    samples : int
        Number of samples.
    sample_time, duration : float
        [s]
    usable : bool
        False if a finding is an error: then nothing can be identified from the record.
    jitter : float
        Root mean square deviation of the sampling interval, lost samples apart [s].
    lost_samples : int
        Samples missing from the time grid.
    noise : float
        Standard deviation of the position's white noise [m or rad].
    quantisation_step : float or None
        Step in which the position is seen to move; None where it is finer than the noise shows.
    travel, top_speed : float
        Range of the position [m or rad]; largest speed over ten samples [m/s or rad/s].
    voltage_range : tuple of float or None
        Least and largest logged voltage [the record's command unit].
    fitted_kp, fitted_kd, law_misfit : float or None
        Gains that the logged voltage fits best, and what they leave of it, as a share of its root mean square; None
        where voltage or reference is missing.
    findings : tuple of Finding
        The reader's remarks, then what was seen here.
    """

    name: str
    samples: int
    sample_time: float
    duration: float
    usable: bool
    jitter: float
    lost_samples: int
    noise: float
    quantisation_step: float | None
    travel: float
    top_speed: float
    voltage_range: tuple[float, float] | None
    fitted_kp: float | None
    fitted_kd: float | None
    law_misfit: float | None
    findings: tuple[Finding, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the record's entry of the check schema; the findings stand beside the records there."""
        fields = {
            field: list(value) if isinstance(value := getattr(self, field), tuple) else value
            for field in self.__slots__
            if field != "findings"
        }
        return with_reasons(fields, REASONS)


def assess(record: Records, **settings: Unpack[RecordSettings]) -> RecordQuality:
    """Measure the record's quality and say what is wrong with it.

    A path, a DataFrame or a TimeResponseData will do, with ``kp``, ``kd`` … as keywords.

    Codes of the findings: ``too_few_samples``, ``uneven_stamps``, ``jitter``, ``gaps``, ``cycle_changes``,
    ``repeated_samples``, ``frozen_position``, ``coarse_quantisation``, ``encoder_contradicts_log``,
    ``constant_position``, ``weak_excitation``, ``dead_voltage``, ``motor_off``, ``wrong_sign``,
    ``columns_exchanged``, ``unsigned_voltage``, ``units_contradict``, ``unstable_log``, ``clipped_voltage``,
    ``voltage_beyond_limit``, ``impossible_controller``, ``gains_contradict_log``, ``settings_contradict_log``,
    ``added_to_law``, ``law_contradicts_log``, ``measured_intervals``, ``voltage_shifted``, ``position_shifted``,
    ``reference_shifted``, ``position_wraps``, ``position_jumps``, ``position_spikes``, ``gains_unknown``,
    ``no_reference``, ``onset_missed``, ``voltage_reconstructed``.

    Examples
    --------
    >>> from servolens import lab
    >>> quality = assess(lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1))
    >>> quality.usable, quality.findings
    (True, ())
    """
    record = as_record(record, settings)
    sampling = measure(record)
    fit, findings = _loop(record, sampling)
    told = any(finding.code in FATAL for finding in findings)
    exchanged = tuple(exchanged_columns(record))
    seen = exchanged or (
        *sampling_findings(record, sampling),
        *(() if told else sense_findings(record, sampling, law_holds=fit is not None and fit.holds)),
        *motion_findings(record, sampling),
        *jump_findings(record, sampling),
        *spike_findings(record, sampling),
        *_beginning(record, sampling, fit),
        *findings,
    )
    findings = (*record.remarks, *(replace(finding, record=record.name) for finding in seen))
    return _quality(record, sampling, fit, findings)


def fatal(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings for which no model is to be written: a wrong or missing sign or unit, exchanged columns.

    Other errors make a record unfit: nothing can be identified from it at all.

    Examples
    --------
    >>> from servolens import lab
    >>> record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1)
    >>> fatal(assess(record).findings)
    ()
    >>> mirrored = record.with_({"position": -record.position})
    >>> [finding.code for finding in fatal(assess(mirrored).findings)]
    ['wrong_sign']
    """
    return tuple(finding for finding in findings if finding.severity == "error" and finding.code in FATAL)


def against_model(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that make a model worthless which can be fitted all the same.

    Beside the :func:`fatal` ones a position that begins again after each turn, of which nothing is diagnosed.

    Examples
    --------
    >>> from servolens import lab
    >>> against_model(assess(lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1)).findings)
    ()
    """
    return tuple(finding for finding in findings if finding.code == "position_wraps" or fatal([finding]))


def of_the_loop(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that what a log states of its loop is wrong.

    Examples
    --------
    >>> from servolens import lab
    >>> record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1)
    >>> of_the_loop(assess(record).findings)
    ()
    >>> late = record.with_({"voltage": [0.0, *record.voltage[:-1]]})
    >>> [finding.code for finding in of_the_loop(assess(late).findings)]
    ['voltage_shifted']
    """
    return tuple(finding for finding in findings if finding.code in OF_THE_LOOP)


def _loop(record: Record, sampling: Sampling) -> tuple[LoopFit | None, tuple[Finding, ...]]:
    """Return the fitted control law and findings about it, but for those that are only of samples that stick out."""
    fit = fit_loop(record, sampling)
    found = tuple(loop_findings(record, fit))
    mended = without_spikes(record) if found else record
    if mended is not record:
        fit = fit_loop(mended, measure(mended), spoilt(mended))
        found = tuple(loop_findings(mended, fit))
    return fit, found


def _beginning(record: Record, sampling: Sampling, fit: LoopFit | None) -> Iterator[Finding]:
    """Yield findings about the beginning, but for a shift that the control law tells better."""
    for finding in beginning_findings(record, sampling):
        if finding.code != "reference_shifted" or fit is None or fit.alternative is None:
            yield finding


def _quality(record: Record, sampling: Sampling, fit: LoopFit | None, findings: tuple[Finding, ...]) -> RecordQuality:
    voltage = record.voltage
    return RecordQuality(
        name=record.name,
        samples=len(record),
        sample_time=sampling.sample_time,
        duration=record.duration,
        usable=all(finding.severity != "error" for finding in findings),
        jitter=sampling.jitter,
        lost_samples=sampling.lost,
        noise=sampling.noise,
        quantisation_step=sampling.step,
        travel=sampling.travel,
        top_speed=sampling.top_speed,
        voltage_range=None if voltage is None else (float(voltage.min()), float(voltage.max())),
        fitted_kp=None if fit is None else fit.kp,
        fitted_kd=None if fit is None else fit.kd,
        law_misfit=None if fit is None else fit.misfit,
        findings=findings,
    )
