"""Logs as loggers, spreadsheets and German programs write them: commands, numbers, clocks, and columns of one name."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.campaign import read_records
from servolens.cli import group
from servolens.errors import InputError
from servolens.reading import read_log, read_record, record_from_dataframe, record_from_timeresponse
from servolens.reading.lines import unified
from servolens.reading.reference_file import read_reference_file
from servolens.reading.words import meaning
from servolens.record import Controller

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.6, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage
GAINS = {"kp": "60 V/m", "kd": "4 V s/m"}


def log(path, heads, *columns, separator=",", form="{:.12g}"):
    """Write columns below their heads; texts stand as they are."""
    rows = (
        separator.join(x if isinstance(x, str) else form.format(x) for x in row) for row in zip(*columns, strict=True)
    )
    path.write_text(separator.join(heads) + "\n" + "\n".join(rows) + "\n")
    return path


def convert(path, *options):
    return CliRunner().invoke(group, ["convert", str(path), "--out", str(path.with_suffix(".toml")), *options])


def refusal(path, **options):
    with pytest.raises(InputError) as refused:
        read_log(path, **options)
    return str(refused.value).removeprefix(f"{path}: ")


def evidence(reading, quantity):
    return next(guess for guess in reading.guesses if guess.quantity == quantity)


# ---- commands


@pytest.mark.parametrize(
    "name",
    [
        "Stellspannung",
        "Ankerspannung",
        "Klemmenspannung",
        "Führungsspannung",
        "Umotor",
        "Umotor [V]",
        "UMotor",
        "Ua",
        "UA [V]",
    ],
)
def test_a_voltage_of_the_motor_is_the_command(tmp_path, name):
    reading = read_log(log(tmp_path / "a.csv", ("t", "Soll", "Ist", name), T, R, Y, U))
    assert np.array_equal(reading.record.voltage, read_record(tmp_path / "a.csv", columns={"voltage": "4"}).voltage)
    assert evidence(reading, "kp").value == "60 V/m"


@pytest.mark.parametrize(
    "name",
    [
        *("Versorgungsspannung", "Zwischenkreisspannung", "Betriebsspannung", "Netzspannung", "Batteriespannung"),
        *("Busspannung", "Bordnetzspannung", "Speisespannung", "supply_voltage", "Riemenspannung", "Vorspannung"),
    ],
)
def test_the_voltage_of_a_supply_or_a_tension_is_not_the_command(tmp_path, name):
    path = log(tmp_path / "a.csv", ("t", "Soll", "Ist", name), T, R, Y, U)
    assert meaning(name).roles == ()
    assert read_record(path, settings=GAINS).voltage is None


SENSED = (
    *("Potispannung", "Referenzspannung", "Seilspannung", "Gurtspannung", "Kettenspannung", "Bandspannung"),
    *("Feldspannung", "Logikspannung", "Biegespannung", "Tachospannung"),
)


@pytest.mark.parametrize("name", SENSED)
@pytest.mark.parametrize("command", ["Stellgroesse", "Spannung", "Strom [A]", "iq"])
def test_the_voltage_of_a_sensor_or_a_tension_is_never_preferred_to_a_command(tmp_path, name, command):
    path = log(tmp_path / "a.csv", ("t", "Soll", "Ist", name, command), T, R, Y, Y * 50 + 2, U)
    reading = read_log(path)
    assert reading.columns["voltage"] == command.removesuffix(" [A]")
    assert np.array_equal(reading.record.voltage, read_record(path, columns={"voltage": "5"}).voltage)


def test_the_voltage_of_a_sensor_is_asked_about_where_nothing_else_may_be_the_command(tmp_path):
    path = log(tmp_path / "a.csv", ("t", "Soll", "Ist", "Potispannung"), T, R, Y, Y * 50 + 2)
    assert "if it is 'Potispannung', name it" in refusal(path)
    assert read_record(path, settings=GAINS).voltage is None


def test_a_column_in_volts_that_no_word_tells_is_asked_about_where_the_gains_are_unknown(tmp_path):
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "Drive [V]", "n"), T, R, Y, U, T)
    assert refusal(path) == (
        "the gains are unknown and no column is known as the command; if it is 'Drive' (in volts), name it, e.g."
        " --column voltage=Drive, else give kp and kd (on the command line --record-kp and --record-kd)"
    )
    assert convert(path, "--column", "voltage=Drive").exit_code == 0
    assert read_records(path.with_suffix(".toml"))[0].voltage == pytest.approx(U)


def test_a_column_in_volts_beside_stated_gains_is_a_remark(tmp_path):
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "Drive [V]"), T, R, Y, U)
    (remark,) = read_record(path, settings=GAINS).remarks
    assert (remark.code, remark.severity) == ("command_not_known", "note")
    assert "if it is 'Drive' (in volts), name it, e.g. --column voltage=Drive." in remark.message
    assert read_record(path, settings=GAINS, columns={"voltage": "-"}).remarks == ()


def test_the_columns_that_are_left_are_named_where_neither_gains_nor_command_are_known(tmp_path):
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "mv"), T, R, Y, U)
    assert "if it is 'mv', name it, e.g. --column voltage=mv, else give kp and kd" in refusal(path)
    path = log(tmp_path / "b.csv", ("time", "reference", "position", "foo", "bar"), T, R, Y, U, -U)
    assert "if it is one of 'foo', 'bar', name it, e.g. --column voltage=foo, else" in refusal(path)


def test_only_what_may_be_a_command_is_offered_as_one(tmp_path):
    rows = {"still": T * 0, "switch": ["on" if t < 0.5 else "off" for t in T], "hot [K]": U, "place [mm]": U}
    path = log(tmp_path / "a.csv", ("time", "reference", "position", *rows), T, R, Y, *rows.values())
    assert refusal(path).startswith("no voltage is logged and the gains are unknown; give kp and kd")
    path = log(tmp_path / "a.csv", ("time", "reference", "position", *rows, "foo"), T, R, Y, *rows.values(), U)
    assert "if it is 'foo', name it" in refusal(path)
    assert refusal(path, settings={"ki": "1"}) == "ki is given without kp; give both"


def test_a_name_that_is_the_armature_s_voltage_or_a_command_in_amperes_is_a_question(tmp_path):
    path = log(tmp_path / "a.csv", ("t", "Soll", "Ist", "U_A"), T, R, Y, U)
    assert refusal(path) == (
        "column 'U_A' may be the armature's voltage, or a command in A; say --unit voltage=V or --unit voltage=A"
    )
    assert read_record(path, units={"voltage": "V"}).command_unit == "V"
    assert read_record(path, units={"voltage": "A"}).command_unit == "A"
    path = log(tmp_path / "b.csv", ("t", "Soll", "Ist", "axis.U_A"), T, R, Y, U)
    for columns in ({"voltage": "axis.U_A"}, None):
        assert "'axis.U_A' may be the armature's voltage, or a command in A" in refusal(path, columns=columns)
    assert read_record(path, columns={"voltage": "4"}, units={"voltage": "V"}).command_unit == "V"
    path = log(tmp_path / "c.csv", ("t", "Soll", "Ist", "U_A [V]"), T, R, Y, U)
    assert read_record(path, columns={"voltage": "U_A"}).command_unit == "V"


# ---- positions and their references


@pytest.mark.parametrize(
    ("reference", "position", "unit"),
    [
        ("theta_des", "theta", "rad"),
        ("thetades", "theta", "rad"),
        ("phisoll", "phi", "rad"),
        ("x_des", "x", "m"),
        ("xref", "x", "m"),
        ("x_ref", "x", "m"),
        ("q_des", "q", "m"),
        ("des_y", "y", "m"),
    ],
)
def test_what_is_asked_of_a_symbol_is_its_reference(tmp_path, reference, position, unit):
    reading = read_log(log(tmp_path / "a.csv", ("t", reference, position, "u"), T, R, Y, U))
    assert reading.columns["reference"] == reference
    assert reading.columns["position"] == position
    assert reading.record.length_unit == unit


def test_d_behind_a_symbol_is_what_is_asked_of_it_or_its_derivative():
    for name in ("q_d", "theta_d", "x_d", "y_d", "xd", "yd"):
        assert meaning(name).roles == ("reference", "velocity")


@pytest.mark.parametrize("name", ["x_d", "xd"])
def test_d_behind_x_is_the_velocity_or_the_desired_position_by_the_numbers(tmp_path, name):
    path = log(tmp_path / "a.csv", ("t", "x", name, "u"), T, Y, np.gradient(Y, T), U)
    assert read_log(path).columns == {"time": "t", "position": "x", "voltage": "u", "velocity": name}
    path = log(tmp_path / "a.csv", ("t", "x", name, "u"), T, Y, np.full(T.size, 0.1), U)
    assert read_log(path).columns == {"time": "t", "position": "x", "voltage": "u", "reference": name}
    path = log(tmp_path / "a.csv", ("t", "x", name, "u"), T, Y, T * 0, U)
    assert f"column '{name}' may be reference or velocity" in refusal(path)


def test_the_german_article_asks_for_nothing():
    assert meaning("Lage des Wagens").roles == ("position",)


def test_a_position_named_by_the_user_keeps_what_its_own_name_says(tmp_path):
    path = log(tmp_path / "a.csv", ("t", "theta1", "theta2", "u"), T, Y, Y**2, U)
    reading = read_log(path, columns={"position": "theta1"})
    assert reading.record.length_unit == "rad"
    assert evidence(reading, "position").evidence.startswith("named by you; rad is assumed")


# ---- columns that share a name


def test_columns_of_one_name_are_told_by_their_numbers(tmp_path):
    path = log(tmp_path / "a.csv", ("time [s]", "Value [m]", "Value [m]", "Value [V]"), T, R, Y, U)
    assert refusal(path) == (
        "no column named position; the columns are 'time, 2 (Value), 3 (Value), 4 (Value)' (say which by name or"
        " number, e.g. --column position=2)"
    )
    assert refusal(path, columns={"position": "Value"}) == (
        "3 columns are named 'Value'; say which, e.g. --column position=2 or --column position=3 or --column position=4"
    )
    asked = refusal(path, columns={"position": "3", "reference": "2"})
    assert "if it is '4 (Value)' (in volts), name it, e.g. --column voltage=4" in asked


@pytest.mark.parametrize(
    "answer",
    [
        ["--columns", "time,reference,position,voltage"],
        ["--column", "position=3", "--column", "reference=2", "--column", "voltage=4"],
    ],
    ids=["order", "numbers"],
)
def test_a_campaign_holds_the_numbers_of_columns_that_share_a_name(tmp_path, answer):
    path = log(tmp_path / "a.csv", ("time [s]", "Value [m]", "Value [m]", "Value [V]"), T, R, Y, U)
    done = convert(path, *answer)
    assert done.exit_code == 0, done.output
    assert "3 (Value)" in done.output
    (record,) = read_records(path.with_suffix(".toml"))
    for values, truth in ((record.position, Y), (record.reference, R), (record.voltage, U)):
        assert values == pytest.approx(truth)


def test_a_number_that_is_another_column_s_name_is_no_address(tmp_path):
    path = log(tmp_path / "a.csv", ("time", "2", "Value", "Value"), T, R, Y, U)
    assert "3 (Value), 4 (Value)" in refusal(path)
    assert read_log(path, columns={"position": "3", "reference": "2", "voltage": "4"}).columns["position"] == "3"
    assert "'3, 2, Value, 4 (Value)'" in refusal(log(tmp_path / "b.csv", ("3", "2", "Value", "Value"), T, R, Y, U))


# ---- clocks


def test_a_time_named_by_the_user_keeps_the_unit_in_its_name(tmp_path):
    path = log(tmp_path / "a.csv", ("time_min", "reference", "position", "voltage"), T / 60, R, Y, U)
    for columns in ({"time": "time_min"}, None):
        assert read_record(path, columns=columns).time == pytest.approx(T)
    assert meaning("pos_min").roles == ()


@pytest.mark.parametrize("start", [45717.5, 739000.25], ids=["spreadsheet", "matlab"])
def test_dates_in_days_are_no_seconds(tmp_path, start):
    days = [f"{start + t / 86400:.12f}" for t in T]
    reading = read_log(log(tmp_path / "a.csv", ("Zeit", "Soll", "Ist", "u"), days, R, Y, U))
    assert reading.record.time == pytest.approx(T, abs=2e-5)
    assert evidence(reading, "time").value == "day"
    assert "values that are dates in days" in evidence(reading, "time").evidence


@pytest.mark.parametrize("interval", [0.2, 0.5])
def test_slow_dates_in_days_are_no_seconds(tmp_path, interval):
    days = [f"{45717.5 + k * interval / 86400:.9f}" for k in range(T.size)]
    record = read_record(log(tmp_path / "a.csv", ("Zeit", "Soll", "Ist", "u"), days, R, Y, U))
    assert record.time == pytest.approx(interval * np.arange(T.size), abs=1e-4)


def test_short_steps_from_zero_are_seconds(tmp_path):
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "voltage"), T * 1e-3, R, Y, U)
    assert read_record(path).time == pytest.approx(T * 1e-3)


@pytest.mark.parametrize(
    ("head", "period", "start", "factor"),
    [
        ("micros", 2**32, 2**32 - 200_000, 1e6),
        ("t_us", 2**16, 65_000, 1e6),
        ("millis", 2**16, 65_300, 1e3),
        ("t_s", 86400, 86399.5, 1.0),
    ],
)
def test_a_counter_that_begins_again_is_counted_on(tmp_path, head, period, start, factor):
    ticks = (start + np.round(T * factor, 6)) % period
    record = read_record(log(tmp_path / "a.csv", (head, "reference", "position", "voltage"), ticks, R, Y, U))
    assert record.time - record.time[0] == pytest.approx(T, abs=1e-8)
    (remark,) = (remark for remark in record.remarks if remark.code == "clock_wrapped")
    assert f"fall back by {period} at sample" in remark.message


def test_a_clock_goes_on_past_midnight(tmp_path):
    seconds = (86399.4 + T) % 86400
    stamps = [f"{int(s // 3600):02d}:{int(s // 60 % 60):02d}:{s % 60:06.3f}" for s in np.round(seconds, 3)]
    record = read_record(log(tmp_path / "a.txt", ("Time", "ref", "pos", "u"), stamps, R, Y, U, separator="\t"))
    assert record.time == pytest.approx(T, abs=1e-6)
    assert "as a clock does at midnight" in record.remarks[0].message


@pytest.mark.parametrize("fall", [0.3, 65.0, 65.536 + 0.01], ids=["any", "nearly", "far"])
def test_a_clock_that_falls_back_otherwise_is_refused(tmp_path, fall):
    time = np.where(T < 0.4, 100 + T, 100 + T - fall) * 1e3
    path = log(tmp_path / "a.csv", ("millis", "reference", "position", "voltage"), np.round(time), R, Y, U)
    assert refusal(path).startswith("time must increase; sample 400 ")


@pytest.mark.parametrize("where", ["caller", "file"])
def test_a_stated_sample_time_is_said_to_be_stated(tmp_path, where):
    path = log(tmp_path / "a.csv", ("millis", "reference", "position", "voltage"), np.floor(T * 500), R, Y, U)
    settings = {"sample_time": "1 ms"} if where == "caller" else None
    if where == "file":
        path.write_text("# sample_time = 1 ms\n" + path.read_text())
    guess = evidence(read_log(path, settings=settings), "time")
    by = "by you" if where == "caller" else "by the file"
    assert (guess.source, guess.value, guess.evidence, guess.is_stated) == ("stated", "1 ms", by, True)


LVM = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t.
X_Columns\tNo
***End_of_Header***\t
\t
Channels\t3\t\t\t
Samples\t5\t5\t5\t
X_Dimension\tTime\tTime\tTime\t
X0\t0.5\t0.5\t0.5\t
Delta_X\t0.001000\t0.001000\t0.001000\t
***End_of_Header***\t\t\t\t
X_Value\tSetpoint\tPosition\tVoltage\tComment
"""


