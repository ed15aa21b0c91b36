"""Several gains at once: margins are python-control's, optima are no worse than a dense scan, and all are feasible."""

from __future__ import annotations

import json
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from click.testing import CliRunner

from servolens import GainWishes, PDSpec, Plant, tune_gains
from servolens.cli import group
from servolens.design import evaluate
from servolens.design.margins import loop_margins
from servolens.effects import Backlash, CoulombFriction, Delay, SensorLag, VelocityDecayDamping
from servolens.errors import InputError
from servolens.model import Model
from servolens.model_evidence import DataRange, Evidence, Remainder
from servolens.results import write_json

LINEAR = Plant(gain=1.8, damping=6.0)
PAPER = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
STICKY = LINEAR.with_effect(CoulombFriction(level=0.3))
SPEC = PDSpec(kp=60.0, settling_time=0.5, sample_time=2e-3)


def textbook_loop(gain, damping, spec, kd, late=0):
    """Return controller and loop of a linear plant behind a delay of whole samples, by python-control."""
    h, share = spec.sample_time, spec.derivative_filter
    plant = ct.c2d(ct.tf([gain], [1.0, damping, 0.0]), h) * ct.tf([1.0], [1.0] + [0.0] * late, h)
    slope = ct.tf([share, -share], [h, -h * (1.0 - share)], h)
    controller = spec.kp + kd * slope
    return controller, controller * plant


@pytest.mark.parametrize(("late", "share"), [(0, 1.0), (5, 1.0), (0, 0.3)], ids=["plain", "late", "filtered"])
def test_margins_of_a_linear_loop_are_those_of_python_control(late, share):
    spec, kd = replace(SPEC, derivative_filter=share), 5.0
    plant = LINEAR.with_effect(Delay(time=late * spec.sample_time)) if late else LINEAR
    found = loop_margins([plant], spec, kd)
    controller, loop = textbook_loop(1.8, 6.0, spec, kd, late)
    omega = np.geomspace(0.5, 0.999 * np.pi / spec.sample_time, 4000)
    response = loop(np.exp(1j * omega * spec.sample_time))
    sensitivity = 1.0 / (1.0 + response)
    assert found.peak_sensitivity == pytest.approx(np.abs(sensitivity).max(), rel=1e-3)
    assert found.peak_complementary == pytest.approx(np.abs(1.0 - sensitivity).max(), rel=1e-3)
    crossing = int(np.argmin(np.abs(np.log(np.abs(response)))))
    assert found.delay_margin == pytest.approx((np.pi + np.angle(response[crossing])) / omega[crossing], rel=5e-3)
    made = ct.ss(ct.minreal(controller * ct.feedback(1, loop), verbose=False))
    assert found.noise_gain == pytest.approx(ct.norm(made, 2), rel=5e-3)


def test_margins_are_those_of_the_worst_speed_and_plant():
    """The law α1 exp(−α2 |v|) v has the slope α1 (1 − α2 v) exp(−α2 v), which at speed takes from the damping."""
    fast = 2.0 * SPEC.reference / SPEC.settling_time
    slopes = [15.2528 * (1.0 - 5.9934 * v) * np.exp(-5.9934 * v) for v in (0.0, fast)]
    still, moving = (loop_margins([Plant(gain=1.91, damping=3.799 + slope)], SPEC, 2.0) for slope in slopes)
    found = loop_margins([PAPER], SPEC, 2.0)
    assert moving.peak_sensitivity > 1.1 * still.peak_sensitivity
    assert found.peak_sensitivity == pytest.approx(moving.peak_sensitivity, rel=1e-9)
    assert found.delay_margin == pytest.approx(min(still.delay_margin, moving.delay_margin), rel=1e-9)
    both = loop_margins([LINEAR, PAPER], SPEC, 2.0)
    assert both.peak_sensitivity == pytest.approx(found.peak_sensitivity, rel=1e-3)


def test_the_margins_of_an_axis_with_play_are_those_of_its_closed_gap():
    loose = LINEAR.with_effect(Backlash(gap=1e-3, load_share=0.3))
    assert loop_margins([loose], SPEC, 5.0) == loop_margins([LINEAR], SPEC, 5.0)


def scanned(plants, spec, limit, gains, objective):
    """Return the least objective over a dense scan of exact simulations."""
    best = np.inf
    for kp in gains["kp"]:
        for kd in gains["kd"]:
            one = replace(spec, kp=float(kp))
            margins = loop_margins(plants, one, float(kd))
            value = {"noise": margins.noise_gain, "kd": float(kd), "margin": margins.peak_sensitivity}[objective]
            if (
                value < best
                and margins.peak_sensitivity <= limit
                and all(evaluate(p, one, float(kd)).meets for p in plants)
            ):
                best = value
    return best


@pytest.mark.parametrize(
    ("plants", "objective"),
    [
        ([PAPER], "noise"),
        ([STICKY], "kd"),
        pytest.param([PAPER], "margin", marks=pytest.mark.slow),
        pytest.param([LINEAR, STICKY], "noise", marks=pytest.mark.slow),
    ],
    ids=["paper", "sticky", "margin", "both"],
)
def test_no_pair_of_a_dense_scan_is_better(plants, objective):
    found = tune_gains(plants, SPEC, GainWishes(free=("kp", "kd"), objective=objective, peak_sensitivity=1.4))
    assert found.from_program
    assert all(evaluate(plant, found.spec, found.kd).meets for plant in plants)
    assert found.margins.peak_sensitivity <= 1.4
    around = {"kp": found.spec.kp * np.linspace(0.6, 1.5, 16), "kd": found.kd * np.linspace(0.5, 1.5, 21)}
    assert found.value <= 1.005 * scanned(plants, SPEC, 1.4, around, objective)


