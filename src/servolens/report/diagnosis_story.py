"""What a diagnosis tells on a page: a section of the report, and a page of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.report.content import Findings, Section
from servolens.report.figures import plant_formula
from servolens.report.figures_diagnosis import (
    CLEAR,
    candidates_figure,
    gains_figure,
    instrument_figure,
    instrument_sentence,
    residuals_figure,
    shares_figure,
    telling_instrument,
)
from servolens.report.page import write_page
from servolens.report.wording import shown
from servolens.summaries.diagnosis import diagnosis_summary
from servolens.summaries.wording import listed
from servolens.summary import Summary

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.diagnosis import Diagnosis
    from servolens.report.content import Block

__all__ = ["WRONG", "diagnosis_section", "write_diagnosis_report"]

WRONG = "What the simulation gets wrong"


def write_diagnosis_report(path: Path, diagnosis: Diagnosis) -> None:
    """Write a diagnosis as one self-contained page.

    Parameters
    ----------
    path : Path
        The HTML file.
    diagnosis : Diagnosis
        What was found.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    told = diagnosis_summary(diagnosis)
    names = [shown(record.name) for record in diagnosis.records]
    wrong = Section(key="wrong", title=WRONG, blocks=(*_where(diagnosis), *_instrument(diagnosis)))
    sections = [wrong, _causes(diagnosis, told), _gain(diagnosis, told), _doubts(diagnosis)]
    write_page(path, f"Diagnosis: {listed(names)}", told.sentences[0], (), sections)


def diagnosis_section(diagnosis: Diagnosis) -> Section:
    """Return the report's section: the sentence first, then the pictures, then what follows from it."""
    told = diagnosis_summary(diagnosis)
    blocks = [
        told.sentences[0],
        *_where(diagnosis),
        *_instrument(diagnosis),
        *_causes(diagnosis, told).blocks,
        *_gain(diagnosis, told).blocks,
    ]
    return Section(key="wrong", title=WRONG, blocks=tuple(blocks))


def _where(diagnosis: Diagnosis) -> list[Block]:
    blocks: list[Block] = [residuals_figure("wrong-residuals", diagnosis)]
    if diagnosis.verdict != "healthy" and diagnosis.where:
        blocks.append(shares_figure("wrong-shares", diagnosis.where))
    return blocks


def _instrument(diagnosis: Diagnosis) -> list[Block]:
    best, law = telling_instrument(diagnosis)
    blocks: list[Block] = [instrument_sentence(best)]
    if best is not None and best.significance <= CLEAR:
        blocks.append(instrument_figure("wrong-instrument", diagnosis, best, law))
    return blocks


def _causes(diagnosis: Diagnosis, told: Summary) -> Section:
    """Tell causes, what to do, and what else was tried."""
    blocks: list[Block] = [Summary(title="", sentences=told.sentences[1:])]
    if diagnosis.causes:
        blocks += [plant_formula("wrong-model", diagnosis.plant), Summary(title="", tables=told.tables[:1])]
    if diagnosis.candidates:
        blocks.append(candidates_figure("wrong-candidates", diagnosis))
    elif not diagnosis.causes:
        blocks.append("No other effect was tried: gain and damping leave nothing to be explained.")
    return Section(key="causes", title="Why, and what to do", blocks=tuple(blocks))


def _gain(diagnosis: Diagnosis, told: Summary) -> Section:
    """Tell what the causes are worth, record by record."""
    blocks: list[Block] = []
    if diagnosis.causes and any(np.isfinite(gain.before) and gain.before > 0 for gain in diagnosis.gains):
        blocks.append(gains_figure("wrong-gains", diagnosis))
    blocks.append(Summary(title="", tables=told.tables[1 if diagnosis.causes else 0 :]))
    return Section(key="gain", title="Record by record", blocks=tuple(blocks))


def _doubts(diagnosis: Diagnosis) -> Section:
    if not diagnosis.findings:
        return Section(key="doubts", title="Doubts", blocks=("Neither the records nor the fits gave cause for doubt.",))
    return Section(key="doubts", title="Doubts", blocks=(Findings(findings=diagnosis.findings),))
