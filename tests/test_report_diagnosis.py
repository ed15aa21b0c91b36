"""The page of a diagnosis: its figures show what was found, and say what is held out."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from test_report import HOSTILE, assert_self_contained

from servolens import lab
from servolens.diagnosis import diagnose
from servolens.diagnosis.evidence import Instrument, Share
from servolens.diagnosis.result import Cause
from servolens.effects import CATALOGUE, PeriodicDisturbance
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.model import NOT_REACHED, UNDETERMINED, Quantity
from servolens.model_evidence import UNRELIABLE
from servolens.plant import Plant
from servolens.rendering import grouped
from servolens.report import write_diagnosis_report
from servolens.report.curves import curve
from servolens.report.diagnosis_story import diagnosis_sections
from servolens.report.equation import motion_latex
from servolens.report.figures_diagnosis import candidates_figure, edge_text, instrument_figure, telling_instrument
from servolens.report.laws import law_along
from servolens.report.plots_diagnosis import (
    plot_candidates,
    plot_pieces,
    plot_record_errors,
    plot_residuals,
    plot_shares,
)
from servolens.report.style import panel_figure
from servolens.report.svg import svg
from servolens.report.wording import symbol_text
from servolens.simulation import simulate
from servolens.summaries import diagnosis_summary
from servolens.summaries.diagnosis import (
    advice,
    doubt_sentences,
    findings_of_logs,
    next_sentences,
    remaining_sentences,
    verdict_sentence,
)
from servolens.summaries.diagnosis_tables import data_kinds
from servolens.summaries.evidence import instrument_sentence, where_phrase
from servolens.summaries.names import cause_phrase
from servolens.summary import Table

CART = {"gain": 1.9, "damping": 6.0}


def steps(effects, gains):
    cart = lab.Truth(**CART, effects=effects)
    return [
        lab.step_record(
            cart, kp=kp, reference=[0.1, 0.0], duration=0.7, noise=1e-5, seed=kp, setup=lab.Setup(name=f"kp {kp}")
        )
        for kp in gains
    ]


@pytest.fixture(scope="module")
def rubbing():
    runs = steps({"coulomb_friction": {"level": 0.3}}, (40, 60, 90))
    return diagnose(runs[:2], heldout=runs[2:])


@pytest.fixture(scope="module")
def healthy():
    return diagnose(steps({}, (40, 60)))


def page_of(diagnosis, folder):
    path = folder / "diagnosis.html"
    write_diagnosis_report(str(path), diagnosis)
    text = path.read_text(encoding="utf-8")
    assert_self_contained(text)
    return text.replace("\u00a0", " ")  # before units


def test_page_has_sliders_and_recommends_no_gain(rubbing, tmp_path):
    text = page_of(rubbing, tmp_path)
    assert text.index('data-name="wrong-gains"') < text.index('class="playground"')
    assert "A diagnosis recommends no gain" in text
    assert "as designed with" not in text
    found = re.search(r'<script type="application/json" class="design">(.*?)</script>', text, flags=re.DOTALL)[1]
    kp, kd = json.loads(found)["sliders"]
    assert (kp["key"], kp["value"], kd["key"]) == ("kp", 60, "free")


def test_page_without_a_known_loop_has_no_sliders(rubbing, tmp_path):
    blind = replace(rubbing, records=tuple(replace(record, controller=None) for record in rubbing.records))
    assert 'class="playground"' not in page_of(blind, tmp_path)


def test_page_says_the_cause_first_and_shows_it(rubbing, tmp_path):
    text = page_of(rubbing, tmp_path)
    lead = re.search(r'<p class="lead">(.*?)</p>', text)[1]
    assert "Coulomb friction" in lead
    assert text.count("<figure ") == 7
    assert text.index('data-name="prediction"') < text.index('data-name="wrong-shares"')
    assert "the missing force correlates with the direction of motion" in text
    assert "is what the model with its causes says" in text
    assert "Held out: the record took no part in fit and choice" in text
    assert "Fitted to kp 40 and kp 60; tested on kp 90, held out." in text


def test_every_figure_says_whether_its_data_are_held_out(rubbing, tmp_path):
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page_of(rubbing, tmp_path))
    assert len(captions) == 7
    told = ("held out", "no measured data")
    assert [caption for caption in captions if not any(words in caption.lower() for words in told)] == []


def test_nothing_sticks_out_of_a_figure(rubbing, monkeypatch, tmp_path):
    cut = []

    def watched(figure, key):
        text = svg(figure, key)  # lays it out
        drawn, room = figure.get_tightbbox(), figure.get_size_inches()
        if min(drawn.x0, drawn.y0) < 0 or drawn.x1 > room[0] or drawn.y1 > room[1]:
            cut.append((key, drawn.extents.round(2).tolist()))
        return text

    monkeypatch.setattr("servolens.report.drawing.svg", watched)
    fine = Instrument(
        varies="force",
        goes_with="position",
        correlation=0.9,
        significance=1e-9,
        abscissa=(0.0, 0.05, 0.1),
        value=(-0.00075, -0.00025, 0.00075),
        deviation=(1e-5, 1e-5, 1e-5),
    )
    runs = {
        kind: tuple(replace(run, position=simulate(rubbing.plant, run).position) for run in getattr(rubbing, kind))
        for kind in ("records", "heldout")
    }
    page_of(replace(rubbing, **runs, noise_floor=1e-7), tmp_path)  # what is left is enlarged by tens of thousands
    page_of(rubbing, tmp_path)
    instrument_figure("fine", rubbing, fine, None)
    assert cut == []


@pytest.mark.parametrize(
    ("count", "kind", "tells"),
    [
        (2, "left out", "each record in turn, by a model fitted to the others; causes were chosen on all of them"),
        (1, "its end", "the last 40 % of the record, by a model fitted to its beginning."),
    ],
)
def test_page_says_what_was_held_out_where_no_record_was(rubbing, tmp_path, count, kind, tells):
    ends = tuple(missed[-280:] if count == 1 else missed for missed in rubbing.missed[0])
    alone = replace(rubbing, heldout=(), records=(rubbing.records[0],) * count, missed=(ends,) * count)
    text = page_of(alone, tmp_path)
    assert data_kinds(alone)[-1] == kind
    assert tells in text
    assert "(held out)" not in text


def test_record_beyond_all_others_is_not_said_to_be_left_out(rubbing):
    assert data_kinds(replace(rubbing, heldout=(), gains=(*rubbing.gains, rubbing.gains[-1])))[2:] == (
        "left out",
        "its end",
    )


def test_page_of_a_healthy_axis_shows_no_cause(healthy, tmp_path):
    text = page_of(healthy, tmp_path)
    assert text.count("<figure ") == 3 + bool(healthy.candidates)
    assert "correlates significantly with anything that was measured" in text
    assert f"None of the {len(CATALOGUE)} effects of the catalogue makes these records more likely" in text
    assert "with the causes" not in text.lower()
    assert "Before and after" not in text
    assert text.count('<th scope="col">Error</th>') == 1


def test_doubts_about_the_logs_follow_the_sentence_at_once(rubbing, tmp_path):
    lost = [Finding(code="gaps", severity="warning", message="samples are lost.", record=f"kp {kp}") for kp in (40, 60)]
    small = Finding(code="strongly_correlated", severity="note", message="gain and damping are correlated.")
    doubtful = replace(rubbing, findings=(*lost, small))
    text = page_of(doubtful, tmp_path)
    lead = re.search(r'<p class="lead">(.*?)</p>', text)[1]
    assert lead.startswith("The logs are in doubt; taken as they are, ")
    assert "kp 40 and kp 60: samples are lost." in text[: text.index("<nav")]
    assert "are correlated" not in text[: text.index("<nav")]
    first, second, *_ = diagnosis_summary(doubtful).sentences
    assert first == lead
    assert second.startswith("Correct the logs first: kp 40 and kp 60: samples are lost.")


def test_doubts_of_one_kind_are_told_once():
    found = [
        Finding(code="gaps", severity="warning", message=f"{n} samples are lost.", record=f"run {n}") for n in (3, 4, 4)
    ]
    assert [(f.record, f.message) for f in grouped(found)] == [
        ("run 3", "3 samples are lost."),
        ("run 4", "4 samples are lost."),
    ]


def test_first_doubt_of_a_kind_names_the_other_records(healthy):
    found = tuple(
        Finding(code="gaps", severity="warning", message=f"{n} samples are lost.", record=f"run {n}") for n in (3, 4, 5)
    )
    (told,) = findings_of_logs(replace(healthy, findings=found))
    assert (told.record, told.message) == ("run 3", "3 samples are lost. Likewise run 4 and run 5.")


def test_effects_that_together_are_the_cause_are_no_rivals_to_be_parted(rubbing):
    (cause,) = rubbing.causes
    same = replace(cause, effect="asymmetric_friction", rivals=("coulomb_friction + constant_force",))
    text = " ".join(diagnosis_summary(replace(rubbing, causes=(same,))).sentences)
    assert "It is the same as Coulomb friction together with a constant force." in text
    assert "cannot distinguish" not in text
    assert "separate them" not in text


def test_records_that_contradict_each_other_are_not_said_to_have_been_searched(healthy):
    doubt = Finding(code="records_contradict", severity="warning", message="the records contradict each other?")
    told = diagnosis_summary(replace(healthy, verdict="unexplained", findings=(doubt,))).sentences[0]
    assert told == "The records contradict each other?"


def test_few_samples_are_said_to_show_little(healthy):
    short = tuple(record.slice(0.0, 0.049) for record in healthy.records)
    told = diagnosis_summary(replace(healthy, records=short)).sentences
    assert any(sentence.startswith("100 samples in 0.098 s show little") for sentence in told)
    assert not any("show little" in sentence for sentence in diagnosis_summary(healthy).sentences)


def test_page_of_an_unexplained_axis_keeps_to_the_evidence(rubbing, tmp_path):
    linear = replace(rubbing, verdict="unexplained", causes=(), model=rubbing.linear, heldout=())
    linear = replace(linear, missed=rubbing.missed * 2)
    text = page_of(linear, tmp_path)
    assert "nothing in the catalogue explains it" in text
    assert "with the causes" not in re.sub(r"<(table|script).*?</\1>", "", text, flags=re.DOTALL)
    assert "Fitted to these very data: not held out." in text


def test_frequency_is_told_only_where_the_error_has_one():
    def share(held):
        bins = tuple((float(low), low + 1.0, part, 0.25) for low, part in enumerate(held))
        return Share(
            quantity="frequency", low=0.0, high=4.0, unit="Hz", share_of_error=1.0, share_of_samples=0.1, bins=bins
        )

    assert where_phrase([share((0.05, 0.5, 0.4, 0.05))]) == "90 % of the error has a frequency between 1 and 3 Hz"
    assert where_phrase([share((0.25, 0.25, 0.25, 0.25))]) == ""


@pytest.mark.parametrize(("samples", "tells"), [(0.75, ""), (0.4, "96 % of the error arises at a position below 3 mm")])
def test_range_of_most_samples_is_no_place_to_look(samples, tells):
    bins = ((0.0, 0.003, 0.96, samples), (0.003, 0.004, 0.04, 1.0 - samples))
    found = Share(
        quantity="position", unit="m", bins=bins, low=0.0, high=0.003, share_of_error=0.96, share_of_samples=samples
    )
    assert where_phrase([found]) == tells


@pytest.mark.parametrize(
    ("effects", "latex"),
    [
        (("sensor_lag",), r"\dot v = \beta\,V - c\,v,\quad v = \dot y,\quad \tau\,\dot y_m = y - y_m"),
        (("delay",), r"\dot v = \beta\,a - c\,v,\quad v = \dot y,\quad a(t)=V(t-\tau)"),
        (("cogging", "saturation"), r"\dot v = \beta\,a - c\,v - A\,\sin(2\pi\,y/p + \phi),\quad v = \dot y,\quad a ="),
    ],
    ids="+".join,
)
def test_equation_subtracts_forces_and_nothing_else(effects, latex):
    parts = [CATALOGUE[name] for name in effects]
    values = [{spec.name: max(spec.low, 0.1) for spec in part.parameters()} for part in parts]
    plant = Plant(gain=1.9, damping=6.0, effects=tuple(part(**own) for part, own in zip(parts, values, strict=True)))
    assert motion_latex(plant).startswith(latex)


def test_no_symbol_is_written_in_code():
    symbols = [symbol_text(spec.symbol) for effect in CATALOGUE.values() for spec in effect.parameters()]
    assert [symbol for symbol in symbols if "_" in symbol] == []
    assert {"F₊", "F₋", "Vₘₐₓ"} <= set(symbols)


def test_page_tells_which_simulation_ran_away(rubbing, tmp_path):
    plant = replace(rubbing.linear.plant, gain=-1e9)
    lost = replace(rubbing, linear=replace(rubbing.linear, plant=plant), where=(), instruments=())
    text = page_of(lost, tmp_path)
    assert "too few samples of motion" in text
    assert "diverges: gain and damping on kp 40, gain and damping on kp 60, gain and damping on kp 90" in text


def test_names_stay_text_and_doubts_are_told(rubbing, tmp_path):
    named = tuple(record.with_({"name": HOSTILE}) for record in rubbing.records)
    text = page_of(replace(rubbing, records=named), tmp_path)
    assert "<script>alert" not in text


def test_page_that_cannot_be_written_leaves_nothing(healthy, tmp_path):
    with pytest.raises(InputError, match="missing does not exist; create it first"):
        write_diagnosis_report(tmp_path / "missing" / "x.html", healthy)
    assert list(tmp_path.iterdir()) == []


def test_diagnosis_with_instruments_is_json(rubbing):
    body = json.loads(json.dumps(rubbing.to_json(), allow_nan=False))
    assert {found["varies"] for found in body["instruments"]} == {"damping", "gain", "force"}


def test_law_of_friction_is_its_level_each_way(rubbing):
    found, law = telling_instrument(rubbing)
    assert (found.varies, found.goes_with) == ("force", "direction")
    level = rubbing.causes[0].quantities["level"].value
    assert law.y == pytest.approx(level * law.x, rel=0.02, abs=1e-12)


@pytest.mark.parametrize("goes_with", ["distance", "time_since_step", "speed"])
def test_force_along_what_sets_no_state_has_no_law(rubbing, goes_with):
    found = next(i for i in rubbing.instruments if i.varies == "force")
    assert law_along(rubbing, replace(found, goes_with=goes_with)) is None


@pytest.mark.parametrize("quantity", ["direction", "position"])
def test_force_on_an_axis_is_none_that_its_motor_and_load_exert_on_each_other(rubbing, quantity):
    """Drawn was the push of a contact as deep as the axis had moved, 80 000 m/s²."""
    along = replace(next(i for i in rubbing.instruments if i.varies == "force"), goes_with=quantity)
    sprung = rubbing.plant.with_effect(Plant.effect_from("return_spring", {"stiffness": 5.0}))
    loose = sprung.with_effect(Plant.effect_from("backlash", {"gap": 1e-3, "load_share": 0.4}))
    alone, both = (
        law_along(replace(rubbing, model=replace(rubbing.model, plant=plant, covariance=None)), along)
        for plant in (sprung, loose)
    )
    np.testing.assert_allclose(both.y, alone.y, rtol=1e-12)


@pytest.mark.parametrize(
    ("varies", "goes_with", "correlation", "tells"),
    [
        (
            "gain",
            "time",
            -0.97,
            "estimated piece by piece in time, falls with the time of the record (r = −0.97)",
        ),
        ("damping", "speed", 0.9996, "rises with the speed (r = 0.999)"),
        ("force", "position", 0.5, "the missing force correlates with the position (r = 0.50)"),
        ("force", "constant", -0.9, "the missing force is about the same everywhere"),
    ],
)
def test_instrument_is_told_in_a_sentence(varies, goes_with, correlation, tells):
    found = Instrument(
        varies=varies,
        goes_with=goes_with,
        correlation=correlation,
        significance=1e-9,
        abscissa=(),
        value=(),
        deviation=(),
    )
    assert tells in instrument_sentence(found)
    assert "correlates significantly" in instrument_sentence(replace(found, significance=0.5))


def test_shares_are_bars_under_their_samples():
    error, samples = np.array([10.0, 70.0, 20.0]), np.array([30.0, 30.0, 40.0])
    ax = plot_shares(error, samples, [(0.0, "0"), (3.0, "9")], np.array([False, True, False]), xlabel="Speed [m/s]")
    assert [bar.get_height() for bar in ax.patches] == error.tolist()
    assert [bar.get_alpha() for bar in ax.patches] == [0.35, 1.0, 0.35]
    assert [line[0, 1] for line in ax.collections[0].get_segments()] == samples.tolist()
    assert ax.get_xlabel() == "Speed [m/s]"


@pytest.mark.parametrize("width", [1.2, 2.6, 5.6])
@pytest.mark.parametrize(
    "texts",
    [("0.00064", "0.0012", "0", "0.99"), ("0", "12", "5", "7"), ("−0.000079", "123456", "−4.8", "−0.00000012")],
    ids=["speed", "short", "long"],
)
def test_ticks_of_shares_never_touch(texts, width):
    share = np.full(12, 100 / 12)
    for places in itertools.permutations((0.0, 1.0, 4.0, 12.0)):
        figure, ax = panel_figure(2.2, width, 0.55)
        ticks = [*zip(places, texts, strict=True)]
        plot_shares(share, share, ticks, np.zeros(12, dtype=bool), xlabel="Speed [m/s]", ax=ax)
        figure.draw_without_rendering()
        labels = ax.get_xticklabels()
        boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
        assert all(right.x0 > left.x1 for left, right in itertools.pairwise(boxes))
        assert texts[0] in [label.get_text() for label in labels], "the most welcome is there"
        assert boxes[-1].x1 < figure.bbox.x1


def test_pieces_are_points_with_the_law_through_them():
    x, y = np.arange(4.0), np.array([1.0, 3.0, 2.0, 5.0])
    law = curve("the model", x, 2 * x, "velocity")
    ax = plot_pieces(x, y, 0.1 * y, xlabel="Speed [m/s]", ylabel="Damping [1/s]", law=law, held=6.0)
    drawn = [line.get_ydata() for line in ax.get_lines()]
    assert any(np.array_equal(line, y) for line in drawn)
    assert any(np.array_equal(line, 2 * x) for line in drawn)
    assert any(np.array_equal(line, [6.0, 6.0]) for line in drawn)


def test_band_of_the_noise_has_edges_where_it_can_be_seen():
    small, large = (curve("", [0, 1], [0.0, size], "constant") for size in (1.0, 100.0))
    edges = [
        [line.get_ydata()[0] for line in plot_residuals([drawn], 2.0).get_lines() if line.get_zorder() == 5]
        for drawn in (small, large)
    ]
    assert edges == [[-2.0, 2.0], []]


def test_candidates_are_dots_at_what_they_leave():
    ax = plot_candidates(["one", "two"], np.array([0.01, 3.0]), [True, False], floor=0.009, xlabel="Error [mm]")
    assert [float(np.ravel(line.get_xdata())[0]) for line in ax.get_lines() if line.get_marker() == "o"] == [0.01, 3.0]
    assert ax.get_xscale() == "log"
    assert [label.get_fontweight() for label in ax.get_yticklabels()] == ["bold", "normal"]


def test_held_out_records_are_filled():
    before, after, noise = np.array([1.0, 2.0]), np.array([0.1, 0.2]), np.array([0.1, 0.1])
    held = np.array([False, True])
    ax = plot_record_errors(["a", "b"], before, after, noise, held, xlabel="Error [mm]")
    faces = [
        line.get_markerfacecolor() for line in ax.get_lines() if line.get_marker() == "s" and len(line.get_xdata())
    ]
    assert faces == ["white", "#D55E00"]


def test_record_without_a_finite_error_is_left_blank():
    values = np.array([np.nan, 2.0])
    ax = plot_record_errors(
        ["a", "b"], values, values, np.array([0.1, 0.1]), np.array([True, True]), xlabel="Error [m]"
    )
    assert ax.get_xlim()[1] == pytest.approx(2.8)


def test_all_causes_stand_in_bold_among_the_effects_that_were_tried(rubbing, monkeypatch):
    bold = []
    monkeypatch.setattr(
        "servolens.report.figures_diagnosis.plot_candidates",
        lambda names, _left, chosen, **look: [
            bold.extend(name for name, answer in zip(names, chosen, strict=True) if answer),
            plot_candidates(names, _left, chosen, **look),
        ],
    )
    other = next(c.effects[-1] for c in rubbing.candidates if c.effects[-1] != "coulomb_friction" and c.error > 0)
    pair = replace(rubbing, causes=(*rubbing.causes, replace(rubbing.causes[0], effect=other)))
    caption = candidates_figure("tried", pair).caption
    assert len(bold) == 2
    assert "Bold: the causes, each by itself here; together they leave less." in caption


def test_causes_with_which_held_out_data_are_missed_by_more_are_not_said_to_help(rubbing):
    worse = replace(rubbing, extended=replace(rubbing.extended, heldout_rms_error=0.05))
    assert (
        verdict_sentence(worse)
        .partition("; but ")[2]
        .startswith("simulations miss more with it: the held-out error is 50 mm with it, ")
    )
    late = Finding(code="position_shifted", severity="warning", message="shift the column.", record="kp 40")
    assert "; but simulations of the loop as the logs state it miss more" in verdict_sentence(
        replace(worse, findings=(late,))
    )
    assert "the held-out error falls from" in verdict_sentence(rubbing)


def test_cause_at_less_than_even_odds_is_one_of_several_explanations(rubbing):
    """A constant force at a confidence of 3.6 % was called the cause."""
    assert "the cause is Coulomb friction (" in verdict_sentence(rubbing)
    unsure = replace(rubbing, causes=tuple(replace(cause, confidence=0.036) for cause in rubbing.causes))
    assert "one of several explanations is Coulomb friction (" in verdict_sentence(unsure)


@pytest.mark.parametrize("error", [1.0, math.inf, math.nan])
def test_causes_with_which_the_simulation_diverges_are_told_so(rubbing, error):
    """Off by more than an axis travels is no error of its model: 1 m of 0.1 m, or not a number."""
    away = replace(rubbing, extended=replace(rubbing.extended, heldout_rms_error=error))
    told = verdict_sentence(away).partition("; but ")[2]
    assert told.startswith("with it the simulation diverges; without, the held-out error is ")
    assert re.search(r" is [0-9.]+ mm \(r\.m\.s\.\)\. The noise is [0-9.]+ µm\.$", told)
    both = replace(away, baseline=replace(away.baseline, heldout_rms_error=math.inf))
    assert verdict_sentence(both).startswith("The cause is Coulomb friction (")
    assert "; but with it the simulation diverges. The noise is " in verdict_sentence(both)
    late = Finding(code="position_shifted", severity="warning", message="shift the column.", record="kp 40")
    loop = verdict_sentence(replace(away, findings=(late,)))
    assert "; but with it the simulation of the loop as the logs state it diverges" in loop


def test_model_without_the_cause_that_diverges_is_not_told_as_an_error(rubbing):
    """Of an axis that moves 0.1 m it was said that the error falls from 38 m, and at which speeds it arises."""
    away = replace(rubbing, baseline=replace(rubbing.baseline, heldout_rms_error=38.0))
    told = verdict_sentence(away)
    assert told.startswith("The cause is Coulomb friction (")
    assert told.endswith("; without, the simulation diverges.")
    assert "38" not in told
    assert " m (r.m.s." not in told
    unknown = replace(away, verdict="unexplained", causes=())
    assert "a model of gain and damping diverges on held-out data, and no effect" in verdict_sentence(unknown)
    assert verdict_sentence(unknown).startswith("Nothing in the catalogue explains the error")
    assert "diverges" not in verdict_sentence(rubbing)


def test_remainder_that_noise_hides_is_not_told_as_nothing(rubbing):
    left = replace(rubbing.remainder, rms=0.0, of_travel=0.0, depends_on_inputs=True)
    told = remaining_sentences(replace(rubbing, verdict="partly_explained", remainder=left))
    assert (
        told[0]
        == "What is left depends on the inputs, but is smaller than the noise: only many samples together show it."
    )


def test_doubt_in_a_cause_is_told_with_its_rivals(rubbing):
    """A cause of confidence 0.5 was told by `tune` like one of 0.999, and so was one of 0.005."""
    (sure,) = rubbing.causes
    doubtful = replace(rubbing, causes=(replace(sure, confidence=0.5, rivals=("dead_zone",)),))
    assert doubt_sentences(doubtful) == [
        "Confidence in Coulomb friction: 50 %; these data cannot distinguish it from a dead zone."
    ]
    causes = (replace(sure, confidence=0.4936), replace(sure, effect="cogging", confidence=0.2), sure)
    partly = replace(rubbing, verdict="partly_explained", causes=causes)
    assert doubt_sentences(partly) == ["Confidence: Coulomb friction 49.4 % and cogging 20 %."]
    assert doubt_sentences(rubbing) == []


def test_of_a_rival_that_was_not_fitted_no_data_are_said_to_speak(rubbing):
    """A coupling was said to be indistinguishable from what left seven times the noise."""
    (sure,) = rubbing.causes
    rings = replace(sure, effect="flexible_coupling", confidence=0.5, rivals=("second_order_actuator",))
    diagnosis = replace(rubbing, causes=(rings,), next_experiment=None)
    assert " ".join(advice(rings, diagnosis)[-2:]) == (
        "Confidence 50 % among the effects tried. An actuator of second order has the same structure and was not"
        " fitted: look at the machine to tell which it is."
    )
    assert doubt_sentences(diagnosis) == ["Confidence: a flexible coupling 50 %."]
    assert next_sentences(diagnosis) == []


def test_advice_on_what_may_be_something_else_is_given_for_the_case_that_it_is_that(rubbing):
    """A motor with skewed slots was advised against what a foreign law leaves."""
    (sure,) = rubbing.causes
    assert any(told.startswith("What to do: ") for told in advice(sure, rubbing))
    guess = replace(sure, confidence=0.5)
    told = advice(guess, replace(rubbing, verdict="partly_explained", causes=(guess,)))
    assert [one.partition(": ")[0] for one in told[1:3]] == [
        "What to do, if it is that",
        "For the PD gain, if it is that",
    ]


@pytest.mark.parametrize("verdict", ["healthy", "explained", "partly_explained", "unexplained"])
def test_error_bars_of_a_model_that_leaves_more_than_noise_are_told_not_to_be_relied_on(rubbing, verdict):
    """They were printed like those of a model that explains its data, and missed the truth by many of themselves."""
    judged = replace(rubbing, verdict=verdict)
    pages = [block for section in diagnosis_sections(judged) for block in section.blocks]
    tables = [diagnosis_summary(judged).tables[0], *(one for one in pages if isinstance(one, Table))]
    notes = [table.note for table in tables if "Value ± standard error" in table.columns]
    assert len(notes) == 2
    is_doubtful = verdict in ("partly_explained", "unexplained")
    assert [note.startswith(UNRELIABLE) for note in notes] == [is_doubtful, is_doubtful]


def test_speed_of_rounding_is_told_as_zero():
    edges = np.array([0.0, 2.6e-15, 0.004, 7.9])
    assert [edge_text(edges, place) for place in range(4)] == ["0", "0", "0.004", "7.9"]


def test_cause_is_told_with_what_is_known_of_it_and_many_parameters_are_left_to_the_table():
    def phrase(effect, **values):
        quantities = {name: Quantity(**{"unit": "m", **fields}) for name, fields in values.items()}
        cause = Cause(
            effect=effect, quantities=quantities, confidence=0.9, rivals=(), train=(2.0, 1.0), heldout=(2.0, 1.0)
        )
        return cause_phrase(cause)

    high = {"value": 0.1, "stderr": 1e-3}
    low = {"value": -17.0, "reason": UNDETERMINED}
    assert phrase("end_stop", low=low, high=high) == "an end stop (high 100.0 ± 1.0 mm; low not determined)"
    beyond = {"value": -5e6, "reason": NOT_REACHED}
    assert (
        phrase("end_stop", low=beyond, high=high) == "an end stop (high 100.0 ± 1.0 mm; low not seen by these records)"
    )
    unsure = {"value": 0.1, "reason": UNDETERMINED}
    assert phrase("end_stop", low=beyond, high=unsure).endswith("; low not seen by these records)")
    at_bound = {"value": -0.2, "reason": "it is at its bound"}
    assert "low −200 mm" in phrase("end_stop", low=at_bound, high=high)
    assert phrase("delay", time=low).startswith("a delay (")
    force = {"value": 1.0024, "stderr": 5e-4, "unit": "m/s^2"}
    excess = {"value": -0.0076, "stderr": 0.0029, "unit": "m/s^2"}
    speed = {"value": 0.0068, "stderr": 0.0046, "unit": "m/s"}
    assert phrase("stribeck_friction", level=force, static_excess=excess, stribeck_speed=speed) == (
        "Stribeck friction (level 1.0024 ± 0.0005 m/s², static excess −0.008 ± 0.003 m/s², stribeck speed 7 ± 5 mm/s)"
    )
    levels = {f"positive_{i}": high for i in range(5)}
    assert phrase("friction_map", **levels).endswith("(5 parameters, in the table of the model)")


def test_loop_that_a_log_states_wrongly_is_named_as_the_reason_of_what_is_left():
    runs = [
        replace(run, controller=replace(run.controller, kp=1.25 * run.controller.kp)) for run in steps({}, (40, 80))
    ]
    diagnosis = diagnose(runs)
    told = remaining_sentences(diagnosis)
    assert "with the loop as the logs state it" in told[0]
    assert diagnosis.verdict == "healthy"
    assert "driven by the logged voltage, gain and damping explain these records" in verdict_sentence(diagnosis)
    assert "nothing else is wrong" not in verdict_sentence(diagnosis)


def test_wave_is_not_the_reason_of_errors_that_its_phase_does_not_explain(rubbing):
    """With the phases of each record simulations missed more than without the wave."""
    wave = PeriodicDisturbance(amplitude=0.1, frequency=2.0, phase=0.0)
    model = replace(rubbing.model, plant=rubbing.model.plant.with_effect(wave), covariance=None)
    worse = replace(rubbing, model=model, extended=replace(rubbing.extended, heldout_rms_error=0.05))
    assert "No simulation can predict that phase" in verdict_sentence(worse)
    missed = replace(worse, remainder=replace(worse.remainder, rms=0.5))
    assert "simulations miss more with it" in verdict_sentence(missed)
