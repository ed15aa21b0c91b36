"""What a check says of a loop that is not the stated one: settings, signs, units, limits; in several worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, lab, predict, read_record
from servolens.checking import check
from servolens.control_law import controller_voltage
from servolens.effects import ConstantForce
from servolens.identification import fit
from servolens.inputs import as_records
from servolens.quality import fatal
from servolens.record import Controller, Record
from servolens.study.spec import completed_spec

RUBBING = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.5}})
WORLDS = ("white", "coloured", "coarse", "hum")


def logged(world, *, stated=None, levels=(0.1, 0.02, 0.07), rounding=0.0, limit=None, **true):
    """Steps of a rubbing axis in a world; `stated` is what the log says of the loop, beside kp = 60 and kd = 4."""
    loop = {"kp": 60.0, "kd": 4.0}
    rig = lab.Setup(
        controller=Controller(**{**loop, **true}), surroundings=lab.surroundings(world, seed=1), voltage_limit=limit
    )
    record = lab.step_record(RUBBING, seed=2, reference=levels, duration=0.6, setup=rig)
    voltage = np.round(record.voltage / rounding) * rounding if rounding else record.voltage
    return record.with_({"voltage": voltage, "controller": Controller(**{**loop, **(stated or {})})})


def told(record):
    return {finding.code: finding.message for finding in check(record) if finding.severity != "note"}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("rounding", [0.0, 0.01, 0.02, 0.1])
def test_loop_as_stated_raises_nothing(world, rounding):
    assert told(logged(world, rounding=rounding, ki=40.0, derivative_filter=0.3, setpoint_weight=0.7,
                       stated={"ki": 40.0, "derivative_filter": 0.3, "setpoint_weight": 0.7})) == {}  # fmt: skip


CASES = {
    "integral larger": ({"ki": 40.0}, {"ki": 20.0}, "ki = 40 V/(m s), not 20 "),
    "integral unstated": ({"ki": 40.0}, {}, "ki = 40 V/(m s), not 0 "),
    "integral that is none": ({}, {"ki": 40.0}, "ki = 0 V/(m s), not 40 "),
    "filter and integral": (
        {"derivative_filter": 0.3, "ki": 40.0},
        {},
        "derivative_filter = 0.3, ki = 40 V/(m s), not 1, 0 ",
    ),
    "set-point weight": ({"setpoint_weight": 0.5}, {}, "setpoint_weight = 0.5, not 1 "),
    "I-PD": ({"setpoint_weight": 0.0, "ki": 400.0}, {"ki": 400.0}, "setpoint_weight = 0, not 1 "),
    "period and integral": (
        {"control_period": 0.004, "ki": 40.0},
        {},
        "control_period = 0.004 s, ki = 40 V/(m s), not every sample, 0 ",
    ),
    "on error, filtered": (
        {"derivative_on": "error", "derivative_filter": 0.2},
        {},
        "derivative_on = error, derivative_filter = 0.2, not measurement, 1 ",
    ),
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("case", CASES)
def test_settings_are_named_with_their_values(world, case):
    true, stated, said = CASES[case]
    found = told(logged(world, stated=stated, **true))
    assert list(found) == ["settings_contradict_log"]
    assert found["settings_contradict_log"].startswith(f"the log fits {said}")


@pytest.mark.parametrize("world", ["coloured", "coarse"])
def test_settings_are_named_through_a_rounded_voltage(world):
    found = told(logged(world, rounding=0.01, derivative_filter=0.3, ki=40.0))
    assert "ki = 40 V/(m s), not 1, 0 " in found["settings_contradict_log"]


@pytest.mark.parametrize("levels", [(0.1,), (0.0, 0.1), (0.1, 0.02, 0.07)], ids=["one", "rest", "three"])
@pytest.mark.parametrize("column", ["reference", "position", "voltage"])
def test_wrong_sign_of_any_column_is_fatal(column, levels):
    record = logged("coloured", levels=levels)
    mirrored = record.with_({column: -getattr(record, column)})
    (finding,) = fatal(check(mirrored))
    assert finding.code == "wrong_sign"
    assert column in finding.message


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("rounding", [0.0, 0.02])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("stated", [True, False])
def test_a_command_that_was_logged_without_its_sign_is_fatal(world, rounding, sign, stated):
    """Duty and direction are often two columns."""
    record = logged(world, levels=(0.1, 0.02, 0.07), rounding=rounding)
    unsigned = record.with_({"voltage": sign * np.abs(record.voltage)})
    (finding,) = fatal(check(unsigned if stated else unsigned.with_({"controller": None})))
    assert finding.code == "unsigned_voltage"


def test_magnitude_of_a_command_with_feedforward_is_one():
    record = logged("white", levels=(0.1, 0.02, 0.07))
    added = 0.5 * np.sin(20.0 * record.time)
    unsigned = record.with_({"voltage": np.abs(record.voltage + added), "feedforward": added})
    assert [finding.code for finding in fatal(check(unsigned))] == ["unsigned_voltage"]


def test_command_of_one_sign_is_no_magnitude():
    """A weight is held with it."""
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 30.0}})
    rig = lab.Setup(controller=Controller(kp=60.0, kd=4.0, integral_before=30.0 / 1.9))
    record = lab.step_record(truth, seed=2, reference=(0.05, 0.1), duration=0.6, noise=1e-5, setup=rig)
    assert record.voltage.min() > 0.0
    assert fatal(check(record)) == ()
    assert fatal(check(record.with_({"controller": Controller(kp=60.0, kd=4.0)}))) == ()


@pytest.mark.parametrize("levels", [(0.1,), (0.1, 0.02, 0.07)], ids=["one", "three"])
@pytest.mark.parametrize("column", ["reference", "position"])
@pytest.mark.parametrize(("factor", "said"), [(180 / np.pi, "in degrees"), (1e3, "in thousandths")])
def test_wrong_unit_of_a_column_is_fatal(column, levels, factor, said):
    record = logged("coarse", levels=levels)
    other = record.with_({column: factor * getattr(record, column)})
    (finding,) = fatal(check(other))
    assert finding.code == "units_contradict"
    assert f"the {column} is {said}" in finding.message


@pytest.mark.parametrize("level", [0.5, 3.0], ids=["little friction", "much friction"])
@pytest.mark.parametrize("kd", [0.0, 4.0])
def test_degrees_are_told_without_a_voltage_and_before_the_axis_rests(level, kd):
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": level}})
    record = lab.step_record(truth, 60, kd, noise=1e-5, seed=3, duration=0.8)
    assert fatal(check(record.with_({"voltage": None}))) == ()
    (finding,) = fatal(check(record.with_({"voltage": None, "position": np.degrees(record.position)})))
    assert "in degrees where radians are meant" in finding.message


@pytest.mark.parametrize("world", WORLDS)
def test_plateau_below_the_stated_limit_is_said(world):
    record = logged(world)
    clipped = record.with_({"voltage": np.clip(record.voltage, -3.0, 3.0)})
    assert told(clipped.with_({"voltage_limit": 3.0})) == {}
    found = told(clipped.with_({"voltage_limit": 10.0}))
    assert list(found) == ["clipped_voltage"]
    assert "stays at -3 and 3 V" in found["clipped_voltage"]
    assert "whatever the stated limit of 10 V; state voltage_limit = 3 V" in found["clipped_voltage"]


CLAMPED = {"ki": 400.0, "anti_windup": "clamping"}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({**CLAMPED, "ki": 200.0}, "ki = 400 V/(m s), not 200 "),
        ({"ki": 400.0}, "anti_windup = clamping, not none "),
        ({}, "anti_windup = clamping, ki = 400 V/(m s), not none, 0 "),
    ],
    ids=["size", "anti-windup", "all of it"],
)
def test_clamped_integral_is_named_with_its_size(world, stated, said):
    assert told(logged(world, limit=3.0, stated=CLAMPED, **CLAMPED)) == {}
    found = told(logged(world, limit=3.0, stated=stated, **CLAMPED))
    assert found["settings_contradict_log"].startswith(f"the log fits {said}")


@pytest.mark.parametrize("levels", [(0.1,), (0.0, 0.1), (0.1, 0.02, 0.07)], ids=["one", "rest", "three"])
@pytest.mark.parametrize(
    ("columns", "code", "said"),
    [
        ({}, None, ""),
        ({"reference": -1.0}, "wrong_sign", "the axis moves -1"),
        ({"position": -1.0}, "wrong_sign", "the axis moves -1"),
        ({"reference": 180.0 / np.pi}, "units_contradict", "the axis moves 0.017"),
        ({"position": 180.0 / np.pi}, "units_contradict", "the axis moves 57."),
    ],
    ids=["as it is", "reference", "position", "reference in degrees", "position in degrees"],
)
def test_axis_that_swings_about_another_place_than_its_reference_is_told_without_a_voltage(columns, code, said, levels):
    axis = lab.Truth(gain=1.9, damping=3.0, effects={"coulomb_friction": {"level": 0.1}})
    record = lab.step_record(axis, kp=60, noise=1e-5, seed=1, reference=levels, duration=0.8)
    assert np.ptp(record.position[-200:]) > 0.2 * abs(record.reference[-1] - record.reference[0] or 0.1)  # swings yet
    changed = {name: factor * getattr(record, name) for name, factor in columns.items()}
    found = told(record.with_({"voltage": None, **changed}))
    assert {"wrong_sign", "units_contradict"} & set(found) == ({code} if code else set())
    if code:
        assert found[code].startswith(said)


@pytest.mark.parametrize("limit", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("reference", [(0.1,), (0.0, 0.1)])
def test_axis_at_its_voltage_limit_is_in_no_other_unit(limit, reference):
    axis = lab.Truth(gain=1.9, damping=3.0, effects={"saturation": {"limit": limit}})
    for duration in (0.3, 0.5, 0.8):
        record = lab.step_record(axis, kp=60, noise=1e-5, seed=1, reference=reference, duration=duration)
        assert not {"wrong_sign", "units_contradict"} & set(told(record.with_({"voltage": None})))


@pytest.mark.parametrize("step", [1e-4, 1e-3])
def test_a_position_that_was_rounded_when_it_was_written_contradicts_no_stated_gain(step):
    """The rounding does what another filter or other gains would: neither has anything to be corrected."""
    run = lab.step_record(lab.LM1, 60, 0.5, noise=1e-5, encoder=0, seed=1)
    rounded = replace(run, position=step * np.round(run.position / step), voltage=np.round(run.voltage, 3))
    assert {finding.code for finding in check(rounded) if finding.severity != "note"} <= {"coarse_quantisation"}


def test_wrong_gains_beside_a_coarse_encoder_are_told():
    run = lab.step_record(lab.LM1, 60, 0.5, noise=1e-5, encoder=1e-4, seed=1)
    stated = replace(run, controller=replace(run.controller, kd=0.4))
    assert "gains_contradict_log" in {finding.code for finding in check(stated)}


def own_loop(stamps, *, share=1.0, on="measurement", kp=100.0, kd=3.0, by_interval=True, seed=1):
    """Return the log of a loop that reads the clock at each sample and divides by what has passed, or by its cycle.

    The axis has gain 1.9 and damping 6, of which every step is exact.
    """
    rng = np.random.default_rng(seed)
    time = stamps(rng)
    reference = np.where(time > 0.1, 0.1, 0.0)
    position, voltage = np.zeros(time.size), np.zeros(time.size)
    y = v = u = slope = 0.0
    for k in range(time.size):
        if k:
            passed = time[k] - time[k - 1]
            decay, settled = np.exp(-6.0 * passed), 1.9 * u / 6.0
            y += settled * passed + (v - settled) * (1.0 - decay) / 6.0
            v = settled + (v - settled) * decay
        position[k] = y + 1e-5 * rng.standard_normal()
        if k:
            moved = position[k] - position[k - 1]
            moved -= reference[k] - reference[k - 1] if on == "error" else 0.0
            slope += share * (moved / (passed if by_interval else CYCLE) - slope)
        u = voltage[k] = kp * (reference[k] - position[k]) - kd * slope
    stated = Controller(kp=kp, kd=kd, derivative_on=on)
    return Record(time=time, position=position, voltage=voltage, reference=reference, controller=stated)


CYCLE = 5e-3


def late(rng):
    return CYCLE * (np.arange(400) + np.concatenate(([0.0], rng.uniform(-0.25, 0.25, 399))))


def wandering(rng):
    return CYCLE * np.concatenate(([0.0], np.cumsum(rng.uniform(0.6, 1.4, 399))))


@pytest.mark.parametrize("stamps", [late, wandering])
@pytest.mark.parametrize("on", ["measurement", "error"])
def test_loop_that_divides_by_measured_intervals_is_no_contradiction(stamps, on):
    found = {finding.code: finding for finding in check(own_loop(stamps, on=on))}
    assert set(found) == {"jitter", "measured_intervals"}
    assert found["measured_intervals"].severity == "note"


@pytest.mark.parametrize("on", ["measurement", "error"])
def test_loop_that_divides_by_its_cycle_is_none_either_where_stamps_are_late(on):
    assert set(told(own_loop(late, on=on, by_interval=False))) == {"jitter"}


def test_filter_of_measured_intervals_is_named():
    found = told(own_loop(late, share=0.3))
    assert set(found) == {"jitter", "settings_contradict_log"}
    assert "derivative_filter = 0.3, not 1 " in found["settings_contradict_log"]


@pytest.mark.parametrize("seed", range(3))
def test_loop_with_late_stamps_is_simulated_as_it_ran(seed):
    record = own_loop(late, by_interval=False, seed=seed)
    assert record.sample_time == pytest.approx(CYCLE, rel=1e-3)
    ((error,),) = predict(Plant(gain=1.9, damping=6.0), record).errors
    assert error.rms_error < 2e-5  # the sensor's noise is half of that, and the loop answers to it


@pytest.mark.parametrize("stamps", [late, wandering])
@pytest.mark.parametrize("on", ["measurement", "error"])
def test_loop_that_divides_by_measured_intervals_is_simulated_so(stamps, on):
    (record,) = as_records(own_loop(stamps, on=on))
    assert record.controller.time_step == "measured"
    assert record.voltage == pytest.approx(controller_voltage(record), abs=1e-9)
    ((error,),) = predict(Plant(gain=1.9, damping=6.0), own_loop(stamps, on=on)).errors
    assert error.rms_error < 2e-5  # the sensor's noise is half of that, and the loop answers to it
    by_cycle = own_loop(stamps, on=on, by_interval=False)
    assert as_records(by_cycle)[0].controller.time_step == "cycle"


MEASURING = {
    "window": Controller(kp=60, kd=3, derivative_window=3, derivative_filter=0.5, time_step="measured"),
    "pid": Controller(kp=60, kd=3, ki=200, velocity_feedforward=1, time_step="measured"),
    "clamped": Controller(kp=200, kd=3, ki=200, anti_windup="clamping", time_step="measured"),
    "pulled": Controller(kp=200, kd=3, ki=200, anti_windup="back_calculation", time_step="measured"),
    "cascade": Controller.cascade(kp=20, kv=4, kiv=20, time_step="measured"),
}


@pytest.mark.parametrize("law", MEASURING)
def test_laws_with_measured_time_steps_are_those_of_the_bench(law):
    around = lab.Surroundings(encoder=0.0, jitter=lab.Jitter(share=0.15))
    rig = lab.Setup(controller=MEASURING[law], surroundings=around, voltage_limit=12.0)
    run = lab.step_record(
        lab.Truth(gain=1.9, damping=6.0), sample_time=5e-3, reference=(0.1, 0.02), duration=0.6, seed=4, setup=rig
    )
    assert controller_voltage(run) == pytest.approx(
        run.voltage, abs=1e-4
    )  # the first step is the cycle, of which a log knows the median
    ((error,),) = predict(Plant(gain=1.9, damping=6.0), run).errors
    by_cycle = run.with_({"controller": replace(MEASURING[law], time_step="cycle"), "voltage": None})
    ((wrong,),) = predict(Plant(gain=1.9, damping=6.0), by_cycle).errors
    assert error.rms_error < 1e-6
    assert wrong.rms_error > 100 * error.rms_error


def bench_run(controller, *, jitter=0.15, seed=4):
    around = lab.Surroundings(encoder=0.0, jitter=lab.Jitter(share=jitter) if jitter else None)
    rig = lab.Setup(controller=controller, surroundings=around)
    pushed = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 5.0}})
    return lab.step_record(pushed, sample_time=5e-3, reference=(0.1, 0.02), duration=0.6, seed=seed, setup=rig)


def stated_as(record, **settings):
    return record.with_({"controller": replace(record.controller, **settings)})


@pytest.mark.parametrize(
    "law", [Controller(kp=60, kd=3, ki=400), Controller.cascade(kp=20, kv=4, kiv=40)], ids=["pid", "cascade"]
)
def test_lost_samples_of_an_even_clock_are_no_measured_time_steps(law):
    whole = bench_run(law, jitter=0.0)
    kept = np.delete(np.arange(len(whole)), [90, 91, 92])
    names = ("time", "position", "reference", "voltage")
    record = Record(**{name: getattr(whole, name)[kept] for name in names}, controller=law)
    assert as_records(record)[0].controller.time_step == "cycle"
    assert set(told(record)) == {"gaps"}


def test_measured_time_steps_that_noise_of_the_voltage_hides_are_to_be_stated():
    record = bench_run(Controller(kp=60, kd=3, time_step="measured"))
    noisy = record.voltage + 0.01 * np.random.default_rng(1).normal(scale=np.std(record.voltage), size=len(record))
    found = told(stated_as(record.with_({"voltage": noisy}), time_step="cycle"))
    assert "the log fits time_step = measured, not cycle " in found["settings_contradict_log"]


def test_measured_time_steps_that_the_log_contradicts_are_named():
    found = told(stated_as(bench_run(Controller(kp=60, kd=3)), time_step="measured"))
    assert "the log fits time_step = cycle, not measured " in found["settings_contradict_log"]
    assert "measured_intervals" not in found


def test_wrong_integral_gain_of_a_loop_with_measured_time_steps_is_named_alone():
    record = bench_run(Controller(kp=60, kd=3, ki=400, time_step="measured"))
    found = told(stated_as(record, ki=380.0))["settings_contradict_log"]
    assert "the log fits ki = 400 V/(m s), " in found
    assert "kp" not in found
    assert "kd" not in found


def test_stated_period_that_the_log_contradicts_is_no_wrong_unit_of_time():
    record = logged("white", kd=0.0, stated={"kd": 0.0, "control_period": 0.005})
    assert not fatal(check(record))
    assert told(record)["settings_contradict_log"].startswith("the log fits control_period = every sample, not 0.005 (")


def test_gains_of_a_cascade_are_told_as_they_are_stated():
    drive = Controller.cascade(kp=20.0, kv=5.0, kiv=60.0)
    record = lab.step_record(RUBBING, seed=2, duration=0.6, setup=lab.Setup(controller=drive))
    found = told(record.with_({"controller": Controller.cascade(kp=26.0, kv=5.0, kiv=60.0)}))
    assert "kp = 20 1/s, kv = 5 V s/m, not kp = 26 1/s, kv = 5 V s/m; " in found["gains_contradict_log"]


RAMP = np.interp(np.arange(600) * 1e-3, [0.05, 0.3], [0.0, 0.1])
OF_CASCADES = {
    "integral unstated": ({"kiv": 60.0}, {}, "kiv = 60 V/m, not 0 ("),
    "integral larger": ({"kiv": 60.0}, {"kiv": 90.0}, "kiv = 60 V/m, not 90 ("),
    "velocity unstated": ({"feedforward_speed": 0.7}, {}, "feedforward_speed = 0.7, not 0 ("),
    "velocity beside an integral": (
        {"kiv": 60.0, "feedforward_speed": 1.0},
        {"kiv": 60.0},
        "feedforward_speed = 1, not 0 (",
    ),
}


@pytest.mark.parametrize(("true", "stated", "said"), OF_CASCADES.values(), ids=OF_CASCADES)
def test_settings_of_a_cascade_are_told_by_their_names(true, stated, said):
    loop, claimed = (Controller.cascade(kp=20.0, kv=5.0, **own) for own in (true, stated))
    record = lab.step_record(RUBBING, seed=2, setup=lab.Setup(controller=loop, trajectory=RAMP))
    found = told(record.with_({"controller": claimed}))
    assert list(found) == ["settings_contradict_log"]
    assert found["settings_contradict_log"].startswith(f"the log fits {said}")


@pytest.mark.parametrize(
    ("true", "stated", "said"),
    [
        ({"kd": 0.0}, {"velocity_feedforward": 0.0}, "velocity_feedforward = 3 V s/m, not 0 ("),
        ({"kd": 4.0}, {"velocity_feedforward": 0.0}, "velocity_feedforward = 3 V s/m, not 0 ("),
        ({"kd": 4.0, "ki": 100.0}, {"ki": 0.0}, "ki = 100 V/(m s), not 0 ("),
    ],
)
def test_feedforward_makes_a_pd_or_pid_law_no_cascade(true, stated, said):
    loop = Controller(kp=60.0, velocity_feedforward=3.0, **true)
    record = lab.step_record(RUBBING, seed=2, setup=lab.Setup(controller=loop, trajectory=RAMP))
    found = told(record.with_({"controller": replace(loop, **stated)}))
    assert found["settings_contradict_log"].startswith(f"the log fits {said}")


def test_a_cascade_without_an_integral_is_told_and_designed_as_one(tmp_path):
    drive = Controller.cascade(kp=20.0, kv=5.0)
    record = lab.step_record(RUBBING, seed=2, duration=0.6, setup=lab.Setup(controller=drive))
    record.to_csv(tmp_path / "drive.csv")
    assert "# kv = 5.0 V s/m\n" in (tmp_path / "drive.csv").read_text()
    assert read_record(tmp_path / "drive.csv").controller == drive
    spec = completed_spec([record], {"settling_time": 0.5})
    assert (spec.controller, spec.kp, spec.kiv) == ("cascade", 20.0, 0.0)
    found = told(record.with_({"controller": Controller.cascade(kp=20.0, kv=6.0)}))
    assert "fits kp = 20 1/s, kv = 5 V s/m, not kp = 20 1/s, kv = 6 V s/m; " in found["gains_contradict_log"]


def test_a_setting_that_is_the_stated_one_as_it_is_written_contradicts_nothing():
    assert told(logged("white", setpoint_weight=1.0004)) == {}
    (message,) = told(logged("white", setpoint_weight=1.0004, derivative_filter=0.3)).values()
    assert "the log fits derivative_filter = 0.3, not 1 (" in message


# --- an integral that was charged before the log began


def held(world, *, rounding=0.0, **settings):
    """Steps of an axis that its integral holds against a weight; what it holds is the weight over the gain."""
    truth = lab.Truth(gain=2.0, damping=6.0, effects={"constant_force": {"acceleration": 5.0}})
    loop = Controller(kp=60.0, kd=4.0, ki=300.0, integral_before=2.5, **settings)
    rig = lab.Setup(controller=loop, surroundings=lab.surroundings(world, seed=1))
    record = lab.step_record(truth, seed=3, reference=(0.1, 0.02, 0.07), duration=0.8, setup=rig)
    voltage = np.round(record.voltage / rounding) * rounding if rounding else record.voltage
    return record.with_({"voltage": voltage, "controller": replace(loop, integral_before=None)})


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("rounding", "settings"),
    [(0.0, {}), (0.02, {}), (0.0, {"derivative_filter": 0.3}), (0.0, {"setpoint_weight": 0.0})],
    ids=["as it was", "rounded", "filtered", "I-PD"],
)
def test_the_integral_that_holds_a_weight_is_read_off_the_log(world, rounding, settings):
    """No user can know it; it was called a setting that contradicts the log, and simulations fell by the weight."""
    record = held(world, rounding=rounding, **settings)
    (found,) = as_records(record)
    assert found.controller.integral_before == pytest.approx(2.5, abs=max(1e-3, rounding))
    assert told(record) == {}


def test_an_integral_is_read_where_the_law_without_it_would_reach_the_limit():
    """The log stays within 6 V; without the integral the law is clamped at −6 V, from where it goes on otherwise."""
    truth = lab.Truth(gain=2.0, damping=6.0, effects={"constant_force": {"acceleration": 5.0}})
    loop = Controller(kp=60.0, kd=4.0, ki=300.0, integral_before=2.5, anti_windup="clamping")
    rig = lab.Setup(controller=loop, voltage_limit=6.0)
    still = np.zeros(100)
    record = lab.step_record(truth, seed=3, reference=(-0.11,), duration=0.8, noise=1e-6, setup=rig)
    before = replace(
        record,
        time=1e-3 * np.arange(len(record) + 100),
        position=np.concatenate([still, record.position]),
        reference=np.concatenate([still, record.reference]),
        voltage=np.concatenate([still + 2.5, record.voltage]),
        controller=replace(loop, integral_before=None),
    )
    assert np.abs(before.voltage).max() < 6.0
    assert np.abs(controller_voltage(before)).max() > 6.0
    assert as_records(before)[0].controller.integral_before == pytest.approx(2.5, abs=1e-3)


def test_a_weight_that_an_integral_holds_is_predicted_and_identified():
    record, other = held("white"), held("coloured")
    plant = Plant(gain=2.0, damping=6.0, effects=(ConstantForce(acceleration=5.0),))
    assert max(predict(plant, other).average_percent) < 0.1
    found = fit("constant_force", record)
    assert found.plant.effect("constant_force").acceleration == pytest.approx(5.0, rel=1e-2)
    assert max(predict(found, other).average_percent) < 0.1


@pytest.mark.parametrize("wrong", [{"ki": 200.0}, {"kp": 50.0}, {"derivative_filter": 0.5}])
def test_an_integral_is_not_read_off_a_log_of_another_law(wrong):
    record = held("white")
    other = record.with_({"controller": replace(record.controller, **wrong)})
    (found,) = as_records(other)
    assert found.controller.integral_before is None
    assert told(other) != {}


@pytest.mark.parametrize("value", [2.0, 0.0])
def test_an_integral_that_is_stated_stays_as_it_is(value):
    """That of 0 counted as unstated, and another was read off the log."""
    record = held("white")
    stated = record.with_({"controller": replace(record.controller, integral_before=value)})
    assert as_records(stated)[0].controller.integral_before == value
    assert f"integral_before = 2.5 V, not {value:g}" in told(stated)["settings_contradict_log"]


@pytest.mark.parametrize("law", ["pid", "cascade"])
def test_a_stated_integral_of_nothing_is_read_from_a_file_and_written_to_one(law, tmp_path):
    record = held("white")
    loop = Controller.cascade(kp=15.0, kv=4.0, kiv=60.0) if law == "cascade" else record.controller
    for value in (0.0, None):
        record.with_({"controller": replace(loop, integral_before=value)}).to_csv(tmp_path / "run.csv")
        assert ("integral_before" in (tmp_path / "run.csv").read_text()) == (value is not None)
        assert read_record(tmp_path / "run.csv").controller.integral_before == value


def test_integral_against_the_proportional_gain_is_named():
    record = lab.step_record(RUBBING, 60, 4, seed=2, noise=1e-5).with_({"voltage": None})
    wrong, right = (record.with_({"controller": Controller(kp=60.0, kd=4.0, ki=ki)}) for ki in (-3.0, 3.0))
    assert "ki = -3 beside kp = 60 drives the axis away" in told(wrong)["impossible_controller"]
    assert "impossible_controller" not in told(right)
