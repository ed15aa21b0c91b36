"""The commands from outside: statuses, one-line refusals, JSON, and what they print."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from servolens import Controller, Plant, Record, lab, predict
from servolens.cli import group
from servolens.commands import COMMANDS
from servolens.commands.files import about
from servolens.effects import DeadZone
from servolens.errors import InputError, NumericalError
from servolens.model import Model
from servolens.results import to_text

LAB = (("kp60", 60, 0), ("kp80", 80, 0), ("kp100", 100, 0), ("kp80kd5", 80, 5))
SPEC = ("--kp", "100", "--settling-time", "0.5")
HEADER = {"schema", "servolens", "created", "findings"}
QUANTITY = {"value", "stderr", "interval", "unit"}
DESIGN = {"feasible", "kd", "kp", "settling_time", "intervals", "certificate", "verified"}


def write_csv(record, path, *, voltage=True, gains=True):
    lines = [f"# name = {record.name}"]
    if gains:
        lines += [f"# kp = {record.controller.kp} V/m", f"# kd = {record.controller.kd} V s/m"]
    columns = {"time [s]": record.time, "reference [m]": record.reference, "position [m]": record.position}
    if voltage:
        columns["voltage [V]"] = record.voltage
    lines.append(",".join(columns))
    lines += [",".join(repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """A folder of records of the paper's nonlinear cart, and a model of it."""
    folder = tmp_path_factory.mktemp("bench")
    for name, kp, kd in LAB:
        write_csv(lab.step_record(lab.NLM3, kp, kd, noise=1e-5, seed=kp), folder / f"{name}.csv")
    bare = lab.step_record(lab.NLM3, 80, 5, noise=1e-5, seed=7, setup=lab.Setup(name="bare"))
    write_csv(bare, folder / "bare.csv", voltage=False, gains=False)
    done = run("identify", folder / "kp100.csv", "--out", folder / "model.json")
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(group, [str(a) for a in arguments], prog_name="servolens")