@pytest.mark.parametrize("end", ["", "\t"], ids=["bare", "comment"])
def test_labview_without_times_is_read_by_its_header(tmp_path, end):
    path = tmp_path / "a.lvm"
    path.write_text(LVM + "".join(f"\t{r:.6f}\t{y:.6f}\t{u:.6f}{end}\n" for r, y, u in zip(R, Y, U, strict=True)))
    reading = read_log(path)
    assert reading.record.time == pytest.approx(0.5 + T)
    assert reading.record.position == pytest.approx(Y, abs=1e-6)
    assert evidence(reading, "time").source == "delta_x"


# ---- cells


@pytest.mark.parametrize(("on", "off"), [("True", "False"), ("true", "false"), ("TRUE", "FALSE"), ("on", "off")])
def test_words_for_on_and_off_are_read(tmp_path, on, off):
    enabled = [on if t < 0.5 else off for t in T]
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "voltage", "enable"), T, R, Y, U, enabled)
    assert np.array_equal(read_record(path).enabled, T < 0.5)
    path.write_text(path.read_text() + f"{T[-1] + 1},0,0,0,maybe\n")
    assert f"line {T.size + 2}, enabled: 'maybe' is neither on nor off" in refusal(path)


def test_zeros_and_ones_may_stand_among_switches(tmp_path):
    enabled = [("1", "on", "True")[k % 3] if t < 0.5 else ("off", "0")[k % 2] for k, t in enumerate(T)]
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "voltage", "enabled"), T, R, Y, U, enabled)
    assert np.array_equal(read_record(path).enabled, T < 0.5)


