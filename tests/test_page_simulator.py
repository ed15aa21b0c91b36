"""The page's simulator is the kernel's rule in JavaScript: it agrees with the kernel on whatever a page can show."""

from __future__ import annotations

import ast
import json
import math
import shutil
import subprocess
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

from servolens.design import PDSpec, evaluate
from servolens.design.scenarios import Scenario, drawn
from servolens.design.settle import horizon, step_response
from servolens.effects import CATALOGUE, CoulombFriction, Delay, Force, Saturation, parameter
from servolens.errors import NumericalError
from servolens.model import Model
from servolens.plant import Plant
from servolens.report.printing import chromium
from servolens.report.simulated import axis_json, design_json, plant_of, plants_script, simulator_script
from servolens.simulation import translated

if TYPE_CHECKING:
    from pathlib import Path

OF_THE_STEP = 1e-3
"""What is asked for; where nothing sticks and slips, the simulators agree to rounding."""
EFFECTS: dict[str, dict[str, float]] = {
    "coulomb_friction": {"level": 0.4},
    "asymmetric_friction": {"level_positive": 0.5, "level_negative": 0.2},
    "stribeck_friction": {"level": 0.3, "static_excess": 0.2, "stribeck_speed": 0.02},
    "velocity_decay_damping": {"alpha1": 17.0, "alpha2": 13.0},
    "asymmetric_damping": {"damping_difference": 1.5},
    "quadratic_drag": {"drag": 4.0},
    "return_spring": {"stiffness": 20.0},
    "hardening_spring": {"cubic_stiffness": 900.0},
    "constant_force": {"acceleration": 0.6},
    "pendulum_gravity": {"amplitude": 2.0, "phase": 0.3},
    "cogging": {"amplitude": 0.5, "pitch": 0.02, "phase": 0.4},
    "position_friction": {"level": 0.7, "centre": 0.06, "width": 0.02},
    "load_friction": {"share": 0.12},
    "friction_map": {f"{way}_{i}": 0.2 + 0.05 * i for way in ("positive", "negative") for i in range(5)}
    | {"low": 0.0, "high": 0.1},
    "end_stop": {"low": -0.02, "high": 0.103},
    "presliding": {"stiffness": 2000.0, "level": 0.4},
    "periodic_disturbance": {"amplitude": 0.4, "frequency": 7.0, "phase": 0.2},
    "gain_drift": {"rate": 0.1},
    "dead_zone": {"width": 0.2},
    "saturation": {"limit": 4.0},
    "delay": {"time": 0.0123},
    "actuator_lag": {"time_constant": 0.006},
    "force_limit": {"acceleration": 9.0},
    "speed_servo": {"speed_per_volt": 0.1, "proportional": 40.0, "integral": 200.0},
    "backlash": {"gap": 0.0006, "load_share": 0.3},
    "flexible_coupling": {"frequency": 20.0, "damping_ratio": 0.05, "load_ratio": 0.3},
    "sensor_lag": {"time_constant": 0.004},
}


@dataclass(frozen=True)
class UsersForce(Force):
    """Operations that no effect of the catalogue has."""

    name = "users_force"
    sentence = "A force of a user's own."
    latex = r"F_u"

    size: float = parameter("F_u", "{x}/s^2", "size", per_mass=1)

    @staticmethod
    def physics(axis: Any, p: Any) -> Any:
        y, v = axis.position, axis.velocity
        odd = ca.erf(20 * v) + ca.tanh(y) + ca.atan2(v, 1 + y**2) + ca.fmod(y, 0.03) + ca.log1p(v**2) ** 1.5
        steps = ca.floor(40 * y) + ca.ceil(3 * v) + ca.if_else(ca.logic_or(y > 0.05, v < 0), 0.3, ca.fabs(v))
        return p.size * (odd + 0.1 * steps + ca.fmax(ca.fmin(v, 0.2), -0.1) + ca.expm1(y) + ca.hypot(v, 0.1))


