"""A voltage that the log holds in steps: what the law of its loop says that it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import Controller, Record, diagnose, fit, identify, lab
from servolens.effects import ConstantForce
from servolens.rounded_voltage import with_exact_voltage

STEP = 0.01
CART = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})


def rounded(record, step=STEP):
    return replace(record, voltage=np.round(record.voltage / step) * step)


def logged(kp=60.0, kd=1.0, **settings):
    return lab.step_record(CART, kp, kd, noise=1e-5, seed=3, encoder=0.0, **settings)


def missed(record, other):
    return float(np.sqrt(np.mean((record.voltage - other.voltage) ** 2)))


def test_a_rounded_voltage_is_what_the_law_asks_for():
    record = logged()
    found = with_exact_voltage(rounded(record))
    assert missed(rounded(record), record) == pytest.approx(STEP / np.sqrt(12.0), rel=0.1)
    assert missed(found, record) < 1e-9


def test_a_law_of_positions_that_were_rounded_too_is_taken_within_half_a_step():
    record = logged()
    written = replace(rounded(record), position=np.round(record.position, 6))  # after the loop had used it
    found = with_exact_voltage(written)
    assert 0.0 < missed(found, record) < missed(written, record)
    assert np.max(np.abs(found.voltage - written.voltage)) <= 0.5 * STEP * (1.0 + 1e-9)


def test_a_limit_that_was_reached_stays():
    record = logged(kp=300.0, reference=0.1)
    clipped = replace(record, voltage=np.clip(record.voltage, -12.0, 12.0))
    found = with_exact_voltage(rounded(clipped))
    assert np.max(np.abs(found.voltage - clipped.voltage)) <= 0.5 * STEP * (1.0 + 1e-9)
    assert missed(found, clipped) < 0.5 * STEP / np.sqrt(12.0)


@pytest.mark.parametrize(
    "changed",
    [
        lambda record: replace(record, controller=replace(record.controller, kp=1.01 * record.controller.kp)),
        lambda record: replace(record, controller=None),
        lambda record: replace(record, voltage=None),
        lambda record: replace(record, voltage=record.voltage + 0.013),
    ],
    ids=["other gain", "no law", "no voltage", "something added"],
)
def test_what_the_law_does_not_tell_is_left_as_it_is_logged(changed):
    record = changed(rounded(logged()))
    assert with_exact_voltage(record) is record


def test_a_voltage_that_is_not_rounded_is_left_as_it_is():
    record = logged()
    assert with_exact_voltage(record) is record


def test_friction_behind_a_coarsely_logged_voltage_is_all_that_is_found():
    """The rounding drove simulations by other forces than the axis felt, which seemed to shake it."""
    records = [
        rounded(lab.step_record(CART, kp, noise=2e-6, encoder=0.0, seed=int(kp)), 0.1) for kp in (40.0, 80.0, 120.0)
    ]
    found = diagnose(records[:2], heldout=records[2:])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert "shaken_axis" not in {finding.code for finding in found.findings}
    level = found.causes[0].quantities["level"]
    assert abs(level.value - 0.3) < 3.0 * level.stderr


PWM = 12.0 / 255.0
"""Of a supply of 12 V, in whole counts."""


def driven_in_steps(kp, kd, seed, *, levels=(0.1, 0.03, 0.12), force=1.3):
    """An axis ÿ = 4 V − 12 ẏ − force under a PD whose command reaches the motor in whole counts, solved exactly."""
    h, gain, damping = 1e-3, 4.0, 12.0
    decay = np.exp(-damping * h)
    held = (1.0 - decay) / damping  # of the speed, per acceleration; of the position the integral of that
    reached = (h - held) / damping
    time = h * np.arange(1800)
    reference = np.repeat(levels, 600)
    noise = 2e-6 * np.random.default_rng(seed).standard_normal(time.size)
    position, voltage = np.zeros(time.size), np.zeros(time.size)
    y = v = last = 0.0
    for k in range(time.size):
        position[k] = y + noise[k]
        rate = (position[k] - last) / h if k else 0.0
        last = position[k]
        voltage[k] = PWM * np.round((kp * (reference[k] - position[k]) - kd * rate) / PWM)
        push = gain * voltage[k] - force
        y, v = y + held * v + reached * push, decay * v + held * push
    law = Controller(kp=kp, kd=kd)
    return Record(time=time, position=position, voltage=voltage, reference=reference, controller=law)


def test_a_command_that_reached_the_motor_in_steps_is_taken_as_logged():
    """The law's own command, within the half step, drove simulations by other forces than the motor gave."""
    records = [driven_in_steps(80.0, 1.0, seed=1), driven_in_steps(120.0, 2.0, seed=2)]
    assert all(with_exact_voltage(record) is not record for record in records)
    found = fit(ConstantForce, records)
    assert all(np.array_equal(one.voltage, record.voltage) for one, record in zip(found.records, records, strict=True))
    assert found.at_noise
    for name, value in (("gain", 4.0), ("damping", 12.0), ("constant_force.acceleration", 1.3)):
        quantity = found.quantities[name]
        assert abs(quantity.value - value) < 3.5 * quantity.stderr


def test_steps_that_reached_the_motor_are_no_further_cause():
    records = [driven_in_steps(80.0, 1.0, seed=1), driven_in_steps(120.0, 2.0, seed=2)]
    found = diagnose(records)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["constant_force"])
    assert "command_in_steps" in {finding.code for finding in found.findings}


def test_steps_of_a_text_that_seem_to_be_the_motors_are_told_apart_beside_the_causes():
    """A log in decimals is first read as if rounded for the text; the other reading is likelier beside the causes."""
    records = [driven_in_steps(80.0, 1.0, seed=3), driven_in_steps(120.0, 2.0, seed=4)]
    scale = 0.1 / PWM
    decimal = [
        replace(
            record,
            voltage=np.round(record.voltage / PWM) * 0.1,
            controller=Controller(kp=scale * record.controller.kp, kd=scale * record.controller.kd),
        )
        for record in records
    ]
    found = diagnose(decimal)
    assert [cause.effect for cause in found.causes] == ["constant_force"]
    gain = found.model.quantities["gain"]
    assert abs(gain.value - 4.0 / scale) < 3.5 * gain.stderr
    assert "command_in_steps" in {finding.code for finding in found.findings}


def test_identify_takes_the_voltage_that_moved_the_axis():
    in_steps = driven_in_steps(80.0, 1.0, seed=5, force=0.0)
    for_the_log = rounded(
        lab.step_record(lab.Truth(gain=4.0, damping=12.0), 80.0, 1.0, noise=2e-6, encoder=0.0, seed=5), PWM
    )
    assert np.array_equal(identify(in_steps, model="constant").records[0].voltage, in_steps.voltage)
    assert not np.array_equal(identify(for_the_log, model="constant").records[0].voltage, for_the_log.voltage)
