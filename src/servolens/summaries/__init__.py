"""What results say to people: each as one :class:`~servolens.summary.Summary` for terminal and page alike."""

from servolens.summaries.checks import check_summary
from servolens.summaries.diagnosis import diagnosis_summary, experiment_summary
from servolens.summaries.experiment import demo_summary
from servolens.summaries.gains import comparison_summary, design_summary
from servolens.summaries.models import identification_summary, model_table, prediction_summary

__all__ = [
    "check_summary",
    "comparison_summary",
    "demo_summary",
    "design_summary",
    "diagnosis_summary",
    "experiment_summary",
    "identification_summary",
    "model_table",
    "prediction_summary",
]
