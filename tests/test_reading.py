"""Reading: what a file may hold, and the sentence that meets what it may not."""

from __future__ import annotations

import bz2
import io
import lzma
import math
import os
import pickle
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from servolens.control_law import controller_voltage
from servolens.errors import InputError
from servolens.reading import files, read_record, record_from_dataframe, record_from_timeresponse
from servolens.reading.assembly import assemble
from servolens.record import Controller

DATA = Path(os.environ.get("SERVOLENS_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="measured data are not here (SERVOLENS_DATA)")

HEADER = "time,position,reference\n"
ROWS = "0.000,0,0.1\n0.001,0,0.1\n0.002,1e-5,0.1\n"
GAIN = "# kp = 60\n"
ROW = "0,0,1\n"
TWO = "0,0,1\n1,1,1\n"
ORDERED = "; a record is one run in the order of its time: split or sort the rows"
REGULAR = "; if the stamps were rounded, state the sample_time instead"
FILL = "; fill or leave out such rows"
LAW = "; give it in V/m or V/rad, or A, N, N m, %, pwm in place of V"
NAMELESS = (
    "has no row that names its {} columns, which begin with {}; name them in their order, e.g."
    " --columns time,position,voltage (- for one that is not needed)"
)
MAP = " (say which column it is, e.g. --column position=NAME)"
CLOCKLESS = " (say which column it is, e.g. --column time=NAME, or for rows at even times --setting 'sample_time=1 ms')"
PLAIN_VECTOR = "not a vector of numbers; save it as a plain vector"
SIGNALS = "time, position, reference, voltage, velocity, feedforward, enabled"
PLAIN = GAIN + HEADER + ROWS
TEXT = "is text without a table of numbers; a record has a row of names and rows of numbers below it"


def packed(names):
    """Return a ZIP archive of files with these names."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in names:
            archive.writestr(name, "t,q\n0,1\n")
    return content.getvalue()


def database():
    """Return an SQLite database of a table that is no bag's."""
    with sqlite3.connect(":memory:") as connection:
        connection.execute("create table log (t real, q real)")
        return connection.serialize()


@pytest.fixture
def write(tmp_path):
    def _write(content, name="run.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return _write


def refusal(path, **options):
    """The message without the path, which must stand before it; always one line."""
    with pytest.raises(InputError) as refused:
        read_record(path, **options)
    message = str(refused.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    return message.removeprefix(f"{path}: ")


# ---- what is read


def test_example_of_the_manual(write):
    path = write(
        "# name = cart, kp 60\n# kp = 60 V/m\n# kd = 0 V s/m\n# encoder_resolution = 1e-5 m\n# voltage_limit = 10 V\n"
        "# voltage_before = 500 mV\n# derivative_filter = 0.3\n"
        "time [s],reference [m],position [m],voltage [V]\n0.000,0.1,0.0,6.0\n0.001,0.1,0,6\n"
    )
    record = read_record(path)
    assert record.name == "cart, kp 60"
    assert record.controller == Controller(kp=60.0, kd=0.0, derivative_filter=0.3)
    assert (record.encoder_resolution, record.voltage_limit, record.voltage_before) == (1e-5, 10.0, 0.5)
    assert (record.length_unit, record.command_unit) == ("m", "V")
    assert record.voltage.tolist() == [6.0, 6.0]
    assert record.remarks == ()
    assert record.source == str(path)


@pytest.mark.parametrize(
    "content",
    [
        PLAIN,
        PLAIN.rstrip("\n"),
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("\n", "\r"),
        "\ufeff" + PLAIN,
        "\n\n" + PLAIN,
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", "\t"),
        PLAIN + "\n\n",
        PLAIN + "   \n",
        GAIN + "Time,Position,REFERENCE\n" + ROWS,
        GAIN + "t,position,reference\n" + ROWS,
        GAIN + '"time","position","reference"\n' + ROWS,
        GAIN + HEADER + ROWS.replace("0.001", '"0.001"'),
        GAIN + "reference,time,position\n0.1,0.000,0\n0.1,0.001,0\n0.1,0.002,1e-5\n",
        GAIN + "note,time,position,reference\na,0.000,0,0.1\nb,0.001,0,0.1\n,0.002,1e-5,0.1\n",
        GAIN + 'time,position,reference,note\n0.000,0,0.1,"a, b"\n0.001,0,0.1,\n0.002,1e-5,0.1,x\n',
        GAIN + "time [ms],position [um],reference [mm]\n0,0,100\n1,0,100\n2,10,100\n",
        HEADER + ROWS + "# kp = 60\n",
        HEADER + ROWS.replace("0.1\n", "0.1,\n") + GAIN,
    ],
    ids=[
        "plain",
        "no newline at the end",
        "CRLF",
        "CR",
        "BOM",
        "blank lines before",
        "semicolons",
        "tabs",
        "blank lines behind",
        "a line of blanks",
        "other letters",
        "t",
        "quoted names",
        "quoted numbers",
        "another order",
        "a column of text",
        "a column of quoted text",
        "units",
        "comment at the end",
        "separator at line ends",
    ],
)
def test_every_dialect_gives_the_same_record(write, content):
    record = read_record(write(content))
    assert record.time == pytest.approx([0, 0.001, 0.002], abs=1e-15)
    assert record.position == pytest.approx([0, 0, 1e-5], abs=1e-18)
    assert record.reference == pytest.approx([0.1] * 3)
    assert record.controller == Controller(kp=60.0)
    assert record.name == "run"


def test_milliseconds_become_exact_seconds(write):
    record = read_record(write(GAIN + "time [ms],position,reference\n3,0,1\n7,1,1\n"))
    assert record.time.tolist() == [0.003, 0.007]


def test_degrees_make_a_rotary_axis(write):
    record = read_record(write("# kp = 2 V/deg\ntime,position [deg],reference [deg]\n0,0,90\n1,180,90\n"))
    assert record.length_unit == "rad"
    assert record.position == pytest.approx([0, math.pi])
    assert record.controller.kp == pytest.approx(2 * 180 / math.pi)


@pytest.mark.parametrize("where", ["# kp = 2 V/rad\ntime,position", "# kp = 2\ntime,position [rad]"])
def test_one_stated_unit_settles_the_others(write, where):
    assert read_record(write(where + ",reference\n0,0,1\n1,0,1\n")).length_unit == "rad"


@pytest.mark.parametrize(("unit", "kept"), [("A", "A"), ("mA", "A"), ("N", "N"), ("N m", "N m"), ("%", "%")])
def test_command_keeps_its_unit(write, unit, kept):
    record = read_record(write(f"time,position,voltage [{unit}]\n0,0,1\n1,1,2\n"))
    assert record.command_unit == kept
    assert record.voltage == pytest.approx(np.array([1, 2]) * (1e-3 if unit == "mA" else 1))


def test_gain_of_a_current_loop_is_in_its_unit(write):
    record = read_record(write("# kp = 0.06 A/mm\ntime,position,reference,voltage [A]\n0,0,1,2\n1,1,1,2\n"))
    assert (record.controller.kp, record.command_unit) == (pytest.approx(60.0), "A")


@pytest.mark.parametrize("per_unit", ["40000", "40000 1/m", "40 1/mm", "40000 counts/m"])
@pytest.mark.parametrize("heading", ["position", "position [counts]"])
def test_counts_are_divided_and_give_the_resolution(write, per_unit, heading):
    text = f"# kp = 1\n# counts_per_unit = {per_unit}\ntime,{heading},reference [m]\n0,0,0.1\n1,400,0.1\n"
    record = read_record(write(text))
    assert record.position == pytest.approx([0, 0.01])
    assert record.reference == pytest.approx([0.1, 0.1])
    assert record.encoder_resolution == pytest.approx(2.5e-5)


def test_reference_in_counts_is_divided_too(write):
    text = (
        "# kp = 1\n# counts_per_unit = 40000\n# encoder_resolution = 1e-4\ntime,position,reference\n0,0,40\n1,400,40\n"
    )
    record = read_record(write(text))
    assert record.reference == pytest.approx([1e-3, 1e-3])
    assert record.encoder_resolution == 1e-4


def test_settings_of_the_caller_win(write):
    path = write("# kp = 60\n# name = a\n" + HEADER + ROWS)
    record = read_record(path, settings={"kp": "0.08 V/mm", "kd": 2, "name": "b", "derivative_on": "error"})
    assert record.controller == Controller(kp=80.0, kd=2.0, derivative_on="error")
    assert record.name == "b"


def test_settings_that_are_none_are_not_given(write):
    assert read_record(write(PLAIN), settings={"kp": None, "kd": None}).controller.kp == 60


def test_every_setting_is_read(write):
    text = (
        "# kp = 60\n# kd = 2\n# controller = PD\n# derivative_filter = 0.5\n# derivative_window = 2\n# ki = 0\n"
        "# derivative_on = error\n# derivative = velocity\n# control_period = 5 ms\n# on a Monday = x\n# free text\n"
    )
    assert read_record(write(text + HEADER + ROWS)).controller == Controller(
        kp=60.0,
        kd=2.0,
        derivative_filter=0.5,
        derivative_window=2,
        derivative_on="error",
        derivative="velocity",
        control_period=0.005,
    )


def test_voltage_needs_no_gains(write):
    record = read_record(write("time,position,reference,voltage\n0,0,1,2\n1,0,1,2\n"))
    assert record.controller is None


def test_optional_columns_are_read(write):
    text = "time,position,voltage,velocity [mm/s],feedforward [mV]\n0,0,1,2000,500\n1,0,1,2000,500\n"
    record = read_record(write(text))
    assert (record.velocity[0], record.feedforward[0]) == (pytest.approx(2.0), pytest.approx(0.5))


@pytest.mark.parametrize(
    ("comments", "code", "sentence"),
    [
        (
            "# kp = 60 V per position unit\n",
            "unit_not_understood",
            "kp: 'V per position unit' is no unit; the number was taken as SI.",
        ),
        (
            "# kp = 60\n# colour = red\n# b = 1\n",
            "unknown_setting",
            "comment keys that mean nothing here were left alone: 'b, colour'.",
        ),
        (
            "# kp = 60\n# derivative_window = 2 samples\n",
            "unit_not_understood",
            "derivative_window: 'samples' is no unit; the number was taken as SI.",
        ),
    ],
)
def test_what_is_not_understood_is_a_remark(write, comments, code, sentence):
    (remark,) = read_record(write(comments + HEADER + ROWS)).remarks
    assert (remark.code, remark.severity, remark.message, remark.record) == (code, "note", sentence, "run")


def test_loop_settings_without_gains_are_a_remark(write):
    text = "# derivative_filter = 0.5\ntime,position,voltage\n0,0,1\n1,0,1\n"
    (remark,) = read_record(write(text)).remarks
    assert remark.message == "kp is not given, so derivative_filter says nothing."


# ---- what is refused


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "is empty; check how it was written"),
        ("\n \n", "holds no header row and no numbers"),
        ("# kp = 60\n", "holds no header row and no numbers"),
        (HEADER, "the header row is not followed by numbers"),
        (GAIN + HEADER + "0,0,0\n", "a record needs at least 2 samples, got 1"),
        (
            "0,1,2\n3,4,5\n",
            NAMELESS.format(3, "0, 1, 2"),
        ),
        (
            HEADER + ROWS,
            "no voltage is logged and the gains are unknown; give kp and kd (on the command"
            " line --record-kp and --record-kd)",
        ),
        (
            "time,position\n0,0\n1,1\n",
            "neither reference nor voltage is given, and none of the columns 'time, position' is named so; name one,"
            " e.g. --column voltage=NAME, or state a reference that was not logged, e.g. --reference-step 0.1@0.5"
            " or --reference-file FILE",
        ),
        (
            GAIN + "time,reference\n0,0\n1,1\n",
            "no column named position; the columns are 'time, reference'" + MAP,
        ),
        (
            "a,b\n0,0\n1,1\n",
            "no column named time and none named position; the columns are 'a, b'" + CLOCKLESS,
        ),
        (",\n0,0\n1,1\n", NAMELESS.format(2, "0, 0")),
        (
            "time,position,position\n0,0,0\n1,1,1\n",
            "2 columns are named 'position'; say which, e.g. --column position=2 or --column position=3",
        ),
        (GAIN + HEADER + "0,0,1\n0,1,1\n", "time must increase; sample 1 (0 s) repeats sample 0 (0 s)" + REGULAR),
        (
            GAIN + HEADER + "0,0,1\n2,1,1\n1,1,1\n",
            "time must increase; sample 2 (1 s) lies before sample 1 (2 s)" + ORDERED,
        ),
        (GAIN + HEADER + "0,0,1\n1,nan,1\n", "line 4, position: 'nan' is not a finite number" + FILL),
        (GAIN + HEADER + "0,0,1\n1,1,-inf\n", "line 4, reference: '-inf' is not a finite number" + FILL),
        (GAIN + HEADER + "0,0,1\n1,1e999,1\n", "line 4, position: '1e999' is not a finite number" + FILL),
        (
            GAIN + HEADER + "0,0,1\n1,1e300,1\n",
            "position reaches 1e+300 in SI units; up to 1e+15 is read, check its unit",
        ),
        (
            GAIN + HEADER + "0,0,1\n1,1e-200,1\n",
            "position reaches no more than 1e-200 in SI units; 1e-150 and more, or 0, is read, check its unit",
        ),
        (GAIN + HEADER + "0,0,1\n1,,1\n", "line 4, position: the value is missing" + FILL),
        (GAIN + HEADER + "0,0,1\n1,on,1\n", "line 4, position: 'on' is not a number" + FILL),
        (GAIN + HEADER + "0,0,1\n1,1_0,1\n", "line 4, position: '1_0' is not a number" + FILL),
        (GAIN + HEADER + "0,0,1\n1,\x1b[31m\x07,1\n", "line 4, position: '\\x1b[31m\\x07' is not a number" + FILL),
        (
            GAIN + HEADER + "0,0,1\n1," + "x" * 99 + ",1\n",
            "line 4, position: '" + "x" * 40 + "…' is not a number" + FILL,
        ),
        (GAIN + HEADER + "0,0,1\n1,1\n2,1,1\n", "line 4 has 2 values where the header row has 3"),
        (
            GAIN + HEADER + "0,0,1\n1,1\n",
            "line 4 has 2 values where the header row has 3; if the log was cut off there, delete this last line",
        ),
        (
            GAIN + HEADER + "0,0,1\n1,1,1,1\n",
            "line 4 has 4 values where the header row has 3",
        ),
        (
            GAIN + HEADER + "0,0,0,5,0,1\n1,0,0,5,0,1\n",
            "the rows have 6 values where the header row has 3; where commas are decimal too, separate the columns by"
            " semicolons",
        ),
        (
            GAIN + HEADER.replace(",", ";") + "0;0;1\n1;0,5;0.1\n",
            "line 4, position: '0,5' has a comma where other numbers have points; write all numbers with one decimal"
            " sign and without separators of thousands",
        ),
        (
            GAIN + "time,position [blub],reference\n" + TWO,
            "column position: 'blub' is no unit; write e.g. [s], [mm], [rad] or [V]",
        ),
        (GAIN + "time [m],position,reference\n" + TWO, "time is in 'm', which is not a unit for it; give it in s"),
        (
            GAIN + "time,position [s],reference\n" + TWO,
            "position is in 's', which is not a unit for it; give it in m or rad",
        ),
        (
            GAIN + "time,position [m],reference [rad]\n" + TWO,
            "reference is in 'rad', which contradicts the unit of position; correct that, or give reference in m",
        ),
        (
            "# kp = 60 V/rad\ntime,position [m],reference\n" + TWO,
            "kp is in 'V/rad', which contradicts the unit of position; correct that, or give kp in V/m",
        ),
        ("# kp = 60 V s\n" + HEADER + ROWS, "kp is in 'V s', which is not a unit for it" + LAW),
        (
            "# kp = 6 A/m\n# voltage_limit = 9 V\n" + HEADER + ROWS,
            "voltage_limit is in 'V', which contradicts the unit of kp; correct that, or give voltage_limit in A",
        ),
        (
            "time,position,voltage [W]\n" + TWO,
            "voltage is in 'W', which is not a unit for it; give it in V, or A, N, N m, %, pwm in place of V",
        ),
        ("# kp = nan\n" + HEADER + ROWS, "kp must be a number, perhaps with a unit; 'nan' is not a number"),
        ("# kp = \n" + HEADER + ROWS, "kp must be a number, perhaps with a unit; '' is not a number"),
        (
            "# kp = 1,5\n" + HEADER + ROWS,
            "kp must be a number, perhaps with a unit; '1,5' has a decimal comma; write a point",
        ),
        ("# kp = 1e99\n" + HEADER + ROWS, "kp reaches 1e+99 in SI units; up to 1e+15 is read, check its unit"),
        ("# kp = 1\n# kp = 2\n" + HEADER + ROWS, "the comment lines give kp twice, with different values; keep one"),
        ("# kd = 1\n" + HEADER + ROWS, "kd is given without kp; give both"),
        (
            "# kp = 1\n# kv = 0.5\n" + HEADER + ROWS,
            "kv is given and controller = pd has none; its gains are kp, kd, ki",
        ),
        (
            "# controller = cascade\n# kp = 1\n# kv = 1\n# ki = 1\n" + HEADER + ROWS,
            "ki is given and controller = cascade has none; its gains are kp, kv, kiv",
        ),
        (
            "# controller = cascade\n# kp = 1\n" + HEADER + ROWS,
            "controller = cascade needs kv, the gain of its speed loop; give it",
        ),
        (
            "# controller = cascade\n# kp = 1 V/m\n# kv = 1\n" + HEADER + ROWS,
            "kp is in 'V/m', which is not a unit for it; give it in 1/s",
        ),
        ("# ki = 2\n" + HEADER + ROWS, "ki is given without kp; give both"),
        (
            "# kp = 1\n# ki = 2\n# anti_windup = clamping\n" + HEADER + ROWS,
            "anti_windup needs the limit of the command; give voltage_limit",
        ),
        (
            "# kp = 1\n# current_limit = 2\n" + HEADER + ROWS,
            "current_limit is given and the command is in V; give voltage or gains in A",
        ),
        (
            "# kp = 1\n# current_limit = 2 A\n# voltage_limit = 2\n" + HEADER + ROWS,
            "voltage_limit and current_limit are given both; keep the one that limits the command",
        ),
        (
            "# kp = 1\n# controller = lqr\n" + HEADER + ROWS,
            "controller must be pd or pid or cascade, got 'lqr'",
        ),
        ("# kp = 1\n# derivative_on = x\n" + HEADER + ROWS, "derivative_on must be measurement or error, got 'x'"),
        ("# kp = 1\n# derivative_filter = 0\n" + HEADER + ROWS, "derivative_filter must lie in (0, 1], got 0.0"),
        ("# kp = 1\n# derivative_filter = 0.3 V\n" + HEADER + ROWS, "derivative_filter has no unit, got 'V'"),
        (
            "# kp = 1\n# derivative_window = 1.5\n" + HEADER + ROWS,
            "derivative_window must be a whole number of samples, at least 1, got 1.5",
        ),
        ("# kp = 1\n# encoder_resolution = -1e-5\n" + HEADER + ROWS, "encoder_resolution must be positive, got -1e-05"),
        ("# kp = 1\n# encoder_resolution = 0\n" + HEADER + ROWS, "encoder_resolution must be positive, got 0"),
        (
            "# kp = 1\n# control_period = 5 m\n" + HEADER + ROWS,
            "control_period is in 'm', which is not a unit for it; give it in s",
        ),
        (
            "# kp = 1\ntime,position [counts],reference\n" + TWO,
            "column position is in encoder counts; give counts_per_unit, counts per m or rad, or counts_per_rev",
        ),
        (
            "# kp = 1\n# counts_per_unit = 10\ntime,position [mm],reference\n" + TWO,
            "position is in 'mm' and counts_per_unit is given too; give only one of the two",
        ),
        (
            b"\xff\x00\x01\x02",
            "is a binary file of an unknown kind; see the documentation for the formats that are read",
        ),
        (b"\x93\x94abc\xff", TEXT),
        ("time,pos".encode("utf-16"), "the header row is not followed by numbers"),
        (b"PAR1....", "is a damaged Parquet file; write it again"),
        (b"TDSm....", "holds no columns of numbers"),
        (b"MDF     4.10    ", "is a damaged MDF file; record or export it again"),
        (b"\x89HDF\r\n\x1a\n...", "is a damaged HDF5 file; write it again"),
        (b"PK\x03\x04...", "is a damaged workbook, or another kind of ZIP file; save it again as .xlsx"),
        *(
            (bz2.compress(b"t,q\n0,1\n", level), "is compressed by bzip2; unpack it first, or pack it by gzip")
            for level in range(1, 10)
        ),
        (lzma.compress(b"t,q\n0,1\n"), "is compressed by xz; unpack it first, or pack it by gzip"),
        (b"\x28\xb5\x2f\xfd\x24\x08A\x00", "is compressed by Zstandard; unpack it first, or pack it by gzip"),
        (b"ARROW1\x00\x00", "is an Arrow (Feather) file, which is not read; save it as Parquet"),
        (pickle.dumps({"t": [0.0]}), "is a pickle, which may run code and is not read; save it as CSV or Parquet"),
        (pickle.dumps({"t": [0.0]}, 2), "is a pickle, which may run code and is not read; save it as CSV or Parquet"),
        (b"CDF\x01\x00\x00", "is a NetCDF file of version 3, which is not read; save it as version 4 or as CSV"),
        (b"%PDF-1.7\n", "is a PDF, which holds no signals; give the log itself"),
        (packed(("a.csv",)), "is a ZIP archive of 'a.csv'; unpack it first"),
        (packed(("a.csv", "b/c.csv")), "is a ZIP archive of 2 files, the first of them 'a.csv'; unpack it first"),
        (
            packed(("[Content_Types].xml",)),
            "is a damaged workbook, or another kind of ZIP file; save it again as .xlsx",
        ),
        (database(), "is an SQLite database, and no ROS 2 bag; export its table as CSV"),
        (b"\x1f\x8b...", "is a damaged gzip file; pack it again"),
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM",
            "is a damaged MAT file; save it again with -v7",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_by_one_sentence(write, content, sentence):
    assert refusal(write(content)) == sentence


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"settings": {"kp": float("nan")}}, "kp must be a finite number, got nan"),
        ({"settings": {"kp": 10**400}}, "kp must be a finite number, got inf"),
        ({"settings": {"kp": True}}, "kp must be a number, got bool True"),
        ({"settings": {"kp": [1]}}, "kp must be a number, got list [1]"),
        ({"settings": {"name": 3}}, "name must be a text, got int 3"),
        ({"columns": {"pos": "x"}}, "columns: no signal is named 'pos'; did you mean 'position'?"),
        ({"columns": {"position": 3}}, "columns: position must be a text, got int 3"),
        (
            {"columns": {"position": "qm"}},
            "no column named 'qm' for position; the columns are 'time, position, reference'",
        ),
        ({"units": {"place": "m"}}, "units: no signal is named 'place'; known are " + SIGNALS),
        ({"units": {"position": "blub"}}, "column position: 'blub' is no unit; write e.g. [s], [mm], [rad] or [V]"),
    ],
)
def test_wrong_options_are_refused_by_one_sentence(write, options, sentence):
    assert refusal(write(PLAIN), **options) == sentence


