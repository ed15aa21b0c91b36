"""Whether what a model leaves depends on the inputs: laws that no effect has, shaking, and the size of either."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter, welch
from scipy.stats import norm

import servolens
from servolens import lab
from servolens.diagnosis.case import Case
from servolens.effects import CoulombFriction, SensorLag
from servolens.identification.autoregression import burg
from servolens.identification.likelihood import Likelihood
from servolens.identification.loop_errors import drawn_loop_errors
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.options import FitOptions
from servolens.identification.score import FALSE_ALARM, ScoreTest
from servolens.identification.shaken import at_least_white, shaken, shaking
from servolens.identification.structure import TESTS, Answer, answers, depends_on_inputs, joint_chance

GAIN, DAMPING, H = 2.0, 8.0, 1e-3
CART = servolens.Plant(gain=GAIN, damping=DAMPING)


def loop(plant, levels=(0.0, 0.1, 0.0, 0.08, 0.0), each=1.0):
    """Return a record of the loop of `plant`, without noise."""
    time = np.arange(int(len(levels) * each / H)) * H
    reference = np.array(levels)[np.minimum((time / each).astype(int), len(levels) - 1)]
    record = servolens.Record(
        time=time, position=0.0 * time, reference=reference, controller=servolens.Controller(kp=60.0)
    )
    run = servolens.simulation.loop.simulate(plant, record)
    return replace(record, position=run.measured, voltage=run.voltage)


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_size_of_noise_is_as_uncertain_as_that_of_many_draws_is(pole):
    samples, stream = 2000, np.random.default_rng(1)
    draws = lfilter([1.0], [1.0, -pole], stream.standard_normal((800, samples + 200)), axis=1)[:, 200:]
    spread = 1.0 / np.sqrt(1.0 - pole**2)
    filters = (np.ones(1),) if pole == 0.0 else (np.ones(1), np.array([1.0, -pole]))
    noise = replace(NoiseModel.white(1.0), filters=filters, scales=np.ones(len(filters)), spread=spread)
    assert noise.spread_error(samples) == pytest.approx(np.std(np.sqrt(np.mean(draws**2, axis=1))), rel=0.1)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_slow_noise_is_told_from_an_autoregression_of_the_first_order(seed):
    stream, samples, pole = np.random.default_rng(seed), 3000, 0.98
    position = stream.standard_normal(samples)
    position += 0.25 * lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], stream.standard_normal(samples))
    _, spreads = burg([position], 1, 0.0)
    found = NoiseModel.white(1.0).coloured([position], [Whitener(position, 0.0 * position, NoiseModel.white(1.0))])
    assert found.order > 1
    fewer = 2.0 * samples * np.log(spreads[-1]) + np.log(samples)
    assert 2.0 * samples * np.log(found.innovation) + found.parameters * np.log(samples) < fewer - 20.0


@pytest.mark.parametrize("corner", [5.0, 60.0])
@pytest.mark.parametrize("rate", [60.0, 250.0])
def test_draws_of_a_shaken_loop_leave_an_observer_white_noise(corner, rate):
    record = loop(CART)
    likelihood = Likelihood([record], CART, FitOptions())
    noise = replace(NoiseModel.white(1e-6), gain=GAIN, damping=DAMPING, rate=rate, corner=corner)
    (drawn,) = shaken(likelihood.runs(noise), [CART], [np.array([record.position[0], 0.0])])
    settled = drawn[500:]  # the observer's gains are those of an axis whose beginning is uncertain
    assert np.mean(settled**2) == pytest.approx(1.0, abs=0.03)
    for lag in (1, 2, 5, 20, 100):
        assert abs(np.mean(settled[lag:] * settled[:-lag])) < 0.02


def test_draws_of_a_loop_whose_sensor_lags_are_of_what_it_shows():
    plant = CART.with_effect(SensorLag(time_constant=3e-3))
    record = loop(plant)
    noise = replace(NoiseModel.white(1e-6), gain=GAIN, damping=DAMPING, rate=60.0, corner=5.0)
    (drawn,) = shaken(Likelihood([record], plant, FitOptions()).runs(noise), [plant], [np.array([0.0, 0.0])])
    missed = np.array([draw[0] for draw in drawn_loop_errors([plant], [record], noise)])
    for draws in (drawn[500:].T, missed[:, 500:]):  # none errs alike: the steps of the reference are no noise
        assert np.mean(np.mean(draws, axis=0) ** 2) < 3.0 / len(draws) * np.mean(draws**2)


def test_draws_of_a_shaken_axis_that_sticks_rest_with_it():
    plant = CART.with_effect(CoulombFriction(level=2.0))
    record = loop(plant)
    likelihood = Likelihood([record], plant, FitOptions())
    noise = replace(NoiseModel.white(1e-6), gain=GAIN, damping=DAMPING, rate=250.0, corner=60.0)
    (drawn,) = shaken(likelihood.runs(noise), [plant], [np.array([record.position[0], 0.0])])
    moves = np.abs(np.gradient(record.position, H)) > 1e-3
    assert np.mean(drawn[~moves] ** 2) < 0.93 * np.mean(drawn[moves] ** 2)


def test_draws_of_a_simulated_loop_are_as_large_as_its_errors():
    record = loop(CART)
    noise = replace(NoiseModel.white(1e-6), gain=GAIN, damping=DAMPING, rate=60.0, corner=5.0)
    runs = Likelihood([record], CART, FitOptions()).simulating().runs(noise)
    (drawn,) = shaken(runs, [CART], [np.empty(0)])
    missed = np.concatenate([draw[0] for draw in drawn_loop_errors([CART], [record], noise)])
    assert np.mean(drawn**2) * noise.innovation**2 == pytest.approx(np.mean(missed**2), rel=0.2)


def hidden_force(kind, run, time):
    """Return an acceleration along a loop that is shaken: none, of a law that two quantities make, or of a mode."""
    if kind == "friction that grows":
        return 2.0 * np.sign(run.velocity) * (np.cumsum(np.abs(run.velocity)) * H - 0.2)
    if kind == "damping that changes":
        return 6.0 * run.velocity * (time / time[-1] - 0.5)
    if kind == "a mode that rings":
        pole = np.exp((-0.3 + 40.0j) * H)
        kicked = np.diff(run.voltage, prepend=run.voltage[0])
        return 0.2 * lfilter([1.0], [1.0, -pole], kicked.astype(complex)).imag
    return 0.0 * time


def shaken_record(kind, seed):
    """Return a record of a loop that is shaken, and moved by a hidden force."""
    clean, stream = loop(CART, (0.0, 0.1, 0.0, 0.08, -0.05, 0.0)), np.random.default_rng(seed)
    noise = replace(NoiseModel.white(2e-6), gain=GAIN, damping=DAMPING, rate=60.0, corner=60.0)
    shake = shaking(noise, clean, stream)[:, 0]
    force = hidden_force(kind, servolens.simulate(CART, clean), clean.time)
    run = servolens.simulate(CART, clean, acceleration=shake + force)
    return replace(clean, position=run.position + 2e-6 * stream.standard_normal(len(clean)), voltage=run.voltage)


@pytest.mark.parametrize(
    ("kind", "asked"),
    [("nothing", None), ("friction that grows", 2), ("damping that changes", 2), ("a mode that rings", 1)],
)
def test_a_shaken_loop_shows_a_force_to_the_instrument_that_is_made_for_it(kind, asked):
    likelihood = Likelihood([shaken_record(kind, 8)], CART, FitOptions())
    test = ScoreTest(likelihood, likelihood.judged(CART))
    exceeded = {place // 2 for place, answer in enumerate(answers(test)) if answer.chance < FALSE_ALARM / TESTS}
    assert exceeded == set() if asked is None else asked in exceeded
    assert depends_on_inputs(test) == (asked is not None)


@pytest.mark.parametrize(("kind", "is_enough"), [("nothing", True), ("damping that changes", False)])
def test_records_held_out_are_asked_as_well_of_an_axis_that_is_shaken(kind, is_enough):
    fitted, other = (shaken_record(*of) for of in (("nothing", 8), (kind, 9)))
    case = Case((fitted,), (other,), {}, 1)
    assert case.is_enough(case.base)
    assert case.is_enough_everywhere(case.base) == is_enough
    assert case.is_enough(case.base) == is_enough
    assert Case((fitted,), (), {}, 1).is_enough_everywhere(case.base)


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        *(pytest.param("growing_friction", seed, marks=pytest.mark.slow) for seed in (740863, 740864)),
        pytest.param("changing_damping", 740161, marks=pytest.mark.slow),
        pytest.param("hanging_load", 740961, marks=pytest.mark.slow),
        ("hanging_load", 740995),  # among fifty modes only the one that rings shows it
        pytest.param("switching_friction", 742796, marks=pytest.mark.slow),  # with a phase of its own in each record
    ],
)
def test_a_law_of_no_effect_is_not_taken_for_shaking(law, seed):
    campaign = lab.hidden_campaign(seed, foreign=law, world="white")
    found = servolens.diagnose(campaign.records, heldout=campaign.heldout, effort="quick")
    assert found.verdict in ("unexplained", "partly_explained")
    assert found.remainder.depends_on_inputs
    assert "shaken_axis" not in {finding.code for finding in found.findings}


@pytest.mark.parametrize("size", [3000, 300])
def test_draws_that_are_weak_where_they_are_slow_become_as_strong_as_white_noise(size):
    """By Welch's method; what is stronger stays as it is."""

    def power(draws):
        return np.mean(welch(draws, nperseg=128, axis=0)[1][2:], axis=1) / 2.0

    white = np.random.default_rng(2).standard_normal((size, 40))
    weak = lfilter([1.0, -0.9], [1.0], white, axis=0)  # from a tenth to nearly twice as strong
    now, then = power(at_least_white(weak)), power(weak)
    slow, fast = slice(0, 6), slice(40, 60)
    assert np.all(then[slow] < 0.35)
    assert np.mean(now[slow]) == pytest.approx(1.0, rel=0.25)
    np.testing.assert_allclose(now[fast], then[fast], rtol=0.1)
    assert np.std(at_least_white(white) - white) < 0.1
    assert at_least_white(white[:1]).shape == (1, 40)


