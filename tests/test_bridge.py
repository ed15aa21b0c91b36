"""Plants and loops in python-control, against the kernel, finite differences and closed forms."""

from __future__ import annotations

import copy
import pickle
import warnings

import control as ct
import matplotlib as mpl
import numpy as np
import pytest

from servolens import lab
from servolens.bridge import SOLVER, ResponseWarning, check_response, closed_loop, held_response, to_control
from servolens.bridge.checking import judge
from servolens.effects import CATALOGUE, CoulombFriction, DryFriction, Saturation, VelocityDecayDamping
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.record import Controller
from servolens.simulation.loop import simulate_continuous, simulate_loop, simulate_voltage

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
        (
            lambda: to_control(STICKY, friction_width=0.0),
            "friction_width must be a finite number larger than 0, got float 0.0",
        ),
        (lambda: closed_loop(CART, float("nan")), "kp must be a finite number, got float nan"),
        (lambda: held_response(to_control(CART), [0.0, 0.0], [1.0, 1.0]), "time must be .* increase"),
        (lambda: held_response(to_control(CART), [0.0, 1.0], [1.0]), r"inputs must have shape \(1, 2\), got \(1, 1\)"),
    ],
    ids=["width", "gain", "time", "inputs"],
)
def test_wrong_use_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


# Effects with states, transmissions, drives, sensors and delays.

VALUES = {name: cls.typical for name, cls in CATALOGUE.items()} | {
    "delay": {"time": 0.01},
    "flexible_coupling": {"frequency": 12.0, "damping_ratio": 0.05, "load_ratio": 0.4},
}
"""The latter two as the closed forms below have them."""
WIDTH = 1e-4
ORDER = 6
SECOND = TIME[:1001]
PUSHES = np.select([SECOND < 0.02, SECOND < 0.22, SECOND < 0.37, SECOND < 0.52], [0.0, 4.0, -4.0, 2.0], 0.0)
every_effect = pytest.mark.parametrize("name", CATALOGUE)


def with_effects(*names, **others):
    effects = tuple(CATALOGUE[name](**VALUES[name] | others.get(name, {})) for name in names)
    return Plant(gain=1.9, damping=6.0, effects=effects)


def bridged(plant, **options):
    return to_control(plant, friction_width=WIDTH, delay_order=ORDER, **options)


def looped(plant, kp=60.0, kd=3.0):
    return closed_loop(plant, kp, kd, friction_width=WIDTH, delay_order=ORDER)


def tolerance(name):
    """Distance allowed [m] on a move of 0.1 m."""
    if issubclass(CATALOGUE[name], DryFriction):
        return 0.1 * WIDTH * SECOND[-1]  # creeps at the order of the width while it sticks: 3 % of it, mostly
    if name == "backlash":
        return 2e-5  # a contact of 2000 rad/s is struck a few times; the kernel itself is 8e-6 off
    if name == "delay":
        return 5e-6  # what Padé of order 6 makes of jumps: 1.5e-6 here
    return 1e-6


@every_effect
def test_every_effect_agrees_with_the_kernel_under_a_held_voltage(name):
    plant = with_effects(name)
    expected = simulate_voltage(plant, SECOND, PUSHES, substeps=40)
    response = held_response(bridged(plant), SECOND, PUSHES, initial_state="at rest", check=True)
    assert np.ptp(expected.measured) > 0.05
    np.testing.assert_allclose(response.outputs[0], expected.measured, rtol=0, atol=tolerance(name))


def random_points(system, seed):
    """States off all kinks, with quantities of the size of real ones; motor and load far apart, or about as the gap."""
    rng = np.random.default_rng(seed)
    for place in (0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3):
        scale = {"position": place, "velocity": 0.3}
        sizes = [scale.get(label.rpartition(".")[2], 0.5) for label in system.state_labels]
        yield np.array(sizes) * rng.uniform(-1, 1, len(sizes)), rng.uniform(-2, 2, 1)


def differences(function, x, u, step):
    point, columns = np.r_[x, u], []
    for i in range(point.size):
        ahead, back = point.copy(), point.copy()
        ahead[i] += step
        back[i] -= step
        n = x.size
        columns.append((function(0.3, ahead[:n], ahead[n:]) - function(0.3, back[:n], back[n:])) / (2 * step))
    return np.column_stack(columns)