def test_unknown_setting_of_the_caller_names_the_known_ones(write):
    assert refusal(write(PLAIN), settings={"gain": 1}).startswith("no setting is named 'gain'; known are name, kp, kd,")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_folders_pipes_devices_and_missing_files_are_refused(tmp_path):
    assert refusal(tmp_path) == "is a folder, not a file"
    assert refusal(tmp_path / "no.csv") == "cannot be opened: no such file or directory"
    os.mkfifo(tmp_path / "pipe.csv")
    assert refusal(tmp_path / "pipe.csv") == "is a device or a pipe; records are read from regular files"
    assert refusal(Path("/dev/zero")) == "is a device or a pipe; records are read from regular files"


def test_path_with_control_characters_is_escaped(tmp_path):
    with pytest.raises(InputError) as refused:
        read_record(str(tmp_path / "a\x1b[31m\nb\0.csv"))
    assert str(refused.value) == f"{tmp_path}/a\\x1b[31m\\nb\\x00.csv: cannot be opened: embedded null byte"


def test_large_files_are_refused(write, monkeypatch):
    monkeypatch.setattr(files, "MAX_BYTES", 2**20)
    assert refusal(write(b"1" * (2**21))) == "has 2 MiB; files up to 1 MiB are read"


def test_too_many_columns_are_refused(write):
    assert refusal(write(",".join(["1"] * 1001) + "\n")) == "the table has 1001 columns; at most 1000 are read"


