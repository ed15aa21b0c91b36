"""The page of a study of measured records."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.quality import fatal
from servolens.report.content import Details, Findings, Lights, Section
from servolens.report.curves import curve
from servolens.report.diagnosis_story import diagnosis_sections
from servolens.report.figures import (
    Match,
    damping_in_time_figure,
    damping_law_figure,
    errors_figure,
    law_curve,
    match_figure,
    plant_formula,
    record_figure,
)
from servolens.report.gain_story import gain_section
from servolens.report.page import write_page
from servolens.report.wording import shown
from servolens.summaries import check_summary, gain_sentences, identification_summary, told_elsewhere
from servolens.summaries.diagnosis import remaining_sentences, verdict_sentence
from servolens.summaries.models import MODEL_WORDS, determined
from servolens.summaries.wording import capital, listed, number, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from servolens.findings import Finding
    from servolens.identification import Identification
    from servolens.plant import Plant
    from servolens.prediction import Prediction
    from servolens.record import Record
    from servolens.report.content import Block
    from servolens.report.curves import Curve, Role
    from servolens.study import Study

__all__ = ["damping_figures", "write_measured"]

MOST_STEPS = 3
MOST_DRAWN, MOST_BESIDE = 12, 4
"""Records in a figure, and in one of models that a diagnosis has left behind; the tables have all."""


def write_measured(path: Path, study: Study, held_out: Prediction | None, findings: Sequence[Finding]) -> None:
    """Write the page of a study, with what its models predict of records that they do not know.

    First what was measured against what was predicted, then where the error lives, its cause and what that is worth,
    then the gain; models and data follow for those who want to look closer.
    """
    title = f"Servo axis: {listed([shown(record.name) for record in study.records])}"
    lights = Lights(lights=study.lights)
    if study.diagnosis is None and fatal([finding for quality in study.check for finding in quality.findings]):
        lead = "Correct the records first: a sign or a unit in them is wrong, and no model is worth showing."
        told = Section(key="findings", title="What is wrong", blocks=(Findings(findings=study.findings),))
        write_page(path, title, lead, (lights,), [told, _data(study)])
        return
    sections = [*_found(study, held_out), gain_section(study)]
    if study.fit is not None:
        sections.append(_models(study, study.fit))
    sections += [_data(study), _open_questions(study, findings)]
    lead, more = _lead(study)
    write_page(path, title, lead, (lights, *more), sections)


def _found(study: Study, held_out: Prediction | None) -> list[Section]:
    """Return what the models predict and miss: by the diagnosis, or where there is none by damping alone."""
    if study.diagnosis is not None:
        return diagnosis_sections(study.diagnosis)
    reason = f"No cause was sought: {study.why_undiagnosed.rstrip('.')}."
    sought = Section(key="wrong", title="Where the error lives", blocks=(reason,))
    return [sought] if study.fit is None else [_validation(held_out), sought]


def _lead(study: Study) -> tuple[str, tuple[str, ...]]:
    """Return the gain or why there is none, and what else matters most."""
    first = gain_sentences(study, overrule="")[0]
    if study.diagnosis is not None:
        told = (verdict_sentence(study.diagnosis), *remaining_sentences(study.diagnosis))
    else:
        told = () if study.fit is None else identification_summary(study.fit).sentences[:2]
    if told and first in study.lights["gain"].sentence:
        return told[0], told[1:]
    return first, told


def _data(study: Study) -> Section:
    told = check_summary(study.check, length_unit=study.records[0].length_unit)
    runs = (*study.records, *study.heldout)
    whole = runs[:MOST_DRAWN]
    drawn = [_excerpt(record) for record in whole]
    rest = len(runs) - len(drawn)
    has_command = any(record.voltage is not None for record in whole)
    caption = "The records as they were logged: position and reference"
    caption += " above, the command below." if has_command else "; the command was not logged."
    if rest:
        caption += f" {rest} more {'record is' if rest == 1 else 'records are'} in the table only."
    if any(len(part) < len(record) for part, record in zip(drawn, whole, strict=True)):
        caption += f" Of records with many steps the first {MOST_STEPS} are drawn."
    if max(len(record) for record in drawn) > 10_000:
        caption += " Long records are drawn by the smallest and largest value of each run of samples."
    blocks: tuple[Block, ...] = (
        Summary(title="", sentences=told.sentences, tables=told.tables),
        _settings(study),
        record_figure("data", drawn, caption),
    )
    return Section(key="data", title="The data", blocks=blocks)


def _excerpt(record: Record) -> Record:
    """Return the first steps of a record that has many."""
    steps = record.steps()
    if len(steps) <= 2 * MOST_STEPS:
        return record
    return record.slice(float(record.time[0]), float(steps[MOST_STEPS - 1].time[-1]))


def _settings(study: Study) -> Table:
    rows = []
    for record, quality in zip((*study.records, *study.heldout), study.check, strict=True):
        speed = f"{number(quality.top_speed, 3)} {record.length_unit}/s"
        rows.append(
            (
                record.name,
                _gains(record),
                f"{number(record.step_size, 3)} {record.length_unit}",
                speed,
            )
        )
    return Table(
        title="What was done",
        columns=("Record", "Gains", "Step", "Top speed"),
        rows=tuple(rows),
    )


def _gains(record: Record) -> str:
    """Return the gains of a record's loop by their names in its law."""
    loop = record.controller
    if loop is None:
        return "–"
    if loop.is_cascade and loop.kd:
        integral = {"Kiv": loop.integral_rate * loop.kd}
        told = {"Kp": loop.kp / loop.kd, "Kv": loop.kd}
    else:
        integral, told = {"Ki": loop.ki}, {"Kp": loop.kp, "Kd": loop.kd}
    told |= {name: value for name, value in integral.items() if value}
    return ", ".join(f"{name} {number(value)}" for name, value in told.items())


