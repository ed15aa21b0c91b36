"""The pages people read: figures show what they are given, pages load nothing, names stay text."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from dataclasses import replace
from hashlib import sha256
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from servolens import lab
from servolens.design import PDSpec
from servolens.effects import CoulombFriction, EndStop, VelocityDecayDamping
from servolens.errors import InputError
from servolens.identification import identify
from servolens.identification.later import known
from servolens.identification.varying import VaryingDamping
from servolens.plant import Plant
from servolens.report import write_report, write_study
from servolens.report.content import Drawing, Key, Picture, Section
from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_of
from servolens.report.figure_data import Line, Panel, Scale, encoded, panels_of
from servolens.report.figures import damping_at, damping_in_time_figure, plant_formula, record_figure
from servolens.report.measured_story import damping_figures
from servolens.report.page import render_page, write_page
from servolens.report.plots import plot_curves, plot_damping_in_time, plot_damping_laws, plot_percent_errors
from servolens.report.plots_design import Mark, plot_settling_times, plot_step_responses
from servolens.report.printing import chromium
from servolens.report.style import new_figure, panel_figure
from servolens.report.svg import svg
from servolens.report.wording import shown
from servolens.study import study_records
from servolens.summaries.models import determined

HOSTILE = "<script>alert(1)</script> --> $x_{ & \"quoted\" 'too' \x1b[31m\n{{ 7*7 }}"
signal = arrays.arrays(np.float64, st.integers(2, 50), elements=st.floats(-1e3, 1e3))


class Page(HTMLParser):
    """Collects what a browser would load or run."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.anchors, self.ids, self.scripts, self.policy = [], [], [], [], [], ""
        self._script = None
        self.feed(text)

    def handle_data(self, data):
        if self._script is not None:
            self._script += data

    def handle_endtag(self, tag):
        if tag == "script":
            self.scripts += [] if self._script is None else [self._script]
            self._script = None

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        given = dict(attrs)
        if tag == "script":
            self._script = "" if "type" not in given else None
            assert given.get("type", "application/json") == "application/json"
        if given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"]
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                (self.anchors if value.startswith("#") else self.addresses).append(value)
            if name == "id":
                self.ids.append(value)
            assert not name.startswith("on")


def assert_self_contained(text):
    page = Page(text)
    assert page.addresses == []
    assert {"iframe", "object", "embed", "link", "img", "base"} & set(page.tags) == set()
    assert page.policy.startswith("default-src 'none'; style-src 'unsafe-inline'; script-src ")
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in page.scripts]
    assert re.findall(r"'sha256-([^']+)'", page.policy) == hashes
    outside = text
    for script, its_hash in zip(page.scripts, hashes, strict=True):
        outside = outside.replace(script, "").replace(its_hash, "")  # in which any letters may stand
        assert not re.search(r"\bfetch\(|XMLHttpRequest|WebSocket|\beval\(|new Function|\bimport\b", script)
    assert "http" not in text
    assert not re.search(r"//[a-z]", outside)
    assert "@import" not in text
    assert len(page.ids) == len(set(page.ids))
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | {anchor[1:] for anchor in page.anchors}
    assert used <= set(page.ids)


@given(signal)
def test_lines_are_the_curves_given(values):
    time = np.arange(values.size) / 1000.0
    ax = plot_curves([curve("measured", time, values, "measured")], xlabel="Time [s]", ylabel="Position [m]")
    (line,) = ax.get_lines()
    assert np.array_equal(line.get_xdata(), time)
    assert np.array_equal(line.get_ydata(), values)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Time [s]", "Position [m]")


@given(arrays.arrays(np.float64, st.integers(1, 20), elements=st.floats(0.1, 100.0)))
def test_pieces_of_damping_stand_where_they_hold(damping):
    edges = 0.1 * np.arange(damping.size + 1)
    ax = plot_damping_in_time(edges, damping, 0.1 * damping)
    drawn = ax.patches[0].get_data()
    assert np.array_equal(drawn.values, damping)
    assert np.array_equal(drawn.edges, edges)