def test_quotes_are_short_whatever_the_file_holds(write):
    secret = "s3cret" * 30
    for content in (secret, f"# kp = {secret}\n{HEADER}{ROWS}", f"{secret},{secret}\n1,2\n", f"{HEADER}0,{secret},1\n"):
        assert refusal(write(content)).count("s3cret") <= 40 // 6


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_read_or_refused(tmp_path_factory, content):
    read_or_refuse(tmp_path_factory, content)


NUMBERS = st.one_of(st.floats().map(repr), st.integers().map(str), st.text(max_size=8))


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["kp", "kd", "ki", "name", "counts_per_unit", "x"]), NUMBERS), max_size=3),
    st.sampled_from(["time,position,reference", "time [ms],position [deg],voltage", "t;position;voltage [A];x"]),
    st.lists(st.lists(NUMBERS, min_size=2, max_size=4), max_size=5),
)
def test_nearly_right_files_are_read_or_refused(tmp_path_factory, comments, header, rows):
    lines = [*(f"# {key} = {value}" for key, value in comments), header, *(",".join(row) for row in rows)]
    read_or_refuse(tmp_path_factory, "\n".join(lines).encode("utf-8", "surrogatepass"))


def read_or_refuse(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    path.write_bytes(content)
    try:
        record = read_record(path, settings={"kp": 1})
    except InputError as error:
        assert str(error).isprintable()  # noqa: PT017 - either outcome is right
    else:
        assert np.isfinite(record.position).all()


# ---- MAT


def mat(**variables):
    stream = io.BytesIO()
    scipy.io.savemat(stream, variables, do_compression=variables.pop("compress", False))
    return stream.getvalue()


COLUMN = np.arange(5.0)[:, None]


@pytest.mark.parametrize("compress", [False, True])
def test_mat_vectors_are_read_whatever_else_is_in_the_file(write, compress):
    content = mat(
        t=COLUMN * 1e-3,
        qm=np.arange(5, dtype=np.int16),
        vir=COLUMN.T,
        extra={"a": 1},
        note="text",
        image=np.eye(3),
        compress=compress,
    )
    record = read_record(
        write(content, "run.mat"),
        columns={"position": "qm", "voltage": "vir"},
        units={"position": "mm"},
        settings={"kp": 3, "name": "drive"},
    )
    assert record.position == pytest.approx(np.arange(5) * 1e-3)
    assert (record.name, record.controller.kp) == ("drive", 3.0)


def test_mat_is_known_by_its_content(write):
    content = mat(time=COLUMN, position=COLUMN, voltage=COLUMN)
    assert len(read_record(write(content, "run.dat"))) == 5


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (
            mat(data={"t": [1, 2]}),
            "no column named position; the columns are 't, data'" + MAP,
        ),
        (mat(time=COLUMN, position={"a": 1}), "variable 'position' is a struct, " + PLAIN_VECTOR),
        (mat(time=COLUMN, position=np.array([1, "a"], dtype=object)), "variable 'position' is a cell, " + PLAIN_VECTOR),
        (mat(time=COLUMN, position="text"), "variable 'position' is a char, " + PLAIN_VECTOR),
        (
            mat(time=COLUMN, position=np.eye(5)),
            "the position may be one of 'position(:,1)', 'position(:,2)', 'position(:,3)', 'position(:,4)' and 1 other;"
            " say which, e.g. --column position=position(:,1) or --column position=position(:,2)",
        ),
        (mat(time=COLUMN, position=COLUMN * 1j), "variable 'position' is complex; a signal is real"),
        (mat(time=COLUMN, position=np.arange(3.0), voltage=COLUMN), "position has 3 samples, time has 5"),
        (mat(time=COLUMN, position=COLUMN * np.nan, voltage=COLUMN), "position must be finite; sample 0 is nan"),
        (mat(time=COLUMN), "no column named position; the columns are 'time'" + MAP),
        (mat(time=COLUMN, position=COLUMN, voltage=COLUMN)[:200], "is a damaged MAT file; save it again with -v7"),
        (b"junk", "is not a MAT v5 or v7.3 file (version 4, or damaged); save it with -v7 in MATLAB"),
        (
            b" " * 124 + b"\x00\x01IM" + struct.pack("<II", 15, 4) + b"abcd",
            "is a damaged MAT file; save it again with -v7",
        ),
    ],
)
def test_mat_that_cannot_be_read_is_refused_by_one_sentence(write, content, sentence):
    assert refusal(write(content, "run.mat")) == sentence