def with_effect(name: str) -> Plant:
    return Plant(gain=1.8, damping=6.0, effects=(CATALOGUE[name](**EFFECTS[name]),))


def run_script(script: str, folder: Path) -> Any:
    """Return what `script` leaves in ``answer``, run by Node or, where there is none, by Chromium."""
    node, browser = shutil.which("node"), chromium()
    if node is not None:
        path = folder / "script.js"
        path.write_text(f"{script}\nconsole.log(JSON.stringify(answer));", encoding="utf-8")
        done = subprocess.run([node, path], capture_output=True, text=True, check=True)
        return json.loads(done.stdout)
    if browser is None:
        pytest.skip("neither Node nor Chromium is here to run JavaScript")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not here to run JavaScript")
    with sync_api.sync_playwright() as tools:
        page = tools.chromium.launch(executable_path=browser, args=["--no-sandbox"]).new_page()
        return page.evaluate(f"(() => {{ {script}\nreturn answer; }})()")


def asked(
    axes: list[tuple[Plant, PDSpec, float, Any]],
    folder: Path,
    *,
    duration: float | None = None,
    moved: dict[str, float] | None = None,
) -> list[Any]:
    """Return the script's steps of plants in their loops with a gain; some sliders of the page may be `moved`."""
    names = {}
    for plant, spec, _, _ in axes:
        names.setdefault((plant.structure, spec.control), f"plant{len(names)}")
    texts = [
        (name, plant_of(PDSpec(kp=1, settling_time=1, control=control), structure))
        for (structure, control), name in names.items()
    ]
    jobs = [
        {
            "design": design_json(spec, plant),
            "axis": axis_json(names[plant.structure, spec.control], plant, spec, gain, scenario),
            "gains": {"kp": spec.kp, "free": gain, "integral": spec.kiv if spec.controller == "cascade" else spec.ki}
            | (moved or {}),
            "duration": duration or horizon(plant, spec),
        }
        for plant, spec, gain, scenario in axes
    ]
    script = f"""
{simulator_script()}
{plants_script(texts)}
const simulator = servolensSimulator(servolensRule, servolensPlants);
const finite = (value) => (Number.isFinite(value) ? value : null);
const answer = {json.dumps(jobs)}.map(({{design, axis, gains, duration}}) => {{
  const found = simulator.evaluate(design, axis, gains, duration);
  return {{
    n: found.run.n, position: Array.from(found.run.position.subarray(0, found.run.n)),
    voltage: Array.from(found.run.voltage.subarray(0, found.run.n)), settling: found.settling,
    overshoot: finite(found.overshoot), peak: finite(found.peak), meets: found.meets, stable: found.stable,
    horizon: simulator.horizon(design, axis, gains),
  }};
}});"""
    return run_script(script, folder)


def assert_same(told: Any, plant: Plant, spec: PDSpec, gain: float) -> None:
    """Hold a step of the script against the kernel's, and what is said of it."""
    found = evaluate(plant, spec, gain)
    assert told["stable"] == found.stable
    if not found.stable:
        return
    run = step_response(plant, spec, gain, horizon(plant, spec))
    assert told["horizon"] == pytest.approx(horizon(plant, spec))
    assert told["n"] == run.time.size
    assert np.abs(np.array(told["position"]) - run.position).max() <= OF_THE_STEP * abs(spec.reference)
    assert told["overshoot"] == pytest.approx(found.overshoot, abs=OF_THE_STEP)
    assert told["peak"] == pytest.approx(found.peak_voltage, rel=OF_THE_STEP)


def test_every_effect_of_the_catalogue_is_tried():
    assert EFFECTS.keys() == CATALOGUE.keys()


def test_script_agrees_with_the_kernel_on_every_effect(tmp_path):
    spec = PDSpec(kp=100, settling_time=0.2)
    axes = [(with_effect(name), spec, gain, None) for name in EFFECTS for gain in (0.0, 7.0)]
    for (plant, own, gain, _), told in zip(axes, asked(axes, tmp_path), strict=True):
        assert_same(told, plant, own, gain)


