"""Quality: clean logs raise nothing, each defect raises its own finding, and real logs are judged as they are known."""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from servolens import Plant, fit, identify, lab, predict
from servolens.checking import check
from servolens.control_law import controller_voltage
from servolens.encoder import quantisation_step, white_noise
from servolens.errors import InputError
from servolens.quality import assess, fatal
from servolens.quality.beginning import beginning_findings
from servolens.quality.sampling import measure
from servolens.quality.spikes import without_spikes
from servolens.reading import read_record
from servolens.record import Controller, Record
from servolens.summaries import check_summary

DATA = Path(os.environ.get("SERVOLENS_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="measured data are not here (SERVOLENS_DATA)")


def simulated(
    *,
    beta=1.9,
    c=6.0,
    kp=60.0,
    kd=0.0,
    encoder=1e-5,
    noise=0.0,
    h=1e-3,
    edge=0,
    share=1.0,
    seed=0,
    limit=math.inf,
    dead=0.0,
    delay=0,
    force=None,
    added=None,
):
    """The digital PD loop on ÿ = βa(V) − cẏ − force, solved from sample to sample; exactly, if there is no force."""
    rng = np.random.default_rng(seed)
    n = round(1.5 / h)
    reference = np.where(np.arange(n) < edge, 0.0, 0.1)
    decay = math.exp(-c * h)
    travelled = (1 - decay) / c
    y, v, d, before = 0.0, 0.0, 0.0, None
    positions, voltages = [], []
    for k in range(n):
        seen = y + noise * rng.normal() + (0.0 if added is None else added[k])
        if encoder:
            seen = round(seen / encoder) * encoder
        d += share * ((0.0 if before is None else (seen - before) / h) - d)
        before = seen
        asked = kp * (reference[k] - seen) - kd * d
        positions.append(seen)
        voltages.append(asked)
        given = voltages[max(k - delay, 0)]
        push = beta * math.copysign(max(min(abs(given), limit) - dead, 0.0), given)
        final = (push - (force(y, v) if force else 0.0)) / c
        y, v = y + final * h + (v - final) * travelled, final + (v - final) * decay
    return Record(
        time=np.arange(n) * h,
        position=positions,
        reference=reference,
        voltage=voltages,
        controller=Controller(kp=kp, kd=kd, derivative_filter=share),
        encoder_resolution=encoder or None,
    )


def codes(record):
    return [finding.code for finding in check(record)]


def only(record):
    """The one finding, whose message is one line."""
    (finding,) = check(record)
    assert finding.message.isprintable()
    assert finding.message.endswith(".")
    return finding


def drawn(seed):
    """A random healthy axis and log: encoder 1 to 100 µm or none, noise up to 30 µm, a loop that is stable."""
    rng = np.random.default_rng(seed)
    axis = {"beta": rng.uniform(0.5, 5), "c": rng.uniform(2, 20)}
    kp, kd = rng.uniform(20, 150), float(rng.choice([0.0, rng.uniform(0, 10)]))
    h = float(rng.choice([5e-4, 1e-3, 2e-3]))
    if axis["c"] + axis["beta"] * kd < 4 * h * axis["beta"] * kp:  # the delay of sampling eats the damping
        kp /= 10
    encoder = 0.0 if rng.random() < 0.2 else 10 ** rng.uniform(-6, -4)
    noise = float(rng.choice([1e-6, 1e-5, 3e-5])) if encoder == 0 else float(rng.choice([0, 1e-6, 1e-5, 3e-5]))
    edge, share = int(rng.choice([0, 100])), float(rng.choice([1.0, 0.3]))
    return simulated(**axis, kp=kp, kd=kd, encoder=encoder, noise=noise, h=h, edge=edge, share=share, seed=seed)


@pytest.mark.parametrize("seed", range(60))
def test_clean_log_raises_nothing(seed):
    assert codes(drawn(seed)) == []


@pytest.mark.parametrize("truth", [lab.NLM1, lab.NLM2, lab.NLM3], ids=["NLm1", "NLm2", "NLm3"])
def test_laboratory_raises_nothing(truth):
    records = (*lab.paper_campaign(truth, seed=1), *lab.table_one(truth, seed=2))
    assert [codes(record) for record in records] == [[]] * len(records)


@pytest.mark.parametrize(("kp", "kd"), [(60, 0), (60, 5)])
@pytest.mark.parametrize(
    "effect",
    [
        {"dead": 0.5},
        {"delay": 5},
        {"limit": 4.0},
        {"force": lambda y, v: 0.8 * math.tanh(v / 1e-3)},
        {"force": lambda y, v: 20.0 * y},
        {"force": lambda y, v: 1.0},
        {"force": lambda y, v: 2.0 * math.sin(2 * math.pi * y / 0.01)},
        {"force": lambda y, v: 20.0 * math.exp(-20 * abs(v)) * v},
    ],
    ids=["dead zone", "delay", "saturation", "friction", "spring", "tilt", "cogging", "varying damping"],
)
def test_what_the_axis_lacks_is_no_fault_of_the_log(effect, kp, kd):
    assert codes(simulated(kp=kp, kd=kd, noise=1e-5, **effect)) == []


def test_axis_that_sticks_is_no_fault_of_the_log():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 4.0}})
    for encoder in (1e-6, 1e-5, 1e-4):
        assert codes(lab.step_record(truth, 60, noise=0.0, encoder=encoder, seed=3)) == []


def test_measures_are_those_of_the_log():
    quality = assess(simulated(encoder=0.0, noise=1e-5, kd=2.0))
    assert quality.noise == pytest.approx(1e-5, rel=0.1)
    assert quality.quantisation_step is None
    assert (quality.samples, quality.usable, quality.lost_samples) == (1500, True, 0)
    assert quality.sample_time == pytest.approx(1e-3)
    assert quality.jitter < 1e-12
    assert (quality.fitted_kp, quality.fitted_kd) == (pytest.approx(60, rel=1e-6), pytest.approx(2, rel=1e-6))
    assert quality.law_misfit < 1e-9
    assert quality.voltage_range[1] == pytest.approx(6.0, abs=0.1)
    assert 0.09 < quality.travel < 0.2


def test_assessment_is_plain_json():
    entry = assess(simulated()).to_json()
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry
    assert entry["usable"] is True
    assert "findings" not in entry


@pytest.mark.parametrize("step", [1e-6, 4.84e-5, 1e-4])
@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_quantisation_step_is_seen(step, noise):
    assert quantisation_step(simulated(encoder=step, noise=noise).position) == pytest.approx(step, rel=0.01)


def test_quantisation_step_is_seen_through_print_rounding():
    position = np.round(simulated(encoder=4.84e-5).position, 6)
    assert quantisation_step(position) == pytest.approx(4.84e-5, rel=0.02)


def in_noise(colour, *, sigma=3e-5, **settings):
    """`simulated` with sensor noise that is correlated from sample to sample by `colour`, before the encoder."""
    noise = math.sqrt(1 - colour**2) * lfilter([1.0], [1.0, -colour], np.random.default_rng(3).standard_normal(2500))
    return simulated(added=sigma * noise[1000:], **settings)


@pytest.mark.parametrize("colour", [0.0, 0.9, 0.99])
@pytest.mark.parametrize("encoder", [0.0, 1e-5, 2e-4])
@pytest.mark.parametrize(
    "effect",
    [
        {},
        {"force": lambda y, v: 1.0 * math.tanh(v / 1e-3)},
        {"force": lambda y, v: (1.0 + math.exp(-abs(v) / 0.01)) * math.tanh(v / 1e-3)},
        {"force": lambda y, v: 3.0 * math.cos(y)},
        {"limit": 3.0},
    ],
    ids=["none", "friction", "stiction", "gravity", "saturation"],
)
def test_noise_of_any_colour_raises_nothing(effect, encoder, colour):
    for kp, kd in ((60.0, 0.0), (100.0, 3.0)):
        record = in_noise(colour, kp=kp, kd=kd, encoder=encoder, **effect)
        assert codes(record) == []
        assert codes(record.with_({"voltage": None})) == ["voltage_reconstructed"]
        assert codes(record.with_({"reference": None})) == ["no_reference"]