def test_the_settling_time_is_shorter_than_that_of_any_pair_of_a_scan():
    found = tune_gains(PAPER, SPEC, GainWishes(objective="settling_time", peak_sensitivity=1.4))
    pairs = [(kp, kd) for kp in np.linspace(20.0, 150.0, 20) for kd in np.linspace(0.5, 14.0, 28)]
    times = [
        run.settling_time
        for kp, kd in pairs
        if (run := evaluate(PAPER, replace(SPEC, kp=float(kp)), float(kd))).meets
        and loop_margins([PAPER], replace(SPEC, kp=float(kp)), float(kd)).peak_sensitivity <= 1.4
    ]
    assert found.verified[0].settling_time == found.value
    assert found.value <= 1.03 * min(times)


@pytest.mark.slow
def test_limits_are_kept_and_cost_something():
    loop = PAPER.with_effect(SensorLag(time_constant=3e-3))
    free = tune_gains(loop, SPEC, GainWishes(objective="settling_time"))
    wishes = GainWishes(objective="settling_time", delay_margin=0.06, voltage_noise=0.02, position_noise=1e-5)
    held = tune_gains(loop, SPEC, wishes)
    assert free.margins.delay_margin < 0.06
    assert held.margins.delay_margin >= 0.06
    assert held.voltage_noise <= 0.02
    assert held.value > free.value


def test_the_filter_is_a_gain_too():
    wishes = GainWishes(free=("kp", "kd", "derivative_filter"), objective="noise")
    found = tune_gains(PAPER, SPEC, wishes)
    fixed = tune_gains(PAPER, SPEC, replace(wishes, free=("kp", "kd")))
    assert 0.1 <= found.spec.derivative_filter < 0.5
    assert found.value < 0.5 * fixed.value
    assert fixed.spec.derivative_filter == 1.0


def test_what_cannot_be_met_is_said():
    found = tune_gains(PAPER, replace(SPEC, settling_time=0.02), GainWishes())
    assert found.kd is None
    assert found.gains == {"kp": None, "kd": None, "derivative_filter": None}
    assert "no gains were found that meet everything, with kp from 12 to 150 and kd from 0" in found.reason


def test_the_noise_is_that_of_the_records_where_the_model_knows_it():
    left = Remainder(
        rms=3e-5, times_noise=2.0, of_travel=1e-4, acceleration_rms=0.0, correlation_time=0.1, of_motor=0.0,
        depends_on_inputs=False, material=False,
    )  # fmt: skip
    evidence = Evidence(range=DataRange(voltage=10.0, speed=1.0, step=0.1), remainder=left)
    found = tune_gains(Model(plant=LINEAR, evidence=evidence), SPEC, GainWishes())
    assert found.voltage_noise == pytest.approx(found.margins.noise_gain * 3e-5 / np.sqrt(3.0))


@pytest.mark.parametrize(
    ("wishes", "says"),
    [
        ({"free": ("kp",)}, "free gains are kd and perhaps kp"),
        ({"free": ("kd", "ki")}, "got kd, ki"),
        ({"objective": "speed"}, "objective must be one of"),
        ({"peak_sensitivity": 1.0}, "peak_sensitivity must be finite and larger than 1, got 1.0"),
        ({"voltage_noise": 0.1}, "needs position_noise"),
    ],
    ids=["no kd", "unknown", "objective", "peak", "noise"],
)
def test_wishes_that_make_no_sense_are_refused(wishes, says):
    with pytest.raises(InputError, match=says):
        tune_gains(LINEAR, SPEC, GainWishes(**wishes))


def test_a_continuous_loop_has_neither_filter_nor_noise():
    ideal = replace(SPEC, control="continuous")
    with pytest.raises(InputError, match="no derivative filter and no finite noise"):
        tune_gains(LINEAR, ideal, GainWishes(objective="noise"))
    found = tune_gains(LINEAR, ideal, GainWishes(objective="kd"))
    assert evaluate(LINEAR, found.spec, found.kd).meets


def test_the_command_gives_the_gains(tmp_path):
    write_json(tmp_path / "model.json", "model", Model(plant=PAPER).to_json())
    call = ["design", str(tmp_path / "model.json"), "--kp", "60", "--settling-time", "0.5", "--sample-time", "0.002"]
    wishes = ["--free", "kp", "kd", "--objective", "noise", "--peak-sensitivity", "1.4", "--position-noise", "1e-5"]
    result = CliRunner().invoke(group, [*call, *wishes, "--json", str(tmp_path / "design.json")])
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "design.json").read_text())
    found = tune_gains(PAPER, SPEC, GainWishes(free=("kp", "kd"), objective="noise", peak_sensitivity=1.4))
    assert told["gains"] == pytest.approx(found.gains, rel=1e-6)
    assert told["kp"] == pytest.approx(found.spec.kp, rel=1e-6)
    assert told["several"]["margins"]["peak_sensitivity"] <= 1.4
    assert "the least noise of the command" in " ".join(result.output.split())
    refused = CliRunner().invoke(group, [*call, "--peak-sensitivity", "2"])
    assert refused.exit_code == 2
    assert "--peak-sensitivity is for free gains" in refused.output
    hopeless = CliRunner().invoke(group, ["design", *call[1:4], "--settling-time", "0.02", "--free", "kp", "kd"])
    assert hopeless.exit_code == 1
    assert "no gains were found" in " ".join(hopeless.output.split()).lower()