def test_mat_that_would_fill_the_memory_is_refused(write, monkeypatch):
    monkeypatch.setattr(files, "MAX_BYTES", 2**20)
    long = np.zeros(100_000)
    content = mat(time=long, position=long, voltage=long, compress=True)
    assert len(content) < 10_000
    assert refusal(write(content, "run.mat")) == "holds more than 1 MiB of numbers, the most that is read"


def test_mat_bomb_is_inflated_no_further_than_needed(write):
    bomb = zlib.compress(struct.pack("<II", 14, 2**32 - 1) + bytes(2**24), 9)
    content = b" " * 124 + b"\x00\x01IM" + struct.pack("<II", 15, len(bomb)) + bomb
    assert refusal(write(content, "run.mat")) == "is a damaged MAT file; save it again with -v7"


@pytest.mark.parametrize("kind", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"])
def test_mat_values_are_those_that_scipy_reads(write, kind):
    values = np.array([0, 1, 100, 7, 3]).astype(kind)
    content = mat(time=COLUMN, position=values, voltage=values[:, None], compress=kind in ("f8", "i2"))
    expected = scipy.io.loadmat(io.BytesIO(content))["position"].ravel()
    record = read_record(write(content, "run.mat"))
    assert record.position.tolist() == expected.astype(float).tolist()
    assert record.voltage.tolist() == expected.astype(float).tolist()


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 700), st.binary(min_size=1, max_size=8))
def test_damaged_mat_is_read_or_refused(tmp_path_factory, at, junk):
    content = bytearray(mat(time=COLUMN, position=COLUMN, voltage=COLUMN))
    content[at : at + len(junk)] = junk
    read_or_refuse(tmp_path_factory, bytes(content))


