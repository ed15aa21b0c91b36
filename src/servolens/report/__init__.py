"""One-page reports; the only place that draws."""

from servolens.report.diagnosis_story import write_diagnosis_report
from servolens.report.measured import write_report, write_study

__all__ = ["write_diagnosis_report", "write_report", "write_study"]
