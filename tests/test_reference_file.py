"""A reference that was not logged, from a file of its own: each value holds from its instant to the next."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from servolens import lab
from servolens.campaign import read_records
from servolens.cli import group
from servolens.errors import InputError
from servolens.inputs import as_record
from servolens.reading import read_record

LEVELS = (0.1, 0.02, 0.07)
TRUTH = lab.step_record(lab.NLM2, 60, 4, reference=LEVELS, duration=0.6, noise=1e-5, seed=5)
HELD = "time,reference\n" + "".join(f"{0.6 * k:g},{level:g}\n" for k, level in enumerate(LEVELS))


def log(path, *, unit="", factor=1.0):
    rows = zip(TRUTH.time, TRUTH.position * factor, strict=True)
    path.write_text(
        f"# kp = 60 V/m\n# kd = 4 V s/m\ntime,position{unit}\n" + "".join(f"{t:.9g},{y:.12g}\n" for t, y in rows)
    )
    return path


def beside(path, content):
    path.write_text(content)
    return path


@pytest.mark.parametrize(
    "content",
    [
        HELD,
        "0,0.1\n0.6,0.02\n1.2,0.07\n",
        "t_ms;Sollwert [mm]\n0;100\n600;20\n1200;70\n",
        "time [s]\tvalue [cm]\n-3\t5\n0\t10\n0.6\t2\n1.2\t7\n9\t1\n",
        "cycle,time,target_pos [mm],note\n1,0,100,4\n2,0.6,20,4\n3,1.2,70,4\n",
        "time,reference\n" + "".join(f"{t:.9g},{r:g}\n" for t, r in zip(TRUTH.time, TRUTH.reference, strict=True)),
    ],
    ids=["named", "two columns", "German, ms, mm", "longer than the log", "among others", "each sample"],
)
def test_each_value_holds_until_the_next(tmp_path, content):
    file = beside(tmp_path / "ref.csv", content)
    record = read_record(log(tmp_path / "a.csv"), settings={"reference_file": str(file)})
    assert record.reference == pytest.approx(TRUTH.reference, abs=1e-12)
    assert record.controller.kp == 60


@pytest.mark.parametrize(
    ("content", "part"),
    [
        ("time,reference\n0.5,0.1\n0.7,0\n", "the reference begins at 0.5 s and the record at 0 s; add a row"),
        ("time,reference\n0,0.1\n0.7,0\n0.6,0.1\n", "row 3 of the numbers (0.6 s) follows 0.7 s"),
        ("time,reference\n0,0.1\n0.7,\n0.8,0.1\n", "row 2 of the numbers holds none"),
        ("time,reference [V]\n0,0.1\n0.7,0\n", "reference is in 'V', which is not a unit for it"),
        ("time,reference [foo]\n0,0.1\n0.7,0\n", "'foo' is no unit"),
        ("time,speed,current\n0,0.1,1\n0.7,0,1\n", "it needs two columns, time and reference"),
        ("time,target,setpoint\n0,0.1,1\n0.7,0,1\n", "more than one column that may be the reference"),
        ("nothing here\n", "ref.csv: "),
        ("", "is empty"),
    ],
    ids=["late", "backward", "gap", "volts", "no unit", "no reference", "two", "text", "empty"],
)
def test_what_is_no_reference_is_refused_by_one_sentence(tmp_path, content, part):
    file = beside(tmp_path / "ref.csv", content)
    with pytest.raises(InputError) as refused:
        read_record(log(tmp_path / "a.csv"), settings={"reference_file": str(file)})
    assert part in str(refused.value)
    assert str(refused.value).isprintable()


def test_a_unit_must_be_stated_where_the_position_has_one(tmp_path):
    path = log(tmp_path / "a.csv", unit=" [mm]", factor=1e3)
    file = beside(tmp_path / "ref.csv", HELD)
    with pytest.raises(InputError, match=r"write the unit into the heading, e.g. reference \[mm\]"):
        read_record(path, settings={"reference_file": str(file)})
    beside(file, HELD.replace("reference", "reference [m]"))
    record = read_record(path, settings={"reference_file": str(file)})
    assert record.reference == pytest.approx(TRUTH.reference, abs=1e-12)


def test_a_reference_is_stated_once(tmp_path):
    file = beside(tmp_path / "ref.csv", HELD)
    with pytest.raises(InputError, match="reference and reference_file are given both; keep one"):
        read_record(log(tmp_path / "a.csv"), settings={"reference_file": str(file), "reference": "0.1"})
    logged = beside(tmp_path / "b.csv", "time,position,reference\n0,0,0.1\n1,0.1,0.1\n")
    with pytest.raises(InputError, match="a reference is logged and a file of one is given too"):
        read_record(logged, settings={"reference_file": str(file)})


def test_a_log_cannot_name_a_file(tmp_path):
    file = beside(tmp_path / "ref.csv", HELD)
    path = log(tmp_path / "a.csv")
    path.write_text(f"# reference_file = {file}\n" + path.read_text())
    with pytest.raises(InputError, match="which is not followed; give --reference-file"):
        read_record(path)
    assert read_record(path, settings={"reference_file": str(file)}).reference is not None


def test_a_data_frame_takes_one_too(tmp_path):
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"time": TRUTH.time, "position": TRUTH.position})
    record = as_record(frame, {"kp": 60, "reference_file": str(beside(tmp_path / "ref.csv", HELD))})
    assert record.reference == pytest.approx(TRUTH.reference, abs=1e-12)


def run(*arguments):
    return CliRunner().invoke(group, [str(argument) for argument in arguments])


def test_convert_writes_it_down_and_copies_it(tmp_path, monkeypatch):
    (tmp_path / "logs").mkdir()
    (tmp_path / "axis").mkdir()
    path = log(tmp_path / "logs" / "a.csv")
    beside(tmp_path / "logs" / "ref.csv", HELD)
    monkeypatch.chdir(tmp_path / "logs")
    done = run("convert", path, "--reference-file", "ref.csv", "--out", tmp_path / "axis" / "c.toml")
    assert done.exit_code == 0, done.output
    assert "a file named by you" in " ".join(done.output.split())
    assert sorted(found.name for found in (tmp_path / "axis").iterdir()) == ["a.csv", "c.toml", "ref.csv"]
    monkeypatch.chdir(tmp_path)
    (record,) = read_records(tmp_path / "axis" / "c.toml")
    assert record.reference == pytest.approx(TRUTH.reference, abs=1e-12)
    assert 'reference_file = "ref.csv"' in (tmp_path / "axis" / "c.toml").read_text()


def test_a_folder_does_not_take_it_for_a_log(tmp_path):
    log(tmp_path / "a.csv")
    file = beside(tmp_path / "ref.csv", HELD)
    assert run("check", tmp_path, "--reference-file", file).exit_code == 0
    done = run("identify", tmp_path, "--reference-file", file, "--json", file)
    assert done.exit_code == 2
    assert "would overwrite" in done.output
    assert file.read_text() == HELD


def test_a_campaign_may_not_name_one_outside_its_folder(tmp_path):
    beside(tmp_path / "ref.csv", HELD)
    (tmp_path / "axis").mkdir()
    log(tmp_path / "axis" / "a.csv")
    campaign = beside(tmp_path / "axis" / "c.toml", '[[records]]\nfile = "a.csv"\nreference_file = "../ref.csv"\n')
    with pytest.raises(InputError, match="lies outside its folder"):
        read_records(campaign)
    (record,) = read_records(campaign, data_root=tmp_path)
    assert np.allclose(record.reference, TRUTH.reference)
    beside(campaign, '[[records]]\nfile = "a.csv"\nreference_file = 3\n')
    with pytest.raises(InputError, match="reference_file must be the name of a file"):
        read_records(campaign)
