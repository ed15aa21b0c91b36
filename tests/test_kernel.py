"""The compiled stepping rule: order of accuracy, dry friction, composition, and what it promises bit for bit."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from servolens.dynamics import dynamics
from servolens.effects import (
    CATALOGUE,
    ActuatorLag,
    AsymmetricFriction,
    Backlash,
    Cogging,
    CoulombFriction,
    Delay,
    Effect,
    EndStop,
    FlexibleCoupling,
    ForceLimit,
    HardeningSpring,
    PeriodicDisturbance,
    PositionFriction,
    Presliding,
    SensorLag,
    SpeedServo,
    StribeckFriction,
    VelocityDecayDamping,
)
from servolens.errors import InputError, NumericalError, ServolensError
from servolens.plant import Plant
from servolens.record import Controller, Record
from servolens.simulation import Simulation, simulate, simulate_loop, simulate_many, simulate_voltage
from servolens.simulation.rates import fixed_substeps_for, rate_of, substeps_for
from servolens.simulation.trial import Accuracy, closed_trial

if TYPE_CHECKING:
    from collections.abc import Callable

H = 1e-3
LOOP = Controller(kp=80.0, kd=2.0)


def grid(duration: float, h: float = H) -> np.ndarray:
    return h * np.arange(round(duration / h) + 1)


def plant_with(*effects: Effect) -> Plant:
    return Plant(gain=1.9, damping=6.0, effects=effects)


def motion(plant: Plant) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Rates of [x, v, states] in a given direction, and the measured position: without the kernel."""
    d = dynamics(plant.structure)
    given = [ca.vertcat(d.position, d.velocity, d.states), d.time, d.command, d.direction, d.parameters]
    flow = ca.Function("flow", given, [ca.vertcat(d.velocity, d.acceleration, d.rates)])
    output = ca.Function("output", given, [d.output])
    p = np.array(plant.values)
    return lambda *a: np.array(flow(*a, p)).ravel(), lambda x: float(output(x, 0, 0, 1, p))


def at_rest(plant: Plant, command: float) -> np.ndarray:
    d = dynamics(plant.structure)
    begin = ca.Function("begin", [d.position, d.command, d.parameters], [d.beginning])
    return np.array([0.0, 0.0, *np.array(begin(0, command, np.array(plant.values))).ravel()])


def smooth_reference(plant: Plant, time: np.ndarray, voltage: np.ndarray) -> np.ndarray:
    """Integrate sample by sample under the held command."""
    flow, output = motion(plant)
    x = at_rest(plant, voltage[0])
    found = [output(x)]
    for k in range(time.size - 1):
        u = voltage[k]
        x = solve_ivp(
            lambda t, x, u=u: flow(x, t, u, 1.0 if x[1] > 0 or (x[1] == 0 and u > 0) else -1.0),
            (time[k], time[k + 1]),
            x,
            method="DOP853",
            rtol=1e-10,
            atol=1e-13,
        ).y[:, -1]
        found.append(output(x))
    return np.array(found)