def process(*arguments, **options):
    command = [sys.executable, "-m", "servolens", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8", **options)


def finite(text):
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in the JSON"))


def result(kind, *arguments, status=0):
    """Run a command with --json -; return its JSON, after checking header and purity."""
    done = run(*arguments, "--json", "-")
    assert done.exit_code == status, done.output
    body = finite(done.stdout)
    assert list(body)[:4] == ["schema", "servolens", "created", "findings"]
    assert body["schema"] == f"servolens.{kind}/1"
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", body["created"])
    assert all(set(f) == {"code", "severity", "message", "record"} for f in body["findings"])
    return body


def refused(done, status=2):
    """Return the one line of a refusal."""
    assert done.exit_code == status, done.output
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("servolens: error: ")
    assert lines[0].isprintable()
    return lines[0].removeprefix("servolens: error: ")


def is_quantity(value):
    assert set(value) >= QUANTITY
    low, high = value["interval"]
    assert low < value["value"] < high
    assert value["stderr"] == pytest.approx((high - low) / 2 / 1.96, rel=1e-3)


def test_check_tells_each_record_and_its_doubts(bench):
    body = result("check", "check", bench / "kp60.csv", bench / "kp80.csv")
    assert [r["name"] for r in body["records"]] == ["kp 60, kd 0", "kp 80, kd 0"]
    assert all(r["usable"] is True for r in body["records"])
    assert [r["samples"] for r in body["records"]] == [1501, 1501]
    assert [r["sample_time"] for r in body["records"]] == pytest.approx([1e-3, 1e-3])


def test_check_says_no_to_a_record_that_stands_still_and_writes_its_json(here):
    rows = "\n".join(f"{k / 1000},0.1,0.0" for k in range(200))
    (here / "still.csv").write_text(f"# kp = 60\ntime,reference,position\n{rows}\n")
    done = run("check", "still.csv", "--json", "check.json")
    assert done.exit_code == 1
    assert "unfit" in done.stdout
    body = finite((here / "check.json").read_text(encoding="utf-8"))
    assert [r["usable"] for r in body["records"]] == [False]
    assert "error" in {f["severity"] for f in body["findings"]}


@pytest.mark.parametrize("option", ["--kp", "--record-kp"])
def test_check_finds_gains_that_contradict_the_log(bench, option):
    body = result("check", "check", bench / "kp60.csv", option, "70")
    assert "gains_contradict_log" in {f["code"] for f in body["findings"]}


@pytest.fixture(scope="session")
def mirrored(bench, tmp_path_factory):
    """A record whose position has the other sign than its reference."""
    record = lab.step_record(lab.NLM3, 60, noise=1e-5, seed=1, setup=lab.Setup(name="mirrored"))
    path = tmp_path_factory.mktemp("mirrored") / "mirrored.csv"
    write_csv(record.with_({"position": -record.position}), path)
    return path


def test_refusal_names_a_record_once_that_is_called_like_its_file(here):
    time = 0.001 * np.arange(5.0)
    few = Record(time=time, position=time, reference=time, controller=Controller(kp=60.0), name="five")
    few.to_csv(here / "five.csv")
    said = refused(run("identify", "five.csv"))
    assert said == "five.csv: the record has 5 samples; at least 20 are needed, log longer or faster"
    few.with_({"name": "cart"}).to_csv(here / "five.csv")
    assert refused(run("identify", "five.csv")).startswith("five.csv: cart: the record has 5 samples")


def test_wrong_sign_makes_check_say_no(mirrored):
    body = result("check", "check", mirrored, status=1)
    assert [(f["code"], f["severity"]) for f in body["findings"]] == [("wrong_sign", "error")]
    assert [r["usable"] for r in body["records"]] == [False]


def test_wrong_sign_writes_no_model_unless_forced(mirrored, here):
    done = run("identify", mirrored, "--out", "model.json", "--json", "result.json")
    assert done.exit_code == 1
    assert "no model is written: a sign or a unit in mirrored is wrong" in " ".join(done.output.split())
    assert not (here / "model.json").exists()
    body = finite((here / "result.json").read_text(encoding="utf-8"))
    assert {"model_refused", "wrong_sign"} <= {f["code"] for f in body["findings"] if f["severity"] == "error"}
    done = run("identify", mirrored, "--model", "constant", "--out", "model.json", "--force")
    assert done.exit_code == 0, done.output
    assert (here / "model.json").exists()


def test_position_that_begins_again_after_each_turn_writes_no_model_unless_forced(here):
    record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1, duration=0.6)
    turned = np.mod(80.0 * record.position + 1.0, 2.0 * np.pi)
    rows = zip(record.time, turned, record.voltage, strict=True)
    lines = ["time [s],position [rad],voltage [V]", *(",".join(map(str, row)) for row in rows)]
    (here / "r.csv").write_text("\n".join(lines), encoding="utf-8")
    body = result("check", "check", "r.csv", status=1)
    assert "position_wraps" in {f["code"] for f in body["findings"]}
    done = run("identify", "r.csv", "--model", "constant", "--out", "model.json")
    assert done.exit_code == 1
    assert "no model is written: the position of r jumps at each turn" in " ".join(done.output.split())
    assert not (here / "model.json").exists()
    assert run("identify", "r.csv", "--model", "constant", "--out", "model.json", "--force").exit_code == 0


def test_diagnosis_of_a_wrong_sign_writes_no_model_unless_forced(here):
    record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=1, duration=0.6)
    write_csv(record.with_({"voltage": -record.voltage}), here / "r.csv")
    body = result("diagnosis", "diagnose", "r.csv", "--out", "model.json", status=1)
    assert {"model_refused", "wrong_sign"} <= {f["code"] for f in body["findings"]}
    assert not (here / "model.json").exists()
    assert run("diagnose", "r.csv", "--out", "model.json", "--force").exit_code == 0
    assert (here / "model.json").exists()


