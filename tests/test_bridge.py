"""Plants and loops in python-control, against the kernel, finite differences and closed forms."""

from __future__ import annotations

import copy
import pickle

import control as ct
import matplotlib as mpl
import numpy as np
import pytest

from servolens import lab
from servolens.bridge import SOLVER, closed_loop, held_response, to_control
from servolens.effects import CoulombFriction, Saturation, VelocityDecayDamping
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.simulation.loop import simulate_continuous, simulate_voltage

DECAY = VelocityDecayDamping(alpha1=17.3264, alpha2=13.1068)
LINEAR = Plant(gain=1.8545, damping=6.1520)
CART = Plant(gain=1.9165, damping=5.9986, effects=(DECAY,))
CLIPPED = Plant(gain=1.9165, damping=5.9986, effects=(DECAY, Saturation(limit=4.0)))
STICKY = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.8),))
EVERYTHING = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.8), DECAY, Saturation(limit=4.0)))
TIME = np.arange(1501) * 1e-3
STEP = np.full(TIME.size, 0.1)
SMOOTH = {"linear": LINEAR, "decay": CART, "decay, clipped": CLIPPED}


def kernel_position(plant, kp, kd):
    return simulate_continuous(plant, kp, kd, TIME, STEP, substeps=40).position


@pytest.mark.parametrize(("kp", "kd"), [(60.0, 0.0), (100.0, 5.0)])
@pytest.mark.parametrize("plant", SMOOTH.values(), ids=SMOOTH)
def test_closed_loop_agrees_with_the_kernel_on_smooth_plants(plant, kp, kd):
    response = ct.input_output_response(closed_loop(plant, kp, kd), TIME, STEP, solve_ivp_kwargs=SOLVER)
    assert np.abs(response.outputs[0] - kernel_position(plant, kp, kd)).max() < 1e-6
    expected = kp * (0.1 - response.outputs[0]) - kd * response.outputs[1]
    np.testing.assert_allclose(response.outputs[2], expected, rtol=0, atol=1e-12)


def test_signals_and_parameters_have_their_names():
    system = to_control(EVERYTHING, name="axis")
    assert system.name == "axis"
    assert system.input_labels == ["voltage"]
    assert system.output_labels == system.state_labels == ["position", "velocity"]
    assert system.params == dict(zip(EVERYTHING.parameters, EVERYTHING.values, strict=True))
    loop = closed_loop(EVERYTHING, 60, 5)
    assert loop.input_labels == ["reference"]
    assert loop.output_labels == ["position", "velocity", "voltage"]
    assert loop.params == {**system.params, "kp": 60.0, "kd": 5.0}


@pytest.mark.parametrize("name", ["gain", "damping", "velocity_decay_damping.alpha1", "kp", "kd"])
def test_parameter_given_later_is_the_parameter_built_in(name):
    given = {**closed_loop(CART, 60, 1).params, name: 1.1 * closed_loop(CART, 60, 1).params[name]}
    *values, kp, kd = given.values()
    built_in = closed_loop(CART.with_values(values), kp, kd)
    expected = ct.input_output_response(built_in, TIME, STEP, solve_ivp_kwargs=SOLVER).outputs
    system = closed_loop(CART, 60, 1)
    response = ct.input_output_response(system, TIME, STEP, params={name: given[name]}, solve_ivp_kwargs=SOLVER)
    np.testing.assert_array_equal(response.outputs, expected)
    unchanged = ct.input_output_response(system, TIME, STEP, solve_ivp_kwargs=SOLVER).outputs
    assert np.abs(unchanged - expected).max() > 1e-4


def central_differences(system, x, u):
    """A and B by differences that do not reach across a kink; error of second order in 1e-6."""
    step = 1e-6
    columns = []
    for i in range(3):
        ahead, back = np.r_[x, u], np.r_[x, u]
        ahead[i] += step
        back[i] -= step
        columns.append((system.dynamics(0, ahead[:2], ahead[2:]) - system.dynamics(0, back[:2], back[2:])) / (2 * step))
    return np.column_stack(columns)


@pytest.mark.parametrize("velocity", [-0.2, -1e-3, 3e-4, 0.05, 0.4])
@pytest.mark.parametrize("make", [to_control, lambda plant: closed_loop(plant, 30.0, 2.0)], ids=["plant", "loop"])
def test_linearisation_is_the_limit_of_differences(make, velocity):
    system = make(EVERYTHING)
    x, u = np.array([0.01, velocity]), np.array([0.05])
    linear = ct.linearize(system, x, u)
    # third derivative of tanh(v/1e-3)·0.8 is at most 2·0.8/1e-9: 1.6e9·1e-12/6 = 3e-4 absolute, on slopes up to 800
    np.testing.assert_allclose(np.column_stack([linear.A, linear.B]), central_differences(system, x, u), atol=5e-4)
    np.testing.assert_array_equal(linear.C[:2], np.eye(2))
    if linear.noutputs == 3:
        np.testing.assert_array_equal(linear.C[2], [-30.0, -2.0])
        np.testing.assert_array_equal(linear.D, [[0.0], [0.0], [30.0]])


