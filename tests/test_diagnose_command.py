"""`servolens diagnose` and `servolens next` from outside: results, statuses, refusals; and the experiments proposed."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from test_cli import finite, is_quantity, process, refused, result, run

from servolens import Controller, Plant, Record, lab, simulate
from servolens.diagnosis.logged import Logged
from servolens.diagnosis.next_experiment import next_experiment, proposed
from servolens.diagnosis.result import Errors
from servolens.effects import ActuatorLag, CoulombFriction, DeadZone, Delay, SensorLag
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.model import Model
from servolens.results import to_text
from servolens.summaries import diagnosis_summary
from servolens.summaries.diagnosis import spoken

NOISE = 2e-5
RUBBING = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
LAGGING = lab.Truth(gain=1.9, damping=6.0, effects={"actuator_lag": {"time_constant": 0.004}})
PLAIN = lab.Truth(gain=1.9, damping=6.0)
OTHER = lab.Truth(gain=3.1, damping=6.0)
VERDICTS = {"healthy", "explained", "partly_explained", "unexplained"}
CAUSE = {"effect", "parameters", "confidence", "rivals", "gain"}
FIELDS = {
    "verdict",
    "causes",
    "baseline",
    "extended",
    "noise_floor",
    "remainder",
    "where",
    "model",
    "next_experiment",
    "experiments",
}
REMAINDER = {
    "rms",
    "times_noise",
    "of_travel",
    "acceleration_rms",
    "correlation_time",
    "of_motor",
    "depends_on_inputs",
    "material",
    "heldout",
}
EXPERIMENT = {"kp", "kd", "start", "reference", "back", "duration", "sample_time", "separates", "separation"}


def step(truth, kp, kd=0.0, **settings):
    settings = {"noise": NOISE, "seed": kp, "sample_time": 2e-3, "duration": 1.2, **settings}
    return lab.step_record(truth, kp, kd, **settings)


def write(record, path, *, columns=("reference", "voltage"), unit="m"):
    lines = [
        f"# name = {path.stem}",
        f"# kp = {record.controller.kp} V/{unit}",
        f"# kd = {record.controller.kd} V s/{unit}",
    ]
    signals = {"time [s]": record.time, f"position [{unit}]": record.position}
    units = {"reference": unit, "voltage": record.command_unit}
    signals |= {f"{name} [{units[name]}]": getattr(record, name) for name in columns}
    lines.append(",".join(signals))
    lines += [",".join(repr(float(x)) for x in row) for row in zip(*signals.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def cart(*effects, gain=1.9):
    return Plant(gain=gain, damping=6.0, effects=effects)


STICKY = {"coulomb_friction": cart(CoulombFriction(level=0.3)), "dead_zone": cart(DeadZone(width=0.158))}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnose")
    for kp in (40, 60, 80):
        write(step(RUBBING, kp), folder / f"rub{kp}.csv")
    for kp in (40, 80):
        write(step(LAGGING, kp, sample_time=1e-3), folder / f"lag{kp}.csv")
        write(step(PLAIN, kp), folder / f"plain{kp}.csv")
    return folder


@pytest.fixture(scope="module")
def rubbing(bench):
    """The diagnosis of a cart with dry friction, its files, and what was printed."""
    arguments = (bench / "rub40.csv", bench / "rub80.csv", "--heldout", bench / "rub60.csv")
    done = run("diagnose", *arguments, "--out", bench / "model.json", "--json", bench / "rub.json")
    assert done.exit_code == 0, done.output
    return finite((bench / "rub.json").read_text(encoding="utf-8")), done


@pytest.fixture(scope="module")
def lagging(bench):
    """The diagnosis of a linear cart with a lag, which may sit in actuator or sensor."""
    return result("diagnosis", "diagnose", bench / "lag40.csv", bench / "lag80.csv")


@pytest.fixture(scope="module")
def doubtful(rubbing, bench):
    """A diagnosis file whose cause has a rival, a dead zone."""
    body = json.loads(json.dumps(rubbing[0]))
    body["causes"][0]["rivals"] = ["dead_zone"]
    body["rival_models"] = {"coulomb_friction": [Model(plant=STICKY["dead_zone"]).to_json()]}
    path = bench / "doubtful.json"
    path.write_text(json.dumps(body), encoding="utf-8")
    return path


def test_a_diagnosis_names_the_cause_and_measures_what_it_gains(rubbing):
    body, _ = rubbing
    assert body["schema"] == "servolens.diagnosis/1"
    assert set(body) >= FIELDS
    assert body["verdict"] in VERDICTS
    assert body["verdict"] == "explained"
    (cause,) = body["causes"]
    assert set(cause) >= CAUSE
    assert cause["effect"] == "coulomb_friction"
    is_quantity(cause["parameters"]["level"])
    assert cause["parameters"]["level"]["value"] == pytest.approx(0.3, rel=1e-2)
    assert cause["parameters"]["level"]["unit"] == "m/s^2"
    assert 0.9 < cause["confidence"] <= 1.0
    assert "coulomb_friction" not in cause["rivals"]
    assert cause["gain"]["unit"] == "m"


def test_errors_before_and_after_are_those_of_the_models(rubbing):
    body, _ = rubbing
    (cause,) = body["causes"]
    assert cause["gain"]["train"] == [body["baseline"]["rms_error"], body["extended"]["rms_error"]]
    assert cause["gain"]["heldout"] == [body["baseline"]["heldout_rms_error"], body["extended"]["heldout_rms_error"]]
    assert body["baseline"]["heldout_rms_error"] > 20 * NOISE
    assert body["extended"]["heldout_rms_error"] == pytest.approx(body["noise_floor"], rel=0.2)
    assert body["noise_floor"] == pytest.approx(NOISE, rel=0.2)
    rows = {(row["name"], row["heldout"]) for row in body["records"]}
    assert rows == {("rub40", False), ("rub80", False), ("rub60", True)}


def test_shares_of_the_error_and_candidates_are_told(rubbing):
    body, _ = rubbing
    assert {share["quantity"] for share in body["where"]} >= {"speed", "position", "voltage"}
    for share in body["where"]:
        low, high = share["range"]
        assert low < high
        assert 0.0 <= share["share_of_error"] <= 1.0 + 1e-9
    gained = [candidate["likelihood"] for candidate in body["candidates"]]
    assert gained == sorted(gained, reverse=True)


def test_what_was_logged_is_in_the_result(rubbing):
    body, _ = rubbing
    first, second = body["experiments"]
    assert (first["kp"], second["kp"]) == (40, 80)
    assert first["kd"] == 0
    assert first["reference"] == pytest.approx(0.1)
    assert first["sample_time"] == pytest.approx(2e-3)
    assert first["duration"] == pytest.approx(1.2)
    assert second["voltage_range"][1] == pytest.approx(8.0, rel=0.01)


def test_the_first_sentence_says_cause_size_and_gain(rubbing):
    _, done = rubbing
    text = " ".join(done.stdout.split())
    assert "the cause is Coulomb friction (0.3" in text
    assert "m/s²); with it the held-out error falls from" in text
    assert "What to do: Reduce preload" in text
    assert "For the PD gain: Friction brakes for free" in text
    assert "held out" in text


def test_the_text_fits_a_narrow_screen(doubtful, bench):
    for arguments in (("next", doubtful), ("diagnose", bench / "plain40.csv", bench / "plain80.csv")):
        done = process(*arguments, env={**os.environ, "COLUMNS": "60"})
        assert done.returncode == 0, done.stderr
        assert max(len(line) for line in done.stdout.splitlines()) <= 60
        assert "…" not in done.stdout


def test_the_model_it_writes_predicts_the_record_held_out(rubbing, bench):
    body, _ = rubbing
    model = finite((bench / "model.json").read_text(encoding="utf-8"))
    assert model["schema"] == "servolens.model/1"
    assert model["identified_from"] == ["rub40", "rub80"]
    assert model["effects"] == body["model"]["effects"]
    (row,) = result("prediction", "predict", bench / "model.json", bench / "rub60.csv")["records"]
    assert row["held_out"] is True
    assert row["rms_error"] < 1.3 * NOISE


def test_next_proposes_what_parts_the_rivals_of_a_diagnosis(doubtful):
    experiment = result("next", "next", doubtful)["next_experiment"]
    assert set(experiment) == EXPERIMENT
    assert experiment["separates"] == ["coulomb_friction", "dead_zone"]
    assert experiment["separation"] > 10
    assert 20 <= experiment["kp"] <= 160
    text = " ".join(run("next", doubtful).stdout.split())
    assert "Coulomb friction and a dead zone differ by" in text


def test_lags_that_give_the_same_records_are_rivals_that_no_step_parts(lagging, tmp_path):
    (cause,) = lagging["causes"]
    assert {cause["effect"], *cause["rivals"]} == {"actuator_lag", "sensor_lag"}
    assert set(lagging["rival_models"]) == {cause["effect"]}
    assert lagging["next_experiment"] is None
    assert lagging["reason"] == "next_experiment: no safe step like those logged would tell the rivals apart"
    (tmp_path / "lag.json").write_text(json.dumps(lagging), encoding="utf-8")
    assert "tell the rivals apart" in result("next", "next", tmp_path / "lag.json", status=1)["reason"]


def test_next_says_no_where_a_diagnosis_names_no_rivals(rubbing, bench):
    body, _ = rubbing
    assert body["causes"][0]["rivals"] == []
    assert body["next_experiment"] is None
    told = result("next", "next", bench / "rub.json", status=1)
    assert told["next_experiment"] is None
    assert "no rivals" in told["reason"]


def test_next_of_a_model_alone_doubts_its_least_certain_effect(rubbing, bench):
    body = result("next", "next", bench / "model.json")
    assert body["next_experiment"]["separates"] == ["coulomb_friction", "gain_and_damping"]
    assert [finding["code"] for finding in body["findings"]] == ["no_rivals"]  # its file knows the gains and steps
    smaller = result("next", "next", bench / "model.json", "--kp", "60", "--reference", "0.02")["next_experiment"]
    assert abs(smaller["reference"]) <= 0.02
    assert 30 <= smaller["kp"] <= 120


def test_next_of_a_model_without_effects_says_no(bench, tmp_path):
    path = tmp_path / "linear.json"
    assert run("identify", bench / "plain40.csv", "--model", "constant", "--out", path).exit_code == 0
    body = result("next", "next", path, status=1)
    assert "nothing to tell apart" in body["reason"]
    assert "names no rivals" in run("next", path).stdout.replace("\n", " ")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is not JSON"),
        ("[1]", "neither diagnosis nor model"),
        ('{"schema": "servolens.design/1"}', "neither diagnosis nor model"),
        ('{"schema": "servolens.diagnosis/1"}', "'causes' is missing"),
        ('{"schema": "servolens.model/1"}', "not a model"),
    ],
    ids=["empty", "list", "design", "hollow diagnosis", "hollow model"],
)
def test_next_refuses_other_files(tmp_path, content, words):
    path = tmp_path / "file.json"
    path.write_text(content, encoding="utf-8")
    assert words in refused(run("next", path))


def test_next_refuses_settings_that_do_not_fit(doubtful, rubbing, bench, tmp_path):
    assert "for a model alone" in refused(run("next", doubtful, "--kp", "60"))
    assert "sign of the model's gain" in refused(run("next", bench / "model.json", "--kp", "-60"))
    assert "other than 0" in refused(run("next", bench / "model.json", "--reference", "0"))
    assert "cannot be read" in refused(run("next", tmp_path / "none.json"))
    assert "overwrite" in refused(run("next", doubtful, "--json", doubtful))


@pytest.mark.parametrize("field", ["experiments", "rival_models", "noise_floor", "causes"])
def test_next_refuses_a_diagnosis_that_lacks_something(doubtful, tmp_path, field):
    body = json.loads(doubtful.read_text(encoding="utf-8"))
    path = tmp_path / "part.json"
    del body[field]
    path.write_text(json.dumps(body), encoding="utf-8")
    assert f"'{field}' is missing" in refused(run("next", path))
    body[field] = "nothing"
    path.write_text(json.dumps(body), encoding="utf-8")
    refused(run("next", path))


def test_a_healthy_axis_is_called_healthy(bench):
    body = result("diagnosis", "diagnose", bench / "plain40.csv", bench / "plain80.csv", "--effort", "quick")
    assert body["verdict"] == "healthy"
    assert body["causes"] == []
    assert set(body["remainder"]) == REMAINDER
    assert (body["remainder"]["depends_on_inputs"], body["remainder"]["material"]) == (False, False)
    assert body["next_experiment"] is None
    assert body["model"]["effects"] == []
    assert body["baseline"] == body["extended"]


def test_progress_and_messages_stay_off_standard_output(bench):
    done = process("diagnose", bench / "plain40.csv", bench / "plain80.csv", "--json", "-")
    assert done.returncode == 0
    assert finite(done.stdout)["schema"] == "servolens.diagnosis/1"
    assert "Gain and damping explain these records" in done.stderr
    assert "━" not in done.stderr
    out = process("diagnose", bench / "plain40.csv", bench / "plain80.csv", "--out", "-")
    assert finite(out.stdout)["schema"] == "servolens.model/1"


def test_the_report_is_one_page_that_names_the_cause(bench, tmp_path):
    page = tmp_path / "page.html"
    done = run("diagnose", bench / "rub60.csv", "--report", page)
    assert done.exit_code == 0, done.output
    text = page.read_text(encoding="utf-8")
    assert "Coulomb friction" in text
    assert "rub60" in text
    assert not re.search(r"(src|href)=[\"']https?:", text)
    assert "needs the name of a file" in refused(run("diagnose", bench / "rub60.csv", "--report", "-"))


def test_heldout_takes_every_path_up_to_the_next_option(bench, tmp_path):
    extra = [write(step(PLAIN, kp, seed=7), tmp_path / f"more{kp}.csv") for kp in (50, 70)]
    split = ("diagnose", "--heldout", extra[0], "--kp", "40", bench / "plain40.csv", f"--heldout={extra[1]}")
    together = ("diagnose", bench / "plain40.csv", "--kp", "40", "--heldout", *extra, "--", bench / "plain80.csv")
    for arguments, trained in ((split, ["plain40"]), (together, ["plain40", "plain80"])):
        done = run(arguments[0], "--json", tmp_path / "d.json", *arguments[1:])
        assert done.exit_code == 0, done.output
        rows = finite((tmp_path / "d.json").read_text(encoding="utf-8"))["records"]
        assert [row["name"] for row in rows if row["heldout"]] == ["more50", "more70"]
        assert [row["name"] for row in rows if not row["heldout"]] == trained


def test_a_file_given_as_training_and_as_held_out_is_refused(bench, tmp_path):
    link = tmp_path / "link.csv"
    link.symlink_to(bench / "rub40.csv")
    for other in (bench / "rub40.csv", bench / ".." / bench.name / "rub40.csv", link):
        done = run("diagnose", bench / "rub40.csv", bench / "rub80.csv", "--heldout", other)
        assert refused(done) == f"{other}: is given both as training and as held out; keep one of the two"
    assert "both as training and as held out" in refused(run("diagnose", bench, "--heldout", bench / "rub40.csv"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--heldout", "RUB"), "missing argument"),
        (("RUB", "--heldout"), "--heldout needs at least one record"),
        (("RUB", "--heldout", "--out", "m.json"), "--heldout needs at least one record"),
        (("RUB", "--heldout", ""), "is empty"),
        (("none.csv",), "none.csv"),
        (("RUB", "--heldout", "none.csv"), "none.csv"),
        (("RUB", "RUB"), "given twice"),
        (("RUB", "--prior", "level=1,2"), "a prior on 'level' is not possible"),
        (("RUB", "--prior", "gain=1.9"), "NAME=MEAN,SD"),
        (("RUB", "--effort", "hasty"), "'hasty' is not one of"),
        (("RUB", "--out", "-", "--json", "-"), "cannot both go to standard output"),
        (("RUB", "--out", "RUB"), "would overwrite"),
        (("RUB", "--json", "nowhere/d.json"), "does not exist"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_arguments_that_cannot_be_used_are_refused(bench, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(run("diagnose", *[bench / "rub40.csv" if a == "RUB" else a for a in arguments]))


def test_an_output_that_is_a_held_out_record_is_refused(bench):
    done = run("diagnose", bench / "rub40.csv", "--heldout", bench / "rub60.csv", "--out", bench / "rub60.csv")
    assert "would overwrite" in refused(done)


def test_records_that_do_not_move_are_refused(tmp_path):
    time = 1e-3 * np.arange(400)
    still = Record(
        time=time, position=0 * time, reference=0 * time + 0.1, voltage=0 * time, controller=Controller(kp=60.0)
    )
    assert "still.csv" in refused(run("diagnose", write(still, tmp_path / "still.csv")))


def test_a_record_of_fifty_samples_gives_a_diagnosis_or_one_sentence(tmp_path):
    short = step(RUBBING, 60, duration=0.098)
    assert len(short) == 50
    done = run("diagnose", write(short, tmp_path / "short.csv"), "--json", tmp_path / "short.json")
    assert done.exit_code in (0, 2), done.output
    if done.exit_code == 2:
        refused(done)
    else:
        assert finite((tmp_path / "short.json").read_text(encoding="utf-8"))["verdict"] in VERDICTS


def test_metres_and_radians_are_not_mixed(bench, tmp_path):
    turning = write(step(RUBBING, 70, setup=lab.Setup(length_unit="rad")), tmp_path / "turning.csv", unit="rad")
    assert "rad" in refused(run("diagnose", bench / "rub40.csv", turning))
    assert "rad" in refused(run("diagnose", bench / "rub40.csv", "--heldout", turning))


def test_commands_of_different_units_are_not_mixed(bench, tmp_path):
    text = (bench / "rub80.csv").read_text(encoding="utf-8").replace("[V]", "[A]").replace("V", "A")
    (tmp_path / "amps.csv").write_text(text, encoding="utf-8")
    assert "is in A" in refused(run("diagnose", bench / "rub40.csv", tmp_path / "amps.csv"))
    assert " V" in refused(run("diagnose", bench / "rub40.csv", "--heldout", tmp_path / "amps.csv"))


@pytest.mark.slow
def test_two_axes_in_one_campaign_contradict_each_other(bench, tmp_path):
    other = write(step(OTHER, 60), tmp_path / "other.csv")
    body = result("diagnosis", "diagnose", bench / "plain40.csv", other, "--effort", "quick")
    (finding,) = [f for f in body["findings"] if f["code"] == "records_contradict"]
    assert finding["severity"] == "warning"
    assert "plain40" in finding["message"]
    assert "other" in finding["message"]


def test_records_of_different_rates_are_diagnosed_together(tmp_path):
    paths = [
        write(step(RUBBING, kp, sample_time=h), tmp_path / f"rate{kp}.csv") for kp, h in ((40, 1e-3), (70, 2.5e-3))
    ]
    body = result("diagnosis", "diagnose", *paths)
    assert (body["verdict"], [c["effect"] for c in body["causes"]]) == ("explained", ["coulomb_friction"])
    assert [e["sample_time"] for e in body["experiments"]] == pytest.approx([1e-3, 2.5e-3])


def test_one_record_alone_is_parted_in_time(bench):
    body = result("diagnosis", "diagnose", bench / "rub60.csv")
    assert [c["effect"] for c in body["causes"]] == ["coulomb_friction"]
    assert [row["heldout"] for row in body["records"]] == [False, True]
    assert body["extended"]["heldout_rms_error"] < 2 * NOISE


def test_without_the_voltage_it_is_computed_from_the_control_law(tmp_path):
    paths = [write(step(RUBBING, kp), tmp_path / f"quiet{kp}.csv", columns=("reference",)) for kp in (40, 80)]
    body = result("diagnosis", "diagnose", *paths)
    assert "coulomb_friction" in [c["effect"] for c in body["causes"]]


def test_without_the_reference_the_voltage_drives(tmp_path):
    paths = [write(step(RUBBING, kp), tmp_path / f"driven{kp}.csv", columns=("voltage",)) for kp in (40, 80)]
    body = result("diagnosis", "diagnose", *paths)
    assert [c["effect"] for c in body["causes"]] == ["coulomb_friction"]


# The experiment itself


@pytest.fixture(scope="module")
def logged():
    return [step(RUBBING, kp) for kp in (40, 80)]


def test_the_separation_is_the_difference_of_the_simulated_responses(logged):
    best = next_experiment(STICKY, logged, noise=NOISE)
    rest = 5
    time = best.sample_time * np.arange(rest + round(best.duration / best.sample_time))
    ask = Record(
        time=time,
        position=0 * time + best.start,
        reference=np.where(np.arange(time.size) < rest, best.start, best.reference),
        controller=Controller(kp=best.kp, kd=best.kd),
    )
    first, second = (simulate(plant, ask).position for plant in STICKY.values())
    assert best.back is False
    assert best.separation == pytest.approx(np.sqrt(np.mean((first - second) ** 2)) / NOISE, rel=1e-6)


def test_no_other_safe_step_of_the_same_kind_separates_more(logged):
    best = next_experiment(STICKY, logged, noise=NOISE)
    time = best.sample_time * np.arange(round(best.duration / best.sample_time))
    for record in logged:
        ask = Record(time=time, position=0 * time, reference=0 * time + 0.1, controller=record.controller)
        first, second = (simulate(plant, ask).position for plant in STICKY.values())
        assert np.sqrt(np.mean((first - second) ** 2)) / NOISE <= best.separation * 1.01


def test_it_keeps_to_what_was_logged(logged):
    best = next_experiment(STICKY, logged, noise=NOISE)
    assert 20 <= best.kp <= 160
    assert best.kd >= 0
    assert abs(best.reference) <= 0.1
    most = max(float(np.abs(record.voltage).max()) for record in logged)
    assert best.kp * abs(best.reference - best.start) <= 1.01 * most


def test_the_worst_told_pair_decides_among_several_rivals(logged):
    plants = {
        "delay": cart(Delay(time=0.004)),
        "actuator_lag": cart(ActuatorLag(time_constant=0.004)),
        "coulomb_friction": cart(CoulombFriction(level=0.3)),
    }
    assert set(next_experiment(plants, logged, noise=1e-6).separates) == {"delay", "actuator_lag"}


def test_rivals_that_nothing_parts_do_not_rule_the_choice(logged):
    twin = cart(CoulombFriction(level=0.3))
    plants = {"coulomb_friction": twin, "twin": twin, "dead_zone": STICKY["dead_zone"]}
    best = next_experiment(plants, logged, noise=NOISE)
    assert "dead_zone" in best.separates
    assert best.separation > 10
    assert next_experiment({"coulomb_friction": twin, "twin": twin}, logged, noise=NOISE) is None


def test_lags_of_actuator_and_sensor_of_a_linear_axis_are_not_parted():
    lags = {"actuator_lag": ActuatorLag(time_constant=0.004), "sensor_lag": SensorLag(time_constant=0.004)}
    # what the sensor shows is the same; the true positions are not
    assert (
        next_experiment(
            {name: cart(lag) for name, lag in lags.items()}, [step(PLAIN, 60, sample_time=5e-4)], noise=NOISE
        )
        is None
    )


def test_without_rivals_there_is_no_experiment(logged):
    assert next_experiment({"coulomb_friction": STICKY["coulomb_friction"]}, logged, noise=NOISE) is None
    assert proposed(STICKY["coulomb_friction"], {}, {}, logged, noise=NOISE) is None


@pytest.mark.parametrize(
    ("field", "value", "finds"),
    [
        ("kd", 1e308, True),
        ("kp", -1e308, False),
        ("reference", 1e-310, False),
        ("sample_time", 1e308, False),
        ("start", -1.7e308, False),
    ],
)
def test_number_of_a_damaged_diagnosis_that_no_computer_doubles_is_no_error(logged, field, value, finds):
    """Twice a kd of 1e308 is infinite; warnings are errors here."""
    written = {**Logged.of(logged[0]).to_json(), "reference": 0.1 + (1.7e308 if field == "start" else 0.0)}
    best = next_experiment(STICKY, [Logged.from_json({**written, field: value})], noise=NOISE)
    assert (best is not None) is finds


def test_loops_unstable_with_a_rival_are_not_proposed():
    record = step(PLAIN, 60, 4.0)
    rivals = {"delay": cart(Delay(time=0.05)), "sensor_lag": cart(SensorLag(time_constant=0.05))}
    best = next_experiment(rivals, [record], noise=NOISE)
    time = best.sample_time * np.arange(2000)
    ask = Record(time=time, position=0 * time, reference=0 * time + 0.1, controller=Controller(kp=best.kp, kd=best.kd))
    for plant in rivals.values():
        assert np.ptp(simulate(plant, ask).position[-200:]) < 0.05


def test_a_negative_gain_keeps_its_sign():
    record = step(lab.Truth(gain=-1.9, damping=6.0, effects=RUBBING.effects), -60, seed=1)
    plants = {name: replace(plant, gain=-plant.gain) for name, plant in STICKY.items()}
    best = next_experiment(plants, [record], noise=NOISE)
    assert best.kp < 0
    assert best.kd <= 0


def test_unknown_gains_are_replaced_by_what_the_voltage_allows():
    record = step(RUBBING, 60).with_({"controller": None, "reference": None})
    best = next_experiment(STICKY, [record], noise=NOISE)
    assert 15 <= best.kp <= 130


def test_the_least_certain_cause_is_asked_about(logged):
    plant = cart(CoulombFriction(level=0.3), Delay(time=0.004))
    rivals = {
        "coulomb_friction": [cart(DeadZone(width=0.158), Delay(time=0.004))],
        "delay": [cart(CoulombFriction(level=0.3), ActuatorLag(time_constant=0.004))],
    }
    for sure, asked in (({"coulomb_friction": 0.9, "delay": 0.6}, "delay"), ({"delay": 0.9}, "delay")):
        assert asked in proposed(plant, rivals, sure, logged, noise=NOISE).separates


def test_what_was_logged_survives_its_json(logged):
    for record in logged:
        one = Logged.of(record)
        assert Logged.from_json(json.loads(json.dumps(one.to_json()))) == one


@pytest.mark.parametrize("change", [{"start": None}, {"duration": 0}, {"voltage_range": [1]}, {"controller": {"a": 1}}])
def test_a_damaged_experiment_is_refused(logged, change):
    with pytest.raises(InputError, match="experiment"):
        Logged.from_json({**Logged.of(logged[0]).to_json(), **change})


# What is said


@pytest.fixture(scope="module")
def found():
    from servolens import diagnose

    return diagnose([step(RUBBING, 40), step(RUBBING, 80)])


def test_each_verdict_has_its_own_honest_sentence(found):
    much = replace(
        found.remainder, rms=1.2e-3, of_travel=0.012, times_noise=60.0, depends_on_inputs=True, material=True
    )
    little = replace(much, rms=3e-4, of_travel=0.003, times_noise=15.0, material=False)
    partly = replace(found, verdict="partly_explained", remainder=much)
    lost = replace(found, verdict="unexplained", causes=(), remainder=much)
    assert "part of it is explained by Coulomb friction" in diagnosis_summary(partly).sentences[0]
    told = "What is left is unexplained, and it matters: 1.2 % of the travel, 1.2 mm (r.m.s.) beyond the noise."
    assert diagnosis_summary(partly).sentences[1].startswith(told)
    assert "nothing in the catalogue explains it" in diagnosis_summary(lost).sentences[0]
    assert "before tuning" in diagnosis_summary(lost).sentences[1]
    told = "What is left is unexplained, but immaterial: 0.3 % of the travel, 0.3 mm (r.m.s.) beyond the noise."
    assert diagnosis_summary(replace(lost, remainder=little)).sentences[1].startswith(told)
    shaken = replace(found, remainder=replace(little, depends_on_inputs=False))
    assert "0.3 % of the travel" in diagnosis_summary(shaken).sentences[1]
    assert "does not depend on what drives the axis" in diagnosis_summary(shaken).sentences[1]
    assert diagnosis_summary(lost).tables[1].title.startswith("R.m.s. error")


def test_rivals_are_named_where_there_are_any(found):
    (cause,) = found.causes
    doubted = replace(found, causes=(replace(cause, rivals=("dead_zone", "presliding", "delay + backlash")),))
    for verdict in ("explained", "partly_explained"):
        text = " ".join(diagnosis_summary(replace(doubted, verdict=verdict)).sentences)
        assert "No safe step like those logged would separate them" in text
        rivals = "a dead zone, presliding friction or a delay together with backlash."
        assert f"These data cannot distinguish it from {rivals}" in text


def test_what_the_records_hold_beside_the_motion_is_told_once(found):
    ripple = Finding(code="mains_ripple", severity="note", message="the sensor shows a ripple of the mains at 50 Hz.")
    summary = diagnosis_summary(replace(found, findings=(*found.findings, ripple)))
    assert "The sensor shows a ripple of the mains at 50 Hz." in summary.sentences
    assert len(re.findall(r"(?:the noise is|Noise) 0?\.?(?:019|02\d|19|2\d) [µm]m", " ".join(summary.sentences))) == 1
    assert not {"noise_model", "mains_ripple"} & {finding.code for finding in summary.findings}


def test_diagnosis_that_proposes_nothing_says_why(found):
    (cause,) = found.causes
    alone = replace(found, causes=(replace(cause, rivals=()),), rival_plants={}, next_experiment=None)
    assert alone.to_json()["reason"].startswith("next_experiment: the diagnosis names no rivals")
    twin = replace(alone, causes=(replace(cause, rivals=("dead_zone",)),))
    assert "give the same records whatever is done" in twin.to_json()["reason"]
    rival = replace(twin, rival_plants={cause.effect: (found.linear.plant,)})
    assert "no safe step like those logged" in rival.to_json()["reason"]
    assert type(found).from_json(json.loads(to_text(rival.to_json()))).to_json() == rival.to_json()


def test_errors_that_are_not_finite_are_null_with_a_reason(found):
    lost = Errors(rms_error=float("inf"), heldout_rms_error=0.001)
    runaway = replace(found.remainder, rms=float("inf"), times_noise=float("inf"), of_travel=float("inf"))
    body = json.loads(to_text(replace(found, extended=lost, remainder=runaway).to_json()))
    assert body["extended"]["rms_error"] is None
    assert "cannot be simulated" in body["extended"]["reason"]
    assert body["remainder"]["rms"] is None
    assert "cannot be simulated" in body["remainder"]["reason"]
    assert "reason" not in body["baseline"]
    text = " ".join(diagnosis_summary(replace(found, extended=lost, remainder=runaway)).sentences)
    assert "How much the model misses is unknown" in text
    assert "nan" not in text
    assert "inf " not in text


def test_every_effect_has_a_name_that_people_say():
    from servolens.effects import CATALOGUE

    assert all("_" not in spoken(name) for name in CATALOGUE)