def test_nothing_identified_from_a_wrong_sign_is_a_no(mirrored, monkeypatch):
    def fails(*_args, **_settings):
        raise NumericalError("the fit diverged")

    monkeypatch.setattr("servolens.identification.identify", fails)
    body = result("identification", "identify", mirrored, status=1)
    assert body["models"] == {}
    assert "the fit diverged" in body["reason"]
    assert refused(run("identify", mirrored, "--force"), 3).endswith("the fit diverged")


def test_identify_gives_all_models_with_errors_and_units(bench):
    body = result("identification", "identify", bench / "kp100.csv")
    assert set(body["models"]) == {"constant", "varying", "velocity"}
    velocity = body["models"]["velocity"]
    is_quantity(velocity["gain"])
    assert velocity["gain"]["unit"] == "m/s^2/V"
    assert velocity["gain"]["value"] == pytest.approx(lab.NLM3.gain, rel=5e-4)
    (effect,) = velocity["effects"]
    assert effect["effect"] == "velocity_decay_damping"
    assert set(effect["parameters"]) == {"alpha1", "alpha2"}
    for model in body["models"].values():
        assert model["fit"]["percent_error"] > 0
        assert model["fit"]["mean_abs_error"] > 0
    varying = body["models"]["varying"]
    is_quantity(varying["gain"])
    assert len(varying["edges"]) == len(varying["damping"]) + 1


def test_identified_model_file_is_the_chosen_one(bench, here):
    assert run("identify", bench / "kp100.csv", "--model", "constant", "--out", "constant.json").exit_code == 0
    constant = finite((here / "constant.json").read_text(encoding="utf-8"))
    velocity = finite((bench / "model.json").read_text(encoding="utf-8"))
    assert constant["schema"] == velocity["schema"] == "servolens.model/1"
    assert constant["effects"] == []
    assert [e["effect"] for e in velocity["effects"]] == ["velocity_decay_damping"]
    assert constant["identified_from"] == ["kp 100, kd 0"]


def test_identify_takes_gains_from_the_command_line_and_says_the_voltage_is_reconstructed(bench):
    options = ("--kp", "80", "--kd", "5 V s/m", "--model", "constant")
    body = result("identification", "identify", bench / "bare.csv", *options)
    assert [f["code"] for f in body["findings"]].count("voltage_reconstructed") == 1
    assert set(body["models"]) == {"constant"}


def test_a_prior_moves_the_gain_it_is_about(bench):
    free = result("identification", "identify", bench / "kp60.csv", "--model", "constant")
    held = result("identification", "identify", bench / "kp60.csv", "--model", "constant", "--prior", "gain=1.5,1e-6")
    assert abs(free["models"]["constant"]["gain"]["value"] - 1.5) > 0.05
    assert held["models"]["constant"]["gain"]["value"] == pytest.approx(1.5, abs=1e-3)


def test_columns_and_units_are_mapped(bench, here):
    lines = (bench / "kp60.csv").read_text(encoding="utf-8").splitlines()
    head = lines.index("time [s],reference [m],position [m],voltage [V]")
    lines[head] = "time,reference,qm,voltage"
    for i in range(head + 1, len(lines)):
        t, r, y, v = lines[i].split(",")
        lines[i] = f"{t},{r},{1e3 * float(y)!r},{v}"
    (here / "mm.csv").write_text("\n".join(lines), encoding="utf-8")
    model = ("--model", "constant")
    mapped = ("--column", "position=qm", "--unit", "position=mm")
    a = result("identification", "identify", "mm.csv", *mapped, *model)
    b = result("identification", "identify", bench / "kp60.csv", *model)
    assert a["models"]["constant"]["gain"]["value"] == pytest.approx(b["models"]["constant"]["gain"]["value"], rel=1e-6)


