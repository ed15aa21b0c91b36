"""Records of one axis that differ in their moving inertia, or in which the motor is off for a while."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from servolens.bridge import to_control
from servolens.campaign import read_records
from servolens.cli import group
from servolens.design import PDSpec
from servolens.diagnosis import diagnose
from servolens.dynamics import dynamics
from servolens.effects import (
    CATALOGUE,
    Actuator,
    ActuatorLag,
    CoulombFriction,
    EndStop,
    FlexibleCoupling,
    Force,
    ForceLimit,
    Presliding,
    Sensor,
    SpeedServo,
    TimeShift,
    parameter,
)
from servolens.errors import InputError
from servolens.identification import fit, identify
from servolens.model import Model, read_model
from servolens.plant import Plant
from servolens.reading import read_record, record_from_dataframe
from servolens.record import Controller, Record
from servolens.results import write_json
from servolens.simulation import plant_in, simulate, simulate_voltage
from servolens.study import tune

GAIN, DAMPING = 1.9, 6.0
TIME = 1e-3 * np.arange(801)
PUSH = np.where(TIME < 0.3, 4.0, -2.0)


def record(**changes: Any) -> Record:
    given = {"time": TIME, "position": 0 * TIME, "voltage": PUSH, **changes}
    return Record(**given)


# --- files

CSV = """# kp = 60
# inertia = {inertia}
time [s],reference,position,voltage,enabled
0.000,0.1,0.0,6.0,1
0.001,0.1,0.0,6.0,1
0.002,0.1,0.0,6.0,0
0.003,0.1,0.0,6.0,0
0.004,0.1,0.0,6.0,1
"""


@pytest.mark.parametrize(
    ("text", "inertia"), [("0.02", 0.02), ("0.02 kg m^2", 0.02), ("200 kg cm^2", 0.02), ("0.02 kg m²", 0.02)]
)
def test_inertia_and_enabled_are_read_from_a_file(tmp_path, text, inertia):
    path = tmp_path / "run.csv"
    path.write_text(CSV.format(inertia=text), encoding="utf-8")
    found = read_record(path)
    assert found.inertia == pytest.approx(inertia)
    assert found.enabled is not None
    assert found.enabled.tolist() == [1.0, 1.0, 0.0, 0.0, 1.0]
    assert found.remarks == ()


def test_mass_and_mapped_columns_are_read_from_a_campaign(tmp_path):
    lines = CSV.format(inertia=0.02).replace("enabled", "servo_on").splitlines()
    (tmp_path / "run.csv").write_text("\n".join(lines[:1] + lines[2:]))
    (tmp_path / "campaign.toml").write_text(
        '[[records]]\nfile = "run.csv"\nmass = "1500 g"\ncolumns = {enabled = "servo_on"}\n'
    )
    (found,) = read_records(tmp_path / "campaign.toml")
    assert found.inertia == pytest.approx(1.5)
    assert found.enabled is not None
    assert found.enabled.sum() == 3


def test_data_frame_may_say_true_and_false():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame(
        {"time": [0, 1, 2], "position": [0, 0, 0], "voltage": [1, 1, 1], "enabled": [True, False, True]}
    )
    found = record_from_dataframe(frame, settings={"inertia": "0.02 kg m^2"})
    assert found.enabled is not None
    assert found.enabled.tolist() == [1.0, 0.0, 1.0]
    assert found.inertia == 0.02


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("0.02", "-1", "inertia must be positive, got -1"),
        ("0.02", "2 kg", "inertia is in 'kg', which is not a unit for it; give it in kg m\\^2"),
        ("0.02", "0.02\n# mass = 3 kg", "inertia and mass are given both; keep the one that the axis moves"),
        ("6.0,0\n", "6.0,2\n", r"enabled must be 0 \(motor off\) or 1 \(on\); sample 2 is 2"),
    ],
)
def test_wrong_inertia_and_enabled_are_refused(tmp_path, old, new, sentence):
    path = tmp_path / "run.csv"
    path.write_text(CSV.format(inertia="0.02").replace(old, new))
    with pytest.raises(InputError, match=f"run.csv: {sentence}"):
        read_record(path)


def test_enabled_is_held_between_samples_and_cut_with_the_record():
    one = record(enabled=(TIME < 0.1).astype(float), inertia=0.3)
    assert one.resample(0.03).enabled.tolist() == [1, 1, 1, 1] + [0] * 23
    assert one.slice(0.05, 0.15).enabled.sum() == 50
    assert one.slice(0.05, 0.15).inertia == 0.3


# --- moving inertia


def test_bare_axis_of_twice_the_inertia_has_half_of_gain_and_damping():
    plant = Plant(gain=GAIN, damping=DAMPING, inertia=0.02, free_damping=3.0)
    heavy = plant.for_record(record(inertia=0.04))
    assert (heavy.gain, heavy.damping, heavy.free_damping, heavy.inertia) == (GAIN / 2, DAMPING / 2, 1.5, 0.04)
    assert heavy.for_record(record(inertia=0.04)) is heavy
    assert heavy.for_record(record(inertia=0.02)) == plant
    assert plant.for_record(record()) is plant
    assert Plant(gain=GAIN, damping=DAMPING).for_record(record(inertia=0.04)).gain == GAIN


KNOWS_NO_MASS = (Actuator, TimeShift, Sensor)
"""Kinds of effects that act on the command or on what is seen."""
OTHERWISE = ("backlash", "end_stop")
"""Whose stiff contacts are given by the moving mass that they act on."""
FORCES = [name for name, cls in CATALOGUE.items() if not issubclass(cls, KNOWS_NO_MASS) and name not in OTHERWISE]


@pytest.mark.parametrize("name", FORCES)
def test_every_acceleration_is_divided_by_the_inertia(name):
    """At the same instant the same forces act, so push and level of friction are three times smaller."""
    plant = Plant(gain=GAIN, damping=DAMPING).with_effect(CATALOGUE[name](**CATALOGUE[name].typical))
    heavy = plant.scaled(1 / 3.0)
    d = dynamics(plant.structure)
    function = ca.Function("at", d.inputs, [d.push, d.level])
    rng = np.random.default_rng(5)
    for _ in range(20):
        position, velocity, command = rng.normal(scale=(0.05, 0.3, 4.0))
        states, lighter = rng.normal(scale=0.1, size=d.states.numel()), [1.0] * d.states.numel()
        if name == "presliding":
            lighter = [1 / 3.0]  # its state is a force per mass
        instant = (position, velocity, 0.1, command, np.sign(velocity))
        light = [float(value) for value in function(*instant, plant.values, states)]
        found = [float(value) for value in function(*instant, heavy.values, states * lighter)]
        np.testing.assert_allclose(found, np.array(light) / 3.0, rtol=1e-12, atol=1e-15)


def test_every_parameter_of_what_acts_on_the_mass_says_how_it_goes_with_it():
    specs = [spec for cls in CATALOGUE.values() if not issubclass(cls, KNOWS_NO_MASS) for spec in cls.parameters()]
    assert all(spec.per_mass in (0, 0.5, 1) for spec in specs)
    assert all(spec.per_mass == 1 for spec in specs if spec.unit == "{x}/s^2")


def test_coupling_keeps_its_spring_and_damper():
    coupling = FlexibleCoupling(frequency=12.0, damping_ratio=0.05, load_ratio=0.4)
    (heavy,) = Plant(gain=GAIN, damping=DAMPING, effects=(coupling,)).scaled(0.25).effects
    assert isinstance(heavy, FlexibleCoupling)
    assert heavy.values == pytest.approx((6.0, 0.025, 0.4))


def test_limits_that_are_none_stay_none_and_drives_keep_their_speed():
    plant = Plant(gain=1.0, damping=0.0, effects=(ForceLimit(acceleration=1e12), EndStop(low=-0.1, high=1e12)))
    assert plant.scaled(2.0).effects == plant.effects
    servo = SpeedServo(speed_per_volt=0.1, proportional=40.0, integral=200.0)
    assert Plant(gain=1.0, damping=0.0, effects=(servo,)).scaled(0.5).gain == pytest.approx(2.0)


def test_simulation_takes_the_inertia_of_the_record():
    parts = (CoulombFriction(level=0.8), Presliding(stiffness=900.0, level=0.4), ActuatorLag(time_constant=0.01))
    plant = Plant(gain=GAIN, damping=DAMPING, effects=parts, inertia=0.02)
    heavy = (CoulombFriction(level=0.5), Presliding(stiffness=562.5, level=0.25), ActuatorLag(time_constant=0.01))
    by_hand = Plant(gain=GAIN / 1.6, damping=DAMPING / 1.6, effects=heavy)
    expected = simulate_voltage(by_hand, TIME, PUSH).position
    np.testing.assert_allclose(simulate(plant, record(inertia=0.032)).position, expected, rtol=1e-9, atol=1e-12)
    assert np.ptp(expected) > 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Silent(Force):
    name = "silent"
    sentence = "A force that does not say how it goes with the mass."
    latex = "s"
    size: float = parameter("s", "{x}/s^2", "its size")

    @staticmethod
    def physics(axis: Any, p: Any) -> Any:
        return p.size


def test_effect_that_does_not_say_how_it_goes_with_the_mass_is_refused_for_another_inertia():
    plant = Plant(gain=GAIN, damping=DAMPING, effects=(Silent(size=1.0),), inertia=0.02)
    assert plant.for_record(record(inertia=0.02)) is plant
    with pytest.raises(InputError, match=r"silent does not say how size goes with the moving mass.*per_mass=1"):
        simulate(plant, record(inertia=0.03))


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_inertia_is_positive(wrong):
    with pytest.raises(InputError, match="inertia must be a finite number larger than 0"):
        Plant(gain=GAIN, damping=DAMPING, inertia=wrong)
    with pytest.raises(InputError, match="inertia must be positive"):
        record(inertia=wrong)
    with pytest.raises(InputError, match="a ratio of inertias must be positive"):
        Plant(gain=GAIN, damping=DAMPING).scaled(wrong)


def test_model_file_keeps_inertia_and_free_damping(tmp_path):
    plant = Plant(gain=GAIN, damping=DAMPING, inertia=0.02, free_damping=2.5)
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **Model(plant=plant).to_json()}, allow_nan=False))
    assert read_model(path).plant == plant
    assert "inertia" not in Model(plant=Plant(gain=GAIN, damping=DAMPING)).to_json()


def test_the_gain_s_unit_tells_the_command_s_unit_of_a_model_s_file(tmp_path):
    """A file by hand of an axis in amperes was refused, unless it knew of `command_unit`."""
    for command in ("A", "N m", "V"):
        unit = Plant(gain=2.0, damping=5.0, command_unit=command).unit("gain")
        (tmp_path / "model.json").write_text(
            json.dumps({"schema": "servolens.model/1", "gain": {"value": 2.0, "unit": unit}, "damping": {"value": 5.0}})
        )
        assert read_model(tmp_path / "model.json").plant.command_unit == command


# --- motor off


@pytest.mark.parametrize("free", [None, 2.5])
def test_axis_whose_motor_is_off_runs_free(free):
    enabled = (TIME < 0.25).astype(float)
    run = simulate(Plant(gain=GAIN, damping=DAMPING, free_damping=free), record(enabled=enabled))
    off, c = 250, DAMPING if free is None else free
    gone = np.exp(-c * (TIME[off:] - TIME[off]))
    np.testing.assert_allclose(run.velocity[off:], run.velocity[off] * gone, rtol=0, atol=1e-8)
    on = simulate_voltage(Plant(gain=GAIN, damping=DAMPING), TIME, PUSH)
    np.testing.assert_allclose(run.position[: off + 1], on.position[: off + 1], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(run.voltage, PUSH)


def test_motor_goes_off_and_on_beside_friction_and_a_lag_as_an_independent_integration_says():
    enabled = ((TIME < 0.05) | ((TIME >= 0.1) & (TIME < 0.2)) | (TIME >= 0.26)).astype(float)
    lag, level, free = 0.02, 0.5, 2.0
    parts = (ActuatorLag(time_constant=lag), CoulombFriction(level=level))
    plant = Plant(gain=GAIN, damping=DAMPING, effects=parts, free_damping=free)
    run = simulate(plant, record(voltage=np.full(TIME.size, 4.0), enabled=enabled, voltage_before=0.0))
    state, expected = np.array([0.0, 0.0, 0.0]), [0.0]
    for k in range(TIME.size - 1):

        def motion(_: float, x: np.ndarray, on: bool = bool(enabled[k])) -> list[float]:
            motor = GAIN * x[2] - DAMPING * x[1] if on else -free * x[1]
            moving = x[1] > 0 or motor > level
            return [x[1], motor - level if moving else 0.0, (4.0 - x[2]) / lag]

        state = solve_ivp(motion, (TIME[k], TIME[k + 1]), state, rtol=1e-10, atol=1e-13, max_step=2e-4).y[:, -1]
        expected.append(state[0])
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=1e-6)


def test_closed_loop_goes_on_asking_while_the_motor_is_off():
    enabled = (TIME >= 0.2).astype(float)
    loop = Controller(kp=60.0, kd=1.0)
    run = simulate(
        Plant(gain=GAIN, damping=DAMPING),
        record(reference=0 * TIME + 0.1, controller=loop, enabled=enabled, voltage=None),
    )
    assert np.all(run.position[:201] == 0.0)
    np.testing.assert_allclose(run.voltage[:201], 6.0)
    later = simulate(
        Plant(gain=GAIN, damping=DAMPING),
        Record(time=TIME[:601], position=0 * TIME[:601], reference=0 * TIME[:601] + 0.1, controller=loop),
    )
    np.testing.assert_allclose(run.position[200:], later.position, rtol=0, atol=1e-9)


def test_drive_with_a_speed_loop_does_not_brake_while_it_is_off():
    servo = SpeedServo(speed_per_volt=0.1, proportional=40.0, integral=0.0)
    plant = Plant(gain=4.0, damping=0.0, effects=(servo,), free_damping=0.5)
    run = simulate(plant, record(voltage=np.full(TIME.size, 2.0), enabled=(TIME < 0.4).astype(float)))
    assert run.velocity[400] == pytest.approx(0.2, rel=1e-5)
    assert run.velocity[-1] == pytest.approx(run.velocity[400] * np.exp(-0.5 * 0.4), rel=1e-6)


def logged_free(truth: Plant, noise: float) -> Record:
    """Return a run of `truth` whose motor is switched off twice while it moves."""
    time = 1e-3 * np.arange(2000.0)
    asked = Record(
        name="off",
        time=time,
        position=0.0 * time,
        reference=np.where((time >= 0.1) & (time < 1.0), 0.1, 0.0),
        controller=Controller(kp=60.0, kd=1.0),
        enabled=((time < 0.16) | ((time >= 0.4) & (time < 1.06)) | (time >= 1.4)).astype(float),
    )
    run = simulate(truth, asked)
    measured = run.position + np.random.default_rng(5).normal(0.0, noise, time.size)
    return asked.with_({"position": measured, "voltage": run.voltage})


@pytest.mark.parametrize("effects", [(), (CoulombFriction(level=0.2),)], ids=["alone", "with friction"])
def test_the_damping_that_is_left_while_the_motor_is_off_is_identified(effects):
    """Back-EMF, which is gone then, was named as a drive with a speed loop of its own."""
    truth = Plant(gain=GAIN, damping=DAMPING, effects=effects, free_damping=1.5)
    record = logged_free(truth, 5e-6)
    found = fit(effects, record)
    for name, true in truth.named.items():
        quantity = found.model.quantities[name]
        assert abs(quantity.value - true) < 4.0 * quantity.stderr < 0.02 * true
    told = diagnose([record])
    assert told.verdict == ("explained" if effects else "healthy")
    assert [cause.effect for cause in told.causes] == [effect.name for effect in effects]
    assert told.plant.free_damping == pytest.approx(1.5, rel=0.01)


def test_free_damping_is_no_unknown_where_the_axis_does_not_move_while_the_motor_is_off():
    truth = Plant(gain=GAIN, damping=DAMPING)
    record = logged_free(truth, 5e-6)
    resting = record.with_({"enabled": (record.time >= 0.1).astype(float)})
    assert fit((), resting).plant.free_damping is None
    stated = fit(Plant(gain=2.0, damping=5.0, free_damping=3.0), resting)
    assert stated.plant.free_damping == 3.0
    assert stated.model.quantities["free_damping"].stderr is None


def test_a_model_s_file_keeps_the_error_of_the_free_damping_and_of_what_else_it_is_correlated_with(tmp_path):
    found = fit((), logged_free(Plant(gain=GAIN, damping=DAMPING, free_damping=1.5), 5e-6)).model
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **found.to_json()}, allow_nan=False))
    again = read_model(path)
    assert again.quantities == found.quantities
    np.testing.assert_array_equal(again.covariance, found.covariance)


@pytest.mark.parametrize(
    "priors", [{"gain": (GAIN, 1e-5)}, {"damping": (DAMPING, 1e-5)}, {}], ids=["gain", "damping", "none"]
)
def test_a_prior_moves_the_free_damping_as_well(priors, tmp_path):
    """Its covariance with gain and damping stayed as it was without the prior: that was none, and its file refused."""
    record = logged_free(Plant(gain=GAIN, damping=DAMPING, free_damping=1.5), 5e-6)
    found = identify(record, model="constant", priors=priors).constant
    assert np.linalg.eigvalsh(found.covariance).min() >= 0.0
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **found.to_json()}, allow_nan=False))
    assert read_model(path).quantities == found.quantities
    quantity = found.quantities["free_damping"]
    assert abs(quantity.value - 1.5) < 4.0 * quantity.stderr


def test_a_model_s_file_whose_free_damping_is_a_number_is_read(tmp_path):
    """As files had it while it was never estimated: their covariance does not name it."""
    old = Model(plant=Plant(gain=GAIN, damping=DAMPING), covariance=np.diag([1e-4, 1e-2])).to_json()
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"schema": "servolens.model/1", **old, "free_damping": 2.5}, allow_nan=False))
    again = read_model(path)
    assert again.plant.free_damping == 2.5
    assert again.quantities["gain"].stderr == pytest.approx(1e-2)
    assert again.quantities["free_damping"].stderr is None


@pytest.fixture(scope="module")
def switched() -> Record:
    return logged_free(Plant(gain=GAIN, damping=DAMPING, free_damping=1.5), 5e-6)


@pytest.mark.parametrize("name", ["constant", "velocity"])
def test_identify_takes_a_value_or_bounds_of_the_free_damping(name, switched):
    """It said that this was no parameter of the model."""
    fixed = getattr(identify(switched, model=name, fixed={"free_damping": 1.4}), name)
    assert fixed.quantities["free_damping"].value == 1.4
    assert fixed.quantities["free_damping"].reason == "given, not estimated"
    bounded = getattr(identify(switched, model=name, bounds={"free_damping": (1.6, None)}), name)
    assert bounded.quantities["free_damping"].value == pytest.approx(1.6)
    assert bounded.quantities["free_damping"].reason == "it ended at the end of its range"


@pytest.mark.parametrize("name", ["constant", "velocity"])
def test_identify_combines_a_prior_on_the_free_damping_with_the_records(name, switched):
    alone = getattr(identify(switched, model=name), name).quantities["free_damping"]
    prior = (alone.value + alone.stderr, alone.stderr)
    both = getattr(identify(switched, model=name, priors={"free_damping": prior}), name).quantities["free_damping"]
    assert both.value == pytest.approx(alone.value + 0.5 * alone.stderr, abs=0.1 * alone.stderr)
    assert both.stderr == pytest.approx(alone.stderr / np.sqrt(2.0), rel=0.1)


def test_free_damping_is_found_beside_a_known_gain_and_damping(switched):
    found = identify(switched, model="constant", fixed={"gain": GAIN, "damping": DAMPING}).constant
    quantity = found.quantities["free_damping"]
    assert abs(quantity.value - 1.5) < 4.0 * quantity.stderr < 0.01


def test_prior_on_the_free_damping_that_the_records_contradict_is_named(switched):
    priors = {"free_damping": (3.0, 0.1)}
    for told in (identify(switched, model="constant", priors=priors), diagnose([switched], priors=priors)):
        said = [finding.message for finding in told.findings if finding.code == "prior_contradicts_data"]
        assert len(said) == 1
        assert said[0].startswith("the prior on free_damping, 3 ± 0.1, contradicts the records")


def test_diagnose_takes_a_prior_on_the_free_damping(switched):
    found = diagnose([switched], priors={"free_damping": (1.5, 1e-5)})
    quantity = found.model.quantities["free_damping"]
    assert quantity.value == pytest.approx(1.5, abs=3e-5)
    assert quantity.stderr < 1e-5


@pytest.mark.parametrize(
    "asked",
    [
        lambda record, known: identify(record, priors=known),
        lambda record, known: identify(record, fixed={"free_damping": 1.5}),
        lambda record, known: diagnose([record], priors=known),
        lambda record, known: fit((), record, priors=known),
    ],
    ids=["identify, prior", "identify, fixed", "diagnose", "fit"],
)
def test_nothing_is_asked_of_the_free_damping_where_the_axis_does_not_move_while_the_motor_is_off(asked, switched):
    resting = switched.with_({"enabled": (switched.time >= 0.1).astype(float)})
    sentence = "free_damping is the damping while the motor is off, and in none of the records .* leave it out, or add"
    with pytest.raises(InputError, match=sentence):
        asked(resting, {"free_damping": (1.5, 0.1)})


def test_free_damping_at_its_bound_and_beside_a_wrong_model_says_why_it_has_no_error():
    """It was said to be given, though it was estimated."""
    none = logged_free(Plant(gain=GAIN, damping=DAMPING, free_damping=0.0), 5e-6)
    found = identify(none, model="constant", bounds={"free_damping": (0.1, None)}).constant
    assert found.quantities["free_damping"].reason == "it ended at the end of its range"
    rubbing = Plant(gain=GAIN, damping=DAMPING, effects=(CoulombFriction(level=0.5),), free_damping=1.5)
    found = identify(logged_free(rubbing, 5e-6), model="constant").constant
    assert found.quantities["free_damping"].stderr is None
    assert found.quantities["free_damping"].reason == (
        "this model does not explain the records to noise level, so its error is not known"
    )


def test_a_sensor_that_drifts_while_the_motor_is_off_does_not_determine_the_free_damping():
    """It was 4.9 ± 6.3, and `identify` said nothing of it."""
    time = 1e-3 * np.arange(3900.0)
    asked = Record(
        name="off",
        time=time,
        position=0.0 * time,
        reference=np.where(time >= 0.1, 0.1, 0.0),
        controller=Controller(kp=60.0, kd=1.0),
        enabled=(time < 3.0).astype(float),
    )
    run = simulate(Plant(gain=GAIN, damping=DAMPING, free_damping=1.5), asked)
    noise = np.random.default_rng(5).normal(0.0, 5e-6, time.size) + 1e-4 * np.maximum(time - 3.0, 0.0)
    record = asked.with_({"position": run.position + noise, "voltage": run.voltage})
    sentence = "the data do not determine free_damping: the axis hardly moves while its motor is off."
    found = identify(record, model="constant")
    for told in (found, fit((), record), diagnose([record])):
        quantity = told.model.quantities["free_damping"]
        assert (quantity.stderr, quantity.reason) == (None, "the data do not determine it")
        said = [finding.message for finding in told.findings if "free_damping" in finding.message]
        assert said == [sentence]
        assert told.model.quantities["damping"].stderr < 0.01


def test_held_out_record_whose_free_damping_no_fitted_record_shows_is_said_to_be_simulated_without(switched, tmp_path):
    """So is it where a model's file predicts it."""
    truth = Plant(gain=GAIN, damping=DAMPING, free_damping=1.5)
    driven = logged_free(truth, 5e-6)
    on = Record(
        name="on", time=driven.time, position=driven.position, reference=driven.reference, controller=driven.controller
    )
    run = simulate(truth, on)
    noise = np.random.default_rng(6).normal(0.0, 5e-6, on.time.size)
    on = on.with_({"position": run.position + noise, "voltage": run.voltage})
    told = diagnose([on], heldout=[switched])
    said = [finding for finding in told.findings if finding.code == "free_damping_assumed"]
    assert [finding.record for finding in said] == ["off"]
    assert "simulated with the damping that it has with the motor on" in said[0].message
    path, out = tmp_path / "off.csv", tmp_path / "told.json"
    switched.to_csv(path)
    for plant, count in ((truth, 0), (replace(truth, free_damping=None), 1)):
        write_json(str(tmp_path / "model.json"), "model", Model(plant=plant).to_json())
        done = CliRunner().invoke(group, ["predict", str(tmp_path / "model.json"), str(path), "--json", str(out)])
        assert done.exit_code == 0
        codes = [finding["code"] for finding in json.loads(out.read_text())["findings"]]
        assert codes.count("free_damping_assumed") == count


