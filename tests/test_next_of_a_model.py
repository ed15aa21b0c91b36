"""`servolens next` of a model alone: the scale that is assumed where no logged step is known, and that it is said."""

from __future__ import annotations

import json

import pytest
from test_cli import result

from servolens import Plant
from servolens.diagnosis.proposal import assumed_scale
from servolens.effects import CoulombFriction, DeadZone, Saturation
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence
from servolens.results import write_json


def stage(*effects, **settings):
    """A stage of a few mm: 4500 V/m leave it half damped, 450 V for a step of 0.1 m."""
    return Plant(**{"gain": 0.05, "damping": 15.0, "effects": effects, **settings})


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.json"
    write_json(str(path), "model", Model(plant=stage(CoulombFriction(level=0.02))).to_json(), ())
    return path


def note(body):
    (finding,) = [f for f in body["findings"] if f["code"] == "scale_assumed"]
    assert finding["severity"] == "note"
    return finding["message"]


def test_step_asks_for_no_more_than_drives_take(model):
    body = result("next", "next", model)
    experiment = body["next_experiment"]
    assert abs(experiment["kp"] * (experiment["reference"] - experiment["start"])) <= 10.1
    assert note(body) == (
        "the model's file does not say what was logged: looked at are steps of 0.0022 m around kp = 4500 V/m, which ask"
        " for 9.9 V; give --kp and --reference as they were logged, or the diagnosis (servolens diagnose --json), which"
        " knows them."
    )


def test_gain_follows_a_step_that_is_given_and_the_step_a_gain(model):
    body = result("next", "next", model, "--reference", "0.005")
    assert "steps of 0.005 m around kp = 2000 V/m, which ask for 10 V" in note(body)
    assert "steps of 0.01 m around kp = 1000 V/m" in note(result("next", "next", model, "--kp", "1000"))


def test_model_that_states_no_schema_is_one_for_its_gain(model, tmp_path):
    data = json.loads(model.read_text(encoding="utf-8"))
    path = tmp_path / "bare.json"
    path.write_text(json.dumps({name: data[name] for name in ("gain", "damping", "effects")}), encoding="utf-8")
    assert result("next", "next", path)["next_experiment"] == result("next", "next", model)["next_experiment"]


def test_nothing_is_assumed_where_both_are_given(model):
    body = result("next", "next", model, "--kp", "6000", "--reference", "0.005")
    assert [finding["code"] for finding in body["findings"]] == ["no_rivals"]
    assert 3000 <= body["next_experiment"]["kp"] <= 12000


def test_what_the_records_of_a_model_showed_is_not_asked_again(model, tmp_path):
    shown = DataRange(voltage=9.0, speed=0.1, step=0.004, kp=2500.0, kd=0.0)
    path = tmp_path / "known.json"
    known = Model(plant=stage(CoulombFriction(level=0.02)), evidence=Evidence(range=shown))
    write_json(str(path), "model", known.to_json(), ())
    body = result("next", "next", path)
    assert [finding["code"] for finding in body["findings"]] == ["no_rivals"]
    assert (
        body["next_experiment"]
        == result("next", "next", model, "--kp", "2500", "--reference", "0.004")["next_experiment"]
    )


@pytest.mark.parametrize(
    ("plant", "most"),
    [
        (stage(), 10.0),
        (stage(command_unit="%"), 100.0),
        (stage(command_unit="N"), 450.0),
        (stage(Saturation(limit=24.0)), 48.0),
        (stage(DeadZone(width=1.0)), 10.0),
        (stage(gain=-0.05), 10.0),
    ],
    ids=["V", "%", "N", "saturation", "dead zone", "negative gain"],
)
def test_scale_is_that_of_the_drive(plant, most):
    gain, step = assumed_scale(plant)
    assert gain == pytest.approx(225.0 / plant.gain)
    assert abs(gain * step) == pytest.approx(most, rel=0.05)  # set with two digits


def test_axis_that_needs_little_keeps_the_usual_step():
    assert assumed_scale(Plant(gain=1.9, damping=6.0)) == (pytest.approx(36.0 / 1.9), 0.1)
    assert assumed_scale(Plant(gain=1.9, damping=0.0)) == (pytest.approx(100.0 / 1.9), 0.1)
