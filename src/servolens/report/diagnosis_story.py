"""What a diagnosis tells on a page: a section of the report, and a page of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servolens.design import tune
from servolens.errors import ServolensError
from servolens.report.content import Details, Findings, Lights, Section
from servolens.report.figures import plant_equation
from servolens.report.figures_diagnosis import (
    candidates_figure,
    errors_figure,
    instrument_figure,
    shares_figure,
    telling_instrument,
)
from servolens.report.figures_prediction import prediction_figure
from servolens.report.figures_residuals import residuals_figure
from servolens.report.page import write_page
from servolens.report.playground import playground
from servolens.report.wording import shown, symbol_text
from servolens.study import diagnosis_lights, suggested_spec
from servolens.summaries.diagnosis import (
    advice,
    findings_of_logs,
    next_sentences,
    noise_sentences,
    other_findings,
    remaining_sentences,
    verdict_sentence,
    why_enough,
)
from servolens.summaries.diagnosis_tables import candidates_table, records_table, reliance
from servolens.summaries.evidence import CLEAR, instrument_sentence
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import capital, listed, plus_minus, unit
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    import os

    from servolens.diagnosis import Diagnosis
    from servolens.report.content import Block

__all__ = ["diagnosis_sections", "write_diagnosis_report"]

WHY = {
    "healthy": "Why nothing more is needed",
    "explained": "Why, and what to do",
    "partly_explained": "Why, as far as is known, and what to do",
    "unexplained": "What was tried",
}


def write_diagnosis_report(path: str | os.PathLike[str], diagnosis: Diagnosis) -> None:
    """Write a diagnosis as one self-contained page.

    Parameters
    ----------
    path : str or path
        The HTML or PDF file.
    diagnosis : Diagnosis
        What was found.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    names = [shown(record.name) for record in diagnosis.records]
    sections = [
        *diagnosis_sections(diagnosis),
        *_gains_to_try(diagnosis),
        Section(key="findings", title="Warnings and notes", blocks=_findings(diagnosis)),
    ]
    more = [Lights(lights=diagnosis_lights(diagnosis)), *_log(diagnosis), *remaining_sentences(diagnosis)]
    more.append(_tested(diagnosis))
    write_page(Path(path), f"Diagnosis: {listed(names)}", verdict_sentence(diagnosis), more, sections)


def diagnosis_sections(diagnosis: Diagnosis) -> list[Section]:
    """Return what a diagnosis shows: measured against predicted, where the error lives, and why."""
    where = "Where the error lives"
    if diagnosis.verdict != "healthy":
        where += ", and why" if diagnosis.causes else ""
    figure = prediction_figure("prediction", diagnosis)
    lost = "No model can be simulated on data that it was not fitted to: each diverges there."
    return [
        Section(key="prediction", title="Measured against predicted", blocks=(figure or lost,)),
        Section(key="wrong", title=where, blocks=_wrong(diagnosis)),
        Section(
            key="worth", title="Before and after" if diagnosis.causes else "Record by record", blocks=_gain(diagnosis)
        ),
        Section(key="causes", title=WHY[diagnosis.verdict], blocks=_why(diagnosis)),
    ]


def _gains_to_try(diagnosis: Diagnosis) -> list[Section]:
    """Return the model with sliders for the gains; nothing where no loop is known, or none settles."""
    try:
        spec = suggested_spec(diagnosis.records, diagnosis.plant)
        design = None if spec is None else tune(diagnosis.plant, spec).withhold("a diagnosis recommends none")
    except ServolensError:
        design = None
    if design is None:
        return []
    said = (
        "The model in simulation, with the largest kp of the records to begin with and a settling time that it can"
        " reach: what it says of gains, not what the axis will do. A diagnosis recommends no gain; servolens tune"
        " does, and says how far it can be trusted."
    )
    played = playground("gain", diagnosis.model, design)
    return [] if played is None else [Section(key="try", title="Try gains", blocks=(said, played))]