def test_predict_tells_errors_and_what_is_held_out(bench):
    body = result("prediction", "predict", bench / "model.json", bench / "kp80kd5.csv", bench / "kp100.csv")
    assert [(r["name"], r["held_out"]) for r in body["records"]] == [("kp 80, kd 5", True), ("kp 100, kd 0", False)]
    for record in body["records"]:
        assert 0 < record["percent_error"] < 0.1
        assert 99 < record["fit_percent"] < 100
        assert record["mean_abs_error"] == pytest.approx(record["percent_error"] / 100 * 0.1, rel=1e-2)


def test_predict_sees_the_encoder_as_python_and_diagnose_do(bench, here):
    """Its loop was simulated without the rounding that the positions show."""
    steps = {"reference": [0.05, 0.0, 0.05], "duration": 0.8}
    axis = lab.Truth(gain=1.9, damping=6.0, effects={"dead_zone": {"width": 0.3}})
    record = lab.step_record(axis, kp=100, kd=5, **steps, encoder=2e-5)
    replace(record, encoder_resolution=None).to_csv(here / "unstated.csv")
    plant = Plant(gain=1.9, damping=6.0, effects=(DeadZone(width=0.3),))
    (here / "true.json").write_text(
        to_text({"schema": "servolens.model/1", **Model(plant=plant).to_json()}), encoding="utf-8"
    )
    (told,) = result("prediction", "predict", "true.json", "unstated.csv")["records"]
    ((expected,),) = predict(plant, here / "unstated.csv").errors
    ((stated,),) = predict(plant, record).errors
    assert told["rms_error"] == expected.rms_error == pytest.approx(stated.rms_error, rel=1e-3)


def test_predict_says_when_it_is_driven_by_the_voltage(bench, here):
    text = (bench / "kp60.csv").read_text(encoding="utf-8")
    (here / "open.csv").write_text(re.sub(r"# k[pd].*\n", "", text).replace("reference", "unused"), encoding="utf-8")
    body = result("prediction", "predict", bench / "model.json", "open.csv")
    assert "voltage_driven" in {f["code"] for f in body["findings"]}


def test_predict_refuses_a_record_in_other_units(bench, here):
    text = (bench / "kp60.csv").read_text(encoding="utf-8").replace("[m]", "[rad]").replace("/m\n", "/rad\n")
    (here / "arm.csv").write_text(text, encoding="utf-8")
    assert "positions in rad" in refused(run("predict", bench / "model.json", "arm.csv"))


def test_design_gives_the_least_gain_and_every_interval(bench):
    body = result("design", "design", bench / "model.json", *SPEC)
    assert set(body) >= DESIGN
    assert body["feasible"] is True
    assert body["kp"] == 100
    assert body["kd"] == pytest.approx(body["intervals"][0][0])
    assert len(body["intervals"]) == 2
    low, high = body["certificate"]["searched"]
    assert low == 0
    assert high > body["intervals"][-1][1]
    assert body["certificate"]["kind"] == "sensitivity"
    assert body["verified"]["meets"] is True
    assert body["settling_time"] <= 0.5


def test_design_for_two_models_holds_for_both(bench, here):
    assert run("identify", bench / "kp100.csv", "--model", "constant", "--out", "constant.json").exit_code == 0
    alone = result("design", "design", "constant.json", *SPEC)
    both = result("design", "design", bench / "model.json", "constant.json", *SPEC)
    assert both["kd"] >= alone["kd"]


def test_infeasible_design_exits_with_1_and_writes_its_json(bench, here):
    done = run("design", bench / "model.json", "--kp", 1, "--settling-time", 0.1, "--json", "design.json")
    assert done.exit_code == 1
    body = finite((here / "design.json").read_text(encoding="utf-8"))
    assert (body["feasible"], body["kd"], body["intervals"]) == (False, None, [])
    assert body["reason"]
    assert " ".join(done.stdout.split()).count("No kd in") == 1


