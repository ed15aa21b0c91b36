"""Time stamps that are off the instants at which samples were taken, and what a log shows of that."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from servolens import diagnose, lab
from servolens.checking import check
from servolens.cli import group
from servolens.even_times import with_even_times
from servolens.inputs import as_records
from servolens.quality import fatal
from servolens.record import Controller

CYCLE = 2e-3


def logged(**surroundings):
    rig = {"duration": 1.2, "sample_time": CYCLE, "noise": 5e-6, "reference": (0.1, 0.02), "seed": 4}
    return lab.step_record(lab.LM1, 60, 1.0, **{**rig, **surroundings})


def stamped(record, error, seed=1):
    """Return `record` with each stamp late by up to so much."""
    late = error * np.random.default_rng(seed).uniform(size=len(record))
    return replace(record, time=record.time + late)


def off_even(record):
    """By how much its intervals differ from whole cycles, at most."""
    steps = np.diff(record.time) / record.sample_time
    return float(np.abs(steps - np.rint(steps)).max())


@pytest.mark.parametrize("error", [1e-4, 5e-4, 1.5e-3])
def test_late_stamps_of_a_log_that_was_sampled_evenly_are_mended(error):
    taken = logged()
    (found,) = as_records(stamped(taken, error))
    assert off_even(found) < 1e-9
    assert found.sample_time == pytest.approx(CYCLE, rel=1e-3)
    assert found.stamp_error == pytest.approx(error / np.sqrt(12.0), rel=0.1)
    told = {finding.code: finding for finding in check(stamped(taken, error))}
    assert told["uneven_stamps"].severity == "note"
    assert "jitter" not in told


def test_the_command_says_of_stamps_and_integral_what_python_says(tmp_path):
    truth = lab.Truth(gain=2.0, damping=6.0, effects={"constant_force": {"acceleration": 5.0}})
    loop = Controller(kp=60.0, kd=4.0, ki=300.0, integral_before=2.5)
    held = lab.step_record(truth, seed=3, reference=(0.1, 0.02), noise=5e-6, setup=lab.Setup(controller=loop))
    unstated = replace(stamped(held, 5e-4), controller=replace(loop, integral_before=None))
    unstated.to_csv(tmp_path / "held.csv")
    result = CliRunner().invoke(group, ["check", str(tmp_path / "held.csv"), "--json", "-"])
    told = [finding["code"] for finding in json.loads(result.stdout)["findings"]]
    assert told == [finding.code for finding in check(tmp_path / "held.csv")]
    assert "uneven_stamps" in told
    assert not {"jitter", "settings_contradict_log"} & set(told)


def test_stamps_rounded_to_whole_milliseconds_are_mended():
    """A cycle of 1.6 ms has intervals of one and two."""
    taken = logged(sample_time=1.6e-3)
    rounded = replace(taken, time=np.round(taken.time, 3))
    (found,) = as_records(rounded)
    assert off_even(found) < 1e-6
    assert found.sample_time == pytest.approx(1.6e-3, rel=1e-3)


def test_lost_samples_stay_lost():
    taken = stamped(logged(), 3e-4)
    kept = np.ones(len(taken), dtype=bool)
    kept[[200, 201, 340]] = False
    gappy = replace(taken, **{s: getattr(taken, s)[kept] for s in ("time", "position", "reference", "voltage")})
    (found,) = as_records(gappy)
    assert off_even(found) < 1e-9
    assert np.sort(np.rint(np.diff(found.time) / CYCLE))[-2:].tolist() == [2.0, 3.0]


@pytest.mark.parametrize("seed", range(4))
def test_a_log_that_was_sampled_as_its_stamps_say_stays_as_it_is(seed):
    """The position at uneven instants, between the samples of a log that is ten times as fast."""
    fine = logged(sample_time=CYCLE / 10, noise=0.0)
    late = np.random.default_rng(seed).integers(0, 6, size=len(fine) // 10)
    chosen = 10 * np.arange(late.size) + late
    columns = {s: getattr(fine, s)[chosen] for s in ("time", "position", "reference", "voltage")}
    noise = np.random.default_rng(seed).normal(0.0, 5e-6, chosen.size)
    uneven = replace(fine, **{**columns, "position": columns["position"] + noise}, controller=None)
    assert with_even_times(uneven) is uneven


def test_where_noise_hides_which_instants_are_true_the_stamps_stand():
    loud = stamped(logged(noise=2e-3), 1e-4)
    assert with_even_times(loud) is loud
    still = stamped(logged(reference=0.0), 1e-3)
    assert with_even_times(still) is still


@pytest.mark.parametrize("cycle", [1 / 1024, 1 / 64, 1 / 4])
def test_stamps_that_are_even_to_the_last_bit_stay(cycle):
    taken = logged()
    exact = replace(taken, time=cycle * np.arange(len(taken)))
    assert with_even_times(exact) is exact


@pytest.mark.parametrize("late", [0.3, 0.75, 0.95])
def test_no_times_are_farther_from_the_truth_than_the_stamps(late):
    """Stamps so late that a clock cannot count its cycles stand."""
    taken = logged()
    for seed in range(12):
        found = with_even_times(stamped(taken, late * CYCLE, seed))
        error, before = (np.std(time - taken.time) for time in (found.time, stamped(taken, late * CYCLE, seed).time))
        assert error <= before


def test_even_stamps_and_a_cycle_that_changes_stay():
    taken = logged()
    assert with_even_times(taken) is taken
    slower = replace(taken, time=np.where(taken.time > 0.5, 2.0 * taken.time - 0.5, taken.time))
    assert with_even_times(slower) is slower


@pytest.mark.parametrize("count", range(2, 8))
def test_a_few_samples_tell_nothing(count):
    few = stamped(logged(), 1e-3).slice(0.0, CYCLE * count)
    assert with_even_times(few) is few


def test_late_stamps_name_no_cause():
    """Their errors grow with the speed, and were taken for a little dry friction."""
    runs = [
        lab.step_record(lab.LM1, kp, 1.0, reference=(0.1, 0.0), duration=1.0, noise=5e-6, seed=kp)
        for kp in (40, 60, 90)
    ]
    late = [stamped(run, 6e-4, seed) for seed, run in enumerate(runs)]
    found = diagnose(late[:2], heldout=late[2])
    assert found.verdict == "healthy"
    assert fatal(found.findings) == ()
    truth = {"gain": lab.LM1.gain, "damping": lab.LM1.damping}
    for name, true in truth.items():
        quantity = found.model.quantities[name]
        assert abs(quantity.value - true) < 4.0 * quantity.stderr < 1e-2 * true


@pytest.mark.parametrize("lost", [[], [40, 41, 200, 333]], ids=["all there", "some lost"])
def test_whole_milliseconds_of_a_loop_of_two_and_a_half_are_taken_evenly(lost):
    """With lost samples the cycle was 3 ms, and the gains that the log states seemed wrong."""
    taken = logged(sample_time=2.5e-3)
    signals = {name: np.delete(getattr(taken, name), lost) for name in ("position", "reference", "voltage")}
    record = taken.with_({**signals, "time": np.delete(np.round(taken.time, 3), lost)})
    found = with_even_times(record)
    assert found.sample_time == pytest.approx(2.5e-3, rel=1e-6)
    assert off_even(found) < 1e-6
    assert {finding.code for finding in check(record)} == {"uneven_stamps", *(["gaps"] if lost else [])}


@pytest.mark.parametrize(
    ("lost", "cure"),
    [([], 'state that by --setting "sample_time=2.5 ms".'), ([40, 41, 200], "write the stamps with more digits.")],
    ids=["all there", "some lost"],
)
def test_rounded_stamps_are_told_where_noise_hides_the_motion(lost, cure):
    taken = logged(sample_time=2.5e-3, noise=5e-3)
    signals = {name: np.delete(getattr(taken, name), lost) for name in ("position", "reference", "voltage")}
    record = taken.with_({**signals, "time": np.delete(np.round(taken.time, 3), lost), "controller": None})
    found = {finding.code: finding.message for finding in check(record.with_({"reference": None}))}
    assert found["rounded_stamps"] == (
        "the time stamps come in steps of 1 ms, as if rounded; if samples were taken regularly, they are 2.5 ms apart: "
        + cure
    )
    assert ("gaps" in found) == bool(lost)
    assert "jitter" not in found
