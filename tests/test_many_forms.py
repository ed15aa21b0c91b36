"""Logs in the forms that programs and drives write: each is read as the laboratory made it, or asked about."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.campaign import read_records
from servolens.cli import group
from servolens.errors import InputError
from servolens.reading import files, isolated, read_log

TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=(0.1, 0.02, 0.07), duration=0.6, noise=1e-5, seed=5)
T, Y, R, U = TRUTH.time, TRUTH.position, TRUTH.reference, TRUTH.voltage
DEG = np.degrees(1.0)
NS = 1_700_000_000_000_000_000


def lines(*columns, separator=",", decimal=".", form="{:.9g}"):
    rows = zip(*columns, strict=True)
    text = "\n".join(separator.join(form.format(x).replace(".", decimal) for x in row) for row in rows)
    return text + "\n"


def text(content, encoding="utf-8"):
    return lambda path: path.write_bytes(content.encode(encoding))


def lvm():
    head = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t,\n"
        "Multi_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\nOperator\tm\nDate\t2024/05/01\nTime\t12:00:00,1\n"
        "***End_of_Header***\t\n\t\nChannels\t3\t\t\t\t\n"
        f"Samples\t{T.size}\t{T.size}\t{T.size}\t\nDate\t2024/05/01\t2024/05/01\t2024/05/01\t\n"
        "Time\t12:00:00,1\t12:00:00,1\t12:00:00,1\t\nX_Dimension\tTime\tTime\tTime\t\nX0\t0\t0\t0\t\n"
        "Delta_X\t0,001\t0,001\t0,001\t\n***End_of_Header***\t\t\t\t\n"
        "X_Value\tPosition (mm)\tSetpoint (mm)\tVoltage (V)\tComment\n"
    )
    return head + lines(T, Y * 1e3, R * 1e3, U, separator="\t", decimal=",").replace("\n", "\t\n")


def scope(*, every_channel=True, symbols=("", "", ""), units=("mm", "mm", "V"), filetime=False, separator="\t"):
    """TwinCAT Scope: header rows that begin with what they tell, a time line for each channel or one for all."""
    names = ("ActPos", "SetPos", "DriveVoltage")
    start = 132_959_733_843_760_000

    def row(label, values):
        cells = [part for value in values for part in (label, value)] if every_channel else [label, *values]
        return separator.join(str(cell) for cell in cells) + "\n"

    head = (
        f"Name{separator}YT Scope Project\nFile{separator}C:\\run.tcscopex\n"
        f"Starttime of export{separator}{start}{separator}Montag, 2. Mai 2022{separator}15:56:24.376\n"
        f"Endtime of export{separator}{start + 18_000_000}{separator}Montag, 2. Mai 2022{separator}15:56:26.176\n\n\n"
        + row("Name", names)
        + row("SymbolComment", ("", "", ""))
        + row("Data-Type", ("REAL64",) * 3)
        + row("SampleTime[ms]", (1, 1, 1))
        + row("VariableSize", (8, 8, 8))
        + row("SymbolBased", ("True",) * 3)
        + row("IndexGroup", (16448,) * 3)
        + (row("SymbolName", symbols) if any(symbols) else "")
        + row("NetID", ("192.168.178.20.1.1",) * 3)
        + row("Port", (501,) * 3)
        + row("Offset", (0, 0, 0))
        + row("ScaleFactor", (1, 1, 1))
        + row("BitMask", ("0xffffffffffffffff",) * 3)
        + row("Unit", units)
        + row("Unit ScaleFactor", (1, 1, 1))
        + row("Unit Offset", (0, 0, 0))
        + "\n"
    )
    decimal = "," if separator == "\t" and not filetime else "."
    times = [f"{start + round(t * 1e7)}" if filetime else f"{t * 1e3:.9g}".replace(".", decimal) for t in T]
    lines_ = []
    for time, *values in zip(times, Y * 1e3, R * 1e3, U, strict=True):
        cells = [f"{value:.9g}".replace(".", decimal) for value in values]
        lines_.append(
            separator.join(part for cell in cells for part in (time, cell))
            if every_channel
            else separator.join([time, *cells])
        )
    return head + "\n".join(lines_) + "\nEOF\n"


AXIS = ("Axes.Axis 1.ToPlc.ActPos", "Axes.Axis 1.ToPlc.SetPos", "MAIN.fCmd")
KINDS_OF_UNITS = ("mm (Length)", "mm (Length)", "V (Voltage)")


PLC = ("PLC_PRG.lrActPos", "PLC_PRG.lrSetPos", "PLC_PRG.lrVoltage")


def codesys_csv(*, flags=16, ticks=1e3, values=(Y, R, U), stamps=(T, T, T), more=""):
    """CODESYS V3, ``.trace.csv``: settings of the trace, then each variable with its settings and its samples."""
    head = (
        "[key]; [value]\nVersion; 0x03050000\nName; Application.Trace\nApplicationName; Application\n"
        "ApplicationDataGuid; 00000000-0000-0000-0000-000000000000\nIecTaskName; MainTask\nComment; \n"
        "Trigger.Flags; 0\nCondition.Name; \nCondition.AddrFlags; 0x00000000\nCondition.Class; 0\n"
        f"Condition.Size; 0\nEveryNCycles; 1\nBufferEntries; 1000\nFlags; {flags}\n"
    )
    for k, (name, time, column) in enumerate(zip(PLC, stamps, values, strict=True)):
        head += (
            f"{k}.Variable; {name}\n{k}.Address.AddrFlags; 0x00000000\n{k}.Class; 15\n{k}.Size; 8\n"
            f"{k}.GraphColor; 4292519200\n{k}.GraphType; 1\n{k}.ActivateMinWarning; 0\n{k}.YAxis; 0\n{k}.Data; \n"
        )
        head += "".join(f"; {t * ticks:.0f}; {x:.17g}\n" for t, x in zip(time, column, strict=True))
    return head + more


def codesys_xml(*, micro=False, values=(Y, R, U), head='<?xml version="1.0" encoding="utf-16"?>\n', name=PLC[0]):
    """CODESYS V3, ``.trace``: the configuration, and the samples as lists."""
    ticks = 1e6 if micro else 1e3
    body = (
        f'{head}<Trace>\n<TraceConfiguration><Single Type="{{c45dff5d}}" Method="IArchivable"><Single Name="Record">'
        f'<Single Name="BufferEntries" Type="uint">1000</Single><Single Name="MicroSeconds" Type="bool">{micro}'
        '</Single><Single Name="Comment" Type="string">speed &lt; 1</Single></Single></Single></TraceConfiguration>\n'
        '<TraceData Version="1.0.0.0"><TraceRecord><TriggerState>0</TriggerState>\n'
    )
    for k, (label, column) in enumerate(zip((name, *PLC[1:]), values, strict=True)):
        body += (
            f'<TraceVariable VarName="{label}" VariableIndex="{k}" Type="System.Double">\n'
            f"<Values>{','.join(f'{x:.17g}' for x in column)}</Values>\n"
            f"<Timestamps>{','.join(f'{t * ticks:.0f}' for t in T)}</Timestamps>\n</TraceVariable>\n"
        )
    return body + "</TraceRecord></TraceData></Trace>\n"


def codesys_text(stamp="Timestamp(ms)", ticks=1e3):
    head = f"CODESYS V3.5 SP20 Patch 4 Trace: Trace\nC:\\Projects\\axis.project\n{stamp} {' '.join(PLC)}\n"
    return head + lines(np.round(T * ticks), Y, R, U, separator=" ", form="{:.17g}")


def iso_german():
    stamps = (np.datetime64("2024-05-01T12:00:00.000") + np.round(T * 1e3).astype("timedelta64[ms]")).astype(str)
    rows = zip(stamps, Y * 1e3, R * 1e3, U, strict=True)
    body = "\n".join(f"{a};{b:.9g};{c:.9g};{d:.9g}".replace(".", ",") for a, b, c, d in rows)
    return "Prüfstand 3\nBediener: Müller\n\nZeitstempel;Weg [mm];Führungsgröße [mm];Stellgröße [V]\n" + body + "\n"


def workbook(path):
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Versuch 3"])
    sheet = book.create_sheet("Messung")
    for row in (["Zeit", "Lageistwert", "Lagesollwert", "Motorspannung"], ["ms", "mm", "mm", "V"]):
        sheet.append(row)
    for row in zip(T * 1e3, Y * 1e3, R * 1e3, U, strict=True):
        sheet.append([float(x) for x in row])
    book.save(path)


def parquet(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    stamps = pa.array(NS + np.round(T * 1e9).astype("int64"), pa.timestamp("ns"))
    columns = {"timestamp": stamps, "pos_actual_mm": Y * 1e3, "pos_target_mm": R * 1e3, "motor_voltage": U}
    pq.write_table(pa.table(columns), path)


def tdms(path):
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject("Log", name, values, properties={"wf_increment": 1e-3, "unit_string": unit})
                for name, values, unit in (
                    ("Position", Y * 1e3, "mm"),
                    ("Sollwert", R * 1e3, "mm"),
                    ("Spannung", U, "V"),
                )
            ]
        )


def mdf(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from asammdf import MDF, Signal

        with MDF(version="4.10") as file:
            file.append(
                [Signal(Y * 1e3, T, name="Axis.ActPos", unit="mm"), Signal(R * 1e3, T, name="Axis.SetPos", unit="mm")]
            )
            file.append([Signal(U, T, name="Axis.Voltage", unit="V")])
            file.save(path, overwrite=True)


def hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        group = file.create_group("run1")
        for name, values, unit in (("t", T, "s"), ("q", Y * 1e3, "mm"), ("target", R * 1e3, "mm"), ("u", U, "V")):
            group[name] = values
            group[name].attrs["unit"] = unit


def mat73(path):
    """MATLAB writes v7.3 as HDF5 behind 512 bytes of its own, classes as attributes, matrices by columns."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", T), ("pos", Y), ("ref", R), ("u", U)):
            file[name] = values[np.newaxis, :]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Wed May 01 12:00:00 2024 HDF5 schema 1.00 .".ljust(
                124
            )
        )
        stream.write(b"\x00\x02IM")