def test_damping_law_shows_curves_as_lines_and_pieces_as_marks():
    law, points = curve("law", [0, 1], [9, 6], "velocity"), curve("pieces", [0.1, 0.5], [8, 7], "first")
    lines = plot_damping_laws([law], [points], length_unit="rad").get_lines()
    assert [line.get_linestyle() for line in lines] == ["-", "None"]
    assert np.array_equal(lines[1].get_ydata(), points.y)


def test_laws_of_damping_are_drawn_only_where_the_pieces_are(runs, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        "servolens.report.measured_story.damping_law_figure",
        lambda key, panels, *_: drawn.update({law.label: law for law in panels[0][1]}),
    )
    fit = identify(runs)
    damping_figures(fit)
    assert {float(law.x[0]) for law in drawn.values()} == {fit.varying.speed[determined(fit.varying)].min()} != {0.0}


def test_damping_is_seen_where_single_pieces_are_hardly_determined(monkeypatch):
    heights = []
    monkeypatch.setattr(
        "servolens.report.drawing.svg", lambda figure, _key: heights.append(figure.axes[0].get_ylim()) or "<svg>"
    )
    varying = SimpleNamespace(  # the damping of the second piece is hardly determined
        edges=np.array([0.0, 0.1, 0.2]), damping=np.array([8.0, 6.0]), covariance=np.diag([0.1, 900.0, 1e-6])
    )
    damping_in_time_figure("c", [("", varying)], "")
    assert heights == [(pytest.approx(-0.8), pytest.approx(1.35 * 8.0))]


def test_errors_tell_held_out_records_by_filled_marks():
    held = np.array([[True, False]])
    ax = plot_percent_errors(["run"], ["a", "b"], np.array([[2.0, 0.5]]), held, ["constant", "velocity"])
    marks = [line for line in ax.get_lines() if np.size(line.get_xdata()) == 1]
    assert [float(np.ravel(m.get_xdata())[0]) for m in marks] == [2.0, 0.5]
    assert [m.get_markerfacecolor() == "white" for m in marks] == [False, True]


def test_settling_times_mark_a_broken_spec_with_a_cross():
    marks = [
        Mark(label="late", kd=1.0, settling_time=0.6, role="constant"),
        Mark(label="in time", kd=2.0, settling_time=0.5, role="velocity"),
    ]
    curves = [curve("linear", [0, 1, 2], [0.9, 0.6, 0.5], "constant")]
    ax = plot_settling_times(curves, [("velocity", [(1.5, 2.0)])], marks, limit=0.5)
    drawn = {line.get_label(): line for line in ax.get_lines()}
    assert drawn["late"].get_marker() == "X"
    assert drawn["in time"].get_marker() == "o"
    (span,) = ax.patches
    assert (span.get_x(), span.get_x() + span.get_width()) == (1.5, 2.0)


def test_magnified_step_shows_the_surroundings_of_the_band():
    line = curve("step", [0, 1], [0, 0.1], "velocity")
    ax = plot_step_responses([line], PDSpec(kp=100, settling_time=0.5), zoom=(0.2, 1.0))
    assert ax.get_xlim() == (0.2, 1.0)
    low, high = ax.get_ylim()
    assert low < 0.099 < 0.101 < high


@given(signal, st.integers(4, 20))
@settings(max_examples=50)
def test_thinned_curve_keeps_extremes_and_ends(values, most):
    line = curve("", np.arange(values.size), values, "measured")
    thin = line.thinned(most)
    assert thin.x.size <= most + 2 or thin.x.size == values.size
    assert (thin.y.min(), thin.y.max()) == (values.min(), values.max())
    assert (thin.x[0], thin.x[-1]) == (0, values.size - 1)
    assert np.all(np.diff(thin.x) > 0)
    assert np.array_equal(values[thin.x.astype(int)], thin.y)


def test_figures_are_the_same_every_time_and_hold_no_names_of_others():
    def draw():
        figure = new_figure(2.0)
        plot_curves(
            [curve(HOSTILE, [0, 1], [0, 1], "measured")], xlabel="x", ylabel="y", title=HOSTILE, ax=figure.add_subplot()
        )
        return svg(figure, "key")

    text = draw()
    assert text == draw()
    assert "script" not in text
    assert "http" not in text