@pytest.mark.parametrize("signal", ["reference", "position", "voltage"])
@pytest.mark.parametrize("cells", ["all", "first", "late"])
def test_switches_are_no_numbers(tmp_path, signal, cells):
    columns = {"time": list(T), "reference": list(R), "position": list(Y), "voltage": list(U)}
    if cells == "all":
        columns[signal] = ["on" if t < 0.5 else "off" for t in T]
    else:
        columns[signal][{"first": 0, "late": 9}[cells]] = "on"
    said = f"line {11 if cells == 'late' else 2}, {signal}: 'on' is not a number; fill or leave out such rows"
    assert refusal(log(tmp_path / "a.csv", tuple(columns), *columns.values())) == said


def test_switches_of_a_workbook_are_no_voltage(tmp_path):
    pytest.importorskip("python_calamine")
    pd.DataFrame({"time": T, "reference": R, "position": Y, "voltage": T < 0.5}).to_excel(
        tmp_path / "a.xlsx", index=False
    )
    assert "row 2, voltage: 'True' is not a number" in refusal(tmp_path / "a.xlsx")


def test_switches_are_no_reference(tmp_path):
    path = tmp_path / "reference.csv"
    path.write_text("time,reference\n0,0\n0.1,on\n" + "".join(f"{k},1\n" for k in range(1, 30)))
    with pytest.raises(InputError, match="line 3, reference: 'on' is not a number"):
        read_reference_file(path)


