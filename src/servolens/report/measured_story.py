"""The page of the report on measured records."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.report.content import Findings, Section
from servolens.report.curves import curve
from servolens.report.diagnosis_story import WRONG, diagnosis_section
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
from servolens.report.figures_design import settling_figure, steps_figure
from servolens.report.page import write_page
from servolens.report.wording import shown
from servolens.summaries import check_summary, comparison_summary, identification_summary
from servolens.summaries.wording import listed, number, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.report.content import Block
    from servolens.report.curves import Curve, Role
    from servolens.report.measured import Measured

__all__ = ["write_measured"]

MOST_STEPS = 3
MOST_DRAWN = 12
"""Records in a figure; the tables have all."""


def write_measured(path: Path, measured: Measured) -> None:
    """Write the page."""
    names = [shown(record.name) for record in measured.records]
    sections = [
        _data(measured),
        _open_questions(measured),
        _models(measured),
        _validation(measured),
        _wrong(measured),
        _design(measured),
    ]
    lead, more = _lead(measured)
    write_page(path, f"Servo axis: {listed(names)}", lead, more, sections)


def _lead(measured: Measured) -> tuple[str, tuple[str, ...]]:
    fit = identification_summary(measured.fit).sentences
    if measured.comparison is None:
        return fit[0], fit[1:2]
    told = _compared(measured).sentences
    return " ".join(told[:2]), fit[:2]


def _data(measured: Measured) -> Section:
    told = check_summary(measured.qualities, length_unit=measured.records[0].length_unit)
    whole = measured.records[:MOST_DRAWN]
    drawn = [_excerpt(record) for record in whole]
    rest = len(measured.records) - len(drawn)
    caption = "The records as they were logged: position and reference above, the command below."
    if rest:
        caption += f" {rest} more records are in the table only."
    if any(len(part) < len(record) for part, record in zip(drawn, whole, strict=True)):
        caption += f" Of records with many steps the first {MOST_STEPS} are drawn."
    if max(len(record) for record in drawn) > 10_000:
        caption += " Long records are drawn by the smallest and largest value of each run of samples."
    blocks: tuple[Block, ...] = (
        Summary(title="", sentences=told.sentences, tables=told.tables),
        _settings(measured),
        record_figure("data", drawn, caption),
    )
    return Section(key="data", title="The data", blocks=blocks)


def _excerpt(record: Record) -> Record:
    """Return the first steps of a record that has many."""
    steps = record.steps()
    if len(steps) <= 2 * MOST_STEPS:
        return record
    return record.slice(float(record.time[0]), float(steps[MOST_STEPS - 1].time[-1]))


def _settings(measured: Measured) -> Table:
    rows = []
    for record, quality in zip(measured.records, measured.qualities, strict=True):
        loop = record.controller
        gains = ("–", "–") if loop is None else (number(loop.kp), number(loop.kd))
        speed = f"{number(quality.top_speed, 3)} {record.length_unit}/s"
        rows.append(
            (record.name, number(record.duration), *gains, f"{number(record.step_size, 3)} {record.length_unit}", speed)
        )
    return Table(
        title="What was done",
        columns=("Record", "Duration [s]", "Kp", "Kd", "Step", "Top speed"),
        rows=tuple(rows),
    )


def _open_questions(measured: Measured) -> Section:
    blocks: list[Block] = []
    if measured.findings:
        blocks.append(Findings(findings=measured.findings))
    else:
        blocks.append("Neither the records nor the identification gave a warning or a note.")
    record = measured.records[0]
    fastest = max(quality.top_speed for quality in measured.qualities)
    blocks.append(
        f"The axis moves at up to {number(fastest, 3)} {record.length_unit}/s in these records; what the models say of"
        " higher speeds is extrapolated."
    )
    if len(measured.records) == 1:
        blocks.append(
            "There is one record: nothing is held out, so how well the models predict other gains is not known."
        )
    return Section(key="findings", title="What the data leave open", blocks=tuple(blocks))


def _models(measured: Measured) -> Section:
    fit = measured.fit
    told = identification_summary(fit)
    blocks: list[Block] = [Summary(title="", sentences=told.sentences)]
    if fit.velocity is not None:
        blocks.append(plant_formula("law", fit.velocity.plant))
    blocks.append(Summary(title="", tables=told.tables))
    blocks += _damping_figures(measured)
    matches = _matches(measured)
    if matches:
        rest = len(fit.records) - len(matches)
        more = f" {rest} more records are in the table only." if rest else ""
        blocks.append(
            match_figure(
                "matches",
                matches,
                "Measured and simulated responses, their difference below each. The models were identified from these"
                f" very records: not held out.{more}",
            )
        )
    return Section(key="models", title="The models", blocks=tuple(blocks))


def _damping_figures(measured: Measured) -> list[Block]:
    fit = measured.fit
    blocks: list[Block] = []
    if fit.varying is not None:
        blocks.append(
            damping_in_time_figure(
                "damping-in-time",
                [("Damping since the step", fit.varying)],
                "Damping that is constant on pieces of time, identified from these records (not held out), with 95 %"
                " intervals for the noise. If it stays level, damping is constant; if it rises as the axis slows down,"
                " something acts at low speed.",
            )
        )
    if fit.velocity is not None and fit.varying is not None:
        fastest = 1.1 * float(fit.varying.speed.max())
        laws: list[Curve] = [law_curve("speed-dependent damping", fit.velocity.plant, fastest, "velocity")]
        if fit.law_from_pieces is not None:
            laws.append(law_curve("curve through the pieces", fit.law_from_pieces, fastest, "pieces"))
        if fit.constant is not None:
            laws.append(law_curve("constant damping", fit.constant.plant, fastest, "constant"))
        points = [curve("pieces", fit.varying.speed, fit.varying.damping, "varying")]
        blocks.append(
            damping_law_figure(
                "damping-law",
                [("", laws, points)],
                "Damping against speed: the identified law, constant damping, and the pieces of the figure above at"
                " their mean speeds. From these records, not held out.",
                measured.records[0].length_unit,
            )
        )
    return blocks


def _matches(measured: Measured) -> list[Match]:
    fit = measured.fit
    models: list[tuple[str, Role, Plant]] = []
    if fit.constant is not None:
        models.append(("constant damping", "constant", fit.constant.plant))
    if fit.velocity is not None:
        models.append(("speed-dependent damping", "velocity", fit.velocity.plant))
    return (
        [Match(record=_excerpt(record), models=tuple(models)) for record in fit.records[:MOST_DRAWN]] if models else []
    )


def _validation(measured: Measured) -> Section:
    held = measured.held_out
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


def _wrong(measured: Measured) -> Section:
    if measured.diagnosis is None:
        reason = f"No cause was sought: {measured.why_undiagnosed.rstrip('.')}."
        return Section(key="wrong", title=WRONG, blocks=(reason,))
    return diagnosis_section(measured.diagnosis)


def _design(measured: Measured) -> Section:
    comparison, fit = measured.comparison, measured.fit
    title = "The PD gain, linear against nonlinear"
    if comparison is None or fit.constant is None or fit.velocity is None:
        return Section(key="design", title=title, blocks=(f"No gain was sought: {measured.why_none}.",))
    told = _compared(measured)
    blocks: list[Block] = []
    if measured.suggested:
        blocks.append(
            "No spec was given. This one takes the largest Kp of the records and a settling time that the nonlinear"
            " model can reach with a little to spare; ask for your own with kp and settling_time."
        )
    blocks.append(Summary(title="", sentences=told.sentences, tables=told.tables))
    linear, nonlinear = fit.constant.plant, fit.velocity.plant
    blocks.append(
        settling_figure(
            "settling",
            comparison,
            linear,
            nonlinear,
            "Settling time against Kd on both models, with the gains that meet the spec shaded (orange: linear, blue:"
            " nonlinear, grey: both). Cross: a recommendation that breaks the spec on the nonlinear model. Simulated,"
            " no measured data.",
        )
    )
    if comparison.linear.kd is not None or comparison.nonlinear.kd is not None:
        blocks.append(
            steps_figure(
                "steps",
                comparison,
                nonlinear,
                "Step responses of the recommendations on the nonlinear model, with the band and the time it holds from"
                " (dashed). Simulated, no measured data.",
            )
        )
    return Section(key="design", title=title, blocks=tuple(blocks))


def _compared(measured: Measured) -> Summary:
    assert measured.comparison is not None  # noqa: S101 - the callers checked
    record = measured.records[0]
    return comparison_summary(measured.comparison, length_unit=record.length_unit, command_unit=record.command_unit)