SMOOTH = {
    "soft bristles": (Presliding(stiffness=1e4, level=0.3),),
    "stiff bristles": (Presliding(stiffness=1e5, level=0.3),),
    "actuator lag": (ActuatorLag(time_constant=5e-3),),
    "sensor lag": (SensorLag(time_constant=5e-3),),
    "coupling": (FlexibleCoupling(frequency=20.0, damping_ratio=0.03, load_ratio=0.4),),
    "speed servo": (SpeedServo(speed_per_volt=0.05, proportional=60.0, integral=300.0),),
    "cogging and decay": (
        Cogging(amplitude=0.3, pitch=0.02, phase=0.3),
        VelocityDecayDamping(alpha1=6.0, alpha2=20.0),
    ),
    "disturbance": (PeriodicDisturbance(amplitude=1.0, frequency=8.0, phase=0.3),),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_error_falls_with_the_square_of_the_step_and_is_small_with_the_automatic_one(name: str) -> None:
    plant, time = plant_with(*SMOOTH[name]), grid(0.12)
    voltage = simulate_loop(plant, LOOP, time, np.full(time.size, 0.1)).voltage
    voltage[70:] -= 3.0  # it reverses
    exact = smooth_reference(plant, time, voltage)
    error = {n: np.abs(simulate_voltage(plant, time, voltage, substeps=n).position - exact).max() for n in (16, 32, 64)}
    floor = 2e-12
    assert error[32] < error[16] / 3.0 + floor
    assert error[64] < error[32] / 3.0 + floor
    automatic = np.abs(simulate_voltage(plant, time, voltage).position - exact).max()
    assert automatic < 1e-7


@pytest.mark.slow
def test_bristles_so_stiff_that_they_relax_within_a_substep_are_followed() -> None:
    plant, time = plant_with(Presliding(stiffness=1e6, level=0.3)), grid(0.12)
    voltage = simulate_loop(plant, LOOP, time, np.full(time.size, 0.1)).voltage
    exact = smooth_reference(plant, time, voltage)
    assert np.abs(simulate_voltage(plant, time, voltage).position - exact).max() < 1e-7


def test_backlash_is_followed_through_its_contacts() -> None:
    plant, time = plant_with(Backlash(gap=1e-3, load_share=0.4)), grid(0.2)
    voltage = simulate_loop(plant, LOOP, time, np.full(time.size, 0.1)).voltage
    voltage[120:] -= 3.0
    exact = smooth_reference(plant, time, voltage)
    error = [np.abs(simulate_voltage(plant, time, voltage, substeps=n).position - exact).max() for n in (4, 16, 64)]
    assert np.abs(simulate_voltage(plant, time, voltage).position - exact).max() < 1e-6
    assert error[1] < error[0] / 2
    assert error[2] < error[1] / 2


def test_a_delay_of_a_part_of_a_sample_is_exact() -> None:
    time, delay = grid(0.2), 0.0023
    voltage = 3.0 * np.sin(40.0 * time)
    fine = grid(0.2, 1e-4)
    late = voltage[np.maximum(np.floor((fine - delay) / H + 1e-6).astype(int), 0)]
    wanted = simulate_voltage(plant_with(), fine, late, substeps=2).position[::10]
    run = simulate_voltage(plant_with(Delay(time=delay)), time, voltage, substeps=20)
    np.testing.assert_allclose(run.position, wanted, rtol=0, atol=1e-12)


def test_a_delay_of_whole_samples_is_a_shifted_command_bit_for_bit() -> None:
    time = grid(0.5)
    voltage = 3.0 * np.sin(40.0 * time) + 0.1
    shifted = np.concatenate([np.full(3, voltage[0]), voltage[:-3]])
    late = simulate_voltage(plant_with(Delay(time=3e-3)), time, voltage, substeps=2)
    np.testing.assert_array_equal(late.position, simulate_voltage(plant_with(), time, shifted, substeps=2).position)


def event_reference(plant: Plant, time: np.ndarray, voltage: np.ndarray) -> np.ndarray:
    """Dry friction with its reversals as events; at rest the axis leaves where the push exceeds the level."""
    flow, output = motion(plant)
    x = at_rest(plant, voltage[0])
    found = [output(x)]
    for k in range(time.size - 1):
        t, u = time[k], voltage[k]
        while t < time[k + 1] - 1e-13:
            forward, backward = flow(x, t, u, 1.0)[1], flow(x, t, u, -1.0)[1]
            d = np.sign(x[1]) if x[1] != 0.0 else 1.0 if forward > 0.0 else -1.0 if backward < 0.0 else 0.0
            if d == 0.0:
                break  # the command is held and nothing else changes

            def reversal(now: float, x: np.ndarray, began: float = t, d: float = d) -> float:
                return x[1] if now > began else d

            reversal.terminal, reversal.direction = True, -d  # type: ignore[attr-defined]  # SciPy's way
            part = solve_ivp(
                lambda t, x, u=u, d=d: flow(x, t, u, d),
                (t, time[k + 1]),
                x,
                events=reversal,
                method="DOP853",
                rtol=1e-11,
                atol=1e-14,
            )
            t, x = part.t[-1], part.y[:, -1]
            if part.status == 1:
                x[1] = 0.0
        found.append(output(x))
    return np.array(found)


FRICTION = {
    "coulomb": CoulombFriction(level=0.4),
    "asymmetric": AsymmetricFriction(level_positive=0.5, level_negative=0.2),
    "stribeck": StribeckFriction(level=0.2, static_excess=0.3, stribeck_speed=0.02),
    "tight spot": PositionFriction(level=1.5, centre=0.03, width=0.01),
}


@pytest.mark.parametrize("name", FRICTION)
def test_dry_friction_agrees_with_an_event_driven_reference(name: str) -> None:
    plant, time = plant_with(FRICTION[name]), grid(0.6)
    voltage = np.where(time < 0.1, 5.0, np.where(time < 0.2, -4.0, 0.05))  # goes, reverses, stops and sticks
    exact = event_reference(plant, time, voltage)
    run = simulate_voltage(plant, time, voltage)
    np.testing.assert_allclose(run.position, exact, rtol=0, atol=2e-8)
    assert run.velocity[-1] == 0.0
    errors = [np.abs(simulate_voltage(plant, time, voltage, substeps=n).position - exact).max() for n in (4, 16)]
    assert errors[1] < errors[0] / 10 + 1e-11


STUCK = {
    "alone": (),
    "behind a lag": (ActuatorLag(time_constant=5e-3),),
    "with a sensor lag": (SensorLag(time_constant=5e-3),),
    "with a load": (FlexibleCoupling(frequency=20.0, damping_ratio=0.03, load_ratio=0.4),),
}


@pytest.mark.parametrize("name", STUCK)
def test_an_axis_below_breakaway_does_not_move_one_bit_in_a_million_samples(name: str) -> None:
    plant, time = plant_with(CoulombFriction(level=0.4), *STUCK[name]), grid(1000.0)
    run = simulate_voltage(plant, time, 0.2 * np.sin(0.1 * np.arange(time.size)), start=(0.123456789, 0.0), substeps=1)
    assert time.size > 1_000_000
    assert np.all(run.position == 0.123456789)
    assert np.all(run.velocity == 0.0)


def middle(cls: type[Effect], **fixed: float) -> Effect:
    """An effect with values that a small axis may have."""
    usual = {
        "frequency": 20.0, "damping_ratio": 0.05, "load_ratio": 0.4, "load_share": 0.4, "gap": 1e-3, "pitch": 0.02,
        "time_constant": 4e-3, "time": 2.5e-3, "limit": 5.0, "width": 0.1, "acceleration": 5.0, "rate": 0.01,
        "speed_per_volt": 0.05, "proportional": 60.0, "integral": 300.0, "stiffness": 20.0, "level": 0.2,
        "stribeck_speed": 0.05, "amplitude": 0.2, "phase": 0.3, "centre": 0.03, "low": -0.02, "high": 0.08,
    }  # fmt: skip
    values = {spec.name: float(np.clip(usual.get(spec.name, 0.1), spec.low, spec.high)) for spec in cls.parameters()}
    return cls(**{**values, **fixed})


WIDE = {"low": -0.3, "high": 0.7}
"""A map whose knots are not crossed: at each the step is split, which by itself changes the last digits."""
VANISHING = [name for name, cls in CATALOGUE.items() if cls.absent_at]


@pytest.mark.parametrize("name", VANISHING)
def test_an_effect_of_size_zero_changes_nothing_but_rounding(name: str) -> None:
    cls, time = CATALOGUE[name], grid(0.4)
    absent = middle(cls, **(WIDE if name == "friction_map" else {}) | cls.absent_at)
    assert absent.absent
    reference = np.full(time.size, 0.1)
    plain = simulate_loop(plant_with(), LOOP, time, reference, substeps=2).position
    run = simulate_loop(plant_with(absent), LOOP, time, reference, substeps=2).position
    np.testing.assert_allclose(run, plain, rtol=0, atol=1e-13)


def test_the_same_simulation_gives_the_same_bits() -> None:
    plant, time = plant_with(*SMOOTH["stiff bristles"], Cogging(amplitude=0.3, pitch=0.02, phase=0.3)), grid(0.3)
    runs = [simulate_loop(plant, LOOP, time, np.full(time.size, 0.1)) for _ in range(3)]
    assert len({(run.position.tobytes(), run.voltage.tobytes()) for run in runs}) == 1


def refusal(*effects: type[Effect]) -> str:
    """Return the sentence with which a combination is refused; empty if it is not."""
    try:
        plant_with(*map(middle, effects))
    except InputError as refused:
        return str(refused)
    return ""


@pytest.mark.slow
def test_any_two_effects_run_together_or_are_refused_with_a_sentence() -> None:
    time = grid(0.03)
    reference = np.full(time.size, 0.1)
    pairs = list(itertools.combinations(CATALOGUE.values(), 2))
    sentences = {pair: refusal(*pair) for pair in pairs}
    assert all(len(sentence) > 20 for sentence in sentences.values() if sentence)
    for pair in (pair for pair in pairs if not sentences[pair]):
        run = simulate_loop(plant_with(*map(middle, pair)), LOOP, time, reference)
        assert np.isfinite([run.position, run.velocity]).all(), [cls.name for cls in pair]


def record(duration: float = 0.5) -> Record:
    time = grid(duration)
    return Record(time=time, position=np.zeros(time.size), reference=np.full(time.size, 0.1), controller=LOOP)


def sticky(levels: list[float]) -> list[Plant]:
    return [plant_with(CoulombFriction(level=level), Cogging(amplitude=0.2, pitch=0.02, phase=0.0)) for level in levels]


def test_threads_give_the_bits_of_one_thread_in_order() -> None:
    plants, records = sticky([0.01 * k for k in range(40)]), [record(), record(0.3)]
    many, one = (simulate_many(plants, records, workers=workers) for workers in (4, 1))
    for plant, several, alone in zip(plants, many, one, strict=True):
        for given_record, a, b in zip(records, several, alone, strict=True):
            assert isinstance(a, Simulation)
            assert isinstance(b, Simulation)
            np.testing.assert_array_equal(a.position, b.position)
            np.testing.assert_array_equal(a.position, simulate(plant, given_record).position)


def test_a_plant_that_fails_does_not_lose_the_others() -> None:
    wild = Plant(gain=1e9, damping=0.0)
    first, failed, last = simulate_many([plant_with(), wild, plant_with()], [record(5.0)])
    assert isinstance(failed[0], NumericalError)
    assert "diverges" in str(failed[0])
    assert isinstance(first[0], Simulation)
    assert isinstance(last[0], Simulation)
    (refused,) = simulate_many([plant_with()], [record()], voltage_driven=True)
    assert isinstance(refused[0], ServolensError)


@settings(max_examples=40, deadline=None)
@given(
    level=st.floats(0.0, 3.0),
    excess=st.floats(0.0, 2.0),
    width=st.floats(1e-3, 1.0),
    velocity=st.floats(-1.0, 1.0),
    damping=st.floats(0.0, 20.0),
)
def test_friction_never_adds_energy(level: float, excess: float, width: float, velocity: float, damping: float) -> None:
    friction = StribeckFriction(level=level, static_excess=excess, stribeck_speed=width)
    plant, time = Plant(gain=1.0, damping=damping, effects=(friction,)), grid(0.3)
    run = simulate_voltage(plant, time, np.zeros(time.size), start=(0.0, velocity))
    assert np.all(np.diff(run.velocity**2) <= 1e-15)


@settings(max_examples=25, deadline=None)
@given(stiffness=st.floats(1e2, 1e6), level=st.floats(1e-3, 3.0), velocity=st.floats(-1.0, 1.0))
def test_bristles_never_add_energy(stiffness: float, level: float, velocity: float) -> None:
    """What the bristles store is less than level²/(2 stiffness) and only then comes back."""
    plant = Plant(gain=1.0, damping=0.1, effects=(Presliding(stiffness=stiffness, level=level),))
    time = grid(0.3)
    run = simulate_voltage(plant, time, np.zeros(time.size), start=(0.0, velocity))
    assert np.max(run.velocity**2) <= velocity**2 * (1 + 1e-9) + 1e-15


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300], ids=["nan", "infinite", "huge"])
def test_numbers_that_run_away_end_at_once_with_an_error(value: float) -> None:
    time = grid(1000.0)
    voltage = np.zeros(time.size)
    voltage[5] = value
    said = "diverges" if np.isfinite(value) else "not finite"
    for plant in (plant_with(), plant_with(*SMOOTH["coupling"], *SMOOTH["stiff bristles"])):
        with pytest.raises(NumericalError if np.isfinite(value) else InputError, match=said):
            simulate_voltage(plant, time, voltage)