def test_switches_of_a_workbook_are_read(tmp_path):
    pytest.importorskip("python_calamine")
    columns = {"time": T, "reference": R, "position": Y, "voltage": U, "enabled": T < 0.5}
    pd.DataFrame(columns).to_excel(tmp_path / "a.xlsx", index=False)
    assert np.array_equal(read_record(tmp_path / "a.xlsx").enabled, T < 0.5)


def german(value):
    return f"{value:,.1f}".translate(str.maketrans(",.", ".,"))


@pytest.mark.parametrize(
    ("separator", "form"),
    [(";", german), (";", "{:,.1f}".format), ("\t", german), (",", lambda x: f'"{x:,.1f}"'), ("\t", "{:,.1f}".format)],
    ids=["German", "US", "German tabs", "US quoted", "US tabs"],
)
def test_separated_thousands_are_read_where_a_number_shows_both_signs(tmp_path, separator, form):
    heads = ("Time [ms]", "target [um]", "actual [um]", "u [mV]")
    columns = [[form(x) for x in values] for values in (T * 1e3, R * 1e6, Y * 1e6, U * 1e3)]
    record = read_record(log(tmp_path / "a.csv", heads, *columns, separator=separator))
    assert record.time == pytest.approx(T)
    assert record.position == pytest.approx(Y, abs=1e-7)
    assert record.voltage == pytest.approx(U, abs=1e-4)


