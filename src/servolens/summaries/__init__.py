"""What results say to people: each as one :class:`~servolens.summary.Summary` for terminal and page alike."""

from servolens.summaries.checks import check_summary
from servolens.summaries.comparison import comparison_summary
from servolens.summaries.diagnosis import diagnosis_summary, experiment_summary
from servolens.summaries.experiment import demo_summary, hidden_summary
from servolens.summaries.fits import fit_summary
from servolens.summaries.fleet import fleet_summary
from servolens.summaries.gains import design_summary, gains_summary, map_summary
from servolens.summaries.models import identification_summary, model_table, prediction_summary
from servolens.summaries.reading import reading_summary
from servolens.summaries.shown import summary_of
from servolens.summaries.tuning import compared_summary, gain_sentences, told_elsewhere, tuning_summaries

__all__ = [
    "check_summary",
    "compared_summary",
    "comparison_summary",
    "demo_summary",
    "design_summary",
    "diagnosis_summary",
    "experiment_summary",
    "fit_summary",
    "fleet_summary",
    "gain_sentences",
    "gains_summary",
    "hidden_summary",
    "identification_summary",
    "map_summary",
    "model_table",
    "prediction_summary",
    "reading_summary",
    "summary_of",
    "told_elsewhere",
    "tuning_summaries",
]