def test_design_and_bridge_are_of_an_axis_whose_motor_is_on():
    """They know no other: the free damping stays with the model and changes nothing."""
    free = Plant(gain=GAIN, damping=DAMPING, free_damping=1.5)
    spec = PDSpec(kp=60, settling_time=0.6)
    assert tune(free, spec).kd == tune(replace(free, free_damping=None), spec).kd
    assert dict(to_control(free).params) == {"gain": GAIN, "damping": DAMPING}


def test_plant_in_a_record_can_be_made_twice_and_is_the_plant_itself_where_nothing_differs():
    plant = Plant(gain=GAIN, damping=DAMPING, inertia=0.02)
    assert plant_in(plant, record()) is plant
    hard = record(inertia=0.05, voltage_limit=3.0, enabled=(TIME < 0.4).astype(float))
    once = plant_in(plant, hard)
    assert plant_in(once, hard) == once
    assert [effect.name for effect in once.effects] == ["saturation", "motor_off"]


def test_motor_that_goes_off_all_the_time_is_refused():
    flicker = (np.arange(TIME.size) % 4 < 2).astype(float)
    with pytest.raises(InputError, match="the motor goes off 200 times; a simulation allows 50, cut the record"):
        simulate(Plant(gain=GAIN, damping=DAMPING), record(enabled=flicker))