def timetable(path):
    """mat-io is the one free writer of timetables; its import changes pandas' options: it runs in another process."""
    script = (
        "import sys, numpy as np, pandas as pd, matio\n"
        "t, y, r, u = np.load(sys.argv[1])\n"
        "frame = pd.DataFrame({'pos': y, 'ref': r, 'voltage': u}, index=pd.to_timedelta(t, unit='s'))\n"
        "matio.save_to_mat(sys.argv[2], {'log': frame}, version='v7')\n"
    )
    data = path.with_suffix(".npy")
    np.save(data, np.stack([T, Y, R, U]))
    subprocess.run([sys.executable, "-c", script, str(data), str(path)], check=True, capture_output=True)


def simulink(path):
    import scipy.io

    signals = [{"values": v, "label": name} for name, v in (("position", Y), ("reference", R), ("voltage", U))]
    scipy.io.savemat(path, {"ScopeData": {"time": T, "signals": signals}})


def bag(plugin):
    def write(path):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        kinds = store.types
        with Writer(path, version=8, storage_plugin=StoragePlugin[plugin]) as writer:
            states = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
            command = writer.add_connection("/elbow/target_position", "std_msgs/msg/Float64", typestore=store)
            for t, y, r, u in zip(T, Y, R, U, strict=True):
                now = NS + round(t * 1e9)
                stamp = kinds["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
                header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="")
                nothing = np.array([])
                state = kinds["sensor_msgs/msg/JointState"](
                    header=header, name=["elbow"], position=np.array([y]), velocity=nothing, effort=np.array([u])
                )
                message = kinds["std_msgs/msg/Float64"](data=float(r))
                writer.write(command, now, store.serialize_cdr(message, "std_msgs/msg/Float64"))
                writer.write(states, now, store.serialize_cdr(state, "sensor_msgs/msg/JointState"))

    return write


