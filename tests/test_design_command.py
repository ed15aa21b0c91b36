"""The design command: the gain to use, the lights, and what it withholds."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.cli import group
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence, Remainder
from servolens.plant import Plant
from servolens.results import write_json

AXIS = Plant(gain=1.9, damping=6.0)
SPEC = ("--kp", "100", "--settling-time", "0.5")
LEFT = Remainder(
    rms=1e-4,
    times_noise=3.0,
    of_travel=1e-3,
    acceleration_rms=0.01,
    correlation_time=0.05,
    of_motor=1e-3,
    depends_on_inputs=True,
    material=False,
)
SHOWN = DataRange(voltage=10.0, speed=1.0, step=0.08)


@pytest.fixture
def model(tmp_path, monkeypatch):
    """Write a model with some evidence; return its file."""
    monkeypatch.chdir(tmp_path)

    def write(**fields):
        evidence = Evidence(**{"range": SHOWN, "verdict": "unexplained", "remainder": LEFT, **fields})
        write_json("model.json", "model", Model(plant=AXIS, evidence=evidence).to_json())
        return "model.json"

    return write


def run(*arguments):
    return CliRunner().invoke(group, [str(a) for a in arguments], prog_name="servolens")


def designed(*arguments, status=0):
    done = run("design", *arguments, *SPEC, "--json", "-")
    assert done.exit_code == status, done.output
    return json.loads(done.stdout)


def test_recommended_gain_stands_beside_the_least(model):
    body = designed(model())
    found = body["recommended"]
    assert set(found) >= {"kd", "settling_time", "worst", "probability", "why", "risk"}
    assert body["kd"] < found["kd"]
    assert found["probability"]["interval"][0] <= found["probability"]["value"] <= found["probability"]["interval"][1]
    assert {name: light["light"] for name, light in body["lights"].items()} == {"model": "green", "gain": "green"}
    assert (body["withheld"], body["forced"]) == (False, False)
    settled = lab.step_record(
        lab.Truth(gain=1.9, damping=6.0), 100.0, found["kd"], reference=body["spec"]["reference"], encoder=0.0
    )
    late = settled.time >= 0.5
    assert abs(settled.position[late] - 0.08).max() <= 0.01 * 0.08


def test_text_tells_the_recommended_gain_first_and_ends_with_both_lights(model):
    text = run("design", model(), *SPEC).stdout
    words = " ".join(text.split())
    assert words.index("is recommended: it settles in") < words.index("is the least gain")
    assert "Model: green. " in words
    assert "Gain: green. " in words


def test_step_is_that_of_the_records_unless_it_is_given(model):
    assert designed(model())["spec"]["reference"] == 0.08
    assert designed(model(), "--reference", "0.05")["spec"]["reference"] == 0.05
    write_json("bare.json", "model", Model(plant=AXIS).to_json())
    assert designed("bare.json")["spec"]["reference"] == 0.1


WITHHELD = {
    "fatal finding": ({"fatal": ("kp60: the voltage has the wrong sign.",)}, "wrong sign"),
    "held-out error": ({"heldout_of_step": 0.08}, "misses 8 % of the step"),
    "remainder": (
        {
            "remainder": Remainder(
                **{**LEFT.to_json(), "acceleration_rms": 5.0, "correlation_time": 0.5, "material": True}
            )
        },
        "nine of ten",
    ),
    "voltage": ({"range": DataRange(voltage=4.0, speed=1.0, step=0.08)}, "the voltage reaches 8 V"),
    "speed": ({"range": DataRange(voltage=10.0, speed=0.01, step=0.08)}, "the speed reaches"),
    "amplitude": ({"range": DataRange(voltage=10.0, speed=1.0, step=0.04)}, "the step reaches 0.08 m"),
}


@pytest.mark.parametrize(("fields", "words"), WITHHELD.values(), ids=WITHHELD)
def test_gain_is_withheld_and_force_overrules(model, fields, words):
    file, step = model(**fields), ("--reference", "0.08")
    body = designed(file, *step, status=1)
    assert (body["kd"], body["recommended"], body["withheld"]) == (None, None, True)
    assert words in body["reason"]
    assert body["lights"]["gain"] == {"light": "red", "sentence": body["reason"]}
    assert body["intervals"]
    text = " ".join(run("design", file, *step, *SPEC).stdout.split())
    assert "The gain is withheld; --force gives it all the same." in text
    forced = designed(file, *step, "--force")
    assert forced["forced"]
    assert forced["kd"] == pytest.approx(body["intervals"][0][0])
    assert "Forced: " in run("design", file, *step, *SPEC, "--force").stdout


def test_model_that_says_nothing_of_its_records_is_taken_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bare = {"gain": {"value": 1.9}, "damping": {"value": 6.0}, "effects": []}
    write_json("model.json", "model", bare)
    body = designed("model.json")
    assert body["lights"]["model"]["light"] == "amber"
    assert "Nothing is known" in body["lights"]["model"]["sentence"]
    assert body["recommended"]["probability"]["value"] == 1.0


def test_model_that_was_written_by_force_gives_no_gain(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record = lab.step_record(lab.LM1, 60, noise=1e-5, seed=1)
    rows = zip(record.time, record.reference, record.position, -record.voltage, strict=True)
    lines = [
        "# kp = 60",
        "# kd = 0",
        "time,reference,position,voltage",
        *(",".join(map(repr, map(float, r))) for r in rows),
    ]
    (tmp_path / "mirrored.csv").write_text("\n".join(lines), encoding="utf-8")
    assert run("identify", "mirrored.csv", "--out", "model.json", "--force").exit_code == 0
    known = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"))
    assert known["range"]["voltage"] == pytest.approx(6.0, rel=1e-3)
    assert len(known["fatal"]) == 1


def test_other_steps_have_to_be_met_too(tmp_path, monkeypatch):
    """Dry friction can hold the axis up to 1.6 mm away, which is much of a small step."""
    monkeypatch.chdir(tmp_path)
    friction = {"effect": "coulomb_friction", "parameters": {"level": {"value": 0.3}}}
    write_json("model.json", "model", {"gain": {"value": 1.9}, "damping": {"value": 6.0}, "effects": [friction]})
    wide = ("--band", "0.02")
    alone = designed("model.json", *wide)["recommended"]
    both = designed("model.json", *wide, "--also-reference", "0.2", "--also-reference", "0.01")["recommended"]
    assert alone["probability"]["value"] == both["probability"]["value"] == 1.0
    assert both["kd"] < 0.8 * alone["kd"]
    tiny = designed("model.json", *wide, "--also-reference", "0.005", status=1)
    assert "No gain meets the spec in nine of ten plants" in tiny["reason"]
    refused = run("design", "model.json", *SPEC, "--also-reference", "0")
    assert refused.exit_code == 2
    assert "reference must be finite and not 0" in refused.stderr


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["design", "--free"], "--free needs at least one gain"),
        (["design", "--also-reference", "0"], "error: reference must be finite and not 0"),
        (["map", "--out", "map.png", "--kp-range", "10", "5"], "error: kp of a map must run from"),
    ],
    ids=["no gain", "no step", "empty range"],
)
def test_wrong_option_is_told_as_what_it_is_and_not_as_a_fault_of_the_file(model, wrong, said):
    done = run(wrong[0], model(), *SPEC, *wrong[1:])
    assert done.exit_code == 2
    assert said in done.output