# ---- clock


def cut(record, keep):
    signals = ("time", "position", "reference", "voltage")
    return record.with_({signal: getattr(record, signal)[keep].copy() for signal in signals})


def test_lost_samples_are_counted():
    record = simulated(encoder=0.0, noise=1e-6)
    finding = only(cut(record, np.delete(np.arange(1500), [700, 701, 900])))
    assert (finding.code, finding.severity, finding.record) == ("gaps", "warning", "record")
    assert finding.message.startswith("3 samples are lost in 2 places, the first before 0.702 s;")


@pytest.mark.parametrize("first", [2, 5, 700])
@pytest.mark.parametrize(("before", "after"), [(1e-3, 2e-3), (2e-3, 1e-3), (1e-3, 1.5e-3)])
def test_bus_that_changes_its_cycle_loses_no_samples(first, before, after):
    time = np.cumsum(np.where(np.arange(1500) <= first, before, after))
    position = np.round(0.1 * (1 - np.exp(-8 * time)) / 1e-5) * 1e-5
    record = Record(time=time, position=position, reference=np.full(1500, 0.1), controller=Controller(kp=60))
    found = {finding.code: finding.message for finding in check(record)}
    assert set(found) == {"cycle_changes", "voltage_reconstructed", "onset_missed"}  # it sets out at full speed
    assert f"between {1e3 * min(before, after):g} and {1e3 * max(before, after):g} ms" in found["cycle_changes"]
    assert assess(record).lost_samples == 0
    torn = cut(record.with_({"voltage": np.zeros(1500)}), np.delete(np.arange(1500), [100, 101, 1200]))
    assert assess(torn).lost_samples == 3


def test_jitter_counts_where_it_moves_the_axis():
    record = simulated()
    rng = np.random.default_rng(1)
    stamped = record.with_({"time": record.time + 2e-4 * rng.uniform(-1, 1, size=1500)})
    taken = CubicSpline(record.time, record.position)(stamped.time)
    assert "jitter" in codes(stamped.with_({"position": taken}))
    assert only(stamped).code == "uneven_stamps"  # of samples that were taken evenly
    rounded = record.with_({"time": np.round(record.time, 9) + 1e-9 * rng.uniform(-1, 1, size=1500)})
    assert codes(rounded) == []


def test_too_few_samples_are_unusable():
    quality = assess(cut(simulated(), slice(0, 1500, 100)))
    assert "too_few_samples" in [finding.code for finding in quality.findings]
    assert not quality.usable


# ---- sensor


def test_coarse_encoder_is_said():
    finding = only(simulated(encoder=1e-3))
    assert finding.code == "coarse_quantisation"
    assert "0.001 m, 1 % of the step: whether the axis stays within a band of ±1 % or less" in finding.message


@pytest.mark.parametrize("kd", [0.0, 3.0])
@pytest.mark.parametrize("logs_voltage", [True, False])
def test_exchanged_columns_are_said_once(kd, logs_voltage):
    truth = lab.Truth(gain=2.0, damping=5.0)
    run = lab.step_record(truth, 80, kd, reference=(0.1, 0.0), noise=1e-5, seed=1, setup=lab.Setup(rest=0.2))
    voltage = run.voltage if logs_voltage else None
    quality = assess(run.with_({"position": run.reference, "reference": run.position, "voltage": voltage}))
    assert [finding.code for finding in quality.findings] == ["columns_exchanged"]
    assert not quality.usable
    assert fatal(quality.findings)


def test_coarse_encoder_that_follows_a_smooth_reference_is_no_reference():
    share = np.clip(np.arange(2500) / 2000, 0.0, 1.0)
    way = 0.05 * share**3 * (10 - 15 * share + 6 * share**2)
    truth, setup = lab.Truth(gain=2.0, damping=5.0), lab.Setup(trajectory=way)
    for encoder in (0.006, 0.01, 0.012):
        run = lab.step_record(truth, 60, 2, encoder=encoder, setup=setup)
        assert "columns_exchanged" not in codes(run)


def test_encoder_whose_step_is_the_whole_one_shows_no_band():
    record = simulated(encoder=1e-2)
    hardly = record.with_({"reference": 0.01 * record.reference})
    (said,) = [finding.message for finding in assess(hardly).findings if finding.code == "coarse_quantisation"]
    assert "%" not in said
    assert "0.01 m, as large as the step that was commanded: whether it stays within a band cannot be seen" in said


@pytest.mark.parametrize(("stated", "code"), [(1e-5, None), (2e-6, True), (7e-5, True)])
def test_encoder_that_is_not_the_stated_one_is_said(stated, code):
    record = simulated(encoder=1e-5, noise=1e-5).with_({"encoder_resolution": stated})
    assert codes(record) == (["encoder_contradicts_log"] if code else [])


def test_encoder_of_a_rounded_log_is_believed():
    record = simulated(encoder=4.84e-5)
    rounded = record.with_({"position": np.round(record.position, 6)})
    assert "encoder_contradicts_log" not in codes(rounded)


def test_repeated_samples_are_said():
    record = simulated(encoder=1e-6)
    held = np.repeat(np.arange(0, 1500, 3), 3)
    slow = record.with_({"position": record.position[held].copy(), "voltage": record.voltage[held].copy()})
    assert "repeated_samples" in codes(slow)


def test_sensor_that_freezes_is_said():
    record = simulated(encoder=1e-6)
    position = record.position.copy()
    position[100:130] = position[100]
    (finding,) = [f for f in check(record.with_({"position": position})) if f.code == "frozen_position"]
    assert finding.message.startswith("the position stands still for 29 samples from 0.1 s and then jumps by ")


def lost_silently(record, lost):
    """Return the record without some samples, its time renumbered."""
    short = cut(record, np.delete(np.arange(len(record)), lost))
    return short.with_({"time": record.time[: len(short)].copy()})


@pytest.mark.parametrize("count", [1, 5, 20])
@pytest.mark.parametrize("missing", [(), ("voltage",), ("reference", "controller")], ids=["none", "V", "r"])
def test_lost_samples_that_the_time_column_hides_are_said(count, missing):
    record = lost_silently(lab.step_record(lab.NLM2, 60, noise=1e-5, seed=4), np.arange(100, 100 + count))
    (finding,) = [f for f in check(record.with_(dict.fromkeys(missing))) if f.severity == "warning"]
    assert finding.code == "position_jumps"
    assert " at 0.1 s, as far as it goes in " in finding.message
    assert int(re.search(r"in (\d+) samples", finding.message)[1]) == pytest.approx(count, abs=2)


def turning(target, wraps):
    """Return an angle of first order with a sensor of one turn, or one that counts on."""
    time = 0.002 * np.arange(1500)
    angle = target * (1.0 - np.exp(-np.maximum(time - 0.2, 0.0) / 0.3))
    return Record(
        time=time, position=np.mod(angle + 1.0, 2.0 * np.pi) if wraps else angle,
        reference=np.where(time < 0.2, 0.0, target), voltage=np.where(time < 0.2, 0.0, target / 0.3), length_unit="rad",
    )  # fmt: skip


@pytest.mark.parametrize("target", [7.0, -9.0])
def test_a_sensor_that_begins_again_after_each_turn_is_said(target):
    """Truth: the lag of first order, its angle within one turn as a single-turn encoder shows it."""
    assert "position_wraps" not in codes(turning(target, wraps=False))
    (finding,) = [f for f in check(turning(target, wraps=True)) if f.severity == "error"]
    assert finding.code == "position_wraps"
    assert "unwrap the column" in finding.message