def test_damping_at_rest_is_base_plus_alpha1():
    linear = ct.linearize(to_control(CART), [0.0, 0.0], 0.0)
    np.testing.assert_array_equal(linear.A, [[0.0, 1.0], [0.0, -(5.9986 + 17.3264)]])
    np.testing.assert_array_equal(linear.B, [[0.0], [1.9165]])


def test_damping_of_smoothed_friction_at_rest_is_level_over_width():
    linear = ct.linearize(to_control(STICKY, friction_width=0.01), [0.0, 0.0], 0.0)
    assert linear.A[1, 1] == pytest.approx(-(6.0 + 0.8 / 0.01), rel=1e-14)


def test_linearisation_takes_what_python_control_takes():
    loop = closed_loop(CART, 60, 5, name="loop")
    found = ct.find_operating_point(loop, [0.0, 0.0], 0.1)
    np.testing.assert_allclose(found.states, [0.1, 0.0], atol=1e-10)
    linear = ct.linearize(loop, found, params={"gain": 2.0}, copy_names=True)
    np.testing.assert_allclose(linear.A, [[0, 1], [-120.0, -(5.9986 + 17.3264 + 10.0)]], rtol=1e-9)
    assert linear.state_labels == ["position", "velocity"]
    assert linear.name == "loop$linearized"
    assert ct.linearize(loop, 0.0, name="mine").name == "mine"
    short = ct.linearize(loop, [0.0], 0.0)
    np.testing.assert_array_equal(short.A, ct.linearize(loop, [0.0, 0.0], 0.0).A)


def test_bode_plot_of_the_linearised_plant_shows_its_transfer_function():
    mpl.use("Agg")
    linear = ct.linearize(to_control(CART, name="cart"), [0.0, 0.0], 0.0)[0, 0]
    omega = np.logspace(-1, 2, 7)
    s = 1j * omega
    expected = 1.9165 / (s * (s + 5.9986 + 17.3264))
    np.testing.assert_allclose(ct.frequency_response(linear, omega).complex, expected, rtol=1e-12)
    plot = ct.bode_plot(linear, omega)
    line = plot.axes[0, 0].get_lines()[0]
    np.testing.assert_allclose(line.get_ydata(), np.abs(expected), rtol=1e-12)
    mpl.pyplot.close("all")


def test_hand_made_interconnection_is_the_closed_loop():
    gains = ct.ss(
        [], [], [], [[60, -60, -5]], inputs=["reference", "position", "velocity"], outputs=["voltage"], name="pd"
    )
    joined = ct.interconnect(
        [gains, to_control(CART, name="cart")], inputs=["reference"], outputs=["position", "velocity", "voltage"]
    )
    ours = ct.input_output_response(closed_loop(CART, 60, 5), TIME, STEP, solve_ivp_kwargs=SOLVER)
    theirs = ct.input_output_response(joined, TIME, STEP, solve_ivp_kwargs=SOLVER)
    # the same equations in another order of rounding: what the solver's rtol of 1e-8 makes of it
    np.testing.assert_allclose(theirs.outputs, ours.outputs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        ct.linearize(joined, [0.0, 0.0], 0.1).A, ct.linearize(closed_loop(CART, 60, 5), [0.0, 0.0], 0.1).A, atol=1e-3
    )


def two_axes(**prefixes):
    slow = to_control(LINEAR.with_values([1.0, 6.0]), name="slow", prefix=prefixes.get("slow", ""))
    fast = to_control(LINEAR.with_values([5.0, 6.0]), name="fast", prefix=prefixes.get("fast", ""))
    return ct.interconnect(
        [slow, fast],
        inplist=[["slow.voltage", "fast.voltage"]],
        inputs=["voltage"],
        outlist=["slow.position", "fast.position", "slow.velocity", "fast.velocity"],
        outputs=["y1", "y2", "v1", "v2"],
    )


