"""The parts of the demo's page that design gains and hold them against the paper's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.demo.experiment import PAPER_ANSWERS, PRINTED, RECOMPUTED, SPEC, plant_of
from servolens.design import evaluate
from servolens.report.content import Section
from servolens.report.figures_design import columns, settling_figure, steps_figure
from servolens.summaries import comparison_summary
from servolens.summaries.wording import inside, number
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from servolens.demo.experiment import Demo
    from servolens.design import Comparison, Design, Response
    from servolens.report.content import Block

__all__ = ["design_section", "paper_section"]


def design_section(demo: Demo) -> Section:
    """Return the designs from the identified models."""
    fit, comparison = demo.fits[-1], demo.sampled[-1]
    assert fit.constant is not None  # noqa: S101 - the demo asks for all models
    assert fit.velocity is not None  # noqa: S101 - the demo asks for all models
    models = columns(comparison)
    told = comparison_summary(comparison)
    blocks: tuple[Block, ...] = (
        f"Eq. 36 asks for the least Kd with Kp = {SPEC['kp']:g} V/m such that a step of {SPEC['reference']:g} m stays"
        f" within ±{100 * SPEC['band']:g} % from {SPEC['settling_time']:g} s on. Below, both models come from the"
        " Kp 100 record.",
        Summary(title="", sentences=told.sentences, tables=told.tables),
        settling_figure(
            "settling",
            models,
            "Settling time against Kd on both models (digital loop), with the gains that meet the spec shaded (orange:"
            " linear, blue: nonlinear, grey: both). The curves"
            " jump where a swing of the response touches the edge of the band, so the feasible gains need not be one"
            " interval. Cross: the linear recommendation, where it really ends up. No measured data in this figure.",
        ),
        steps_figure(
            "steps",
            models,
            "Step responses of both recommendations on the nonlinear model, with the band and the time it holds from"
            " (dashed). Simulated, no measured data.",
        ),
        _cart_table(demo),
        _pairs_table(demo),
        _routes_table(demo),
    )
    return Section(key="design", title="The cart: the PD gain, linear against nonlinear", blocks=blocks)


def paper_section(demo: Demo) -> Section:
    """Return the designs from the paper's printed models."""
    worst = max(
        abs(a - b)
        for name, design in demo.printed.items()
        for ours, theirs in zip(design.intervals, RECOMPUTED[name], strict=False)
        for a, b in zip(ours, theirs, strict=True)
    )
    same = all(len(design.intervals) == len(RECOMPUTED[name]) for name, design in demo.printed.items())
    verdict = (
        f"All interval ends agree with an independent scan within {number(worst, 2)}."
        if same
        else "The number of intervals differs from that of an independent scan: see the table."
    )
    blocks: tuple[Block, ...] = (
        "The same search on the six models with the parameters that the paper prints, with the ideal continuous PD of"
        f" its eq. 15. {verdict}",
        _printed_table(demo),
        _answers_table(),
        "The paper's gains, 7.35 and 3.55, are not the least gains of its printed models, and 3.55 does not meet the"
        " spec on its own. Its conclusion stands all the same: the linear model asks for far more derivative gain, and"
        " that gain breaks the spec on the nonlinear one.",
    )
    return Section(key="paper", title="The cart: against the paper's printed models", blocks=blocks)


def _cart_table(demo: Demo) -> Table:
    limit = SPEC["settling_time"]
    rows = [
        (
            run.label,
            number(run.kd),
            number(run.settling_time),
            "yes" if run.settling_time is not None and run.settling_time <= limit else "no",
        )
        for run in demo.on_cart
    ]
    return Table(
        title="Tried on the virtual cart itself",
        columns=("Gain", "Kd [V s/m]", "Settles [s]", f"Within {limit:g} s"),
        rows=tuple(rows),
        note="The cart's own physics and numerics, without sensor noise. A least gain stands at the edge of what is"
        " feasible: the smallest error of the model can tip it over, so leave a margin.",
    )


def _pairs_table(demo: Demo) -> Table:
    rows = [(f"Lm{i} / NLm{i}", "digital", *_sides(pair)) for i, pair in enumerate(demo.sampled, start=1)]
    rows.append((f"Lm{len(rows)} / NLm{len(rows)}", "continuous", *_sides(demo.continuous)))
    return Table(
        title="Every pair of models, digital and continuous loop",
        columns=(
            "Models",
            "Loop",
            "Linear Kd",
            "settles on NLm [s]",
            "Nonlinear Kd",
            "settles [s]",
            "All gains of NLm",
        ),
        rows=tuple(rows),
    )


def _sides(comparison: Comparison) -> tuple[str, ...]:
    own = next(iter(comparison.nonlinear.verified), None)
    return (
        _least(comparison.linear),
        _time(comparison.linear_on_nonlinear),
        _least(comparison.nonlinear),
        _time(own),
        _spans(comparison.nonlinear.intervals),
    )


def _routes_table(demo: Demo) -> Table:
    rows = []
    for fit, by_pieces, comparison in zip(demo.fits, demo.by_pieces, demo.sampled, strict=True):
        direct = comparison.nonlinear
        kept = "–"
        if by_pieces.kd is not None:
            kept = _time(evaluate(demo.truth, by_pieces.spec, by_pieces.kd))
        rows.append((fit.records[0].name, _least(by_pieces), kept, _least(direct), _least(demo.on_truth)))
    return Table(
        title="What the two routes to the damping law cost: least Kd [V s/m], digital loop",
        columns=("Identified from", "Through the pieces", "settles on the truth [s]", "Integral equation", "True cart"),
        rows=tuple(rows),
    )


def _printed_table(demo: Demo) -> Table:
    rows = [
        (name, _spans(design.intervals), _spans(RECOMPUTED[name]), number(PAPER_ANSWERS.get(name)))
        for name, design in demo.printed.items()
    ]
    return Table(
        title="Gains that meet eq. 36",
        columns=("Model", "servolens", "Independent scan", "The paper's gain"),
        rows=tuple(rows),
    )


def _answers_table() -> Table:
    from servolens.design import PDSpec

    spec = PDSpec(**SPEC, control="continuous")
    nonlinear = plant_of(PRINTED["NLm3"])
    linear = plant_of(PRINTED["Lm3"])
    tried = (
        (6.28, "least gain of Lm3"),
        (7.35, "the paper's for Lm3"),
        (3.55, "the paper's for NLm3"),
        (3.79, "least gain of NLm3"),
    )
    rows = [
        (f"{kd:g}", what, _time(evaluate(linear, spec, kd)), _time(evaluate(nonlinear, spec, kd))) for kd, what in tried
    ]
    return Table(
        title="Settling times with these gains [s]; 0.5 s is asked for",
        columns=("Kd [V s/m]", "What it is", "on Lm3", "on NLm3"),
        rows=tuple(rows),
    )


def _least(design: Design) -> str:
    return "none" if design.kd is None else inside(*design.intervals[0])[0]


def _time(response: Response | None) -> str:
    return "–" if response is None else number(response.settling_time)


def _spans(intervals: tuple[tuple[float, float], ...]) -> str:
    return ", ".join("–".join(inside(*span)) for span in intervals) or "none"