def test_whole_numbers_with_separated_thousands_are_read_where_others_show_both_signs(tmp_path):
    heads = ("Zeit [ms]", "Soll [um]", "Ist [um]", "u [mV]")
    columns = [
        [f"{t * 1e3:,.0f}".replace(",", ".") for t in T],
        *([german(x) for x in v] for v in (R * 1e6, Y * 1e6, U)),
    ]
    assert read_record(log(tmp_path / "a.csv", heads, *columns, separator=";")).time == pytest.approx(T)


def test_points_that_may_separate_thousands_are_refused(tmp_path):
    whole = [f"{y * 1e6:,.0f}".replace(",", ".") for y in Y]
    path = log(
        tmp_path / "a.csv", ("Zeit [ms]", "Ist [um]", "u [mV]"), np.arange(T.size) % 1000, whole, whole, separator=";"
    )
    said = refusal(path)
    assert "may be a whole number with separated thousands, as may all numbers with a '.' here" in said
    assert said.endswith("write all numbers with one decimal sign and without separators of thousands")


@pytest.mark.parametrize("sign", [".", ","])
def test_a_column_that_always_shows_three_decimals_is_no_question(tmp_path, sign):
    shown = [f"{100 + 1000 * y:.3f}".replace(".", sign) for y in Y]
    heads = ("time_ms", "pos_mm", "pwm")
    duty = [f"{round(20 * u)}" for u in U]
    rows = [column[:900] for column in (np.arange(T.size), shown, duty)]
    record = read_record(log(tmp_path / "a.csv", heads, *rows, separator=";"))
    assert record.position == pytest.approx(0.1 + Y[:900], abs=1e-6)


