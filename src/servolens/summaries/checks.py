"""What a check of records says."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from servolens.summaries.wording import listed, number, scale
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.findings import Finding
    from servolens.quality import RecordQuality

__all__ = ["check_summary"]


def check_summary(
    qualities: Sequence[RecordQuality], of_all: Sequence[Finding] = (), *, length_unit: str = "m"
) -> Summary:
    """Tell which records can be used, and how they were sampled; warnings are the summary's findings.

    Parameters
    ----------
    qualities : sequence of RecordQuality
        One a record.
    of_all : sequence of Finding
        On the records together.
    length_unit : str
        Of the records.
    """
    unfit = [quality.name for quality in qualities if not quality.usable]
    findings = [*(finding for quality in qualities for finding in quality.findings), *of_all]
    warnings = len({finding.message for finding in findings if finding.severity == "warning"})  # told once for all
    return Summary(
        title="Check",
        sentences=(_verdict(len(qualities), unfit), *_counted(warnings)),
        tables=(_table(qualities, length_unit),),
        findings=tuple(findings),
    )


def _verdict(count: int, unfit: Sequence[str]) -> str:
    if not unfit:
        return {1: "The record can be used.", 2: "Both records can be used."}.get(
            count, f"All {count} records can be used."
        )
    if count == 1:
        return "The record is unfit for identification as it is; the errors below say why."
    return f"{len(unfit)} of {count} records are unfit for identification as they are: {listed(unfit)}."


def _counted(warnings: int) -> list[str]:
    if not warnings:
        return []
    return [
        f"{'One warning says' if warnings == 1 else f'{warnings} warnings say'} what to know before trusting a number."
    ]


def _table(qualities: Sequence[RecordQuality], length_unit: str) -> Table:
    rounding = [(quality.quantisation_step or 0.0) / math.sqrt(12.0) for quality in qualities]
    noise = [max(quality.noise, own) for quality, own in zip(qualities, rounding, strict=True)]
    is_rounded = any(own > quality.noise for quality, own in zip(qualities, rounding, strict=True))
    factor, length = scale(noise, length_unit)
    rows = [
        (
            quality.name,
            str(quality.samples),
            number(1e3 * quality.sample_time),
            number(quality.duration),
            number(factor * own, 2),
            str(sum(finding.severity != "note" for finding in quality.findings)),
            "yes" if quality.usable else "no",
        )
        for quality, own in zip(qualities, noise, strict=True)
    ]
    return Table(
        title="Records",
        columns=(
            "Record",
            "Samples",
            "Sample time [ms]",
            "Duration [s]",
            f"Fast noise{' or rounding' if is_rounded else ''} [{length}]",
            "Warnings and errors",
            "Usable",
        ),
        rows=tuple(rows),
    )
