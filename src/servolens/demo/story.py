"""The demo's page: what was measured, what it cannot tell, models, predictions, designs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.demo.experiment import DELTA, SHORT_PIECE, SPEC
from servolens.demo.story_design import design_section, paper_section
from servolens.demo.story_hidden import hidden_sections, hidden_sentence
from servolens.report.content import Findings, Lights, Section
from servolens.report.curves import curve
from servolens.report.figures import (
    Match,
    damping_at,
    damping_in_time_figure,
    damping_law_figure,
    errors_figure,
    law_curve,
    match_figure,
    plant_formula,
    record_figure,
)
from servolens.report.page import write_page
from servolens.simulation import simulate
from servolens.summaries import gain_sentences, model_table
from servolens.summaries.diagnosis import verdict_sentence
from servolens.summaries.wording import listed, number, percent, percents
from servolens.summary import Table

if TYPE_CHECKING:
    from pathlib import Path

    from servolens.demo.experiment import Demo
    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.report.content import Block, Drawing
    from servolens.report.curves import Curve, Role

__all__ = ["law_panels", "write_story"]

PAPER = (
    "N. Wongvanich, C. E. Hann and H. R. Sirisena, in “Non linear electromechanical cart characterization using minimal"
    " modeling approach” (European Control Conference 2013)"
)
KP_ROLES: tuple[Role, Role, Role] = ("first", "second", "third")
MODEL_ROLES: tuple[Role, ...] = ("constant", "constant", "constant", "velocity", "velocity", "velocity")


def write_story(path: Path, demo: Demo) -> None:
    """Write the page: the axis whose lack is hidden first, then the paper's cart."""
    study = demo.hidden.study
    more: list[str | Lights] = [Lights(lights=study.lights), hidden_sentence(demo.hidden)]
    if study.diagnosis is not None:
        more.append(verdict_sentence(study.diagnosis))
    more.append("Below that, the same tools repeat the experiments of a paper on a virtual copy of its cart.")
    sections = (
        *hidden_sections(demo.hidden),
        _data(demo),
        _open_questions(demo),
        _fit(demo),
        _validation(demo),
        design_section(demo),
        paper_section(demo),
    )
    write_page(path, "From measured steps to a gain you can trust", gain_sentences(study)[0], more, sections)


def _data(demo: Demo) -> Section:
    gains = listed([f"{c.kp:g}/{c.kd:g}" for r in demo.records if (c := r.controller) is not None], most=8)
    record = demo.records[0]
    average = demo.prediction.average_percent
    constant, velocity = (percents(min(own), max(own)) for own in (average[:3], average[3:]))
    blocks: tuple[Block, ...] = (
        f"{PAPER}, identify a cart on a rail from one step: once with constant damping, once with damping that depends"
        " on speed. They test both on other gains, and design the least derivative gain on each. All of that is done"
        " here on a virtual cart that obeys the paper's nonlinear model and is logged as the paper logs its real one.",
        "The cart's physics and numerics are written separately from those that identify and simulate it; it obeys the"
        " very law that is fitted, so the errors here are those of a law that is exactly right. No real machine obeys"
        " its model so well.",
        f"On the gain pairs of the paper's Table I the models with constant damping are {constant} of the step off on"
        f" average, those with damping that depends on speed {velocity}; each model knows one of the eight records.",
        f"Eight steps to {SPEC['reference']:g} m with the gains Kp/Kd = {gains} (V/m, V s/m), the pairs of the"
        f" paper's Table I: {len(record)} samples each, every {number(1e3 * record.sample_time)} ms, encoder and noise"
        " of 10 µm each.",
        f"Models are identified from one record at a time: {listed([r.name for r in demo.training])}. For every model"
        " the other seven records are held out.",
        record_figure(
            "data",
            demo.training,
            "The three steps that models are identified from: position above, the voltage that the controller asked"
            " for below.",
        ),
    )
    return Section(key="data", title="A paper's cart: the data", blocks=blocks)


def _open_questions(demo: Demo) -> Section:
    fastest = max(float(np.abs(simulate(demo.truth, r).velocity).max()) for r in demo.training)
    blocks: list[Block] = [
        f"The cart never moves faster than {number(fastest, 3)} m/s: damping beyond that speed is extrapolated.",
        "Every step goes from 0 to the same place: what differs along the rail or between directions cannot be seen.",
        "The voltage never reached a limit, so the amplifier's limit is unknown.",
    ]
    if demo.findings:
        blocks.append(Findings(findings=demo.findings))
    else:
        blocks.append("The checks of the identification found nothing to warn of.")
    return Section(key="findings", title="The cart: what the data leave open", blocks=tuple(blocks))