@pytest.mark.parametrize("height", [4.8, 6.0, -6.3, 7.5])
def test_a_spike_of_about_a_turn_is_a_spike(height):
    record = turning(3.0, wraps=False)
    position = record.position.copy()
    position[700] += height
    assert "position_spikes" in codes(record.with_({"position": position}))
    assert "position_wraps" not in codes(record.with_({"position": position}))


@pytest.mark.parametrize("places", [[0], [1], [0, 1], [-2], [-1], [700, 701], [700, 703]], ids=str)
@pytest.mark.parametrize("height", [6.0, -6.3])
def test_a_few_disturbed_samples_are_no_turn(places, height):
    record = turning(3.0, wraps=False)
    position = record.position.copy()
    position[places] += height
    assert "position_wraps" not in codes(record.with_({"position": position}))


def test_a_sensor_that_rests_on_the_border_of_its_turn_wraps():
    record = turning(2.0 * np.pi - 1.0, wraps=True)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(len(record))
    wrapped = np.mod(turning(2.0 * np.pi - 1.0, wraps=False).position + 1.0 + noise, 2.0 * np.pi)
    assert "position_wraps" in codes(record.with_({"position": wrapped}))


def test_an_axis_that_turned_once_in_a_gap_has_not_wrapped():
    record = turning(30.0, wraps=False)
    kept = np.delete(np.arange(1500), np.arange(90, 135))
    signals = {name: getattr(record, name)[kept] for name in ("time", "position", "reference", "voltage")}
    assert abs(np.max(np.diff(signals["position"])) - 2.0 * np.pi) < 0.5 * np.pi
    assert "position_wraps" not in codes(record.with_(signals))


def test_a_spike_elsewhere_does_not_hide_that_a_sensor_wraps():
    record = turning(9.0, wraps=True)
    position = record.position.copy()
    position[700] += 3.0
    assert "position_wraps" in codes(record.with_({"position": position}))


def test_lost_samples_of_an_axis_almost_at_rest_are_told_by_the_control_law():
    record = lab.step_record(lab.NLM1, 100, 4, noise=1e-5, seed=4)
    still = int(np.argmax(record.position)) + 10
    (finding,) = check(lost_silently(record, np.arange(still, still + 20)))
    assert finding.code == "position_jumps"
    assert "the logged voltage knows nothing of it: samples are lost, whatever the time column says" in finding.message


def test_jump_that_the_controller_has_seen_is_the_sensor_s():
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, seed=4)
    slipped = record.with_({"position": record.position + np.where(np.arange(len(record)) < 100, 0.0, 0.003)})
    (finding,) = check(slipped.with_({"voltage": controller_voltage(slipped)}))
    assert finding.code == "position_jumps"
    assert "and the voltage with it: check the sensor for lost counts" in finding.message


@pytest.mark.parametrize("height", [0.01, -0.004])
@pytest.mark.parametrize("encoder", [0.0, 1e-4])
def test_single_samples_that_stick_out_are_the_sensors(height, encoder):
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, encoder=encoder, seed=4)
    position = record.position.copy()
    position[[2, 40, 250]] += height * np.array([0.5, 1.0, 0.5])
    spiked = record.with_({"position": position})
    (finding,) = check(spiked)  # the voltage knows nothing of them, which is no fault of the gains
    assert finding.code == "position_spikes"
    assert " at 0.04 s for one sample and is back (3 such samples)" in finding.message
    assert float(re.search(r"leaps by ([\d.]+) m", finding.message)[1]) == pytest.approx(abs(height), rel=0.1)
    assert "fits, predictions and diagnoses interpolate such samples" in finding.message
    assert np.abs(without_spikes(spiked).position - record.position).max() < 1e-4
    wrong = spiked.with_({"controller": replace(record.controller, kp=70.0)})
    assert {"position_spikes", "gains_contradict_log"} <= set(codes(wrong))


@pytest.mark.parametrize(
    "number",
    [
        lambda record: identify(record, model="constant").constant.plant.gain,
        lambda record: fit("coulomb_friction", record).plant.gain,
        lambda record: predict(Plant(gain=1.8, damping=5.5), record).errors[0][0].rms_error,
    ],
    ids=["identify", "fit", "predict"],
)
def test_samples_that_stick_out_change_neither_fits_nor_errors(number):
    record = lab.step_record(lab.LM1, 60, noise=1e-5, seed=4)
    position = record.position.copy()
    position[[200, 500, 900]] += (0.02, -0.02, 0.02)
    assert number(record.with_({"position": position})) == pytest.approx(number(record), rel=1e-4)


def test_what_sticks_out_by_less_than_the_axis_moves_is_told_by_the_law():
    """A healthy axis with two such samples was left unexplained, and its noise taken for three times as large."""
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, seed=4)
    quickest = int(np.argmax(np.gradient(record.position)))
    moved = record.position[quickest + 1] - record.position[quickest - 1]
    position = record.position + np.where(np.arange(len(record)) == quickest, 0.6 * moved, 0.0)
    spiked = record.with_({"position": position})
    assert np.abs(without_spikes(spiked).position - record.position).max() < 1e-4
    early = spiked.with_({"voltage": controller_voltage(spiked)})  # so do samples that are taken early
    assert np.array_equal(without_spikes(early).position, position)


@pytest.mark.parametrize("apart", [1, 2, 3])
@pytest.mark.parametrize("stated", [{}, {"kp": 70.0}, {"kd": 5.0}], ids=["right", "kp", "kd"])
def test_samples_that_stick_out_together_are_no_fault_of_the_law(apart, stated):
    """The voltage was said to be logged 13 samples early, and kd to be -0.2."""
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, seed=4)
    position = record.position.copy()
    position[[250, 700, 700 + apart, 1200, 1200 + apart]] += [0.005, 0.008, -0.011, 0.01, 0.009]
    spiked = record.with_({"position": position, "controller": replace(record.controller, **stated)})
    assert codes(spiked) == ["position_spikes", *(["gains_contradict_log"] if stated else [])]
    assert np.abs(without_spikes(spiked).position - record.position).max() < 1e-4


@pytest.mark.parametrize("late", [-2, -1, 1, 2])
def test_samples_that_stick_out_beside_a_shifted_voltage_stop_nothing(late):
    """A mask of 1501 samples met the 1500 that a shifted column leaves, and the check stopped with a ValueError."""
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, seed=4)
    position = record.position + np.where(np.arange(len(record)) == 700, 0.01, 0.0)
    spiked = record.with_({"position": position, "voltage": np.roll(record.voltage, late)})
    assert {"position_spikes", "voltage_shifted"} <= set(codes(spiked))


@pytest.mark.parametrize("first", [1, 2])
def test_samples_that_stick_out_of_a_log_that_begins_within_a_cycle_of_its_loop_stop_nothing(first):
    slow = lab.Setup(controller=Controller(kp=60, kd=4, control_period=0.008))
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-5, seed=4, setup=slow)
    position = record.position + np.where(np.arange(len(record)) % 500 == 301, 0.01, 0.0)
    spiked = record.with_({"position": position}).slice(record.time[first], record.time[-1])
    assert "position_spikes" in codes(spiked)


def test_vibration_and_knocks_are_no_pairs_of_spikes():
    time = np.arange(2000) * 1e-3
    noise = 1e-6 * np.random.default_rng(5).standard_normal(time.size)
    ring = np.where(time > 1.0, 1e-3 * np.exp(-30.0 * (time - 1.0)) * np.sin(2e3 * (time - 1.0)), 0.0)
    corner = 0.3 * np.abs(time - 0.5)
    slip = np.where(time > 1.5, 2e-3, 0.0)
    spiked = ring + corner + slip + noise
    assert np.array_equal(without_spikes(positions(time, spiked)).position, spiked)