def test_damping_at_a_speed_is_the_law():
    plant = Plant(gain=1.9, damping=6.0, effects=(VelocityDecayDamping(alpha1=17.0, alpha2=13.0),))
    speed = np.array([0.0, 0.1, 0.5])
    assert damping_at(plant, speed) == pytest.approx(6.0 + 17.0 * np.exp(-13.0 * speed), rel=1e-6)


def test_formula_names_every_parameter_in_words():
    plant = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.3),))
    words = plant_formula("law", plant).caption
    assert all(name in words for name in ("β, gain", "c, damping", "F, level", "Dry friction".lower()))


def test_formula_explains_what_was_fitted_and_no_contact_that_was_not():
    usual = EndStop(low=-0.1, high=0.1)
    words = plant_formula("law", Plant(gain=1.9, damping=6.0, effects=(usual,))).caption
    assert "contact frequency" not in words
    assert "The contact's stiffness k and damping d are those of a stiff one and were not fitted." in words
    other = replace(usual, contact_frequency=100.0)
    words = plant_formula("law", Plant(gain=1.9, damping=6.0, effects=(other,))).caption
    assert "contact frequency" in words
    assert "damping d follow from ν and χ" in words
    law = Plant(gain=1.9, damping=6.0, effects=(VelocityDecayDamping(alpha1=17.0, alpha2=13.0),))
    assert "α₁: extra damping" in plant_formula("law", law).caption


def test_sample_of_an_outline_is_a_line_of_its_colour():
    _, ax = panel_figure(2.0)
    plot_damping_in_time(np.array([0.0, 1.0, 2.0]), np.array([3.0, 4.0]), np.array([0.1, 0.1]), ax=ax)
    (key,) = keys_of(ax)
    assert "<rect" not in key.svg
    assert 'stroke="var(--green)"' in key.svg


def test_damping_of_which_the_data_say_nothing_is_not_drawn():
    varying = VaryingDamping(
        gain=2.0,
        edges=np.array([0.0, 1.0, 2.0, 3.0]),
        damping=np.array([5.0, 6.0, 7.0]),
        speed=np.array([0.3, 0.2, 0.1]),
        active=(),
        spread=known(np.diag([0.1, 0.1, 1e4, 0.1])),
    )
    drawn = damping_in_time_figure("key", [("T", varying)], "Caption.")
    assert drawn.caption == "Caption. 1 piece of which the data say little is left out."
    (panel,) = drawn.pictures[0].panels
    assert panel.x.high == 2.0
    assert len(drawn.table.rows) == 3


def test_records_whose_command_is_not_logged_have_no_empty_panel(runs):
    blind = runs[5].with_({"voltage": None})
    assert [len(record_figure("key", [r], "Caption.").pictures[0].panels) for r in (runs[5], blind)] == [2, 1]


def test_lines_break_neither_before_a_unit_nor_in_a_range():
    text = render_page("T", "In 0.5 s at 4 V s/m, 3 %, 1.2–3.4 of 5 records.", [], [])
    assert "In 0.5\u00a0s at 4\u00a0V\u00a0s/m, 3\u00a0%, 1.2\u2060–\u20603.4 of 5 records." in text


def test_page_escapes_whatever_it_is_given():
    line = Line(label=HOSTILE, colour="#000000", x=np.array([0.0, 1.0]), y=np.array([0.0, np.nan]))
    scale = Scale(label=HOSTILE, low=0.0, high=1.0, kind="linear")
    panel = Panel(title=HOSTILE, box=(0.0, 0.0, 1.0, 1.0), x=scale, y=scale, lines=(line,))
    picture = Picture(svg="<svg></svg>", panels=(panel,))
    drawing = Drawing(pictures=(picture,), caption=HOSTILE, legend=(Key(label=HOSTILE, svg="<svg></svg>"),))
    text = render_page(HOSTILE, HOSTILE, [HOSTILE], [Section(key="a", title=HOSTILE, blocks=(HOSTILE, drawing))])
    assert "<script>alert" not in text
    assert "{{ 7*7 }}" in text
    (told,) = re.findall(r'<script type="application/json" class="numbers">(.*?)</script>', text)
    assert json.loads(told)["pictures"][0][0]["lines"][0]["label"] == HOSTILE
    assert_self_contained(text)