def mcap(*, schema=True, encoding="json", chunks="ZSTD"):
    """MCAP as Foxglove's library writes it; the messages are JSON, with or without a schema."""

    def write(path):
        from mcap.writer import CompressionType, Writer

        with path.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType[chunks])
            writer.start()
            known = writer.register_schema("axis", "jsonschema", b'{"type": "object"}') if schema else 0
            states = writer.register_channel("/axis/state", encoding, known)
            target = writer.register_channel("/axis/target", encoding, known)
            for t, y, r, u in zip(T, Y, R, U, strict=True):
                now = NS + round(t * 1e9)
                stamp = {"sec": now // 10**9, "nsec": now % 10**9}
                state = {"timestamp": stamp, "position_mm": y * 1e3, "motor": {"voltage": u, "name": "M1"}}
                for channel, message in ((target, {"timestamp": stamp, "setpoint_mm": r * 1e3}), (states, state)):
                    data = json.dumps(message).encode()
                    writer.add_message(channel, log_time=now + 50_000, data=data, publish_time=now)
            writer.finish()

    return write


def matrix(path):
    import scipy.io

    scipy.io.savemat(path, {"rec": np.column_stack([T, R, Y, U])})


def json_lines():
    rows = zip(T, Y, R, U, strict=True)
    return "\n".join(
        json.dumps({"ts": a * 1e3, "pos": {"mm": b * 1e3}, "ref_mm": c * 1e3, "u": d}) for a, b, c, d in rows
    )


PER_MM = 65536 / 40
"""Counts of Klipper's angle sensor on a belt that moves 40 mm a revolution."""
MOVES = (
    [10.0, 0.1, 0.0, 1000.0, [30.0, 20.0, 0.0], [1.0, 0.0, 0.0]],
    [10.1, 0.4, 100.0, 0.0, [35.0, 20.0, 0.0], [1.0, 0.0, 0.0]],
    [10.5, 0.1, 100.0, -1000.0, [75.0, 20.0, 0.0], [1.0, 0.0, 0.0]],
)
"""Time, duration, speed, acceleration, place, direction: 50 mm in x, as the toolhead plans it."""


def klipper(moves=MOVES, *, sensor=True):
    """Klipper's data logger: documents that a control character ends, packed; times since the printer's start."""

    def write(path):
        time = np.arange(9.9, 10.9, 1e-3)
        counts = np.round(PER_MM * np.interp(time - 0.01, *COMMANDED))
        parts = [{"id": "info", "result": {"state": "ready", "software_version": "v0.12.0"}}]
        header = ["time", "duration", "start_velocity", "acceleration", "start_position", "direction"]
        parts += [{"id": "trapq:toolhead", "result": {"header": header}}]
        parts += [{"id": "stepq:stepper_x", "result": {"header": ["interval", "count", "add"]}}]
        parts += [{"id": "angle:belt", "result": {"header": ["time", "angle"]}}] * sensor
        parts += [{"q": "trapq:toolhead", "params": {"data": [move]}} for move in moves]
        parts += [{"q": "stepq:stepper_x", "params": {"data": [[1200, 8, -3]], "start_position": 30.0}}]
        rows = [[float(t), int(c)] for t, c in zip(time, counts, strict=True)]
        for k in range(0, len(rows) * sensor, 100):
            parts += [{"q": "angle:belt", "params": {"position_offset": 3.15, "errors": 0, "data": rows[k : k + 100]}}]
        path.write_bytes(gzip.compress(b"".join(json.dumps(part).encode() + b"\x03" for part in parts)))

    return write


def commanded(time):
    """The same moves, integrated on a fine grid: an answer that the reader's formula did not make."""
    grid = np.arange(9.0, 12.0, 1e-5)
    speed = np.interp(grid, [10.0, 10.1, 10.5, 10.6], [0.0, 100.0, 100.0, 0.0])
    place = 30.0 + np.concatenate([[0.0], np.cumsum(0.5e-5 * (speed[1:] + speed[:-1]))])
    return np.interp(time, grid, place)


COMMANDED = (np.arange(9.0, 12.0, 1e-4), commanded(np.arange(9.0, 12.0, 1e-4)))


def lerobot(path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    joints = [[float(y * 500), 3.0] for y in Y]
    pq.write_table(pa.table({"action": joints, "observation.state": joints, "timestamp": T}), path)


MM = 1e-3
READ = [
    ("the format's own", "a.csv", text("time [s],position [m],reference [m],voltage [V]\n" + lines(T, Y, R, U)), {}),
    ("suffixes", "a.csv", text("t_ms,pos_mm,ref_mm,u_V\n" + lines(T * 1e3, Y * 1e3, R * 1e3, U)), {}),
    (
        "microcontroller",
        "a.txt",
        text("millis target_mm actual_mm volts\n" + lines(T * 1e3, R * 1e3, Y * 1e3, U, separator=" ")),
        {},
    ),
    ("microseconds", "a.csv", text("micros,soll_um,ist_um,pwm_volts\n" + lines(T * 1e6, R * 1e6, Y * 1e6, U)), {}),
    ("German, time stamps, Latin-1", "a.csv", text(iso_german(), "latin-1"), {}),
    (
        "German compounds",
        "a.csv",
        text(
            "Zeit in ms;Positionsistwert / mm;Positionssollwert / mm;Reglerausgang / V\n"
            + lines(T * 1e3, Y * 1e3, R * 1e3, U, separator=";", decimal=",")
        ),
        {},
    ),
    (
        "UTF-16 of a spreadsheet",
        "a.txt",
        text(
            "Time\tActual position\tTarget position\tControl voltage\ns\tmm\tmm\tV\n"
            + lines(T, Y * 1e3, R * 1e3, U, separator="\t"),
            "utf-16",
        ),
        {},
    ),
    (
        "preamble and units",
        "a.csv",
        text(
            'Device,"PSU 4"\nSample Interval,1 ms\n\nTime,CH1 pos,CH2 setpoint,CH3 voltage\n(s),(mm),(mm),(V)\n'
            + lines(T, Y * 1e3, R * 1e3, U)
        ),
        {},
    ),
    ("numpy.savetxt", "a.txt", text("# t y r u\n" + lines(T, Y, R, U, separator=" ", form="{:.18e}")), {}),
    ("pandas with its index", "a.csv", text(",time,pos,ref,u\n" + lines(np.arange(T.size), T, Y, R, U)), {}),
    ("gzip", "a.csv.gz", lambda p: p.write_bytes(gzip.compress(("t,q,qg,u\n" + lines(T, Y, R, U)).encode())), {}),
    ("LabVIEW", "a.lvm", text(lvm()), {}),
    ("TwinCAT Scope", "a.csv", text(scope()), {}),
    ("TwinCAT Scope, symbols", "a.csv", text(scope(symbols=AXIS, units=KINDS_OF_UNITS)), {}),
    ("TwinCAT Scope, one time", "a.csv", text(scope(every_channel=False, symbols=AXIS, separator=";")), {}),
    ("TwinCAT Scope, FILETIME", "a.csv", text(scope(filetime=True, units=KINDS_OF_UNITS)), {}),
    ("CODESYS V3, CSV", "a.trace.csv", text(codesys_csv()), {}),
    ("CODESYS V3, CSV in microseconds", "a.trace.csv", text(codesys_csv(flags=36, ticks=1e6), "utf-8-sig"), {}),
    ("CODESYS V3, trace", "a.trace", text(codesys_xml(), "utf-16"), {}),
    ("CODESYS V3, trace in microseconds", "a.xml", text(codesys_xml(micro=True, head="")), {}),
    ("CODESYS V3, text", "a.txt", text(codesys_text()), {}),
    ("CODESYS V3, German text", "a.txt", text(codesys_text("Zeitstempel(µs)", 1e6), "cp1252"), {}),
    ("workbook", "a.xlsx", workbook, {}),
    ("Parquet", "a.parquet", parquet, {}),
    ("TDMS", "a.tdms", tdms, {}),
    ("MDF4, two groups", "a.mf4", mdf, {}),
    ("HDF5", "a.h5", hdf5, {}),
    ("npz", "a.npz", lambda p: np.savez(p, time=T, theta=Y, theta_ref=R, u=U), {}),
    ("MAT v7.3", "a.mat", mat73, {}),
    ("timetable", "a.mat", timetable, {}),
    ("Simulink", "a.mat", simulink, {}),
    (
        "JSON",
        "a.json",
        lambda p: p.write_text(
            json.dumps({"t": T.tolist(), "log": {"pos": Y.tolist(), "ref": R.tolist(), "u": U.tolist()}})
        ),
        {},
    ),
    ("JSON lines", "a.jsonl", text(json_lines()), {}),
    ("ROS 2, MCAP", "bag", bag("MCAP"), {}),
    ("ROS 2, SQLite", "bag", bag("SQLITE3"), {}),
    ("MCAP with JSON", "a.mcap", mcap(), {}),
    ("MCAP with JSON, no schema, LZ4", "a.mcap", mcap(schema=False, chunks="LZ4"), {}),
    (
        "ODrive",
        "a.csv",
        text(
            "t,axis0.pos_estimate,axis0.input_pos,axis0.Iq_setpoint,axis0.Iq_measured,vbus_voltage\n"
            + lines(T, Y / (2 * np.pi), R / (2 * np.pi), U, U * 0.9, 24 + 0 * T)
        ),
        {},
    ),
    (
        "moteus",
        "a.csv",
        text(
            "timestamp,servo_stats.position,servo_command.position,servo_stats.torque_Nm,servo_stats.voltage\n"
            + lines(T + 1.7e9, Y / (2 * np.pi), R / (2 * np.pi), U, 24 + 0 * T, form="{:.15g}")
        ),
        {},
    ),
    (
        "named by their order",
        "a.csv",
        text(lines(T, R, Y, U)),
        {"columns": {"time": "1", "reference": "2", "position": "3", "voltage": "4"}},
    ),
    ("matrix", "a.mat", matrix, {"columns": {"time": "1", "reference": "2", "position": "3", "voltage": "4"}}),
    (
        "duty and supply",
        "a.csv",
        text("t_ms,angle_deg,target_deg,duty\n" + lines(T * 1e3, Y * DEG, R * DEG, U / 24)),
        {"settings": {"supply_voltage": 24}},
    ),
    (
        "counts and PWM",
        "a.csv",
        text(
            "t_ms,enc_counts,target_counts,pwm\n"
            + lines(T * 1e3, Y * 4096 / (2 * np.pi), R * 4096 / (2 * np.pi), U * 255 / 12)
        ),
        {"settings": {"counts_per_rev": 4096, "supply_voltage": "12 V", "pwm_full_scale": 255}},
    ),
]


@pytest.mark.parametrize(("name", "write", "options"), [case[1:] for case in READ], ids=[case[0] for case in READ])
def test_log_is_read_as_it_was_made(tmp_path, name, write, options):
    write(tmp_path / name)
    record = read_log(tmp_path / name, **options).record
    step = np.ptp(R)
    assert record.time == pytest.approx(T, abs=1e-6)
    assert np.max(np.abs(record.position - Y)) < 1e-6 * step
    assert np.max(np.abs(record.reference - R)) < 1e-6 * step
    assert np.max(np.abs(record.voltage - U)) < 1e-6 * np.ptp(U)
    assert (record.controller.kp, record.controller.kd) == (pytest.approx(60, rel=1e-3), pytest.approx(4, rel=1e-3))


ASKED = [
    ("no names", "a.csv", text(lines(T, R, Y, U)), "has no row that names its 4 columns"),
    ("two axes", "a.csv", text("t,theta1,theta2,u\n" + lines(T, Y, Y**2, U)), "may be one of 'theta1', 'theta2'"),
    (
        "degrees or radians",
        "a.csv",
        text("t,angle,target,u\n" + lines(T, Y * 500, R * 500, U)),
        "deg and rad are plausible",
    ),
    (
        "no unit of a length",
        "a.csv",
        text("t,pos,target,u\n" + lines(T, Y * 1e3, R * 1e3, U)),
        "mm, deg and rad are plausible",
    ),
    (
        "milliseconds or microseconds",
        "a.csv",
        text("t,pos,target,u\n" + lines(T * 5e4, Y, R, U)),
        "plausible in ms (20 Hz) and in us (20 kHz)",
    ),
    (
        "counts without a scale",
        "a.csv",
        text(
            "t_ms,Present Position,Goal Position,Present PWM\n"
            + lines(T * 1e3, np.round(1e7 * Y), np.round(1e7 * R), U)
        ),
        "counts_per_rev",
    ),
    (
        "cycles instead of time",
        "a.txt",
        text("Cycle PLC_PRG.fPos PLC_PRG.fTarget PLC_PRG.fU\n" + lines(np.arange(T.size), Y, R, U, separator=" ")),
        "no column named time",
    ),
    (
        "CODESYS, sampling trace",
        "a.txt",
        text(
            "CODESYS Trace\nD:\\PROJECTS\\AXIS.PRO\nCycle PLC_PRG.fActPos PLC_PRG.fSetPos PLC_PRG.fU\n"
            + lines(np.arange(T.size), Y, R, U, separator=" ")
        ),
        "no column named time",
    ),
    (
        "CODESYS V3, no unit of a length",
        "a.trace",
        text(codesys_xml(values=(Y * 1e3, R * 1e3, U)), "utf-16"),
        "mm, deg and rad are plausible",
    ),
    (
        "CODESYS V3, no unit of the time",
        "a.trace.csv",
        text(codesys_csv(flags=0, ticks=5e4)),
        "plausible in ms (20 Hz) and in us (20 kHz)",
    ),
    (
        "a command that may be the reference",
        "a.csv",
        text("t,pos,command\n" + lines(T, Y, R)),
        "may be reference or voltage",
    ),
    (
        "volts or counts",
        "a.csv",
        text("t,pos,ref,u\n" + lines(T, Y, R, np.clip(np.round(U * 50), -255, 255))),
        "counts of a PWM are plausible",
    ),
    ("joints", "a.parquet", lerobot, "say --unit position="),
    ("Klipper: what is a count", "a.json.gz", klipper(), "give counts_per_unit, counts per m or rad"),
    ("Klipper: no sensor", "a.json.gz", klipper(sensor=False), "commanded moves alone; log a sensor"),
    ("Klipper: damaged moves", "a.json.gz", klipper([[10.0, 0.1]]), "damaged rows"),
    ("no command", "a.json.gz", klipper(()), "neither reference nor voltage is given"),
]


@pytest.mark.parametrize(("name", "write", "part"), [case[1:] for case in ASKED], ids=[case[0] for case in ASKED])
def test_what_can_be_read_in_two_ways_is_a_question(tmp_path, name, write, part):
    write(tmp_path / name)
    with pytest.raises(InputError) as asked:
        read_log(tmp_path / name)
    assert part in str(asked.value)


ORDER = ["--columns", "time,reference,position,voltage"]
ANSWERS = {
    "named by their order": (ORDER, 1.0),
    "matrix": (ORDER, 1.0),
    "counts and PWM": (["--setting", "counts_per_rev=4096"], 1.0),
    "counts without a scale": (["--setting", "counts_per_rev=4096"], 1e7 * 2 * np.pi / 4096),
    "CODESYS, sampling trace": (["--setting", "sample_time=1 ms"], 1.0),
    "CODESYS V3, no unit of a length": (["--unit", "position=mm"], 1.0),
    "joints": (["--unit", "position=deg"], 500 / DEG),
    "Klipper: what is a count": (["--setting", f"counts_per_unit={PER_MM * 1e3:.0f}"], None),
}
"""Forms about which there is a question, the answer, and the position in units of the truth (Klipper has its own)."""
FORMS = [case[:3] for case in READ] + [case[:3] for case in ASKED if case[0] in ANSWERS]
REAL = 25
PAGE = (Path(__file__).parent.parent / "docs" / "logs.md").read_text(encoding="utf-8")
NO_COMMAND = ("joints", "Klipper: what is a count")
"""Logs without a command: which gains moved the axis is a second question."""


def test_most_forms_are_read_in_one_command_and_the_others_after_one_question(tmp_path):
    """The raw log, no option: a campaign that reads it as it was made, or one question that one answer settles."""
    read, asked, twice = [], [], []
    for k, (form, name, write) in enumerate(FORMS):
        folder = tmp_path / str(k)
        folder.mkdir()
        write(folder / name)
        done = convert(folder / name, folder / "c.toml")
        answer, factor = ANSWERS.get(form, ([], 1.0))
        if answer:
            assert done.exit_code == 2, form
            assert done.output.startswith("servolens: error: "), form
            assert done.output.count("\n") == 1, form
            assert not (folder / "c.toml").exists(), form
            done = convert(folder / name, folder / "c.toml", *answer)
        if form in NO_COMMAND:
            assert done.exit_code == 2, form
            assert "give kp and kd" in done.output, form
            done = convert(folder / name, folder / "c.toml", *answer, "--record-kp", "60")
        assert done.exit_code == 0, (form, done.output)
        (twice if form in NO_COMMAND else asked if answer else read).append(form)
        (record,) = read_records(folder / "c.toml")
        expected = commanded(record.time - 0.01) * 1e-3 if factor is None else factor * Y
        assert np.max(np.abs(record.position - expected)) < 2e-3 * np.ptp(expected), form
        assert record.sample_time == pytest.approx(1e-3, abs=1e-6), form
        if form == "duty and supply":
            assert record.command_unit == "%", form
    assert len(FORMS) >= REAL
    assert len(read) >= 0.8 * len(FORMS)
    told = f"{len(read)} become a campaign in one command, {len(asked)} after one question, {len(twice)} after two"
    assert f"The tests hold {len(FORMS)} logs in as many forms: {told}" in " ".join(PAGE.split())
    assert f"In one command: {'; '.join(read)}." in " ".join(PAGE.split())


@pytest.mark.parametrize("form", ANSWERS)
def test_the_page_tells_which_form_asks_and_what_answers(form):
    (row,) = (row for row in PAGE.splitlines() if row.startswith((f"| {form} |", f"| {form} (")))
    assert f"`{' '.join(ANSWERS[form][0])}`" in row
    assert ("--record-kp" in row) == (form in NO_COMMAND)


def convert(log, campaign, *options):
    return CliRunner().invoke(group, ["convert", str(log), "--out", str(campaign), *options])


@pytest.mark.parametrize(
    "moves",
    [
        [[10.0, 0.1, 0.0, 1000.0, [30.0, 20.0, 0.0], "x"]],
        [[10.0, 0.1, 0.0, 1000.0, [30.0, 20.0], [1.0, 0.0]]],
        [{"time": 10.0}],
        [[11.0, 0.1, 0.0, 1.0, [0.0] * 3, [1.0, 0.0, 0.0]], [10.0, 0.1, 0.0, 1.0, [0.0] * 3, [1.0, 0.0, 0.0]]],
        [[10**400, 0.1, 0.0, 1.0, [0.0] * 3, [1.0, 0.0, 0.0]]],
        [None],
    ],
    ids=["text", "two axes", "object", "backward", "huge", "nothing"],
)
def test_klipper_s_damaged_moves_are_refused(tmp_path, moves):
    klipper(moves)(tmp_path / "a.json.gz")
    assert "damaged rows" in read_or_refuse(tmp_path / "a.json.gz")


def test_klipper_s_moves_are_the_reference(tmp_path):
    klipper()(tmp_path / "a.json.gz")
    reading = read_log(tmp_path / "a.json.gz", settings={"counts_per_unit": PER_MM * 1e3, "kp": 60})
    record = reading.record
    assert record.reference * 1e3 == pytest.approx(commanded(record.time), abs=1e-3)
    assert record.position * 1e3 == pytest.approx(commanded(record.time - 0.01), abs=0.5 / PER_MM + 1e-3)
    assert {"target x", "angle", "time"} == {guess.source.rpartition(".")[2] for guess in reading.guesses}


def test_an_answer_settles_the_question(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,pos,target,u\n" + lines(T, Y * 1e3, R * 1e3, U))
    (record,) = read_records(path, units={"position": "mm"})
    assert np.max(np.abs(record.position - Y)) < 1e-9
    assert np.max(np.abs(record.reference - R)) < 1e-9
    (tmp_path / "b.txt").write_text("Cycle fPos fTarget fU\n" + lines(np.arange(T.size), Y, R, U, separator=" "))
    (record,) = read_records(tmp_path / "b.txt", settings={"sample_time": "1 ms"})
    assert record.time == pytest.approx(T, abs=1e-9)


# ---- hostile and damaged files


@pytest.mark.parametrize(
    ("name", "write"),
    [(case[1], case[2]) for case in READ if case[0] not in ("ROS 2, SQLite", "timetable")],
    ids=[case[0] for case in READ if case[0] not in ("ROS 2, SQLite", "timetable")],
)
@pytest.mark.parametrize("share", [0.02, 0.6])
def test_a_file_that_ends_early_is_read_or_refused_by_one_sentence(tmp_path, name, write, share):
    write(tmp_path / name)
    path = next((tmp_path / name).glob("*.mcap")) if (tmp_path / name).is_dir() else tmp_path / name
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    read_or_refuse(tmp_path / name)


@pytest.mark.parametrize("name", ["a.xlsx", "a.parquet", "a.tdms", "a.mf4", "a.h5", "a.npz", "a.mat", "a.mcap"])
def test_a_file_with_wrong_bytes_is_read_or_refused_by_one_sentence(tmp_path, name):
    writers = {"a.xlsx": workbook, "a.parquet": parquet, "a.tdms": tdms, "a.mf4": mdf, "a.h5": hdf5, "a.mat": mat73}
    writers["a.mcap"] = mcap(chunks="NONE")
    writers["a.npz"] = lambda path: np.savez_compressed(path, t=T, q=Y, ref=R, u=U)
    writers[name](tmp_path / name)
    content = bytearray((tmp_path / name).read_bytes())
    rng = np.random.default_rng(7)
    for _ in range(4):
        wrong = bytearray(content)
        for at in rng.integers(0, len(wrong), 40):
            wrong[at] = rng.integers(256)
        (tmp_path / name).write_bytes(wrong)
        read_or_refuse(tmp_path / name)


def read_or_refuse(path):
    """Return the sentence of the refusal, None where the file was read."""
    try:
        record = read_log(path).record
    except InputError as error:
        sentence = str(error)
    else:
        assert np.isfinite(record.position).all()
        return None
    assert sentence.isprintable()
    return sentence


def test_links_of_hdf5_to_other_files_are_not_followed(tmp_path):
    import h5py

    (tmp_path / "axis").mkdir()
    hdf5(tmp_path / "secret.h5")
    with h5py.File(tmp_path / "axis" / "a.h5", "w") as file:
        file["t"] = T
        file["pos"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/run1/q")
        file["soft"] = h5py.SoftLink("/t")
        file.create_dataset("ref", (4,), "f8", external=[(str(tmp_path / "secret.h5"), 0, 32)])
        layout = h5py.VirtualLayout((T.size,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "/run1/q", (T.size,))
        file.create_virtual_dataset("position", layout)
    assert "the columns are 't'" in read_or_refuse(tmp_path / "axis" / "a.h5")


def test_a_bag_that_names_a_file_outside_is_refused(tmp_path):
    bag("MCAP")(tmp_path / "bag")
    (data,) = (tmp_path / "bag").glob("*.mcap")
    metadata = tmp_path / "bag" / "metadata.yaml"
    data.rename(tmp_path / data.name)
    metadata.write_text(metadata.read_text().replace(data.name, f"../{data.name}"))
    assert "outside its folder" in read_or_refuse(tmp_path / "bag")
    metadata.write_text(metadata.read_text().replace(f"../{data.name}", data.name))
    (tmp_path / "bag" / data.name).symlink_to(tmp_path / data.name)
    assert "outside its folder" in read_or_refuse(tmp_path / "bag")


def test_a_slower_channel_of_a_scope_is_held(tmp_path):
    """Fewer rows for the channel of 2 ms: blank cells below them, as in TwinCAT's exports of several rates."""
    whole = scope(symbols=AXIS).splitlines()
    first = whole.index("", 6) + 1
    rows = [line.split("\t") for line in whole[first:-1]]
    half = [row[:4] + (rows[2 * k][4:] if 2 * k < len(rows) else ["", ""]) for k, row in enumerate(rows)]
    (tmp_path / "a.csv").write_text("\n".join([*whole[:first], *("\t".join(row) for row in half), "EOF", ""]))
    record = read_log(tmp_path / "a.csv").record
    assert record.position == pytest.approx(Y, abs=1e-9)
    assert record.voltage == pytest.approx(np.repeat(U[::2], 2)[: U.size], abs=1e-6)


def test_variables_of_a_trace_that_began_apart_are_read_at_the_instants_of_all(tmp_path):
    stamps, values = (T[2:], T[:-3], T[1:]), (Y[2:], R[:-3], U[1:])
    (tmp_path / "a.trace.csv").write_text(codesys_csv(stamps=stamps, values=values))
    record = read_log(tmp_path / "a.trace.csv").record
    assert record.time == pytest.approx(T[2:-3])
    assert record.position == pytest.approx(Y[2:-3], abs=1e-12)
    assert record.reference == pytest.approx(R[2:-3], abs=1e-12)
    assert record.voltage == pytest.approx(U[2:-3], abs=1e-12)


def test_a_variable_of_a_trace_in_a_slower_task_is_held(tmp_path):
    stamps, values = (T, T[::4], T), (Y, R[::4], U)
    (tmp_path / "a.trace.csv").write_text(codesys_csv(stamps=stamps, values=values))
    record = read_log(tmp_path / "a.trace.csv").record
    assert record.position == pytest.approx(Y, abs=1e-12)
    assert record.reference == pytest.approx(np.repeat(R[::4], 4)[: R.size], abs=1e-12)


def test_variables_of_a_trace_that_are_no_numbers_are_left_out(tmp_path):
    """A text that holds a semicolon, one that does not, and a truth: none of them is asked for."""
    more = "3.Variable; PLC_PRG.sState\n3.Data; \n; 0; a; b\n4.Variable; PLC_PRG.sMode\n4.Data; \n"
    more += "".join(f"; {t * 1e3:.0f}; idle\n" for t in T) + "5.Variable; PLC_PRG.xOn\n5.Data; \n"
    more += "".join(f"; {t * 1e3:.0f}; TRUE\n" for t in T)
    (tmp_path / "a.trace.csv").write_text(codesys_csv(more=more))
    assert read_log(tmp_path / "a.trace.csv").record.position == pytest.approx(Y, abs=1e-12)
    options = {"columns": {"position": "PLC_PRG.sMode"}}
    with pytest.raises(InputError, match="sample 1, position: 'idle' is not a number"):
        read_log(tmp_path / "a.trace.csv", **options)
    with pytest.raises(InputError, match="holds more than one number a sample"):
        read_log(tmp_path / "a.trace.csv", columns={"position": "PLC_PRG.sState"})


DOCTYPE = '<!DOCTYPE Trace [<!ENTITY a "xxxxxxxxxx"><!ENTITY b "&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (codesys_xml(head="")[:-30], "is a damaged CODESYS trace (line"),
        (codesys_xml(head="").replace("<Trace>", f"{DOCTYPE}<Trace>", 1), "XML with a document type"),
        (f"<Trace >{DOCTYPE}</Trace>", "is a damaged CODESYS trace"),
        ("<Trace><TraceData/></Trace>", "holds no samples"),
        ("[key]; [value]\nFlags; 16\n0.Variable; PLC_PRG.a\n0.Data; \n", "holds no samples"),
        (codesys_csv().replace("\n; 300;", "\n; x;"), "has damaged time stamps"),
        (
            codesys_xml(head="").replace("<Values>", "<Values>1,", 1),
            f"has {T.size + 1} values for {T.size} time stamps",
        ),
    ],
    ids=["cut", "document type", "document type within", "no samples, XML", "no samples, CSV", "stamps", "values"],
)
def test_damaged_traces_of_codesys_are_refused(tmp_path, content, part):
    (tmp_path / "a.trace").write_text(content)
    with pytest.raises(InputError) as refused:
        read_log(tmp_path / "a.trace", columns={"position": PLC[0]})
    assert part in str(refused.value)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (codesys_csv().replace("\n; 300;", "\n;" + " " * 1_000_000 + "x;"), "has damaged time stamps"),
        (
            "[key]; [value]\n" + "".join(f"{i}.Variable; a\n{i}.Data; \n" for i in range(1002)),
            "more than 1000 variables",
        ),
        ("<Trace>" + "<TraceVariable/>" * 1002 + "</Trace>", "more than 1000 variables"),
        ("<Trace>" + "<a>" * 200_000, "more than 100 elements within each other"),
    ],
    ids=["blanks", "many, CSV", "many, XML", "deep"],
)
def test_hostile_traces_of_codesys_are_refused_at_once(tmp_path, content, part):
    (tmp_path / "a.trace").write_text(content)
    begun = process_time()
    with pytest.raises(InputError, match=part):
        read_log(tmp_path / "a.trace", columns={"position": PLC[0]})
    assert process_time() - begun < 10.0  # what SECURITY.md promises


def test_blank_cells_between_tabs_are_never_skipped(tmp_path):
    """Six blank cells in a table of six columns: as many numbers as in one row less."""
    rows = np.column_stack([T, Y, R, U, Y, U])[:50]
    cells = [[f"{x:.9g}" for x in row] for row in rows]
    for k in range(6):
        cells[20 + k][4] = ""
    (tmp_path / "a.tsv").write_text(
        "t\tpos\tref\tu\tmotor temperature\thousing temperature\n" + "\n".join("\t".join(row) for row in cells) + "\n"
    )
    record = read_log(tmp_path / "a.tsv").record
    assert record.time == pytest.approx(T[:50])
    assert record.position == pytest.approx(Y[:50])


def test_mcap_of_other_messages_is_refused(tmp_path):
    mcap(encoding="protobuf")(tmp_path / "a.mcap")
    assert "without messages in JSON or by ROS" in read_or_refuse(tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("data", "part"),
    [(b"{", "declared as JSON but is not JSON"), (b"[1, 2]", "no object of names"), (b"[" * 5000, "declared as JSON")],
)
def test_mcap_with_wrong_json_is_refused(tmp_path, data, part):
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/axis", "json", 0)
        writer.add_message(channel, log_time=NS, data=data, publish_time=NS)
        writer.finish()
    assert part in read_or_refuse(tmp_path / "a.mcap")


def test_bombs_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_BYTES", 2**20)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"0,0\n" * 2**20))
    assert "unpacks to more than 1 MiB" in read_or_refuse(tmp_path / "a.csv.gz")
    (tmp_path / "b.json").write_text("[" * 200_000)
    assert "nested too deep" in read_or_refuse(tmp_path / "b.json")


def test_numpy_objects_are_never_unpickled(tmp_path):
    np.savez(tmp_path / "a.npz", position=np.array([{"a": 1}], dtype=object))
    assert "holds objects, which are not read" in read_or_refuse(tmp_path / "a.npz")


def test_a_reader_that_takes_too_long_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(isolated, "WALL", 0.05)
    hdf5(tmp_path / "a.h5")
    assert "takes more than 0.05 s to read as HDF5" in read_or_refuse(tmp_path / "a.h5")


def test_a_reader_that_needs_too_much_memory_is_ended(tmp_path, monkeypatch):
    script = tmp_path / "hungry.py"
    script.write_text("import numpy\nfrom servolens.reading.isolated import _limit\n_limit()\nnumpy.ones(2**30)\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert "MemoryError" in done.stderr


@pytest.mark.parametrize(
    ("name", "write", "library", "kind"), [("a.h5", hdf5, "h5py", "HDF5"), ("a.mcap", mcap(), "mcap", "MCAP")]
)
def test_a_missing_library_is_named(tmp_path, monkeypatch, name, write, library, kind):
    write(tmp_path / name)
    (tmp_path / "without").mkdir()
    (tmp_path / "without" / f"{library}.py").write_text(f"raise ImportError('no module', name='{library}')\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path / 'without'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert read_or_refuse(tmp_path / name).endswith(
        f"is {kind}; to read it install {library}, or all readers: pip install 'servolens[formats]'"
    )