def test_elementary_functions_are_those_of_the_library() -> None:
    """Through the kernel: a force exp, sin and cos of the position where the axis starts, at rest in one sample."""
    for angle in np.concatenate([np.linspace(-40.0, 40.0, 401), [1e4, 99999.0, 100001.0, 3e5]]):
        plant = plant_with(Cogging(amplitude=1e6, pitch=2 * np.pi, phase=0.0))
        run = simulate_voltage(plant, [0.0, 1e-9], [0.0, 0.0], start=(float(angle), 0.0), substeps=1)
        assert run.velocity[1] == pytest.approx(-1e-3 * np.sin(angle), abs=1e-9)


@pytest.mark.parametrize("damping", [6.0, 300.0, 3000.0])
def test_linear_damping_is_solved_exactly_in_one_step_a_sample_however_strong(damping: float) -> None:
    """Through reversals of the velocity within the sample, too; from sample to sample in closed form."""
    plant = Plant(gain=10.0 * damping, damping=damping)
    time = H * np.arange(400)
    voltage = np.where(time % 0.1 < 0.05, 3.0, -3.0) + 0.3 * np.sin(2.0 * np.pi * 7.0 * time)
    position, velocity = [0.0], [0.0]
    kept = np.exp(-damping * H)
    for held in voltage[:-1]:
        end = 10.0 * held
        position.append(position[-1] + end * H + (velocity[-1] - end) * (1.0 - kept) / damping)
        velocity.append(end + (velocity[-1] - end) * kept)
    run = simulate_voltage(plant, time, voltage)
    assert substeps_for(plant, H) == 1
    assert np.abs(run.position - position).max() < 1e-12 * np.ptp(position)
    assert np.abs(run.velocity - velocity).max() < 1e-11 * np.ptp(velocity)


