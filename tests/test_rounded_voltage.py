"""A voltage that the log holds in steps: what the law of its loop says that it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import diagnose, lab
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
        rounded(lab.step_record(CART, kp, noise=2e-6, encoder=0.0, seed=int(kp)), 0.05) for kp in (40.0, 80.0, 120.0)
    ]
    found = diagnose(records[:2], heldout=records[2:])
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("explained", ["coulomb_friction"])
    assert "shaken_axis" not in {finding.code for finding in found.findings}
    level = found.causes[0].quantities["level"]
    assert abs(level.value - 0.3) < 3.0 * level.stderr