def _fit(demo: Demo) -> Section:
    first, delta = demo.fits[0], f"δ = {DELTA:g}"
    constant, velocity = first.constant, first.velocity
    assert constant is not None  # noqa: S101 - the demo asks for all models
    assert velocity is not None  # noqa: S101 - the demo asks for all models
    blocks: tuple[Block, ...] = (
        "Constant damping: the acceleration is the gain times the voltage, less the damping times the speed.",
        _parameters(demo),
        _constant_figure(demo),
        "Damping that varies in time: constant on pieces of half the smallest interval between zeros of the velocity,"
        f" without and with the constraint (eq. 18) that it falls by at most {delta} from piece to piece.",
        _time_figure(demo),
        match_figure(
            "pieces-match",
            [
                Match(
                    record=demo.training[0],
                    models=(("time-varying damping", "varying", varying),),
                    title=f"Kp 60, {name}",
                    until=1.0,
                )
                for name, varying in (("δ off", demo.short), (delta, demo.short_limited))
            ],
            f"Time-varying damping with pieces of {SHORT_PIECE:g} s simulated on the record it was identified from"
            " (not held out), without and with the constraint (the paper's figure 6).",
        ),
        "Damping that depends on speed: the law of eq. 20, fitted directly in the integral equation and refined.",
        plant_formula("law", velocity.plant),
        model_table(velocity, f"NLm1: damping that depends on speed, from {demo.training[0].name}"),
        match_figure(
            "velocity-match",
            [
                Match(
                    record=demo.training[0],
                    models=(("speed-dependent damping", "velocity", velocity.plant),),
                    title=t,
                    of_error=e,
                )
                for t, e in (("Kp 60: error", True), ("Kp 60: position", False))
            ],
            "The speed-dependent model NLm1 on the record it was identified from, not held out (the paper's figure 7):"
            " first the control error, then the position.",
        ),
        _law_figure(demo),
    )
    return Section(key="fit", title="The cart: the models", blocks=blocks)


def _parameters(demo: Demo) -> Table:
    rows = []
    for i, fit in enumerate(demo.fits, start=1):
        for name, model in ((f"Lm{i}", fit.constant), (f"NLm{i}", fit.velocity)):
            if model is not None:
                values = [*model.plant.values, None, None][:4]
                errors = fit.errors["constant" if name.startswith("L") else "velocity"]
                rows.append((name, fit.records[0].name, *(number(v) for v in values), percent(errors[0].percent_error)))
    rows.sort()
    rows.append(("truth", "", *(number(v) for v in demo.truth.values), ""))
    return Table(
        title="All models",
        columns=("Model", "Identified from", "β [m/s²/V]", "c or γ [1/s]", "α₁ [1/s]", "α₂ [s/m]", "Error there"),
        rows=tuple(rows),
        note="Lm: constant damping; NLm: damping γ + α₁·exp(−α₂|v|). Error: mean |model − measured| as a share of the"
        " step, on the record that the model was identified from.",
    )


def _constant_figure(demo: Demo) -> Drawing:
    matches = [
        Match(
            record=fit.records[0],
            models=(("constant damping", "constant", fit.constant.plant),),
            title=f"Kp {kp}",
            of_error=True,
        )
        for fit, kp in ((demo.fits[0], 60), (demo.fits[2], 100))
        if fit.constant is not None
    ]
    return match_figure(
        "constant-match",
        matches,
        "The control error of the constant-damping models Lm1 and Lm3 against the measured one (the paper's figure 3),"
        " on the records they were identified from (not held out). The first swing fits; the later ones do not, because"
        " the real damping grows as the cart slows down.",
    )


def _time_figure(demo: Demo) -> Drawing:
    node = demo.fits[0].varying
    assert node is not None  # noqa: S101 - the demo asks for all models
    width = f"{number(float(node.edges[1]), 2)} s"
    panels = [
        (f"Pieces of {width}, δ off", node),
        (f"Pieces of {width}, δ = {DELTA:g}", demo.limited[0]),
        (f"Pieces of {SHORT_PIECE:g} s, δ off", demo.short),
        (f"Pieces of {SHORT_PIECE:g} s, δ = {DELTA:g}", demo.short_limited),
    ]
    active = len(demo.limited[0].active), len(demo.short_limited.active)
    binding = "binds nowhere" if not active[0] else f"binds {active[0]} times"
    return damping_in_time_figure(
        "damping-in-time",
        panels,
        "Damping against time at Kp 60 (the paper's figures 4 and 5), identified from this record. With the paper's"
        f" piece length the constraint {binding} here: damping rises by itself. With short pieces it binds"
        f" {active[1]} times, and what it cuts away is real: the true damping peaks wherever the cart reverses,"
        " because there its speed is zero. The bars are 95 % intervals of the unconstrained estimate and hold for"
        " the noise alone, not for damping that changes within a piece.",
        truth=[_true_damping(demo, demo.training[0])] * len(panels),
    )


