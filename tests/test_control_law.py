"""The control law against its definition, written as a loop, against the laboratory and against a real drive."""

from __future__ import annotations

import numpy as np
import pytest

from servolens import lab
from servolens.control_law import controller_voltage, felt_rounding, noise_gain
from servolens.errors import InputError
from servolens.record import Controller, Record


def by_definition(record):
    """The law sample by sample, as the contract states it."""
    c, h = record.controller, 0.001
    ratio = 1 if c.control_period is None else round(c.control_period / h)
    y, r = record.position, record.reference
    d, asked, voltages = 0.0, 0.0, []
    for k in range(len(record)):
        if k % ratio == 0:
            before = max(k - c.derivative_window * ratio, 0)
            span = c.derivative_window * ratio * h
            raw = (y[k] - y[before]) / span
            if c.derivative_on == "error":
                raw -= (r[k] - r[before]) / span
            if c.derivative == "velocity":
                raw = record.velocity[k]
            d += c.derivative_filter * (raw - d)
            asked = c.kp * (r[k] - y[k]) - c.kd * d
        voltages.append(asked + (0.0 if record.feedforward is None else record.feedforward[k]))
    return np.array(voltages)


def wandering(controller, n=400, **signals):
    rng = np.random.default_rng(3)
    return Record(
        time=np.arange(n) * 1e-3,
        position=np.cumsum(rng.normal(size=n)) * 1e-4,
        reference=np.where(np.arange(n) < n // 2, 0.1, -0.1),
        velocity=rng.normal(size=n),
        controller=controller,
        **signals,
    )


@pytest.mark.parametrize(
    "controller",
    [
        Controller(kp=60),
        Controller(kp=60, kd=2.5),
        Controller(kp=60, kd=2.5, derivative_filter=0.3),
        Controller(kp=60, kd=2.5, derivative_window=2),
        Controller(kp=60, kd=2.5, derivative_window=7, derivative_filter=0.5, derivative_on="error"),
        Controller(kp=60, kd=2.5, derivative="velocity", derivative_filter=0.2),
        Controller(kp=60, kd=2.5, control_period=0.005),
        Controller(kp=60, kd=2.5, control_period=0.003, derivative_window=2, derivative_filter=0.4),
        Controller(kp=60, kd=2.5, derivative_window=1000),
    ],
    ids=["p", "pd", "filter", "window", "error", "velocity", "slow", "slow and filtered", "window longer than record"],
)
@pytest.mark.parametrize("feedforward", [None, np.linspace(0, 1, 400)], ids=["", "feedforward"])
def test_law_is_the_definition_sample_by_sample(controller, feedforward):
    record = wandering(controller, feedforward=feedforward)
    assert controller_voltage(record) == pytest.approx(by_definition(record), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_law_reproduces_the_laboratory_log(share):
    controller = Controller(kp=60, kd=3, derivative_filter=share)
    record = lab.step_record(lab.NLM1, noise=1e-5, seed=1, setup=lab.Setup(controller=controller))
    assert controller_voltage(record) == pytest.approx(record.voltage, abs=1e-9)


def test_constant_position_needs_no_derivative():
    record = Record(time=[0, 1, 2], position=[5, 5, 5], reference=[7, 7, 7], controller=Controller(kp=2, kd=9))
    assert controller_voltage(record).tolist() == [4, 4, 4]


def test_difference_over_lost_samples_takes_the_time_that_passed():
    time = np.array([0, 1, 2, 7, 8]) * 1e-3
    record = Record(time=time, position=2.0 * time, reference=0 * time, controller=Controller(kp=0, kd=1))
    assert controller_voltage(record)[1:] == pytest.approx(-2.0)


def test_slow_loop_keeps_its_ticks_over_lost_samples():
    full = wandering(Controller(kp=60, kd=0, control_period=0.005))
    keep = np.delete(np.arange(400), [102, 103])
    part = Record(
        time=full.time[keep], position=full.position[keep], reference=full.reference[keep], controller=full.controller
    )
    assert controller_voltage(part) == pytest.approx(controller_voltage(full)[keep], abs=1e-12)


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (
            Record(time=[0, 1], position=[0, 1], voltage=[0, 1], reference=[0, 1]),
            "record: the control law needs the gains; give kp and kd (on the command line --record-kp and --record-kd)",
        ),
        (
            Record(time=[0, 1], position=[0, 1], voltage=[0, 1], controller=Controller(kp=1)),
            "record: the control law needs the reference; log it",
        ),
        (
            Record(time=[0, 1], position=[0, 1], reference=[0, 1], controller=Controller(kp=1, derivative="velocity")),
            "record: the loop used a velocity of its own (derivative = velocity); log it",
        ),
        (
            Record(time=[0, 2], position=[0, 1], reference=[0, 1], controller=Controller(kp=1, control_period=3.0)),
            "record: control_period is 3 s and the sample time 2 s; the longer must be a whole multiple of the shorter",
        ),
        (
            Record(time=[0, 2], position=[0, 1], reference=[0, 1], controller=Controller(kp=1, control_period=0.75)),
            "record: control_period is 0.75 s and the sample time 2 s;"
            " the longer must be a whole multiple of the shorter, and at most 1000 times as long",
        ),
    ],
    ids=["gains", "reference", "velocity", "fraction", "faster than the log"],
)
def test_what_is_missing_is_named(record, sentence):
    with pytest.raises(InputError) as refusal:
        controller_voltage(record)
    assert str(refusal.value) == sentence


@pytest.mark.parametrize(
    "settings",
    [
        {"kd": 0.1},
        {"kd": 5.0, "derivative_filter": 0.2},
        {"kd": 0.5, "derivative_filter": 0.1, "derivative_window": 4},
        {"kd": 5.0, "control_period": 2e-3},
        {"kd": 1.0, "derivative_on": "error"},
        {"kd": 5.0, "derivative": "velocity"},
    ],
    ids=["small kd", "filter", "window", "slow loop", "of the error", "velocity signal"],
)
def test_what_the_law_makes_of_white_noise_and_of_rounding_is_what_its_simulation_makes(settings):
    """Of rounding it was taken to be another than of noise: a quarter less, or twice as much in a slow loop."""
    loop, count = Controller(kp=100.0, **settings), 100_000
    noise, still = np.random.default_rng(1).normal(size=count), np.zeros(count)
    velocity = still if "derivative" in settings else None
    record = Record(time=1e-3 * np.arange(count), position=noise, reference=still, velocity=velocity, controller=loop)
    found = float(controller_voltage(record).std())
    assert noise_gain(loop, record.sample_time) == pytest.approx(found, rel=0.02)
    assert felt_rounding(loop, 1e-5, record.sample_time) == pytest.approx(1e-5 / np.sqrt(12.0) * found, rel=0.02)
