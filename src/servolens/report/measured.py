"""The report on a user's own records."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from servolens.errors import InputError, as_progress, described
from servolens.report.measured_story import write_measured
from servolens.report.printing import checked_page
from servolens.results import to_finite
from servolens.study import diagnosed_prediction, held_out_prediction, study_records

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design import PDSpec
    from servolens.findings import Finding
    from servolens.inputs import Records, RecordSettings
    from servolens.prediction import Prediction
    from servolens.study import Study

__all__ = ["write_report", "write_study"]


def write_report(
    path: str | os.PathLike[str],
    records: Records,
    *,
    spec: PDSpec | None = None,
    effort: str = "normal",
    progress: Callable[[str, int, int], None] | None = None,
    **settings: Unpack[RecordSettings],
) -> dict[str, Any]:
    """Write everything about `records` into one self-contained page.

    Parameters
    ----------
    path : str or path
        The page: .html, or .pdf, which Chromium prints.
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Runs of one axis.
    spec : PDSpec, optional
        What a PD gain has to achieve; when None, a spec that suits the records is chosen, and the page says which.
    effort : {"quick", "normal", "thorough"}
        How far the search for causes goes.
    progress : callable, optional
        Called with (description, done, total).
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

    Returns
    -------
    dict
        The fields of ``servolens.report/1``, its findings included.

    Raises
    ------
    InputError
        If there is no record, the name ends otherwise, there is no Chromium to print a PDF, or the file cannot be
        written.
    NumericalError
        If records that are fit for it do not determine gain and damping.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"the path of the page is needed first, then the records; got {described(path)}")
    checked_page(Path(path))
    tell = as_progress(progress)
    found = study_records(records, spec, effort=effort, progress=tell, **settings)
    return write_study(Path(path), found, progress=tell)


def write_study(
    path: Path, study: Study, *, progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None
) -> dict[str, Any]:
    """Write what a study found as one self-contained page.

    Parameters
    ----------
    path : Path
        The page: .html, or .pdf, which Chromium prints.
    study : Study
        Of one axis.
    progress : callable
        Is told (what, done, total).

    Returns
    -------
    dict
        The fields of ``servolens.report/1``, its findings included.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    held_out: Prediction | None = None
    lost: tuple[Finding, ...] = ()
    if study.diagnosis is None:
        progress("Predicting held-out records", 95, 100)
        held_out, lost = held_out_prediction(study)
    progress("Writing the page", 98, 100)
    findings = (*study.findings, *lost)
    write_measured(path, study, held_out, findings)
    progress("Page written", 100, 100)
    told = diagnosed_prediction(study) if held_out is None else held_out
    rows = [] if told is None else [[error.to_json() for error in row] for row in told.errors]
    names = [] if told is None else list(told.models)
    body: dict[str, Any] = to_finite({**study.to_json(), "held_out": {"models": names, "records": rows}})
    return {**body, "findings": [finding.to_json() for finding in findings]}