def test_lost_sample_is_told_without_the_digits_that_a_stamp_cannot_hold():
    record = cut(simulated(encoder=0.0, noise=1e-6), np.delete(np.arange(1500), [700]))
    stamped = record.with_({"time": record.time + 1.3e-7 * (np.arange(len(record)) % 3)})
    assert "the first before 0.701 s;" in only(stamped).message


def positions(time, position):
    """Return a log of which only the position matters."""
    return Record(time=time, position=position, voltage=np.zeros(time.size))


@pytest.mark.parametrize("samples", [4, 5, 6, 12])
def test_spike_of_a_short_log_needs_some_samples_to_stand_out_of(samples):
    line = np.arange(samples) * 1e-3
    spiked = positions(line, line + np.where(np.arange(samples) == 2, 5.0, 0.0))
    found = without_spikes(spiked).position
    assert found == pytest.approx(line if samples > 11 else spiked.position)


def test_samples_taken_twice_or_early_are_no_spikes():
    record = lab.step_record(lab.NLM2, 60, 4, noise=1e-6, seed=4)
    position = record.position.copy()
    position[[30, 40, 52]] = position[[29, 39, 51]]
    position[60] = 0.4 * position[60] + 0.6 * position[61]
    assert "position_spikes" not in codes(record.with_({"position": position, "voltage": None}))


@pytest.mark.parametrize("samples", [2.9, 3.0, 3.05])
def test_vibration_of_a_few_samples_is_no_spike(samples):
    time = np.arange(400) * 0.01
    ringing = np.where(time < 0.5, 0.0, 0.1 + 2e-3 * np.exp(-2.0 * time) * np.sin(2.0 * np.pi * 100.0 * time / samples))
    noisy = ringing + 1e-6 * np.random.default_rng(1).standard_normal(time.size)
    assert without_spikes(positions(time, noisy)).position == pytest.approx(noisy, abs=0.0)


def test_noise_slips_and_coarse_encoders_are_no_spikes():
    rng = np.random.default_rng(2)
    time = np.arange(300_000) * 1e-3
    noise = 1e-5 * rng.standard_normal(time.size)
    noise[10::50] += 9e-5  # nine standard deviations are not yet beyond doubt
    slip = 1e-6 * rng.standard_normal(400) + np.where(np.arange(400) < 200, 0.0, 0.1)
    flicker = lab.step_record(lab.NLM2, 60, 4, noise=1e-4, encoder=0.01, seed=0, duration=1.0)
    logs = [positions(time, noise), positions(time[:400], slip), cut(flicker, slice(0, None, 10))]
    for record in logs:
        assert without_spikes(record) is record


def test_rounding_at_rest_is_no_spike():
    time = np.arange(400) * 1e-3
    position = 0.1 * np.sin(5.0 * np.pi * np.minimum(time, 0.1))  # rests for most of the time
    position[300] += 1e-14
    record = positions(time, position)
    assert without_spikes(record) is record


def test_sample_between_two_gaps_is_no_spike():
    kept = np.r_[0:190, 200, 211:400]
    time = kept * 1e-3
    record = positions(time, 0.1 * np.cos(2.0 * np.pi * (time - 0.2) / 0.022))
    assert without_spikes(record) is record


HARD = {
    "backlash": {"gap": 2e-3, "load_share": 0.5},
    "flexible_coupling": {"frequency": 60.0, "damping_ratio": 0.01, "load_ratio": 0.4},
    "coulomb_friction": {"level": 4.0},
    "delay": {"time": 0.03},
    "speed_servo": {"speed_per_volt": 0.019, "proportional": 100.0, "integral": 500.0},
}


@cache
def driven(effect):
    """Records of an axis with a hard effect, the last with a coarse encoder."""
    truth = lab.Truth(gain=1.9, damping=6.0, effects={effect: HARD[effect]})
    levels = {"reference": (0.1, 0.02, 0.07), "duration": 1.0}
    loops = ((60, 0, 1e-5), (40, 2, 1e-5), (60, 1, 5e-4))
    return [lab.step_record(truth, kp, kd, **levels, noise=1e-5, seed=1, encoder=step) for kp, kd, step in loops]


@pytest.mark.parametrize("effect", HARD)
@pytest.mark.parametrize("every", [1, 5, 20, 50])
def test_motion_has_no_jumps_however_slowly_it_is_logged(effect, every):
    for record in driven(effect):
        slow = cut(record, slice(0, None, every)).with_({"voltage": None})
        assert not {"position_jumps", "position_spikes"} & set(codes(slow))


def test_knocks_and_trajectories_are_no_jumps():
    def knocks(y, v):
        return 300.0 if 0.03 < y < 0.0305 else 0.0

    assert not {"position_jumps", "position_spikes"} & set(codes(simulated(force=knocks, noise=1e-5)))
    way = 0.1 * np.sin(40.0 * np.arange(3000) * 1e-3)
    assert codes(lab.step_record(lab.NLM2, 60, 2, noise=1e-5, seed=1, setup=lab.Setup(trajectory=way))) == []


@pytest.mark.parametrize(
    "hidden",
    [["backlash"], ["flexible_coupling", "dead_zone"], ["presliding"], ["sensor_lag"], ["periodic_disturbance"]],
)
def test_hidden_campaign_raises_nothing(hidden):
    campaign = lab.hidden_campaign(7, effects=hidden, visibility=60.0)
    assert [codes(record) for record in (*campaign.records, *campaign.heldout)] == [[]] * (
        len(campaign.records) + len(campaign.heldout)
    )


# ---- motion


def test_constant_position_is_unusable():
    quality = assess(simulated().with_({"position": np.full(1500, 0.02)}))
    error = [finding for finding in quality.findings if finding.severity == "error"]
    assert [finding.code for finding in error] == ["constant_position"]
    assert error[0].message == "the position is 0.02 m throughout; check the sensor, or log a step."
    assert not quality.usable


def test_noise_alone_is_unusable():
    position = 1e-5 * np.random.default_rng(0).normal(size=1500)
    quality = assess(simulated(encoder=0.0, noise=1e-6).with_({"position": position}))
    assert [f.code for f in quality.findings if f.severity == "error"] == ["weak_excitation"]


def test_small_motion_is_a_warning():
    record = simulated(encoder=1e-5)
    small = np.round(record.position / 400 / 1e-5) * 1e-5
    (finding,) = [f for f in check(record.with_({"position": small})) if f.code == "weak_excitation"]
    assert finding.severity == "warning"


def test_motor_that_is_off_throughout_tells_nothing():
    record = lab.step_record(lab.NLM1, 60.0, noise=1e-5, seed=1)
    off = record.with_({"enabled": np.zeros(len(record))})
    assert codes(off) == ["motor_off"]
    with pytest.raises(InputError, match="while the motor is on"):
        identify(off)
    assert codes(record.with_({"enabled": np.ones(len(record))})) == []


def test_dead_voltage_is_said():
    record = simulated()
    assert codes(record.with_({"voltage": np.zeros(1500)})) == ["dead_voltage"]


@pytest.mark.parametrize("seed", range(10))
def test_wrong_sign_is_said(seed):
    record = drawn(seed)
    flipped = record.with_({"voltage": -record.voltage, "controller": None})
    assert "wrong_sign" in codes(flipped)
    mirrored = record.with_({"voltage": -record.voltage})
    assert "wrong_sign" in codes(mirrored)
    assert "gains_contradict_log" not in codes(mirrored)  # a sign, and no other gains