@pytest.mark.parametrize("shared", [0.0, 0.7])
def test_answers_that_each_fall_a_little_short_count_together_no_more_often_than_is_stated(shared):
    """Of tests that share a part of what they ask, each beside as many draws as a diagnosis makes."""
    stream = np.random.default_rng(12)

    def chances(count):
        common = np.sqrt(shared) * stream.standard_normal(count)
        return norm.sf(common + np.sqrt(1.0 - shared) * stream.standard_normal((6, count)))

    def joint(rows):
        return joint_chance([Answer(1.0, row) for row in rows])

    found = joint(np.column_stack([chances(40), np.full(6, 2e-4)]))
    assert found < FALSE_ALARM / TESTS
    often = np.mean([joint(chances(41)) < 0.01 for _ in range(3000)])
    assert 0.001 < often < (0.012 if shared == 0.0 else 0.025)
    assert joint_chance([Answer(1e-9)] * 3) == 1.0


@pytest.mark.parametrize("closed", [False, True])
def test_an_axis_that_is_shaken_moves_as_its_acceleration_says(closed):
    """Against the exact solution of the sampled linear axis; the actuator's dead zone does not see what shakes it."""
    time = np.arange(400) * H
    shake = np.random.default_rng(3).standard_normal(time.size)
    plant = CART.with_effect(servolens.effects.DeadZone(width=5.0))
    setup = {"reference": 0.0 * time, "controller": servolens.Controller(kp=1.0)} if closed else {"voltage": 0.0 * time}
    run = servolens.simulate(plant, servolens.Record(time=time, position=0.0 * time, **setup), acceleration=shake)
    left = np.exp(-DAMPING * H)
    position, speed = np.zeros(time.size), np.zeros(time.size)
    for k in range(time.size - 1):
        steady = shake[k] / DAMPING
        position[k + 1] = position[k] + steady * H + (speed[k] - steady) * (1.0 - left) / DAMPING
        speed[k + 1] = steady + (speed[k] - steady) * left
    np.testing.assert_allclose(run.position, position, atol=1e-6 * np.abs(position).max())


def test_an_acceleration_of_another_length_is_refused():
    time = np.arange(10) * H
    record = servolens.Record(time=time, position=0.0 * time, voltage=0.0 * time)
    with pytest.raises(servolens.InputError, match="time has 10 samples, the acceleration 9"):
        servolens.simulate(CART, record, acceleration=np.zeros(9))
