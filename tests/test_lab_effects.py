"""Every effect of the virtual laboratory against closed forms and SciPy; never against servolens' own simulator."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from servolens import lab
from servolens.control_law import controller_voltage
from servolens.errors import InputError, NumericalError
from servolens.lab import loop
from servolens.lab.laws import LAWS
from servolens.lab.motion import lag_weights
from servolens.record import Controller

GAIN, DAMPING = 1.9, 6.0
H = 1e-3
TYPICAL = {
    "actuator_lag": {"time_constant": 0.003},
    "asymmetric_damping": {"damping_difference": 3.0},
    "asymmetric_friction": {"level_positive": 0.3, "level_negative": 0.2},
    "backlash": {"gap": 1e-3, "load_share": 0.3},
    "cogging": {"amplitude": 0.3, "pitch": 0.004, "phase": 0.3},
    "constant_force": {"acceleration": 0.2},
    "coulomb_friction": {"level": 0.3},
    "dead_zone": {"width": 0.1},
    "delay": {"time": 0.0024},
    "end_stop": {"low": -0.01, "high": 0.07},
    "flexible_coupling": {"frequency": 30.0, "damping_ratio": 0.03, "load_ratio": 0.4},
    "force_limit": {"acceleration": 4.0},
    "friction_map": {
        **{f"positive_{i}": level for i, level in enumerate((0.3, 0.1, 0.5, 0.2, 0.4))},
        **{f"negative_{i}": level for i, level in enumerate((0.2, 0.6, 0.1, 0.3, 0.0))},
        "low": -0.01,
        "high": 0.09,
    },
    "gain_drift": {"rate": 0.1},
    "hardening_spring": {"cubic_stiffness": 200.0},
    "load_friction": {"share": 0.1},
    "pendulum_gravity": {"amplitude": 0.5, "phase": 0.3},
    "periodic_disturbance": {"amplitude": 0.4, "frequency": 17.0, "phase": 0.0},
    "position_friction": {"level": 0.3, "centre": 0.06, "width": 0.005},
    "presliding": {"stiffness": 1e5, "level": 0.3},
    "quadratic_drag": {"drag": 3.0},
    "return_spring": {"stiffness": 3.0},
    "saturation": {"limit": 4.0},
    "sensor_lag": {"time_constant": 0.004},
    "speed_servo": {"speed_per_volt": 0.1, "proportional": 19.0, "integral": 50.0},
    "stribeck_friction": {"level": 0.1, "static_excess": 0.2, "stribeck_speed": 0.01},
    "velocity_decay_damping": {"alpha1": 17.0, "alpha2": 13.0},
}
EVERYTHING = {
    "everything and backlash": {name: p for name, p in TYPICAL.items() if name != "flexible_coupling"},
    "everything and coupling": {name: p for name, p in TYPICAL.items() if name != "backlash"},
}
COMBINATIONS = {name: {name: p} for name, p in TYPICAL.items()} | EVERYTHING


def axis(damping=DAMPING, gain=GAIN, **effects):
    return lab.Truth(gain=gain, damping=damping, effects=effects)


def driven(truth, volts, *, start=0.0, length_unit="m", **settings):
    """Log an axis that is driven by the voltage at each sample, without a loop; with its velocity."""
    loop_off = Controller(kp=0.0, derivative="velocity")
    rig = lab.Setup(
        controller=loop_off, trajectory=np.zeros(len(volts)), feedforward=volts, start=start, length_unit=length_unit
    )
    return lab.step_record(truth, setup=rig, **{"encoder": 0.0, **settings})


def pulses(*levels_and_samples):
    return np.concatenate([np.full(n, level) for level, n in levels_and_samples])


def replay(record, rates, state, *, method="DOP853"):
    """Integrate ``rates(t, state, volts)`` by SciPy through the logged, held voltage; state at the samples."""
    jumps = np.flatnonzero(np.diff(record.voltage)) + 1
    edges = [0, *jumps.tolist(), len(record) - 1]
    parts = [np.array([state], dtype=float).T]
    for a, b in itertools.pairwise(edges):
        if b > a:
            t, volts = record.time[a : b + 1], record.voltage[a]
            done = solve_ivp(
                lambda t, s, volts=volts: rates(t, s, volts),
                (t[0], t[-1]),
                parts[-1][:, -1],
                method=method,
                t_eval=t[1:],
                rtol=1e-12,
                atol=1e-14,
            )
            parts.append(done.y)
    return np.concatenate(parts, axis=1)


# forces that are subtracted, of position, velocity and time
SMOOTH_FORCES = {
    "asymmetric_damping": lambda x, v, t, p: p["damping_difference"] / 2 * abs(v),
    "cogging": lambda x, v, t, p: p["amplitude"] * np.sin(2 * np.pi * x / p["pitch"] + p["phase"]),
    "constant_force": lambda x, v, t, p: p["acceleration"],
    "hardening_spring": lambda x, v, t, p: p["cubic_stiffness"] * x**3,
    "pendulum_gravity": lambda x, v, t, p: p["amplitude"] * np.sin(x + p["phase"]),
    "periodic_disturbance": lambda x, v, t, p: p["amplitude"] * np.sin(2 * np.pi * p["frequency"] * t + p["phase"]),
    "quadratic_drag": lambda x, v, t, p: p["drag"] * v * abs(v),
    "return_spring": lambda x, v, t, p: p["stiffness"] * x,
    "velocity_decay_damping": lambda x, v, t, p: p["alpha1"] * np.exp(-p["alpha2"] * abs(v)) * v,
}


@pytest.mark.parametrize("name", SMOOTH_FORCES)
def test_forces_agree_with_scipy_through_a_reversal(name):
    p = TYPICAL[name]
    record = driven(axis(**{name: p}), pulses((5.0, 200), (-5.0, 300), (2.0, 100)))
    force = SMOOTH_FORCES[name]
    expected, speed = replay(
        record, lambda t, s, volts: [s[1], GAIN * volts - DAMPING * s[1] - force(s[0], s[1], t, p)], [0.0, 0.0]
    )
    assert speed.min() < -0.1 < 0.1 < speed.max()
    assert np.abs(record.position - expected).max() < 1e-9


def test_small_pendulum_swings_at_the_root_of_its_gravity():
    truth = axis(damping=0.0, pendulum_gravity={"amplitude": 30.0, "phase": 0.0})
    record = driven(truth, np.zeros(1001), start=1e-4, length_unit="rad")
    # the period grows by (amplitude/4)² = 6e-10, and its phase is 5.5 rad at the end
    np.testing.assert_allclose(record.position, 1e-4 * np.cos(np.sqrt(30.0) * record.time), rtol=0, atol=1e-12)


def test_drifting_gain_is_a_cubic_in_time():
    record = driven(axis(damping=0.0, gain_drift={"rate": 0.5}), np.full(501, 3.0))
    t = record.time
    np.testing.assert_allclose(record.position, GAIN * 3.0 * (t**2 / 2 + 0.5 * t**3 / 6), rtol=0, atol=1e-14)


BOTH_FRICTIONS = {
    "coulomb_friction": {"level": 0.5},
    "asymmetric_friction": {"level_positive": 0.3, "level_negative": 0.0},
}


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
@pytest.mark.parametrize(
    ("effects", "up", "down"),
    [
        ({"coulomb_friction": {"level": 0.8}}, 0.8, 0.8),
        ({"asymmetric_friction": {"level_positive": 0.8, "level_negative": 0.3}}, 0.8, 0.3),
        (BOTH_FRICTIONS, 0.8, 0.5),
    ],
    ids=["coulomb", "asymmetric", "both"],
)
def test_dry_friction_stops_after_the_distance_of_its_level(effects, up, down, sign):
    level = up if sign > 0 else down
    record = driven(axis(damping=0.0, **effects), sign * pulses((2.0, 200), (0.0, 3000)))
    push = GAIN * 2.0 - level
    travel = push * 0.2**2 / 2 * (1 + push / level)
    assert record.position[-1] == pytest.approx(sign * travel, abs=1e-12)
    assert np.unique(record.position[-50:]).size == 1


@pytest.mark.parametrize(
    ("effects", "held"),
    [
        ({"stribeck_friction": {"level": 0.4, "static_excess": 0.5, "stribeck_speed": 0.01}}, 0.9),
        ({"stribeck_friction": {"level": 0.4, "static_excess": -0.3, "stribeck_speed": 0.01}}, 0.1),
        ({"position_friction": {"level": 0.7, "centre": 0.0, "width": 0.01}}, 0.7),
        ({"position_friction": {"level": 0.7, "centre": 0.01, "width": 0.01}}, 0.7 * np.exp(-1.0)),
        ({"coulomb_friction": {"level": 0.2}, "position_friction": {"level": 0.5, "centre": 0.0, "width": 1.0}}, 0.7),
    ],
    ids=["stribeck", "negative excess", "tight spot", "beside it", "two"],
)
def test_axis_breaks_away_where_the_push_exceeds_what_holds_it(effects, held):
    for share, moves in ((0.999, False), (1.001, True)):
        for sign in (1.0, -1.0):
            record = driven(axis(**effects), np.full(200, sign * share * held / GAIN))
            assert (record.position[-1] != 0.0) == moves
            assert sign * record.position[-1] >= 0.0


@pytest.mark.parametrize("name", ["stribeck_friction", "position_friction"])
def test_shaped_friction_agrees_with_scipy_until_it_stops(name):
    p = {"stribeck_speed": 0.02, "static_excess": 0.5, "level": 0.4, "centre": 0.06, "width": 0.005}
    p = {key: p[key] for key in TYPICAL[name]}
    level = {
        "stribeck_friction": lambda x, v: 0.4 + 0.5 * np.exp(-v / 0.02),
        "position_friction": lambda x, v: 0.4 * np.exp(-(((x - 0.06) / 0.005) ** 2)) + 0.4,
    }[name]
    extra = {"coulomb_friction": {"level": 0.4}} if name == "position_friction" else {}
    record = driven(axis(damping=1.0, **{name: p}, **extra), pulses((2.0, 200), (0.0, 1500)))

    def coasting(t, s, volts):
        return [s[1], GAIN * volts - 1.0 * s[1] - level(*s)]

    def stopped(t, s, volts):
        return s[1]

    stopped.terminal = True
    pushed = solve_ivp(coasting, (0, 0.2), [0.0, 0.0], args=(2.0,), method="DOP853", rtol=1e-12, atol=1e-14)
    coasted = solve_ivp(
        coasting, (0, 2), pushed.y[:, -1], args=(0.0,), method="DOP853", rtol=1e-12, atol=1e-14, events=stopped
    )
    assert record.position[200] == pytest.approx(pushed.y[0, -1], abs=1e-9)
    assert record.position[-1] == pytest.approx(coasted.y[0, -1], abs=1e-9)
    assert record.position[-1] == record.position[-2]


@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7])
def test_dahl_friction_takes_the_energy_of_its_closed_form(stiffness):
    level, push = 0.5, GAIN * 2.0
    record = driven(axis(damping=0.0, presliding={"stiffness": stiffness, "level": level}), np.full(300, 2.0))
    x = record.position
    energy = (push - level) * x + level**2 / stiffness * -np.expm1(-stiffness * x / level)
    # 1e-8 m at the end of a move to 0.14 m, where v is 1 m/s and the push 3.3 m/s²
    np.testing.assert_allclose(record.velocity**2 / 2, energy, rtol=0, atol=3e-8)


def test_dahl_friction_agrees_with_scipy_through_reversals():
    p = {"stiffness": 1e4, "level": 0.5}
    record = driven(axis(presliding=p), pulses((0.5, 100), (-0.4, 100), (0.1, 100)))

    def rates(t, s, volts):
        _x, v, f = s
        return [v, GAIN * volts - DAMPING * v - f, p["stiffness"] * (v - abs(v) * f / p["level"])]

    expected, speed, _ = replay(record, rates, [0.0, 0.0, 0.0], method="LSODA")
    assert np.count_nonzero(np.diff(np.sign(speed[1:]))) >= 4
    assert np.abs(record.position - expected).max() < 1e-8


def test_dahl_contact_is_a_spring_before_it_slips():
    record = driven(axis(damping=0.0, presliding={"stiffness": 1e4, "level": 50.0}), np.full(60, 0.01))
    push = 0.01 * GAIN
    expected = push / 1e4 * (1 - np.cos(100.0 * record.time))
    # half a swing bends by 2·push/σ and slips by a share of about push/F of that: twice that share in time and size
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=4 * push / 50.0 * 2 * push / 1e4)


def test_growing_disturbance_breaks_the_axis_away_at_its_instant():
    effects = {
        "coulomb_friction": {"level": 0.5},
        "periodic_disturbance": {"amplitude": 1.0, "frequency": 3.1, "phase": 0.0},
    }
    record = driven(axis(damping=0.0, **effects), np.zeros(120))
    w = 2 * np.pi * 3.1
    away = np.arcsin(0.5) / w
    assert away % (H / 4) > 1e-5, "the instant must lie within a substep"
    s = np.maximum(record.time - away, 0.0)
    # x'' = F − A sin(w t) from rest
    sines = np.sin(w * (away + s)) - np.sin(w * away) - w * s * np.cos(w * away)
    np.testing.assert_allclose(record.position, 0.5 * s**2 / 2 + sines / w**2, rtol=0, atol=1e-12)


def test_lagged_voltage_breaks_the_axis_away_at_its_instant():
    lag, volts, level = 0.02, 3.0, 2.0
    truth = axis(damping=0.0, coulomb_friction={"level": level}, actuator_lag={"time_constant": lag})
    record = driven(truth, pulses((0.0, 5), (volts, 100)))
    push = GAIN * volts
    away = -lag * np.log(1 - level / push)
    s = np.maximum(record.time - 5 * H - away, 0.0)
    rest = push - level
    expected = rest * (s**2 / 2 - lag * s + lag**2 * -np.expm1(-s / lag))
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("time", [0.0024, 0.003, 0.0, 4e-5, 0.0201])
def test_delayed_step_is_the_step_moved(time):
    record = driven(axis(delay={"time": time}), pulses((0.0, 5), (3.0, 100)))
    s = np.maximum(record.time - 5 * H - time, 0.0)
    expected = GAIN * 3.0 / DAMPING * (s + np.expm1(-DAMPING * s) / DAMPING)
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["delay", "actuator_lag"])
def test_first_voltage_was_applied_before_the_record(name):
    late, prompt = (driven(axis(**effects), np.full(50, 3.0)) for effects in ({name: TYPICAL[name]}, {}))
    np.testing.assert_allclose(late.position, prompt.position, rtol=0, atol=1e-14)


@pytest.mark.parametrize("lag", [0.1, 3e-3, 2e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("name", ["actuator_lag", "sensor_lag"])
def test_lagged_step_is_the_closed_form_however_short_the_lag(name, lag):
    record = driven(axis(damping=0.0, **{name: {"time_constant": lag}}), pulses((0.0, 5), (3.0, 200)))
    s = np.maximum(record.time - 5 * H, 0.0)
    # of ½ s² behind a first-order lag, wherever in the chain that is
    expected = GAIN * 3.0 * (s**2 / 2 - lag * s + lag**2 * -np.expm1(-s / lag))
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-9)


def test_lag_on_either_side_of_a_linear_plant_gives_the_same_loop():
    # the voltage is held before both: the loop from command to measurement is one and the same
    first, second = (
        lab.step_record(
            axis(**{name: {"time_constant": 0.004}}), 60, encoder=0.0, duration=0.5, setup=lab.Setup(rest=0.01)
        )
        for name in ("actuator_lag", "sensor_lag")
    )
    np.testing.assert_allclose(first.position, second.position, rtol=0, atol=1e-9)


@pytest.mark.parametrize("z", [1e-12, 1e-3, 0.7, 1.0, 1.0001, 40.0])
def test_weights_of_the_sensor_carry_cubics_exactly(z):
    for power, weight in enumerate(lag_weights(z)):
        # lag and the chain s^p, p s^(p-1), …, p! of integrators, by the matrix exponential
        system = np.diag(np.r_[z, np.arange(power, 0.0, -1.0)], 1)
        system[0, 0] = -z
        assert weight == pytest.approx(expm(system)[0, -1], rel=1e-10, abs=1e-16)


def test_dead_zone_takes_its_width_from_either_side():
    volts = pulses((0.5, 50), (2.0, 100), (-2.0, 300))
    record = driven(axis(dead_zone={"width": 0.6}), volts)
    bare = driven(axis(), np.sign(volts) * np.maximum(abs(volts) - 0.6, 0.0))
    np.testing.assert_array_equal(record.position, bare.position)
    assert np.all(record.position[:51] == 0.0)


def test_limit_comes_before_dead_zone_before_delay_before_lag():
    effects = {name: TYPICAL[name] for name in ("actuator_lag", "delay", "dead_zone", "saturation")}
    record = driven(axis(damping=0.0, **effects), pulses((0.0, 5), (9.0, 100)))
    s = np.maximum(record.time - 5 * H - 0.0024, 0.0)
    expected = GAIN * (4.0 - 0.1) * (s**2 / 2 - 0.003 * s + 0.003**2 * -np.expm1(-s / 0.003))
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
def test_limited_force_ends_where_the_back_emf_has_grown(sign):
    volts, most = 5.0, 4.0
    record = driven(axis(force_limit={"acceleration": most}), np.full(400, sign * volts))
    free = (GAIN * volts - most) / DAMPING
    until = free / most
    t, s = np.minimum(record.time, until), np.maximum(record.time - until, 0.0)
    last = GAIN * volts / DAMPING
    expected = most * t**2 / 2 + last * s + (last - free) * np.expm1(-DAMPING * s) / DAMPING
    np.testing.assert_allclose(sign * record.position, expected, rtol=0, atol=1e-12)


def test_speed_servo_is_the_matrix_exponential():
    p = TYPICAL["speed_servo"]
    record = driven(axis(speed_servo=p), np.full(400, 3.0))
    s, kp, ki = p["speed_per_volt"], p["proportional"], p["integral"]
    system = np.array([[0, 1, 0, 0], [0, -DAMPING - kp, ki, kp * s * 3.0], [0, -1, 0, s * 3.0], [0, 0, 0, 0]])
    expected = [(expm(system * t) @ [0, 0, 0, 1])[0] for t in record.time]
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("frequency", [8.0, 30.0, 120.0])
def test_free_load_swings_at_the_resonance(frequency):
    load = 0.4
    p = {"frequency": frequency, "damping_ratio": 0.0, "load_ratio": load}
    record = driven(axis(damping=0.0, flexible_coupling=p), np.full(500, 3.0))
    w, t, push = 2 * np.pi * frequency, record.time, GAIN * 3.0
    stretch = push / (1 - load) / w**2 * (1 - np.cos(w * t))
    np.testing.assert_allclose(record.position, push * t**2 / 2 - (1 - load) * stretch, rtol=0, atol=1e-8)


@pytest.mark.parametrize("damping_ratio", [0.03, 3.0])
def test_coupled_loop_is_the_matrix_exponential(damping_ratio):
    p = {"frequency": 30.0, "damping_ratio": damping_ratio, "load_ratio": 0.4}
    record = lab.step_record(axis(flexible_coupling=p), 60, 2, encoder=0.0, duration=0.5)
    w, own, load = 2 * np.pi * 30.0, 0.6, 0.4
    k, d = w**2 * own * load, 2 * damping_ratio * w * own * load
    system = np.array(
        [
            [0, 1, 0, 0, 0],
            [-k / own, -(d + DAMPING) / own, k / own, d / own, GAIN / own],
            [0, 0, 0, 1, 0],
            [k / load, d / load, -k / load, -d / load, 0],
            [0, 0, 0, 0, 0],
        ]
    )
    held, state, before, expected = expm(system * H), np.zeros(4), 0.0, []
    for _ in record.time:
        expected.append(state[2])
        volts = 60 * (0.1 - state[2]) - 2 * (state[2] - before) / H
        before = state[2]
        state = held[:4, :4] @ state + held[:4, 4] * volts
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-8)


def test_load_swings_on_while_friction_holds_the_motor():
    p = {"frequency": 10.0, "damping_ratio": 0.0, "load_ratio": 0.5}
    truth = axis(damping=2.0, coulomb_friction={"level": 3.0}, flexible_coupling=p)
    record = driven(truth, pulses((4.0, 100), (0.0, 900)))
    late = record.position[500:]
    # with the motor held the load swings on k/μ = (2πf)²(1 − μ), for ever
    w = 2 * np.pi * 10.0 * np.sqrt(0.5)
    t = record.time[500:]
    columns = np.column_stack([np.ones_like(t), np.cos(w * t), np.sin(w * t)])
    found, *_ = np.linalg.lstsq(columns, late, rcond=None)
    assert np.hypot(found[1], found[2]) > 1e-4
    assert np.abs(late - columns @ found).max() < 1e-9


def test_friction_map_is_linear_between_its_knots():
    p = TYPICAL["friction_map"]
    record = driven(axis(friction_map=p), pulses((4.0, 200), (-4.0, 300)))
    knots = np.linspace(p["low"], p["high"], 5)
    levels = {+1: [p[f"positive_{i}"] for i in range(5)], -1: [p[f"negative_{i}"] for i in range(5)]}

    def rates(t, s, volts):
        side = 1 if s[1] > 0 or (s[1] == 0 and volts > 0) else -1
        return [s[1], GAIN * volts - DAMPING * s[1] - side * np.interp(s[0], knots, levels[side])]

    stop = int(np.argmin(record.velocity >= 0))  # up to the reversal: SciPy is not stopped there
    expected, _ = replay(record.slice(0.0, record.time[stop - 1]), rates, [0.0, 0.0])
    assert record.position[stop - 1] > 0.1
    # kinks at the knots cost one step of fourth order each
    assert np.abs(record.position[:stop] - expected).max() < 1e-9
    turned = record.slice(record.time[stop], record.time[-1])
    state = [float(record.position[stop]), float(record.velocity[stop])]
    expected, _ = replay(turned, rates, state)
    assert np.abs(turned.position - expected).max() < 1e-9
    assert turned.position[-1] < 0.02


@pytest.mark.parametrize("load", [0.0, 1.5, -1.5], ids=["free", "against", "with"])
def test_load_friction_takes_a_share_of_what_the_gear_transmits(load):
    volts, share, weight = 3.0, 0.2, {"constant_force": {"acceleration": load}}
    record = driven(axis(damping=0.0, load_friction={"share": share}, **weight), np.full(301, volts))
    push = GAIN * volts - load - share * abs(GAIN * volts + load)
    np.testing.assert_allclose(record.position, push * record.time**2 / 2, rtol=0, atol=1e-13)


def test_load_friction_holds_a_weight_that_the_motor_leaves_alone_only_with_the_whole_share():
    def end(share):
        truth = axis(load_friction={"share": share}, return_spring={"stiffness": 20.0})
        return driven(truth, np.zeros(301), start=0.05).position[-1]

    assert end(0.5) < 0.04  # the spring pulls with 1 and friction holds with a half of it
    record = driven(axis(load_friction={"share": 0.3}, constant_force={"acceleration": 1.0}), np.full(301, 0.8))
    # 1.52 against 1, friction up to 0.3 · 2.52: it holds
    assert np.unique(record.position).size == 1


def test_end_stop_is_met_as_the_closed_form_of_a_critically_damped_contact_says():
    rate, edge = 2000.0, 0.01
    push = GAIN * 2.0
    touch = np.sqrt(2 * edge / push)
    speed, rest = push * touch, push / rate**2  # depth at which the push alone would hold it
    record = driven(axis(damping=0.0, end_stop={"low": -1.0, "high": edge}), np.full(900, 2.0), sample_time=1e-4)
    since = record.time - touch
    pressed = (since > 0) & (since < 1.5 / rate)  # it springs back at 2/rate or somewhat later
    t = since[pressed]
    depth = rest + (-rest + (speed - rate * rest) * t) * np.exp(-rate * t)
    assert pressed.sum() >= 5
    assert np.abs(record.position[pressed] - edge - depth).max() < 1e-10
    assert record.position[-1] < edge + 1e-4


def test_axis_pressed_against_an_end_stop_comes_to_rest_in_it():
    record = lab.step_record(axis(end_stop={"low": -0.01, "high": 0.07}), 60, encoder=0.0, duration=2.0)
    depth = GAIN * 60 * (0.1 - record.position[-1]) / 2000.0**2
    assert record.position[-1] == pytest.approx(0.07 + depth, abs=1e-10)


def contact_rates(t, s, volts, gap=2e-3, load=0.3):
    x, v, y, w = s
    own, force, side = 1 - load, 0.0, np.sign(x - y)
    depth = abs(x - y) - gap / 2
    if depth > 0:
        force = side * max(0.0, 2000.0**2 * own * load * depth + 4000.0 * own * load * side * (v - w))
    return [v, (GAIN * volts - DAMPING * v - force) / own, w, force / load - 2.0 * w]


def test_backlash_agrees_with_scipy_through_hits_and_reversals():
    truth = axis(backlash={"gap": 2e-3, "load_share": 0.3})
    record = driven(truth, pulses((3.0, 100), (-3.0, 150), (3.0, 100)))
    jumps, state, expected = [0, 100, 250, 349], np.zeros(4), [np.zeros(1)]
    for a, b in itertools.pairwise(jumps):
        t = record.time[a : b + 1]
        done = solve_ivp(
            contact_rates,
            (t[0], t[-1]),
            state,
            args=(record.voltage[a],),
            method="DOP853",
            t_eval=t[1:],
            rtol=1e-8,
            atol=1e-10,
            max_step=2e-4,
        )
        state = done.y[:, -1]
        expected.append(done.y[2])
    assert np.abs(record.position - np.concatenate(expected)).max() < 1e-7


def test_load_waits_while_the_motor_crosses_half_the_gap_and_then_coasts():
    record = driven(axis(damping=0.0, backlash={"gap": 2e-3, "load_share": 0.3}), pulses((3.0, 100), (-3.0, 30)))
    touch = np.sqrt(2 * 1e-3 * 0.7 / (GAIN * 3.0))
    moving = record.position > 0.0
    assert int(np.argmax(moving)) == int(np.floor(touch / H)) + 1
    # once the motor brakes, nothing pulls the load: only its own drag of 2 1/s is left
    speed = record.velocity[103:122]
    np.testing.assert_allclose(speed[1:] / speed[:-1], np.exp(-2.0 * H), rtol=1e-9)


@pytest.mark.parametrize("effects", COMBINATIONS.values(), ids=COMBINATIONS)
def test_many_runs_at_once_are_the_runs_one_by_one(effects):
    settings = {"duration": 0.1, "noise": 2e-5, "reference": (0.1, 0.06), "encoder": 1e-5}
    truth = axis(**effects)
    together = lab.step_records(truth, 60, 1, repeats=3, seed=4, **settings)
    for record, stream in zip(together, np.random.default_rng(4).spawn(3), strict=True):
        alone = lab.step_record(truth, 60, 1, seed=stream, **settings)
        np.testing.assert_allclose(record.position, alone.position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(record.voltage, alone.voltage, rtol=0, atol=1e-8)
        assert np.ptp(record.position) > 1e-3


@pytest.mark.parametrize("effects", EVERYTHING.values(), ids=EVERYTHING)
def test_more_runs_leave_the_first_as_they_were(effects):
    few, many = (lab.step_records(axis(**effects), 60, repeats=n, seed=5, duration=0.03) for n in (2, 5))
    for a, b in zip(few, many[:2], strict=True):
        np.testing.assert_array_equal(a.position, b.position)


@pytest.mark.parametrize("effects", COMBINATIONS.values(), ids=COMBINATIONS)
def test_shorter_steps_change_less_than_a_hundredth_of_a_micrometre(effects, monkeypatch):
    def position(share):
        monkeypatch.setattr(loop, "SUBSTEP", 2.5e-4 * share)
        monkeypatch.setattr(loop, "STEP_TIMES_QUICKEST_RATE", 0.1 * share)
        return lab.step_record(axis(**effects), 60, encoder=0.0, reference=(0.1, 0.06), duration=0.2).position

    assert np.abs(position(1.0) - position(0.3)).max() < 1e-8


def test_steps_stay_of_fourth_order_across_every_edge(monkeypatch):
    names = ("flexible_coupling", "force_limit", "coulomb_friction", "periodic_disturbance", "sensor_lag")
    truth = axis(**{name: TYPICAL[name] for name in names})
    monkeypatch.setattr(loop, "STEP_TIMES_QUICKEST_RATE", 1e9)

    def position(substep):
        monkeypatch.setattr(loop, "SUBSTEP", substep)
        return lab.step_record(truth, 60, encoder=0.0, duration=0.4).position

    exact = position(6.25e-5)
    errors = [np.abs(position(h) - exact).max() for h in (1e-3, 5e-4)]
    assert errors[0] / errors[1] > 2**3.5


ZERO = {
    "actuator_lag": {"time_constant": 0.0},
    "asymmetric_damping": {"damping_difference": 0.0},
    "asymmetric_friction": {"level_positive": 0.0, "level_negative": 0.0},
    "cogging": {"amplitude": 0.0, "pitch": 0.02, "phase": 1.0},
    "constant_force": {"acceleration": 0.0},
    "coulomb_friction": {"level": 0.0},
    "dead_zone": {"width": 0.0},
    "delay": {"time": 0.0},
    "end_stop": {"low": -1e6, "high": 1e6},
    "force_limit": {"acceleration": 1e12},
    "friction_map": {
        **{f"{side}_{i}": 0.0 for side in ("positive", "negative") for i in range(5)},
        "low": 0,
        "high": 1,
    },
    "gain_drift": {"rate": 0.0},
    "hardening_spring": {"cubic_stiffness": 0.0},
    "load_friction": {"share": 0.0},
    "pendulum_gravity": {"amplitude": 0.0, "phase": 1.0},
    "periodic_disturbance": {"amplitude": 0.0, "frequency": 5.0, "phase": 1.0},
    "position_friction": {"level": 0.0, "centre": 0.05, "width": 0.1},
    "presliding": {"stiffness": 1e4, "level": 0.0},
    "quadratic_drag": {"drag": 0.0},
    "return_spring": {"stiffness": 0.0},
    "saturation": {"limit": 1e12},
    "sensor_lag": {"time_constant": 0.0},
    "stribeck_friction": {"level": 0.0, "static_excess": 0.0, "stribeck_speed": 0.01},
    "velocity_decay_damping": {"alpha1": 0.0, "alpha2": 10.0},
}


@pytest.mark.parametrize("name", ZERO)
def test_effect_of_zero_size_changes_nothing(name):
    bare, same = (lab.step_record(axis(**effects), 60, 1, duration=0.4) for effects in ({}, {name: ZERO[name]}))
    # shorter steps, where the law asks for them, are the only difference: less than an encoder step a thousandfold
    np.testing.assert_allclose(same.position, bare.position, rtol=0, atol=1e-12)


def test_every_effect_is_tested_here():
    assert set(TYPICAL) == set(LAWS)
    assert set(LAWS) - set(ZERO) == {"backlash", "flexible_coupling", "speed_servo"}


SIGNED = {
    ("asymmetric_damping", "damping_difference"),
    ("cogging", "amplitude"),
    ("cogging", "phase"),
    ("constant_force", "acceleration"),
    ("gain_drift", "rate"),
    ("hardening_spring", "cubic_stiffness"),
    ("pendulum_gravity", "amplitude"),
    ("pendulum_gravity", "phase"),
    ("periodic_disturbance", "amplitude"),
    ("periodic_disturbance", "phase"),
    ("position_friction", "centre"),
    ("quadratic_drag", "drag"),
    ("return_spring", "stiffness"),
    ("velocity_decay_damping", "alpha1"),
}
NEEDS_MORE_THAN_ZERO = {
    ("cogging", "pitch"),
    ("flexible_coupling", "frequency"),
    ("position_friction", "width"),
    ("speed_servo", "proportional"),
    ("stribeck_friction", "stribeck_speed"),
}
SHARES = {("backlash", "load_share"), ("flexible_coupling", "load_ratio")}
EACH = [(name, key) for name, values in TYPICAL.items() for key in values]


@pytest.mark.parametrize(("name", "key"), EACH, ids=lambda text: text)
def test_parameter_outside_its_range_is_refused(name, key):
    def refused(value, sentence):
        with pytest.raises(InputError, match=rf"^truth: {name}\.{key} must {sentence}, got {value:g}$"):
            axis(**{name: {**TYPICAL[name], key: value}})

    refused(float("inf"), "be finite")
    if (name, key) in SHARES:
        for value in (-0.1, 0.0, 1.0):
            refused(value, "lie between 0 and 1")
    elif (name, key) in NEEDS_MORE_THAN_ZERO:
        refused(0.0, "be above 0")
        refused(-1.0, "be above 0")
    elif (name, key) in SIGNED:
        axis(**{name: {**TYPICAL[name], key: -1.0}})
    elif key == "share":
        refused(-0.1, "lie between 0 and 0.999")
        refused(1.0, "lie between 0 and 0.999")
    elif name not in ("speed_servo", "stribeck_friction") and key not in ("low", "high"):
        refused(-1.0, "be at least 0")


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        (
            {name: TYPICAL[name] for name in ("backlash", "flexible_coupling")},
            "backlash and flexible_coupling cannot be combined, both move the load; keep one",
        ),
        (
            {"speed_servo": {**TYPICAL["speed_servo"], "proportional": 20.0}},
            "with speed_servo the gain is proportional times speed_per_volt, 2, got 1.9",
        ),
        ({"speed_servo": {**TYPICAL["speed_servo"], "integral": -1.0}}, "speed_servo.integral must be at least 0"),
        ({"end_stop": {"low": 0.1, "high": 0.1}}, r"end_stop\.low must be below high \(0.1\), got 0.1"),
        ({"friction_map": {**TYPICAL["friction_map"], "high": -0.1}}, r"friction_map\.low must be below high"),
        ({"stribeck_friction": {**TYPICAL["stribeck_friction"], "level": -1.0}}, "level must be at least 0, got -1"),
        (
            {"stribeck_friction": {"level": 0.3, "static_excess": -0.4, "stribeck_speed": 0.01}},
            r"static_excess must be at least -level \(-0.3\), got -0.4",
        ),
    ],
    ids=[
        "two transmissions",
        "servo's gain",
        "servo's integral",
        "end stop",
        "friction map",
        "negative level",
        "negative static friction",
    ],
)
def test_effects_that_do_not_fit_are_refused(effects, sentence):
    with pytest.raises(InputError, match=sentence):
        axis(**effects)


CONTROLLERS = {
    "error": Controller(kp=60, kd=3, derivative_on="error"),
    "window": Controller(kp=60, kd=3, derivative_window=3),
    "slow": Controller(kp=60, kd=3, control_period=0.005, derivative_window=2, derivative_filter=0.5),
    "velocity": Controller(kp=60, kd=3, derivative="velocity", derivative_filter=0.7),
    "velocity, slow": Controller(kp=60, kd=3, derivative="velocity", control_period=0.002),
}


@pytest.mark.parametrize("controller", CONTROLLERS.values(), ids=CONTROLLERS)
def test_logged_voltage_is_that_of_the_controller_and_the_feedforward(controller):
    rng = np.random.default_rng(2)
    reference, extra = 0.05 * np.sin(np.arange(400) / 40), 0.3 * rng.standard_normal(400)
    record = lab.step_record(
        axis(),
        noise=1e-5,
        seed=1,
        setup=lab.Setup(controller=controller, trajectory=reference, feedforward=extra, start=0.01),
    )
    assert record.controller is controller
    assert record.position[0] == pytest.approx(0.01, abs=1e-4)
    np.testing.assert_array_equal(record.reference, reference)
    np.testing.assert_array_equal(record.feedforward, extra)
    np.testing.assert_allclose(record.voltage, controller_voltage(record), rtol=0, atol=1e-9)
    assert (record.velocity is not None) == (controller.derivative == "velocity")


def test_logged_velocity_is_that_of_the_load():
    p = {"frequency": 15.0, "damping_ratio": 0.03, "load_ratio": 0.4}
    record = lab.step_record(
        axis(flexible_coupling=p), encoder=0.0, duration=0.3, setup=lab.Setup(controller=CONTROLLERS["velocity"])
    )
    # central difference: h²/6 of the third derivative, here (2π15)² · 1 m/s
    slope = (record.position[2:] - record.position[:-2]) / (2 * H)
    np.testing.assert_allclose(record.velocity[1:-1], slope, rtol=0, atol=H**2 / 6 * (2 * np.pi * 15) ** 2)


def test_axis_starts_at_rest_where_it_is_told():
    record = lab.step_record(
        axis(**TYPICAL_AT_REST), 60, reference=0.05, encoder=0.0, setup=lab.Setup(start=0.03, rest=0.1)
    )
    assert np.all(record.position[:100] == 0.03)
    assert np.all(record.reference[:100] == 0.03)
    assert record.position[-1] > 0.04


TYPICAL_AT_REST = {
    name: TYPICAL[name]
    for name in ("coulomb_friction", "delay", "actuator_lag", "sensor_lag", "presliding", "flexible_coupling")
}


def test_record_carries_units_and_leaves_out_the_reference():
    record = lab.step_record(lab.LM1, 60, setup=lab.Setup(length_unit="rad", command_unit="A", log_reference=False))
    assert (record.length_unit, record.command_unit, record.reference) == ("rad", "A", None)
    assert record.voltage is not None


def test_numbers_of_numpy_are_as_good_as_plain_ones():
    plain, numpys = (
        lab.step_record(axis(**EVERYTHING["everything and coupling"]), number(60), number(2), duration=0.05)
        for number in (float, np.float64)
    )
    np.testing.assert_array_equal(plain.position, numpys.position)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"trajectory": [0.1]}, "trajectory must have at least 2 samples, got 1"),
        ({"trajectory": [[0.1, 0.1]]}, r"trajectory must be a finite number at each sample, got an array of shape"),
        ({"trajectory": [0.1, np.nan]}, "trajectory must be a finite number"),
        ({"voltage_limit": 0.0}, "voltage_limit must be positive"),
        ({"rest": -0.1}, "rest must be at least 0"),
        ({"feedforward": [0.1]}, "feedforward has 1 samples, the reference has 1501"),
        ({"start": np.inf}, "start must be finite"),
        ({"log_reference": False, "log_voltage": False}, "log_reference and log_voltage are both False"),
        (
            {"controller": Controller(kp=60, control_period=0.0025)},
            "the longer must be a whole multiple of the shorter",
        ),
    ],
    ids=["one sample", "two dimensions", "not finite", "limit", "rest", "other length", "start", "nothing", "period"],
)
def test_impossible_setup_is_refused(settings, sentence):
    with pytest.raises(InputError, match=sentence):
        lab.step_record(lab.LM1, 60, setup=lab.Setup(**settings))


@pytest.mark.parametrize(
    "run",
    [lambda truth: lab.step_record(truth, 60), lambda truth: lab.step_records(truth, 60, repeats=2, seed=1)],
    ids=["one", "many"],
)
def test_axis_that_flies_away_is_named_whatever_its_laws(run):
    effects = {"hardening_spring": {"cubic_stiffness": -1e6}, "pendulum_gravity": {"amplitude": 1.0, "phase": 0.0}}
    with pytest.raises(NumericalError, match="has run away"):
        run(axis(**effects))