def test_design_options_reach_the_specification(bench):
    options = ("--band", "0.02", "--reference", "0.05", "--overshoot", "0.3", "--voltage-limit", "20", "--kd-max", "12")
    loop = ("--control", "sampled", "--sample-time", "0.002", "--derivative-filter", "0.5")
    spec = result("design", "design", bench / "model.json", *SPEC, *options, *loop)["spec"]
    wanted = {"band": 0.02, "reference": 0.05, "overshoot": 0.3, "voltage_limit": 20, "kd_max": 12}
    assert {k: spec[k] for k in wanted} == wanted
    assert (spec["control"], spec["sample_time"], spec["derivative_filter"]) == ("sampled", 0.002, 0.5)


def test_compare_shows_the_linear_gain_breaking_the_spec(bench):
    body = result("comparison", "compare", bench / "kp100.csv", *SPEC)
    assert set(body["linear"]) >= DESIGN
    assert body["linear"]["on_nonlinear"]["meets"] is False
    assert body["linear"]["on_nonlinear"]["settling_time"] > 0.5
    assert body["nonlinear"]["feasible"] is True
    text = " ".join(run("compare", bench / "kp100.csv", *SPEC).stdout.split())
    assert re.search(r"the diagnosed plant settles in 0\.5\d* s and misses the 0\.5 s target", text)


def test_compare_exits_with_1_where_no_gain_meets_the_spec(bench):
    options = ("--record-kp", "80", "--kd", "5", "--kp", "100", "--settling-time", "0.1")
    body = result("comparison", "compare", bench / "bare.csv", *options, status=1)
    assert body["nonlinear"]["feasible"] is False