@pytest.mark.parametrize("lag", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("damping", [60.0, 240.0, 1000.0, 3000.0])
def test_lag_beside_strong_damping_takes_few_substeps(damping: float, lag: float) -> None:
    plant = Plant(gain=10.0 * damping, damping=damping, effects=(ActuatorLag(time_constant=lag),))
    time = H * np.arange(600)
    voltage = np.where(time % 0.2 < 0.1, 3.0, -3.0)
    rates = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, -damping, 10.0 * damping, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0] * 4])
    rates[2] /= lag
    moved, state, position = expm(rates * H), np.array([0.0, 0.0, voltage[0], 0.0]), [0.0]
    for held in voltage[:-1]:
        state[3] = held
        state = moved @ state
        position.append(state[0])
    run = simulate_voltage(plant, time, voltage)
    assert substeps_for(plant, H) <= 8
    assert np.abs(run.position - position).max() < 2e-7 * np.ptp(position)


def test_more_substeps_for_faster_plants() -> None:
    slow, fast = plant_with(), plant_with(FlexibleCoupling(frequency=200.0, damping_ratio=0.03, load_ratio=0.4))
    assert substeps_for(slow, H) < substeps_for(fast, H)
    assert substeps_for(slow, H) < substeps_for(slow, H, 500.0)


