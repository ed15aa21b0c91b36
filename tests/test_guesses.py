"""What is guessed of a log: the meaning of names, units by what is plausible, gains by the law, and how it is told."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.campaign import read_records
from servolens.cli import group
from servolens.errors import InputError
from servolens.reading import read_log, read_record
from servolens.reading.words import meaning

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.6, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage


def table(path, **columns):
    rows = zip(*columns.values(), strict=True)
    path.write_text(",".join(columns) + "\n" + "\n".join(",".join(f"{x:.12g}" for x in row) for row in rows) + "\n")
    return path


def run(*arguments):
    return CliRunner().invoke(group, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    ("name", "roles", "unit"),
    [
        ("time_ms", ("time",), "ms"),
        ("Zeit [s]", ("time",), "s"),
        ("millis", ("time",), "ms"),
        ("Timestamp (us)", ("time",), "us"),
        ("Sollposition", ("reference",), None),
        ("Positionssollwert / mm", ("reference",), "mm"),
        ("Lageistwert [mm]", ("position",), "mm"),
        ("Istwinkel in Grad", ("position",), "Grad"),
        ("target_pos", ("reference",), None),
        ("posActual", ("position",), None),
        ("currentPosition_deg", ("position",), "deg"),
        ("current_A", ("voltage",), "A"),
        ("pwm_volts", ("voltage",), "V"),
        ("duty", ("voltage",), "duty"),
        ("Motorstrom", ("voltage",), "A"),
        ("Drehmoment", ("voltage",), "N m"),
        ("Stellgröße [V]", ("voltage",), "V"),
        ("Führungsgröße", ("reference",), None),
        ("theta_dot", ("velocity",), None),
        ("thetadot_rad_s", ("velocity",), "rad/s"),
        ("Drehzahl [U/min]", ("velocity",), "U/min"),
        ("speed_setpoint", (), None),
        ("position_error", (), None),
        ("Schleppfehler [mm]", (), "mm"),
        ("motor_temperature", (), None),
        ("vbus_voltage", (), None),
        ("Kp", (), None),
        ("position [V]", (), "V"),
        ("command", ("reference", "voltage"), None),
        ("v", ("velocity", "voltage"), None),
        ("y[0]", ("position",), None),
        ("axis0.encoder.pos_estimate", ("position",), "rev"),
    ],
)
def test_names_mean_what_people_mean(name, roles, unit):
    said = meaning(name)
    assert (said.roles, said.unit) == (roles, unit)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns")], ids=["s", "ms", "us", "ns"]
)
def test_a_time_without_unit_is_read_in_the_one_that_is_plausible(tmp_path, factor, unit):
    log = read_log(table(tmp_path / "a.csv", time=T * factor, position=Y, reference=R, voltage=U))
    assert log.record.time == pytest.approx(T, rel=1e-9)
    assert {guess.quantity: guess.value for guess in log.guesses}["time"] == unit


def test_what_was_guessed_is_told_once_and_what_was_stated_is_not(tmp_path):
    path = table(tmp_path / "a.csv", t_ms=T * 1e3, pos_mm=Y * 1e3, reference=R, voltage=U)
    (remark,) = read_record(path, settings={"kp": 60, "kd": 4}).remarks
    assert (remark.code, remark.severity) == ("columns_guessed", "note")
    assert remark.message == (
        "read by guess: time from 't_ms' [ms], position from 'pos_mm' [mm]; `servolens convert` shows why."
    )
    stated = {"time": "t_ms", "position": "pos_mm"}
    assert read_record(path, settings={"kp": 60, "kd": 4}, columns=stated).remarks == ()


# ---- gains


@pytest.mark.parametrize(
    ("kp", "kd", "window", "derivative"),
    [(60, 0, 1, "position"), (60, 4, 1, "position"), (60, 4, 2, "position"), (60, 4, 1, "velocity")],
)
def test_gains_are_those_of_the_law_that_made_the_command(tmp_path, kp, kd, window, derivative):
    slope = np.zeros_like(Y)
    slope[window:] = (Y[window:] - Y[:-window]) / (window * 1e-3)
    slope[:window] = (Y[:window] - Y[0]) / (window * 1e-3)
    speed = np.gradient(Y, 1e-3)
    command = kp * (R - Y) - kd * (speed if derivative == "velocity" else slope)
    path = table(tmp_path / "a.csv", time=T, position=Y, reference=R, velocity=speed, voltage=command)
    controller = read_record(path).controller
    assert (controller.kp, controller.kd) == (pytest.approx(kp, rel=1e-3), pytest.approx(kd, rel=1e-3))
    assert (controller.derivative, controller.derivative_window) == (derivative, window)


def test_no_gains_are_guessed_where_no_law_explains_the_command(tmp_path):
    integral = np.cumsum(R - Y) * 1e-3 * 400
    path = table(tmp_path / "a.csv", time=T, position=Y, reference=R, voltage=60 * (R - Y) + integral)
    assert read_record(path).controller is None


def test_a_gain_beside_the_columns_that_contradicts_the_log_is_not_taken(tmp_path):
    integral = np.cumsum(R - Y) * 1e-3 * 400
    path = table(tmp_path / "a.csv", time=T, position=Y, reference=R, voltage=60 * (R - Y) + integral, kp=0 * T + 160)
    assert read_record(path).controller is None
    path = table(tmp_path / "b.csv", time=T, position=Y, reference=R, kp=0 * T + 60, kd=0 * T + 4)
    assert (read_record(path).controller.kp, read_record(path).controller.kd) == (60, 4)


# ---- references that were not logged


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("0.1", [0.1, 0.1, 0.1, 0.1]),
        ("0.1@1", [0, 0.1, 0.1, 0.1]),
        ("100 mm from 1000 ms", [0, 0.1, 0.1, 0.1]),
        ("0.1 m at 1 s, 0.05 m at 3 s", [0, 0.1, 0.1, 0.05]),
        ("0.2@0,0.1@2", [0.2, 0.2, 0.1, 0.1]),
    ],
)
def test_a_reference_can_be_stated(tmp_path, text, levels):
    path = tmp_path / "a.csv"
    path.write_text("# kp = 60\ntime,position\n0,0\n1,0\n2,0.05\n3,0.1\n")
    assert read_record(path, settings={"reference": text}).reference == pytest.approx(levels)
    path.write_text(f"# kp = 60\n# reference = {text}\ntime,position\n0,0\n1,0\n2,0.05\n3,0.1\n")
    assert read_record(path).reference == pytest.approx(levels)


@pytest.mark.parametrize(
    ("header", "text", "part"),
    [
        ("position [mm]", "90@1", "write '90 mm' or '90 m'"),
        ("position", "x@1", "is not a number; write e.g. 0.1 m from 0.5 s"),
        ("position", "0.1@1,0.2", "each level needs its instant"),
        ("position", "0.1@2,0.2@1", "each level needs its instant"),
        ("position", "0.1@9", "behind the record's end"),
        ("position", "0.1 V@1", "is not in a unit of the position"),
        ("position", "0.1@1@2", "states two instants"),
        ("position", "0.1@1 m", "which is no time"),
    ],
)
def test_a_reference_that_cannot_be_meant_is_refused(tmp_path, header, text, part):
    (tmp_path / "a.csv").write_text(f"# kp = 60\ntime,{header}\n0,0\n1,0\n2,0.05\n3,0.1\n")
    with pytest.raises(InputError) as refused:
        read_record(tmp_path / "a.csv", settings={"reference": text})
    assert part in str(refused.value)


def test_a_step_relative_to_where_the_axis_stands_is_asked_about(tmp_path):
    (tmp_path / "a.csv").write_text("# kp = 60\ntime,position\n0,0.3\n1,0.3\n2,0.35\n3,0.4\n")
    with pytest.raises(InputError) as refused:
        read_record(tmp_path / "a.csv", settings={"reference": "0.4@1"})
    assert "state the reference there too, e.g. 0.3@0, 0.4@1" in str(refused.value)


# ---- the command convert


def test_a_converted_campaign_reads_the_same_without_a_guess(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "axis").mkdir()
    one = table(tmp_path / "logs" / "run.csv", t_ms=T * 1e3, pos_mm=Y * 1e3, ref_mm=R * 1e3, u=U)
    two = table(tmp_path / "axis" / "run.csv", Zeit=T, Ist=Y, Soll=R, Spannung=U)
    out = tmp_path / "axis" / "campaign.toml"
    done = run("convert", one, two, "--out", out, "--json", tmp_path / "how.json")
    assert done.exit_code == 0, done.output
    assert "copied 1 log beside it" in done.output
    assert (tmp_path / "axis" / "run-2.csv").read_bytes() == one.read_bytes()
    guessed, read = read_records([one, two]), read_records(out)
    for before, after in zip(guessed, read, strict=True):
        for signal in ("time", "position", "reference", "voltage"):
            assert np.array_equal(getattr(before, signal), getattr(after, signal))
        assert (before.controller, before.length_unit) == (after.controller, after.length_unit)
        assert after.remarks == ()
    body = json.loads((tmp_path / "how.json").read_text())
    assert body["schema"] == "servolens.conversion/1"
    assert [guess["quantity"] for guess in body["records"][0]["guesses"]] == [
        "time", "position", "reference", "voltage", "kp", "kd",
    ]  # fmt: skip


def test_converting_again_copies_nothing_twice(tmp_path):
    (tmp_path / "axis").mkdir()
    log = table(tmp_path / "run.csv", t=T, q=Y, r=R, u=U)
    for _ in range(2):
        assert run("convert", log, "--out", tmp_path / "axis" / "c.toml").exit_code == 0
    assert sorted(path.name for path in (tmp_path / "axis").iterdir()) == ["c.toml", "run.csv"]


def test_names_survive_the_campaign_whatever_they_hold(tmp_path):
    name = 'a"b\\c\x7f.csv'
    log = table(tmp_path / name, **{'po"s': Y, "Zeit\\": T, "ref": R, "u": U})
    done = run("convert", log, "--out", tmp_path / "c.toml", "--column", 'position=po"s', "--column", "time=Zeit\\")
    assert done.exit_code == 0, done.output
    (record,) = read_records(tmp_path / "c.toml")
    assert np.allclose(record.position, Y)


@pytest.mark.parametrize(
    ("columns", "options", "answer"),
    [
        ({"t": T, "theta1": Y, "theta2": Y**2, "u": U}, [], ["--column", "position=theta1"]),
        ({"t": T, "pos": Y * 1e3, "u": U}, [], ["--unit", "position=mm"]),
        ({"t": T, "pos": Y}, ["--record-kp", "60"], ["--reference-step", "0.1@0,0.02@0.6,0.07@1.2"]),
        ({"1": T, "2": Y, "3": U}, [], ["--columns", "time,position,voltage"]),
        ({"t": T, "enc_counts": Y * 1e4, "u": U}, [], ["--setting", "counts_per_unit=10000"]),
        ({"n": np.arange(T.size), "pos": Y, "u": U}, [], ["--setting", "sample_time=1 ms"]),
    ],
    ids=["column", "unit", "reference", "order", "scale", "clock"],
)
def test_one_answer_settles_the_one_question(tmp_path, columns, options, answer):
    log = table(tmp_path / "a.csv", **columns)
    if "1" in columns:
        log.write_text(log.read_text().partition("\n")[2])
    asked = run("convert", log, "--out", tmp_path / "c.toml", *options)
    assert asked.exit_code == 2
    assert asked.output.startswith(f"servolens: error: {log}: ")
    assert asked.output.count("\n") == 1
    assert not (tmp_path / "c.toml").exists()
    done = run("convert", log, "--out", tmp_path / "c.toml", *options, *answer)
    assert done.exit_code == 0, done.output
    (record,) = read_records(tmp_path / "c.toml")
    assert np.max(np.abs(record.position - Y)) < 1e-9


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--out", "c.txt"], "is no .toml file"),
        (["--out", "c.toml", "--columns", "time,where"], "'where' is no signal"),
        (["--out", "c.toml", "--columns", "time,time"], "a signal stands twice"),
        (["--out", "c.toml", "--setting", "kp"], "is not KEY=VALUE"),
        (["--out", "c.toml", "--setting", "colour=red"], "no setting is named 'colour'"),
        (["--out", "missing/c.toml"], "the folder missing does not exist"),
    ],
)
def test_wrong_options_of_convert_are_refused(tmp_path, monkeypatch, options, part):
    monkeypatch.chdir(tmp_path)
    log = table(tmp_path / "a.csv", t=T, q=Y, r=R, u=U)
    done = run("convert", log, *options)
    assert done.exit_code == 2
    assert part in done.output


def test_columns_by_number_are_those_of_the_file_beside_a_stated_sample_time(tmp_path):
    path = table(tmp_path / "log.csv", **{"Channel 1": R, "Channel 2": Y, "Channel 3": R - Y, "Channel 4": U})
    out = tmp_path / "log.toml"
    stated = ("--columns", "reference,position,-,voltage", "--setting", "sample_time=1 ms", "--unit", "position=m")
    units = ("--unit", "reference=m", "--unit", "voltage=V", "--record-kp", "60", "--record-kd", "4")
    assert run("convert", path, *stated, *units, "--out", out).exit_code == 0
    record = read_records(out)[0]
    assert record.position == pytest.approx(Y)
    assert record.reference == pytest.approx(R)
    assert record.voltage == pytest.approx(U)


def test_a_supply_is_asked_about_where_the_axis_turns_round_and_may_be_left_out(tmp_path):
    supply = 12.0 - 0.1 * np.abs(U) / np.abs(U).max()
    path = table(tmp_path / "log.csv", time=T, position=Y, reference=R, input_volts=supply)
    asked = run("check", path, "--record-kp", "60", "--record-kd", "4")
    assert asked.exit_code == 2
    said = " ".join(asked.output.split())
    assert "hardly varies, as the voltage of a supply while the axis turns round" in said
    assert "--column voltage=input_volts or --column voltage=- if no command was logged" in said
    gains = {"kp": "60", "kd": "4"}
    assert read_record(path, columns={"voltage": "-"}, settings=gains).voltage is None
    assert run("check", path, "--record-kp", "60", "--record-kd", "4", "--column", "voltage=-").exit_code == 0


@pytest.mark.parametrize("scale", [{"counts_per_unit": 40000}, {"counts_per_rev": 4000}])
def test_columns_in_counts_may_be_named(tmp_path, scale):
    path = table(tmp_path / "log.csv", t=T, enc=np.round(4e4 * Y), ref=np.round(4e4 * R), u=U)
    columns = {"position": "enc", "reference": "ref", "voltage": "u"}
    record = read_record(path, columns=columns, settings={"kp": 60, "kd": 4, **scale})
    unit = 4e4 if "counts_per_unit" in scale else 4000 / (2 * np.pi)
    assert record.position == pytest.approx(np.round(4e4 * Y) / unit, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "voltage"),
    [("u_volts", 0.0 * U), ("voltage [V]", 5.0 + 0.5 * np.sin(40.0 * T)), ("u_volts", U)],
)
def test_no_supply_is_suspected_of_a_free_motion_or_of_what_is_called_the_voltage(tmp_path, name, voltage):
    path = table(tmp_path / "log.csv", **{"time": T, "position": Y, "reference": R, name: voltage})
    assert read_record(path, settings={"kp": "60 V/m"}).voltage == pytest.approx(voltage)


def test_a_signal_that_is_said_to_be_missing_stays_so_in_the_campaign(tmp_path):
    path = table(tmp_path / "log.csv", time=T, position=Y, reference=R, input_volts=12.0 + 0.01 * np.sin(T))
    stated = ("--record-kp", "60", "--record-kd", "4", "--column", "voltage=-")
    assert run("convert", path, *stated, "--out", tmp_path / "a.toml").exit_code == 0
    assert read_records(tmp_path / "a.toml")[0].voltage is None


def test_the_answer_to_rounded_time_stamps_can_be_given(tmp_path):
    """Beside this noise the motion does not show whether the samples were taken evenly."""
    time = np.arange(T.size) * 2.5
    noisy = Y + np.random.default_rng(8).normal(scale=3e-4, size=Y.size)
    path = table(tmp_path / "log.csv", **{"time [ms]": np.floor(time), "position": noisy, "reference": R, "voltage": U})
    told = " ".join(run("check", path, "--record-kp", "60", "--record-kd", "4").output.split())
    assert "the time stamps come in steps of 1 ms, as if rounded" in told
    assert '--setting "sample_time=2.5 ms"' in told
    assert "samples are lost" not in told
    record = read_record(path, settings={"sample_time": "2.5 ms", "kp": 60, "kd": 4})
    assert record.time == pytest.approx(1e-3 * time)


def test_rounded_time_stamps_are_made_even_where_the_motion_shows_it(tmp_path):
    time = np.arange(T.size) * 2.5
    path = table(tmp_path / "log.csv", **{"time [ms]": np.floor(time), "position": Y, "reference": R, "voltage": U})
    told = " ".join(run("check", path, "--record-kp", "60", "--record-kd", "4").output.split())
    assert "the samples were taken evenly, every 2.5 ms" in told
    assert "as if rounded" not in told


def test_counts_are_whole_numbers_whatever_the_name_implies(tmp_path):
    """A servo's protocol counts its goal_position; a program that logs it may have converted it."""
    path = table(tmp_path / "log.csv", time=T, position=Y, goal_position=R)
    assert read_record(path, settings={"kp": "60", "kd": "4"}).reference == pytest.approx(R)
    asked = run("check", table(tmp_path / "counts.csv", time=T, position=Y, goal_position=np.round(1e4 * R)))
    assert asked.exit_code == 2
    assert "encoder counts" in " ".join(asked.output.split())
