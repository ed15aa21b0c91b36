"""How well constant and speed-dependent damping predict records that they were not identified from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.errors import NumericalError, ServolensError
from servolens.findings import Finding
from servolens.identification import identify
from servolens.prediction import Prediction, prediction_error, record_error

if TYPE_CHECKING:
    from servolens.identification import Identification
    from servolens.prediction import RecordError
    from servolens.record import Record
    from servolens.study.result import Study

__all__ = ["diagnosed_prediction", "held_out_prediction"]

MOST_FOLDS = 6
"""Records are held out in at most so many groups."""


def diagnosed_prediction(study: Study) -> Prediction | None:
    """Return what the models of the diagnosis miss on data that they were not fitted to.

    ``"constant"`` is gain and damping alone, ``"diagnosed"`` the model with the causes. Where no record was held out,
    each is predicted by models that were fitted to the others, or its end by models fitted to its beginning.
    """
    found = study.diagnosis
    if found is None:
        return None
    rows = []
    for record, missed in zip(found.heldout or found.records, found.missed, strict=True):
        seen = record.slice(float(record.time[len(record) - missed[0].size]), float(record.time[-1]))
        rows.append(tuple(record_error(seen, own) for own in missed))
    return Prediction(models=("constant", "diagnosed"), errors=tuple(rows))


def held_out_prediction(study: Study) -> tuple[Prediction | None, tuple[Finding, ...]]:
    """Predict each record that the models come from by models that were identified from the others.

    Returns
    -------
    prediction : Prediction or None
        Of the constant and the speed-dependent model; None with fewer than two records.
    findings : tuple of Finding
        Which records could not be predicted.
    """
    records = () if study.fit is None else study.fit.records
    if len(records) < 2:
        return None, ()
    folds = min(len(records), MOST_FOLDS)
    rows: dict[int, tuple[RecordError, RecordError]] = {}
    findings = []
    for fold in range(folds):
        out = range(fold, len(records), folds)
        training = [record for i, record in enumerate(records) if i not in out]
        try:
            fit = identify(training)
            rows |= {i: _errors(fit, records[i]) for i in out}
        except ServolensError as error:
            message = f"could not be predicted from the other records: {error}."
            findings += [
                Finding(code="not_predicted", severity="note", message=message, record=records[i].name) for i in out
            ]
    errors = tuple(rows[i] for i in sorted(rows))
    return (Prediction(models=("constant", "velocity"), errors=errors) if errors else None), tuple(findings)


def _errors(fit: Identification, record: Record) -> tuple[RecordError, RecordError]:
    if fit.constant is None or fit.velocity is None:
        raise NumericalError("the models could not be identified")
    return prediction_error(fit.constant.plant, record), prediction_error(fit.velocity.plant, record)