def test_position_of_the_wrong_sign_is_said():
    record = staircase(60, 4)
    mirrored = record.with_({"position": -record.position})
    for log in (mirrored, mirrored.with_({"controller": None}), mirrored.with_({"voltage": None})):
        assert [finding.code for finding in fatal(check(log))] == ["wrong_sign"]
    once = lab.step_record(lab.NLM2, 60, noise=1e-5, seed=1)  # a weight may draw it there
    (finding,) = [f for f in check(once.with_({"position": -once.position, "voltage": None})) if f.severity != "note"]
    assert (finding.code, finding.severity) == ("wrong_sign", "warning")


@pytest.mark.parametrize("trajectory", [True, False])
@pytest.mark.parametrize("gain", [0.7, 8.0])
@pytest.mark.parametrize(
    "weight",
    [
        {"pendulum_gravity": {"amplitude": 60.0, "phase": 0.0}},
        {"pendulum_gravity": {"amplitude": 40.0, "phase": 1.6}},
        {"constant_force": {"acceleration": 9.81}},
        {"constant_force": {"acceleration": -9.81}, "coulomb_friction": {"level": 3.0}},
        {"return_spring": {"stiffness": 60.0}},
    ],
    ids=["pendulum", "arm", "lift", "lowering", "spring"],
)
def test_weight_is_no_wrong_sign(weight, gain, trajectory):
    truth = lab.Truth(gain=gain, damping=6.0, effects=weight)
    way = 0.7 + 0.4 * np.sin(2e-3 * np.arange(2000)) if trajectory else None
    steps = {"sample_time": 2e-3} if trajectory else {"reference": (0.5, -0.3, 0.4), "duration": 0.8}
    setup = lab.Setup(length_unit="rad", trajectory=way)
    for kp, kd in ((15, 0), (60, 3)):
        record = lab.step_record(truth, kp, kd, noise=1e-5, seed=2, setup=setup, **steps)
        offset = record.with_({"voltage": record.voltage - 0.5, "reference": None, "controller": None})
        for log in (record, record.with_({"voltage": None}), record.with_({"reference": None}), offset):
            assert not {"wrong_sign", "units_contradict"} & set(codes(log))


@pytest.mark.parametrize("trajectory", [True, False])
def test_wrong_sign_under_a_weight_is_said_without_a_reference(trajectory):
    truth = lab.Truth(gain=8.0, damping=6.0, effects={"pendulum_gravity": {"amplitude": 20.0, "phase": 0.5}})
    way = 0.7 + 0.4 * np.sign(np.sin(8e-3 * np.arange(2000))) if trajectory else None
    steps = {} if trajectory else {"reference": (0.5, -0.3, 0.4), "duration": 0.8}
    setup = lab.Setup(length_unit="rad", trajectory=way)
    record = lab.step_record(truth, 30, 1, noise=1e-5, seed=2, setup=setup, **steps)
    flipped = record.with_({"voltage": -record.voltage, "reference": None, "controller": None})
    assert [finding.code for finding in fatal(check(flipped))] == ["wrong_sign"]


@pytest.mark.parametrize(("factor", "power"), [(1e3, 3), (1e6, 6)])
@pytest.mark.parametrize("kd", [0, 4])
def test_time_that_cannot_be_seconds_is_said(factor, power, kd):
    record = staircase(60, kd)
    found = fatal(check(record.with_({"time": factor * record.time})))
    assert {finding.code for finding in found} == {"units_contradict"}
    shown = f"10^{power} times what the loop used" if kd else f"{factor * 1e-3:g} s apart"
    assert f"the time stamps are {shown}" in found[0].message


def test_time_in_thousands_of_seconds_is_told_by_the_derivative():
    record = staircase(60, 4)
    (finding,) = fatal(check(record.with_({"time": 1e-3 * record.time})))
    assert "the time stamps are 10^-3 times what the loop used" in finding.message


def test_growing_oscillation_is_said():
    finding = only(simulated(c=0.5, kp=400.0, kd=-1.0, encoder=1e-5))
    assert finding.code == "unstable_log"
    assert "grows from" in finding.message


def test_a_position_that_runs_away_from_its_reference_is_said():
    """A spring that pushes outwards is held by kp while it is stiffer; a negative damping lets the axis go slowly."""
    pushed = lab.Truth(gain=2.0, damping=8.0, effects={"return_spring": {"stiffness": -130.0}})
    held, away = (lab.step_record(pushed, kp, 0.0, noise=1e-5, seed=1, duration=1.2) for kp in (90, 60))
    (finding,) = (one for one in check(away) if one.code == "unstable_log")
    assert "runs away from its reference" in finding.message
    assert "the largest step is 0.1 m" in finding.message
    assert "unstable_log" not in {one.code for one in check(held)}
    ended = away.slice(0.0, 0.02)
    assert "unstable_log" not in {one.code for one in check(ended)}


def test_an_axis_that_has_sagged_does_not_run_away():
    """A weight that a weak loop lets down farther than its step; and without any step."""
    weight = lab.Truth(gain=2.0, damping=8.0, effects={"constant_force": {"acceleration": 40.0}})
    sagging = lab.step_record(weight, 50, 1.0, noise=1e-5, seed=1, duration=2.5)
    assert np.abs(sagging.position - sagging.reference)[-1] > 0.2
    still = sagging.with_({"reference": 0.0 * sagging.reference})
    assert "unstable_log" not in {one.code for record in (sagging, still) for one in check(record)}


# ---- loop


@pytest.mark.parametrize(("kp", "kd"), [(60, 0), (58.7, 0.5), (56, 1.0)])
@pytest.mark.parametrize("rounding", [0.0, 1e-3])
def test_gains_that_are_not_the_log_s_are_named(kp, kd, rounding):
    record = simulated(kp=58.7, kd=0.02)
    if rounding:
        record = record.with_({"voltage": np.round(record.voltage / rounding) * rounding})
    finding = only(record.with_({"controller": Controller(kp=kp, kd=kd)}))
    assert finding.code == "gains_contradict_log"
    fitted = assess(record)
    assert (fitted.fitted_kp, fitted.fitted_kd) == (pytest.approx(58.7, rel=1e-3), pytest.approx(0.02, abs=0.01))
    if not rounding:
        assert finding.message == (
            f"the logged voltage fits kp = 58.7 V/m, kd = 0.02 V s/m, not kp = {kp:.4g} V/m, kd = {kd:.4g} V s/m;"
            " correct the stated gains."
        )


def test_ringing_after_an_edge_is_forgiven():
    record = simulated(edge=200)
    voltage = record.voltage.copy()
    lag = np.arange(10)
    voltage[200:210] += 3.0 * np.cos(2 * lag) * np.exp(-lag / 4)
    assert codes(record.with_({"voltage": voltage})) == []


def test_few_outliers_do_not_move_the_gains():
    record = simulated()
    voltage = record.voltage.copy()
    voltage[np.arange(50, 1500, 97)] += 5.0
    quality = assess(record.with_({"voltage": voltage}))
    assert quality.fitted_kp == pytest.approx(60.0, rel=1e-4)
    assert [finding.code for finding in quality.findings] == []


def test_clipped_log_is_said_and_its_gains_still_verified():
    record = simulated(limit=3.0)
    clipped = record.with_({"voltage": np.clip(record.voltage, -3, 3)})
    finding = only(clipped)
    assert finding.code == "clipped_voltage"
    assert finding.message.startswith("the logged voltage stays at 3 V for 153 samples while the control law asks for")
    assert "state voltage_limit = 3 V, or" in finding.message
    assert assess(clipped).fitted_kp == pytest.approx(60, rel=1e-6)


def test_asking_beyond_the_stated_limit_is_a_note():
    finding = only(simulated(limit=3.0).with_({"voltage_limit": 3.0}))
    assert (finding.code, finding.severity) == ("voltage_beyond_limit", "note")


