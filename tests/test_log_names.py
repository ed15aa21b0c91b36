"""Logs whose names mislead: what was taken silently for another signal or unit is read right, or asked about."""

from __future__ import annotations

import json

import numpy as np
import pytest

from servolens import lab
from servolens.campaign import read_logs, read_records
from servolens.conversion import write_campaign
from servolens.errors import InputError
from servolens.reading import read_log
from servolens.reading.words import meaning, unit_behind

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.6, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage
SPEED = np.gradient(Y, T)
TURN = 1 / (2 * np.pi)
COUNTS = np.round(Y * 4096 * TURN + 2048), np.round(R * 4096 * TURN + 2048)
START = 1_714_564_800
STAMPS = [(START + round(1e6 * t) // 10**6, round(1e6 * t) % 10**6 * 1000) for t in T]


def rows(*columns, separator=",", decimal=".", form="%.9g"):
    return "".join(
        separator.join((form % x).replace(".", decimal) for x in row) + "\n" for row in zip(*columns, strict=True)
    )


def written(folder, content, name="run.csv"):
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return path


def check(record, scale=1.0):
    assert record.time - record.time[0] == pytest.approx(T, abs=1e-9)
    for signal, truth in (("position", Y * scale), ("reference", R * scale), ("voltage", U)):
        assert np.max(np.abs(getattr(record, signal) - truth)) < 2e-3 * np.ptp(truth), signal


# ---- names


@pytest.mark.parametrize(
    ("name", "roles"),
    [
        *((name, ("voltage",)) for name in ("i_soll", "i_ist", "i_ref", "PosCtrlOut", "Lagereglerausgang", "Vq", "OP")),
        *((name, ("velocity",)) for name in ("n_ist", "w_meas", "gyro_z", "servo_stats.velocity")),
        *((name, ("velocity", "voltage")) for name in ("v_ist", "v_act")),
        *((name, ("reference",)) for name in ("Limited Position", "servo_control.position", "traj_pos", "r(t)", "SP")),
        *((name, ("position",)) for name in ("y(t)", "PV", "theta_m", "Kolbenweg [mm]", "Achsposition", "load_pos")),
        *((name, ("time",)) for name in ("u.Time", "pos.Time", "pos_timestamp", "Zeit")),
        *(
            (name, ())
            for name in ("v_ref", "v_soll", "n_soll", "M_ist [Nm]", "T_ist", "f_ist", "servo_control.velocity")
        ),
        *((name, ()) for name in ("Present_Load", "in_position", "elec_angle", "U_pot", "sensor voltage [V]")),
        *((name, ()) for name in ("loop_time", "cycle time", "Nr")),
    ],
)
def test_a_name_means_what_the_field_calls_so(name, roles):
    assert meaning(name).roles == roles


@pytest.mark.parametrize(("name", "kind"), [("angular position", "angle"), ("ang_pos", "angle"), ("pos", "position")])
def test_angles_are_in_radians(name, kind):
    assert meaning(name).kind == kind


def test_a_letter_behind_an_angle_is_no_unit():
    assert [meaning(name).unit for name in ("theta_m", "phi_m", "x_m")] == [None, None, "m"]


def test_a_function_of_time_is_no_mass():
    assert unit_behind("y(t) [mm]") == ("y", "mm", "in brackets")
    assert unit_behind("u(t)") == ("u", None, "")
    assert unit_behind("Masse (kg)")[1] == "kg"


# ---- logs that are plain


def labview(columns):
    count = {"One": 3, "Multi": 6, "No": 3}[columns]
    cells = ["mm", "mm", "Volts"] if count == 3 else ["mm", "", "mm", "", "Volts", ""]
    names = ["Position", "Setpoint", "Output"]
    names = ["X_Value", *names] if count == 3 else [cell for name in names for cell in ("X_Value", name)]
    body = {"One": (T, Y * 1e3, R * 1e3, U), "Multi": (T, Y * 1e3, T, R * 1e3, T, U), "No": (Y * 1e3, R * 1e3, U)}[
        columns
    ]
    lines = rows(*body, separator="\t").splitlines()
    return (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
        f"Multi_Headings\tYes\nX_Columns\t{columns}\nTime_Pref\tRelative\n***End_of_Header***\t\n\t\nChannels\t3\n"
        + "\t".join(["Y_Unit_Label", *cells])
        + "\nX0\t0\t0\t0\nDelta_X\t0.001\t0.001\t0.001\n***End_of_Header***\n"
        + "\t".join([*names, "Comment"])
        + "\n"
        + "".join(("\t" if columns == "No" else "") + line + "\t\n" for line in lines)
    )


def ros_lines():
    return "\n".join(
        json.dumps({"stamp": {"sec": s, "nanosec": n}, "position": y, "setpoint": r, "voltage": u})
        for (s, n), y, r, u in zip(STAMPS, Y.tolist(), R.tolist(), U.tolist(), strict=True)
    )


PLAIN = {
    "LabVIEW, one time": ("run.lvm", labview("One")),
    "LabVIEW, a time for each": ("run.lvm", labview("Multi")),
    "LabVIEW, no time": ("run.lvm", labview("No")),
    "JSON lines of ROS": ("run.jsonl", ros_lines()),
    "seconds and nanoseconds": (
        "run.csv",
        "sec,nanosec,position,setpoint,voltage\n" + rows(*np.transpose(STAMPS), Y, R, U, form="%.10g"),
    ),
    "C's clock": (
        "run.csv",
        "tv_sec,tv_usec,pos,ref,u\n" + rows(*(np.transpose(STAMPS) // [[1], [1000]]), Y, R, U, form="%.10g"),
    ),
    "moteus": (
        "run.csv",
        "timestamp,servo_stats.position,servo_control.position,servo_control.velocity,servo_stats.velocity,"
        "servo_control.torque\n" + rows(T, Y * TURN, R * TURN, 0 * T, SPEED * TURN, U),
    ),
    "moteus, with gains in SI": (
        "run.csv",
        "# kp = 60 N m/rad\n# kd = 2 N m s/rad\ntimestamp,servo_stats.position,target_position,torque_cmd [N m]\n"
        + rows(T, Y * TURN, R * TURN, U),
    ),
    "Copley": (
        "run.csv",
        "Time (ms),Limited Position (mm),Actual Motor Position (mm),Commanded Current (A)\n"
        + rows(T * 1e3, R * 1e3, Y * 1e3, U),
    ),
    "process control": ("run.csv", "Time,SP,PV,OP\n" + rows(T, R, Y, U)),
    "parts of the law": ("run.csv", "t,sp,pv,p,i,d,out\n" + rows(T, R, Y, 60 * (R - Y), 0 * T, U - 60 * (R - Y), U)),
    "a simulation beside it": ("run.csv", "t,r,y,y_model,u\n" + rows(T, R, Y, 1.1 * Y, U)),
    "time of the loop": ("run.csv", "timestamp,loop_time,pos,ref,u\n" + rows(T, 1e-3 + 1e-5 * np.sin(99 * T), Y, R, U)),
    "functions of time": ("run.csv", "t,r(t),y(t),u(t)\n" + rows(T, R, Y, U)),
    "motor angle": ("run.csv", "t,theta_m,theta_ref,u\n" + rows(T, Y, R, U)),
    "pulses": ("run.csv", "t,Feedback [pulse],Reference [pulse],u\n" + rows(T, Y * 1e6, R * 1e6, U)),
    "rotations": ("run.csv", "t,Position (rot),target_rotations,u\n" + rows(T, Y * TURN, R * TURN, U)),
    "feet": ("run.csv", "t,pos_ft,ref_ft,u\n" + rows(T, Y / 0.3048, R / 0.3048, U)),
    "a set point of the position, as ODrive calls it": ("run.csv", "t,pos,pos_setpoint,u\n" + rows(T, Y, R, U)),
    "ODrive without its axis": (
        "run.csv",
        "timestamp,pos_setpoint,pos_estimate,vel_estimate,Iq_setpoint\n" + rows(T, R * TURN, Y * TURN, SPEED * TURN, U),
    ),
    "one motor by its number": ("run.csv", "t,motor_id,pos,ref,u\n" + rows(T, 0 * T + 3, Y, R, U)),
    "a speed beside the position": ("run.csv", "t,target,velocity,angle,u\n" + rows(T, R, SPEED, Y, U)),
    "German compounds": (
        "run.csv",
        "Zeit [s];Kolbenposition [mm];Kolbensollposition [mm];Ventilspannung [V]\n"
        + rows(T, Y * 1e3, R * 1e3, U, separator=";", decimal=","),
    ),
    "German revolutions": (
        "run.csv",
        "Zeit [s];Position [Umdr.];Sollposition [Umdr.];Moment [Nm]\n"
        + rows(T, Y * TURN, R * TURN, U, separator=";", decimal=","),
    ),
}


@pytest.mark.parametrize("reference", [0.1 + 0.0 * T, R], ids=["constant", "steps"])
def test_a_reference_beside_a_position_in_millimetres_is_as_the_gains_are_where_it_looks_so(tmp_path, reference):
    head = "# kp = 60 V/m\n# kd = 2 V s/m\ntime [s],pos_mm,setpoint,voltage [V]\n"
    record = read_log(written(tmp_path, head + rows(T, Y * 1e3, reference, U))).record
    assert np.max(np.abs(record.position - Y)) < 1e-6
    assert np.max(np.abs(record.reference - reference)) < 1e-6


@pytest.mark.parametrize("form", PLAIN)
def test_a_plain_log_is_read_without_a_question(tmp_path, form):
    name, content = PLAIN[form]
    settings = {"counts_per_unit": 1e6} if form == "pulses" else None
    check(read_log(written(tmp_path, content, name), settings=settings).record)


@pytest.mark.parametrize("form", PLAIN)
def test_the_campaign_of_a_plain_log_reads_it_again(tmp_path, form):
    name, content = PLAIN[form]
    settings = {"counts_per_unit": 1e6} if form == "pulses" else None
    write_campaign(read_logs([written(tmp_path, content, name)], settings=settings), tmp_path / "runs.toml")
    (record,) = read_records(tmp_path / "runs.toml")
    check(record)


def test_the_load_of_a_servo_is_no_position(tmp_path):
    content = "timestamp,Present_Position,Goal_Position,Present_Load\n" + rows(T, *COUNTS, np.round(U * 10))
    path = written(tmp_path, content)
    with pytest.raises(InputError, match="no column is known as the command; if it is 'Present_Load', name it"):
        read_log(path, settings={"counts_per_rev": 4096})
    record = read_log(path, settings={"counts_per_rev": 4096, "kp": 60}).record
    assert record.voltage is None
    assert record.position == pytest.approx(COUNTS[0] / 4096 / TURN)


@pytest.mark.parametrize("every", [1, 5], ids=["one clock", "own clocks"])
def test_signals_of_matlab_have_times_of_their_own(tmp_path, every):
    from scipy.io import savemat

    signals = {"y": (T, Y), "r": (T[::every], R[::every]), "u": (T[::every], U[::every])}
    tree = {name: {"Time": t[:, None], "Data": values[:, None]} for name, (t, values) in signals.items()}
    savemat(tmp_path / "run.mat", tree)
    record = read_log(tmp_path / "run.mat").record
    assert record.time == pytest.approx(T)
    assert record.position == pytest.approx(Y)
    assert record.voltage == pytest.approx(np.repeat(U[::every], every)[: T.size])


def test_a_sheet_of_numbers_with_decimal_commas_is_read(tmp_path):
    """Numbers that an import has left as texts: "a workbook without a sheet of numbers"."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Zeit [s]", "Istposition [mm]", "Sollposition [mm]", "Spannung [V]"])
    for row in zip(T, Y * 1e3, R * 1e3, U, strict=True):
        book.active.append([f"{x:.6f}".replace(".", ",") for x in row])
    book.save(tmp_path / "run.xlsx")
    check(read_log(tmp_path / "run.xlsx").record)


def test_grouped_thousands_of_a_sheet_are_a_question(tmp_path):
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Zeit [s]", "Istposition [mm]", "Spannung [V]"])
    for k in range(60):
        book.active.append([f"0,{k:02d}5", f"{900 + k}" if k < 50 else f"1,{k:03d}", f"0,{k:02d}5"])
    book.save(tmp_path / "run.xlsx")
    with pytest.raises(InputError, match="'1,050' may be a whole number with separated thousands"):
        read_log(tmp_path / "run.xlsx")


# ---- logs of which two readings are plausible


def by_turns(label, *names):
    scales = (1.0, 0.4)
    lines = (
        f"{t + 3e-4 * k:.6f},{name},{y * scale + 0.2 * k:.9g},{r * scale + 0.2 * k:.9g},{u * scale:.9g}\n"
        for t, y, r, u in zip(T, Y, R, U, strict=True)
        for k, (name, scale) in enumerate(zip(names, scales, strict=True))
    )
    return f"time,{label},position,target,current\n" + "".join(lines)


ASKED = {
    "a speed loop": ("t,v_ref,v_act,u\n" + rows(T, R, Y, U), "no column named position"),
    "a speed loop, German": ("t,n_soll,n_ist,i_soll\n" + rows(T, R, Y, U), "no column named position"),
    "a gyroscope": ("t,gyro_z,ref,u\n" + rows(T, Y, R, U), "no column named position"),
    "a sensor's voltage": ("t,pos,ref,sensor_voltage\n" + rows(T, Y, R, 30 * Y + 1), "the gains are unknown"),
    "an output of the position loop": (
        "Zeit;Laser [mm];Lagereglerausgang;Sollwert [mm]\n" + rows(T, Y * 1e3, U, R * 1e3, separator=";", decimal=","),
        "no column named position",
    ),
    "amperes or milliamperes": (
        "t,pos,ref,current\n" + rows(T, Y, R, 1000.1 * U),
        "column 'current' reaches 6001.2 and states no unit: A and mA are plausible",
    ),
    "newton metres": ("t,pos,ref,torque\n" + rows(T, Y, R, 1000.1 * U), "N m and mN m are plausible"),
    "a quarter of a millisecond": (
        "t,pos,ref,u\n" + rows(T * 250, Y, R, U),
        "column 't' has steps of 0.25, which are plausible in ms (4 kHz) and in s (4 Hz); say --unit time=ms or --unit"
        " time=s",
    ),
    "minutes": (
        "t,pos,ref,u\n" + rows(T / 60, Y, R, U),
        "are plausible in min (1 kHz) and in h (16.7 Hz) and in s (60 kHz); say --unit time=min",
    ),
    "hours": (
        "Zeit,pos,ref,u\n" + rows(T / 3600, Y, R, U),
        "are plausible in h (1 kHz) and in day (41.7 Hz) and in s (3600 kHz)",
    ),
    "an axis that never moves, without a unit": (
        "t,soll,ist,u\n" + rows(T, R * 1e3, 0 * Y + 37, U),
        "column 'ist', the position, is 37 throughout; check the sensor, log a step, or name another column, e.g."
        " --column position=NAME",
    ),
    "an axis that never moves, a direction": (
        "t,pos,pwm,dir\n" + rows(T, 0 * Y, np.abs(U), U > 0),
        "column 'pos', the position, is 0 throughout; check the sensor, log a step",
    ),
    "an axis that never moves, two readings of another": (
        "t,qd,q,u\n" + rows(T, R, 0 * Y, U),
        "column 'q', the position, is 0 throughout; check the sensor, log a step",
    ),
    "a few counts": (
        "t,encoder,target,pwm\n" + rows(T, np.round(Y * 80), np.round(R * 80), U),
        "column 'encoder' travels 9 and states no unit: mm, deg, rad and counts are plausible",
    ),
    "measured or metres": (
        "t,y_m,ref,u\n" + rows(T, Y * 1e3, R * 1e3, U),
        "travels 107.3 and states no unit: mm, deg and rad are plausible",
    ),
    "angle of a motor": (
        "t,theta_m,theta_ref,u\n" + rows(T, Y * 1e3, R * 1e3, U),
        "column 'theta_m' travels 107.3 and states no unit: deg and rad are plausible",
    ),
    "rows of two axes": (by_turns("motor_id", "1", "2"), "of several axes by turns, as column 'motor_id' says"),
    "rows of two joints": (by_turns("joint", "shoulder", "elbow"), "of several axes by turns, as column 'joint' says"),
    "a set point of the speed": (
        "t,target,velocity,angle,u\n" + rows(T, 30 * R, 30 * Y, np.cumsum(0.03 * Y), U),
        "column 'target' seems to be the set point of the speed 'velocity'; say --column reference=- if the position"
        " has none, or --column reference=target",
    ),
    "a steady set point of the speed": (
        "t,setpoint,speed,pos,u\n" + rows(T, 3 + 0 * T, 3 - 3 * np.exp(-20 * T), 3 * T, U),
        "column 'setpoint' seems to be the set point of the speed 'speed'",
    ),
    "two units": (
        "t,pos_mm [m],ref_mm [m],u\n" + rows(T, Y * 1e3, R * 1e3, U),
        "column 'pos_mm [m]' has mm in its name and m as its unit; say --unit position=mm or --unit position=m",
    ),
    "perhaps ODrive's": (
        "t,pos_estimate,pos_setpoint,u\n" + rows(T, Y, R, U),
        "column 'pos_estimate' may be in revolutions, as ODrive's of that name, or in m; say --unit position=rev or",
    ),
    "two references, one of them shifted": (
        "t,target_pos,pos_setpoint,pos,u\n" + rows(T, R + 0.05, R, Y, U),
        "the reference may be one of 'target_pos', 'pos_setpoint'",
    ),
    "U_A": ("t,pos,ref,v_a\n" + rows(T, Y, R, U), "may be the armature's voltage, or a command in A"),
}


@pytest.mark.parametrize("form", ASKED)
def test_what_can_be_read_in_two_ways_is_a_question(tmp_path, form):
    content, part = ASKED[form]
    with pytest.raises(InputError) as asked:
        read_log(written(tmp_path, content))
    assert part in str(asked.value)


def test_a_unit_that_is_stated_is_no_question(tmp_path):
    content = "t [min],pos,ref,current [mA]\n" + rows(T / 60, Y, R, U * 1e3, form="%.12g")
    check(read_log(written(tmp_path, content)).record)
    check(read_log(written(tmp_path, "t,pos,ref,u\n" + rows(T * 250, Y, R, U)), units={"time": "4 ms"}).record)


@pytest.mark.parametrize("slower", [200.0, 1e-3])
def test_the_time_of_a_record_file_is_in_seconds(tmp_path, slower):
    """Its own names assume SI units; a name of other logs would be a question at such steps."""
    path = written(tmp_path, "# kp = 60\n# kd = 4\ntime,reference,position,voltage\n" + rows(T * slower, R, Y, U))
    record = read_log(path).record
    assert record.time == pytest.approx(T * slower)


LARGE = 1e3 * Y, 1e3 * R


@pytest.mark.parametrize(
    "head", ["time,setpoint,position,voltage", "t,reference,position,u", "time,reference,pos,voltage"]
)
def test_the_word_position_alone_is_no_unit(tmp_path, head):
    """It is the name of record files too, whose numbers are metres; among other names it is a word like others."""
    content = head + "\n" + rows(T, LARGE[1], LARGE[0], U)
    with pytest.raises(InputError, match="states no unit: mm, deg and rad are plausible; say --unit position=mm or"):
        read_log(written(tmp_path, content))
    answered = read_log(written(tmp_path, content), units={"position": "mm"}).record
    assert answered.position == pytest.approx(Y, abs=1e-9)
    assert answered.reference == pytest.approx(R, abs=1e-9)


def test_the_word_position_is_in_the_unit_that_its_reference_states(tmp_path):
    content = "time,setpoint [mm],position,voltage\n" + rows(T, LARGE[1], LARGE[0], U)
    assert read_log(written(tmp_path, content)).record.position == pytest.approx(Y, abs=1e-9)


def test_a_record_file_without_units_that_travels_far_is_read_in_metres_with_a_warning(tmp_path):
    content = "time,reference,position,voltage\n" + rows(T, LARGE[1], LARGE[0], U)
    record = read_log(written(tmp_path, content)).record
    assert record.position == pytest.approx(1e3 * Y)
    (warning,) = [remark for remark in record.remarks if remark.severity == "warning"]
    assert warning.code == "length_unit_assumed"
    assert "taken in m" in warning.message
    assert "--unit position=mm" in warning.message
    stated = read_log(written(tmp_path, "# kp = 0.06 V/m\n" + content)).record
    assert not [remark for remark in stated.remarks if remark.severity == "warning"]


@pytest.mark.parametrize(("head", "unit"), [("t_ms,target,pos,voltage", "V"), ("time,reference,pos,voltage", "V")])
def test_the_word_voltage_alone_is_no_unit(tmp_path, head, unit):
    """Whole numbers of many levels are as often millivolts, or counts of a PWM, as they are volts."""
    time = T * 1e3 if head.startswith("t_ms") else T
    path = written(tmp_path, head + "\n" + rows(time, R, Y, np.round(U * 1e3)))
    with pytest.raises(
        InputError, match=r"column .voltage. holds whole numbers up to .* and states no unit: volts and"
    ):
        read_log(path)
    assert np.abs(read_log(path, units={"voltage": "mV"}).record.voltage - U).max() <= 0.5e-3 + 1e-9
    assert read_log(path, units={"voltage": unit}).record.voltage == pytest.approx(np.round(U * 1e3))


def test_a_record_file_s_voltage_is_in_volts(tmp_path):
    path = written(tmp_path, "# kp = 60 V/m\ntime,reference,position,voltage\n" + rows(T, R, Y, np.round(U * 1e3)))
    assert read_log(path).record.voltage == pytest.approx(np.round(U * 1e3))


@pytest.mark.parametrize("name", ["reference", "target"])
@pytest.mark.parametrize("comment", ["", "# kp = 60 V/m\n"])
def test_a_reference_that_rests_where_the_axis_goes_is_in_its_unit(tmp_path, name, comment):
    """A step that began with the record does not travel; how far from zero it lies tells as much."""
    step = lab.step_record(lab.NLM2, 60, 4, reference=0.1, duration=0.3, noise=1e-5, seed=5)
    signals = step.time * 1e3, step.position * 1e3, 1e3 * step.reference, step.voltage
    path = written(tmp_path, f"{comment}t_ms,pos_mm,{name},u_V\n" + rows(*signals))
    assert read_log(path).record.reference == pytest.approx(step.reference)


def test_a_reference_that_rests_in_metres_beside_millimetres_stays_so(tmp_path):
    step = lab.step_record(lab.NLM2, 60, 4, reference=0.1, duration=0.3, noise=1e-5, seed=5)
    signals = step.time * 1e3, step.position * 1e3, step.reference, step.voltage
    path = written(tmp_path, "t_ms,pos_mm,reference,u_V\n" + rows(*signals))
    assert read_log(path).record.reference == pytest.approx(step.reference)


@pytest.mark.parametrize(
    ("name", "roles", "unit"),
    [
        ("axis/u", ("voltage",), None),
        ("/axis/u", ("voltage",), None),
        ("axis/t", ("time",), None),
        ("Weg/m", ("position",), "m"),
        ("Weg / mm", ("position",), "mm"),
        ("Strom/A", ("voltage",), "A"),
        ("Zeit/s", ("time",), "s"),
        ("Kraft / N", ("voltage",), "N"),
    ],
)
def test_a_letter_behind_a_slash_is_a_unit_only_if_signals_are_in_it(name, roles, unit):
    """Paths end in symbols: u is no atomic mass there, and t is no tonne."""
    assert (meaning(name).roles, meaning(name).unit) == (roles, unit)


DSPACE = (
    "descriptor,trace\nhost,rig\ntype,float,float,float,float\npath,time,Model Root/ref,Model Root/pos,Model Root/u\n"
)


@pytest.mark.parametrize(
    "head",
    [
        DSPACE + "trace_values,,,,\n",
        DSPACE.replace("path,time", "path,") + "unit,s,m,m,V\ntrace_values,,,,\n",
    ],
    ids=["names", "names and units"],
)
def test_a_mark_between_the_names_and_the_numbers_hides_no_names(tmp_path, head):
    """As dSPACE exports it: the row of paths stands above one that says that values follow."""
    content = head + "".join(f",{line}\n" for line in rows(T, R, Y, U).splitlines())
    options = {} if ",time," in head else {"columns": {"time": "2"}}
    record = read_log(written(tmp_path, content), **options).record
    assert record.position == pytest.approx(Y, abs=1e-9)
    assert record.voltage == pytest.approx(U, abs=1e-6)


def test_a_word_alone_between_the_names_and_the_numbers_hides_no_names(tmp_path):
    record = read_log(written(tmp_path, "t,ref,pos,u\nDATA\n" + rows(T, R, Y, U))).record
    assert record.position == pytest.approx(Y, abs=1e-9)


def test_thousandths_are_tenths_of_a_percent(tmp_path):
    content = "t,ref,pos,torque [‰]\n" + rows(T, R, Y, 10 * U)
    record = read_log(written(tmp_path, content)).record
    assert record.command_unit == "%"
    assert record.voltage == pytest.approx(U, abs=1e-6)


@pytest.mark.parametrize(("given", "scale"), [("position", 1e3), ("reference", 1e3), ("position", 1.0)])
def test_the_answer_for_one_length_of_a_record_file_holds_for_the_other_too(tmp_path, given, scale):
    """Where both travel alike in it; a reference that is in metres beside an answer in millimetres stays so."""
    path = written(tmp_path, "time,reference,position,voltage\n" + rows(T, scale * R, 1e3 * Y, U))
    record = read_log(path, units={given: "mm"}).record
    assert record.position == pytest.approx(Y, abs=1e-9)
    assert record.reference == pytest.approx(R, abs=1e-9)
    assert not [remark for remark in record.remarks if remark.severity == "warning"]