# ---- what is in memory


def test_dataframe_is_read_like_a_file():
    frame = pd.DataFrame({"time [ms]": [0, 1, 2], "position [mm]": [0, 0, 1], "u": [1, 2, 3]})
    record = record_from_dataframe(frame, columns={"voltage": "u"}, units={"voltage": "A"})
    assert record.time.tolist() == [0.0, 0.001, 0.002]
    assert record.position == pytest.approx([0, 0, 1e-3])
    assert record.command_unit == "A"
    frame.iloc[0, 2] = 99
    assert record.voltage[0] == 1.0


@pytest.mark.parametrize(
    "index",
    [
        pd.Index([0.0, 0.001, 0.002], name="time"),
        pd.Index([0, 1, 2], name="time [ms]"),
        pd.to_timedelta([0, 1, 2], unit="ms"),
        pd.to_datetime(["2024-01-01 00:00:00.000", "2024-01-01 00:00:00.001", "2024-01-01 00:00:00.002"]),
    ],
    ids=["named", "with unit", "timedelta", "dates"],
)
def test_index_of_a_dataframe_is_the_time(index):
    frame = pd.DataFrame({"position": [0, 0, 1.0], "voltage": [1, 2, 3]}, index=index)
    assert record_from_dataframe(frame).time == pytest.approx([0, 0.001, 0.002], abs=1e-12)


