"""The demo's page on the hidden axis: what was hidden, what was found, and what the gains do on the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.report.content import Lights, Section
from servolens.report.figures_design import columns, settling_figure, steps_figure
from servolens.report.figures_residuals import residuals_figure
from servolens.summaries import gain_sentences
from servolens.summaries.comparison import side_by_side
from servolens.summaries.diagnosis import advice, verdict_sentence
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import capital, number, plus_minus, unit
from servolens.summary import Table

if TYPE_CHECKING:
    from servolens.demo.hidden import HiddenAxis
    from servolens.diagnosis import Diagnosis
    from servolens.report.content import Block

__all__ = ["hidden_section"]


def hidden_section(axis: HiddenAxis) -> Section:
    """Return the section."""
    study, campaign = axis.study, axis.campaign
    hidden = " and ".join(spoken(name) for name in campaign.truth.effects)
    blocks: list[Block] = [
        f"The laboratory drew another axis, hid {hidden} in it, and logged {len(campaign.records)} runs to learn from"
        f" and {len(campaign.heldout)} to test with. What follows is what `servolens tune` makes of such records; it is"
        " not told what was hidden.",
    ]
    if study.diagnosis is not None:
        blocks += [verdict_sentence(study.diagnosis), residuals_figure("hidden-residuals", study.diagnosis)]
        blocks += [sentence for cause in study.diagnosis.causes for sentence in advice(cause, study.diagnosis)]
        blocks.append(_parameters(axis, study.diagnosis))
    blocks += [Lights(lights=study.lights), *gain_sentences(study)]
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
            steps_figure(
                "hidden-steps",
                models,
                "Step responses of these gains on the diagnosed model, with the band and the time it holds from"
                " (dashed). No measured data.",
            ),
        ]
    blocks.append(_on_axis(axis))
    return Section(key="hidden", title="Another axis, whose lack is not known", blocks=tuple(blocks))


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