@given(signal, st.integers(0, 3))
def test_numbers_in_a_page_are_those_of_the_figure(values, gaps):
    values = values.copy()
    values[:gaps] = np.nan
    code = encoded(values)
    steps = [code["from"] + round(i * code["step"]) for i in range(code["n"])] if "n" in code else None
    whole = np.cumsum([0 if d is None else d for d in code.get("d", [])]) if steps is None else np.array(steps)
    known = np.isfinite(values)
    if "d" in code:
        assert [d is not None for d in code["d"]] == known.tolist()
    if known.any():
        size = (
            max(float(np.ptp(values[known])), 1e-300) if np.ptp(values[known]) else float(np.abs(values[known]).max())
        )
        assert np.abs(whole * 10.0 ** code["e"] - values)[known].max() <= 1.1e-4 * size


def test_panels_tell_where_they_are_and_what_is_in_them():
    figure, ax = panel_figure(2.0, 4.0)
    plot_curves([curve("a", [0, 1, 2], [0, 5, 9], "first")], xlabel="Time [s]", ylabel="Position [m]", title="T", ax=ax)
    drawn = drawing("key", figure, "caption")
    (panel,) = drawn.pictures[0].panels
    left, top, width, height = panel.box
    assert (panel.title, panel.x.label, panel.y.label, panel.x.kind) == ("T", "Time [s]", "Position [m]", "linear")
    assert [line.label for line in panel.lines] == ["a"]
    path = re.search(
        r'class="panel-0".*?d="(M[^"]*)" clip-path="[^"]*" style="fill: none; stroke: var\(--blue\)',
        drawn.pictures[0].svg,
    )
    first = [float(number) for number in re.findall(r"-?[\d.]+", path[1])[:2]]
    share = (0.0 - panel.x.low) / (panel.x.high - panel.x.low), (0.0 - panel.y.low) / (panel.y.high - panel.y.low)
    assert first == pytest.approx([left + share[0] * width, top + (1 - share[1]) * height], abs=0.02)
    assert panels_of(figure)[0].box == panel.box


@pytest.mark.parametrize("name", ["page.docx", "page", "page.html.txt"])
def test_page_of_another_kind_is_refused(name, runs, tmp_path):
    with pytest.raises(InputError, match=r"written as \.html or \.pdf"):
        write_report(tmp_path / name, runs[:1])
    assert list(tmp_path.iterdir()) == []


def test_pdf_without_a_browser_is_refused_at_once(runs, tmp_path, monkeypatch):
    monkeypatch.setenv("SERVOLENS_CHROMIUM", "no-such-browser")
    with pytest.raises(InputError, match="needs Chromium or Chrome, and none was found"):
        write_report(tmp_path / "page.pdf", runs[:1])
    assert list(tmp_path.iterdir()) == []


def test_browser_that_prints_nothing_is_refused(tmp_path, monkeypatch):
    idle = tmp_path / "idle"
    idle.write_text("#!/bin/sh\nexit 0\n", encoding="utf-8")
    idle.chmod(0o755)
    monkeypatch.setenv("SERVOLENS_CHROMIUM", str(idle))
    with pytest.raises(InputError, match="idle did not print the page"):
        write_page(tmp_path / "page.pdf", "Title", "Lead.", [], [])
    assert [path.name for path in tmp_path.iterdir()] == ["idle"]


@pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome is here to print")
def test_pdf_is_a_pdf(tmp_path):
    write_page(tmp_path / "page.PDF", "Title", "Lead.", [], [Section(key="a", title="Part", blocks=("Text.",))])
    content = (tmp_path / "page.PDF").read_bytes()
    assert content.startswith(b"%PDF-")
    assert b"%%EOF" in content[-32:]


def test_long_names_are_cut():
    assert len(shown("x" * 1000)) == 40


@pytest.fixture(scope="module")
def runs():
    return lab.table_one(lab.NLM3, 5)


