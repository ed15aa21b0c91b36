"""One-page reports; the only place that draws."""

from servolens.report.measured import write_report

__all__ = ["write_report"]
