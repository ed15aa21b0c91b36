"""What a model remembers of its records: written, read, and measured against what the laboratory knows."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from servolens import lab
from servolens.diagnosis import diagnose
from servolens.diagnosis.remainder import unexplained_acceleration
from servolens.effects import CoulombFriction
from servolens.errors import InputError
from servolens.identification import identify
from servolens.identification.data_range import data_range
from servolens.model import Model, read_model
from servolens.model_evidence import DataRange, Evidence, Missed, Remainder
from servolens.plant import Plant
from servolens.prediction import prediction_residual

LEFT = Remainder(
    rms=1e-4,
    times_noise=None,
    of_travel=1e-3,
    acceleration_rms=0.02,
    correlation_time=0.05,
    of_motor=1e-3,
    depends_on_inputs=True,
    material=False,
)
KNOWN = Evidence(
    range=DataRange(voltage=8.0, speed=1.2, step=0.1),
    verdict="partly_explained",
    remainder=LEFT,
    heldout_of_step=0.002,
    fatal=("run 3: its voltage has the wrong sign.",),
    missed=(Missed(record="run 3", how="left_out", rms=2e-4, step=0.1),),
)
PLANT = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.3),))
MATRIX = np.array([[1e-4, 2e-5, np.nan], [2e-5, 4e-3, np.nan], [np.nan, np.nan, np.nan]])


def written(model, tmp_path):
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **model.to_json()}, allow_nan=False), encoding="utf-8")
    return path


def changed(path, **fields):
    data = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**data, **fields}), encoding="utf-8")
    return path


def test_model_file_keeps_evidence_and_covariance(tmp_path):
    again = read_model(written(Model(plant=PLANT, covariance=MATRIX, evidence=KNOWN), tmp_path))
    assert again.evidence == KNOWN
    np.testing.assert_array_equal(again.covariance, MATRIX)


def test_covariance_is_read_by_its_names(tmp_path):
    path = written(Model(plant=PLANT, covariance=MATRIX), tmp_path)
    named = json.loads(path.read_text(encoding="utf-8"))["covariance"]
    assert named["names"] == ["gain", "damping", "coulomb_friction.level"]
    turned = {"names": named["names"][::-1], "matrix": [row[::-1] for row in named["matrix"][::-1]]}
    np.testing.assert_array_equal(read_model(changed(path, covariance=turned)).covariance, MATRIX)
    np.testing.assert_array_equal(read_model(changed(path, covariance=named["matrix"])).covariance, MATRIX)


def test_model_file_without_evidence_is_taken_as_it_is(tmp_path):
    assert read_model(written(Model(plant=PLANT), tmp_path)).evidence is None


DAMAGED = {
    "range that is no number": {"range": {"voltage": "8 V", "speed": 1.0, "step": 0.1}},
    "range without a step": {"range": {"voltage": 8.0, "speed": 1.0}},
    "negative share": {"heldout_of_step": -0.1},
    "record that is left out in no known way": {
        "missed": [{"record": "run 3", "how": "half", "rms": 1e-4, "step": 0.1}]
    },
    "record without a step": {"missed": [{"record": "run 3", "how": "end", "rms": 1e-4, "step": 0.0}]},
    "remainder without its force": {"remainder": {"rms": 1e-4}},
    "verdict that is none": {"verdict": "fine"},
    "verdict that is none, without evidence": {"verdict": "fine", "range": None},
    "remainder that is a number": {"remainder": 3},
    "remainder that is a number, without evidence": {"remainder": 3, "range": None},
    "remainder of a wrong type": {"remainder": {**LEFT.to_json(), "material": "no"}},
    "negative noise": {"noise": -1e-5},
    "covariance of other parameters": {"covariance": {"names": ["a", "b", "c"], "matrix": np.eye(3).tolist()}},
}


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"verdict": "fine"}, "verdict must be one of healthy, explained, partly_explained, unexplained; got 'fine'"),
        ({"remainder": 3}, "remainder must be an object, got '3'"),
        ({"effects": [{"effect": "delay", "parameters": 3}]}, "parameters must be an object, got '3'"),
        ({"effects": [7]}, r"effects\[0\] must be an object, got '7'"),
        ({"effects": [{"effect": "delay"}]}, r"effects\[0\]: 'parameters' is missing"),
        ({"identified_from": "run 1"}, "identified_from must be a list, got 'run 1'"),
        ({"covariance": {"names": 3, "matrix": [[1.0]]}}, "names of covariance must be a list, got '3'"),
        ({"covariance": {"names": ["gain"], "matrix": [["x"]]}}, "covariance must hold numbers, got"),
    ],
)
def test_the_field_that_is_wrong_is_named(tmp_path, fields, said):
    path = changed(written(Model(plant=PLANT, covariance=MATRIX, evidence=KNOWN), tmp_path), **fields)
    with pytest.raises(InputError, match=rf"model\.json: {said}"):
        read_model(path)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('"gain":', '"gain": {"value": 45}, "gain":', "names 'gain' twice in one object; keep one"),
        ('"speed": ', '"speed": 1.0, "speed": ', "names 'speed' twice in one object; keep one"),
        ('"noise": 1e-05', '"noise": NaN', "noise must be finite, got nan; write null for what is not known"),
        ('"noise": 1e-05', '"noise": 1e999', "noise must be finite, got inf; write null"),
    ],
)
def test_json_that_says_two_things_or_nothing_is_refused(tmp_path, before, after, said):
    path = written(Model(plant=PLANT, evidence=replace(KNOWN, noise=1e-5)), tmp_path)
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after, 1), encoding="utf-8")
    with pytest.raises(InputError, match=rf"model\.json: {said}"):
        read_model(path)


def test_noise_of_the_records_range_that_is_null_is_not_known():
    """It was read as infinite, and then nothing lay beyond the records."""
    known = {"voltage": 6.0, "speed": 0.7, "step": 0.1}
    unknown = dict.fromkeys(("voltage_error", "speed_error", "step_error"))
    assert DataRange.from_json({**known, **unknown}) == DataRange(**known)


def test_what_is_null_says_why():
    known = replace(KNOWN, verdict=None, remainder=None, noise=None)
    told = Model(plant=PLANT, covariance=MATRIX, evidence=known, reasons={"coulomb_friction.level": "usual"}).to_json()
    assert told["reason"].startswith("verdict: no diagnosis was made; remainder: no diagnosis was made; ")
    assert told["reason"].endswith("; noise: it was not estimated")
    assert told["covariance"]["reason"] == "coulomb_friction.level: usual"
    assert Model(plant=PLANT).to_json()["reason"] == "covariance: the errors of the parameters are not known"


@pytest.mark.parametrize("fields", DAMAGED.values(), ids=DAMAGED)
def test_damaged_evidence_is_refused(tmp_path, fields):
    path = changed(written(Model(plant=PLANT, covariance=MATRIX, evidence=KNOWN), tmp_path), **fields)
    with pytest.raises(InputError, match=r"model\.json: "):
        read_model(path)


def test_remainder_that_is_not_finite_stays_so(tmp_path):
    lost = replace(KNOWN, remainder=replace(LEFT, rms=np.inf, acceleration_rms=np.inf, of_travel=np.inf))
    again = read_model(written(Model(plant=PLANT, evidence=lost), tmp_path)).evidence
    assert again == lost


@pytest.mark.parametrize("frequency", [0.5, 1.5])
@pytest.mark.parametrize("kd", [0.0, 5.0])
def test_unexplained_acceleration_is_the_force_that_was_left_out(frequency, kd):
    """A sine of amplitude A has the r.m.s. A/√2, and its rate of change 2πf times that; slower than the loop."""
    swing = {"amplitude": 0.5, "frequency": frequency, "phase": 0.3}
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"periodic_disturbance": swing})
    record = lab.step_record(truth, 60.0, kd, duration=4.0, encoder=0.0, noise=2e-6, seed=1)
    plant = Plant(gain=1.9, damping=6.0)
    residual = prediction_residual(plant, record)
    force, lasts = unexplained_acceleration(plant, [record], [residual], rate=np.sqrt(1.9 * 60.0), noise=2e-6)
    assert force == pytest.approx(0.5 / np.sqrt(2.0), rel=0.1)
    assert lasts == pytest.approx(1.0 / (2.0 * np.pi * frequency), rel=0.15)


def test_diagnosed_model_remembers_its_records():
    runs = [lab.step_record(lab.LM1, kp, noise=1e-5, seed=kp) for kp in (40, 60)]
    heldout = lab.step_record(lab.LM1, 80, noise=1e-5, seed=3)
    known = diagnose(runs, heldout=heldout, effort="quick").model.evidence
    assert known.verdict == "healthy"
    assert known.range.voltage == pytest.approx(8.0, rel=1e-3)  # kp times the step, of the record held out
    assert known.range.step == pytest.approx(0.1, rel=1e-3)
    assert known.range.speed == pytest.approx(np.abs(np.gradient(heldout.position, heldout.time)).max(), rel=0.1)
    assert known.heldout_of_step < 1e-3
    assert [(one.record, one.how) for one in known.missed] == [(heldout.name, "held_out")]
    assert not known.remainder.material
    assert known.fatal == ()


def test_records_that_are_left_out_in_turn_are_told_from_those_held_out():
    runs = [lab.step_record(lab.LM1, kp, noise=1e-5, seed=kp) for kp in (40, 60)]
    both = diagnose(runs, effort="quick").model.evidence
    assert {(one.record, one.how) for one in both.missed} == {(runs[0].name, "left_out"), (runs[1].name, "end")}
    (alone,) = diagnose(runs[0], effort="quick").model.evidence.missed
    assert (alone.record, alone.how) == (runs[0].name, "end")


def test_held_out_record_of_another_axis_speaks_against_the_model():
    other = lab.Truth(gain=2.6 * lab.LM1.gain, damping=lab.LM1.damping)
    runs = [lab.step_record(lab.LM1, kp, noise=1e-5, seed=kp) for kp in (40, 60)]
    known = diagnose(runs, heldout=lab.step_record(other, 60, noise=1e-5, seed=3), effort="quick").model.evidence
    assert known.heldout_of_step > 0.05


def test_identified_model_remembers_how_far_its_records_reach():
    record = lab.step_record(lab.LM1, 60, noise=1e-5, seed=1)
    known = identify(record).model.evidence
    assert known.range.voltage == pytest.approx(6.0, rel=1e-3)
    assert known.verdict is None
    assert known.remainder is None


def test_noise_explains_how_far_the_largest_voltage_is_off():
    """The largest of some noisy samples has a little less than the noise of one."""
    setup = lab.Setup(rest=0.02)
    quiet = data_range([lab.step_record(lab.NLM3, 60, 3, encoder=0.0, setup=setup)])
    runs = [lab.step_record(lab.NLM3, 60, 3, encoder=0.0, noise=1e-5, seed=seed, setup=setup) for seed in range(60)]
    known = [data_range([run]) for run in runs]
    off = np.array([(one.voltage - quiet.voltage) / one.voltage_error for one in known])
    assert np.mean(np.abs(off) < 1.96) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / len(runs))
    assert np.sqrt(np.mean(off**2)) > 0.5