def test_voltage_that_follows_no_pd_law_is_said():
    record = simulated()
    rng = np.random.default_rng(0)
    other = np.convolve(rng.normal(size=1500), np.ones(50) / 7, mode="same")
    assert "law_contradicts_log" in codes(record.with_({"voltage": record.voltage + other}))


@pytest.mark.parametrize("shift", [-12, -2, -1, 1, 2, 12])
def test_shifted_voltage_is_said(shift):
    record = simulated(kd=5.0, edge=100)
    shifted = np.roll(record.voltage, shift)
    (finding,) = [f for f in check(record.with_({"voltage": shifted})) if f.code == "voltage_shifted"]
    count = "1 sample" if abs(shift) == 1 else f"{abs(shift)} samples"
    when = "after" if shift > 0 else "before"
    assert finding.message == f"the voltage is logged {count} {when} its position; shift the column."


def staircase(kp=60, kd=0.0, **settings):
    """Steps of a laboratory cart, the first at the first sample."""
    settings = {"reference": (0.1, 0.02, 0.07), "duration": 0.6, "noise": 1e-5, "seed": 1, **settings}
    return lab.step_record(lab.NLM2, kp, kd, **settings)


def logged_late(record, column, samples):
    signal = getattr(record, column)
    return record.with_({column: signal[np.clip(np.arange(signal.size) - samples, 0, signal.size - 1)]})


@pytest.mark.parametrize("samples", [-20, -5, -1, 1, 3, 5, 20])
@pytest.mark.parametrize(("column", "other"), [("position", "reference"), ("reference", "position")])
@pytest.mark.parametrize(("kp", "kd"), [(60, 0), (100, 4)])
def test_column_that_is_logged_late_or_early_is_said_instead_of_other_gains(column, other, samples, kp, kd):
    record = staircase(kp, kd)
    assert codes(record) == []
    late = logged_late(record, column, samples)
    (finding,) = [f for f in check(late) if f.code != "onset_missed"]  # an early position begins in motion
    count = "1 sample" if abs(samples) == 1 else f"{abs(samples)} samples"
    assert (finding.code, finding.severity) == (f"{column}_shifted", "warning")
    assert finding.message == (
        f"the {column} is logged {count} {'late' if samples > 0 else 'early'} against {other} and voltage;"
        f" shift the column, and the voltage fits kp = {kp} V/m, kd = {kd} V s/m."
    )


@pytest.mark.parametrize("step", [1e-4, 1e-3])
def test_shift_is_seen_through_the_rounding_of_the_voltage(step):
    record = staircase(60, 2)
    rounded = record.with_({"voltage": np.round(record.voltage / step) * step})
    assert codes(rounded) == []
    assert codes(logged_late(rounded, "position", 3)) == ["position_shifted"]
    assert codes(logged_late(rounded, "reference", 5)) == ["reference_shifted"]


def test_shift_of_the_first_step_alone_is_seen():
    record = lab.step_record(lab.NLM2, 60, 3, noise=1e-5, seed=2)
    late = np.where(np.arange(len(record)) < 5, 0.0, record.reference)
    (finding,) = [f for f in check(record.with_({"reference": late})) if f.code == "reference_shifted"]
    assert "logged 5 samples late" in finding.message


def test_shift_after_a_rest_is_said_once_and_in_samples():
    late = logged_late(staircase(150, 2, setup=lab.Setup(rest=0.1)), "reference", 15)
    found = [finding for finding in check(late) if finding.code == "reference_shifted"]
    assert len(found) == 1
    assert "15 samples late" in found[0].message


@pytest.mark.parametrize("column", ["position", "reference", "voltage"])
def test_shift_is_found_in_a_long_record(column):
    levels = tuple(0.1 * (-1.0) ** k for k in range(50))
    record = staircase(reference=levels, setup=lab.Setup(controller=Controller(kp=60, kd=3, derivative_filter=0.3)))
    assert len(record) > 25_000
    assert codes(record) == []
    assert codes(logged_late(record, column, 3)) == [f"{column}_shifted"]


def test_shift_and_wrong_gains_are_both_said():
    late = logged_late(staircase(100, 4), "position", 3)
    assert codes(late.with_({"controller": Controller(kp=120, kd=4)})) == ["position_shifted", "gains_contradict_log"]
    assert codes(late.with_({"controller": None})) == ["position_shifted", "gains_unknown"]


@pytest.mark.parametrize(
    "stated",
    [
        {"kp": 72.0},
        {"kp": 61.0},
        {"kd": 0.0},
        {"kd": 4.18},  # 3 kp h more, what a shift by 3 samples looks like
        {"kd": 3.82},
        {"derivative_filter": 0.3},
        {"derivative_window": 3},
        {"derivative_on": "error"},
    ],
    ids=str,
)
def test_wrong_settings_are_not_taken_for_a_shift(stated):
    record = staircase(60, 4)
    wrong = record.with_({"controller": replace(record.controller, **stated)})
    assert not [code for code in codes(wrong) if code.endswith("shifted")]


@pytest.mark.parametrize("lag", [0.5, 2.0, 5.0])
def test_lagging_voltage_is_not_taken_for_a_shift(lag):
    record = staircase(60, 4)
    share, voltage = 1.0 - math.exp(-1.0 / lag), record.voltage.copy()
    for k in range(1, voltage.size):
        voltage[k] = voltage[k - 1] + share * (record.voltage[k] - voltage[k - 1])
    assert not [code for code in codes(record.with_({"voltage": voltage})) if code.endswith("shifted")]


SETTINGS = [
    ({"derivative_filter": 0.3}, {}, "derivative_filter = 0.3, not 1 "),
    ({}, {"derivative_filter": 0.3}, "derivative_filter = 1, not 0.3 "),
    ({"derivative_window": 2}, {}, "derivative_window = 2, not 1 "),
    ({}, {"derivative_window": 2}, "derivative_window = 1, not 2 "),
    ({"derivative_on": "error"}, {}, "derivative_on = error, not measurement "),
    ({"derivative": "velocity"}, {}, "derivative = velocity, not position "),
    ({"control_period": 0.003}, {}, "control_period = 0.003 s, not every sample "),
    ({}, {"control_period": 0.003}, "control_period = every sample, not 0.003 "),
]


@pytest.mark.parametrize(("true", "stated", "said"), SETTINGS, ids=str)
@pytest.mark.parametrize("rounding", [0.0, 1e-3])
def test_setting_that_the_log_fits_is_named(true, stated, said, rounding):
    record = staircase(setup=lab.Setup(controller=Controller(kp=60, kd=4, **true)))
    if rounding:
        record = record.with_({"voltage": np.round(record.voltage / rounding) * rounding})
    assert not {"settings_contradict_log", "gains_contradict_log"} & set(codes(record))
    finding = only(record.with_({"controller": Controller(kp=60, kd=4, **stated)}))
    assert (finding.code, finding.severity) == ("settings_contradict_log", "warning")
    assert finding.message.startswith(f"the log fits {said}(unexplained voltage ")
    before, left = (float(x) for x in re.findall(r"([\d.e+-]+) V", finding.message))
    assert left < 0.1 * before
    assert left < 1.1 * rounding / math.sqrt(12) + 1e-6


@pytest.mark.parametrize("colour", [0.0, 0.9, 0.99])
def test_setting_is_named_whatever_noise_the_sensor_has(colour):
    record = in_noise(colour, kd=3.0, share=0.3)
    finding = only(record.with_({"controller": Controller(kp=60, kd=3.0)}))
    assert finding.message.startswith("the log fits derivative_filter = 0.3, not 1 ")