@pytest.mark.parametrize(
    "contact", [Backlash(gap=1.2e-3, load_share=0.35), EndStop(low=-0.05, high=0.08), EndStop(low=-0.05, high=0.095)]
)
def test_contacts_ask_for_few_substeps_for_a_step_is_halved_where_one_closes(contact: Effect) -> None:
    """The largest error on a step of 0.1 m is below 20 nm, with a load of a third."""
    plant, time = plant_with(contact), H * np.arange(2500)
    reference = np.where(time < 0.05, 0.0, np.where(time < 1.3, 0.1, 0.0))
    run, exact = (
        simulate_loop(plant, Controller(kp=80.0, kd=4.0), time, reference, substeps=steps).position
        for steps in (None, 512)
    )
    assert substeps_for(plant, H) == 4
    assert np.abs(run - exact).max() < 2e-8


def test_contacts_ask_for_as_many_substeps_wherever_they_are_and_hide_no_other_effect() -> None:
    spring, play = HardeningSpring(cubic_stiffness=1e6), Backlash(gap=1e-3, load_share=0.3)
    assert substeps_for(plant_with(EndStop(low=1e-4, high=0.2)), H) == 4
    assert substeps_for(plant_with(play), 10.0 * H) == 20  # none longer than the contact takes to open
    assert rate_of(plant_with(spring, EndStop(low=-100.0, high=100.0))) == rate_of(plant_with(spring)) > 100.0
    assert fixed_substeps_for(plant_with(play), H) > substeps_for(plant_with(play), H) == 4


