"""The summary of any result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.summaries.diagnosis import diagnosis_summary
from servolens.summaries.fits import fit_summary
from servolens.summaries.gains import design_summary
from servolens.summaries.models import identification_summary, prediction_summary

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design import Design
    from servolens.prediction import Prediction
    from servolens.result import Result
    from servolens.summary import Summary

__all__ = ["summary_of"]


def summary_of(result: Result) -> Summary:
    """Return what `result` says: sentences, tables and findings.

    Parameters
    ----------
    result : Result
        A fit, identification, diagnosis, design or prediction.
    """
    return SUMMARIES[result.kind](result)


def _design(design: Design) -> Summary:
    length_unit, command_unit = design.plant.length_unit, design.plant.command_unit
    return design_summary(
        design, lights=design.lights, in_python=True, length_unit=length_unit, command_unit=command_unit
    )


def _prediction(prediction: Prediction) -> Summary:
    unit = prediction.records[0].length_unit if prediction.records else "m"
    driven = [one.name for one in prediction.records if not one.has_loop]
    return prediction_summary(prediction, voltage_driven=driven, length_unit=unit)


SUMMARIES: dict[str, Callable[[Any], Summary]] = {
    "fit": fit_summary,
    "identification": identification_summary,
    "diagnosis": diagnosis_summary,
    "design": _design,
    "prediction": _prediction,
}