@pytest.mark.parametrize(
    ("change", "tells"),
    [
        ({}, "There is one record"),
        ({"name": HOSTILE}, "&lt;script&gt;"),
        pytest.param({"length_unit": "rad"}, "V s/rad", marks=pytest.mark.slow),
        ({"reference": None, "controller": None}, "No gain was sought"),
        pytest.param({"voltage": None}, "no voltage is logged", marks=pytest.mark.slow),
    ],
    ids=["one record", "hostile name", "radians", "voltage only", "reference only"],
)
def test_report_takes_any_single_record(runs, tmp_path, change, tells):
    page = tmp_path / "report.html"
    body = write_report(page, [runs[5].with_(change)])
    text = page.read_text(encoding="utf-8")
    assert body["diagnosis"]["verdict"] == "explained"
    assert "Measured against predicted" in text
    assert_self_contained(text)
    assert tells in text
    json.dumps(body, allow_nan=False)


@pytest.mark.slow
def test_report_holds_every_record_out_once(runs, tmp_path):
    page = tmp_path / "report.html"
    body = write_report(page, runs[4:7], spec=PDSpec(kp=100, settling_time=0.5))
    errors = [[model["percent_error"] for model in record] for record in body["held_out"]["records"]]
    assert len(errors) == 3
    assert all(constant > 10 * velocity for constant, velocity in errors)
    assert body["comparison"]["nonlinear"]["kd"] == pytest.approx(3.815, abs=0.02)
    assert_self_contained(page.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_report_on_an_infeasible_spec_says_so(runs, tmp_path):
    page = tmp_path / "report.html"
    body = write_report(page, runs[:1], spec=PDSpec(kp=100, settling_time=0.05), effort="quick")
    assert body["comparison"]["nonlinear"]["feasible"] is False
    assert body["kd"] is None
    assert body["gain"]["light"] == "red"
    assert "No kd" in page.read_text(encoding="utf-8")


def test_report_of_a_linear_axis_finds_no_dependence_on_speed(tmp_path):
    page = tmp_path / "report.html"
    write_report(page, [lab.step_record(lab.LM1, kp=60, noise=1e-5, seed=1)])
    assert "does not depend on speed" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_long_record_makes_a_small_page(tmp_path):
    record = lab.step_record(lab.NLM1, kp=60, reference=(0.1, 0.0) * 12, duration=0.6, noise=1e-5, seed=2)
    page = tmp_path / "report.html"
    write_report(page, [record], effort="quick")
    assert "the first 3 are drawn" in page.read_text(encoding="utf-8")
    assert "Where the error lives" in page.read_text(encoding="utf-8")
    assert page.stat().st_size < 1_000_000


def test_report_that_cannot_be_written_is_refused_before_anything_is_computed(tmp_path):
    with pytest.raises(InputError, match=r"missing does not exist; create it first"):
        write_report(tmp_path / "missing" / "report.html", [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("force", [False, True], ids=["refused", "forced"])
def test_page_of_records_with_a_wrong_sign_is_written(tmp_path, force):
    runs = [
        record.with_({"position": -record.position})
        for record in (lab.step_record(lab.NLM1, kp, noise=1e-5, seed=kp) for kp in (60, 80))
    ]
    found = study_records(runs, PDSpec(kp=80, settling_time=0.5), effort="quick", force=force)
    page = tmp_path / "report.html"
    write_study(page, found)
    text = page.read_text(encoding="utf-8")
    assert ("Correct the records first" in text) is not force
    assert ("The gain</h2>" in text) is force
    assert "could not be predicted" not in text


def test_page_tells_each_thing_once_and_in_words(tmp_path):
    runs = [lab.step_record(lab.NLM3, kp, noise=1e-5, seed=kp) for kp in (60, 80)]
    fast = lab.step_record(lab.NLM3, 120, noise=1e-5, seed=3, setup=lab.Setup(name="fast"))
    found = study_records(runs, PDSpec(kp=80, settling_time=0.5), heldout=[fast], effort="quick")
    page = tmp_path / "report.html"
    write_study(page, found)
    text = page.read_text(encoding="utf-8").replace("\u00a0", " ")
    assert any(finding.code == "noise_model" for finding in found.findings)
    assert '<span class="severity">Note</span>: noise' not in text
    assert "velocity_decay_damping" not in re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    fastest = max(quality.top_speed for quality in found.check[:2])
    assert f"moves at up to {fastest:.3g} m/s in the records that were fitted" in text
    assert "force=True" not in text