@every_effect
@pytest.mark.parametrize("make", [bridged, looped], ids=["plant", "loop"])
def test_every_effect_is_linearised_exactly(name, make):
    system = make(with_effects(name))
    for x, u in random_points(system, seed=7):
        linear = system.linearize(x, u, t=0.3)
        slopes = np.column_stack([linear.A, linear.B])
        # rounding of values up to 1e5 (contacts) by a step of 1e-6, and its square in the third derivatives
        size = np.abs(slopes).max()
        np.testing.assert_allclose(slopes, differences(system.dynamics, x, u, 1e-6), rtol=1e-6, atol=1e-8 * size + 1e-7)
        seen = np.column_stack([linear.C, linear.D])
        np.testing.assert_allclose(seen, differences(system.output, x, u, 1e-6), rtol=0, atol=1e-6)


@every_effect
def test_every_parameter_given_later_is_the_one_built_in(name):
    plant = with_effects(name)
    system = bridged(plant)
    base = plant.values
    (x, u), *_ = random_points(system, seed=3)
    assert list(system.params) == list(plant.parameters)
    for i, parameter in enumerate(plant.parameters):
        values = [*base[:i], 0.9 * base[i], *base[i + 1 :]]
        other = bridged(plant.with_values(values))
        if parameter == "gain" and name == "speed_servo":
            continue  # the drive says what it is
        np.testing.assert_array_equal(
            system.dynamics(0.3, x, u, params={parameter: values[i]}), other.dynamics(0.3, x, u)
        )


@every_effect
def test_every_effect_survives_pickling(name):
    system = looped(with_effects(name))
    (x, u), *_ = random_points(system, seed=5)
    other = pickle.loads(pickle.dumps(system))
    assert other.state_labels == system.state_labels
    np.testing.assert_array_equal(other.dynamics(0.3, x, u), system.dynamics(0.3, x, u))
    np.testing.assert_array_equal(other.linearize(x, u).A, system.linearize(x, u).A)
    np.testing.assert_array_equal(other.at_rest(0.1, 2.0), system.at_rest(0.1, 2.0))


LOOPS = {
    "lagged": (("actuator_lag",), 100.0, 5.0),
    "filtered": (("sensor_lag",), 60.0, 3.0),
    "coupled": (("flexible_coupling",), 60.0, 2.0),
    "speed servo": (("speed_servo",), 60.0, 0.0),
    "presliding": (("presliding",), 60.0, 3.0),
    "many": (("presliding", "actuator_lag", "sensor_lag", "flexible_coupling", "saturation"), 60.0, 2.0),
}


@pytest.mark.parametrize(("names", "kp", "kd"), LOOPS.values(), ids=LOOPS)
def test_closed_loop_of_plants_that_remember_agrees_with_the_kernel(names, kp, kd):
    plant = with_effects(*names, actuator_lag={"time_constant": 0.01}, sensor_lag={"time_constant": 5e-3})
    expected = simulate_continuous(plant, kp, kd, TIME, STEP, substeps=40)
    response = held_response(closed_loop(plant, kp, kd), TIME, STEP, initial_state="at rest", check=True)
    position, velocity, voltage = response.outputs
    np.testing.assert_allclose(position, expected.measured, rtol=0, atol=1e-6)
    np.testing.assert_allclose(velocity, expected.velocity, rtol=0, atol=1e-5)
    np.testing.assert_allclose(voltage, kp * (0.1 - position) - kd * velocity, rtol=0, atol=1e-12)


def test_closed_loop_with_backlash_stays_within_a_fiftieth_of_the_gap():
    plant = with_effects("backlash")
    expected = simulate_continuous(plant, 60.0, 5.0, TIME, STEP, substeps=40).measured
    response = held_response(closed_loop(plant, 60.0, 5.0), TIME, STEP, initial_state="at rest")
    np.testing.assert_allclose(response.outputs[0], expected, rtol=0, atol=2e-3 / 20)


def test_plant_that_remembers_goes_into_an_interconnection():
    axis = to_control(with_effects("flexible_coupling", "actuator_lag"), name="axis")
    gains = ct.ss(
        [], [], [], [[60, -60, -2]], inputs=["reference", "position", "velocity"], outputs=["voltage"], name="pd"
    )
    joined = ct.interconnect([gains, axis], inputs=["reference"], outputs=["position", "velocity", "voltage"])
    assert joined.state_labels[2:] == [
        "axis_flexible_coupling.position",
        "axis_flexible_coupling.velocity",
        "axis_actuator_lag.command",
    ]
    ours = held_response(closed_loop(with_effects("flexible_coupling", "actuator_lag"), 60, 2), TIME, STEP)
    theirs = held_response(joined, TIME, STEP)
    np.testing.assert_allclose(theirs.outputs, ours.outputs, rtol=0, atol=1e-6)


