"""Plants, effects and model files."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from servolens.effects import CATALOGUE, CoulombFriction, VelocityDecayDamping
from servolens.errors import InputError
from servolens.model import Model, Quantity, read_model
from servolens.plant import Plant
from servolens.simulation import simulate_voltage

NLM1 = Plant(gain=1.9165, damping=5.9986, effects=(VelocityDecayDamping(alpha1=17.3264, alpha2=13.1068),))


def test_values_go_in_and_out_in_the_same_order() -> None:
    assert NLM1.values == (1.9165, 5.9986, 17.3264, 13.1068)
    assert list(NLM1.parameters) == [
        "gain",
        "damping",
        "velocity_decay_damping.alpha1",
        "velocity_decay_damping.alpha2",
    ]
    assert NLM1.with_values(NLM1.values) == NLM1
    assert NLM1.with_values([1.0, 2.0, 3.0, 4.0]).values == (1.0, 2.0, 3.0, 4.0)


def test_units_follow_the_axis() -> None:
    arm = Plant(gain=45.0, damping=23.0, effects=(CoulombFriction(level=1.0),), length_unit="rad", command_unit="N m")
    assert arm.unit("gain") == "rad/s^2/(N m)"
    assert arm.unit("coulomb_friction.level") == "rad/s^2"
    assert NLM1.unit("velocity_decay_damping.alpha2") == "s/m"


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_describes_itself(name: str) -> None:
    effect = CATALOGUE[name]
    assert effect.name == name
    assert effect.sentence.endswith(".")
    assert effect.latex
    assert all(p.meaning and p.unit and p.low < p.high for p in effect.parameters())


@pytest.mark.parametrize("name", CATALOGUE)
def test_voltage_before_a_record_is_remembered_where_it_shows(name: str) -> None:
    cls = CATALOGUE[name]
    plant = Plant(gain=1.9, damping=6.0, effects=(cls(**cls.typical),), length_unit="rad" if cls.is_rotary else "m")
    time = np.arange(400) * 1e-3
    voltage = np.where(time < 0.2, 5.0, -5.0)
    still, pushed = (simulate_voltage(plant, time, voltage, before=before).measured for before in (0.0, 5.0))
    assert plant.remembers_voltage == bool((still != pushed).any())


def test_values_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        NLM1.gain = 2.0  # type: ignore[misc]  # that is the test


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plant(gain=0.0, damping=1.0), "gain must not be 0"),
        (lambda: Plant(gain=float("inf"), damping=1.0), "gain must lie in"),
        (lambda: CoulombFriction(level=-1.0), "coulomb_friction: level must lie in"),
        (lambda: Plant(gain=1.0, damping=1.0, effects=(CoulombFriction(level=1.0),) * 2), "appears twice"),
        (lambda: Plant(gain=1.0, damping=1.0, length_unit="x" * 99), "must be .m. or .rad., got .x{40}.$"),
        (
            lambda: Plant(gain=1.0, damping=1.0, command_unit="mA"),
            "plant: command_unit must be .V., .* or .pwm., got .mA",
        ),
        (lambda: Plant.effect_from("magic", {}), "there is no effect 'magic'"),
        (lambda: Plant.effect_from("saturation", {"width": 1.0}), "needs the parameters limit"),
        (lambda: Plant.effect_from("saturation", {"w" * 99: 1.0}), "needs the parameters limit; got w{40}$"),
    ],
)
def test_wrong_plants_are_one_sentence(make, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_model_survives_its_file(tmp_path) -> None:
    covariance = np.diag([1e-6, 1e-4, np.nan, 1e-2])
    covariance[0, 1] = covariance[1, 0] = 2e-6
    model = Model(plant=NLM1, covariance=covariance, identified_from=("kp 60",))
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **model.to_json()}, allow_nan=False))
    back = read_model(path)
    assert back.plant == NLM1
    assert back.identified_from == ("kp 60",)
    np.testing.assert_array_equal(back.covariance, np.where(np.isnan(covariance), np.nan, covariance))


def test_quantity_has_a_95_percent_interval_or_a_reason() -> None:
    known = Quantity(value=2.0, unit="1/s", stderr=0.1).to_json()
    assert known["interval"] == pytest.approx([2.0 - 0.196, 2.0 + 0.196], abs=1e-4)
    unknown = Quantity(value=2.0, unit="1/s", reason="at its bound").to_json()
    assert unknown == {"value": 2.0, "stderr": None, "interval": None, "unit": "1/s", "reason": "at its bound"}


def test_reason_stands_only_where_no_standard_error_does() -> None:
    covariance = np.diag([1e-6, np.nan, np.nan, 1e-2])
    model = Model(plant=NLM1, covariance=covariance, reasons={"damping": "at its bound", "gain": "held"})
    assert [q.reason for q in model.quantities.values()] == [None, "at its bound", "given, not estimated", None]


def test_file_may_begin_with_a_byte_order_mark(tmp_path) -> None:
    path = tmp_path / "model.json"
    path.write_text('{"gain": {"value": 2.0}, "damping": {"value": 10.0}}', encoding="utf-8-sig")
    assert read_model(path).plant == Plant(gain=2.0, damping=10.0)


def test_file_keeps_why_a_parameter_has_no_standard_error(tmp_path) -> None:
    covariance = np.diag([1e-6, np.nan, np.nan, 1e-2])
    model = Model(plant=NLM1, covariance=covariance, reasons={"damping": "it ended at the end of its range"})
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model.to_json()))
    assert read_model(path).to_json() == model.to_json()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not JSON"),
        ("[]", "is not a model"),
        ('{"schema": "servolens.design/1"}', "is not a model"),
        ('{"schema": "servolens.model/1"}', "'gain' is missing"),
        ('{"schema": "servolens.model/1", "gain": 3, "damping": 4}', "an object such as {\"value\": 1.9}, got '3'"),
        (
            '{"schema": "servolens.model/1", "gain": {"value": 1, "unit": "km/s^2/V"}, "damping": {"value": 1}}',
            "gain is in 'km/s",
        ),
        ('{"schema": "servolens.model/1", "gain": {"value": "1"}, "damping": {"value": 1}}', "must be a number"),
        ('{"schema": "servolens.model/1", "gain": {"value": NaN}, "damping": {"value": 1}}', "gain must lie in"),
        ('{"gain": {"value": 1, "stderr": -0.1}, "damping": {"value": 1}}', "stderr of gain must lie in"),
        ('{"gain": {"value": 1, "stderr": NaN}, "damping": {"value": 1}}', "stderr of gain must lie in"),
        ('{"gain": {"value": 1}, "damping": {"value": 1, "stderr": "1"}}', "stderr of damping must lie in"),
        ('{"gain": {"value": 1}, "damping": {"value": 1}, "covariance": [[1, 2], [2, 1]]}', "positive semidefinite"),
        ('{"gain": {"value": 1}, "damping": {"value": 1}, "covariance": [[1, 0.5], [0, 1]]}', "symmetric"),
        ('{"gain": {"value": 1}, "damping": {"value": 1}, "covariance": [[-1, 0], [0, 1]]}', "positive semidefinite"),
        ('{"gain": {"value": 1, "stderr": 1e200}, "damping": {"value": 1}}', "stderr of gain must lie in"),
        (
            '{"gain": {"value": 1, "stderr": -1}, "damping": {"value": 1}, "covariance": [[1, 0], [0, 1]]}',
            "stderr of gain must lie in",
        ),
        (
            '{"gain": {"value": 1}, "damping": {"value": 1}, "covariance": [[Infinity, 0], [0, 1]]}',
            "positive semidefinite",
        ),
    ],
)
def test_broken_model_files_are_one_sentence(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_model(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("gain", "message"),
    [
        (
            {"value": 19.0},
            "gain is 19, outside its interval from 1.8804 to 1.9196; where the value was changed by hand",
        ),
        ({"value": 1.95}, "gain is 1.95, outside its interval"),
        (
            {"interval": [2.5, 1.0]},
            "interval of gain is from 2.5 to 1, its ends in the wrong order; begin with the lower",
        ),
        ({"value": 3.0, "interval": [2.5, 1.0]}, "interval of gain is from 2.5 to 1, its ends in the wrong order"),
        ({"interval": "1.9"}, "interval of gain must be a list"),
        ({"interval": [1.9]}, "interval of gain must hold 2 values"),
        (
            {"stderr": 0.02},
            "stderr of gain is 0.02, and the covariance has 0.01; change both, or leave out the covariance",
        ),
        ({"stderr": 0.0}, "stderr of gain is 0, and the covariance has 0.01"),
    ],
)
def test_model_files_that_contradict_themselves_are_refused(tmp_path, gain, message) -> None:
    """As one changed by hand in a single place does: what it then says of its errors would be believed."""
    path = tmp_path / "model.json"
    data = Model(plant=Plant(gain=1.9, damping=6.0), covariance=np.diag([1e-4, 1e-2])).to_json()
    data["gain"] |= gain
    path.write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        read_model(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_standard_errors_that_the_covariance_does_not_know_are_refused(tmp_path) -> None:
    path = tmp_path / "model.json"
    data = Model(plant=Plant(gain=1.9, damping=6.0), covariance=np.diag([1e-4, np.nan])).to_json()
    data["damping"] |= {"stderr": 0.1, "interval": None}
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"stderr of damping is .*, and the covariance does not know it"):
        read_model(path)


def test_errors_of_a_model_may_be_rounded_to_two_digits(tmp_path) -> None:
    path = tmp_path / "model.json"
    data = Model(plant=Plant(gain=1.9, damping=6.0), covariance=np.diag([1.16e-6, 1e-2])).to_json()
    data["gain"] |= {"stderr": 0.0011, "interval": [1.898, 1.902]}
    path.write_text(json.dumps(data))
    assert read_model(path).quantities["gain"].stderr == pytest.approx(1.077e-3, rel=1e-3)
    data["gain"] |= {"value": 1.8, "stderr": 0.01, "interval": None}
    data |= {"covariance": None}
    path.write_text(json.dumps(data))
    assert read_model(path).quantities["gain"].stderr == pytest.approx(0.01)


def test_rounding_of_a_covariance_is_no_fault(tmp_path) -> None:
    path = tmp_path / "model.json"
    held = "[[1, 0, null], [1e-17, 1, null], [null, null, null]]"
    path.write_text(
        '{"gain": {"value": 1}, "damping": {"value": 1}, "effects": [{"effect": "coulomb_friction", "parameters":'
        f' {{"level": {{"value": 1}}}}}}], "covariance": {held}}}'
    )
    np.testing.assert_array_equal(np.isnan(np.diag(read_model(path).covariance)), [False, False, True])


def test_model_by_hand_needs_no_schema(tmp_path) -> None:
    path = tmp_path / "model.json"
    path.write_text('{"gain": {"value": 1.9}, "damping": {"value": 6}, "effects": []}')
    assert read_model(path).plant == Plant(gain=1.9, damping=6.0)


def test_missing_model_file_is_one_sentence(tmp_path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_model(tmp_path / "none.json")