def test_setting_and_gains_that_are_both_wrong_are_both_said():
    record = staircase(setup=lab.Setup(controller=Controller(kp=60, kd=4, derivative_filter=0.3, derivative_window=2)))
    setting, gains = check(record.with_({"controller": Controller(kp=66, kd=4)}))
    assert setting.message.startswith("the log fits derivative_window = 2, derivative_filter = 0.3, not 1, 1 ")
    assert gains.message.startswith("the logged voltage fits kp = 60 V/m, kd = 4 V s/m, not kp = 66 V/m, kd = 4 V s/m;")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("constant", "integral"), [(0.3, 0.0), (0.0, 30.0)], ids=["constant", "integral"])
def test_what_is_added_to_the_law_is_said_with_its_size(constant, integral, known):
    record = staircase(60, 4)
    added = constant + integral * np.cumsum(record.reference - record.position) * record.sample_time
    other = record.with_({"voltage": record.voltage + added, **({} if known else {"controller": None})})
    found = {finding.code: finding.message for finding in check(other)}
    if integral:
        assert found.pop("settings_contradict_log").startswith("the log fits ki = 30 V/(m s), not 0 ")
    else:
        assert found.pop("added_to_law").startswith("the log fits with a constant 0.3 V added to the control law ")
    assert list(found) == ([] if known else ["gains_unknown"])


def test_noise_in_the_logged_voltage_is_no_other_setting():
    record = staircase(60, 4)
    rng = np.random.default_rng(5)
    for colour in (0.0, 0.9):
        noise = 0.02 * math.sqrt(1 - colour**2) * lfilter([1.0], [1.0, -colour], rng.standard_normal(len(record)))
        assert codes(record.with_({"voltage": record.voltage + noise})) == []


# ---- limits


@pytest.mark.parametrize(
    ("low", "high", "said", "cure"),
    [
        (-4.0, 4.0, "-4 and 4 V", "state voltage_limit = 4 V, or log"),
        (-2.0, 5.0, "-2 and 5 V", "no more; log what the controller asks for."),
        (-9.0, 3.0, "3 V", "state voltage_limit = 3 V, or log"),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    "stated", [Controller(kp=60, kd=4), Controller(kp=70, kd=4), None], ids=["right", "wrong", "none"]
)
def test_plateau_of_the_voltage_is_a_limit(low, high, said, cure, noise, stated):
    record = staircase(60, 4)
    voltage = np.clip(record.voltage, low, high) + noise * np.random.default_rng(1).standard_normal(len(record))
    found = {f.code: f.message for f in check(record.with_({"voltage": voltage, "controller": stated}))}
    said_now, wanted = (re.findall(r"-?[\d.]+ (?:and|V)", text) for text in (found["clipped_voltage"], said))
    for shown, true in zip(said_now, wanted, strict=False):
        assert float(shown.split()[0]) == pytest.approx(float(true.split()[0]), abs=1e-6 + noise)
    assert noise or cure in found["clipped_voltage"]
    gains = {None: "gains_unknown", 70: "gains_contradict_log"}.get(stated and stated.kp)
    assert set(found) == {"clipped_voltage", *([gains] if gains else [])}


def test_plateau_below_the_largest_value_is_a_limit():
    record = staircase(60, 4)
    voltage = np.clip(record.voltage, -3.0, 3.0)
    voltage[[0, 601, 1201]] *= 1.2  # an amplifier overshoots
    finding = only(record.with_({"voltage": voltage}))
    assert finding.code == "clipped_voltage"
    assert "stays at -3 and 3 V" in finding.message


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(("kp", "kd"), [(60, 0), (100, 1), (100, 4)])
def test_stated_limit_is_believed(kp, kd, noise):
    record = staircase(kp, kd, setup=lab.Setup(voltage_limit=4.0))
    given = np.clip(record.voltage, -4.0, 4.0) + noise * np.random.default_rng(2).standard_normal(len(record))
    assert codes(record.with_({"voltage": given})) == []
    assert codes(record) == ["voltage_beyond_limit"]
    wrong = {"voltage": given, "controller": Controller(kp=1.2 * kp, kd=kd)}
    assert codes(record.with_(wrong)) == ["gains_contradict_log"]


def test_coarse_voltage_is_no_limit():
    record = staircase(60, 4)
    assert "clipped_voltage" not in codes(record.with_({"voltage": np.round(record.voltage, 1)}))


def test_slow_loop_is_judged_at_its_own_ticks():
    record = simulated(kp=30.0)
    ticks = np.maximum((np.arange(1500) - 2) // 5 * 5 + 2, 0)
    voltage = (30 * (record.reference - record.position))[ticks]
    slow = record.with_({"voltage": voltage, "controller": Controller(kp=30, control_period=0.005)})
    assert "gains_contradict_log" not in codes(slow)
    assert assess(slow).fitted_kp == pytest.approx(30, rel=1e-6)


def test_unknown_gains_are_offered():
    finding = only(simulated(kd=2.0).with_({"controller": None}))
    assert (finding.code, finding.severity) == ("gains_unknown", "note")
    assert finding.message == "the gains are not stated; the logged voltage fits kp = 60 V/m, kd = 2 V s/m."


def test_missing_signals_are_notes():
    record = simulated()
    assert [(f.code, f.severity) for f in check(record.with_({"reference": None}))] == [("no_reference", "note")]
    assert [(f.code, f.severity) for f in check(record.with_({"voltage": None}))] == [("voltage_reconstructed", "note")]


def test_remarks_of_the_reader_come_first(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("# kp = 60\n# colour = red\ntime,position,reference\n0,0,1\n1,0,1\n")
    assert codes(read_record(path))[0] == "unknown_setting"


@pytest.mark.parametrize("n", [2, 3, 4, 5, 9, 19, 21])
@pytest.mark.parametrize("scale", [0.0, 1e-300, 1.0, 1e15])
def test_short_and_odd_records_are_judged_without_complaint(n, scale):
    rng = np.random.default_rng(n)
    record = Record(
        time=np.cumsum(rng.uniform(0.1, 1, size=n)),
        position=scale * rng.normal(size=n),
        reference=scale * rng.normal(size=n),
        voltage=scale * rng.normal(size=n),
        controller=Controller(kp=scale, kd=1.0, derivative_window=7, derivative_filter=0.1),
    )
    json.dumps(assess(record).to_json(), allow_nan=False)


def test_voltage_that_is_nothing_but_limits_has_no_gains():
    position = np.concatenate((np.linspace(0, 1, 15), np.linspace(1, 0, 15)))
    voltage = np.repeat([5.0, -5.0], 15)
    record = Record(time=np.arange(30.0), position=position, voltage=voltage, reference=np.ones(30))
    assert assess(record).fitted_kp is None


# ---- measured data


@needs_data
@pytest.mark.parametrize(
    ("file", "kp", "kd"), [("K1_7", 7, 0), ("K1_8", 8, 0), ("K1_9", 9, 0), ("k1k3_7", 7, 0.271), ("k1k3_9", 9, 0.377)]
)
def test_rotary_arm_gains_are_verified_in_spite_of_ringing(file, kp, kd):
    columns = {"time": "t_ms", "position": "theta_rad", "velocity": "thetadot_rad_s", "reference": "ref_rad"}
    record = read_record(
        DATA / "cu_rotary_arm" / f"bh2017_rigidarm_{file}.csv",
        columns={**columns, "voltage": "voltage_V"},
        units={"time": "ms", "position": "rad"},
        settings={"kp": kp, "kd": kd, "derivative": "velocity"},
    )
    assert codes(record) == []
    quality = assess(record)
    assert quality.fitted_kp == pytest.approx(kp, rel=0.005)
    assert quality.fitted_kd == pytest.approx(kd, abs=0.01)
    assert quality.quantisation_step == pytest.approx(1e-3, rel=0.01)


EMPS = {"position": "qm", "reference": "qg", "voltage": "vir"}


@needs_data
@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"kp": 38996, "kd": 243.45, "derivative_window": 2}, []),
        ({"kp": 37000, "kd": 243.45, "derivative_window": 2}, ["gains_contradict_log"]),
    ],
    ids=["stated", "wrong"],
)
def test_ball_screw_gains_are_verified(settings, expected):
    record = read_record(DATA / "emps" / "DATA_EMPS.mat", columns=EMPS, settings=settings)
    assert codes(record) == expected
    quality = assess(record)
    assert quality.fitted_kp == pytest.approx(38996, rel=0.002)
    assert quality.fitted_kd == pytest.approx(243.45, rel=0.002)


