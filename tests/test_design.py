"""The least gain against the paper's models, SciPy, and properties that any design must have."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Literal

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from servolens.controller import Controller
from servolens.design import PDSpec, compare, evaluate, settling_time, tune
from servolens.design.cover import Cover
from servolens.design.program import Loop
from servolens.design.rest import held_by
from servolens.design.settle import step_response
from servolens.effects import (
    ActuatorLag,
    ConstantForce,
    CoulombFriction,
    Delay,
    Effect,
    PendulumGravity,
    Saturation,
    SensorLag,
    VelocityDecayDamping,
)
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.report.figures_design import columns, draw_settling
from servolens.simulation import simulate_continuous, simulate_loop


def cart(gain: float, damping: float, *law: float) -> Plant:
    effects = (VelocityDecayDamping(alpha1=law[0], alpha2=law[1]),) if law else ()
    return Plant(gain=gain, damping=damping, effects=effects)


MODELS = {
    "Lm1": cart(1.8545, 6.1520),
    "Lm2": cart(1.7482, 5.4916),
    "Lm3": cart(1.7866, 4.5866),
    "NLm1": cart(1.9165, 5.9986, 17.3264, 13.1068),
    "NLm2": cart(1.9180, 5.6035, 22.1357, 18.2233),
    "NLm3": cart(1.9100, 3.7990, 15.2528, 5.9934),
}
FEASIBLE = {
    "Lm1": [(5.365, 11.542)],
    "Lm2": [(5.801, 11.958)],
    "Lm3": [(6.279, 12.443)],
    "NLm1": [(3.597, 4.598), (7.302, 9.694)],
    "NLm2": [(4.001, 4.917), (7.764, 9.988)],
    "NLm3": [(3.788, 4.775), (7.510, 9.869)],
}
SPEC = PDSpec(kp=100.0, settling_time=0.5, control="continuous")


@pytest.mark.parametrize("name", MODELS)
def test_feasible_gains_of_the_paper_s_models(name: str) -> None:
    design = tune(MODELS[name], SPEC)
    np.testing.assert_allclose(np.array(design.intervals), np.array(FEASIBLE[name]), atol=0.002)
    assert design.kd == design.intervals[0][0]
    assert design.verified[0].meets


@pytest.mark.parametrize(
    ("control", "effects"),
    [
        *product(["sampled", "continuous"], [(), (ActuatorLag(time_constant=0.03),), (SensorLag(time_constant=0.02),)]),
        ("sampled", (Delay(time=0.0123),)),
        ("sampled", (Delay(time=0.004), ActuatorLag(time_constant=0.01))),
        ("sampled", (Delay(time=0.0123), ConstantForce(acceleration=2.0), SensorLag(time_constant=0.02))),
        ("continuous", (ActuatorLag(time_constant=0.03), PendulumGravity(amplitude=2.0, phase=0.4))),
    ],
)
def test_the_nonlinear_program_steps_as_the_loop_does(
    control: Literal["sampled", "continuous"], effects: tuple[Effect, ...]
) -> None:
    plant = replace(cart(1.9, 6.0), effects=effects)
    spec, kd, samples = PDSpec(kp=80.0, settling_time=0.5, control=control), 4.0, 600
    late, due = divmod(plant.delay / spec.sample_time, 1.0)
    loop = Loop(plant.structure, control == "continuous", 4, (int(late), due > 0.0))
    given = [
        *plant.values,
        1e-3,
        *held_by(plant, spec.loop(0.0), 0.0),
        spec.kp,
        spec.reference,
        spec.sample_time,
        spec.derivative_filter,
        due,
        kd,
    ]
    states = np.array(loop.step.mapaccum(samples)(loop.beginning(ca.DM(given)), ca.repmat(ca.DM(given), 1, samples)))
    run = step_response(plant, spec, kd, samples * spec.sample_time)
    np.testing.assert_allclose(states[0], run.position[1 : samples + 1], atol=5e-7)


@pytest.mark.parametrize("control", ["sampled", "continuous"])
@pytest.mark.parametrize("name", ["Lm1", "NLm3"])
def test_the_nonlinear_program_agrees_with_the_search(name: str, control: Literal["sampled", "continuous"]) -> None:
    spec = PDSpec(kp=100.0, settling_time=0.5, control=control)
    design = tune(MODELS[name], spec, with_program=True)
    assert design.disagreement is None
    for candidate, (low, high) in zip(design.candidates, design.intervals, strict=True):
        assert candidate is not None
        assert low <= candidate <= high
        assert candidate - low <= design.certificate.gap
        assert evaluate(MODELS[name], spec, candidate).meets


def test_a_program_that_disagrees_is_said_and_its_infeasible_gain_is_not_printed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("servolens.design.program.local_optimum", lambda *_: 3.7)
    design = tune(MODELS["NLm3"], SPEC, with_program=True)
    assert design.candidates == (None, None)
    assert design.disagreement is not None
    assert "3.7 where the search found 3.78" in design.disagreement
    assert "disagrees" in str(design.to_json()["disagreement"])


def test_a_gain_for_all_three_nonlinear_models() -> None:
    design = tune([MODELS["NLm1"], MODELS["NLm2"], MODELS["NLm3"]], SPEC)
    np.testing.assert_allclose(np.array(design.intervals), [(4.001, 4.598), (7.764, 9.694)], atol=0.01)
    assert all(response.meets for response in design.verified)


def test_the_linear_gain_breaks_the_spec_on_the_nonlinear_cart() -> None:
    comparison = compare(MODELS["Lm3"], MODELS["NLm3"], SPEC)
    crossed = comparison.linear_on_nonlinear
    assert crossed is not None
    assert not crossed.meets
    assert crossed.settling_time == pytest.approx(0.547, abs=1e-3)
    assert evaluate(MODELS["NLm3"], SPEC, 7.35).settling_time == pytest.approx(0.5125, abs=1e-3)
    assert evaluate(MODELS["NLm3"], SPEC, 3.55).settling_time == pytest.approx(0.6125, abs=1e-3)
    assert comparison.nonlinear.verified[0].meets


@pytest.mark.parametrize("kd", [3.0, 3.9, 6.0, 8.0, 15.0])
def test_settling_time_agrees_with_scipy(kd: float) -> None:
    plant = MODELS["NLm2"]

    def motion(_: float, x: np.ndarray) -> list[float]:
        c = 5.6035 + 22.1357 * np.exp(-18.2233 * abs(x[1]))
        return [x[1], 1.9180 * (100.0 * (0.1 - x[0]) - kd * x[1]) - c * x[1]]

    time = np.arange(0.0, 3.0, 2e-5)
    run = solve_ivp(motion, (0.0, 3.0), [0.0, 0.0], t_eval=time, rtol=1e-10, atol=1e-13)
    outside = np.flatnonzero(np.abs(0.1 - run.y[0]) > 0.001)
    assert evaluate(plant, SPEC, kd).settling_time == pytest.approx(time[outside[-1] + 1], abs=2e-4)


def test_settling_time_of_a_known_signal() -> None:
    time = np.linspace(0.0, 5.0, 5001)
    assert settling_time(time, np.exp(-time), 0.01) is not None
    assert settling_time(time, np.exp(-time), 0.01) == pytest.approx(np.log(100.0), abs=1e-6)
    assert settling_time(time, np.ones(5001), 0.01) is None
    assert settling_time(time, np.zeros(5001), 0.01) == 0.0


def test_every_gain_inside_an_interval_is_feasible_and_none_outside() -> None:
    design = tune(MODELS["NLm3"], SPEC)
    rng = np.random.default_rng(5)
    for kd in rng.uniform(0.0, 20.0, 300):
        inside = any(low <= kd <= high for low, high in design.intervals)
        near = min(abs(kd - edge) for interval in design.intervals for edge in interval) < 1e-4
        assert near or evaluate(MODELS["NLm3"], SPEC, float(kd)).meets == inside


@settings(max_examples=12, deadline=None)
@given(slower=st.floats(0.4, 0.6), factor=st.floats(0.7, 1.0), wide=st.floats(0.01, 0.05))
def test_a_tighter_spec_never_gives_a_smaller_gain(slower: float, factor: float, wide: float) -> None:
    loose = tune(MODELS["Lm2"], PDSpec(kp=100.0, settling_time=slower, band=wide))
    tight = tune(MODELS["Lm2"], PDSpec(kp=100.0, settling_time=slower * factor, band=wide))
    if tight.kd is not None:
        assert loose.kd is not None
        assert tight.kd >= loose.kd - 1e-4


def test_more_models_never_give_a_smaller_gain() -> None:
    one = tune(MODELS["NLm1"], SPEC).kd
    both = tune([MODELS["NLm1"], MODELS["NLm3"]], SPEC).kd
    assert both >= one  # type: ignore[operator]  # both are feasible


def test_the_search_needs_few_simulations_and_says_what_it_searched() -> None:
    cover = Cover((MODELS["NLm3"],), replace(SPEC, kd_max=20.0))
    cover.intervals()
    assert cover.loops.count < 250
    stated, free = tune(MODELS["NLm3"], replace(SPEC, kd_max=20.0)).certificate, tune(MODELS["NLm3"], SPEC).certificate
    assert stated.searched == (0.0, 20.0)
    assert not stated.end_from_plant
    assert stated.gap <= 1e-3
    assert stated.horizon == 10.0 * SPEC.settling_time
    assert free.end_from_plant
    assert free.searched[1] > FEASIBLE["NLm3"][-1][1]


def test_designs_may_run_in_several_threads() -> None:
    from concurrent.futures import ThreadPoolExecutor

    alone = tune(MODELS["Lm1"], SPEC)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda _: tune(MODELS["Lm1"], SPEC), range(8)))
    assert all(design.intervals == alone.intervals for design in together)


def test_overshoot_limit_binds_and_holds() -> None:
    spec = PDSpec(kp=100.0, settling_time=0.9, overshoot=0.05)
    free, held = tune(MODELS["Lm1"], PDSpec(kp=100.0, settling_time=0.9)), tune(MODELS["Lm1"], spec)
    assert held.kd > free.kd  # type: ignore[operator]  # both are feasible
    assert held.verified[0].overshoot == pytest.approx(0.05, abs=1e-4)
    damping = (6.152 + 1.8545 * held.kd) / (2 * np.sqrt(1.8545 * 100.0))  # type: ignore[operator]
    assert np.exp(-np.pi * damping / np.sqrt(1 - damping**2)) == pytest.approx(0.05, abs=2e-3)


def test_voltage_beyond_the_limit_is_infeasible_with_a_reason() -> None:
    design = tune(MODELS["Lm1"], PDSpec(kp=100.0, settling_time=0.5, voltage_limit=8.0))
    assert not design.feasible
    assert design.intervals == ()
    assert design.reason is not None
    assert "asks for 10 V" in design.reason
    assert design.to_json()["kd"] is None


@pytest.mark.parametrize("gain", [1e-12, -1e-30, 5e-324])
def test_plant_that_does_not_answer_to_the_voltage_is_told_in_one_sentence(gain: float) -> None:
    spec = PDSpec(kp=100.0, settling_time=0.5)
    comparison = compare(MODELS["Lm1"], cart(gain, 6.0), spec)
    design = comparison.nonlinear
    assert design.reason == (
        f"the plant does not answer to the voltage: with a gain of {gain:.2g} m/s²/V and kp = 1e+02 it stays where"
        " it is, and no gain of a loop follows"
    )
    assert (design.feasible, design.certificate.searched) == (False, (0.0, 0.0))
    assert comparison.linear.kd is not None
    silent = compare(cart(gain, 6.0), cart(gain, 6.0), spec)
    assert draw_settling(columns(silent), Figure().add_subplot()) is None  # and warns of nothing


def test_short_settling_time_is_no_plant_that_does_not_answer() -> None:
    design = tune(MODELS["Lm1"], PDSpec(kp=100.0, settling_time=0.003))
    assert design.reason is not None
    assert "the settling time of 0.003 s cannot be met" in design.reason


def test_sticking_axis_that_stops_outside_the_band_is_infeasible() -> None:
    far = cart(1.9, 6.0).with_effect(CoulombFriction(level=5.0))
    late = evaluate(far, PDSpec(kp=10.0, settling_time=0.5), 20.0)
    assert late.settling_time is None
    assert not late.meets


def test_saturation_of_the_plant_is_part_of_the_design() -> None:
    limited = MODELS["Lm1"].with_effect(Saturation(limit=5.0))
    spec = PDSpec(kp=100.0, settling_time=0.6)
    assert tune(limited, spec).intervals != tune(MODELS["Lm1"], spec).intervals


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": -1.0}, "kp must be positive"),
        ({"kp": float("nan")}, "kp must be positive"),
        ({"band": 1.0}, "band must be between 0 and 1"),
        ({"reference": 0.0}, "reference must be finite and not 0"),
        ({"settling_time": 1e-3}, "less than three samples"),
        ({"control": "analogue"}, "control must be"),
        ({"derivative_filter": 0.0}, "derivative_filter must lie in"),
        ({"overshoot": -0.1}, "overshoot must not be negative"),
        ({"overshoot": 5.0}, r"overshoot is a fraction of the step, below 1; got 5.0 \(5 % is 0.05\)"),
        ({"voltage_limit": 0.0}, "voltage_limit must be positive"),
    ],
)
def test_wrong_specs_are_one_sentence(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PDSpec(**{"kp": 100.0, "settling_time": 0.5, **change})


def test_models_of_different_units_are_refused() -> None:
    radians = Plant(gain=1.0, damping=1.0, length_unit="rad")
    with pytest.raises(InputError, match="different units"):
        tune([MODELS["Lm1"], radians], SPEC)
    with pytest.raises(InputError, match="no model"):
        tune([], SPEC)


@settings(max_examples=15, deadline=None)
@given(
    time=st.floats(0.3, 0.9),
    band=st.floats(0.005, 0.05),
    sample_time=st.sampled_from([1e-3, 2e-3, 5e-3]),
    name=st.sampled_from(["Lm1", "NLm2", "NLm3"]),
)
def test_what_is_called_feasible_meets_the_spec(time: float, band: float, sample_time: float, name: str) -> None:
    spec = PDSpec(kp=100.0, settling_time=time, band=band, sample_time=sample_time)
    design = tune(MODELS[name], spec)
    assert all(response.meets for response in design.verified)
    for low, high in design.intervals:
        assert evaluate(MODELS[name], spec, 0.5 * (low + high)).meets


@pytest.mark.parametrize("effect", [Delay(time=0.04), ActuatorLag(time_constant=0.05)])
@pytest.mark.parametrize("back", [False, True])
def test_a_dead_time_and_a_lag_begin_with_the_step(effect, back):
    """Truth: the loop at rest for 0.2 s, then the step."""
    plant = Plant(gain=1.9, damping=6.0, effects=(effect,))
    spec = PDSpec(kp=8.0, settling_time=2.0, reference=0.1, sample_time=0.002)
    time = 0.002 * np.arange(2000)
    begin, end = (0.1, 0.0) if back else (0.0, 0.1)
    reference = np.where(time < 0.2 - 1e-9, begin, end)
    run = simulate_loop(plant, Controller(kp=8.0, kd=1.5), time, reference, start=(begin, 0.0))
    outside = np.flatnonzero(np.abs(run.position - end) > spec.band * 0.1)
    settled = time[outside[-1] + 1] - 0.2
    assert evaluate(plant, spec, 1.5, back=back).settling_time == pytest.approx(settled, abs=0.002)


@pytest.mark.parametrize("back", [False, True])
def test_a_lag_begins_with_the_step_of_an_ideal_loop(back):
    """Truth: the loop at rest for 0.2 s, then the step."""
    plant = Plant(gain=1.9, damping=6.0, effects=(ActuatorLag(time_constant=0.05),))
    spec = PDSpec(kp=8.0, settling_time=2.0, reference=0.1, control="continuous")
    time = 0.001 * np.arange(4000)
    begin, end = (0.1, 0.0) if back else (0.0, 0.1)
    reference = np.where(time < 0.2 - 1e-9, begin, end)
    run = simulate_continuous(plant, 8.0, 1.5, time, reference, start=(begin, 0.0))
    outside = np.flatnonzero(np.abs(run.position - end) > spec.band * 0.1)
    settled = time[outside[-1] + 1] - 0.2
    assert evaluate(plant, spec, 1.5, back=back).settling_time == pytest.approx(settled, abs=0.002)


@pytest.mark.parametrize("asked", [0.003, 0.01, 0.1])
def test_shortest_settling_time_is_offered_before_a_band_as_wide_as_the_step(asked: float) -> None:
    """A band of 0.99 of the step was offered: the steps were not watched until they had settled."""
    plant, spec = Plant(gain=2.0, damping=6.0), PDSpec(kp=60.0, settling_time=asked)
    found = tune(plant, spec)
    assert not found.feasible
    ((wish, offered),) = found.nearest[0].changes
    assert wish == "settling_time"
    assert tune(plant, replace(spec, settling_time=offered)).feasible
    assert not tune(plant, replace(spec, settling_time=0.95 * offered)).feasible
