"""The report on a user's own records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design import compare
from servolens.diagnosis import diagnose
from servolens.errors import NumericalError, ServolensError
from servolens.findings import Finding
from servolens.identification import identify
from servolens.prediction import Prediction, prediction_error
from servolens.quality import assess
from servolens.report.measured_story import write_measured
from servolens.report.suggestion import suggested_spec
from servolens.results import to_finite

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from servolens.design import Comparison, PDSpec
    from servolens.diagnosis import Diagnosis
    from servolens.identification import Identification
    from servolens.prediction import RecordError
    from servolens.quality import RecordQuality
    from servolens.record import Record

__all__ = ["Measured", "write_report"]

MOST_DIAGNOSED = 10_000
"""Samples up to which the report looks for causes: beyond, the search takes minutes."""
MOST_FOLDS = 6
"""Records are held out in at most so many groups."""
SEVERITIES = ("error", "warning", "note")


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """What the report tells.

    Attributes
    ----------
    records : tuple of Record
        All of them.
    qualities : tuple of RecordQuality
        Of each.
    fit : Identification
        From all usable records together.
    held_out : Prediction or None
        Of each usable record by models that were identified without it; None with fewer than two.
    diagnosis : Diagnosis or None
        What gain and damping lack; None where it was not looked for.
    why_undiagnosed : str
        Why there is no diagnosis.
    comparison : Comparison or None
        The design; None where none can be asked for.
    why_none : str
        Why there is no comparison.
    suggested : bool
        Whether the spec was chosen here.
    findings : tuple of Finding
        Warnings and notes, worst first.
    """

    records: tuple[Record, ...]
    qualities: tuple[RecordQuality, ...]
    fit: Identification
    held_out: Prediction | None
    diagnosis: Diagnosis | None
    why_undiagnosed: str
    comparison: Comparison | None
    why_none: str
    suggested: bool
    findings: tuple[Finding, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.report/1`` without the file's header."""
        held = self.held_out
        rows = [] if held is None else [[error.to_json() for error in row] for row in held.errors]
        return {
            "check": {"records": [quality.to_json() for quality in self.qualities]},
            "identification": self.fit.to_json(),
            "held_out": {"models": [] if held is None else list(held.models), "records": rows},
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_json(),
            "comparison": None if self.comparison is None else self.comparison.to_json(),
            "reason": self.why_none or None,
        }


def write_report(
    path: Path,
    records: Sequence[Record],
    *,
    spec: PDSpec | None = None,
    effort: str = "normal",
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Write everything about `records` into one self-contained page.

    Parameters
    ----------
    path : Path
        The HTML file.
    records : sequence of Record
        Runs of one axis.
    spec : PDSpec, optional
        What a PD gain has to achieve; when None, a spec that suits the records is chosen, and the page says which.
    effort : {"quick", "normal", "thorough"}
        How far the search for causes goes.
    progress : callable, optional
        Called with (description, done, total).

    Returns
    -------
    dict
        The fields of ``servolens.report/1``, its findings included.

    Raises
    ------
    InputError
        If nothing can be identified from the records, or the file cannot be written.
    """
    tell = progress or (lambda *_: None)
    runs = tuple(records)
    tell("checking", 0, 100)
    qualities = tuple(assess(record) for record in runs)
    usable = [record for record, quality in zip(runs, qualities, strict=True) if quality.usable]
    tell("identifying", 2, 100)
    fit = identify(usable or runs)
    tell("predicting held-out records", 5, 100)
    held_out, lost = _held_out(usable)
    diagnosis, undiagnosed = _diagnosed(usable, effort, lambda what, done, _: tell(what, 10 + round(0.8 * done), 100))
    tell("designing", 90, 100)
    wanted = spec or suggested_spec(fit)
    comparison, why = _compared(fit, wanted)
    told = {(f.code, f.message, f.record): f for q in qualities for f in q.findings}
    told |= {(f.code, f.message, f.record): f for f in (*fit.findings, *lost)}
    measured = Measured(
        records=runs,
        qualities=qualities,
        fit=fit,
        held_out=held_out,
        diagnosis=diagnosis,
        why_undiagnosed=undiagnosed,
        comparison=comparison,
        why_none=why,
        suggested=spec is None,
        findings=tuple(sorted(told.values(), key=lambda f: SEVERITIES.index(f.severity))),
    )
    tell("writing the page", 95, 100)
    write_measured(path, measured)
    tell("report written", 100, 100)
    body: dict[str, Any] = to_finite(measured.to_json())
    return {**body, "findings": [finding.to_json() for finding in measured.findings]}


def _diagnosed(
    records: Sequence[Record], effort: str, tell: Callable[[str, int, int], None]
) -> tuple[Diagnosis | None, str]:
    """Return what gain and damping lack in these records, or why that is not told."""
    samples = sum(len(record) for record in records)
    if not records:
        return None, "no record is fit for it"
    if samples > MOST_DIAGNOSED:
        return None, (
            f"{samples} samples are many, and a search for causes in them takes minutes; ask for it with servolens"
            " diagnose, which writes a page of its own with --report"
        )
    try:
        return diagnose(records, effort=effort, progress=tell), ""
    except ServolensError as error:
        return None, str(error)


def _held_out(records: Sequence[Record]) -> tuple[Prediction | None, list[Finding]]:
    """Predict each record by models that were identified from the others."""
    if len(records) < 2:
        return None, []
    folds = min(len(records), MOST_FOLDS)
    rows: dict[int, tuple[RecordError, RecordError]] = {}
    findings = []
    for fold in range(folds):
        out = range(fold, len(records), folds)
        training = [record for i, record in enumerate(records) if i not in out]
        for i in out:
            try:
                fit = identify(training, model="all")
                rows[i] = _errors(fit, records[i])
            except ServolensError as error:
                message = f"could not be predicted from the other records: {error}."
                findings.append(Finding(code="not_predicted", severity="note", message=message, record=records[i].name))
    errors = tuple(rows[i] for i in sorted(rows))
    return (Prediction(models=("constant", "velocity"), errors=errors) if errors else None), findings


def _errors(fit: Identification, record: Record) -> tuple[RecordError, RecordError]:
    if fit.constant is None or fit.velocity is None:
        raise NumericalError("the models could not be identified")
    return prediction_error(fit.constant.plant, record), prediction_error(fit.velocity.plant, record)


def _compared(fit: Identification, spec: PDSpec | None) -> tuple[Comparison | None, str]:
    if spec is None:
        return (
            None,
            "the gains of the loop are unknown or the models settle with no gain; ask with kp and settling_time",
        )
    if fit.constant is None or fit.velocity is None:
        return None, "the models could not be identified"
    try:
        return compare(fit.constant.plant, fit.velocity.plant, spec), ""
    except (NumericalError, np.linalg.LinAlgError) as error:
        return None, str(error)