def _true_damping(demo: Demo, record: Record) -> Curve:
    velocity = np.abs(simulate(demo.truth, record).velocity)
    line = curve("true", record.time[::2], velocity[::2], "truth")
    return curve("true", line.x, damping_at(demo.truth, line.y), "truth")


def law_panels(demo: Demo) -> list[tuple[str, list[Curve], list[Curve]]]:
    """Return the damping laws of the three records: title, laws and points of each route to them."""
    fastest = 1.1 * max(float(fit.varying.speed.max()) for fit in demo.fits if fit.varying is not None)
    truth = law_curve("true", demo.truth, (0.0, fastest), "truth")
    named = [(f"Kp {kp}", fit, role) for kp, fit, role in zip((60, 80, 100), demo.fits, KP_ROLES, strict=True)]
    pieces = [law_curve(n, f.law_from_pieces, (0.0, fastest), r) for n, f, r in named if f.law_from_pieces is not None]
    direct = [law_curve(n, f.velocity.plant, (0.0, fastest), r) for n, f, r in named if f.velocity is not None]
    points = [curve("", f.varying.speed, f.varying.damping, r) for n, f, r in named if f.varying is not None]
    return [
        ("Through the pieces (eqs. 19–22)", [truth, *pieces], points),
        ("Directly in the integral equation", [truth, *direct], []),
    ]


def _law_figure(demo: Demo) -> Drawing:
    return damping_law_figure(
        "damping-law",
        law_panels(demo),
        "Damping against speed from the three records (the paper's figure 8), each identified from its own record."
        " First the paper's route, a curve through the damping of the pieces (markers) at their mean speeds; it"
        " falls too fast below 0.2 m/s. Then the same law fitted in the integral equation; the three curves"
        " lie on the truth.",
        "m",
    )


def _validation(demo: Demo) -> Section:
    prediction = demo.prediction
    blocks: tuple[Block, ...] = (
        f"Each of the six models simulates all eight experiments in closed loop: {prediction.models[0]}–3 with constant"
        " damping, NLm1–3 with damping that depends on speed.",
        _table_one(demo),
        errors_figure(
            "table-one",
            [record.name for record in demo.records],
            list(zip(prediction.models, MODEL_ROLES, strict=True)),
            np.array([[error.percent_error for error in row] for row in prediction.errors]),
            demo.held_out,
            "Table I as a figure: every model on every record. Filled marks are held out, hollow"
            " marks stand for the record that the model was identified from.",
        ),
        _pair_figure(
            demo,
            "own-records",
            ((2, 1), (5, 2)),
            "The models of Kp 80 and Kp 100 on the records they were identified from, not held out (the paper's figure"
            " 9).",
        ),
        _pair_figure(
            demo,
            "predictions",
            ((4, 1), (6, 2)),
            "Predictions on held-out records: Kp 80, Kd 10 by the models of Kp 80, and Kp 100, Kd 5 by those of Kp 100"
            " (the paper's figure 10).",
        ),
    )
    return Section(key="validation", title="The cart: do the models predict other gains?", blocks=blocks)


def _table_one(demo: Demo) -> Table:
    rows = []
    for record, errors, held in zip(demo.records, demo.prediction.errors, demo.held_out, strict=True):
        cells = [_cell(e.percent_error) + ("" if out else " *") for e, out in zip(errors, held, strict=True)]
        rows.append((record.name, *cells))
    percents = np.array([[error.percent_error for error in row] for row in demo.prediction.errors])
    alone = [float(percents[demo.held_out[:, j], j].mean()) for j in range(percents.shape[1])]
    rows.append(("average of all eight", *(_cell(a) for a in demo.prediction.average_percent)))
    rows.append(("average of the seven held out", *(_cell(a) for a in alone)))
    return Table(
        title="Table I: mean absolute error [% of the step]",
        columns=("Record", *demo.prediction.models),
        rows=tuple(rows),
        note="* the model was identified from this record; all others are held out. The paper's averages on its real"
        " cart: 9.3, 10.6 and 10.6 with constant damping, 3.7, 3.9 and 4.3 with damping that depends on speed.",
    )


def _cell(percentage: float) -> str:
    """Write a percentage so that those of a column can be compared."""
    return f"{percentage:.2f}" if percentage >= 0.1 else number(percentage, 2)


def _pair_figure(demo: Demo, key: str, pairs: tuple[tuple[int, int], ...], caption: str) -> Drawing:
    matches = []
    for index, which in pairs:
        fit = demo.fits[which]
        if fit.constant is not None and fit.velocity is not None:
            models: tuple[tuple[str, Role, Plant], ...] = (
                ("constant damping", "constant", fit.constant.plant),
                ("speed-dependent damping", "velocity", fit.velocity.plant),
            )
            matches.append(Match(record=demo.records[index], models=models))
    return match_figure(key, matches, caption)
