"""An axis that a weight or a spring pulls is held before a step. Truth: the loop at rest for long, and then stepped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens.controller import Controller
from servolens.design import PDSpec, evaluate
from servolens.design.plant_inverse import tracking
from servolens.design.rest import held_by, rest_of
from servolens.design.settle import closed_loop_gain, step_response
from servolens.effects import (
    ActuatorLag,
    Cogging,
    ConstantForce,
    CoulombFriction,
    DeadZone,
    Delay,
    Effect,
    EndStop,
    FlexibleCoupling,
    ForceLimit,
    HardeningSpring,
    PendulumGravity,
    PeriodicDisturbance,
    ReturnSpring,
    Saturation,
    SensorLag,
    SpeedServo,
)
from servolens.plant import Plant
from servolens.simulation import simulate_continuous, simulate_loop

WEIGHT, LATE = ConstantForce(acceleration=0.5), (Delay(time=0.0123), ActuatorLag(time_constant=0.006))
SPRING = ReturnSpring(stiffness=6.0)
DRIVE = SpeedServo(speed_per_volt=0.1, proportional=38.0, integral=0.0)
COUPLING = FlexibleCoupling(frequency=15.0, damping_ratio=0.05, load_ratio=0.3)
RESTED = 20.0
"""So long the loop has been at rest before the step of the truth [s]."""


def axis(*effects: Effect) -> Plant:
    return Plant(gain=1.9, damping=6.0, effects=effects)


def rested(plant: Plant, spec: PDSpec, gain: float, back: bool, samples: int) -> np.ndarray:
    """Return the positions of the step after a long rest."""
    begin, end = (spec.reference, 0.0) if back else (0.0, spec.reference)
    before = int(RESTED / spec.sample_time)
    reference = np.concatenate([np.full(before, begin), np.full(samples, end)])
    time = spec.sample_time * np.arange(reference.size)
    if spec.control == "continuous":
        run = simulate_continuous(plant, spec.kp, gain, time, reference, start=(begin, 0.0))
    else:
        limit = None if plant.effect("saturation") is not None else np.inf
        run = simulate_loop(plant, spec.loop(gain), time, reference, start=(begin, 0.0), limit=limit)
    return run.position[before:]


CASES = {
    "weight, late command": ((WEIGHT, *LATE), {}, False, 1e-9),
    "weight, late command, integral": ((WEIGHT, *LATE), {"ki": 100.0}, False, 1e-6),
    "weight, set-point weight, back": ((WEIGHT,), {"ki": 100.0, "setpoint_weight": 0.5}, True, 1e-6),
    "weight, clamped integral": (
        (WEIGHT, Saturation(limit=3.0)),
        {"ki": 100.0, "anti_windup": "clamping"},
        False,
        1e-6,
    ),
    "weight, cascade": ((WEIGHT,), {"controller": "cascade", "kp": 8.0}, True, 1e-9),
    "weight, cascade with integral": ((WEIGHT,), {"controller": "cascade", "kp": 8.0, "kiv": 20.0}, False, 1e-9),
    "weight, ideal loop": ((WEIGHT,), {"control": "continuous"}, False, 1e-9),
    "weight behind a drive": ((WEIGHT, DRIVE), {}, False, 1e-9),
    "weight on a coupling": ((WEIGHT, COUPLING), {}, False, 1e-9),
    "weight, slow sensor": ((WEIGHT, SensorLag(time_constant=0.02)), {}, False, 1e-9),
    "weight, friction that holds": ((WEIGHT, CoulombFriction(level=0.7)), {}, False, 1e-9),
    "weight, friction that slips": ((WEIGHT, CoulombFriction(level=0.3)), {}, False, 2e-3),
    "spring, back": ((SPRING,), {}, True, 1e-9),
    "spring, back, ideal loop": ((SPRING, LATE[1]), {"control": "continuous"}, True, 1e-9),
    "spring, back, dead zone": ((SPRING, DeadZone(width=0.25)), {}, True, 1e-9),
    "spring, back, integral": ((SPRING,), {"ki": 100.0}, True, 1e-9),
    "hardening spring, back": ((HardeningSpring(cubic_stiffness=5000.0),), {}, True, 1e-6),
    "gravity": ((PendulumGravity(amplitude=1.2, phase=0.4),), {}, False, 1e-6),
    "upright arm": ((PendulumGravity(amplitude=10.0, phase=np.pi - 0.3),), {}, False, 1e-6),
    "cogging": ((Cogging(amplitude=0.5, pitch=0.03, phase=2.5),), {}, False, 1e-6),
    "cogging of several rests": ((Cogging(amplitude=0.5, pitch=0.005, phase=2.5),), {}, False, 1e-6),
    "weight, stop within the error": ((WEIGHT, EndStop(low=-0.005, high=1.0)), {}, False, 1e-3),
    "spring, back, limit below what the reference takes": ((SPRING, Saturation(limit=0.25)), {"kp": 5.0}, True, 1e-6),
    "spring, dead zone, nothing pulls": ((SPRING, DeadZone(width=0.25)), {"ki": 100.0}, False, 1e-9),
    "set-point weight without an integral, back": ((), {"setpoint_weight": 0.6}, True, 1e-9),
    "weight, limited force": ((WEIGHT, ForceLimit(acceleration=9.0)), {}, False, 1e-9),
}


@pytest.mark.parametrize(("effects", "law", "back", "share"), CASES.values(), ids=CASES)
def test_a_step_begins_as_the_loop_rests(effects, law, back, share):
    """A share of the step may be missed: where a force bends, or friction stops an axis sooner than at its level."""
    spec = PDSpec(**{"kp": 20.0, "settling_time": 0.5, "reference": 0.1, **law})
    plant, gain = axis(*effects), 5.0 if spec.controller == "cascade" else 2.0
    run = step_response(plant, spec, gain, 1.0, back=back)
    truth = rested(plant, spec, gain, back, run.time.size)
    assert np.abs(run.position - truth).max() <= share * spec.reference


def test_a_released_axis_is_another_one():
    spec = PDSpec(kp=20.0, settling_time=0.5, reference=0.1, ki=100.0)
    held, released = (step_response(axis(WEIGHT), spec, 2.0, 1.0, held=held).position for held in (True, False))
    assert np.abs(held - released).max() > 0.05 * spec.reference
    unpulled = (step_response(axis(*LATE), spec, 2.0, 1.0, held=held).position for held in (True, False))
    np.testing.assert_array_equal(*unpulled)


def test_settling_is_that_of_the_axis_at_rest():
    plant = axis(WEIGHT, Delay(time=0.04))
    spec = PDSpec(kp=20.0, settling_time=2.0, reference=0.1, ki=30.0)
    left = rested(plant, spec, 3.0, False, 20_000) - spec.reference
    settled = spec.sample_time * (1 + np.flatnonzero(np.abs(left) > spec.band * spec.reference)[-1])
    assert evaluate(plant, spec, 3.0).settling_time == pytest.approx(settled, abs=spec.sample_time)


def test_what_holds_an_axis():
    for loop in (Controller(kp=20.0), Controller(kp=20.0, ki=100.0)):
        assert held_by(axis(WEIGHT), loop, 0.3) == pytest.approx((0.5 / 1.9, 0.0))
        assert held_by(axis(SPRING), loop, 0.3) == pytest.approx((6.0 * 0.3 / 1.9, 6.0 / 1.9), rel=1e-8)
        behind = held_by(axis(SPRING, DeadZone(width=0.25)), loop, -0.3)
        assert behind == pytest.approx((-6.0 * 0.3 / 1.9 - 0.25, 6.0 / 1.9), rel=1e-6)
        assert held_by(axis(SPRING, DeadZone(width=0.25)), loop, 0.0) == (0.0, 0.0)
        assert held_by(axis(WEIGHT, CoulombFriction(level=0.2)), loop, 0.0) == pytest.approx((0.3 / 1.9, 0.0))
        assert held_by(axis(WEIGHT, CoulombFriction(level=0.6)), loop, 0.0) == (0.0, 0.0)
    backwards = held_by(replace(axis(SPRING), gain=-1.9), Controller(kp=20.0, ki=100.0), 0.3)
    assert backwards.voltage == pytest.approx(-6.0 * 0.3 / 1.9)


def test_what_nothing_holds_is_released():
    swinging = PeriodicDisturbance(amplitude=2.0, frequency=3.0, phase=1.0)
    for loop in (Controller(kp=20.0), Controller(kp=20.0, ki=100.0)):
        assert held_by(axis(swinging), loop, 0.0) == (0.0, 0.0)
        assert held_by(axis(WEIGHT, swinging), loop, 0.0) == pytest.approx((0.5 / 1.9, 0.0))
        assert held_by(axis(WEIGHT, Saturation(limit=0.2)), loop, 0.0) is None
        assert held_by(axis(WEIGHT, Saturation(limit=0.3)), loop, 0.0) == pytest.approx((0.5 / 1.9, 0.0))
        assert held_by(axis(WEIGHT, ForceLimit(acceleration=0.3)), loop, 0.0) is None
        assert held_by(axis(WEIGHT, replace(DRIVE, integral=280.0)), loop, 0.0) is None
    assert rest_of(axis(WEIGHT, Saturation(limit=0.2)), Controller(kp=20.0), 0.1) == (0.1, 0.0, 0.0)


def test_a_loop_without_gains_holds_nothing():
    assert rest_of(axis(SPRING), Controller(kp=0.0), 0.1) == (0.1, 0.0, 0.0)
    assert rest_of(axis(WEIGHT), Controller(kp=0.0), 0.1) == (0.1, 0.0, 0.0)


def test_a_weight_changes_neither_the_loop_s_gain_nor_what_feedforward_is_worth():
    spec, frequency = PDSpec(kp=20.0, settling_time=0.5, reference=0.1), np.geomspace(0.1, 50.0, 40)
    without, weighed = (closed_loop_gain(axis(*effects), spec, 2.0, frequency) for effects in ((), (WEIGHT,)))
    np.testing.assert_allclose(weighed, without, rtol=1e-6)
    free, pulled = (tracking(axis(*effects), spec, 2.0) for effects in ((), (WEIGHT,)))
    assert pulled.with_it == pytest.approx(free.with_it, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("law", [{}, {"ki": 100.0}])
def test_feedforward_against_what_swings_or_hides_in_a_dead_zone_is_worth_as_much(law):
    spec = PDSpec(kp=20.0, settling_time=0.5, reference=0.1, **law)
    swinging = PeriodicDisturbance(amplitude=2.0, frequency=3.0, phase=1.0)
    for effects in ((swinging,), (SPRING, DeadZone(width=0.25))):
        found = tracking(axis(*effects), spec, 2.0)
        assert found.with_it < 1e-4 < 0.1 * found.without