@pytest.mark.parametrize("damping", [0.05, 20.0])
@pytest.mark.parametrize("share", [0.05, 0.7])
def test_the_hardest_and_deadest_contact_that_a_fit_may_try_can_be_simulated(share: float, damping: float) -> None:
    play = Backlash(gap=1e-3, load_share=share, contact_frequency=2000.0, contact_damping=damping)
    time = H * np.arange(1000)
    trial = closed_trial(Controller(kp=80.0, kd=4.0), time, np.where(time % 0.5 < 0.05, 0.0, 0.1))
    plant = plant_with(play)
    assert np.isfinite(trial.measured([plant], [(0.0, 0.0, 0.0)], substeps_for(plant, H))).all()


def test_what_rounding_makes_of_the_sample_time_asks_for_no_further_substep() -> None:
    plant = plant_with(FlexibleCoupling(frequency=200.0, damping_ratio=0.03, load_ratio=0.4))
    step = 10 * 0.25 / rate_of(plant)  # ten substeps, just so
    assert substeps_for(plant, step * (1.0 + 1e-12)) == substeps_for(plant, step * (1.0 - 1e-12)) == 10
    assert substeps_for(plant, step * (1.0 + 1e-6)) == 11


@pytest.mark.parametrize("effect", [ActuatorLag, SensorLag])
@pytest.mark.parametrize("lag", [0.0004, 0.004])
def test_lag_of_a_push_from_rest_is_exact_within_the_sample(effect, lag):
    time = np.arange(600) * 2e-3
    voltage = np.where(time < 0.01, 0.0, 7.0)
    plant = Plant(gain=1.9, damping=6.0, effects=(effect(time_constant=lag),))
    after = np.maximum(time - 0.01, 0.0)
    # y/V = 1.9 / (s (s + 6) (lag s + 1)) of a step, by partial fractions
    rate = 1.0 / lag
    expected = (7.0 * 1.9 * rate) * (
        after / (6.0 * rate)
        - (6.0 + rate) / (6.0 * rate) ** 2
        + np.exp(-6.0 * after) / (36.0 * (rate - 6.0))
        - np.exp(-rate * after) / (rate**2 * (rate - 6.0))
    )
    assert np.abs(simulate_voltage(plant, time, voltage).measured - expected).max() < 2e-7


@pytest.mark.parametrize("begin", [0.3, 0.35, 0.366])
@pytest.mark.parametrize("substeps", [1, 3])
def test_force_leaves_its_limit_within_the_sample(begin, substeps):
    gain, damping, limit, voltage = 11.5, 5.5, 43.8, 4.0
    time = np.array([0.0, 2e-3, 4e-3])
    plant = Plant(gain=gain, damping=damping, effects=(ForceLimit(acceleration=limit),))
    left = (gain * voltage - damping * begin - limit) / (damping * limit)  # at the limit the speed grows linearly
    after = np.maximum(time - left, 0.0)
    top, edge = gain * voltage / damping, begin + limit * left
    expected = np.where(time < left, begin + limit * time, top - (top - edge) * np.exp(-damping * after))
    found = simulate_voltage(plant, time, np.full(3, voltage), start=(0.0, begin), substeps=substeps).velocity
    assert np.abs(found - expected).max() < 2e-7


def test_lagged_push_breaks_friction_loose_within_the_sample():
    lag, level = 0.02, 1.0
    plant = Plant(gain=2.0, damping=0.0, effects=(CoulombFriction(level=level), ActuatorLag(time_constant=lag)))
    time = np.arange(400) * 1e-3
    voltage = np.where(time < 0.0105, 0.0, 3.0)
    since = np.maximum(time - 0.011, 0.0)
    loose = -lag * np.log(1.0 - level / 6.0)  # the push 6 (1 - exp(-t/lag)) then passes the level
    t = np.maximum(since - loose, 0.0)
    left = np.exp(-loose / lag)
    speed = (6.0 - level) * t - 6.0 * left * lag * (1.0 - np.exp(-t / lag))
    found = simulate_voltage(plant, time, voltage)
    assert np.abs(found.velocity - speed).max() < 1e-6 * speed.max()