def test_states_are_the_motors_and_outputs_the_loads_as_the_sensor_shows_them():
    system = to_control(with_effects("flexible_coupling", "sensor_lag"))
    assert system.state_labels == [
        "position",
        "velocity",
        "flexible_coupling.position",
        "flexible_coupling.velocity",
        "sensor_lag.lag",
    ]
    assert system.output_labels == ["position", "velocity"]
    states = [0.1, 0.2, 0.3, 0.4, -0.25]
    assert system.output(0, states, [0.0]).tolist() == [0.55, 0.4]
    loop = closed_loop(with_effects("flexible_coupling", "sensor_lag"), kp=10.0, kd=1.0)
    assert loop.output(0, states, [1.0]).tolist() == [0.55, 0.4, 10.0 * (1.0 - 0.55) - 0.4]
    assert loop.linearize(0.0, 0.0, copy_names=True).state_labels == loop.state_labels


def test_linearised_coupling_has_the_transfer_function_of_two_masses():
    system = to_control(with_effects("flexible_coupling"))
    s = 1j * np.logspace(0, 3, 9)
    load, motor, w = 0.4, 0.6, 2 * np.pi * 12.0
    spring = load * motor * (w**2 + 2 * 0.05 * w * s)
    impedance = motor * s**2 + 6.0 * s + spring
    expected = 1.9 * spring / (impedance * (load * s**2 + spring) - spring**2)
    linear = system.linearize(system.at_rest(), 0.0)[0, 0]
    np.testing.assert_allclose(ct.frequency_response(linear, s.imag).complex, expected, rtol=1e-9)


@every_effect
def test_axis_at_rest_has_caught_up_with_its_input(name):
    plant = with_effects(name, "sensor_lag") if name != "sensor_lag" else with_effects(name)
    for system, held in ((bridged(plant), 2.0), (looped(plant), 0.3)):
        state = system.at_rest(0.2, held)
        assert state[:2].tolist() == [0.2, 0.0]
        assert system.output(0, state, [held])[:2].tolist() == [0.2, 0.0]
        flow = dict(zip(system.state_labels, system.dynamics(0, state, [held]), strict=True))
        # whatever follows something stands still; the axis and an integral may begin to move
        still = {key: rate for key, rate in flow.items() if key not in ("velocity", "speed_servo.position_error")}
        assert still == {key: pytest.approx(0.0, abs=1e-12) for key in still}


def test_axis_at_rest_takes_parameters():
    system = looped(with_effects("actuator_lag"))
    np.testing.assert_allclose(system.at_rest(0.1, 0.3), [0.1, 0.0, 60.0 * (0.3 - 0.1)], rtol=1e-15)
    np.testing.assert_allclose(system.at_rest(0.1, 0.3, params={"kp": 10.0})[2], 10.0 * (0.3 - 0.1), rtol=1e-15)
    drifting = to_control(with_effects("gain_drift", "actuator_lag"))
    assert drifting.at_rest(0.0, 1.0, time=2.0).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("actuator_lag", {"time_constant": 0.0}),
        ("sensor_lag", {"time_constant": 0.0}),
        ("presliding", {"stiffness": 2000.0, "level": 0.0}),
        ("delay", {"time": 0.0}),
    ],
    ids=["actuator_lag", "sensor_lag", "presliding", "delay"],
)
def test_effect_that_is_absent_by_its_values_has_no_states(name, values):
    system = to_control(with_effects(name, **{name: values}))
    assert system.state_labels == ["position", "velocity"]
    assert list(system.params) == ["gain", "damping"]
    parameter, value = next(reversed(values.items()))
    system.dynamics(0, [0, 0], [1.0], params={f"{name}.{parameter}": value})
    with pytest.raises(InputError, match=rf"{name}\.{parameter} cannot become 0\.5: .* build the system from a plant"):
        system.dynamics(0, [0, 0], [1.0], params={f"{name}.{parameter}": 0.5})


# Delays.


def test_delay_is_refused_with_the_way_out():
    for make in (to_control, lambda plant: closed_loop(plant, 60)):
        with pytest.raises(InputError, match=r"delay of 0\.01 s, which .* cannot hold: pass delay_order=3, say"):
            make(with_effects("delay"))
    assert to_control(CART, delay_order=4).state_labels == ["position", "velocity"]


