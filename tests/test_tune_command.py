"""The command tune from outside: statuses, files, one-line refusals, and what a terminal shows last."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import loadmat

from servolens import Controller, Record, lab, read_record
from servolens.cli import group
from servolens.study import completed_spec, study_records
from servolens.summaries import tuning_summaries

DATA = Path(os.environ.get("SERVOLENS_DATA", Path(__file__).parents[2] / "shared" / "data"))
CART = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
OTHER = lab.Truth(gain=0.8, damping=6.0)
QUICK = ("--settling-time", "0.5", "--effort", "quick")
DESIGN = {"feasible", "kd", "kp", "settling_time", "intervals", "certificate", "verified", "recommended"}
LIGHTS = ("Data: ", "Model: ", "Gain: ")


def write(record, path, *, gains=True):
    lines = [f"# name = {path.stem}"]
    lines += [f"# kp = {record.controller.kp} V/m", f"# kd = {record.controller.kd} V s/m"] if gains else []
    columns = {"time [s]": record.time, "reference [m]": record.reference, "position [m]": record.position}
    columns["voltage [V]"] = record.voltage
    lines.append(",".join(columns))
    lines += [",".join(repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    for kp in (60, 80):
        write(lab.step_record(CART, kp, noise=1e-5, seed=kp), folder / f"kp{kp}.csv")
    write(lab.step_record(OTHER, 70, noise=1e-5, seed=70), folder / "other.csv")
    still = lab.step_record(CART, 60)
    write(still.with_({"position": np.zeros(len(still))}), folder / "still.csv")
    write(lab.step_record(CART, 60, noise=1e-5, seed=1), folder / "bare.csv", gains=False)
    driven = (folder / "bare.csv").read_text(encoding="utf-8").replace("reference", "unused")
    (folder / "driven.csv").write_text(driven, encoding="utf-8")
    return folder


def run(*arguments, columns="100"):
    environment = {"COLUMNS": columns}
    return CliRunner(env=environment).invoke(group, [str(a) for a in arguments], prog_name="servolens")


def tuned(*arguments, status=0):
    done = run("tune", *arguments, "--json", "-")
    assert done.exit_code == status, done.output
    body = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"{name} in the JSON"))
    assert list(body)[:4] == ["schema", "servolens", "created", "findings"]
    assert body["schema"] == "servolens.tuning/1"
    return body


@pytest.fixture(scope="module")
def green(bench):
    page, file = bench / "page.html", bench / "tuning.json"
    done = run("tune", bench / "kp60.csv", bench / "kp80.csv", *QUICK, "--report", page, "--json", file, columns="60")
    assert done.exit_code == 0, done.output
    return done.stdout, page.read_text(encoding="utf-8"), json.loads(file.read_text(encoding="utf-8"))


def test_result_says_lights_gains_and_all_that_leads_there(green):
    body = green[2]
    assert [body[name]["light"] for name in ("data", "model", "gain")] == ["green", "green", "green"]
    assert [cause["effect"] for cause in body["diagnosis"]["causes"]] == ["coulomb_friction"]
    assert all(set(body["comparison"][name]) >= DESIGN for name in ("linear", "nonlinear", "diagnosed"))
    assert body["kd"] == body["comparison"]["diagnosed"]["kd"]
    assert body["recommended"]["kd"] > body["kd"]
    assert [row["name"] for row in body["check"]["records"]] == ["kp60", "kp80"]


def test_what_is_not_given_is_that_of_the_records(green):
    spec = green[2]["spec"]
    assert (spec["kp"], spec["reference"], spec["derivative_filter"]) == (80.0, 0.1, 1.0)
    assert spec["sample_time"] == pytest.approx(1e-3)


def test_terminal_ends_with_lights_and_gains_and_keeps_to_its_width(green):
    text, _, body = green
    assert max(len(line) for line in text.splitlines()) <= 60
    last = " ".join(text[text.rindex("The gain\n") :].split())
    places = [last.index(light) for light in (*LIGHTS, "Recommended: ", "Least: ")]
    assert places == sorted(places)
    assert f"kd = {body['recommended']['kd']:.4g} V s/m" in last


def test_page_shows_the_lights_and_the_three_models(green):
    page = green[1]
    assert page.count('<li class="green">') == 3
    assert "Side by side" in page
    assert "Where the error lives, and why" in page
    assert 'class="playground"' in page
    assert "http" not in page


@pytest.mark.slow
def test_withheld_gain_exits_1_and_writes_everything(bench, tmp_path):
    page, file = tmp_path / "page.html", tmp_path / "tuning.json"
    paths = (bench / "kp60.csv", bench / "kp80.csv", "--heldout", bench / "other.csv")
    done = run("tune", *paths, *QUICK, "--report", page, "--json", file)
    assert done.exit_code == 1, done.output
    body = json.loads(file.read_text(encoding="utf-8"))
    assert (body["kd"], body["recommended"], body["gain"]["light"]) == (None, None, "red")
    assert body["reason"]
    assert '<li class="red">' in page.read_text(encoding="utf-8")
    assert "withheld" in done.stdout
    assert "Recommended: " not in done.stdout
    forced = tuned(*paths, *QUICK, "--force")
    assert forced["forced"] is True
    assert forced["kd"] is not None


def test_records_that_stand_still_give_no_gain_but_all_files(bench, tmp_path):
    page = tmp_path / "page.html"
    body = tuned(bench / "still.csv", *QUICK, "--report", page, status=1)
    assert [body[name]["light"] for name in ("data", "model", "gain")] == ["red", "red", "red"]
    assert body["comparison"] is None
    assert body["diagnosis"] is None
    assert body["reason"]
    assert "What the data leave open" in page.read_text(encoding="utf-8")


def test_infeasible_spec_exits_1_with_the_reason(bench):
    body = tuned(bench / "kp60.csv", "--settling-time", "0.03", "--effort", "quick", status=1)
    assert body["comparison"]["diagnosed"]["feasible"] is False
    assert "no kd" in body["reason"].lower()
    told = " ".join(run("tune", bench / "kp60.csv", "--settling-time", "0.03", "--effort", "quick").stdout.split())
    assert told.count("No kd in") == 1


def test_options_of_the_design_and_gains_of_the_record(bench):
    options = ("--record-kp", "60", "--record-kd", "0", "--kp", "70", "--band", "0.02", "--overshoot", "0.02")
    body = tuned(bench / "bare.csv", *options, *QUICK)
    assert (body["spec"]["kp"], body["spec"]["band"], body["spec"]["overshoot"]) == (70.0, 0.02, 0.02)


REFUSED = {
    "no settling time": (["kp60.csv"], "missing option '--settling-time'"),
    "no kp anywhere": (["driven.csv", *QUICK], "state no kp"),
    "settling time of nothing": (["kp60.csv", "--settling-time", "0"], "settling_time must be"),
    "record twice": (["kp60.csv", *QUICK, "--heldout", "kp60.csv"], "both as training and as held out"),
    "page over a record": (["kp60.csv", *QUICK, "--report", "kp60.csv"], "would overwrite"),
    "page to standard output": (["kp60.csv", *QUICK, "--report", "-"], "--report needs the name of a file"),
    "unknown prior": (["kp60.csv", *QUICK, "--prior", "mass=1,1"], "a prior on 'mass' is not possible"),
    "no such file": (["nowhere.csv", *QUICK], "nowhere.csv: "),
}


@pytest.mark.parametrize(("arguments", "says"), REFUSED.values(), ids=REFUSED)
def test_wrong_use_is_one_sentence(bench, monkeypatch, arguments, says):
    monkeypatch.chdir(bench)
    done = run("tune", *arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("servolens: error: ")
    assert says in line


def test_compare_runs_every_gain_on_the_diagnosed_plant(bench):
    done = run("compare", bench / "kp80.csv", "--kp", "80", *QUICK, "--json", "-")
    assert done.exit_code == 0, done.output
    body = json.loads(done.stdout)
    assert body["schema"] == "servolens.comparison/1"
    assert body["diagnosed"]["recommended"]["kd"] > body["diagnosed"]["kd"]
    assert set(body["linear"]["on_diagnosed"]) == set(body["linear"]["on_nonlinear"])
    assert body["linear"]["recommended"] is body["linear"]["tracking"] is None
    assert body["linear"]["reason"].startswith("recommended: only the least gain was sought; tracking: ")
    assert "reason" not in body["diagnosed"]
    assert set(body["lights"]) == {"data", "model", "gain"}


# --- measured axes, whose truth nobody knows


def kawata(kp, code):
    content = loadmat(DATA / "kawata_cart_arm" / f"cdip_cart_pcont_data_kP_{code}_ref_02.mat")
    time = content["t"].ravel()
    reference = np.where(time >= 1.0 - 1e-6, 0.2, 0.0)
    name = f"cart, kP {kp:g}"
    position = content["z"].ravel()
    return Record(time=time, position=position, reference=reference, controller=Controller(kp=kp), name=name)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "kawata_cart_arm").is_dir(), reason="measured data are not here (SERVOLENS_DATA)")
def test_kawatas_cart_never_gets_the_gain_that_its_fastest_run_refutes():
    """Found on slow runs, held against kP 20: 2.9 % off, so that a settling time within 1 % is a doubt."""
    runs = [kawata(kp, code) for kp, code in ((2.5, "025"), (5.0, "050"), (10.0, "100"))]
    held = kawata(20.0, "200")
    spec = completed_spec([*runs, held], {"settling_time": 0.5})
    assert (spec.kp, spec.reference) == (20.0, 0.2)
    found = study_records(runs, spec, heldout=[held], effort="quick")
    assert found.lights["model"].light == "amber"
    assert found.lights["gain"].light != "green"
    assert tuning_summaries(found)[1].sentences[2].startswith("Gain: ")


def arm(name, kp, kd):
    known = {"kp": kp, "kd": kd, "derivative": "velocity", "encoder_resolution": 1e-3, "name": name}
    columns = {
        "time": "t_ms",
        "position": "theta_rad",
        "velocity": "thetadot_rad_s",
        "reference": "ref_rad",
        "voltage": "voltage_V",
    }
    units = {"time": "ms", "position": "rad", "reference": "rad", "velocity": "rad/s", "voltage": "V"}
    return read_record(
        DATA / "cu_rotary_arm" / f"bh2017_rigidarm_{name}.csv", settings=known, columns=columns, units=units
    )


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "cu_rotary_arm").is_dir(), reason="measured data are not here (SERVOLENS_DATA)")
def test_arm_of_which_much_is_not_explained_gets_no_gain():
    """A dead zone and a delay leave 3 % of its travel, and runs that were not fitted are up to 5 % of the step off."""
    runs = [arm(name, kp, kd) for name, kp, kd in (("K1_7", 7, 0), ("K1_9", 9, 0), ("k1k3_7", 7, 0.271))]
    held = [arm("K1_8", 8, 0), arm("k1k3_9", 9, 0.377)]
    spec = completed_spec(runs, {"settling_time": 0.6, "band": 0.05})
    found = study_records(runs, spec, heldout=held)
    assert (found.lights["model"].light, found.lights["gain"].light) == ("amber", "red")
    assert found.design is not None
    assert found.design.kd is None
