"""The virtual laboratory against closed forms, SciPy, and the paper."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.linalg import expm
from scipy.signal import lfilter

from servolens import lab
from servolens.errors import InputError, NumericalError
from servolens.lab import loop
from servolens.record import Controller

STICKY = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.8}})
STICKY_DECAY = lab.Truth(
    gain=1.9165,
    damping=5.9986,
    effects={
        "velocity_decay_damping": {"alpha1": 17.3264, "alpha2": 13.1068},
        "coulomb_friction": {"level": 0.8},
    },
)
SMOOTH = {"NLM1": lab.NLM1, "NLM2": lab.NLM2, "NLM3": lab.NLM3}
TABLE_ONE = [(60, 0), (60, 5), (80, 0), (80, 5), (80, 10), (100, 0), (100, 5), (100, 10)]


def smooth_push(truth, u, v):
    """β u − C(v) v with the paper's eq. 20, written once more."""
    law = truth.effects.get("velocity_decay_damping", {"alpha1": 0.0, "alpha2": 0.0})
    return truth.gain * u - (truth.damping + law["alpha1"] * np.exp(-law["alpha2"] * abs(v))) * v


def by_events(truth, record):
    """Position at the samples under the record's held voltage: SciPy, stopped at every reversal."""
    level = truth.effects.get("coulomb_friction", {"level": 0.0})["level"]
    x, v = 0.0, 0.0
    positions = [x]
    for k in range(len(record) - 1):
        x, v = held_motion(truth, level, x, v, record.voltage[k], record.time[k + 1] - record.time[k])
        positions.append(x)
    return np.array(positions)


def held_motion(truth, level, x, v, u, left):
    while left > 0:
        push = smooth_push(truth, u, v)
        if v == 0 and abs(push) <= level:
            break
        d = np.sign(v) if v else np.sign(push)

        def reversal(t, s, d=d):
            return d * s[1] if t > 0 else 1.0

        reversal.terminal, reversal.direction = True, -1.0
        done = solve_ivp(
            lambda t, s, d=d: [s[1], smooth_push(truth, u, s[1]) - d * level],
            (0.0, left),
            [x, v],
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
            events=reversal,
        )
        x, v, left = *done.y[:, -1], left - done.t[-1]
        if done.status == 1:
            v = 0.0
    return x, v


@pytest.mark.parametrize("kd", [0.0, 5.0], ids=["P", "PD"])
@pytest.mark.parametrize("truth", [lab.LM1, lab.LM2, lab.LM3], ids=["LM1", "LM2", "LM3"])
def test_linear_loop_is_the_matrix_exponential(truth, kd):
    record = lab.step_record(truth, 100, kd, encoder=0.0)
    h = 1e-3
    held = expm(h * np.array([[0, 1, 0], [0, -truth.damping, truth.gain], [0, 0, 0]]))
    state, before, expected = np.zeros(2), 0.0, []
    for _ in record.time:
        expected.append(state[0])
        u = 100 * (0.1 - state[0]) - kd * (state[0] - before) / h
        before = state[0]
        state = held[:2, :2] @ state + held[:2, 2] * u
    # RK4 at 0.25 ms: (c h)^5/120 a step is 1e-17 of the motion; what is left is rounding
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("kp", "kd"), [(60, 0.0), (100, 5.0)])
@pytest.mark.parametrize("truth", SMOOTH.values(), ids=SMOOTH)
def test_smooth_motion_agrees_with_scipy(truth, kp, kd):
    record = lab.step_record(truth, kp, kd, encoder=0.0, duration=0.6)
    assert np.abs(by_events(truth, record) - record.position).max() < 1e-9


@pytest.mark.parametrize("truth", [STICKY, STICKY_DECAY], ids=["coulomb", "coulomb and decay"])
@pytest.mark.parametrize(("kp", "kd"), [(60, 0.0), (60, 2.0)])
def test_dry_friction_agrees_with_scipy_stopped_at_events(truth, kp, kd):
    record = lab.step_record(truth, kp, kd, encoder=0.0, duration=0.8, reference=(0.1, 0.09))
    expected = by_events(truth, record)
    assert np.any(np.diff(np.sign(np.diff(record.position))) != 0), "the run must reverse"
    assert np.abs(expected - record.position).max() < 1e-9