def test_two_plants_in_one_interconnection_need_prefixes():
    prefixed = two_axes(slow="slow.", fast="fast.")
    assert prefixed.dynamics(0, np.zeros(4), [1.0]).tolist() == [0.0, 1.0, 0.0, 5.0]
    assert prefixed.dynamics(0, np.zeros(4), [1.0], params={"slow.gain": 2.0}).tolist() == [0.0, 2.0, 0.0, 5.0]
    # the pitfall that the module describes: without prefixes both get the last gain
    assert two_axes().dynamics(0, np.zeros(4), [1.0]).tolist() == [0.0, 5.0, 0.0, 5.0]


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))], ids=["copied", "pickled"])
def test_copy_behaves_like_the_original_and_stands_alone(twin):
    system = closed_loop(EVERYTHING, 60, 5, name="axis", prefix="x.")
    other = twin(system)
    assert (other.name, other.params) == (system.name, system.params)
    x, u = np.array([0.02, 5e-4]), np.array([0.1])  # slow, where the width of smoothed friction shows
    rates = system.dynamics(0, x, u)
    np.testing.assert_array_equal(other.dynamics(0, x, u), rates)
    np.testing.assert_array_equal(other.linearize(x, u).A, system.linearize(x, u).A)
    other.dynamics(0, 2 * x, u, params={"x.gain": 7.0})
    np.testing.assert_array_equal(system.dynamics(0, x, u), rates)


@pytest.mark.parametrize("kd", [0.0, 5.0])
def test_smoothed_friction_approaches_the_kernel_in_proportion_to_its_width(kd):
    expected = kernel_position(STICKY, 60, kd)
    errors = []
    for width in (1e-3, 1e-4, 1e-5):
        loop = closed_loop(STICKY, 60, kd, friction_width=width)
        response = ct.input_output_response(loop, TIME, STEP, solve_ivp_kwargs=SOLVER)
        errors.append(np.abs(response.outputs[0] - expected).max())
    # the axis creeps at the width's order of speed: ten times narrower, about ten times closer
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 5
    assert errors[2] < errors[1] / 5


def test_pulse_that_the_default_solver_misses_is_not_missed_here():
    pulse = np.where((TIME >= 0.7) & (TIME < 0.75), 6.0, 0.0)
    system = to_control(CART)
    expected = simulate_voltage(CART, TIME, pulse, substeps=40).position
    assert expected[-1] > 0.07
    missed = ct.input_output_response(system, TIME, pulse).outputs[0]
    assert np.all(missed == 0.0)
    ramps = ct.input_output_response(system, TIME, pulse, solve_ivp_kwargs=SOLVER).outputs[0]
    # each edge becomes a ramp over the sample before, so the pulse comes half a sample early; the cart, at no more than
    # 1.9165·6 V·0.05 s, is as much further on
    assert 1e-5 < np.abs(ramps - expected).max() < 0.5e-3 * 1.9165 * 6 * 0.05
    held = held_response(system, TIME, pulse)
    assert np.abs(held.outputs[0] - expected).max() < 1e-7


def test_logged_voltage_drives_the_plant_as_it_drove_the_virtual_cart():
    record = lab.step_record(lab.NLM1, 60, encoder=0.0)
    system = to_control(CART)
    held = held_response(system, record.time, record.voltage)
    assert np.abs(held.outputs[0] - record.position).max() < 1e-7
    # interpolated, each voltage comes half a sample early: 1 mm
    ramps = ct.input_output_response(system, record.time, record.voltage, solve_ivp_kwargs=SOLVER).outputs[0]
    assert np.abs(ramps - record.position).max() > 5e-4


def test_held_response_takes_initial_state_parameters_and_many_inputs():
    system = two_axes(slow="slow.", fast="fast.")
    start = [0.1, 0.0, -0.1, 0.5]
    response = held_response(system, [0.0, 0.5, 1.0], [[1.0, 1.0, 0.0]], initial_state=start, params={"slow.gain": 3.0})
    t = np.array([0.0, 0.5, 1.0])
    gone = (1 - np.exp(-6 * t)) / 6
    np.testing.assert_allclose(response.outputs[0], 0.1 + 3.0 / 6 * (t - gone), atol=1e-7)
    np.testing.assert_allclose(response.outputs[1], -0.1 + 0.5 * gone + 5.0 / 6 * (t - gone), atol=1e-7)
    assert response.inputs.tolist() == [[1.0, 1.0, 0.0]]
    assert response.output_labels == ["y1", "y2", "v1", "v2"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: to_control(STICKY, friction_width=0.0), "friction_width must be positive and finite, got 0.0"),
        (lambda: closed_loop(CART, float("nan")), "kp and kd must be finite, got nan and 0.0"),
        (lambda: held_response(to_control(CART), [0.0, 0.0], [1.0, 1.0]), "time must be .* increase"),
        (lambda: held_response(to_control(CART), [0.0, 1.0], [1.0]), r"inputs must have shape \(1, 2\), got \(1, 1\)"),
    ],
    ids=["width", "gain", "time", "inputs"],
)
def test_wrong_use_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