def _open_questions(study: Study, findings: Sequence[Finding]) -> Section:
    blocks: list[Block] = []
    new = tuple(finding for finding in findings if not told_elsewhere(study, finding))
    if new:
        blocks.append(Findings(findings=new))
    elif not findings:
        blocks.append("Neither the records nor the identification gave a warning or a note.")
    record = study.records[0]
    fastest = max(quality.top_speed for quality in study.check[: len(study.records)])  # others were not fitted
    blocks.append(
        f"The axis moves at up to {number(fastest, 3)} {record.length_unit}/s in the records that were fitted; what the"
        " models say of higher speeds is extrapolated."
    )
    if len(study.records) == 1 and not study.heldout:
        blocks.append(
            "There is one record: nothing is held out, so how well the models predict other gains is not known."
        )
    return Section(key="findings", title="What the data leave open", blocks=tuple(blocks))


def _models(study: Study, fit: Identification) -> Section:
    """Return what is fitted without a cause: all there is without a diagnosis, and else what it started from."""
    told = identification_summary(fit)
    titles = {capital(MODEL_WORDS["varying"])}
    blocks: list[Block] = []
    if study.diagnosis is not None:
        blocks.append(
            "Models of gain and damping alone, by the paper's method, without the causes: the gain above does not"
            " follow from them."
        )
    blocks.append(Summary(title="", sentences=told.sentences))
    if fit.velocity is not None:
        blocks.append(plant_formula("law", fit.velocity.plant))
    blocks.append(Summary(title="", tables=tuple(table for table in told.tables if table.title not in titles)))
    blocks += [
        Details(title=f"{table.title}, in numbers", blocks=(table,)) for table in told.tables if table.title in titles
    ]
    blocks += damping_figures(fit)
    matches = _matches(fit, MOST_DRAWN if study.diagnosis is None else MOST_BESIDE)
    if matches:
        rest = len(fit.records) - len(matches)
        more = f" {rest} more {'record is' if rest == 1 else 'records are'} in the table only." if rest else ""
        blocks.append(
            match_figure(
                "matches",
                matches,
                "Measured and simulated responses, their difference below each. The models were identified from these"
                f" very records: not held out.{more}",
            )
        )
    title = "The models" if study.diagnosis is None else "Models without causes"
    return Section(key="models", title=title, blocks=tuple(blocks))


