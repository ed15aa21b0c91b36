"""The demo, end to end."""

from __future__ import annotations

import json
import math
from itertools import pairwise

import pytest
from test_report import assert_self_contained

from servolens.demo import run_demo
from servolens.demo.experiment import RECOMPUTED
from servolens.errors import InputError
from servolens.summaries import hidden_summary


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "made" / "for it"
    told = []
    body = run_demo(folder, progress=lambda *step: told.append(step))
    return folder, body, told


def test_results_have_header_and_finite_numbers(demo):
    folder, body, _ = demo
    stored = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert stored["schema"] == "servolens.demo/1"
    assert set(body) <= set(stored)

    def walk(value):
        if isinstance(value, dict):
            for item in value.values():
                walk(item)
        elif isinstance(value, list):
            for item in value:
                walk(item)
        elif isinstance(value, float):
            assert math.isfinite(value)

    walk(stored)


def test_speed_dependent_models_err_a_tenth_of_the_constant_ones(demo):
    table = demo[1]["table_one"]
    average = dict(zip(table["models"], table["average_percent_error"], strict=True))
    for i in (1, 2, 3):
        assert average[f"NLm{i}"] < 0.1 * average[f"Lm{i}"]


def test_each_model_knows_one_of_the_eight_records(demo):
    held = demo[1]["table_one"]["held_out"]
    assert len(held) == 8
    assert [sum(not row[j] for row in held) for j in range(6)] == [1] * 6


def test_linear_gain_breaks_the_spec_and_nonlinear_gain_meets_it(demo):
    for comparison in demo[1]["design"]["sampled"].values():
        assert comparison["linear"]["on_nonlinear"]["meets"] is False
        assert comparison["nonlinear"]["on_nonlinear"]["meets"] is True
        assert comparison["nonlinear"]["kd"] < comparison["linear"]["kd"]


def test_hidden_effect_is_found_and_the_recommended_gain_meets_the_spec_on_the_truth(demo):
    hidden = demo[1]["hidden"]
    assert [cause["effect"] for cause in hidden["diagnosis"]["causes"]] == list(hidden["truth"]["effects"])
    found = hidden["diagnosis"]["model"]["gain"]["value"]
    assert found == pytest.approx(hidden["truth"]["gain"], rel=0.01)
    assert [hidden[name]["light"] for name in ("data", "model", "gain")] == ["green", "green", "green"]
    tried = {run["gain"]: run for run in hidden["on_axis"]}
    assert tried["recommended"]["meets"] is True
    assert tried["least"]["meets"] is False


def test_terminal_ends_with_the_three_lights(demo):
    told = hidden_summary(demo[1]).sentences
    assert [sentence.partition(":")[0] for sentence in told[-3:]] == ["Data", "Model", "Gain"]


def test_direct_law_finds_the_true_gain_and_the_pieces_do_not(demo):
    routes = demo[1]["routes"]
    for direct, pieces in zip(routes["from_integral_equation"], routes["from_pieces"], strict=True):
        assert abs(direct - routes["true"]) < 0.02
        assert abs(pieces - routes["true"]) > 0.1


def test_designs_on_the_printed_models_agree_with_the_scan(demo):
    for name, intervals in RECOMPUTED.items():
        found = demo[1]["paper"][name]["intervals"]
        assert [x for pair in found for x in pair] == pytest.approx([x for pair in intervals for x in pair], abs=0.01)


def test_constraint_binds_on_short_pieces(demo):
    short = demo[1]["delta"]["short_pieces"]
    assert short["unconstrained"]["active"] == []
    damping = short["constrained"]["damping"]
    assert short["constrained"]["active"]
    assert all(a - b <= 0.5 + 1e-9 for a, b in pairwise(damping))


def test_page_shows_all_figures_and_loads_nothing(demo):
    text = (demo[0] / "report.html").read_text(encoding="utf-8")
    assert_self_contained(text)
    assert text.count("<figure ") == 19
    assert text.index('class="lights"') < text.index('data-name="prediction"') < text.index('data-name="gain"')
    assert text.index('data-name="gain"') < text.index("N. Wongvanich, C. E. Hann and H. R. Sirisena")
    for figure in ("3", "4 and 5", "6", "7", "8", "9", "10"):
        word = "figures" if " " in figure else "figure"
        assert f"paper&#39;s {word} {figure}" in text
    assert text.count("held out") > 8


def test_progress_counts_to_the_end(demo):
    told = demo[2]
    assert [done for _, done, _ in told] == list(range(len(told)))
    assert told[-1][1] == told[-1][2]


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    file = tmp_path / "file"
    file.write_text("in the way")
    with pytest.raises(InputError, match="cannot be made"):
        run_demo(file / "demo")