@pytest.mark.parametrize("order", range(1, 11))
def test_delay_is_the_approximation_of_pade(order):
    delayed = to_control(with_effects("delay"), delay_order=order)
    assert delayed.state_labels[2:] == [f"delay.history_{i}" for i in range(order)]
    omega = np.logspace(0, 4, 9)
    for time in (0.01, 0.037):
        linear = delayed.linearize(0.0, 0.0, params={"delay.time": time})[0, 0]
        plain = to_control(with_effects()).linearize(0.0, 0.0)[0, 0]
        ratio = ct.frequency_response(linear, omega).complex / ct.frequency_response(plain, omega).complex
        numerator, denominator = ct.pade(time, order)
        expected = np.polyval(numerator, 1j * omega) / np.polyval(denominator, 1j * omega)
        # 1/s² is lost in what the delay's fast modes round off, the more the faster
        np.testing.assert_allclose(ratio, expected, rtol=0, atol=1e-6)
        exact = omega < order / time
        assert np.abs(np.angle(ratio[exact] * np.exp(1j * omega[exact] * time))).max() < np.radians(4.2)


def test_delay_changed_to_zero_passes_the_command_on():
    delayed, plain = to_control(with_effects("delay"), delay_order=3), to_control(with_effects())
    state = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    rates = delayed.dynamics(0, state, [2.0], params={"delay.time": 0.0})
    np.testing.assert_array_equal(rates, [*plain.dynamics(0, state[:2], [2.0]), 0, 0, 0])


def test_delay_in_a_closed_loop_is_that_of_a_fast_sampled_one():
    period, delay = 1e-4, 0.01
    time = np.arange(10001) * period
    plant = with_effects("delay")
    # what is held for a sample is late by half of one
    sampled = with_effects("delay", delay={"time": delay - period / 2})
    pd = Controller(kp=60.0, kd=2.0, derivative="velocity")
    expected = simulate_loop(sampled, pd, time, np.full(time.size, 0.1)).position[::10]
    loop = closed_loop(plant, 60.0, 2.0, delay_order=5)
    response = held_response(loop, time[::10], np.full(1001, 0.1), initial_state="at rest")
    without = held_response(closed_loop(with_effects(), 60.0, 2.0), time[::10], np.full(1001, 0.1))
    assert np.abs(response.outputs[0] - expected).max() < 2e-6
    assert np.abs(without.outputs[0] - expected).max() > 1e-3


# The guard.