@needs_data
def test_ball_screw_pulses_are_missed_where_they_are_not_given():
    settings = {"kp": 38996, "kd": 243.45, "derivative_window": 2}
    path = DATA / "emps" / "DATA_EMPS_PULSES.mat"
    assert codes(read_record(path, columns=EMPS, settings=settings)) == ["law_contradicts_log"]
    with_pulses = read_record(path, columns={**EMPS, "feedforward": "pulses_N"}, settings=settings)
    assert assess(with_pulses).law_misfit < 0.01


def test_onset_that_was_cut_off_is_said():
    finding = only(cut(simulated(noise=1e-6), slice(60, None)))
    assert finding.code == "onset_missed"
    assert "the axis already moves at the first sample, at 0.5" in finding.message


@pytest.mark.parametrize("late", [10, 40])
def test_reference_that_is_logged_late_is_said(late):
    record = simulated(edge=100, noise=1e-6, kp=150.0)
    shifted = np.where(np.arange(len(record)) < 100 + late, 0.0, 0.1)
    assert "reference_shifted" in codes(record.with_({"reference": shifted}))
    assert codes(record) == []


@pytest.mark.parametrize("share", [1.4, 1.6, 1.8])
def test_creep_before_the_step_is_no_shift(share):
    """In the first half of the rest it stays within the noise; at its end it is beyond, as a shifted reference is."""
    record = simulated(edge=100, noise=1e-5, encoder=0.0)
    creep = share * measure(record).outstanding * np.minimum(np.arange(len(record)) / 100.0, 1.0)
    creeping = record.with_({"position": record.position + creep})
    assert [*beginning_findings(creeping, measure(creeping))] == []
    late = record.with_({"reference": np.where(np.arange(len(record)) < 110, 0.0, 0.1)})
    assert [found.code for found in beginning_findings(late, measure(late))] == ["reference_shifted"]


def test_axis_exactly_at_rest_before_its_step_has_no_shift():
    time = np.arange(1200) * 1e-3
    position = 0.1 * (1.0 - np.exp(-np.maximum(time - 0.1, 0.0) / 0.05))
    record = Record(time=time, position=position, reference=np.where(time < 0.1, 0.0, 0.1),
                    voltage=np.where(time < 0.1, 0.0, 1.0))  # fmt: skip
    assert "reference_shifted" not in codes(record)
    early = record.with_({"reference": np.where(time < 0.14, 0.0, 0.1)})
    assert "reference_shifted" in codes(early)


@pytest.mark.parametrize("delay", [0, 12])
@pytest.mark.parametrize("edge", [0, 100])
def test_onset_within_the_record_is_not_missed(edge, delay):
    for kp in (20.0, 60.0, 150.0):
        assert codes(simulated(edge=edge, delay=delay, kp=kp, noise=1e-6)) == []


@pytest.mark.parametrize("ratio", [1e-3, 1e-2, math.pi / 180.0])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_axis_that_is_still_on_its_way_is_in_no_other_unit(ratio, power):
    for samples in (105, 600, 1009):
        time = np.arange(samples) * 1e-3
        going = Record(time=time, position=0.1 * ratio * (time / time[-1]) ** power, reference=0.1 + 0.0 * time,
                       controller=Controller(kp=60.0))  # fmt: skip
        assert "units_contradict" not in codes(going)


def test_first_step_at_once_hides_no_other_unit():
    time = np.arange(600) * 1e-3
    reference = np.where(time < 5e-4, 0.1, 0.2)
    position = 100.0 + 100.0 * (1.0 - np.exp(-30.0 * time))
    record = Record(time=time, position=position, reference=reference, controller=Controller(kp=60.0))
    assert "units_contradict" in codes(record)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000.0, "as mm for m"), (180.0 / math.pi, "in degrees where"), (0.01, "as m for cm")]
)
def test_position_in_another_unit_than_its_reference_is_said(factor, unit):
    record = simulated(noise=1e-6, kp=150.0)
    other = record.with_({"position": factor * record.position})
    for log in (other, other.with_({"voltage": None})):
        found = [f for f in check(log) if f.code == "units_contradict"]
        assert [f.severity for f in found] == ["error"]
        assert unit in found[0].message
        assert fatal(check(log)) == tuple(found)


def test_voltage_in_another_unit_is_not_blamed_on_the_gains():
    record = simulated(noise=1e-6)
    finding = only(record.with_({"voltage": 1e3 * record.voltage}))
    assert (finding.code, finding.severity) == ("units_contradict", "error")
    assert "10^3 times" in finding.message


@pytest.mark.parametrize("noise", [4e-6, 8e-6, 2e-5], ids="{:g}".format)
@pytest.mark.parametrize("moving", [True, False], ids=["moving", "at rest"])
def test_noise_of_a_coarse_encoder_is_that_of_sensor_and_rounding(noise, moving):
    step, count = 1e-5, 4000
    time = 1e-3 * np.arange(count)
    smooth = 3e-6 + moving * 0.1 * (1 - np.exp(-3 * time) * np.cos(8 * time))
    seen = np.random.default_rng(1).normal(smooth, noise)
    # the median of 4000 neighbouring third differences has a standard error of 3 %; steps leave a few per cent more
    assert white_noise(step * np.round(seen / step), step) == pytest.approx(math.hypot(noise, step / 12**0.5), rel=0.12)


def test_rounding_is_told_as_noise_where_the_axis_rests():
    record = lab.step_record(lab.NLM1, 60, encoder=1e-4)
    quality = assess(record)
    told = check_summary([quality], length_unit="m").tables[0]
    noise = dict(zip(told.columns, told.rows[0], strict=True))["Fast noise or rounding [µm]"]
    assert float(noise) >= 28  # 0.1 mm / √12


@pytest.mark.parametrize(
    ("stated", "tells"),
    [
        (
            60 * 180 / math.pi,
            "position and reference seem to be in degrees: state their unit, or correct the stated gains.",
        ),
        (60 * math.pi / 180, "the stated gains seem to be per degree: correct the stated gains."),
        (66.0, "correct the stated gains."),
    ],
)
def test_degrees_in_place_of_radians_are_said_to_be_so(stated, tells):
    record = simulated(kp=60.0, kd=0.0)
    turned = replace(record, length_unit="rad")
    finding = only(turned.with_({"controller": Controller(kp=stated)}))
    assert finding.code == "gains_contradict_log"
    assert finding.message.endswith(f"; {tells}")


def test_reference_that_changes_in_a_gap_is_said():
    record = lab.step_record(lab.NLM2, 60, reference=(0.0, 0.1), noise=1e-5, seed=4)
    edge = int(record.edges()[0])
    torn = cut(record, np.delete(np.arange(len(record)), [edge, 200]))
    (finding,) = [finding for finding in check(torn) if finding.code == "gaps"]
    assert finding.message.startswith("2 samples are lost in 2 places, ")
    assert finding.message.endswith(
        f"The reference changes in the gap before {record.time[edge + 1]:g} s, and when is not known: leave out the"
        " step that begins there."
    )
    (finding,) = [f for f in check(cut(record, np.delete(np.arange(len(record)), [200]))) if f.code == "gaps"]
    assert finding.message == "1 sample is lost in one place, the first before 0.201 s; log without gaps, or cut there."