@pytest.mark.parametrize("line", ["Masse 1.234,5 g", "Impulse je Meter: 1,234.5", "Masse;1.234,5", "Version 1.5"])
@pytest.mark.parametrize("sign", [".", ","])
def test_a_number_above_the_head_does_not_decide_how_the_rows_are_read(tmp_path, line, sign):
    shown = [[f"{x:.6f}".replace(".", sign) for x in column] for column in (T, R, Y, U)]
    path = log(tmp_path / "a.csv", ("time", "reference", "position", "voltage"), *shown, separator=";")
    path.write_text(f"{line}\n{path.read_text()}")
    assert read_record(path).position == pytest.approx(Y, abs=1e-6)


@pytest.mark.parametrize("separator", ["\t", " ", ";"])
@pytest.mark.parametrize("above", ["Anlage,Kran,Halle,Mai", "Zeit,Soll,Ist,Spannung", "Zeit,Soll"])
def test_a_line_with_commas_above_does_not_make_decimal_commas_separators(tmp_path, separator, above):
    shown = [[f"{x:.6f}".replace(".", ",") for x in column] for column in (T, R, Y, U)]
    path = log(tmp_path / "a.csv", shown[0][:1], *shown, separator=separator)
    path.write_text(above + path.read_text()[8:])
    columns = {"time": "1", "reference": "2", "position": "3", "voltage": "4"}
    assert read_record(path, columns=columns).position == pytest.approx(Y, abs=1e-6)


def test_commas_beside_points_are_refused_by_a_true_sentence(tmp_path):
    seconds = [f"{t:.3f}".replace(".", ",") for t in T]
    path = log(tmp_path / "a.csv", ("Zeit [s]", "Soll [m]", "Ist [m]", "Spannung [V]"), seconds, R, Y, U, separator=";")
    assert refusal(path) == (
        "line 2, time: '0,000' has a comma where other numbers have points; write all numbers with one decimal sign and"
        " without separators of thousands"
    )


