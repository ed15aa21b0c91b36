"""The demo's page on the hidden axis: what was hidden, what was found, and what the gains do on the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.report.content import Section
from servolens.report.diagnosis_story import diagnosis_sections
from servolens.report.figures_design import columns, settling_figure
from servolens.report.playground import playground
from servolens.summaries import gain_sentences
from servolens.summaries.comparison import side_by_side
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import capital, number, plus_minus, unit
from servolens.summary import Table

if TYPE_CHECKING:
    from servolens.demo.hidden import HiddenAxis
    from servolens.diagnosis import Diagnosis
    from servolens.report.content import Block

__all__ = ["hidden_sections", "hidden_sentence"]


def hidden_sections(axis: HiddenAxis) -> list[Section]:
    """Return what was found of the axis, in the order of every page: what is missed, why, and the gain."""
    study = axis.study
    if study.diagnosis is None:
        reason = f"No cause was sought: {study.why_undiagnosed.rstrip('.')}."
        return [Section(key="wrong", title="Where the error lives", blocks=(reason,)), _gain(axis)]
    found = diagnosis_sections(study.diagnosis)
    truth = Section(key="truth", title="What the laboratory had hidden", blocks=(_parameters(axis, study.diagnosis),))
    return [*found, truth, _gain(axis)]


def hidden_sentence(axis: HiddenAxis) -> str:
    """Say what was done."""
    campaign = axis.campaign
    hidden = " and ".join(spoken(name) for name in campaign.truth.effects)
    return (
        f"The laboratory drew an axis, hid {hidden} in it, and logged {len(campaign.records)} runs to learn from and"
        f" {len(campaign.heldout)} to test with. What follows is what servolens tune makes of such records; it is not"
        " told what was hidden."
    )


def _gain(axis: HiddenAxis) -> Section:
    """Return the gain, on the model and on the true axis."""
    study = axis.study
    blocks: list[Block] = []
    if study.model is not None and study.design is not None:
        played = playground("gain", study.model, study.design)
        blocks += [] if played is None else [played]
    blocks += gain_sentences(study, overrule="")
    blocks.append(_on_axis(axis))
    if study.comparison is not None:
        models = columns(study.comparison)
        record = study.records[0]
        kd_unit = f"{record.command_unit} s/{record.length_unit}"
        blocks += [
            side_by_side(study.comparison, kd_unit, record.command_unit),
            settling_figure(
                "hidden-settling",
                models,
                "Settling time against Kd on each model of the hidden axis, with the gains that meet the spec shaded in"
                " its colour. Cross: a gain that breaks the spec on the diagnosed model. No measured data.",
            ),
        ]
    return Section(key="gain-found", title="The gain", blocks=tuple(blocks))


def _parameters(axis: HiddenAxis, diagnosis: Diagnosis) -> Table:
    """Return what was found beside what was hidden."""
    truth = axis.campaign.truth
    true = {"gain": truth.gain, "damping": truth.damping}
    true |= {f"{name}.{key}": value for name, values in truth.effects.items() for key, value in values.items()}
    rows = [
        (
            f"{spoken(name.rpartition('.')[0])}: {spoken_parameter(name.rpartition('.')[2])}" if "." in name else name,
            plus_minus(quantity),
            number(true.get(name)),
            unit(quantity.unit),
        )
        for name, quantity in diagnosis.model.quantities.items()
    ]
    return Table(
        title="Found from the records, and hidden by the laboratory",
        columns=("Parameter", "Found ± standard error", "Hidden", "Unit"),
        rows=tuple((capital(first), *rest) for first, *rest in rows),
    )


def _on_axis(axis: HiddenAxis) -> Table:
    design = axis.study.design
    limit = None if design is None else design.spec.settling_time
    rows = [(t.name, number(t.kd), number(t.settling_time), "yes" if t.meets else "no") for t in axis.tried]
    return Table(
        title="Tried on the true axis",
        columns=("Gain", "Kd", "Settles [s]", f"Within {number(limit)} s"),
        rows=tuple(rows),
        note="The laboratory's own physics and numerics, without sensor noise; – means that it does not settle.",
    )
