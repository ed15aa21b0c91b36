"""Integral action, set-point weight and cascade, against python-control's discrete systems and the laboratory."""

from __future__ import annotations

import pickle

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servolens import lab
from servolens.bridge import digital_controller
from servolens.control_law import controller_voltage, with_history
from servolens.effects import Saturation
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.prediction import prediction_error
from servolens.record import Controller, Record
from servolens.simulation import simulate, simulate_loop

H = 1e-3
CART = Plant(gain=1.9, damping=6.0)
TIME = H * np.arange(1200)
SLOPE = ct.ss([[0.0]], [[1.0]], [[-1.0 / H]], [[1.0 / H]], H)
"""Backward difference."""
SUM = ct.ss([[1.0]], [[1.0]], [[H]], [[H]], H)
"""Of all samples up to this one, times h."""


def sampled_cart():
    """The axis behind a zero-order hold, by python-control."""
    return ct.sample_system(ct.ss([[0.0, 1.0], [0.0, -6.0]], [[0.0], [1.9]], [[1.0, 0.0]], [[0.0]]), H, method="zoh")


def response(system, reference):
    return ct.forced_response(system, TIME, reference).outputs


@pytest.mark.parametrize("share", [1.0, 0.3], ids=["", "filtered"])
@pytest.mark.parametrize("weight", [1.0, 0.4, 0.0])
def test_pid_is_that_of_discrete_systems(weight, share):
    kp, kd, ki = 60.0, 2.0, 300.0
    low_pass = ct.ss([[1.0 - share]], [[share]], [[1.0 - share]], [[share]], H)
    forward, back = kp * weight + ki * SUM, kp + kd * low_pass * SLOPE + ki * SUM
    expected = response(ct.feedback(sampled_cart(), back) * forward, np.full(TIME.size, 0.1))
    controller = Controller(kp=kp, kd=kd, ki=ki, setpoint_weight=weight, derivative_filter=share)
    run = simulate_loop(CART, controller, TIME, np.full(TIME.size, 0.1))
    assert run.position == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("forward", [0.0, 0.8])
def test_cascade_is_that_of_its_blocks(forward):
    kp, kv, kiv = 20.0, 5.0, 60.0
    reference = 0.1 * (1 - np.cos(2 * np.pi * TIME))
    speed_loop = ct.feedback(sampled_cart() * (kv + kiv * SUM), SLOPE)  # from w to y, d = SLOPE y fed back
    expected = response(ct.feedback(speed_loop, kp) * (kp + forward * SLOPE), reference)
    controller = Controller.cascade(kp=kp, kv=kv, kiv=kiv, feedforward_speed=forward)
    run = simulate_loop(CART, controller, TIME, reference)
    assert run.position == pytest.approx(expected, abs=1e-9)


LAWS = {
    "pid": Controller(kp=60, kd=2, ki=300),
    "clamping": Controller(kp=60, kd=2, ki=800, anti_windup="clamping"),
    "back calculation": Controller(kp=60, kd=2, ki=800, anti_windup="back_calculation"),
    "tracking time": Controller(kp=60, ki=400, anti_windup="back_calculation", tracking_time=0.02),
    "weight and slow": Controller(
        kp=60, kd=2, ki=400, setpoint_weight=0.3, control_period=0.004, anti_windup="clamping"
    ),
    "charged": Controller(kp=60, kd=2, ki=400, integral_before=1.5, derivative_on="error"),
    "cascade": Controller.cascade(kp=20, kv=5, kiv=60, feedforward_speed=0.3, anti_windup="clamping"),
    "cascade, back calculation": Controller.cascade(
        kp=20, kv=5, kiv=60, anti_windup="back_calculation", derivative_filter=0.3
    ),
    "own velocity": Controller.cascade(kp=20, kv=5, kiv=60, derivative="velocity", anti_windup="clamping"),
}
each_law = pytest.mark.parametrize("controller", LAWS.values(), ids=LAWS.keys())


def logged(controller, voltage_limit=2.5, feedforward=None, **others):
    settings = {"reference": (0.1, -0.05), "duration": 0.6, "encoder": 1e-5, **others}
    setup = lab.Setup(controller=controller, voltage_limit=voltage_limit, feedforward=feedforward)
    return lab.step_record(lab.Truth(gain=1.9, damping=6.0), setup=setup, **settings)


