"""Axes with load friction, a friction map or end stops against closed forms and integrations by SciPy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servolens.effects import (
    ActuatorLag,
    ConstantForce,
    CoulombFriction,
    EndStop,
    ForceLimit,
    FrictionMap,
    LoadFriction,
    PendulumGravity,
    QuadraticDrag,
)
from servolens.errors import InputError
from servolens.plant import Plant
from servolens.record import Controller
from servolens.simulation import simulate_continuous, simulate_loop, simulate_voltage

if TYPE_CHECKING:
    from servolens.effects import Effect

GAIN, DAMPING, SHARE = 1.9, 6.0, 0.25


CONTACT_RATE = 2000.0  # usual, rad/s


def plant_with(*effects: Effect, damping: float = DAMPING) -> Plant:
    return Plant(gain=GAIN, damping=damping, effects=effects)


def grid(duration: float, h: float = 1e-3) -> np.ndarray:
    return h * np.arange(round(duration / h) + 1)


def integrated(law: Any, time: np.ndarray, voltage: np.ndarray) -> np.ndarray:
    """Return the positions of an axis with dry friction, from rest, by events at each reversal.

    `law` gives push and level of friction for (time, position, velocity, command, direction).
    """
    state, positions = np.zeros(2), [0.0]

    def reversal(_: float, x: np.ndarray) -> float:
        return x[1]

    reversal.terminal = True  # type: ignore[attr-defined]  # SciPy's way
    for start, end, u in zip(time[:-1], time[1:], voltage[:-1], strict=True):
        t = start
        while t < end:
            d = np.sign(state[1])
            if d == 0.0:
                push = law(t, state[0], 0.0, u, 0.0)[0]
                d = np.sign(push)
                if abs(push) <= law(t, state[0], 0.0, u, d)[1]:
                    break

            def motion(t: float, x: np.ndarray, u: float = u, d: float = d) -> list[float]:
                push, level = law(t, x[0], x[1], u, d)
                return [x[1], push - level * d]

            reversal.direction = -d  # type: ignore[attr-defined]  # SciPy's way
            part = solve_ivp(motion, (t, end), state, events=reversal, rtol=1e-11, atol=1e-14, method="DOP853")
            t, state = part.t[-1], part.y[:, -1].copy()
            if part.status == 1:
                state[1] = 0.0
        positions.append(state[0])
    return np.array(positions)


BACK_AND_FORTH = np.select([grid(1.2) < 0.2, grid(1.2) < 0.5, grid(1.2) < 0.8], [4.0, -3.0, 2.5], 0.1)


def test_load_friction_takes_its_share_of_the_drive_and_adds_it_to_the_brake():
    time = grid(0.5)
    voltage = np.where(time < 0.4, 4.0, -1.0)
    run = simulate_voltage(plant_with(LoadFriction(share=SHARE)), time, voltage)

    def reached(a: float, v: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fades = np.exp(-DAMPING * t)
        speed = a / DAMPING + (v - a / DAMPING) * fades
        return a / DAMPING * t + (v - a / DAMPING) * (1 - fades) / DAMPING, speed

    drive, brake = GAIN * 4.0 * (1 - SHARE), -GAIN * (1 + SHARE)
    y1, v1 = reached(drive, 0.0, time[time <= 0.4])
    y2, v2 = reached(brake, v1[-1], time[time > 0.4] - 0.4)
    assert v2[-1] > 0
    np.testing.assert_allclose(run.position, [*y1, *(y1[-1] + y2)], rtol=0, atol=2e-8)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["lifts", "lowers"])
@pytest.mark.parametrize("weight", [2.0, -2.0])
def test_weight_is_held_over_the_range_of_commands_in_which_the_gear_sticks(side, weight):
    """It rises where β·a − g > ρ(β·a + g), so from g(1 + ρ)/(1 − ρ) on; it falls below g(1 − ρ)/(1 + ρ)."""
    time = grid(2.0)
    voltage = weight / GAIN * (1 + side * 0.5 * time)  # a staircase, for it is held from sample to sample
    plant = plant_with(LoadFriction(share=SHARE), ConstantForce(acceleration=weight))
    run = simulate_voltage(plant, time, voltage, start=(0.123, 0.0))
    limit = weight / GAIN * ((1 + SHARE) / (1 - SHARE)) ** side
    last = int(np.flatnonzero(side * np.sign(weight) * (voltage - limit) <= 0)[-1])
    assert 100 < last < 1900
    assert np.all(run.position[: last + 1] == 0.123)
    assert np.all(side * np.sign(weight) * np.diff(run.position[last + 1 :]) > 0)


def test_load_friction_beside_a_turning_weight_and_other_forces_follows_an_independent_integration():
    arm = (PendulumGravity(amplitude=3.0, phase=0.4), QuadraticDrag(drag=2.0), CoulombFriction(level=0.1))
    plant = plant_with(*arm, LoadFriction(share=SHARE))
    voltage = 2.0 * BACK_AND_FORTH

    def law(_: float, y: float, v: float, u: float, d: float) -> tuple[float, float]:
        weight = 3.0 * np.sin(y + 0.4)
        return GAIN * u - DAMPING * v - weight - 2.0 * v * abs(v), 0.1 + SHARE * abs(GAIN * u + weight)

    run = simulate_voltage(plant, grid(1.2), voltage)
    expected = integrated(law, grid(1.2), voltage)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=1e-7)


def test_load_friction_in_a_closed_loop_sticks_and_its_load_passes_a_kink_between_samples():
    """In a continuous loop the command passes zero within a sample, where the level has its kink."""
    kp, kd, time = 200.0, 2.0, grid(1.0)
    plant = plant_with(LoadFriction(share=0.4), ConstantForce(acceleration=1.0))
    run = simulate_continuous(plant, kp, kd, time, np.full(time.size, 0.1))

    def law(_: float, y: float, v: float, u: float, d: float) -> tuple[float, float]:
        push = GAIN * (kp * (u - y) - kd * v)
        return push - DAMPING * v - 1.0, 0.4 * abs(push + 1.0)

    np.testing.assert_allclose(run.position, integrated(law, time, np.full(time.size, 0.1)), rtol=0, atol=1e-7)
    assert np.ptp(run.position[-200:]) == 0.0


def test_load_behind_a_lag_and_a_force_limit_is_what_the_motor_gives():
    lag, limit, time = 0.02, 3.0, grid(0.5)
    plant = plant_with(
        ActuatorLag(time_constant=lag), ForceLimit(acceleration=limit), LoadFriction(share=SHARE), damping=0
    )
    run = simulate_voltage(plant, time, np.full(time.size, 4.0), before=0.0)

    def motion(t: float, x: np.ndarray) -> list[float]:
        return [x[1], (1 - SHARE) * min(GAIN * 4.0 * (1 - np.exp(-t / lag)), limit)]

    expected = solve_ivp(motion, (0, 0.5), [0, 0], t_eval=time, rtol=1e-11, atol=1e-14, max_step=1e-3).y[0]
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=1e-7)


LEVELS = {
    **{f"positive_{i}": level for i, level in enumerate((0.3, 0.8, 1.9, 0.6, 0.2))},
    **{f"negative_{i}": level for i, level in enumerate((0.9, 0.4, 0.5, 1.2, 1.0))},
}


def mapped(y: float, d: float) -> float:
    way = "positive" if d > 0 else "negative"
    return float(np.interp(y, np.linspace(-0.01, 0.07, 5), [LEVELS[f"{way}_{i}"] for i in range(5)]))


def test_friction_map_follows_an_independent_integration_to_both_sides_of_its_range():
    plant = plant_with(FrictionMap(**LEVELS, low=-0.01, high=0.07))
    voltage = np.where(BACK_AND_FORTH < 0, 1.6, 0.75) * BACK_AND_FORTH
    run = simulate_voltage(plant, grid(1.2), voltage)

    def law(_: float, y: float, v: float, u: float, d: float) -> tuple[float, float]:
        return GAIN * u - DAMPING * v, mapped(y, d)

    expected = integrated(law, grid(1.2), voltage)
    assert expected.max() > 0.071
    assert expected.min() < -0.01
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=2e-7)


@pytest.mark.parametrize(("place", "way"), [(0.02, 1.0), (0.04, -1.0), (0.3, 1.0), (-0.2, -1.0), (0.063, 1.0)])
def test_friction_map_holds_the_axis_up_to_the_level_of_its_place_and_direction(place, way):
    plant = plant_with(FrictionMap(**LEVELS, low=-0.01, high=0.07))
    level, time = mapped(place, way), grid(0.05)
    for push, moves in ((0.999 * level, False), (1.001 * level, True)):
        run = simulate_voltage(plant, time, np.full(time.size, way * push / GAIN), start=(place, 0.0))
        assert (way * (run.position[-1] - place) > 0) == moves
        assert moves or np.all(run.position == place)


@pytest.mark.parametrize("h", [1e-3, 5e-3])
@pytest.mark.parametrize(("low", "high"), [(-0.03, 0.05), (-3.2, 2.1)], ids=["cart", "arm"])
def test_end_stop_is_hit_and_left_as_an_independent_integration_says(low, high, h):
    """To one part in fifty thousand of the travel."""
    time, size = grid(1.5, h), 20.0 * (high - low)
    voltage = size * np.select([time < 0.4, time < 0.9, time < 1.2], [1.0, -1.0, 0.0], 0.2)
    plant = plant_with(EndStop(low=low, high=high))
    run = simulate_voltage(plant, time, voltage)

    def motion(_: float, x: np.ndarray, u: float) -> list[float]:
        depth = x[0] - high if x[0] > high else min(x[0] - low, 0.0)
        force = CONTACT_RATE**2 * depth + 2 * CONTACT_RATE * x[1]
        return [x[1], GAIN * u - DAMPING * x[1] - (force if depth * force > 0 else 0.0)]

    state, expected = np.zeros(2), [0.0]
    for start, end, u in zip(time[:-1], time[1:], voltage[:-1], strict=True):
        state = solve_ivp(motion, (start, end), state, args=(u,), rtol=1e-9, atol=1e-12, max_step=2e-4).y[:, -1]
        expected.append(state[0])
    assert max(expected) > high
    assert min(expected) < low
    np.testing.assert_allclose(run.position, expected, rtol=0, atol=2e-5 * (high - low))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_axis_pressed_against_a_stop_rests_where_the_spring_of_the_contact_says(side):
    time = grid(1.0)
    run = simulate_voltage(plant_with(EndStop(low=-0.05, high=0.05)), time, np.full(time.size, side * 5.0))
    assert run.position[-1] == pytest.approx(side * (0.05 + GAIN * 5.0 / CONTACT_RATE**2), abs=1e-9)
    assert abs(run.velocity[-1]) < 1e-6


def thrown_back(ratio: float) -> float:
    """Return the share of the speed that a contact which only pushes throws back (Schwager and Pöschel 2007)."""
    if ratio < 1.0:
        root = np.sqrt(1.0 - ratio**2)
        return float(np.exp(-ratio / root * np.arctan2(2.0 * ratio * root, 2.0 * ratio**2 - 1.0)))
    if ratio == 1.0:
        return float(np.exp(-2.0))
    root = np.sqrt(ratio**2 - 1.0)
    return float(np.exp(-ratio / root * np.log((ratio + root) / (ratio - root))))


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.7, 0.9, 3.0])
def test_stop_throws_back_as_much_of_the_speed_as_its_damping_says(ratio):
    time = grid(0.8)
    plant = Plant(
        gain=GAIN, damping=0.0, effects=(EndStop(low=-1.0, high=0.1, contact_frequency=200.0, contact_damping=ratio),)
    )
    run = simulate_voltage(plant, time, np.where(time < 0.2, 2.0, 0.0))
    assert run.velocity[-1] == pytest.approx(-thrown_back(ratio) * run.velocity.max(), rel=1e-3)


@pytest.mark.parametrize("h", [1e-3, 5e-3])
@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
def test_stop_throws_back_as_much_wherever_in_a_sample_it_is_hit(ratio, h):
    """It was entered up to a thousandth of a substep late, without the force of its damper."""
    time = grid(0.8, h)
    for high in (0.1, 0.10013, 0.1007, 0.10111):
        plant = Plant(gain=GAIN, damping=0.0, effects=(EndStop(low=-1.0, high=high, contact_damping=ratio),))
        run = simulate_voltage(plant, time, np.where(time < 0.2, 2.0, 0.0))
        assert run.velocity[-1] == pytest.approx(-thrown_back(ratio) * run.velocity.max(), rel=4e-5)


def test_loop_that_asks_for_more_than_the_travel_stands_at_the_stop():
    time = grid(1.0)
    plant = plant_with(EndStop(low=-1.0, high=0.06), CoulombFriction(level=0.2))
    run = simulate_loop(plant, Controller(kp=60.0, kd=1.0), time, np.full(time.size, 0.1))
    np.testing.assert_allclose(run.position[-100:], 0.06, atol=5e-6)
    assert run.voltage[-1] == pytest.approx(60.0 * 0.04, rel=1e-3)


@pytest.mark.parametrize("cls", [EndStop, FrictionMap])
def test_range_that_ends_before_it_begins_is_refused(cls):
    levels = LEVELS if cls is FrictionMap else {}
    with pytest.raises(InputError, match=f"{cls.name}: low must be less than high, got low 0.2 and high 0.1"):
        cls(**levels, low=0.2, high=0.1)
