"""The study of recommended gains on hidden axes: what it counts, and that its page tells what its file holds."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
sys.path.append(str(BENCHMARKS))
axes, study = import_module("gain_axes"), import_module("tried_gains")


def outcome(number, light, *, meets, section="catalogue"):
    runs = {
        "recommended": axes.Run(2.0, (0.3, 0.3 if meets else None), meets=meets),
        "least": axes.Run(1.0, (0.5, 0.6), meets=False),
    }
    lights = {"data": "green", "model": "green", "gain": light}
    return axes.Outcome(axes.Axis(section, "final", number), ("delay",), "explained", lights, "", 0.5, runs)


def test_only_gains_that_are_given_count_and_what_would_fail_has_to_be_withheld():
    seen = [outcome(i, "green", meets=i != 3) for i in range(8)]
    seen += [outcome(8, "red", meets=False), outcome(9, "red", meets=True)]
    text = study.report(seen)
    assert "| **all** | **10** | **8** | **87.5 % (47.3 to 99.7 %)** | **0.0 % (0.0 to 36.9 %)** |" in text
    assert "withheld on 2, where it would have met the spec on 1" in text
    assert "2 would have failed; 1 of these were withheld (50 %, 1 to 99 %)" in text
    assert "* catalogue 3 (coarse, delay): explained, gain green; asked 0.5 s; recommended 2 0.3 s/never" in text


def test_outcomes_survive_their_file_and_a_line_cut_short_is_no_outcome(tmp_path):
    import json

    one = outcome(4, "amber", meets=True, section="foreign")
    whole = json.dumps(one.to_json())
    (tmp_path / "r.jsonl").write_text(f"{whole}\n{whole[:40]}", encoding="utf-8")
    assert study.read(tmp_path / "r.jsonl") == {one.axis: one}


@pytest.mark.parametrize("kind", ["development", "final"])
def test_seeds_of_the_confusion_study_go_on_beyond_the_first_hundred(kind):
    cases = import_module("hidden_cases")
    seeds = []
    for section in cases.SECTIONS:
        for first in (0, 99, 100, 250):
            chosen = cases.cases(["white"], [section], (), 1, first, kind)
            assert {case.kind for case in chosen} == {kind}
            seeds += [case.seed for case in chosen]
    healthy = 10_000 * list(cases.SECTIONS).index("healthy")  # has ten thousand seeds for its one row
    assert len(set(seeds)) == len(seeds)
    assert {cases.BASES[kind] + healthy + k for k in (0, 99, 100, 250)} <= set(seeds)


def test_seeds_of_the_study_are_those_of_no_other():
    used = {base for name in ("hidden_cases", "coverage_study") for base in import_module(name).BASES.values()}
    own = {base + begin for base in axes.BASES.values() for begin in axes.SECTIONS.values()}
    assert min(abs(a - b) for a in own for b in used) > 200_000
    assert len(own) == 4


def test_the_page_tells_what_the_file_holds():
    final = [one for one in study.read(study.RESULTS).values() if one.axis.kind == "final"]
    assert len(final) >= 20
    _, _, rest = study.PAGE.read_text(encoding="utf-8").partition(study.BEGIN)
    assert rest.partition(study.END)[0].strip() == study.report(final)


@pytest.mark.slow
def test_an_axis_goes_the_whole_way_and_its_gain_is_run_on_the_truth():
    found = axes.run(axes.Axis("catalogue", "development", 1))
    assert found.hidden == ("asymmetric_damping",)
    assert found.given
    assert found.meets("recommended")
    assert found.runs["least"].kd < found.runs["recommended"].kd
    assert max(found.runs["recommended"].settles) <= found.settling_time