def test_push_that_just_passes_the_lower_of_two_levels_breaks_loose_there():
    lag, level, period = 1e-4, 1e-6, 1e-3
    friction = AsymmetricFriction(level_positive=level, level_negative=3.0)
    plant = Plant(gain=1.0, damping=0.0, effects=(friction, ActuatorLag(time_constant=lag)))
    time = np.arange(6) * period
    push = np.where(time < 2.5 * period, -level, level * (1.0 + 1e-3))  # of the sign of the high level first
    since = np.maximum(time - 3 * period, 0.0)
    change, left = level * (2.0 + 1e-3), 1e-3 * level  # push - level = left - change exp(-t/lag)
    loose = lag * np.log(change / left)
    t = np.maximum(since - loose, 0.0)
    speed = left * t - left * lag * (1.0 - np.exp(-t / lag))
    found = simulate_voltage(plant, time, push, substeps=1)
    assert np.abs(found.velocity - speed).max() < 1e-3 * speed.max()


@pytest.mark.parametrize(("patience", "refused"), [(0.5, True), (3.0, False)])
def test_trial_gives_up_where_a_step_is_split_too_often_and_else_changes_nothing(patience, refused):
    plant, time = plant_with(CoulombFriction(level=0.3)), grid(1.0)
    reference = np.full(time.size, 0.1)

    def tried():
        return closed_trial(LOOP, time, reference, accuracy=Accuracy(patience)).simulated(plant, (0.0, 0.0), 4)

    if refused:
        with pytest.raises(NumericalError, match="more parts than allowed"):
            tried()
    else:
        assert np.array_equal(tried().position, simulate_loop(plant, LOOP, time, reference, substeps=4).position)


def test_trial_follows_a_lag_that_splits_every_sample():
    time = grid(2.0)
    plant = plant_with(ActuatorLag(time_constant=2e-4))
    swings = np.where(np.arange(time.size) % 2, 1.0, -1.0)
    still, begin = np.zeros(time.size), (0.0, 0.0)
    tried = closed_trial(LOOP, time, still, feedforward=swings).simulated(plant, begin, 1)
    looped = simulate_loop(plant, LOOP, time, still, feedforward=swings, start=begin, substeps=1)
    assert np.array_equal(tried.position, looped.position)


def test_plants_tried_together_do_what_each_does_alone():
    time = grid(1.0)
    reference = np.where(time < 0.1, 0.0, 0.1)
    plants = [
        plant_with(CoulombFriction(level=0.3)),
        plant_with(ActuatorLag(time_constant=0.01), CoulombFriction(level=0.2)),
        plant_with(CoulombFriction(level=0.5)),
        Plant(gain=-200.0, damping=0.0, effects=(CoulombFriction(level=0.1),)),  # runs away
    ]
    starts = [(0.0, 0.0), (0.001, 0.0), (0.0, 0.01), (0.0, 0.0)]
    trial = closed_trial(LOOP, time, reference)
    found = trial.measured(plants, starts, 2)
    for row, plant, start in zip(found[:3], plants, starts, strict=False):
        assert np.array_equal(row, trial.simulated(plant, start, 2).measured)
    assert np.isnan(found[3]).all()
    assert trial.measured([], [], 2).shape == (0, time.size)


@pytest.mark.parametrize("lag", [0.005, 0.05, 0.15])
@pytest.mark.parametrize("limit", [2.0, 5.0])
def test_limit_of_force_after_a_lag_is_met_and_left_at_the_right_instant(lag: float, limit: float) -> None:
    """What the lag gives is a ramp within a step, and that may still be on the other side of the kink."""
    effects = (ForceLimit(acceleration=limit), ActuatorLag(time_constant=lag))
    plant, time = Plant(gain=20.0, damping=40.0, effects=effects), 5e-3 * np.arange(400)
    voltage = np.where(time % 1.0 < 0.5, 1.0, -1.0) * (0.5 + 0.5 * np.sin(7.0 * time))
    run = simulate_voltage(plant, time, voltage, before=0.0)

    def flow(_: float, x: list[float], u: float) -> list[float]:
        return [x[1], np.clip(20.0 * x[2] - 40.0 * x[1], -limit, limit), (u - x[2]) / lag]

    state, exact = np.zeros(3), [0.0]
    for k, u in enumerate(voltage[:-1]):
        span = (time[k], time[k + 1])
        part = solve_ivp(flow, span, state, args=(u,), method="RK45", rtol=1e-10, atol=1e-13, max_step=2.5e-4)
        state = part.y[:, -1]
        exact.append(state[0])
    assert substeps_for(plant, 5e-3) <= 3
    assert np.abs(run.position - exact).max() < 5e-8