def test_where_nothing_rattles_both_agree_to_rounding(tmp_path):
    spec = PDSpec(kp=100, settling_time=0.3)
    smooth = ("velocity_decay_damping", "pendulum_gravity", "actuator_lag", "delay", "flexible_coupling")
    axes = [(with_effect(name), spec, 7.0, None) for name in smooth]
    for (plant, own, gain, _), told in zip(axes, asked(axes, tmp_path), strict=True):
        run = step_response(plant, own, gain, horizon(plant, own))
        assert np.abs(np.array(told["position"]) - run.position).max() < 1e-11


LAWS = {
    "filtered PD": {"derivative_filter": 0.3, "sample_time": 2e-3},
    "continuous": {"control": "continuous"},
    "PID": {"ki": 150.0},
    "PID, clamped": {"ki": 400.0, "anti_windup": "clamping"},
    "PID, back-calculated": {"ki": 400.0, "anti_windup": "back_calculation", "setpoint_weight": 0.6},
    "cascade": {"controller": "cascade", "kp": 14.0, "kiv": 30.0},
    "cascade, back-calculated": {"controller": "cascade", "kp": 14.0, "kiv": 90.0, "anti_windup": "back_calculation"},
    "cascade without integral": {"controller": "cascade", "kp": 14.0},
    "downwards, with limits": {"reference": -0.05, "overshoot": 0.03, "voltage_limit": 6.0},
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_script_agrees_with_the_kernel_in_every_loop(law, tmp_path):
    spec = PDSpec(**{"kp": 80.0, "settling_time": 0.4, **law})
    limited = Plant(gain=1.8, damping=6.0, effects=(CoulombFriction(level=0.3), Saturation(limit=5.0)))
    plants = (
        [limited] if spec.control == "continuous" or spec.anti_windup != "none" else [limited, with_effect("delay")]
    )
    axes = [(plant, spec, gain, None) for plant in plants for gain in (0.0, 4.0, 9.0)]
    for (plant, own, gain, _), told in zip(axes, asked(axes, tmp_path), strict=True):
        assert_same(told, plant, own, gain)
        assert told["meets"] == evaluate(plant, own, gain).meets


def test_script_agrees_on_axes_as_they_may_be(tmp_path):
    plant = Plant(gain=1.8, damping=6.0, effects=(CoulombFriction(level=0.3), Delay(time=0.004)))
    model = Model(plant=plant, covariance=np.diag([0.05, 0.5, 0.05, 1e-3]) ** 2)
    for spec in (PDSpec(kp=80, settling_time=0.4), PDSpec(kp=14, settling_time=0.4, controller="cascade", kiv=20.0)):
        scenarios = drawn([model], [spec], 6, np.random.default_rng(1))
        axes = [(s.plant, spec, 5.0, s) for s in scenarios]
        for scenario, told in zip(scenarios, asked(axes, tmp_path, duration=1.2), strict=True):
            run = step_response(scenario.plant, scenario.spec, 5.0 * scenario.realised, 1.2, back=scenario.back)
            assert np.abs(np.array(told["position"]) - run.position).max() <= OF_THE_STEP * abs(spec.reference)
            assert told["settling"] == pytest.approx(scenario.response(5.0, 1.2).settling_time, abs=1e-6)


@pytest.mark.parametrize("force", [None, "constant_force", "return_spring", "pendulum_gravity", "hardening_spring"])
@pytest.mark.parametrize(
    "law",
    [
        {},
        {"control": "continuous"},
        {"ki": 300.0, "setpoint_weight": 0.6},
        {"controller": "cascade", "kp": 14.0},
        {"controller": "cascade", "kp": 14.0, "kiv": 30.0},
    ],
)
def test_script_steps_back_lets_a_lag_begin_with_the_step_and_holds_the_axis_before_it(force, law, tmp_path):
    """Where a balance that bends is off by one bit, the first step begins with a reversal."""
    spec = PDSpec(**{"kp": 80.0, "settling_time": 0.4, "reference": 0.1, **law})
    plant = Plant(gain=1.8, damping=6.0, effects=(CATALOGUE["actuator_lag"](time_constant=0.03),))
    plant = plant if force is None else plant.with_effect(CATALOGUE[force](**EFFECTS[force]))
    realised = [(1.0, False), (1.0, True), (0.9, True)]
    scenarios = [Scenario(plant=plant, spec=spec.scaled(r), realised=r, back=back) for r, back in realised]
    axes = [(s.plant, spec, 5.0, s) for s in scenarios]
    for scenario, told in zip(scenarios, asked(axes, tmp_path, duration=1.2), strict=True):
        run = step_response(plant, scenario.spec, 5.0 * scenario.realised, 1.2, back=scenario.back)
        assert np.abs(np.array(told["position"]) - run.position).max() < 1e-10
        assert told["settling"] == pytest.approx(scenario.response(5.0, 1.2).settling_time, abs=1e-6)


@pytest.mark.parametrize("force", ["constant_force", "return_spring"])
@pytest.mark.parametrize(
    ("law", "moved"),
    [({}, {"kp": 50.0}), ({}, {"free": 9.0}), ({"ki": 300.0}, {"kp": 50.0}), ({"ki": 300.0}, {"integral": 0.0})],
)
def test_script_holds_a_weight_or_a_spring_wherever_the_sliders_are(force, law, moved, tmp_path):
    spec = PDSpec(**{"kp": 80.0, "settling_time": 0.4, "reference": 0.1, **law})
    plant = with_effect(force)
    other = replace(spec, kp=moved.get("kp", spec.kp), ki=moved.get("integral", spec.ki))
    for back in (False, True):
        scenario = Scenario(plant=plant, spec=spec, realised=1.0, back=back)
        (told,) = asked([(plant, spec, 5.0, scenario)], tmp_path, duration=1.2, moved=moved)
        run = step_response(plant, other, moved.get("free", 5.0), 1.2, back=back)
        assert np.abs(np.array(told["position"]) - run.position).max() < 1e-8


def test_script_knows_operations_of_users_own_effects(tmp_path):
    plant = Plant(gain=1.8, damping=6.0, effects=(UsersForce(size=0.2),))
    spec = PDSpec(kp=100, settling_time=0.3)
    (told,) = asked([(plant, spec, 7.0, None)], tmp_path)
    assert_same(told, plant, spec, 7.0)


def test_unstable_loop_is_said_and_not_drawn(tmp_path):
    plant = with_effect("delay")
    spec = PDSpec(kp=3000, settling_time=0.5)
    with pytest.raises(NumericalError):
        step_response(plant, spec, 0.0, horizon(plant, spec))
    (told,) = asked([(plant, spec, 0.0, None)], tmp_path)
    assert not told["stable"]
    assert not told["meets"]


def test_error_function_of_the_script_is_exact(tmp_path):
    x = [-7.0, -3.5, -2.999, -0.4, 0.0, 1e-9, 0.7, 2.0, 3.0, 3.001, 5.5, 6.5]
    found = run_script(f"{simulator_script()}\nconst answer = {x}.map(servolensErf);", tmp_path)
    assert found == pytest.approx([math.erf(v) for v in x], abs=1e-13)


def test_rule_is_translated_whole_or_not_at_all():
    writer = translated._Writer({})
    (lambda_of_python,) = ast.parse("f = lambda x: x").body
    with pytest.raises(NotImplementedError, match=r"line 1: .*lambda"):
        writer.statement(lambda_of_python)
    functions = {
        node.name
        for name in translated.MODULES
        for node in translated._tree(name).body
        if isinstance(node, ast.FunctionDef) and not translated._is_intrinsic(node)
    }
    assert {"run", "advance", "law_beyond_pd", "averages"} <= functions
    assert all(f"function {name}(" in translated.rule_script() for name in functions - translated.LEFT_OUT)
