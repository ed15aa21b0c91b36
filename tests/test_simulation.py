"""The kernel against closed forms, SciPy, and an event-driven reference."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from servolens.effects import ActuatorLag, Backlash, CoulombFriction, Delay, Saturation, SensorLag, VelocityDecayDamping
from servolens.errors import InputError, NumericalError
from servolens.plant import Plant
from servolens.record import Controller, Record
from servolens.simulation import loop as simulation_loop
from servolens.simulation import simulate, simulate_continuous, simulate_loop, simulate_voltage
from servolens.simulation.rates import substeps_for

LINEAR = Plant(gain=1.8545, damping=6.152)
NLM1 = Plant(gain=1.9165, damping=5.9986, effects=(VelocityDecayDamping(alpha1=17.3264, alpha2=13.1068),))
STICKY = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.4),))


def grid(duration: float, h: float = 1e-3) -> np.ndarray:
    return h * np.arange(round(duration / h) + 1)


def test_sampled_linear_loop_equals_the_matrix_exponential() -> None:
    time = grid(1.0)
    run = simulate_loop(LINEAR, Controller(kp=60.0, kd=3.0), time, np.full(time.size, 0.1))
    step = expm(np.array([[0, 1, 0], [0, -LINEAR.damping, LINEAR.gain], [0, 0, 0]]) * 1e-3)
    state, last, expected = np.zeros(2), 0.0, []
    for _ in time:
        expected.append(state[0])
        voltage = 60.0 * (0.1 - state[0]) - 3.0 * (state[0] - last) / 1e-3
        last = state[0]
        state = (step @ [*state, voltage])[:2]
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=1e-8)


def test_controller_answers_to_an_error_of_the_sensor_as_the_encoder_rounds_it() -> None:
    time, resolution = grid(1.0), 2e-5
    error = 5e-6 * np.random.default_rng(3).standard_normal(time.size)
    loop = {"resolution": resolution, "sensor_error": error}
    run = simulate_loop(LINEAR, Controller(kp=60.0, kd=3.0), time, np.full(time.size, 0.1), **loop)
    step = expm(np.array([[0, 1, 0], [0, -LINEAR.damping, LINEAR.gain], [0, 0, 0]]) * 1e-3)
    state, last = np.zeros(2), None
    for k in range(time.size):
        assert run.position[k] == pytest.approx(state[0], abs=1e-8)
        seen = run.measured[k]  # one of the two steps beside the position: which, may hang on the last digit
        assert seen == pytest.approx(resolution * np.round((state[0] + error[k]) / resolution), abs=1.01 * resolution)
        assert abs(seen - state[0] - error[k]) <= 0.5 * resolution + 1e-8
        voltage = 60.0 * (0.1 - seen) - 3.0 * (seen - (seen if last is None else last)) / 1e-3
        last = seen
        state = (step @ [*state, voltage])[:2]


def test_disturbance_of_another_length_is_refused() -> None:
    time = grid(0.1)
    for name, called in (("acceleration", "acceleration"), ("sensor_error", "sensor's error")):
        wrong, step = {name: np.zeros(107)}, np.full(time.size, 0.1)
        record = Record(time=time, position=0.0 * time, reference=step, controller=Controller(kp=60.0))
        with pytest.raises(InputError, match=f"time has 101 samples, the {called} 107"):
            simulate_loop(LINEAR, Controller(kp=60.0), time, step, **wrong)
        with pytest.raises(InputError, match=f"time has 101 samples, the {called} 107"):
            simulate(LINEAR, record, **wrong)


def test_continuous_loop_equals_the_damped_oscillator() -> None:
    time = grid(1.0)
    run = simulate_continuous(LINEAR, 60.0, 2.0, time, np.full(time.size, 0.1))
    c, k = LINEAR.damping + LINEAR.gain * 2.0, LINEAR.gain * 60.0
    w = np.sqrt(k - c**2 / 4)
    expected = 0.1 * (1 - np.exp(-c * time / 2) * (np.cos(w * time) + c / (2 * w) * np.sin(w * time)))
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=3e-8)


def test_continuous_loop_feeds_back_and_reports_what_the_lagging_sensor_shows() -> None:
    kp, kd, lag, time = 60.0, 2.0, 0.01, grid(0.5)
    lagging = LINEAR.with_effect(SensorLag(time_constant=lag))
    run = simulate_continuous(lagging, kp, kd, time, np.full(time.size, 0.1), substeps=8)
    b, c = LINEAR.gain, LINEAR.damping
    rates = np.array([[0, 1, 0, 0], [0, -c - b * kd, -b * kp, b * kp * 0.1], [1 / lag, 0, -1 / lag, 0], [0, 0, 0, 0]])
    y, v, shown, _ = np.array([expm(rates * t) @ [0, 0, 0, 1] for t in time]).T
    np.testing.assert_allclose(run.position, y, rtol=0, atol=3e-8)
    np.testing.assert_allclose(run.measured, shown, rtol=0, atol=3e-8)
    np.testing.assert_allclose(run.voltage, kp * (0.1 - shown) - kd * v, rtol=0, atol=1e-5)
    assert np.abs(kp * (y - shown)).max() > 0.1  # volts: what the true position would give is something else


GENTLE = Plant(gain=1.9, damping=4.0, effects=(VelocityDecayDamping(alpha1=4.0, alpha2=2.0),))


@pytest.mark.parametrize("plant", [GENTLE, STICKY, LINEAR], ids=["decay", "coulomb", "linear"])
def test_error_falls_at_least_with_the_square_of_the_step(plant: Plant) -> None:
    time = grid(0.6, 4e-3)
    reference = np.full(time.size, 0.1)
    runs = {n: simulate_continuous(plant, 80.0, 0.0, time, reference, substeps=n).position for n in (2, 4, 8, 512)}
    errors = [np.abs(runs[n] - runs[512]).max() for n in (2, 4, 8)]
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5


def test_coulomb_friction_agrees_with_an_event_driven_reference() -> None:
    level, start = 0.4, 0.0
    time = grid(0.8)
    voltage = np.where(time < 0.2, 6.0, -1.2)
    run = simulate_voltage(STICKY, time, voltage)
    times, states, t, state = [np.zeros(1)], [np.zeros((2, 1))], start, np.zeros(2)
    for end, u in ((0.2, 6.0), (0.8, -1.2)):
        while t < end - 1e-12:
            push = 1.9 * u - 6.0 * state[1]
            d = np.sign(state[1]) if abs(state[1]) > 1e-12 else (np.sign(push) if abs(push) > level else 0.0)
            if d == 0.0:
                times.append(np.array([end]))
                states.append(np.array([[state[0]], [0.0]]))
                t, state = end, np.array([state[0], 0.0])
                continue

            def reversal(_: float, x: np.ndarray) -> float:
                return x[1]

            reversal.terminal, reversal.direction = True, -d  # type: ignore[attr-defined]  # SciPy's way
            part = solve_ivp(
                lambda _, x, u=u, d=d: [x[1], 1.9 * u - 6.0 * x[1] - level * d],
                (t, end),
                state,
                events=reversal,
                rtol=1e-12,
                atol=1e-14,
                dense_output=True,
                max_step=0.01,
            )
            t, state = part.t[-1], part.y[:, -1]
            if part.status == 1:
                state[1] = 0.0
            times.append(part.t)
            states.append(part.y)
    final = states[-1][0, -1]
    assert abs(run.position[-1] - final) < 1e-9


def test_a_kick_within_one_sample_is_followed() -> None:
    plant = Plant(gain=1.91, damping=3.799, effects=(VelocityDecayDamping(alpha1=15.2528, alpha2=5.9934),))
    time = grid(0.3)
    voltage = np.where(np.arange(time.size) == 100, 500.0, 0.0)
    run = simulate_voltage(plant, time, voltage)

    def motion(_: float, x: np.ndarray, u: float) -> list[float]:
        return [x[1], 1.91 * u - (3.799 + 15.2528 * np.exp(-5.9934 * abs(x[1]))) * x[1]]

    state = np.zeros(2)
    for start, end, u in ((0.1, 0.101, 500.0), (0.101, 0.3, 0.0)):
        state = solve_ivp(motion, (start, end), state, args=(u,), rtol=1e-12, atol=1e-14, method="DOP853").y[:, -1]
    assert run.position[-1] == pytest.approx(state[0], abs=1e-6)


def test_an_axis_below_breakaway_does_not_move_one_bit() -> None:
    time = grid(1000.0)
    voltage = 0.2 * np.sin(np.arange(time.size) * 0.1)  # 0.38 < 0.4
    run = simulate_voltage(STICKY, time, voltage, start=(0.123456789, 0.0))
    assert np.all(run.position == 0.123456789)
    assert np.all(run.velocity == 0.0)


def test_an_effect_of_size_zero_changes_nothing() -> None:
    time = grid(0.5)
    reference = np.full(time.size, 0.1)
    loop = Controller(kp=80.0, kd=1.0)
    plain = simulate_loop(LINEAR, loop, time, reference, substeps=2).position
    for effect in (CoulombFriction(level=0.0), VelocityDecayDamping(alpha1=0.0, alpha2=5.0), Saturation(limit=1e9)):
        run = simulate_loop(LINEAR.with_effect(effect), loop, time, reference, substeps=2)
        np.testing.assert_allclose(run.position, plain, rtol=0, atol=1e-15)


@settings(max_examples=25, deadline=None)
@given(
    level=st.floats(0.0, 3.0),
    velocity=st.floats(-1.0, 1.0),
    damping=st.floats(0.0, 20.0),
)
def test_friction_never_adds_energy(level: float, velocity: float, damping: float) -> None:
    plant = Plant(gain=1.0, damping=damping, effects=(CoulombFriction(level=level),))
    time = grid(0.3)
    run = simulate_voltage(plant, time, np.zeros(time.size), start=(0.0, velocity))
    assert np.all(np.diff(run.velocity**2) <= 1e-15)


def test_saturation_clips_what_reaches_the_axis_and_not_what_is_asked() -> None:
    time = grid(0.3)
    limited = LINEAR.with_effect(Saturation(limit=2.0))
    run = simulate_loop(limited, Controller(kp=60.0), time, np.full(time.size, 0.1))
    assert run.voltage[0] == pytest.approx(6.0)
    driven = simulate_voltage(LINEAR, time, np.clip(run.voltage, -2.0, 2.0))
    np.testing.assert_allclose(run.position, driven.position, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("controller", "law"),
    [
        (Controller(kp=50.0, kd=2.0, derivative_filter=0.3), "filter"),
        (Controller(kp=50.0, kd=2.0, derivative_window=2), "window"),
        (Controller(kp=50.0, kd=2.0, derivative_on="error"), "error"),
        (Controller(kp=50.0, kd=2.0, control_period=5e-3), "period"),
    ],
    ids=["filter", "window", "on error", "slower loop"],
)
def test_controller_law_is_that_of_its_description(controller: Controller, law: str) -> None:
    time = grid(0.5)
    reference = np.where(time < 0.25, 0.1, 0.0)
    run = simulate_loop(NLM1, controller, time, reference, resolution=1e-5)
    y, ratio, d, asked = run.measured, 5 if law == "period" else 1, 0.0, 0.0
    for k in range(time.size):
        if k % ratio == 0:
            before = max(k - controller.derivative_window * ratio, 0)
            span = controller.derivative_window * ratio * 1e-3
            raw = (y[k] - y[before]) / span
            if law == "error":
                raw -= (reference[k] - reference[before]) / span
            d += controller.derivative_filter * (raw - d)
            asked = 50.0 * (reference[k] - y[k]) - 2.0 * d
        assert run.voltage[k] == pytest.approx(asked, abs=1e-9)


def test_lost_samples_do_not_stop_the_loop() -> None:
    time = grid(0.6)
    reference = np.full(time.size, 0.1)
    whole = simulate_loop(NLM1, Controller(kp=60.0), time, reference)
    keep = np.ones(time.size, dtype=bool)
    keep[100:140] = False
    record = Record(
        time=time[keep], position=whole.position[keep], reference=reference[keep], controller=Controller(kp=60.0)
    )
    np.testing.assert_allclose(simulate(NLM1, record).position, whole.position[keep], rtol=0, atol=1e-9)


def test_a_known_voltage_limit_of_the_record_saturates_the_plant() -> None:
    time = grid(0.4)
    record = Record(
        time=time,
        position=np.zeros(time.size),
        reference=np.full(time.size, 0.1),
        controller=Controller(kp=60.0),
        voltage_limit=2.0,
    )
    limited = simulate_loop(LINEAR.with_effect(Saturation(limit=2.0)), Controller(kp=60.0), time, np.full(401, 0.1))
    np.testing.assert_array_equal(simulate(LINEAR, record).position, limited.position)


@pytest.mark.parametrize("driven", [False, True], ids=["closed loop", "driven"])
@pytest.mark.parametrize(("own", "stated"), [(3.0, 2.0), (2.0, 3.0), (2.0, 2.0), (2.0, None)])
def test_the_smaller_of_two_limits_counts(own: float, stated: float | None, driven: bool) -> None:
    time, loop = grid(0.4), Controller(kp=60.0)
    given = {"time": time, "position": 0 * time, "reference": 0 * time + 0.1, "controller": loop}
    record = Record(**given, voltage=4.0 - 10.0 * time, voltage_limit=stated)
    plant = LINEAR.with_effect(Saturation(limit=own)).with_effect(CoulombFriction(level=0.2))
    limited = LINEAR.with_effect(Saturation(limit=2.0)).with_effect(CoulombFriction(level=0.2))
    expected = simulate(limited, record.with_({"voltage_limit": None}), voltage_driven=driven).position
    np.testing.assert_allclose(simulate(plant, record, voltage_driven=driven).position, expected, rtol=0, atol=1e-15)


def test_unstable_loop_is_a_numerical_error_that_names_the_plant() -> None:
    time = grid(60.0, 0.05)
    with pytest.raises(NumericalError, match="diverges"):
        simulate_loop(LINEAR, Controller(kp=5e4), time, np.full(time.size, 0.1))


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_sample_that_is_not_finite_is_no_unstable_loop(wrong: float) -> None:
    time = grid(0.1)
    given = np.where(time == time[20], wrong, 0.1)
    with pytest.raises(InputError, match="not finite"):
        simulate_loop(LINEAR, Controller(kp=60.0), time, given)
    with pytest.raises(InputError, match="not finite"):
        simulate_voltage(LINEAR, time, given)


def test_control_period_must_be_whole_samples() -> None:
    time = grid(0.1)
    with pytest.raises(InputError, match="the longer must be a whole multiple of the shorter"):
        simulate_loop(LINEAR, Controller(kp=1.0, control_period=2.5e-3), time, np.zeros(time.size))


def test_voltage_drive_without_a_logged_voltage_is_refused() -> None:
    record = Record(time=[0.0, 1.0], position=[0.0, 0.1], reference=[0.1, 0.1], controller=Controller(kp=1.0))
    with pytest.raises(InputError, match="no voltage is logged"):
        simulate(LINEAR, record, voltage_driven=True)


PROGRAM = """
import numpy as np
from servolens.plant import Plant
from servolens.effects import CoulombFriction
from servolens.simulation import simulate_voltage
plant = Plant(gain=2.0, damping=3.0, effects=(CoulombFriction(level=0.5),))
run = simulate_voltage(plant, np.arange(50) * 1e-3, np.ones(50))
print(repr(float(run.position[-1])))
"""


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["shared", "unwritable"])
def test_kernel_cache_is_safe_with_many_processes_and_needs_no_writable_folder(tmp_path, folder: str) -> None:
    cache = tmp_path / "cache"
    if folder == "unwritable":
        cache.write_text("a file where the folder should be")
    environment = {**os.environ, "SERVOLENS_CACHE": str(cache)}
    running = [
        subprocess.Popen([sys.executable, "-c", PROGRAM], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    answers = {process.communicate(timeout=300)[0] for process in running}
    assert [process.returncode for process in running] == [0, 0, 0]
    assert len(answers) == 1
    t, a, c = 0.049, 1.5, 3.0
    assert float(answers.pop()) == pytest.approx(a / c * (t - (1 - np.exp(-c * t)) / c), abs=1e-11)


@pytest.mark.slow
def test_a_damaged_cache_is_replaced(tmp_path) -> None:
    environment = {**os.environ, "SERVOLENS_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", PROGRAM]
    first = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    damaged = [*tmp_path.iterdir()]
    assert sorted(path.name.partition("-")[0] for path in damaged) == ["elementary", "plant", "rule", "stepping"]
    for path in damaged:
        path.write_bytes(path.read_bytes()[:40])
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert again.stdout == first.stdout


@pytest.mark.parametrize("closed", [False, True])
def test_nothing_is_applied_before_where_the_record_says_so(closed):
    time = np.arange(301) * 1e-3
    plant = Plant(gain=2.0, damping=0.0).with_effect(Delay(time=0.0305))
    held = 3.0 + np.zeros(time.size)
    if closed:  # so slow that the voltage stays what it is
        record = Record(time=time, position=0 * time, reference=3e9 + 0 * time, controller=Controller(kp=1e-9))
    else:
        record = Record(time=time, position=0 * time, voltage=held)
    always = simulate(plant, record).position
    then = simulate(plant, record.with_({"voltage_before": 0.0})).position
    push = 2.0 * 3.0
    np.testing.assert_allclose(always, 0.5 * push * time**2, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(then, 0.5 * push * np.maximum(time - 0.0305, 0.0) ** 2, rtol=1e-8, atol=1e-12)


def test_lag_begins_at_what_was_applied_before():
    time, lag = np.arange(201) * 1e-3, 0.02
    plant = Plant(gain=1.0, damping=0.0).with_effect(ActuatorLag(time_constant=lag))
    velocity = simulate_voltage(plant, time, np.ones(time.size), before=-1.0).velocity
    np.testing.assert_allclose(velocity, time - 2.0 * lag * (1.0 - np.exp(-time / lag)), atol=1e-9)


def test_axis_with_play_that_rests_on_a_flank_needs_no_more_steps_than_one_in_motion(monkeypatch):
    """It is on either side of the contact by rounding alone, which is no reason to split steps."""
    loose = Plant(gain=1.8, damping=6.0, effects=(Backlash(gap=1e-3, load_share=0.3),))
    time = 1e-3 * np.arange(5001)
    monkeypatch.setattr(simulation_loop, "ANY_NUMBER", 1.2 * 4 * time.size)
    run = simulate_loop(loose, Controller(kp=100.0, kd=11.2), time, np.full(time.size, 0.1), substeps=4)
    assert abs(run.position[-1] - 0.1) < 1e-12


def test_motion_that_has_nearly_faded_is_reversed_in_few_steps(monkeypatch):
    """What a lag remembers is a ramp in a step, which tells a reversal at its very beginning too early."""
    gain, damping, lag = 45.0, 23.0, 0.005
    plant = Plant(gain=gain, damping=damping, effects=(ActuatorLag(time_constant=lag),))
    time = 1e-3 * np.arange(3001)
    edges = ((0.01, 1.0), (0.5, -1.0), (2.5, -1.0))  # up, down to 0, and long after that down again
    voltage = sum(step * (time >= at) for at, step in edges)
    monkeypatch.setattr(simulation_loop, "ANY_NUMBER", 2.0 * substeps_for(plant, 1e-3) * time.size)
    run = simulate_voltage(plant, time, voltage, before=0.0)

    def answer(since):
        t = np.maximum(since, 0.0)
        slow, quick = np.exp(-damping * t) / damping, lag * np.exp(-t / lag)
        return gain * (1.0 / damping - (slow - quick) / (1.0 - damping * lag)) * (since >= 0.0)

    wanted = sum(step * answer(time - time[round(at / 1e-3)]) for at, step in edges)
    np.testing.assert_allclose(run.velocity, wanted, atol=1e-7)