def damping_figures(fit: Identification) -> list[Block]:
    """Return damping in time and against speed, as far as the data determine it."""
    blocks: list[Block] = []
    known = np.zeros(0, dtype=np.bool_) if fit.varying is None else determined(fit.varying)
    if fit.varying is not None and known.any():
        blocks.append(
            damping_in_time_figure(
                "damping-in-time",
                [("Damping since the step", fit.varying)],
                "Damping that is constant on pieces of time, identified from these records (not held out), with 95 %"
                " intervals for the noise. If it stays level, damping is constant; if it rises as the axis slows down,"
                " something acts at low speed.",
            )
        )
    if fit.velocity is not None and fit.varying is not None and known.any():
        slowest, fastest = float(fit.varying.speed[known].min()), float(fit.varying.speed.max())
        speeds = slowest, 1.1 * fastest  # slower, no piece tells
        laws: list[Curve] = [law_curve("speed-dependent damping", fit.velocity.plant, speeds, "velocity")]
        if fit.law_from_pieces is not None:
            laws.append(law_curve("curve through the pieces", fit.law_from_pieces, speeds, "pieces"))
        if fit.constant is not None:
            laws.append(law_curve("constant damping", fit.constant.plant, speeds, "constant"))
        points = [curve("pieces", fit.varying.speed[known], fit.varying.damping[known], "varying")]
        blocks.append(
            damping_law_figure(
                "damping-law",
                [("Damping against speed", laws, points)],
                "The identified law, constant damping, and the pieces of the figure above at"
                " their mean speeds. From these records, not held out.",
                fit.records[0].length_unit,
            )
        )
    return blocks


def _matches(fit: Identification, most: int) -> list[Match]:
    models: list[tuple[str, Role, Plant]] = []
    if fit.constant is not None:
        models.append(("constant damping", "constant", fit.constant.plant))
    if fit.velocity is not None:
        models.append(("speed-dependent damping", "velocity", fit.velocity.plant))
    return [Match(record=_excerpt(record), models=tuple(models)) for record in fit.records[:most]] if models else []


def _validation(held: Prediction | None) -> Section:
    title = "Do the models predict records they have not seen?"
    if held is None:
        reason = "This takes at least two usable records; log a step with other gains, and give both."
        return Section(key="validation", title=title, blocks=(reason,))
    names = [row[0].name for row in held.errors]
    percents = np.array([[error.percent_error for error in row] for row in held.errors])
    constant, velocity = held.average_percent
    rows = [(name, *(number(p, 3) for p in row)) for name, row in zip(names, percents, strict=True)]
    rows.append(("average", number(constant, 3), number(velocity, 3)))
    blocks: list[Block] = [
        f"Held out, a record is {percent(constant)} of the step off with constant damping and {percent(velocity)} with"
        " damping that depends on speed, on average. Each record is simulated by models that were identified from"
        " others only.",
        Table(
            title="Mean absolute error on held-out records [% of the step]",
            columns=("Record", "constant damping", "speed-dependent damping"),
            rows=tuple(rows),
        ),
    ]
    if np.isfinite(percents).all() and (percents > 0).all():
        roles: tuple[tuple[str, Role], ...] = (
            ("constant damping", "constant"),
            ("speed-dependent damping", "velocity"),
        )
        drawn = slice(0, 3 * MOST_DRAWN)
        caption = "The errors of the table. Every record was held out from the models that simulate it."
        blocks.append(
            errors_figure("errors", names[drawn], roles, percents[drawn], np.full(percents.shape, True)[drawn], caption)
        )
    return Section(key="validation", title=title, blocks=tuple(blocks))
