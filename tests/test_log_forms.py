"""Logs as tools write them that stray from a plain table: each is read as the laboratory made it, or asked about."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from time import process_time

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.campaign import read_records
from servolens.cli import group
from servolens.errors import InputError
from servolens.reading import read_log, stamps
from servolens.reading.nested import tables_of
from servolens.reading.words import Meaning, meaning, unit_behind

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.2, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage
MM = "time [s],position [mm],reference [mm],voltage [V]\n"
DIGITS = 2e-6
"""Relative error of what is logged with six digits behind the point."""


def rows(*columns, separator=",", form="{:.6f}"):
    """Lines of cells; texts stay as they are."""
    cells = zip(*columns, strict=True)
    lines = (separator.join(x if isinstance(x, str) else form.format(x) for x in row) for row in cells)
    return "\n".join(lines) + "\n"


def texts(form, values):
    return [form.format(value) for value in values]


def stamped(form, start="2026-11-28 11:59:59.900000"):
    """Time stamps of milliseconds; noon passes after 100 of them."""
    instants = [datetime.fromisoformat(start) + timedelta(milliseconds=k) for k in range(T.size)]
    return [x.strftime(form.replace("%ms", f"{x.microsecond // 1000:03d}")) for x in instants]


def blank(values, keep):
    return [f"{1e3 * x:.6f}" if kept else "" for x, kept in zip(values, keep, strict=True)]


TENTH = np.arange(T.size) % 10 == 0
CHANGES = np.append(True, np.diff(R) != 0)
STAMPED = "Time,Position [mm],Setpoint [mm],Voltage [V]\n"
SIGNALS = (Y * 1e3, R * 1e3, U)
COUNTS = [str(k) for k in range(T.size)]
CHANNELS = {"position": "CH1", "reference": "CH2", "voltage": "CH3"}
SCALE = {"columns": CHANNELS, "units": {"position": "0.1 m", "reference": "100 mm"}}
VOLTS = (Y * 10, R * 10, U)
LISTED = [("t", T, "s"), ("ref", R * 1e3, "mm"), ("pos", Y * 1e3, "mm"), ("u", U, "V")]
FOOT = (
    "Mean,50.1,30.2,0.1\nMax,107.3,100.0,6.0\nMin,-0.1,0.0,-6.0\nStd,30.1,20.2,1.0\nCount,1801,1801,1801\nRMS,1,2,3\n"
)
IN_UNITS = ("{:.3f} s", "{:.6f} mm", "{:.3f}mm", "{:.6f}V")
READ = {
    "AM and PM, American date": (STAMPED + rows(stamped("%m/%d/%Y %I:%M:%S.%ms %p"), *SIGNALS), {}),
    "AM and PM, no date": (STAMPED + rows(stamped("%I:%M:%S.%ms %p"), *SIGNALS), {}),
    "European date with slashes": (STAMPED + rows(stamped("%d/%m/%Y %H:%M:%S.%ms"), *SIGNALS), {}),
    "name of the month": (STAMPED + rows(stamped("%d-%b-%Y %H:%M:%S.%ms"), *SIGNALS), {}),
    "minutes and seconds": (STAMPED + rows(stamped("%M:%S.%ms", "2026-11-28 11:00:59.9"), *SIGNALS), {}),
    "reference in every tenth row": (MM + rows(T, Y * 1e3, blank(R, TENTH), U), {}),
    "reference where it changes": (MM + rows(T, Y * 1e3, blank(R, CHANGES), U), {}),
    "reference, nan between": (MM + rows(T, Y * 1e3, [x or "NaN" for x in blank(R, TENTH)], U), {}),
    "units in cells": (
        "Time,Position,Setpoint,Voltage\n"
        + rows(*(texts(form, x) for form, x in zip(IN_UNITS, (T, *SIGNALS), strict=True))),
        {},
    ),
    "units in cells, decimal commas": (
        "Zeit;Position;Sollwert;Spannung\n"
        + rows(
            *(texts(f"{{:.6f}} {u}", x) for u, x in zip(("s", "mm", "mm", "V"), (T, *SIGNALS), strict=True)),
            separator=";",
        ).replace(".", ","),
        {},
    ),
    "prefixes in cells": (
        "Time,Position,Setpoint,Voltage\n"
        + rows(T, [f"{1e3 * y:.6f} mm" if y < 0.05 else f"{100 * y:.7f} cm" for y in Y], texts("{:.6f} m", R), U),
        {},
    ),
    "statistics below": (MM + rows(T, *SIGNALS) + "\n" + FOOT, {}),
    "statistics without a blank line": (MM + rows(T, *SIGNALS) + FOOT, {}),
    "pairs of values below": (MM + rows(T, *SIGNALS) + "\nStatistics\nMean position,50\nOvershoot,7.3\n", {}),
    "Rigol": (
        "X,CH1,CH2,CH3,Start,Increment\nSequence,VOLT,VOLT,VOLT,0.000000e+00,1.000000e-03\n"
        + rows(COUNTS, *VOLTS).replace("\n", ",,\n"),
        SCALE,
    ),
    "Rigol, short rows": (
        "X,CH1,CH2,CH3,Start,Increment,\nSequence,Volt,Volt,Volt,0.000000e+00,1.000000e-03\n"
        + rows(COUNTS, *VOLTS).replace("\n", ",\n"),
        SCALE,
    ),
    "Siglent": (
        "Record Length,Analog:601\nSample Interval,Analog:1.0e-03\nModel Number,SDS1104X-E\n\n"
        "Source,CH1,CH2,CH3\nSecond,Volt,Volt,Volt\n" + rows(T, *VOLTS),
        SCALE,
    ),
    "Graphtec": (
        "Vendor,GRAPHTEC\nSampling interval,1ms\nData\nNumber,Date&Time,ms,Position,Setpoint,Voltage\n"
        "NO.,time,ms,mm,mm,V\n" + rows(COUNTS, stamped("%Y/%m/%d %H:%M:%S"), stamped("%ms"), *SIGNALS),
        {"settings": {"sample_time": "1 ms"}},
    ),
    "a time before each signal": (
        "Time (s),Position (mm),Time (s),Setpoint (mm),Time (s),Voltage (V)\n" + rows(T, Y * 1e3, T, R * 1e3, T, U),
        {},
    ),
    "quoted decimal commas": (
        '"Zeit [s]","Position [mm]","Sollwert [mm]","Spannung [V]"\n'
        + rows(*([f'"{x:.6f}"'.replace(".", ",") for x in column] for column in (T, *SIGNALS))),
        {},
    ),
    "Arduino, labels": (
        "".join(f"t_ms:{t * 1e3:.0f},target_mm:{r * 1e3:.1f},pos_mm:{y * 1e3:.6f},volts:{u:.6f}\n"
                for t, r, y, u in zip(T, R, Y, U, strict=True)),
        {},
    ),
    "Arduino, labels and units, cut at the beginning": (
        "s: 30.0 mm, u: 0.1 V\n"
        + rows(*(texts(f"{name}: {{:.6f}} {unit}", x) for name, x, unit in LISTED), separator=", "),
        {},
    ),
    "Arduino's monitor with time stamps": (
        "11:59:59.100 -> ref_mm,pos_mm,volts\n"
        + rows(texts("{} -> ", stamped("%H:%M:%S.%ms")), *(R * 1e3, Y * 1e3, U)).replace(" -> ,", " -> "),
        {},
    ),
    "inches by name": ("t_ms,pos_inch,target_inch,u_V\n" + rows(T * 1e3, Y / 0.0254, R / 0.0254, U), {}),
    "ACS": (
        "Time [msec],FPOS(0),RPOS(0),DCOM(0) [V]\n" + rows(T * 1e3, Y * 1e3, R * 1e3, U),
        {"units": {"position": "mm"}, "columns": {"voltage": "DCOM(0)"}},
    ),
}  # fmt: skip


def written(tmp_path, content):
    path = tmp_path / "run.csv"
    path.write_text(content, encoding="utf-8")
    return path


def refusal(tmp_path, content, **options):
    with pytest.raises(InputError) as error:
        read_log(written(tmp_path, content), **options)
    return str(error.value).partition("run.csv: ")[2]


def notes(reading):
    return {remark.code: remark.message for remark in reading.record.remarks}


@pytest.mark.parametrize(("content", "options"), READ.values(), ids=READ)
def test_log_is_read_as_it_was_made(tmp_path, content, options):
    record = read_log(written(tmp_path, content), **options).record
    assert record.time == pytest.approx(T, abs=1e-9)
    for signal, truth in (("position", Y), ("reference", R), ("voltage", U)):
        assert np.max(np.abs(getattr(record, signal) - truth)) < DIGITS * np.ptp(truth), signal


@pytest.mark.parametrize("form", READ)
def test_campaign_of_such_a_log_reads_it_again(tmp_path, form):
    content, options = READ[form]
    named = [("--column", "columns"), ("--unit", "units"), ("--setting", "settings")]
    answers = [f"{option}={key}={x}" for option, kind in named for key, x in options.get(kind, {}).items()]
    arguments = ["convert", str(written(tmp_path, content)), "--out", str(tmp_path / "c.toml"), *answers]
    done = CliRunner().invoke(group, arguments)
    assert done.exit_code == 0, done.output
    (record,) = read_records(tmp_path / "c.toml")
    assert np.max(np.abs(record.position - Y)) < DIGITS * np.ptp(Y)
    assert np.max(np.abs(record.voltage - U)) < DIGITS * np.ptp(U)


# ---- time stamps


def test_noon_and_midnight_of_half_a_day():
    found = stamps.stamps(["12:00:00.5 AM", "1:00:00 am", "12:00:00 PM", "11:59:59 p.m."])
    assert found.astype("datetime64[s]").astype(int).tolist() == [0, 3600, 12 * 3600, 24 * 3600 - 1]


def test_hours_of_half_a_day_end_at_twelve(tmp_path):
    content = STAMPED + rows(stamped("%H:%M:%S.%ms AM", "2026-11-28 12:59:59.9"), *SIGNALS)
    assert refusal(tmp_path, content) == "a time stamp has a date or a clock that does not exist"


@pytest.mark.parametrize(("form", "start"), [("%m/%d/%Y", "2026-11-28"), ("%d/%m/%Y", "2026-11-28")])
def test_dates_with_slashes_tell_their_order_past_midnight(tmp_path, form, start):
    content = STAMPED + rows(stamped(f"{form} %H:%M:%S.%ms", f"{start} 23:59:59.9"), *SIGNALS)
    assert read_log(written(tmp_path, content)).record.time == pytest.approx(T, abs=1e-9)


def test_dates_with_slashes_of_two_readings_are_a_question(tmp_path):
    content = STAMPED + rows(stamped("%m/%d/%Y %H:%M:%S.%ms", "2026-03-04 23:59:59.9"), *SIGNALS)
    said = "the time stamps' dates may begin with the day or the month; write them as 2026-11-28"
    assert refusal(tmp_path, content) == said


@pytest.mark.parametrize("wrong", ["/", "11/28 /2026 1:00:00", "a/"])
def test_a_damaged_date_is_refused(tmp_path, wrong):
    instants = stamped("%m/%d/%Y %H:%M:%S.%ms")
    instants[5] = wrong
    said = f"line 7, time: '{wrong}' is no time stamp; fill or leave out such rows"
    assert refusal(tmp_path, STAMPED + rows(instants, *SIGNALS)) == said


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("11/8/2026 9:05:26.120 AM", "2026-11-08T09:05:26.120"),
        ("1/11/2026 9:05:26", "2026-01-11T09:05:26.000"),
        ("3/28/2026 21:05:26", "2026-03-28T21:05:26.000"),
        ("28/3/2026 9:05:26", "2026-03-28T09:05:26.000"),
        ("2026/03/28 9:05:26", "2026-03-28T09:05:26.000"),
        ("8.3.2026 9:05:26", "2026-03-08T09:05:26.000"),
        ("8-Mar-2026 9:05:26", "2026-03-08T09:05:26.000"),
    ],
)
def test_dates_need_no_leading_zeros(cell, said):
    assert stamps.stamps([cell, cell]).astype("datetime64[ms]").astype(str).tolist() == [said] * 2


def test_dates_without_leading_zeros_of_two_readings_are_a_question_where_they_change():
    with pytest.raises(InputError, match="may begin with the day or the month"):
        stamps.stamps(["3/4/2026 23:59:59", "3/5/2026 0:00:00"])


# ---- words


@pytest.mark.parametrize(
    ("name", "roles"),
    [
        *(("curr_pos", "position"), ("curr_time", "time"), ("curr_ref", "reference"), ("curr_angle", "position")),
        *(("pos_curr", "position"), ("pos profile", "position"), ("Profile velocity", "velocity")),
        *(("direction x", "position"), ("setpoint direction x", "reference"), ("ref_dir_x", "reference")),
        *(("target_direction", "reference"), ("voltage_dir_corrected", "voltage"), ("u_dir", "voltage")),
        *(("direction*pwm", "voltage"), ("Sollwert Richtung", "reference"), ("vel_dir", "velocity"), ("refdir", "")),
    ],
)
def test_words_beside_another_signal_s_do_not_change_it(name, roles):
    assert (meaning(name).roles, meaning(name).kind != "direction") == ((roles,) if roles else (), True)


@pytest.mark.parametrize("name", ["dir", "motor_direction", "Drehrichtung", "motordir", "dir1"])
def test_a_direction_is_known_by_its_name(name):
    assert (meaning(name).roles, meaning(name).kind) == ((), "direction")


@pytest.mark.parametrize(
    "name", ["a" + " " * 100_000 + "b", "[" * 100_000, "a" * 100_000, "pos [" + " " * 100_000, "a/ " * 30_000]
)
def test_a_name_without_an_end_keeps_nobody_busy(name):
    begin = process_time()
    assert meaning(name) == Meaning()
    assert unit_behind(name) == (name.strip(), None, "")
    assert process_time() - begin < 1


@pytest.mark.parametrize(
    "name", ["pos [" + " " * 990 + "x", "a," + " " * 990 + "/", "a" + " " * 990 + "/,", "(" * 1000]
)
def test_blanks_and_brackets_in_a_name_keep_nobody_busy(name):
    begin = process_time()
    unit_behind(name)
    assert process_time() - begin < 0.2  # it took seconds where each blank was the end of a name and of a unit


# ---- blank cells


def test_what_was_held_is_said(tmp_path):
    reading = read_log(written(tmp_path, MM + rows(T, Y * 1e3, blank(R, TENTH), U)))
    count = np.count_nonzero(~TENTH)
    assert notes(reading)["reference_held"] == (
        f"the reference is blank in {count} of {T.size} rows; each value was held until the next one."
        " If it moved in between, log it in each row."
    )


@pytest.mark.parametrize("signal", ["position", "voltage"])
def test_only_what_holds_its_value_is_held(tmp_path, signal):
    cells = {"position": Y, "voltage": U / 1e3}
    columns = {"position": Y * 1e3, "reference": R * 1e3, "voltage": U} | {signal: blank(cells[signal], TENTH)}
    said = f"line 3, {signal}: the value is missing; fill or leave out such rows"
    assert refusal(tmp_path, MM + rows(T, *columns.values())) == said


def test_cells_before_the_first_value_are_refused(tmp_path):
    content = MM + rows(T, Y * 1e3, blank(R, np.arange(T.size) > 2), U)
    assert refusal(tmp_path, content).startswith("line 2, reference: the value is missing")


def test_a_reference_with_a_wrong_text_is_refused(tmp_path):
    cells = blank(R, TENTH)
    cells[17] = "error"
    assert refusal(tmp_path, MM + rows(T, Y * 1e3, cells, U)).startswith("line 3, reference: the value is missing")


# ---- units in cells


def test_cells_in_a_unit_that_the_heading_contradicts_are_refused(tmp_path):
    content = "time [s],position [m],voltage [V]\n" + rows(T, texts("{:.4f} mm", Y * 1e3), U)
    said = "column 'position [m]' states 'm' in its heading and 'mm' in its cells; keep one"
    assert refusal(tmp_path, content) == said


@pytest.mark.parametrize("cell", ["0.5", "0.5 V", "none"])
def test_a_cell_in_no_unit_of_its_column_is_refused(tmp_path, cell):
    cells = texts("{:.4f} mm", Y * 1e3)
    cells[30] = cell
    said = f"line 32, position: '{cell}' is no number in a unit as the cells above it; fill or leave out such rows"
    assert refusal(tmp_path, "time,position,voltage\n" + rows(T, cells, U)) == said


# ---- what stands below


def test_words_are_only_left_out_at_the_end(tmp_path):
    content = MM + rows(T, *SIGNALS) + FOOT + rows(T[-1:] + 1e-3, *(x[-1:] for x in SIGNALS))
    assert "'Mean' is not a number" in refusal(tmp_path, content)


def test_a_wrong_value_in_the_last_row_is_refused(tmp_path):
    assert "'error' is not a number" in refusal(tmp_path, MM + rows(T, *SIGNALS) + "0.601,error,70,0\n")


@pytest.mark.parametrize(
    ("foot", "said"),
    [
        (FOOT, "6 lines below the table were left out; the first begins with 'Mean'."),
        ("EOF\n", "a line below the table was left out; it begins with 'EOF'."),
        ("", None),
    ],
)
def test_what_was_left_out_below_is_said(tmp_path, foot, said):
    found = notes(read_log(written(tmp_path, MM + rows(T, *SIGNALS) + foot)))
    assert found.get("lines_below_left_out") == said


@pytest.mark.parametrize(
    ("name", "cells", "words"),
    [
        ("position [mm]", texts("{:.6f}", Y * 1e3), ("OL", "ERR")),
        ("target [mm]", texts("{:.4f}", R * 1e3), ("hold",)),
        ("phase", ["1"] * T.size, ("A",)),
        ("id", COUNTS, ("F", "a")),
        ("id", COUNTS, ("off", "True")),
    ],
)
def test_a_row_that_begins_with_a_word_is_no_foot_of_a_column_of_readings(tmp_path, name, cells, words):
    cells = [*cells[: -len(words)], *words]
    columns = {"pos [mm]": Y * 1e3, "ref [mm]": R * 1e3}
    columns = {head: x for head, x in columns.items() if head[:3] != ("ref" if name[0] == "t" else name[:3])}
    content = f"{name},time [s],{','.join(columns)},voltage [V]\n" + rows(cells, T, *columns.values(), U)
    if "[" in name:
        assert f"line {T.size - len(words) + 2}, " in refusal(tmp_path, content)
    else:
        reading = read_log(written(tmp_path, content))
        assert reading.record.time.size == T.size
        assert "lines_below_left_out" not in notes(reading)


def test_switches_in_the_first_column_are_rows(tmp_path):
    cells = ["1"] * (T.size - 2) + ["True", "off"]
    record = read_log(written(tmp_path, "enabled," + MM + rows(cells, T, *SIGNALS))).record
    assert record.time.size == T.size


# ---- gains without a unit


@pytest.mark.parametrize(("head", "says"), [("", True), ("# kp = 60 V/m\n", False)], ids=["bare", "with its unit"])
def test_a_bare_kp_beside_millimetres_is_said_to_be_in_si(tmp_path, head, says):
    head = head or "# kp = 60\n"
    found = notes(read_log(written(tmp_path, head + "time [s],position [mm],reference [mm]\n" + rows(T, *SIGNALS[:2]))))
    assert found.get("unit_of_kp_assumed") == (
        "kp = 60 states no unit and was taken in V/m, while the position is logged in mm; if it is meant so, write"
        " kp = 60 V/mm."
        if says
        else None
    )


@pytest.mark.parametrize("content", ["time,position,reference\n" + rows(T, Y, R), MM + rows(T, *SIGNALS)])
def test_a_bare_kp_is_no_question_in_si_or_beside_the_command(tmp_path, content):
    assert "unit_of_kp_assumed" not in notes(read_log(written(tmp_path, "# kp = 60\n# kd = 4\n" + content)))


# ---- a magnitude and its direction

PWM = np.round(U * 255 / 12)


@pytest.mark.parametrize(
    ("name", "direction", "why"),
    [
        ("dir", np.sign(U), ""),
        ("motor_direction", np.where(PWM > 0, 1, 0), "1 is forward"),
        ("Drehrichtung", np.where(PWM > 0, 0, 1), "0 is forward"),
        ("dir", np.where(PWM > 0, 1, 2), "1 is forward"),
    ],
    ids=["signs", "one is forward", "zero is forward", "one and two"],
)
@pytest.mark.parametrize("with_reference", [True, False], ids=["with reference", "without"])
def test_a_magnitude_is_given_its_direction(tmp_path, name, direction, why, with_reference):
    heads, columns = ("t_ms,pos_mm,ref_mm,pwm", (R * 1e3,)) if with_reference else ("t_ms,pos_mm,pwm", ())
    content = f"{heads},{name}\n" + rows(T * 1e3, Y * 1e3, *columns, np.abs(PWM), direction)
    reading = read_log(written(tmp_path, content))
    assert reading.record.voltage.tolist() == PWM.tolist()
    assert f"was given the sign of '{name}'" in notes(reading)["voltage_signed"]
    assert why in notes(reading)["voltage_signed"]


@pytest.mark.parametrize(
    "direction",
    [np.where(PWM > 0, "F", "R").tolist(), np.arange(T.size) % 2, np.arange(T.size) % 3],
    ids=["words", "unrelated", "three values"],
)
def test_a_direction_that_is_not_clear_is_a_question(tmp_path, direction):
    content = "t_ms,pos_mm,pwm,dir\n" + rows(T * 1e3, Y * 1e3, np.abs(PWM), direction)
    assert refusal(tmp_path, content) == (
        "column 'pwm' has one sign throughout, and what 'dir' says of its direction is not clear; log the command with"
        " its sign, or the direction as 1 and -1"
    )


def test_a_signed_command_keeps_its_sign(tmp_path):
    content = "t_ms,pos_mm,pwm,dir\n" + rows(T * 1e3, Y * 1e3, PWM, np.where(PWM > 0, 0, 1))
    assert read_log(written(tmp_path, content)).record.voltage.tolist() == PWM.tolist()


SPEED = np.gradient(Y)
MOTION = np.where(np.abs(SPEED) > 1e-3 * np.max(np.abs(SPEED)), np.sign(SPEED), 1)


@pytest.mark.parametrize("direction", [MOTION, -MOTION, MOTION > 0, np.where(MOTION > 0, 2, 5)])
@pytest.mark.parametrize("with_reference", [True, False], ids=["with reference", "without"])
def test_a_direction_of_the_motion_is_not_the_command_s(tmp_path, direction, with_reference):
    heads, columns = ("t_ms,pos_mm,ref_mm,pwm", (R * 1e3,)) if with_reference else ("t_ms,pos_mm,pwm", ())
    content = f"{heads},dir\n" + rows(T * 1e3, Y * 1e3, *columns, np.abs(PWM), direction.astype(float))
    reading = read_log(written(tmp_path, content))
    assert reading.record.voltage.tolist() == np.abs(PWM).tolist()
    assert notes(reading)["voltage_of_one_sign"] == (
        "the voltage, 'pwm', has one sign throughout, and 'dir' beside it is the direction of the motion, which does"
        " not tell the command's; if it is a magnitude, log it with its sign."
    )
    assert "voltage_signed" not in notes(reading)


def test_a_direction_of_the_motion_may_come_late(tmp_path):
    late = np.concatenate((MOTION[:3], MOTION[:-3]))
    content = "t_ms,pos_mm,pwm,dir\n" + rows(T * 1e3, Y * 1e3, np.abs(PWM), late)
    assert "voltage_of_one_sign" in notes(read_log(written(tmp_path, content)))


def test_a_command_that_brakes_for_a_short_time_only_is_given_its_direction(tmp_path):
    slow = lab.step_record(lab.NLM2, 20, 10, reference=(0.1, 0.02, 0.07), duration=0.4, noise=1e-6, seed=5)
    along = np.sign(np.gradient(slow.position)) == np.sign(slow.voltage)
    assert np.mean(along) > 0.9
    columns = (slow.time * 1e3, slow.position * 1e3, np.abs(slow.voltage), np.sign(slow.voltage))
    record = read_log(written(tmp_path, "t_ms,pos_mm,u_V,dir\n" + rows(*columns))).record
    assert record.voltage == pytest.approx(slow.voltage, abs=1e-6)


def test_beside_both_directions_the_command_s_is_taken(tmp_path):
    content = "t_ms,pos_mm,pwm,dir,motor_dir\n" + rows(T * 1e3, Y * 1e3, np.abs(PWM), MOTION, PWM > 0, form="{:.6f}")
    assert read_log(written(tmp_path, content)).record.voltage.tolist() == PWM.tolist()


def test_minus_one_may_be_forward(tmp_path):
    content = "t_ms,pos_mm,pwm,dir\n" + rows(T * 1e3, Y * 1e3, np.abs(PWM), -np.sign(PWM))
    reading = read_log(written(tmp_path, content))
    assert reading.record.voltage.tolist() == PWM.tolist()
    assert "(-1 is forward, as command and speed agree: r = " in notes(reading)["voltage_signed"]


@pytest.mark.parametrize("is_signed", [True, False])
def test_of_an_axis_that_moves_already_no_work_tells_what_is_forward(tmp_path, is_signed):
    first = int(np.argmax(np.abs(SPEED)))
    time, position, command = T[first:], Y[first:], PWM[first:]
    direction = np.sign(command) if is_signed else np.where(command > 0, 1.0, 0.0)
    content = "t_ms,pos_mm,pwm,dir\n" + rows(time * 1e3, position * 1e3, np.abs(command), direction)
    if is_signed:
        assert read_log(written(tmp_path, content)).record.voltage.tolist() == command.tolist()
    else:
        assert "what 'dir' says of its direction is not clear" in refusal(tmp_path, content)


@pytest.mark.parametrize("says", [True, False], ids=["both ways", "one way"])
def test_a_command_of_one_sign_is_remarked_on_where_the_axis_goes_both_ways(tmp_path, says):
    position = Y if says else np.maximum.accumulate(Y)
    found = notes(read_log(written(tmp_path, "t_ms,pos_mm,pwm\n" + rows(T * 1e3, position * 1e3, np.abs(PWM)))))
    assert ("voltage_of_one_sign" in found) == says


def test_a_direction_of_travel_is_a_part_of_a_position_s_name(tmp_path):
    heads = "t [s];Weg in x-Richtung [mm];Sollweg in x-Richtung [mm];Spannung [V]\n"
    record = read_log(written(tmp_path, heads + rows(T, *SIGNALS, separator=";"))).record
    assert np.max(np.abs(record.reference - R)) < DIGITS * np.ptp(R)


# ---- units that names leave open


def test_a_duty_beyond_one_is_a_question(tmp_path):
    content = "t_ms,pos_mm,target_mm,duty\n" + rows(T * 1e3, *SIGNALS[:2], U / 6.5 * 50)
    assert refusal(tmp_path, content).endswith(
        "and 1 is full duty: per cent and counts of a PWM are plausible; say --unit voltage=% or --unit voltage=pwm"
    )
    record = read_log(written(tmp_path, content), units={"voltage": "%"}).record
    assert np.max(np.abs(record.voltage - U / 6.5 * 50)) < DIGITS * 100


def test_a_sign_at_the_end_of_a_name_is_its_unit(tmp_path):
    content = "t_ms,pos_mm,target_mm,duty_%\n" + rows(T * 1e3, *SIGNALS[:2], U / 6.5 * 50)
    record = read_log(written(tmp_path, content)).record
    assert record.command_unit == "%"
    assert np.max(np.abs(record.voltage - U / 6.5 * 50)) < DIGITS * 100


def test_rows_that_count_take_their_time_from_what_is_stated(tmp_path):
    content = "time,pos_mm,target_mm,u\n" + rows(np.arange(T.size), *SIGNALS)
    path = written(tmp_path, content)
    assert read_log(path, units={"time": "ms"}).record.sample_time == pytest.approx(1e-3)
    assert read_log(path, settings={"sample_time": "2 ms"}).record.sample_time == pytest.approx(2e-3)


def test_in_at_a_name_s_end_is_inches_or_an_input(tmp_path):
    content = "t_ms,pos_in,target_in,u_V\n" + rows(T * 1e3, Y / 0.0254, R / 0.0254, U)
    said = "column 'pos_in' may be in inches, or an input; say --unit position=in or --unit position=m"
    assert refusal(tmp_path, content) == said
    record = read_log(written(tmp_path, content), units={"position": "in"}).record
    assert np.max(np.abs(record.reference - R)) < DIGITS * np.ptp(R)


def test_a_sensor_s_voltage_needs_its_scale(tmp_path):
    assert refusal(tmp_path, READ["Siglent"][0], columns=CHANNELS) == (
        "position is in 'Volt', which is not a unit for it; a sensor's voltage needs its scale: state what one V is,"
        " e.g. --unit 'position=0.01 m'"
    )


def test_oscilloscope_is_asked_for_its_channels(tmp_path):
    said = "no column named position; the columns are 'Source, CH1, CH2, CH3' (say which column it is, e.g. --column"
    assert refusal(tmp_path, READ["Siglent"][0]).startswith(said)


def test_a_slower_signal_with_its_own_times_is_held(tmp_path):
    slow = [(f"{t:.4f}", f"{r * 1e3:.4f}") for t, r in zip(T[::10], R[::10], strict=True)]
    slow += [("", "")] * (T.size - len(slow))
    content = "Time (s),Position (mm),Time (s),Setpoint (mm)\n" + rows(T, Y * 1e3, *zip(*slow, strict=True))
    record = read_log(written(tmp_path, content), settings={"kp": 60}).record
    assert np.max(np.abs(record.reference - R[np.arange(T.size) // 10 * 10])) < DIGITS * np.ptp(R)


LABELS = READ["Arduino, labels"][0]


def test_a_line_with_other_labels_is_named(tmp_path):
    content = LABELS.replace("pos_mm:", "pos:", 5)
    said = refusal(tmp_path, content)
    assert said.startswith("line 1 reads 't_ms:0,target_mm:100.0,pos:")
    assert said.endswith("where the others hold values with the labels 't_ms, target_mm, pos_mm, volts'; leave it out")


def test_a_message_among_lines_with_labels_is_named(tmp_path):
    lines = LABELS.splitlines()
    lines[70] = "Motor stalled!"
    assert refusal(tmp_path, "\n".join(lines) + "\n").startswith(
        "line 71 reads 'Motor stalled!', where the others hold "
    )


def test_a_last_line_with_labels_that_was_cut_is_left_out(tmp_path):
    reading = read_log(written(tmp_path, LABELS.rstrip()[:-15]))
    assert reading.record.time == pytest.approx(T[:-1], abs=1e-9)
    last = LABELS.rstrip()[:-15].splitlines()[-1]
    assert notes(reading)["lines_left_out"] == f"the last line, '{last}', was left out: it does not hold all values."


@pytest.mark.parametrize("head", ["", "kp: 60\n", "kp: 60\nkd: 4\nController starting\n\n"])
def test_a_wrong_value_behind_a_label_is_named_by_its_line(tmp_path, head):
    lines = [f"t_ms: {t * 1e3:.0f}, y: {y * 1e3:.4f} mm, u: {u:.3f}" for t, y, u in zip(T, Y, U, strict=True)]
    lines[40] = "t_ms: 40, y: 3 kg, u: 3"
    place = head.count("\n") + 41
    assert refusal(tmp_path, head + "\n".join(lines) + "\n").startswith(f"line {place}, position: '3 kg' is no number")


@pytest.mark.parametrize("separator", [" ", "; ", "\t", ", "])
def test_decimal_commas_behind_labels_are_read_and_said(tmp_path, separator):
    cells = [
        texts(form, values)
        for form, values in (("t_ms: {:.0f}", T * 1e3), ("soll_mm: {:.3f}", R * 1e3), ("ist_mm: {:.6f}", Y * 1e3))
    ]
    lines = ["kp: 60,5", *(separator.join(row).replace(".", ",") for row in zip(*cells, strict=True))]
    reading = read_log(written(tmp_path, "\n".join(lines) + "\n"))
    assert reading.record.time == pytest.approx(T, abs=1e-9)
    assert reading.record.position == pytest.approx(Y, abs=1e-9)
    assert reading.record.controller.kp == 60.5
    assert notes(reading)["decimal_commas"].startswith("numbers such as 60,5 were read with a decimal comma.")


def test_what_stands_above_values_with_labels_tells_nothing_of_their_decimal_sign(tmp_path):
    whole = "".join(
        f"t_ms: {t * 1e3:.0f}, r: {r * 1e6:.0f}, y: {y * 1e6:.0f}\n" for t, r, y in zip(T, R, Y, strict=True)
    )
    reading = read_log(written(tmp_path, "Limits 5,10\nkp: 60\n" + whole), units={"position": "um", "reference": "um"})
    assert "decimal_commas" not in notes(reading)
    parts = "".join(f"t_ms: {t * 1e3:.0f} r: {r:.4f} y: {y:.9f}\n" for t, r, y in zip(T, R, Y, strict=True))
    reading = read_log(written(tmp_path, "Datum: 28.11.2026\nkp: 60\n" + parts.replace(".", ",")))
    assert "decimal_commas" in notes(reading)
    assert reading.record.position == pytest.approx(Y, abs=1e-9)


def test_commas_beside_points_behind_labels_are_no_decimals(tmp_path):
    lines = [f"t_ms: {t * 1e3:.0f} u: {u:.3f} ist_mm: {y * 1e3:.6f}" for t, u, y in zip(T, U, Y, strict=True)]
    lines[30] = lines[30].replace(".", ",")
    assert refusal(tmp_path, "\n".join(lines) + "\n").startswith("line 31 reads 't_ms: 30 u: ")


def test_settings_above_lines_with_labels_are_taken(tmp_path):
    labels = "".join(f"r_mm: {r * 1e3:.3f} y_mm: {y * 1e3:.6f}\n" for r, y in zip(R, Y, strict=True))
    for head in ("kp: 60\nkd: 4 V s/m\n", "Controller starting\nkp: 60, kd: 4\n"):
        reading = read_log(written(tmp_path, head + labels), settings={"sample_time": "1 ms"})
        assert (reading.record.controller.kp, reading.record.controller.kd) == (60, 4)
        assert reading.record.time.size == T.size


def test_labels_behind_time_stamps_are_taken_off(tmp_path):
    labels = texts("ref_mm:{:.3f}", R * 1e3), texts("pos_mm:{:.6f}", Y * 1e3), texts("volts:{:.6f}", U)
    lines = rows(texts("{} -> ", stamped("%H:%M:%S.%ms")), *labels).replace(" -> ,", " -> ")
    record = read_log(written(tmp_path, lines)).record
    assert record.time == pytest.approx(T, abs=1e-9)
    assert record.voltage == pytest.approx(U, abs=1e-6)


def test_texts_with_colons_in_some_columns_are_no_labels(tmp_path):
    content = "a,b," + MM + rows(texts("run: {:.0f}", T * 1e3), ["try: 3"] * T.size, T, *SIGNALS)
    assert read_log(written(tmp_path, content)).record.time == pytest.approx(T, abs=1e-9)


def test_time_stamps_are_no_labels(tmp_path):
    iso = stamped("%Y-%m-%dT%H:%M:%S.%ms", "2026-11-28 12:00:00.0")
    content = "stamp_header,time,position [mm],reference [mm],voltage [V]\n" + rows(iso, iso, *SIGNALS)
    assert read_log(written(tmp_path, content)).record.time == pytest.approx(T, abs=1e-9)


def test_names_with_units_among_them_are_no_row_of_units(tmp_path):
    content = "Device,PSU,4\nTime,mm,V\n" + rows(T, Y * 1e3, U)
    record = read_log(written(tmp_path, content)).record
    assert np.max(np.abs(record.position - Y)) < DIGITS * np.ptp(Y)


@pytest.mark.parametrize(
    ("name", "unit", "spoken", "answers"),
    [
        ("dac", "", "volts and counts of a PWM", "voltage=V or --unit voltage=pwm"),
        ("motor_current", "A", "A and mA", "voltage=A or --unit voltage=mA"),
        ("Act.Trq", "N m", "N m and mN m", "'voltage=N m' or --unit 'voltage=mN m'"),
    ],
)
def test_whole_numbers_of_a_command_without_a_unit_are_a_question(tmp_path, name, unit, spoken, answers):
    content = f"t_ms,pos_mm,ref_mm,{name}\n" + rows(T * 1e3, *SIGNALS[:2], np.round(U * 1e3))
    assert refusal(tmp_path, content) == (
        f"column '{name}' holds whole numbers up to {np.max(np.abs(np.round(U * 1e3))):g} and states no unit: {spoken}"
        f" are plausible; say --unit {answers}"
    )
    milli = {"voltage": f"m{unit or 'V'}"}
    assert np.max(np.abs(read_log(written(tmp_path, content), units=milli).record.voltage - U)) <= 0.5e-3 + 1e-9


def test_a_few_whole_levels_of_a_command_are_in_its_unit(tmp_path):
    content = "t_ms,pos_mm,ref_mm,current\n" + rows(T * 1e3, *SIGNALS[:2], np.round(U))
    assert read_log(written(tmp_path, content)).record.command_unit == "A"


@pytest.mark.parametrize(("factor", "asks"), [(1.0, True), (1e3, False)], ids=["metres", "millimetres"])
def test_a_reference_that_travels_otherwise_than_its_position_is_a_question(tmp_path, factor, asks):
    content = "t_ms,pos_mm,target,u_V\n" + rows(T * 1e3, Y * 1e3, R * factor, U)
    if asks:
        said = refusal(tmp_path, content)
        assert said.startswith("column 'target' travels 0.08 and states no unit, beside ")
        assert said.endswith(" mm of 'pos_mm'; say --unit reference=mm or --unit reference=m")
    options = {"units": {"reference": "m"}} if asks else {}
    record = read_log(written(tmp_path, content), **options).record
    assert np.max(np.abs(record.reference - R)) < DIGITS * np.ptp(R)


@pytest.mark.parametrize("value", [0.0, 30.0])
def test_a_reference_that_does_not_move_is_in_its_position_s_unit(tmp_path, value):
    content = "t_ms,angle [deg],target,u_V\n" + rows(T * 1e3, Y * 1e3, np.full(T.size, value), U)
    record = read_log(written(tmp_path, content)).record
    assert record.length_unit == "rad"
    assert np.degrees(record.reference) == pytest.approx(np.full(T.size, value))


def test_units_that_are_offered_are_of_the_position_s_kind(tmp_path):
    content = "t_ms,angle [deg],target,u_V\n" + rows(T * 1e3, Y * 1e3, np.radians(R * 1e3), U)
    assert refusal(tmp_path, content).endswith("say --unit reference=deg or --unit reference=rad")


def test_a_long_run_of_blanks_keeps_nobody_busy(tmp_path):
    begin = process_time()
    refusal(tmp_path, "1 a" + " " * 200_000 + "b,2\n")
    assert process_time() - begin < 5  # it took minutes where each blank was a beginning


FRAME = pd.DataFrame({"t_ms": 1e3 * T, "target": R, "pos": Y, "u": U})


def as_json(frame, orient):
    return json.dumps(json.loads(frame.to_json(orient=orient, double_precision=12)))


@pytest.mark.parametrize("orient", ["columns", "index", "records", "split", "table"])
def test_a_data_frame_written_as_json_is_read(tmp_path, orient):
    record = read_log(written(tmp_path, as_json(FRAME, orient))).record
    assert record.position == pytest.approx(Y, abs=1e-12)
    assert record.reference == pytest.approx(R, abs=1e-12)
    assert record.voltage == pytest.approx(U, abs=1e-9)


def test_the_index_of_a_data_frame_written_as_json_can_be_the_time(tmp_path):
    path = written(tmp_path, as_json(FRAME.set_index("t_ms"), "columns"))
    with pytest.raises(InputError, match="no column named time; the columns are 'index, target, pos, u'"):
        read_log(path)
    record = read_log(path, columns={"time": "index"}, units={"time": "ms"}).record
    assert record.time == pytest.approx(T, abs=1e-12)
    assert record.position == pytest.approx(Y, abs=1e-12)


@pytest.mark.parametrize(("label", "values"), [("name", "values"), ("Label", "y"), ("id", "data")])
def test_channels_with_names_and_units_of_their_own_are_read(tmp_path, label, values):
    kinds = (("t", T * 1e3, "ms"), ("target", R * 1e3, "mm"), ("pos", Y * 1e3, "mm"), ("u", U, None))
    channels = [{label: name, "unit": unit, values: list(signal)} for name, signal, unit in kinds]
    for content in ({"rate": 1000, "channels": channels}, channels):
        record = read_log(written(tmp_path, json.dumps(content))).record
        assert record.position == pytest.approx(Y, abs=1e-12)
        assert record.reference == pytest.approx(R, abs=1e-12)


@pytest.mark.parametrize("more", [{"limits": [0, 1]}, {"limits": [0, 1], "range": [2, 3]}, {"rate": 1000}])
def test_channels_may_have_short_lists_and_equal_numbers_beside_their_values(tmp_path, more):
    kinds = (("t", T * 1e3, "ms"), ("target", R * 1e3, "mm"), ("pos", Y * 1e3, "mm"), ("u", U, "V"))
    channels = [{"name": name, "unit": unit, **more, "samples": list(signal)} for name, signal, unit in kinds]
    record = read_log(written(tmp_path, json.dumps(channels))).record
    assert record.position == pytest.approx(Y, abs=1e-12)
    assert record.reference == pytest.approx(R, abs=1e-12)


def test_messages_with_a_text_and_a_list_each_are_no_channels(tmp_path):
    """Each is a row, of which the list holds one joint."""
    messages = [
        {"id": f"m{k}", "time": float(t), "position": [float(y)], "reference": float(r), "voltage": float(u)}
        for k, (t, y, r, u) in enumerate(zip(T, Y, R, U, strict=True))
    ]
    record = read_log(written(tmp_path, json.dumps(messages))).record
    assert record.position == pytest.approx(Y, abs=1e-12)
    assert record.time == pytest.approx(T - T[0], abs=1e-12)


@pytest.mark.parametrize("more", [{"time": True}, {}], ids=["numbers that differ", "names of their own"])
def test_rows_of_joints_with_a_text_each_are_no_channels(more):
    key = "values" if more else "position"
    rows = [{"name": f"run{k}", key: [1.0 * k, 2.0 * k], **dict.fromkeys(more, 0.1 * k)} for k in range(5)]
    columns = [column for table in tables_of(rows) for column in table.columns]
    assert {"run0", "run1"}.isdisjoint(column.name for column in columns)
    assert any(np.array_equal(column.values, 2.0 * np.arange(5)) for column in columns)


def test_channels_without_names_are_asked_about(tmp_path):
    content = json.dumps([{"unit": "mm", "values": list(Y)}, {"unit": "mm", "values": list(R)}])
    with pytest.raises(InputError):
        read_log(written(tmp_path, content))


@pytest.mark.parametrize(
    "content",
    [
        {"a": {"0": 1, "1": 2}},
        {"a": {"0": 1, "1": 2}, "b": {"0": 1, "2": 2}},
        {"a": {"0": [1], "1": [2]}, "b": {"0": [1], "1": [2]}},
        {"a": {"0": "x", "1": "y"}, "b": {"0": "x", "1": "y"}},
        {"a": {"nan": 1, "1": 2}, "b": {"nan": 1, "1": 2}},
        [{"name": "a", "values": [1, 2], "more": [1, 2]}, {"name": "a", "values": [1, 2]}],
        [{"name": 1, "values": [1, 2]}, {"name": "b", "values": "12"}],
    ],
)
def test_what_only_looks_like_a_table_of_json_is_refused(tmp_path, content):
    with pytest.raises(InputError):
        read_log(written(tmp_path, json.dumps(content)))


# ---- columns without names, and what only begins as JSON does


def test_a_column_without_a_name_is_offered_by_its_number(tmp_path):
    content = ",ref,pos,u\n" + rows(T, R, Y, U)
    assert refusal(tmp_path, content) == (
        "no column named time; the columns are '1, ref, pos, u' (say which by name or number, e.g. --column time=1, or"
        " for rows at even times --setting 'sample_time=1 ms')"
    )
    assert read_log(written(tmp_path, content), columns={"time": "1"}).record.time == pytest.approx(T)
    counted = ",t,ref,pos\n" + rows(np.arange(T.size), T, R, Y)
    assert "no voltage is logged and the gains are unknown" in refusal(tmp_path, counted)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            "[0 ms] pos: 0.1\n[1 ms] pos: 0.2\n",
            "is not valid JSON from line 1, column 4 on; export it again",
        ),
        ('{"name": "axis"}', "is JSON without arrays of numbers; write one for each signal, as time and position"),
    ],
    ids=["stamps in brackets", "no arrays"],
)
def test_what_only_begins_as_json_does_is_told_so(tmp_path, content, said):
    assert refusal(tmp_path, content).startswith(said)


def test_texts_among_columns_without_names_are_told_as_no_numbers(tmp_path):
    content = "".join(f"axis {t:g} {y:g}\n" for t, y in zip(T, Y, strict=True))
    assert "has no row that names its 3 columns, which begin with no number, 0, " in refusal(tmp_path, content)


# ---- what LabVIEW, Excel and Rigol write


def labview(columns, body):
    head = f"LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{columns}\n***End_of_Header***\t\n\t\nChannels\t3\n"
    head += "Y_Unit_Label\tmm\tmm\tV\nX0\t0\t0\t0\nDelta_X\t1.000000\t1.000000\t1.000000\n***End_of_Header***\n"
    return head + "X_Value\tSoll\tIst\tSpannung\tComment\n" + body


def test_times_that_labview_logs_go_before_the_step_that_it_states(tmp_path):
    body = rows(T, 1e3 * R, 1e3 * Y, U, separator="\t")
    reading = read_log(written(tmp_path, labview("One", body)))
    assert reading.record.time == pytest.approx(T, abs=1e-9)
    assert notes(reading)["sample_time_not_taken"] == (
        "the times in the column 'X_Value' are not those of the stated 'delta_x', 1 s; the column was taken."
    )
    reading = read_log(written(tmp_path, labview("One", body)), settings={"sample_time": "2 ms"})
    assert reading.record.time == pytest.approx(2 * T, abs=1e-9)


def test_a_counter_of_labview_is_no_time_and_times_that_repeat_are_refused(tmp_path):
    counter = labview("One", rows(2.0 * np.arange(T.size), 1e3 * R, 1e3 * Y, U, separator="\t"))
    reading = read_log(written(tmp_path, counter.replace("Delta_X\t1.000000", "Delta_X\t0.001000")))
    assert reading.record.time == pytest.approx(T - T[0], abs=1e-9)
    repeated = np.where(np.arange(T.size) == 50, np.roll(T, 1), T)
    content = labview("One", rows(repeated, 1e3 * R, 1e3 * Y, U, separator="\t"))
    assert "time must increase" in refusal(tmp_path, content)


def test_minutes_and_seconds_above_time_stamps_are_no_unit(tmp_path):
    cells = [f"59:{t:06.3f}" for t in T]
    content = "Zeit [mm:ss.0];Soll;Ist;U\n" + "".join(
        f"{cell};{r:g};{y:.9g};{u:.9g}\n" for cell, r, y, u in zip(cells, R, Y, U, strict=True)
    )
    assert read_log(written(tmp_path, content)).record.time == pytest.approx(T, abs=1e-9)


def test_the_position_is_asked_about_before_the_channels_of_an_oscilloscope(tmp_path):
    content = "Time(s),CH1V,CH2V\n" + rows(T, 10 * Y, U)
    assert refusal(tmp_path, content).startswith("no column named position; the columns are 'Time, CH1V, CH2V'")