@pytest.mark.parametrize(
    ("frame", "sentence"),
    [
        ([1, 2], "a pandas DataFrame is needed, got list"),
        (
            pd.DataFrame({"time": [0, 1], "position": ["a", "b"], "voltage": [0, 1]}),
            "column 'position' holds values that are not numbers",
        ),
        (
            pd.DataFrame({"time": [0, 1], "position": [0, 1j], "voltage": [0, 1]}),
            "column 'position' is complex; a signal is real",
        ),
        (
            pd.DataFrame({"time": [0, 1], "position": [0, None], "voltage": [0, 1]}),
            "position must be finite; sample 1 is nan",
        ),
        (
            pd.DataFrame([[0, 1, 2, 3], [1, 1, 2, 3]], columns=["time", "position", "position", "voltage"]),
            "2 columns are named 'position'; say which, e.g. --column position=2 or --column position=3",
        ),
        (pd.DataFrame({"position": [0, 1.0]}), "no column named time; the columns are 'position'" + CLOCKLESS),
        (
            pd.DataFrame(),
            "holds no columns of numbers",
        ),
    ],
)
def test_dataframe_that_is_no_record_is_refused_by_one_sentence(frame, sentence):
    with pytest.raises(InputError) as refused:
        record_from_dataframe(frame)
    assert str(refused.value) == sentence


