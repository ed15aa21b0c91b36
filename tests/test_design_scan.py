"""Designs for random plants against dense scans of the gain, and against simulations that share nothing with ours."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from servolens import lab
from servolens.design import PDSpec, evaluate, settling_time, tune
from servolens.design.cover import EFFORT, Cover
from servolens.effects import (
    ActuatorLag,
    Backlash,
    CoulombFriction,
    Delay,
    Effect,
    FlexibleCoupling,
    Saturation,
    StribeckFriction,
    VelocityDecayDamping,
)
from servolens.plant import Plant

if TYPE_CHECKING:
    from types import ModuleType

    from servolens.design import Design


def scan_module() -> ModuleType:
    name = "design_scan"
    found = importlib.util.spec_from_file_location(name, Path(__file__).parent.parent / "benchmarks" / f"{name}.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module
    found.loader.exec_module(module)
    return module


SCAN = scan_module()


def test_a_settled_flexible_axis_swings_by_its_rounding_and_is_stable_all_the_same() -> None:
    coupling = FlexibleCoupling(frequency=54.035781, damping_ratio=0.067679, load_ratio=0.53363)
    plant = Plant(gain=2.075789, damping=17.892746, effects=(coupling,))
    spec = PDSpec(
        kp=838.072, settling_time=0.284127, band=0.05, reference=1.0, sample_time=2.48728e-3, derivative_filter=0.577
    )
    assert all(evaluate(plant, spec, kd).stable for kd in np.linspace(8.45, 8.55, 200))
    assert len(tune(plant, replace(spec, kd_max=50.0)).intervals) == 1


def test_the_search_ends_where_the_gains_that_do_have_no_end_of_detail() -> None:
    plant = Plant(gain=6.9034, damping=2.36197, effects=(Backlash(gap=8.7713e-4, load_share=0.3),))
    spec = PDSpec(kp=71.833, settling_time=0.66889, band=0.05, reference=0.01, sample_time=3.98223e-3, kd_max=20.0)
    cover = Cover((plant,), spec)
    finest = cover.gap
    intervals = cover.intervals()
    assert len(intervals) > 1
    assert cover.gap > finest
    assert cover.loops.count < 3 * EFFORT
    assert all(evaluate(plant, spec, kd).meets for span in intervals for kd in span)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_dense_scan_finds_no_wrong_gain_and_no_missed_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = SCAN.random_case(rng)
    design = tune(case.plant, case.spec)
    assert SCAN.mistakes(case, design, 120, rng) == []
    if not design.feasible:
        assert design.reason
        assert design.conflict


PAPER = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))


def scaled(plant: Plant, factor: float) -> Plant:
    return Plant(gain=factor * plant.gain, damping=plant.damping, effects=plant.effects)


@pytest.mark.parametrize("factor", [1e-3, 70.0, 1e4])
@pytest.mark.parametrize("kd_max", [20.0, None])
def test_another_gain_of_the_plant_only_rescales_the_design(factor: float, kd_max: float | None) -> None:
    usual = tune(PAPER, PDSpec(kp=100.0, settling_time=0.5))
    end = None if kd_max is None else kd_max if factor > 1.0 else kd_max / factor
    other = tune(scaled(PAPER, factor), PDSpec(kp=100.0 / factor, settling_time=0.5, kd_max=end))
    expected = np.array(usual.intervals) / factor
    np.testing.assert_allclose(np.array(other.intervals), expected, atol=other.certificate.gap)


@pytest.mark.parametrize("kd_max", [1.0, 20.0, None])
def test_small_gains_of_a_strong_plant_are_found(kd_max: float | None) -> None:
    design = tune(Plant(gain=570.0, damping=6.0), PDSpec(kp=1 / 3, settling_time=0.5, kd_max=kd_max))
    np.testing.assert_allclose(np.array(design.intervals), [(0.0181, 0.0386)], atol=1e-3)


def test_gains_that_leave_the_band_late_are_no_part_of_an_interval() -> None:
    weak = FlexibleCoupling(frequency=15.0, damping_ratio=0.01, load_ratio=0.3)
    plant, spec = Plant(gain=1.9, damping=6.0, effects=(weak,)), PDSpec(kp=60.0, settling_time=0.6, band=0.05)
    design = tune(plant, spec)
    assert design.kd == pytest.approx(1.970, abs=1e-3)
    assert design.intervals[0][1] < 2.6
    assert not evaluate(plant, spec, 2.6).meets
    assert not evaluate(plant, spec, 2.7).meets


def test_a_sliver_is_found() -> None:
    """The settling time is chosen so that the spec holds between two gains that are 0.01 apart, and nowhere else."""
    linear = Plant(gain=1.7866, damping=4.5866)
    low, high = 0.3, 0.6
    for _ in range(40):
        middle = 0.5 * (low + high)
        spec = PDSpec(kp=100.0, settling_time=middle, control="continuous", kd_max=20.0)
        width = sum(b - a for a, b in tune(linear, spec).intervals)
        low, high = (middle, high) if width < 0.01 else (low, middle)
    design = tune(linear, PDSpec(kp=100.0, settling_time=high, control="continuous", kd_max=20.0))
    assert design.feasible
    assert sum(b - a for a, b in design.intervals) == pytest.approx(0.01, abs=2e-3)


UNSTABLE = Plant(gain=1.9, damping=6.0, effects=(Delay(time=0.005),))


@pytest.mark.parametrize("kp", [30.0, 100.0, 1e3, 1e4, 1e6])
@pytest.mark.parametrize("kd_max", [1.0, 20.0, None])
@pytest.mark.parametrize("settling", [0.02, 0.1])
def test_an_infeasible_spec_has_a_reason_and_never_crashes(kp: float, kd_max: float | None, settling: float) -> None:
    design = tune(UNSTABLE, PDSpec(kp=kp, settling_time=settling, kd_max=kd_max))
    if not design.feasible:
        assert design.reason
        assert design.conflict
        assert design.to_json()["reason"] == design.reason


@pytest.mark.parametrize(
    ("asked", "conflict", "gives_way"),
    [
        ({"settling_time": 0.4, "overshoot": 0.02, "kd_max": 7.0}, ("settling_time",), {"settling_time", "overshoot"}),
        ({"settling_time": 0.5, "overshoot": 0.05, "kd_max": 6.0}, ("overshoot",), {"overshoot"}),
        ({"settling_time": 0.5, "voltage_limit": 8.0}, ("voltage_limit",), {"voltage_limit"}),
        ({"settling_time": 0.3}, ("settling_time",), {"settling_time"}),
    ],
)
def test_an_infeasible_spec_names_what_conflicts_and_what_can_be_met(
    asked: dict[str, float], conflict: tuple[str, ...], gives_way: set[str]
) -> None:
    plant = Plant(gain=1.8545, damping=6.152)
    spec = PDSpec(kp=100.0, **asked)
    design = tune(plant, spec)
    assert design.conflict == conflict
    assert design.reason is not None
    units = {"settling_time": "s", "voltage_limit": "V", "overshoot": "of the step"}
    for wish in conflict:
        assert f" of {asked[wish]:g} {units[wish]}" in design.reason
    first = design.nearest[0]
    does = evaluate(plant, replace(spec, **dict(first.changes)), first.kd)
    told = f"can be met: kd = {first.kd:.4g} settles in {does.settling_time:.4g} s, overshoots by"
    assert told in design.reason
    assert "closest" not in design.reason
    assert {name for name, _ in design.nearest[0].changes} == gives_way
    for relaxed in design.nearest:
        assert evaluate(plant, replace(spec, **dict(relaxed.changes)), relaxed.kd).meets


@pytest.mark.parametrize(
    ("asked", "conflict", "said"),
    [
        ({"ki": 1e9}, "ki", "stabilises the loop with kp = 60 and ki = 1e+09; choose a smaller ki"),
        ({"ki": 4000.0}, "ki", "without ki = 4000 a gain meets it; choose a smaller ki"),
        ({"setpoint_weight": 0.0}, "setpoint_weight", "goes to that share of its reference, outside the band; give ki"),
        ({"setpoint_weight": 0.98}, "setpoint_weight", "setpoint_weight = 0.98 goes to that share of its reference"),
    ],
)
def test_an_integral_or_a_weight_that_keeps_the_loop_from_the_spec_is_blamed(
    asked: dict[str, float], conflict: str, said: str
) -> None:
    """Routh and Hurwitz: the loop is stable where ki < kp (c + β kd)."""
    spec = PDSpec(kp=60.0, settling_time=0.6, **asked)
    design = tune(Plant(gain=1.9, damping=6.0), spec)
    assert design.conflict == (conflict,)
    assert design.reason is not None
    assert said in design.reason
    assert tune(Plant(gain=1.9, damping=6.0), PDSpec(kp=60.0, settling_time=0.6)).kd is not None


def test_an_unstable_gain_is_evaluated_without_a_crash() -> None:
    response = evaluate(UNSTABLE, PDSpec(kp=1e4, settling_time=0.1), 20.0)
    assert not response.stable
    assert not response.meets
    values = response.to_json()
    assert values["overshoot"] is None
    assert "unstable" in values["reason"]


AXES: dict[str, tuple[float, float, Effect | None]] = {
    "linear": (1.9, 6.0, None),
    "velocity_decay_damping": (1.91, 3.799, VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934)),
    "coulomb_friction": (240.0, 6.0, CoulombFriction(level=0.15)),
    "stribeck_friction": (1.9, 4.0, StribeckFriction(level=0.1, static_excess=0.1, stribeck_speed=0.01)),
    "saturation": (1.9, 6.0, Saturation(limit=5.0)),
    "flexible_coupling": (1.9, 6.0, FlexibleCoupling(frequency=40.0, damping_ratio=0.1, load_ratio=0.3)),
    "delay": (30.0, 6.0, Delay(time=0.0033)),
}


@pytest.mark.parametrize("name", AXES)
def test_the_laboratory_agrees_with_the_design(name: str) -> None:
    """The laboratory shares neither equations nor numerics with the simulator."""
    gain, damping, effect = AXES[name]
    plant = Plant(gain=gain, damping=damping, effects=() if effect is None else (effect,))
    spec = PDSpec(kp=190.0 / gain, settling_time=0.55, band=0.02, sample_time=2e-3)
    parameters: dict[str, Any] = {}
    if effect is not None:
        parameters[effect.name] = dict(zip((p.name for p in effect.parameters()), effect.values, strict=True))
    truth = lab.Truth(gain=gain, damping=damping, effects=parameters)
    design = tune(plant, spec)
    rng = np.random.default_rng(3)
    for kd in rng.uniform(0.0, 1.5 * design.intervals[-1][1], 12):
        record = lab.step_record(
            truth, spec.kp, float(kd), reference=spec.reference, duration=5.5, sample_time=2e-3, encoder=0.0
        )
        assert agrees(design, float(kd), record.time, record.position)


def agrees(design: Design, kd: float, time: np.ndarray, position: np.ndarray) -> bool:
    """Whether a simulation says of a gain what the design says; near the end of an interval either is right."""
    spec = design.spec
    settled = settling_time(time, (spec.reference - position) / abs(spec.reference), spec.band)
    meets = settled is not None and settled <= spec.settling_time
    inside = any(low <= kd <= high for low, high in design.intervals)
    near = min(abs(kd - end) for interval in design.intervals for end in interval)
    return meets == inside or near < 2e-3 * kd


@pytest.mark.parametrize("sample_time", [1e-3, 0.02])
def test_a_linear_sampled_loop_in_closed_form_agrees_with_the_design(sample_time: float) -> None:
    gain, damping = 12.0, 3.0
    spec = PDSpec(kp=10.0, settling_time=0.7, band=0.03, sample_time=sample_time)
    design = tune(Plant(gain=gain, damping=damping), spec)
    step = expm(np.array([[0.0, 1.0, 0.0], [0.0, -damping, gain], [0.0, 0.0, 0.0]]) * sample_time)
    time = sample_time * np.arange(int(7.0 / sample_time))
    for kd in np.linspace(0.0, 1.3 * design.intervals[-1][1], 60):
        x, before, position = np.zeros(3), 0.0, np.empty(time.size)
        for k in range(time.size):
            position[k] = x[0]
            x[2] = spec.kp * (spec.reference - x[0]) - kd * (x[0] - before) / sample_time
            before = x[0]
            x = step @ x
        assert agrees(design, float(kd), time, position)


def test_loop_that_swings_up_slowly_is_judged_for_as_long_as_its_gains_are_evaluated() -> None:
    """Two samples more than the horizon cost the last gains of an interval, in five of 46 coarsely sampled loops."""
    axis = Plant(gain=0.029156, damping=0.0042358, effects=(ActuatorLag(time_constant=5.4144),))
    spec = PDSpec(kp=0.11588, settling_time=88.851, band=0.6, reference=30.0, sample_time=7.9512)
    design = tune(axis, spec)
    end, gap = design.intervals[-1][1], design.certificate.gap
    assert not any(evaluate(axis, spec, end + share * gap).meets for share in (1.0, 2.0, 3.0))