@each_law
def test_simulation_is_the_laboratory_behind_a_limit(controller):
    record = logged(controller, feedforward=0.2 * np.sin(30 * H * np.arange(1201)))
    assert np.abs(record.voltage).max() > 2.5  # the limit is reached
    run = simulate(CART, record)
    assert run.measured == pytest.approx(record.position, abs=1.1e-5)  # an encoder step where rounding falls apart
    assert np.median(np.abs(run.measured - record.position)) == 0.0
    assert prediction_error(CART, record).percent_error < 0.01


@each_law
def test_law_reproduces_the_laboratory_log(controller):
    record = logged(controller, noise=2e-5, seed=4)
    assert controller_voltage(record) == pytest.approx(record.voltage, abs=1e-9)


@each_law
def test_many_runs_at_once_are_those_one_by_one(controller):
    truth = lab.Truth(gain=1.9, damping=6.0)
    setup = lab.Setup(controller=controller, voltage_limit=3.0)
    runs = lab.step_records(truth, repeats=2, seed=5, duration=0.3, noise=2e-5, encoder=0.0, setup=setup)
    for run in runs:
        assert controller_voltage(run) == pytest.approx(run.voltage, abs=1e-9)


@pytest.mark.parametrize("name", ["pid", "clamping", "charged", "cascade"])
def test_a_slice_goes_on_with_the_integral(name):
    record = logged(LAWS[name], voltage_limit=30.0)
    part = record.slice(0.4, 1.2)
    assert part.controller.integral_before != 0
    unknown = H * LAWS[name].integral_rate * LAWS[name].kd * np.abs(np.diff(record.position)).max() / H
    assert controller_voltage(part)[1:] == pytest.approx(record.voltage[401:], abs=1e-9 + unknown)


def test_an_integral_that_nobody_stated_is_read_off_the_log():
    record = logged(LAWS["pid"], voltage_limit=30.0)
    part = record.slice(0.4, 1.2).with_({"controller": LAWS["pid"]})
    assert np.abs(controller_voltage(part) - part.voltage).min() > 0.1
    known = with_history(part)
    assert controller_voltage(known) == pytest.approx(part.voltage, abs=1e-9)


def by_contract(reference, position, limit, **gains):
    """The cascade as the records' description has it, tick by tick, with clamping."""
    kp, kv, kiv = gains["kp"], gains["kv"], gains["kiv"]
    total, voltages, before = 0.0, [], (reference[0], position[0])
    for r, y in zip(reference, position, strict=True):
        w = kp * (r - y) + gains["feedforward_speed"] * (r - before[0]) / H
        d = (y - before[1]) / H
        grown = H * (w - d)
        asked = kv * (w - d) + kiv * (total + grown)
        if not (abs(asked) > limit and np.sign(asked) == np.sign(kiv * grown)):
            total += grown
        voltages.append(kv * (w - d) + kiv * total)
        before = (r, y)
    return voltages


@given(
    kp=st.floats(1, 100),
    kv=st.floats(0.1, 50),
    kiv=st.floats(0, 500),
    feedforward_speed=st.floats(0, 1),
    limit=st.floats(0.5, 50),
)
def test_cascade_is_its_description_for_any_gains(limit, **gains):
    random = np.random.default_rng(2)
    position, reference = np.cumsum(random.normal(size=80)) * 1e-4, np.linspace(0, 0.02, 80)
    controller = Controller.cascade(**gains, anti_windup="clamping")
    record = Record(
        time=H * np.arange(80), position=position, reference=reference, controller=controller, voltage_limit=limit
    )
    expected = by_contract(reference, position, limit, **gains)
    assert controller_voltage(record) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("way", ["clamping", "back_calculation"])
def test_anti_windup_keeps_the_overshoot_of_a_saturated_step_small(way):
    def overshoot(anti_windup):
        record = logged(
            Controller(kp=60, kd=4, ki=600, anti_windup=anti_windup),
            reference=0.3,
            duration=3.0,
            voltage_limit=3.0,
        )
        return simulate(CART, record).position.max() / 0.3 - 1

    assert overshoot(way) < 0.5 * overshoot("none")