def response(**changes):
    given = {"time": [0, 1, 2], "outputs": [0.0, 1, 2], "inputs": [5.0, 5, 5], "output_labels": ["y"]}
    return SimpleNamespace(**{**given, "input_labels": ["u"], "sysname": "loop", **changes})


def test_single_output_and_input_need_no_names():
    driven = record_from_timeresponse(response())
    assert (driven.name, driven.voltage.tolist(), driven.reference) == ("loop", [5, 5, 5], None)
    closed = record_from_timeresponse(response(), settings={"kp": 2})
    assert closed.reference.tolist() == [5, 5, 5]


def test_labels_of_a_response_are_columns():
    several = response(
        outputs=np.array([[0.0, 1, 2], [7, 8, 9]]), output_labels=["voltage", "position"], input_labels=["reference"]
    )
    record = record_from_timeresponse(several)
    assert (record.position.tolist(), record.voltage.tolist()) == ([7, 8, 9], [0, 1, 2])
    assert record.reference.tolist() == [5, 5, 5]
    mapped = record_from_timeresponse(
        response(outputs=several.outputs, output_labels=["a", "b"]), columns={"position": "b", "voltage": "a"}
    )
    assert mapped.position.tolist() == [7, 8, 9]


def test_python_control_response_is_read():
    control = pytest.importorskip("control")
    plant = control.tf([2.0], [1, 6, 0], name="axis")
    record = record_from_timeresponse(control.step_response(plant, np.linspace(0, 1, 101)))
    assert (len(record), record.name) == (101, "axis")
    assert np.ptp(record.position) > 0.1
    two = control.forced_response(control.ss([[0]], [[1, 1]], [[1]], [[0, 0]]), [0, 1, 2], np.ones((2, 3)))
    chosen = record_from_timeresponse(two, columns={"position": "y[0]", "voltage": "u[1]"})
    assert chosen.voltage.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (3, "a time response with time, outputs and inputs is needed; time, outputs, inputs is missing"),
        (
            response(outputs=np.ones((2, 3)), output_labels=["a", "b"]),
            "which output is the position; map it, e.g. columns={'position': 'a'}",
        ),
        (
            response(outputs=np.ones((1, 2, 3)), output_labels=["a"]),
            "the response has 2 rows of outputs for 1 labels; give one trace",
        ),
    ],
)
def test_response_that_is_no_record_is_refused_by_one_sentence(given, sentence):
    with pytest.raises(InputError) as refused:
        record_from_timeresponse(given)
    assert str(refused.value) == sentence


# ---- manners


