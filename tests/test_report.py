"""The pages people read: figures show what they are given, pages load nothing, names stay text."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from servolens import lab
from servolens.design import PDSpec
from servolens.effects import CoulombFriction, VelocityDecayDamping
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.report import write_report
from servolens.report.content import Drawing, Section
from servolens.report.curves import curve
from servolens.report.figures import damping_at, plant_formula
from servolens.report.page import render_page
from servolens.report.plots import plot_curves, plot_damping_in_time, plot_damping_laws, plot_percent_errors
from servolens.report.plots_design import Mark, plot_settling_times, plot_step_responses
from servolens.report.style import new_figure
from servolens.report.svg import svg
from servolens.report.wording import shown

HOSTILE = "<script>alert(1)</script> --> $x_{ & \"quoted\" 'too' \x1b[31m\n{{ 7*7 }}"
signal = arrays.arrays(np.float64, st.integers(2, 50), elements=st.floats(-1e3, 1e3))


class Page(HTMLParser):
    """Collects what a browser would load or run."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.anchors, self.ids = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                (self.anchors if value.startswith("#") else self.addresses).append(value)
            if name == "id":
                self.ids.append(value)
            assert not name.startswith("on")


def assert_self_contained(text):
    page = Page(text)
    assert page.addresses == []
    assert {"script", "iframe", "object", "embed", "link", "img", "base"} & set(page.tags) == set()
    assert "http" not in text
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
    ax = plot_step_responses([line], reference=0.1, band=0.01, settling_time=0.5, zoom=(0.2, 1.0))
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


def test_page_escapes_whatever_it_is_given():
    drawing = Drawing(svg="<svg></svg>", caption=HOSTILE)
    text = render_page(HOSTILE, HOSTILE, [HOSTILE], [Section(key="a", title=HOSTILE, blocks=(HOSTILE, drawing))])
    assert "<script" not in text
    assert "{{ 7*7 }}" in text
    assert_self_contained(text)


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
        ({"length_unit": "rad"}, "V s/rad"),
        ({"reference": None, "controller": None}, "No gain was sought"),
        ({"voltage": None}, "no voltage is logged"),
    ],
    ids=["one record", "hostile name", "radians", "voltage only", "reference only"],
)
def test_report_takes_any_single_record(runs, tmp_path, change, tells):
    page = tmp_path / "report.html"
    body = write_report(page, [runs[5].with_(change)])
    text = page.read_text(encoding="utf-8")
    assert body["diagnosis"]["verdict"] == "explained"
    assert "What the simulation gets wrong" in text
    assert_self_contained(text)
    assert tells in text
    json.dumps(body, allow_nan=False)


def test_report_holds_every_record_out_once(runs, tmp_path):
    page = tmp_path / "report.html"
    body = write_report(page, runs[4:7], spec=PDSpec(kp=100, settling_time=0.5))
    errors = [[model["percent_error"] for model in record] for record in body["held_out"]["records"]]
    assert len(errors) == 3
    assert all(constant > 10 * velocity for constant, velocity in errors)
    assert body["comparison"]["nonlinear"]["kd"] == pytest.approx(3.815, abs=0.02)
    assert_self_contained(page.read_text(encoding="utf-8"))


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


def test_long_record_makes_a_small_page(tmp_path):
    record = lab.step_record(lab.NLM1, kp=60, reference=(0.1, 0.0) * 12, noise=1e-5, seed=2)
    page = tmp_path / "report.html"
    write_report(page, [record])
    assert "the first 3 are drawn" in page.read_text(encoding="utf-8")
    assert "What the simulation gets wrong" in page.read_text(encoding="utf-8")
    assert page.stat().st_size < 1_000_000


def test_report_that_cannot_be_written_leaves_nothing(runs, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_report(tmp_path / "missing" / "report.html", runs[:1])
    assert list(tmp_path.iterdir()) == []