@pytest.mark.parametrize("sign", ["'", "\u2019", "\u00a0", "\u202f", "\u2009"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_thousands_behind_apostrophes_and_hard_spaces_are_read(tmp_path, sign, decimal):
    """As Switzerland, France and SI write them; neither is ever a decimal sign."""
    times, places = np.arange(1200) * 0.5, 2000 * np.sin(np.arange(1200) / 100)
    cells = [f"{place:,.3f}".replace(",", "S").replace(".", decimal).replace("S", sign) for place in places]
    clock = [f"{time:.1f}".replace(".", decimal) for time in times]
    path = log(tmp_path / "a.csv", ("time [ms]", "position [um]", "voltage [V]"), clock, cells, clock, separator=";")
    record = read_record(path)
    assert record.position == pytest.approx(places * 1e-6, abs=1e-9)
    assert record.time == pytest.approx(times * 1e-3)


@pytest.mark.parametrize("sign", ["\u00a0", "\u202f", "\u2009"])
@pytest.mark.parametrize("form", ["{:.3f}", "{:.0f}"], ids=["decimals", "whole numbers"])
def test_hard_spaces_between_cells_join_no_numbers(tmp_path, sign, form):
    """Nor do the names above whole numbers of three digits, which might be thousands by themselves."""
    times = np.arange(100, 900)
    clock = [form.format(time / 1000.0 if "3" in form else time) for time in times]
    places = [f"{100 + (time // 10) % 800}" for time in times]
    heads = ("time", "position", "voltage") if "3" in form else ("time[ms]", "position[mm]", "voltage[V]")
    record = read_record(log(tmp_path / "a.csv", heads, clock, places, places, separator=sign))
    scale = 1.0 if "3" in form else 1e-3
    assert record.time == pytest.approx(times * 1e-3)
    assert record.position == pytest.approx(scale * np.array(places, dtype=float))


@pytest.mark.parametrize("text", ["'1'234'", "0.5\u00a0100", "0,5\u00a0100", "1234\u00a0567", "0'123", "1'234'56"])
def test_what_cannot_be_thousands_is_left_as_it_is(text):
    assert unified(text.encode()).decode() == text


def test_a_typographic_minus_is_a_minus(tmp_path):
    path = tmp_path / "a.csv"
    log(path, ("time", "reference", "position", "voltage"), T, R, Y, U)
    plain = read_record(path, kp=60)
    text = path.read_text()
    assert "-" in text
    path.write_text(text.replace("-", "\N{MINUS SIGN}"), encoding="utf-8")
    found = read_record(path, kp=60)
    np.testing.assert_array_equal(found.voltage, plain.voltage)
    np.testing.assert_array_equal(found.position, plain.position)


def test_a_velocity_with_a_gap_can_be_left_out(tmp_path):
    path = log(
        tmp_path / "a.csv", ("time", "reference", "position", "voltage", "vel [m/s]"), T, R, Y, U, ["nan", *T[1:]]
    )
    assert refusal(path).endswith("fill or leave out such rows, or do without that column: --column velocity=-")
    assert read_record(path, columns={"velocity": "-"}).velocity is None


def test_gains_are_keywords_of_every_reader(tmp_path):
    path = tmp_path / "run.csv"
    rows = "".join(f"{0.001 * k:.3f},0.1,{0.0001 * k:.4f},{6 - 0.006 * k:.3f}\n" for k in range(50))
    path.write_text(f"time [s],reference [m],position [m],voltage [V]\n{rows}")
    assert read_record(path, kp=60, kd="0.5 V s/m").controller == Controller(kp=60.0, kd=0.5)
    assert [one.controller for one in read_records(path, kp="0.06 V/mm")] == [Controller(kp=60.0)]
    with pytest.raises(InputError, match="no setting is named 'kpp'; did you mean 'kp'"):
        read_record(path, kpp=60)
    frame = pd.read_csv(path)
    assert record_from_dataframe(frame, kp=60, kd="0.5 V s/m").controller == Controller(kp=60.0, kd=0.5)
    response = SimpleNamespace(
        time=frame["time [s]"], outputs=frame["position [m]"], inputs=frame["reference [m]"], output_labels=["y"]
    )
    assert record_from_timeresponse(response, kp=60).controller == Controller(kp=60.0)
    for read, source in ((record_from_dataframe, frame), (record_from_timeresponse, response)):
        with pytest.raises(InputError, match="no setting is named 'kpp'; did you mean 'kp'"):
            read(source, kpp=60)