def test_steps_are_of_fourth_order_across_reversals(monkeypatch):
    def position(substep):
        monkeypatch.setattr(loop, "SUBSTEP", substep)
        return lab.step_record(STICKY_DECAY, 60, encoder=0.0).position

    exact = position(6.25e-5)
    errors = [np.abs(position(h) - exact).max() for h in (1e-3, 5e-4)]
    assert errors[0] / errors[1] > 2**3.5
    assert errors[0] < 1e-9


def test_axis_sticks_to_the_bit_where_the_push_is_smaller():
    record = lab.step_record(STICKY, 60, encoder=0.0)
    at_end = record.position[record.time > 1.0]
    assert np.unique(at_end).size == 1
    band = 0.8 / (1.9 * 60)
    assert 0 < abs(0.1 - at_end[0]) <= band
    assert lab.step_record(STICKY, 60, reference=0.99 * band, encoder=0.0).position.max() == 0.0
    assert lab.step_record(STICKY, 60, reference=1.01 * band, encoder=0.0).position.max() > 0.0


def test_saturated_axis_follows_the_closed_form_of_constant_voltage():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"saturation": {"limit": 2.0}})
    record = lab.step_record(truth, 60, encoder=0.0)
    clipped = int(np.argmax(record.voltage < 2.0))
    assert clipped > 50
    t = record.time[:clipped]
    expected = 1.9 * 2.0 / 6.0 * (t - (1 - np.exp(-6.0 * t)) / 6.0)
    np.testing.assert_allclose(record.position[:clipped], expected, rtol=0, atol=1e-13)
    assert record.voltage[0] == pytest.approx(6.0)
    assert record.voltage_limit is None


def test_saturation_has_two_sides():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"saturation": {"limit": 2.0}})
    up, down = (lab.step_record(truth, 60, reference=r, encoder=0.0) for r in (0.1, -0.1))
    np.testing.assert_array_equal(up.position, -down.position)


def test_stated_voltage_limit_clips_and_is_logged():
    stated = lab.step_record(lab.LM1, 60, setup=lab.Setup(voltage_limit=2.0))
    hidden = lab.Truth(gain=1.8545, damping=6.1520, effects={"saturation": {"limit": 2.0}})
    np.testing.assert_array_equal(stated.position, lab.step_record(hidden, 60).position)
    assert stated.voltage_limit == 2.0
    looser = lab.step_record(hidden, 60, setup=lab.Setup(voltage_limit=4.0))
    np.testing.assert_array_equal(looser.position, stated.position)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_logged_voltage_is_the_digital_pd_of_the_logged_position(share):
    rig = lab.Setup(rest=0.1, controller=Controller(kp=80, kd=5, derivative_filter=share))
    record = lab.step_record(lab.NLM2, noise=1e-5, seed=4, setup=rig)
    raw = np.diff(record.position, prepend=record.position[0]) / 1e-3
    derivative = lfilter([share], [1.0, share - 1.0], raw)
    expected = 80 * (record.reference - record.position) - 5 * derivative
    np.testing.assert_allclose(record.voltage, expected, rtol=0, atol=1e-10)
    assert (record.controller.kp, record.controller.kd, record.controller.derivative_filter) == (80, 5, share)


def test_encoder_shows_whole_steps_and_the_loop_feels_them():
    record = lab.step_record(lab.NLM1, 60, encoder=25e-6)
    counts = record.position / 25e-6
    np.testing.assert_allclose(counts, np.rint(counts), rtol=0, atol=1e-9)
    assert record.encoder_resolution == 25e-6
    ideal = lab.step_record(lab.NLM1, 60, encoder=0.0)
    assert ideal.encoder_resolution is None
    # rounding is off by half a step at most; the loop filters what it feeds back of it
    assert 0 < np.abs(record.position - ideal.position).max() < 25e-6


def test_noise_has_the_size_asked_for():
    record = lab.step_record(lab.LM1, 60, reference=0.0, duration=4.0, noise=2e-5, seed=8, encoder=0.0)
    # 4001 samples: the standard deviation is known to 1/sqrt(2·4001) = 1.1 %, taken four times; the cart itself
    # hardly follows white noise
    assert np.std(np.diff(record.position)) / np.sqrt(2) == pytest.approx(2e-5, rel=0.045)