@pytest.mark.slow
def test_report_is_one_page(bench, here):
    done = run("report", bench / "kp100.csv", "--out", "report.html", "--json", "report.json")
    assert done.exit_code == 0, done.output
    page = (here / "report.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert set(finite((here / "report.json").read_text(encoding="utf-8"))) >= HEADER


@pytest.mark.slow
def test_demo_writes_a_page_and_its_numbers(here):
    done = run("demo", "--out", "out")
    assert done.exit_code == 0, done.output
    assert (here / "out" / "report.html").stat().st_size > 10_000
    assert set(finite((here / "out" / "results.json").read_text(encoding="utf-8"))) >= HEADER


def test_records_come_from_folders_and_campaigns(bench, here):
    (bench / "campaign.toml").write_text('[[records]]\nfile = "kp60.csv"\n[[records]]\nfile = "kp80.csv"\n')
    body = result("check", "check", bench / "campaign.toml")
    assert [r["name"] for r in body["records"]] == ["kp 60, kd 0", "kp 80, kd 0"]
    folder = result("check", "check", bench, "--kp", "60")
    assert len(folder["records"]) == len(LAB) + 1


BAD_FILES = {
    "empty": (b"", "is empty"),
    "junk": (bytes(range(256)) * 8, ""),
    "header only": (b"time,reference,position\n", ""),
    "no numbers": (b"time,reference,position\na,b,c\nd,e,f\n", "number"),
    "nan": (b"# kp = 60\ntime,reference,position\n0,0.1,0\n0.001,0.1,nan\n0.002,0.1,0\n", ""),
    "one sample": (b"# kp = 60\ntime,reference,position\n0,0.1,0\n", "2 samples"),
    "decreasing time": (b"# kp = 60\ntime,reference,position\n0,1,0\n0.002,1,0\n0.001,1,0\n", "time must increase"),
    "repeated time": (b"# kp = 60\ntime,reference,position\n0,1,0\n0.001,1,0\n0.001,1,0\n", "repeats"),
    "no position": (b"time,reference\n0,1\n1,1\n", "position"),
    "unknown unit": (b"# kp = 60\ntime [fortnite],reference,position\n0,1,0\n1,1,0\n", "fortnite"),
    "neither gains nor voltage": (b"time,reference,position\n0,1,0\n1,1,0\n", "kp"),
    "a gain of another law": (b"# kp = 60\n# kv = 3\ntime,reference,position\n0,1,0\n1,1,0\n", "kv"),
}


@pytest.mark.parametrize(("content", "words"), BAD_FILES.values(), ids=BAD_FILES)
@pytest.mark.parametrize("command", ["check", "identify"])
def test_an_unusable_file_is_refused_in_one_line_that_names_it(here, command, content, words):
    (here / "bad.csv").write_bytes(content)
    line = refused(run(command, "bad.csv", "--json", "out.json"))
    assert line.startswith("bad.csv: ")
    assert words in line
    assert not (here / "out.json").exists()


def test_constant_position_is_unfit_for_identification(here):
    rows = "\n".join(f"{k / 1000},0.1,0.0" for k in range(200))
    (here / "still.csv").write_text(f"# kp = 60\ntime,reference,position\n{rows}\n")
    assert refused(run("identify", "still.csv", "--out", "m.json")).startswith("still.csv: ")
    assert [p.name for p in here.iterdir()] == ["still.csv"]


USAGE = {
    "unknown command": (["tuned"], "no such command 'tuned'; did you mean 'tune'? See servolens --help"),
    "unknown option": (["check", "r.csv", "--fast"], "no such option"),
    "misspelt option": (["tune", "r.csv", "--settle", "1"], "; did you mean '--setting' or '--settling-time'? See "),
    "missing record": (["check"], "missing argument"),
    "missing file": (["check", "nowhere.csv"], "nowhere.csv: "),
    "missing model": (["predict", "nowhere.json", "r.csv"], "nowhere.json: "),
    "bad number": (["design", "m.json", "--kp", "ten", "--settling-time", "1"], "'ten' is not a finite number"),
    "decimal comma": (
        ["tune", "kp60.csv", "--settling-time", "0,5"],
        "'0,5' is not a finite number; write it with a point and without a unit, in that of the help",
    ),
    "number with a unit": (
        ["tune", "kp60.csv", "--settling-time", "500ms"],
        "'500ms' is not a finite number; write it with a point and without a unit, in that of the help",
    ),
    "unit without its signal": (
        ["check", "kp60.csv", "--unit", "mm"],
        "'mm' is not SIGNAL=NAME or SIGNAL=UNIT, e.g. position=qm or position=mm",
    ),
    "nan": (["design", "m.json", "--kp", "nan", "--settling-time", "1"], "'nan' is not a finite number"),
    "missing option": (["design", "m.json", "--kp", "1"], "missing option '--settling-time'"),
    "negative gain": (["design", "m.json", "--kp", "-1", "--settling-time", "1"], "kp must be positive"),
    "bad choice": (["identify", "r.csv", "--model", "cubic"], "'cubic' is not one of"),
    "bad prior": (["identify", "r.csv", "--prior", "gain=4"], "NAME=MEAN,SD"),
    "bad column": (["identify", "r.csv", "--column", "q=qm"], "'q' is no signal"),
    "column without a name": (["identify", "r.csv", "--column", "position"], "SIGNAL=NAME"),
    "column twice": (["check", "r.csv", "--column", "time=a", "--column", "time=b"], "twice"),
    "empty name": (["check", ""], "empty"),
    "varying model file": (["identify", "r.csv", "--model", "varying", "--out", "m.json"], "varying"),
    "json folder": (["check", "r.csv", "--json", "no/such/x.json"], "no/such/x.json: the folder"),
    "json without a name": (["check", "r.csv", "--json", ""], "--json needs the name of a file, this name is empty"),
    "model without a name": (["predict", "", "r.csv"], "a model's file name is empty"),
    "json is a folder": (["check", "r.csv", "--json", "."], "folder"),
    "json over input": (["check", "r.csv", "--json", "r.csv"], "would overwrite"),
    "json over out": (["identify", "r.csv", "--json", "x.json", "--out", "x.json"], "would overwrite"),
    "report without out": (["report", "r.csv"], "missing option '--out'"),
    "spec in halves": (["report", "r.csv", "--out", "r.html", "--settling-time", "1"], "needs --kp"),
    "demo over a file": (["demo", "--out", "r.csv"], "is not a folder"),
    "control characters": (["check", "a\x1b[2J\nb.csv"], r"\x1b"),
    "not a model": (["predict", "r.csv", "r.csv"], "is not JSON"),
    "deep model": (["predict", "deep.json", "r.csv"], "deep.json: "),
}


@pytest.mark.parametrize(("arguments", "words"), USAGE.values(), ids=USAGE)
def test_wrong_use_is_refused_in_one_line(here, arguments, words):
    (here / "r.csv").write_text("time,voltage,position\n0,1,0\n1,1,1\n2,1,3\n")
    (here / "deep.json").write_text("[" * 100_000)
    before = {p: p.read_bytes() for p in here.iterdir()}
    assert words in refused(run(*arguments))
    assert {p: p.read_bytes() for p in here.iterdir()} == before


def test_an_output_is_never_a_record_of_a_folder_or_campaign(bench):
    (bench / "one.toml").write_text('[[records]]\nfile = "kp60.csv"\n')
    before = (bench / "kp60.csv").read_bytes()
    assert "would overwrite" in refused(run("check", bench / "one.toml", "--json", bench / "kp60.csv"))
    assert (bench / "kp60.csv").read_bytes() == before


def test_an_output_folder_is_checked_before_the_work(bench, monkeypatch):
    monkeypatch.setattr("servolens.campaign.read_records", lambda *a, **k: pytest.fail("the work began"))
    assert "does not exist" in refused(run("identify", bench / "kp60.csv", "--out", "nowhere/model.json"))


def test_a_write_that_fails_leaves_the_old_file(bench, here, monkeypatch):
    (here / "check.json").write_text("old")

    def full(self, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    assert "no space left" in refused(run("check", bench / "kp60.csv", "--json", "check.json"))
    assert [p.name for p in here.iterdir()] == ["check.json"]
    assert (here / "check.json").read_text() == "old"


FAULTS = {
    "unexpected": (ZeroDivisionError("secret"), 3, "ZeroDivisionError"),
    "recursion": (RecursionError(), 3, "RecursionError"),
    "memory": (MemoryError(), 3, "memory"),
    "interrupt": (KeyboardInterrupt(), 130, "interrupted"),
}


@pytest.mark.parametrize(("error", "status", "words"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_one_line_too(bench, monkeypatch, error, status, words):
    def fail(*_, **__):
        raise error

    monkeypatch.delenv("SERVOLENS_DEBUG", raising=False)
    monkeypatch.setattr("servolens.campaign.read_records", fail)
    line = refused(run("check", bench / "kp60.csv"), status)
    assert words in line
    assert "secret" not in line


def test_debug_shows_the_traceback(bench, monkeypatch):
    monkeypatch.setenv("SERVOLENS_DEBUG", "1")
    monkeypatch.setattr("servolens.campaign.read_records", lambda *a, **k: 1 / 0)
    assert "Traceback" in run("check", bench / "kp60.csv").stderr


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_help_holds_one_example_that_names_its_command(command):
    done = run(command.name, "--help")
    assert done.exit_code == 0
    assert re.findall(r"^Example:\n  (servolens \w+)", done.stdout, flags=re.MULTILINE) == [f"servolens {command.name}"]


@pytest.mark.parametrize("width", [60, 200])
def test_no_number_is_cut_however_narrow_the_screen(bench, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    body = result("identification", "identify", bench / "kp100.csv")
    text = run("identify", bench / "kp100.csv").stdout
    assert max(len(line) for line in text.splitlines()) <= width
    assert "…" not in text
    gain = body["models"]["velocity"]["gain"]
    assert f"{gain['value']:.5f}"[:6] in text
    assert "m/s²/V" in text


def test_the_list_of_commands_is_whole_on_a_terminal_of_80_columns():
    told = CliRunner().invoke(group, ["--help"], terminal_width=80).stdout.partition("Commands:")[2]
    assert all(f"  {command.name} " in told for command in COMMANDS)
    assert "..." not in told


def test_alone_it_prints_its_help():
    done = run()
    assert done.exit_code == 0
    order = re.findall(r"^  ([a-z]+)  ", done.stdout.partition("Commands:")[2], flags=re.MULTILINE)
    assert order == [command.name for command in COMMANDS]


def test_help_loads_no_numerics():
    script = (
        "import sys\nfrom servolens.cli import group\ntry: group.main(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'casadi', 'numba', 'matplotlib', 'control', 'rich', 'pint'}\n"
        "print(*sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stderr.split() == []


def test_as_a_module_it_tells_its_version():
    done = process("--version")
    assert done.returncode == 0
    assert re.fullmatch(r"servolens \d+\.\d+\.\d+\S*\n", done.stdout)


def test_in_a_process_of_its_own_standard_output_is_json_alone(bench):
    done = process("compare", bench / "kp100.csv", *SPEC, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert finite(done.stdout)["schema"] == "servolens.comparison/1"
    assert "recommendation" in done.stderr


def test_in_a_process_of_its_own_a_refusal_is_one_line(here):
    (here / "bad.csv").write_bytes(b"\x00\x01\x02" * 100)
    done = process("check", "bad.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"servolens: error: bad\.csv: [^\n]+\n", done.stderr)


def test_output_survives_a_terminal_without_unicode(bench):
    done = process("identify", bench / "kp60.csv", env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr
    assert "gain" in done.stdout


@pytest.mark.skipif(not hasattr(signal, "SIGPIPE"), reason="pipes end otherwise here")
def test_a_closed_pipe_is_quiet(bench):
    script = f'"{sys.executable}" -m servolens check "{bench / "kp60.csv"}" | true'
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True)
    assert done.stderr == ""


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_ends_with_one_line(bench):
    script = (
        "import os, signal, sys, time\nimport servolens.campaign\nfrom servolens.cli import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a background job ignores it
        "def read(*a, **k):\n"
        " while True:\n  os.kill(os.getpid(), signal.SIGINT)\n  time.sleep(1)\n"  # one may be lost in a destructor
        f"servolens.campaign.read_records = read\nsys.argv[1:] = ['check', {str(bench / 'kp60.csv')!r}]\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (130, "")
    assert re.fullmatch(r"servolens: error: interrupted[^\n]*\n", done.stderr)


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")
@pytest.mark.parametrize(("work", "seen"), [(0.0, False), (2.0, True)], ids=["quick", "slow"])
def test_a_bar_appears_only_on_a_terminal_and_only_when_it_takes_long(work, seen):
    import pty

    script = (
        "import time\nfrom servolens.commands.terminal import progress_bar\n"
        f"with progress_bar() as progress:\n progress('Weighing', 1, 3)\n time.sleep({work})\n"
    )
    reader, writer = pty.openpty()
    subprocess.run([sys.executable, "-c", script], stderr=writer, env={**os.environ, "TERM": "xterm"}, check=True)
    os.write(writer, b"end")
    text = b""
    while not text.endswith(b"end"):
        text += os.read(reader, 4096)
    assert (b"Weighing" in text) is seen
    piped = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert piped.stderr == b""


def test_refusal_about_many_files_names_the_record_that_is_called_like_the_first():
    files = [f"kp{n}.csv" for n in range(4)]
    with pytest.raises(InputError, match=r"^kp0\.csv and 3 more: kp0: too short$"), about(*files):
        raise InputError("kp0: too short")
    with pytest.raises(InputError, match=r"^kp0\.csv: too short$"), about("kp0.csv"):
        raise InputError("kp0: too short")