@given(factor=st.floats(0.1, 10))
def test_a_scaled_loop_asks_for_as_much_more(factor):
    record = logged(LAWS["charged"], duration=0.1, voltage_limit=30.0)
    scaled = record.with_({"controller": LAWS["charged"].scaled(factor)})
    assert controller_voltage(scaled) == pytest.approx(factor * controller_voltage(record), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Controller(kp=1, ki=float("nan")), "ki must be finite, got nan"),
        (lambda: Controller(kp=1, ki="2"), "ki must be a number, got '2'"),
        (
            lambda: Controller(kp=1, anti_windup="stop"),
            "anti_windup must be 'none' or 'clamping' or 'back_calculation'",
        ),
        (lambda: Controller(kp=1, tracking_time=0.0), "tracking_time must be positive, got 0.0"),
        (lambda: Controller(kp=1, integral_rate=-1.0), "integral_rate must not be negative, got -1.0"),
        (
            lambda: Controller(kp=1, kd=-1, ki=1, anti_windup="back_calculation"),
            "the default tracking time needs kd and ki, or kp and ki, of one sign; give tracking_time",
        ),
        (lambda: Controller.cascade(kp=1, kv=0), "kv must not be 0: the speed loop of a cascade needs it"),
        (lambda: Controller.cascade(kp=1, kv=1, kiv=-1), "kiv must have the sign of kv, got -1"),
        (
            lambda: digital_controller(LAWS["pid"], 0.0),
            "sample_time must be a finite number larger than 0, got float 0.0",
        ),
        (lambda: digital_controller(LAWS["clamping"], H), "anti_windup = clamping needs the limit of the command"),
        (
            lambda: simulate_loop(CART, LAWS["clamping"], TIME, 0 * TIME),
            "anti_windup = clamping needs the limit of the command; give it",
        ),
    ],
)
def test_wrong_laws_are_refused_with_a_sentence(make, sentence):
    with pytest.raises(InputError) as refused:
        make()
    assert str(refused.value).startswith(sentence)


@each_law
def test_discrete_system_in_an_interconnection_is_the_simulated_loop(controller):
    period = controller.control_period or H
    law = digital_controller(controller, H, limit=2.5, name="law")
    matrices = ([[0.0, 1.0], [0.0, -6.0]], [[0.0], [1.9]], [[1.0, 0.0], [0.0, 1.0]], [[0.0], [0.0]])
    axis = ct.ss(
        ct.sample_system(ct.ss(*matrices), period, method="zoh"),
        name="axis",
        inputs=["given"],
        outputs=["position", "velocity"],
    )
    clip = ct.nlsys(
        None, lambda t, x, u, p: np.clip(u, -2.5, 2.5), inputs=["voltage"], outputs=["given"], dt=period, name="clip"
    )
    loop = ct.interconnect([law, clip, axis], inputs=["reference"], outputs=["position", "voltage"], check_unused=False)
    time = period * np.arange(250)
    reference = np.where(time < 0.1, 0.2, -0.1)
    start = [*law.at_rest(0.0, 0.2), 0.0, 0.0]
    found = ct.input_output_response(loop, time, reference, start)
    fine = H * np.arange(round(period / H) * 249 + 1)
    steps = np.where(fine < 0.1, 0.2, -0.1)
    run = simulate_loop(CART.with_effect(Saturation(limit=2.5)), controller, fine, steps)
    assert found.outputs[0] == pytest.approx(run.position[:: round(period / H)], abs=1e-7)
    assert np.abs(found.outputs[1]).max() > 2.5


def test_discrete_system_of_a_linear_law_has_its_frequency_response_and_travels_between_processes():
    law = digital_controller(Controller(kp=60.0, kd=2.0, ki=300.0), H)
    twin = pickle.loads(pickle.dumps(law))
    x, u = twin.at_rest(0.02, 0.1), np.array([0.1, 0.02])
    assert twin.output(0, x, u) == law.output(0, x, u) == pytest.approx([60 * 0.08 + H * 300 * 0.08])
    at = np.exp(1j * H * np.array([1.0, 10.0, 100.0, 1000.0]))
    back = 60.0 + 2.0 * (1 - 1 / at) / H + 300.0 * H / (1 - 1 / at)
    assert -law.linearize(0, 0)(at)[0, 1] == pytest.approx(back, rel=1e-5)


def test_default_tracking_times():
    assert Controller(kp=60, kd=2, ki=50).tracking == pytest.approx(0.2)
    assert Controller(kp=60, ki=300).tracking == pytest.approx(0.2)
    assert Controller.cascade(kp=20, kv=5, kiv=50).tracking == pytest.approx(0.1)
