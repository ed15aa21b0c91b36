"""Proofs of a design: enclosures hold what is simulated, and nothing that is wrong passes."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np
import pytest

from servolens.design import PDSpec, evaluate, tune
from servolens.design.certify import proven_gap
from servolens.design.enclosure import FEASIBLE_CELL, INFEASIBLE, LoopMaps, prove
from servolens.design.intervals import IntervalFunction
from servolens.effects import (
    ActuatorLag,
    AsymmetricDamping,
    Backlash,
    ConstantForce,
    CoulombFriction,
    Delay,
    Effect,
    Saturation,
    SensorLag,
    VelocityDecayDamping,
)
from servolens.errors import InputError
from servolens.plant import Plant

LINEAR = Plant(gain=1.7866, damping=4.5866)
PAPER = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
COARSE = PDSpec(kp=100.0, settling_time=0.5, sample_time=0.01, kd_max=20.0)


def test_interval_functions_hold_the_values_of_all_points_in_a_box() -> None:
    x = ca.SX.sym("x", 3)
    output = ca.vertcat(ca.exp(-x[0]) * x[1] + 3.0, x[2] ** 2 - x[0] / (x[1] + 5.0), -2.0 * x[1] * x[2])
    function, exact = IntervalFunction(x, output), ca.Function("f", [x], [output])
    rng = np.random.default_rng(1)
    centre, radius = rng.normal(size=(3, 40)), rng.uniform(0.0, 0.5, size=(3, 40))
    low, high = function(centre - radius, centre + radius)
    for _ in range(20):
        point = centre + radius * rng.uniform(-1.0, 1.0, size=(3, 40))
        values = np.array([np.array(exact(p)).ravel() for p in point.T]).T
        assert (low <= values).all()
        assert (values <= high).all()


def test_an_operation_that_is_not_smooth_is_refused() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(InputError, match="not smooth"):
        IntervalFunction(x, ca.fabs(x))


def test_a_linear_design_is_proven() -> None:
    found = tune(LINEAR, COARSE)
    proven = tune(LINEAR, COARSE, certify=True)
    assert found.certificate.kind == "sensitivity"
    assert proven.certificate.kind == "enclosure"
    assert proven.disagreement is None
    assert proven.intervals == found.intervals
    assert proven.certificate.gap <= 2.0 * found.certificate.gap


def test_a_design_of_a_weight_is_proven_from_where_its_loop_holds_it() -> None:
    """Begun at the reference, the ends of the intervals lie elsewhere by five gaps at least."""
    plant = LINEAR.with_effect(ConstantForce(acceleration=-0.1))
    proven = tune(plant, COARSE, certify=True)
    assert proven.disagreement is None
    assert proven.intervals == tune(plant, COARSE).intervals
    assert proven.certificate.gap <= 1.5e-3


def test_a_wrong_design_is_contradicted() -> None:
    found = tune(LINEAR, COARSE)
    (low, high) = found.intervals[0]
    for intervals in (((low - 1.0, high),), ((low + 1.0, high),), ()):
        _, disagreement = proven_gap((LINEAR,), replace(found, intervals=intervals), 2.0)
        assert disagreement is not None
        assert "contradicts the search at kd" in disagreement


@pytest.mark.parametrize("control", ["sampled", "continuous"])
@pytest.mark.parametrize(
    "plant",
    [
        PAPER,
        pytest.param(LINEAR.with_effect(SensorLag(time_constant=0.02)), marks=pytest.mark.slow),
        LINEAR.with_effect(ActuatorLag(time_constant=0.02)),
    ],
    ids=["damping law", "sensor lag", "actuator lag"],
)
def test_what_is_proven_of_a_cell_holds_for_its_gains(plant: Plant, control: Literal["sampled", "continuous"]) -> None:
    spec = PDSpec(kp=100.0, settling_time=0.5, sample_time=5e-3, control=control, overshoot=0.4)
    middles, rng = np.linspace(0.5, 15.0, 24), np.random.default_rng(2)
    verdicts = prove(LoopMaps(plant, spec), middles - 1e-3, middles + 1e-3)
    assert {INFEASIBLE, FEASIBLE_CELL} <= set(verdicts.tolist())
    assert (verdicts != 0).mean() > 0.6
    for kd, verdict in zip(middles, verdicts, strict=True):
        for inside in kd + 1e-3 * rng.uniform(-1.0, 1.0, 3):
            if verdict != 0:
                assert evaluate(plant, spec, float(inside)).meets == (verdict == FEASIBLE_CELL)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (CoulombFriction(level=0.1), "smooth plant"),
        (Backlash(gap=1e-4, load_share=0.3), "smooth plant"),
        (Delay(time=1e-3), "no delay"),
        (Saturation(limit=5.0), "not smooth"),
        (AsymmetricDamping(damping_difference=1.0), "damping that is continuous"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_plant_that_is_not_smooth_is_refused(effect: Effect, message: str) -> None:
    with pytest.raises(InputError, match=message):
        tune(LINEAR.with_effect(effect), COARSE, certify=True)


def test_what_is_proven_is_proven_by_ball_arithmetic_of_flint_too() -> None:
    """Of a linear axis the error at each sample is a polynomial in kd, which FLINT bounds over a whole cell."""
    flint = pytest.importorskip("flint")
    radius, middles = 1e-3, np.linspace(1.0, 15.0, 8)
    verdicts = prove(LoopMaps(LINEAR, COARSE), middles - radius, middles + radius)
    assert {INFEASIBLE, FEASIBLE_CELL} <= set(verdicts.tolist())
    for middle, verdict in zip(middles, verdicts, strict=True):
        with flint.ctx.workprec(400):  # polynomials of degree 500, whose terms cancel
            errors = _errors_by_flint(flint, float(middle), radius)
        late = errors[round(COARSE.settling_time / COARSE.sample_time) :]
        if verdict == FEASIBLE_CELL:
            assert all(bool(abs(error) <= COARSE.band) for error in late)
        if verdict == INFEASIBLE:
            assert any(bool(abs(error) > COARSE.band) for error in late)


def _errors_by_flint(flint, middle, radius):
    """Return balls that hold the errors, as shares of the step, for all kd within `radius` of `middle`."""
    kd, variable = flint.arb_poly([flint.arb(middle), 1]), flint.arb(0, radius)
    h, beta, c = (flint.arb(value) for value in (COARSE.sample_time, LINEAR.gain, LINEAR.damping))
    kept = (-c * h).exp()
    slowed = (1 - kept) / c
    position = before = speed = flint.arb_poly([0])
    errors = []
    for _ in range(round(10.0 * COARSE.settling_time / COARSE.sample_time) + 1):
        errors.append((1 - position)(variable))
        command = flint.arb(COARSE.kp) * (1 - position) - kd * ((position - before) * (1 / h))
        before = position
        position, speed = (
            position + speed * slowed + command * (beta * (h - slowed) / c),
            speed * kept + command * (beta * slowed),
        )
    return errors