def test_importing_reading_loads_nothing_slow():
    script = "import sys, servolens.reading; print(*sorted({'scipy','pint','pandas','control'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_a_million_rows_are_read(tmp_path):
    n = 1_000_000
    block = "".join(f"{k % 1000 * 1e-3:.3f},0.1,0.0123456,5.25\n" for k in range(1000))
    lines = block.splitlines()
    path = tmp_path / "big.csv"
    with path.open("w", encoding="utf-8") as stream:
        stream.write("# kp = 60\ntime,reference,position,voltage\n")
        for second in range(n // 1000):
            stream.writelines(f"{second}{line[1:]}\n" for line in lines)
    assert len(read_record(path)) == n


@settings(max_examples=50)
@given(st.sampled_from(["m", "mm", "um", "cm", "inch"]), st.integers(0, 2**31))
def test_unit_of_position_rescales_position_and_nothing_else(unit, seed):
    values = np.random.default_rng(seed).normal(size=5)
    signals = {"time": np.arange(5.0), "position": values, "voltage": values}
    metres = assemble(signals, {"position": "m"})
    other = assemble(signals, {"position": unit})
    factor = {"m": 1, "mm": 1e-3, "um": 1e-6, "cm": 1e-2, "inch": 0.0254}[unit]
    assert other.position == pytest.approx(metres.position * factor, rel=1e-12)
    assert other.voltage.tolist() == metres.voltage.tolist()


# ---- measured data


@needs_data
@pytest.mark.parametrize(
    ("file", "kp", "kd"), [("K1_7", 7, 0), ("K1_8", 8, 0), ("K1_9", 9, 0), ("k1k3_7", 7, 0.271), ("k1k3_9", 9, 0.377)]
)
def test_rotary_arm_logs_agree_with_their_law(file, kp, kd):
    record = read_record(
        DATA / "cu_rotary_arm" / f"bh2017_rigidarm_{file}.csv",
        columns={
            "time": "t_ms",
            "position": "theta_rad",
            "velocity": "thetadot_rad_s",
            "reference": "ref_rad",
            "voltage": "voltage_V",
        },
        units={"time": "ms", "position": "rad", "velocity": "rad/s"},
        settings={"kp": kp, "kd": f"{kd} V s/rad", "derivative": "velocity"},
    )
    assert (len(record), record.length_unit) == (10000, "rad")
    assert record.sample_time == pytest.approx(1e-3)
    assert np.median(np.abs(record.voltage - controller_voltage(record))) < 0.01


@needs_data
@pytest.mark.parametrize(("file", "position", "unit"), [("cdip", "z", "m"), ("adip", "phi1", "rad")])
def test_cart_and_arm_of_the_book_are_read(file, position, unit):
    record = read_record(
        DATA / "kawata_cart_arm" / f"{file}_least_square_data.mat",
        columns={"position": position, "voltage": "v"},
        units={"position": unit},
        settings={"kp": 10},
    )
    assert record.length_unit == unit
    assert record.sample_time == pytest.approx(1e-3)
    assert len(record) > 8000


@needs_data
def test_ball_screw_axis_follows_its_stated_law():
    record = read_record(
        DATA / "emps" / "DATA_EMPS.mat",
        columns={"position": "qm", "reference": "qg", "voltage": "vir"},
        settings={"kp": 38996, "kd": 243.45, "derivative_window": 2},
    )
    assert len(record) == 24841
    difference = (record.voltage - controller_voltage(record))[2:]  # the log begins in motion
    assert np.sqrt(np.mean(difference**2)) < 5e-3


def test_integral_and_cascade_are_read_with_their_units(write):
    pid = (
        "# kp = 0.06 V/mm\n# ki = 0.4 V/(mm s)\n# setpoint_weight = 0.5\n# anti_windup = back_calculation\n"
        "# tracking_time = 20 ms\n# voltage_limit = 10 V\n# integral_before = 500 mV\n"
    )
    found = read_record(write(pid + HEADER + ROWS))
    assert found.controller == Controller(
        kp=60.0,
        ki=found.controller.ki,
        setpoint_weight=0.5,
        anti_windup="back_calculation",
        tracking_time=0.02,
        integral_before=0.5,
    )
    assert found.controller.ki == pytest.approx(400.0)
    ahead = "# kp = 0.06 V/mm\n# kd = 1\n# velocity_feedforward = 0.002 V s/mm\n"
    found = read_record(write(ahead + HEADER + ROWS))
    assert found.controller == Controller(kp=found.controller.kp, kd=1.0, velocity_feedforward=2.0)
    with pytest.raises(InputError, match="velocity_feedforward is given and controller = cascade has none; its gains"):
        read_record(write("# controller = cascade\n# kp = 20\n# kv = 5\n# velocity_feedforward = 2\n" + HEADER + ROWS))
    drive = (
        "# controller = cascade\n# kp = 20 1/s\n# kv = 5 A s/m\n# kiv = 50 A/m\n# feedforward_speed = 0.9\n"
        "# current_limit = 3 A\n# anti_windup = clamping\n"
    )
    found = read_record(write(drive + HEADER + ROWS))
    assert (found.command_unit, found.voltage_limit) == ("A", 3.0)
    assert found.controller == Controller(
        kp=100.0, kd=5.0, integral_rate=10.0, velocity_feedforward=4.5, anti_windup="clamping", law="cascade"
    )


def test_a_column_that_the_caller_maps_is_no_other_signal(tmp_path):
    """A column named reference, mapped to the position, was taken for the reference as well."""
    rows = (f"{0.01 * k},{0.001 * k * k},0.1,3" for k in range(9))
    lines = ["time [s],reference [m],position [m],voltage [V]", *rows]
    (tmp_path / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    read = read_record(tmp_path / "run.csv", columns={"position": "reference"})
    assert read.reference is None
    assert read.position[-1] == pytest.approx(0.064)
    with pytest.raises(InputError, match="reference and position are both to be column 'position'; name one for each"):
        read_record(tmp_path / "run.csv", columns={"reference": "position", "position": "3"})


def test_a_mapped_column_decides_for_no_other_of_its_name(tmp_path):
    """Of two sheets with a velocity one was mapped to the reference: the other was taken silently, not the drive's."""
    time = np.arange(300) * 1e-3
    position = 1e-3 * np.sin(20 * time)
    speed = np.gradient(position, time)
    sheets = {
        "drive": {"time": time, "position": position, "speed": speed, "voltage": 5 * position},
        "cmd": {"time": time, "velocity": 1.1 * position},
        "axis2": {"time": time, "velocity": 7 * speed},
    }
    with pd.ExcelWriter(tmp_path / "log.xlsx") as book:
        for sheet, columns in sheets.items():
            pd.DataFrame(columns).to_excel(book, sheet_name=sheet, index=False)
    read = read_record(tmp_path / "log.xlsx", columns={"reference": "cmd/velocity"})
    assert read.reference == pytest.approx(1.1 * position)
    assert read.velocity == pytest.approx(speed)
