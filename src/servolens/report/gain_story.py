"""What a study's page tells of the gain: how it moves, what it is worth, and what simpler models would have said."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design import gain_map, map_axes
from servolens.report.content import Section
from servolens.report.figures_design import columns, gains_figure, settling_figure, steps_figure
from servolens.report.gain_names import gain_names
from servolens.report.playground import playground
from servolens.summaries import comparison_summary, design_summary, gain_sentences
from servolens.summary import Summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design import Design
    from servolens.report.content import Block
    from servolens.report.figures_design import Column
    from servolens.study import Study

__all__ = ["gain_section"]

MAPPED = 50
"""Gains of each kind in the page's map."""


def gain_section(study: Study) -> Section:
    """Return the gain with its sliders, what it does, and what simpler models recommend; or why there is none."""
    return Section(key="design", title="The gain", blocks=tuple(_blocks(study)))


def _blocks(study: Study) -> list[Block]:
    design, comparison, model = study.design, study.comparison, study.model
    if design is None or comparison is None or model is None:
        return [*gain_sentences(study, overrule="")]
    length_unit, command_unit = study.records[0].length_unit, study.records[0].command_unit
    told = design_summary(design, forced=study.forced, length_unit=length_unit, command_unit=command_unit)
    sentences = told.sentences
    blocks: list[Block] = []
    if study.suggested:
        blocks.append(
            "No spec was given. This one takes the largest kp of the records and a settling time that the model can"
            " reach with a little to spare; ask for your own with kp and settling_time."
        )
    if design.withheld:
        sentences = sentences[1:]  # the first says no more
        blocks.append(
            "The gain is withheld, for the reason that its light gives. What follows is what the model says of gains,"
            " not what the axis will do."
        )
    played = playground("gain", model, design)
    blocks += [] if played is None else [played]
    blocks.append(Summary(title="", sentences=sentences, tables=told.tables))
    simpler = comparison_summary(comparison, with_best=False, length_unit=length_unit, command_unit=command_unit)
    new = tuple(sentence for sentence in simpler.sentences if sentence not in told.sentences)
    blocks.append(Summary(title="What simpler models recommend", sentences=new, tables=simpler.tables))
    return [*blocks, *_figures(columns(comparison), design)]


def _figures(models: Sequence[Column], design: Design) -> list[Block]:
    best = models[-1]
    names = gain_names(design.spec, best.plant)
    found = gain_map(best.plant, design.spec, *map_axes(best.plant, design.spec, count=MAPPED))
    blocks: list[Block] = [
        settling_figure(
            "settling",
            models,
            f"Settling time against {names.free} on each model, with the gains that meet the spec shaded in its colour."
            f" Cross: a gain that breaks the spec on the {best.name} model. Simulated, no measured data.",
        ),
        gains_figure(
            "map",
            found,
            design,
            best.plant,
            f"Both gains on the {best.name} model: how soon the step settles, how far it overshoots, and what the"
            f" controller makes of measurement noise ({best.plant.command_unit} for one {best.plant.length_unit} of"
            " white noise). White: it does not settle in twice the time asked for. Simulated, no measured data.",
        ),
    ]
    if any(model.design.kd is not None for model in models):
        blocks.append(
            steps_figure(
                "steps",
                models,
                f"Step responses of these gains on the {best.name} model, with the band and the time it holds from"
                " (dashed). Simulated, no measured data.",
            )
        )
    return blocks