def test_rest_and_levels_make_the_reference():
    record = lab.step_record(lab.LM1, 60, reference=(0.1, 0.0, -0.05), duration=0.4, setup=lab.Setup(rest=0.2))
    assert len(record) == 200 + 3 * 400 + 1
    assert record.time[record.edges()].tolist() == pytest.approx([0.2, 0.6, 1.0])
    assert record.reference[[0, 200, 600, 1000, 1400]].tolist() == [0.0, 0.1, 0.0, -0.05, -0.05]
    assert np.all(record.position[:201] == 0.0)
    assert len(record.steps()) == 3


def test_same_seed_gives_the_same_record_and_another_seed_another():
    first, again, other = (lab.step_record(lab.NLM1, 60, noise=1e-5, seed=s).position for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


@pytest.mark.parametrize("truth", [lab.NLM1, STICKY_DECAY], ids=["smooth", "sticky"])
def test_many_runs_at_once_are_the_runs_one_by_one(truth):
    settings = {"reference": (0.1, 0.08), "duration": 0.6, "encoder": 0.0, "noise": 1e-4}
    together = lab.step_records(truth, 60, 1.0, repeats=4, seed=5, **settings, setup=lab.Setup(voltage_limit=4.0))
    streams = np.random.default_rng(5).spawn(4)
    for stream, record in zip(streams, together, strict=True):
        alone = lab.step_record(truth, 60, 1.0, seed=stream, **settings, setup=lab.Setup(voltage_limit=4.0))
        # the two differ by the last bit of exp
        np.testing.assert_allclose(record.position, alone.position, rtol=0, atol=1e-13)
        np.testing.assert_allclose(record.voltage, alone.voltage, rtol=0, atol=1e-9)


def test_asking_for_more_runs_leaves_the_first_as_they_were():
    few, many = (lab.step_records(lab.NLM1, 60, repeats=n, seed=5, duration=0.3) for n in (2, 5))
    for a, b in zip(few, many[:2], strict=True):
        np.testing.assert_array_equal(a.position, b.position)


def test_thousand_noisy_runs_scatter_around_the_truth():
    records = lab.step_records(lab.NLM1, 60, repeats=1000, seed=0, duration=1.0, noise=1e-4, encoder=0.0)
    quiet = lab.step_record(lab.NLM1, 60, duration=1.0, encoder=0.0)
    scatter = np.array([record.position for record in records]) - quiet.position
    # each sample's mean over 1000 runs is known to 1e-4/sqrt(1000) = 3.2 µm; 1001 correlated draws stay within 5 of it
    assert np.abs(scatter.mean(axis=0)).max() < 5 * 1e-4 / np.sqrt(1000)
    assert 0.95e-4 < scatter.std(axis=0).mean() < 1.1e-4


def test_table_one_has_the_papers_gains():
    records = lab.table_one(lab.NLM1, seed=3)
    assert [(r.controller.kp, r.controller.kd) for r in records] == TABLE_ONE
    assert all(len(r) == 1501 and r.sample_time == pytest.approx(1e-3) for r in records)
    np.testing.assert_array_equal(records[4].position, lab.table_one(lab.NLM1, seed=3)[4].position)


def test_paper_campaign_is_three_proportional_steps_with_noise_of_their_own():
    records = lab.paper_campaign(lab.NLM3, seed=3, noise=1e-3, encoder=0.0)
    assert [(r.controller.kp, r.controller.kd) for r in records] == [(60, 0), (80, 0), (100, 0)]
    noises = [r.position[:5] for r in records]
    assert not np.allclose(noises[0], noises[1])


def settling_time(truth, kp, kd):
    record = lab.step_record(truth, kp, kd, encoder=0.0)
    outside = np.abs(record.position - 0.1) > 1e-3
    return record.time[np.flatnonzero(outside)[-1] + 1]


def test_design_gains_of_the_paper_notes_hold_on_the_sampled_cart():
    # least Kd for 1 % in 0.5 s on NLm3: 3.79 continuous, 3.82 sampled
    assert settling_time(lab.NLM3, 100, 3.83) <= 0.5
    assert settling_time(lab.NLM3, 100, 3.80) > 0.5
    # the answer of the linear model breaks on the nonlinear cart: 0.547 s continuous
    assert settling_time(lab.NLM3, 100, 6.28) == pytest.approx(0.547, abs=0.005)
    # and the paper's own 3.55 settles in 0.6125 s
    assert settling_time(lab.NLM3, 100, 3.55) == pytest.approx(0.6125, abs=0.005)


def test_constant_model_of_the_virtual_cart_is_that_of_the_paper_notes():
    # the notes simulate a continuous loop, logged at 1 kHz with a 25 µm encoder: here a loop at 20 kHz
    fine = lab.step_record(lab.NLM1, 60, encoder=0.0, duration=0.9, sample_time=5e-5)
    t, y = fine.time[::20], np.rint(fine.position[::20] / 25e-6) * 25e-6
    twice = cumulative_trapezoid(cumulative_trapezoid(60 * (0.1 - y), t, initial=0), t, initial=0)
    columns = np.column_stack([np.ones_like(t), t, -cumulative_trapezoid(y, t, initial=0), twice])
    _, _, damping, gain = np.linalg.lstsq(columns, y, rcond=None)[0]
    # half a unit of the last digit printed, and what is left of the hold (a twentieth of its 0.6 % and 0.3 % at 1 kHz)
    assert damping == pytest.approx(6.14, abs=0.005 + 0.003)
    assert gain == pytest.approx(1.805, abs=0.0005 + 0.0003)


@pytest.mark.parametrize(
    ("truth", "numbers"),
    [
        (lab.LM1, (1.8545, 6.1520)),
        (lab.LM2, (1.7482, 5.4916)),
        (lab.LM3, (1.7866, 4.5866)),
        (lab.NLM1, (1.9165, 5.9986, 17.3264, 13.1068)),
        (lab.NLM2, (1.9180, 5.6035, 22.1357, 18.2233)),
        (lab.NLM3, (1.9100, 3.7990, 15.2528, 5.9934)),
    ],
    ids=["LM1", "LM2", "LM3", "NLM1", "NLM2", "NLM3"],
)
def test_carts_carry_the_printed_numbers(truth, numbers):
    effects = [value for values in truth.effects.values() for value in values.values()]
    assert (truth.gain, truth.damping, *effects) == numbers


def test_laboratory_shares_no_physics_with_what_it_tests():
    script = "import sys, servolens.lab; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {tuple(name.split(".")[:2]) for name in done.stdout.split()}
    own = {name[1] for name in loaded if name[0] == "servolens" and name[1:]}
    plain = {"clock", "record", "record_signals", "record_text", "ticks", "controller", "control_arithmetic"}
    plain |= {"errors", "findings", "results", "units"}
    assert own <= {"lab", *plain}
    assert {name[0] for name in loaded}.isdisjoint({"casadi", "numba", "scipy", "control"})


def test_truth_is_frozen_and_survives_pickling():
    with pytest.raises(TypeError):
        lab.NLM1.effects["velocity_decay_damping"]["alpha1"] = 0.0
    assert pickle.loads(pickle.dumps(lab.NLM1)) == lab.NLM1


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ({"gremlin": {}}, "has no effect 'gremlin'; it has actuator_lag, .* coulomb_friction"),
        ({"coulomb_friction": {"size": 1.0}}, "coulomb_friction needs level; got size"),
        ({"coulomb_friction": {"level": float("nan")}}, "coulomb_friction.level must be finite, got nan"),
    ],
    ids=["unknown effect", "wrong parameter", "not finite"],
)
def test_impossible_truth_is_refused(effects, message):
    with pytest.raises(InputError, match=message):
        lab.Truth(gain=1.9, damping=6.0, effects=effects)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": 1e-5}, "noise needs a seed"),
        ({"noise": -1.0}, "noise must be at least 0"),
        ({"encoder": float("inf")}, "encoder must be at least 0 and finite"),
        ({"sample_time": 0.0}, "sample_time must be positive"),
        ({"duration": 1e-4}, r"duration must be at least one sample \(0.001 s\), got 0.0001 s"),
        ({"reference": ()}, "reference must be one finite level"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_impossible_bench_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        lab.step_record(lab.NLM1, 60, **settings)


@pytest.mark.parametrize(
    "run",
    [lambda: lab.step_record(lab.LM1, -500), lambda: lab.step_records(lab.LM1, -500, repeats=2, seed=1)],
    ids=["one", "many"],
)
def test_unstable_loop_is_named(run):
    with pytest.raises(NumericalError, match="the loop is unstable"):
        run()


def test_no_runs_are_refused():
    with pytest.raises(InputError, match="repeats must be at least 1, got 0"):
        lab.step_records(lab.LM1, 60, repeats=0, seed=1)