def _log(diagnosis: Diagnosis) -> list[str | Findings]:
    """Return what is wrong with the logs, which comes before all physics."""
    found = findings_of_logs(diagnosis)
    return (
        ["Correct the logs first: this may be the reason for what follows.", Findings(findings=found)] if found else []
    )


def _tested(diagnosis: Diagnosis) -> str:
    """Say which records were fitted, and on which the models were tested."""
    if diagnosis.heldout:
        fitted, held = (listed([shown(r.name) for r in runs]) for runs in (diagnosis.records, diagnosis.heldout))
        return f"Fitted to {fitted}; tested on {held}, held out."
    if len(diagnosis.records) > 1:
        return "No record was held out; as a test, each in turn was left out of the fit."
    return "There is one record; as a test, its end was held out of a second fit."


def _wrong(diagnosis: Diagnosis) -> tuple[Block, ...]:
    """Show what the simulation misses, and where."""
    blocks: list[Block] = []
    if diagnosis.verdict != "healthy" and diagnosis.where:
        blocks.append(shares_figure("wrong-shares", diagnosis.where))
    best, law = telling_instrument(diagnosis)
    said = instrument_sentence(best)
    blocks += [said] if said not in remaining_sentences(diagnosis) else []
    if best is not None and best.significance <= CLEAR:
        blocks.append(instrument_figure("wrong-instrument", diagnosis, best, law))
    if not blocks:
        blocks.append("The error is spread evenly over all that was measured.")
    return tuple(blocks)


def _why(diagnosis: Diagnosis) -> tuple[Block, ...]:
    """Tell causes, what to do, the model, and what else was tried."""
    blocks: list[Block] = [*(why_enough(diagnosis) if diagnosis.verdict == "healthy" else ())]
    blocks += [
        Summary(title=capital(spoken(c.effect)), sentences=tuple(advice(c, diagnosis))) for c in diagnosis.causes
    ]
    follows = next_sentences(diagnosis)
    if follows:
        blocks.append(Summary(title="To be sure", sentences=tuple(follows)))
    title = "The model with the causes" if diagnosis.causes else "The model of gain and damping"
    blocks += [Summary(title=title), plant_equation("wrong-model", diagnosis.plant), _symbols(diagnosis)]
    best = candidates_table(diagnosis)
    if best is not None:
        blocks += [Summary(title="Effects that were tried"), candidates_figure("wrong-candidates", diagnosis)]
        blocks.append(Details(title="The best in numbers", blocks=(best,)))
    return tuple(blocks)


def _symbols(diagnosis: Diagnosis) -> Table:
    """Return what each symbol of the equation means, and its value."""
    specs, rows = diagnosis.plant.parameters, []
    for name, quantity in diagnosis.model.quantities.items():
        effect, spec = name.rpartition(".")[0], specs[name]
        said = f"{spoken_parameter(spec.name)}{f' ({spoken(effect)})' if len(diagnosis.causes) > 1 and effect else ''}"
        text = unit(quantity.unit) if quantity.unit != "1" else ""
        rows.append((f"{capital(said)}: {spec.meaning}", symbol_text(spec.symbol), plus_minus(quantity), text))
    return Table(
        title="Its parameters, from the training records",
        columns=("Parameter", "Symbol", "Value ± standard error", "Unit"),
        rows=tuple(rows),
        note=reliance(diagnosis),
    )


def _gain(diagnosis: Diagnosis) -> tuple[Block, ...]:
    """Tell what the causes are worth, record by record."""
    drawable = any(np.isfinite(gain.before) and gain.before > 0 for gain in diagnosis.gains)
    figure = [errors_figure("wrong-gains", diagnosis)] if diagnosis.causes and drawable else []
    return (
        *noise_sentences(diagnosis),
        residuals_figure("wrong-residuals", diagnosis),
        *figure,
        records_table(diagnosis),
    )


def _findings(diagnosis: Diagnosis) -> tuple[Block, ...]:
    found = other_findings(diagnosis)
    return (Findings(findings=found),) if found else ("Neither the records nor the fits gave a warning or a note.",)