def silently(system, response, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return check_response(system, response, **options)


def test_guard_is_silent_on_good_responses_however_they_begin():
    for names in ((), ("actuator_lag",), ("flexible_coupling", "sensor_lag"), ("coulomb_friction",)):
        system = closed_loop(with_effects(*names), 60.0, 3.0, friction_width=1e-5)
        ours = held_response(system, TIME, STEP, check=True)  # the reference jumps at the first sample
        theirs = ct.input_output_response(
            system, TIME, STEP, initial_state=system.at_rest(0.02, 0.1), solve_ivp_kwargs=SOLVER
        )
        for response in (ours, theirs):
            assert silently(system, response) < (1e-5 if "coulomb_friction" in names else 1e-6)
    moving = held_response(to_control(CART), SECOND, PUSHES, initial_state=[0.1, 0.5], params={"gain": 3.0})
    assert silently(to_control(CART), moving) < 1e-7


def test_guard_does_not_mistake_long_samples_for_wrong_responses():
    system = to_control(with_effects("actuator_lag"))
    coarse = held_response(system, SECOND[::10], PUSHES[::10])
    assert silently(system, coarse) < 1e-6


def test_guard_catches_a_wrong_number():
    system = closed_loop(CART, 60.0)
    response = held_response(system, TIME, STEP)
    response.y[0, 700] += 3e-4
    with pytest.warns(ResponseWarning, match=r"the response is 0\.0003 m off the kernel's at 0\.7 s \(0\.00.* of its"):
        assert check_response(system, response) == pytest.approx(3e-4, rel=1e-3)
    assert silently(system, response, tolerance=1e-2) == pytest.approx(3e-4, rel=1e-3)
    response.y[0, 700:] = np.nan
    with pytest.warns(ResponseWarning, match=r"not finite from 0\.7 s on: the solver returned nonsense"):
        assert check_response(system, response) == np.inf


@pytest.mark.parametrize("method", ["BDF", "Radau"])
def test_guard_catches_the_nonsense_of_stiff_solvers(method):
    system = closed_loop(STICKY, 60.0, friction_width=1e-12)
    response = ct.input_output_response(system, TIME, STEP, solve_ivp_method=method)
    with pytest.warns(ResponseWarning, match="nonsense as success; use held_response or SOLVER, a larger friction_w"):
        assert check_response(system, response) > 1.0


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (
            lambda: held_response(closed_loop(STICKY, 60.0), TIME, STEP, check=True),
            r"most likely because smoothed friction creeps \(friction_width 0\.001\); make friction_width smaller",
        ),
        (
            lambda: held_response(to_control(STICKY), TIME, np.full(TIME.size, 0.2), check=True),
            r"\(where the axis stays at rest\), most likely because smoothed friction creeps",
        ),
        (
            lambda: check_response(to_control(CART), ct.input_output_response(to_control(CART), SECOND, PUSHES)),
            "most likely because the inputs were interpolated, or stepped over; use held_response$",
        ),
        (
            lambda: check_response(
                closed_loop(CART, 60), ct.input_output_response(closed_loop(CART, 60), TIME, STEP), tolerance=1e-5
            ),
            "the solver's tolerances are loose",
        ),
        (
            lambda: held_response(
                to_control(with_effects("delay", delay={"time": 0.3}), delay_order=1),
                TIME,
                np.where(TIME < 0.1, 0.0, 1.0),
                check=True,
            ),
            "Padé's approximation of the delay is too coarse; use a larger delay_order",
        ),
        (
            lambda: judge(
                closed_loop(CART, 60), ct.input_output_response(closed_loop(CART, 60), TIME, STEP), 1e-5, held=True
            ),
            "contacts or an instability magnify what the solver leaves; trust servolens.simulation more",
        ),
        (
            lambda: held_response(closed_loop(LINEAR, -60.0), 20 * TIME[::10], STEP[::10], check=True),
            "there is no response to trust: .* unstable",
        ),
    ],
    ids=["creep", "stuck", "interpolated", "loose", "delay", "magnified", "unstable"],
)
def test_guard_names_the_cause(answer, sentence):
    with pytest.warns(ResponseWarning, match=sentence):
        answer()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: to_control(CART, delay_order=0), "delay_order must be a whole number from 1 to 10, got 0"),
        (lambda: to_control(CART, delay_order=2.5), "delay_order must be a whole number from 1 to 10, got 2.5"),
        (
            lambda: held_response(to_control(CART), TIME, STEP, initial_state=[0.0, 0.0, 0.0]),
            r"initial_state must be one number or have shape \(2,\), got \(3,\)",
        ),
        (
            lambda: held_response(two_axes(), TIME, STEP, initial_state="at rest"),
            "initial_state must be numbers, or \"at rest\" of one plant or loop; got 'at rest'",
        ),
        (
            lambda: held_response(two_axes(), TIME[:2], STEP[:2], check=True),
            "only systems of to_control and closed_loop can be checked, got InterconnectedSystem",
        ),
        (
            lambda: check_response(to_control(with_effects("sensor_lag")), held_response(to_control(CART), TIME, STEP)),
            r"the response is not one of .*: it needs 3 states and 1 input of 1501 samples, got shapes \(2, 1501\)",
        ),
        (
            lambda: held_response(
                bridged(with_effects("actuator_lag")), TIME, STEP, initial_state=[0, 0, 9.0], check=True
            ),
            "the kernel cannot begin as this response does",
        ),
        (
            lambda: held_response(looped(with_effects("delay")), TIME, STEP, initial_state="at rest", check=True),
            "a loop with a delay cannot be checked",
        ),
    ],
    ids=["order", "half an order", "state", "rest of two", "check of two", "foreign", "beginning", "delay"],
)
def test_wrong_use_of_states_and_guard_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize(
    "ask",
    [
        lambda loop, params: held_response(loop, [0.0, 0.1], [0.1, 0.1], params=params),
        lambda loop, params: ct.input_output_response(loop, [0.0, 0.1], [0.1, 0.1], params=params),
        lambda loop, params: loop.linearize([0.0, 0.0], 0.0, params=params),
        lambda loop, params: loop.at_rest(params=params),
    ],
    ids=["held_response", "input_output_response", "linearize", "at_rest"],
)
def test_misspelt_parameter_is_refused_with_the_one_that_may_be_meant(ask):
    loop = closed_loop(Plant(gain=1.9, damping=6.0), kp=60.0)
    with pytest.raises(InputError, match="'gian' is no parameter of this system; did you mean 'gain'"):
        ask(loop, {"gian": 2.0})
    ask(loop, {"gain": 2.0})


def test_parameters_of_the_whole_reach_each_plant_of_an_interconnection():
    plants = [to_control(Plant(gain=1.9, damping=6.0), name=name, prefix=f"{name}.") for name in ("x", "y")]
    both = ct.interconnect(
        plants, inplist=["x.voltage", "y.voltage"], outlist=["x.position", "y.position"], check_unused=False
    )
    drawn = ct.input_output_response(both, [0.0, 0.1], np.ones((2, 2)), params={"x.gain": 3.8})
    assert drawn.outputs[0, -1] == pytest.approx(2.0 * drawn.outputs[1, -1], rel=1e-4)
