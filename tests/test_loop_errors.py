"""What simulations in closed loop miss: noise and shaking, or a structure that depends on the inputs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov
from scipy.stats import beta

import servolens
from servolens import lab
from servolens.effects import ActuatorLag, AsymmetricFriction, CoulombFriction, Delay
from servolens.identification.hypothesis import Hypothesis
from servolens.identification.likelihood import Likelihood
from servolens.identification.loop_errors import drawn_loop_errors, loop_error, share_limit
from servolens.identification.noise import NoiseModel
from servolens.identification.observed import least_missed
from servolens.identification.options import FitOptions
from servolens.identification.repeats import common_share, repeats, spread_of
from servolens.identification.shaken import shaken
from servolens.prediction import prediction_residual
from servolens.simulation.loop import simulate

GAIN, DAMPING, H = 2.0, 8.0, 1e-3
CART = servolens.Plant(gain=GAIN, damping=DAMPING)
WHITE = replace(NoiseModel.white(1e-6), gain=GAIN, damping=DAMPING)


def steps(seconds=8.0, kp=60.0):
    """Return a record of steps up and down whose position is that of the cart, without noise."""
    time = np.arange(int(seconds / H)) * H
    reference = np.where((time % 2.0 >= 0.5) & (time % 2.0 < 1.2), 0.1, 0.0)
    record = servolens.Record(
        time=time, position=0.0 * time, reference=reference, controller=servolens.Controller(kp=kp)
    )
    return replace(record, position=servolens.simulation.loop.simulate(CART, record).position)


@pytest.mark.parametrize(("explained", "left"), [(10, 40), (3, 6), (10, 4000)])
def test_limit_of_a_share_is_that_of_the_beta_distribution(explained, left):
    stream = np.random.default_rng(5)
    along, rest = stream.chisquare(explained, 20_000), stream.chisquare(left, 20_000)
    exact = beta.isf(1e-3, explained / 2, left / 2)
    assert share_limit(along / (along + rest), 1e-3) == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("corner", [3.0, 30.0])
def test_a_linear_loop_that_is_shaken_misses_what_its_lyapunov_equation_says(corner):
    record, rate = steps(30.0), 60.0
    noise = replace(WHITE, rate=rate, corner=corner)
    kept = np.exp(-corner * H)
    power = (WHITE.spread * rate**2) ** 2 * (1.0 - kept) / (1.0 + kept)  # stationary, of what shakes
    states = np.array([[0.0, 1.0, 0.0], [-GAIN * 60.0, -DAMPING, 1.0], [0.0, 0.0, -corner]])
    pushed = np.array([0.0, 0.0, np.sqrt(2.0 * corner * power)])
    variance = solve_continuous_lyapunov(states, -np.outer(pushed, pushed))[0, 0]
    drawn = drawn_loop_errors([CART], [record], noise)
    found = np.mean([np.mean(draw[0][1000:] ** 2) for draw in drawn])
    assert found == pytest.approx(variance + WHITE.spread**2, rel=0.1)  # 40 draws of some 100 independent values


@pytest.mark.parametrize("seed", [441001, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (441002, 441003))])
def test_an_axis_that_is_shaken_depends_on_no_input(seed):
    campaign = lab.hidden_campaign(seed, world="shaken")
    found = servolens.diagnose(campaign.records, heldout=campaign.heldout, effort="quick")
    assert (found.verdict, found.remainder.depends_on_inputs) == ("healthy", False)


SHAKEN = replace(WHITE, rate=80.0, corner=60.0)
OTHERS = 57
"""Draws that are not those from which the limits are taken: so many at once differ from any other number of them."""


def errors_of(kind, record, size):
    """Return errors of `record` that follow its motion, or that know nothing of it."""
    stream = np.random.default_rng(11)
    speed = np.gradient(record.position, record.time)
    missed = [draw[0] for draw in drawn_loop_errors([CART], [record], SHAKEN, count=OTHERS)]
    return {
        "shaking": missed[0],
        "friction": size * np.sign(speed) * (np.abs(speed) > 1e-3),
        "force in fast motion": missed[0] * (np.abs(speed) > 0.3 * np.abs(speed).max()),
        "noise": 1e-6 * stream.standard_normal(len(record)),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "depends"),
    [("shaking", False), ("friction", True), ("force in fast motion", True), ("noise", False)],
)
def test_what_follows_the_motion_is_no_shaking(kind, depends):
    record = steps()
    found = loop_error([CART], [record], [errors_of(kind, record, 1e-4)], SHAKEN, 11.0)
    assert found.depends is depends
    assert found.is_seen


def test_a_record_of_a_moment_does_not_show_whether_its_axis_is_shaken():
    record = steps().slice(0.45, 0.6)
    noise = replace(WHITE, rate=400.0, corner=2.0)
    drawn = drawn_loop_errors([CART], [record], noise, count=OTHERS)[:5]
    found = [loop_error([CART], [record], draw, noise, 11.0) for draw in drawn]
    assert [(one.depends, one.is_seen) for one in found] == [(False, False)] * 5


def test_shaking_that_moves_an_axis_far_and_slowly_is_told_from_what_follows_its_motion():
    """Such errors last as long as those of a model that lacks something: unwhitened they hardly count."""
    record = steps(4.0, kp=30.0)
    noise = replace(WHITE, spread=4e-5, rate=220.0, corner=25.0)
    draws = drawn_loop_errors([CART], [record], noise, count=OTHERS)[:8]
    assert all(np.std(draw[0]) > 0.005 * np.ptp(record.position) for draw in draws)  # material
    found = [loop_error([CART], [record], draw, noise, 8.0) for draw in draws]
    assert [(one.depends, one.is_seen) for one in found] == [(False, True)] * 8
    speed = np.gradient(record.position, record.time)
    for (draw,) in draws:
        for like in (speed / np.std(speed), np.sign(speed)):  # as large as the shaking
            assert loop_error([CART], [record], [draw + np.std(draw) * like], noise, 8.0).depends


def test_a_record_of_few_samples_beside_a_long_one_does_not_hide_what_follows_the_motion():
    record = steps(4.0, kp=30.0)
    records = [record, record.slice(0.5, 0.503)]
    noise = replace(WHITE, spread=4e-5, rate=220.0, corner=25.0)
    draw = drawn_loop_errors([CART] * 2, records, noise, count=OTHERS)[0]
    assert not loop_error([CART] * 2, records, draw, noise, 8.0).depends
    speed = np.gradient(record.position, record.time)
    follows = [draw[0] + np.std(draw[0]) / np.std(speed) * speed, draw[1]]
    assert loop_error([CART] * 2, records, follows, noise, 8.0).depends


def test_an_axis_that_does_not_move_depends_on_nothing_seen():
    record = steps().slice(0.0, 0.4)
    found = loop_error([CART], [record], drawn_loop_errors([CART], [record], SHAKEN, count=OTHERS)[0], SHAKEN, 11.0)
    assert not found.depends


def test_an_axis_that_sticks_may_rest_while_something_shakes_it():
    held = CART.with_effect(CoulombFriction(level=0.4))
    record = steps()
    still = servolens.simulation.loop.simulate(held, record).position
    record = replace(record, position=still)
    noise = replace(WHITE, rate=100.0, corner=100.0)
    drawn = drawn_loop_errors([held], [record], noise)
    assert not loop_error([held], [record], drawn[7], noise, 11.0).depends


def test_runs_that_repeat_each_other_are_recognised():
    one, other, shorter = steps(), steps(), steps(6.0)
    another_gain = steps(kp=61.0)
    late = replace(other, time=other.time + 100.0)
    assert repeats([one, another_gain, shorter, late, other]) == [(0, 3, 4)]
    assert repeats([one, another_gain]) == []


def test_spread_of_repeated_runs_is_that_of_their_noise():
    stream = np.random.default_rng(3)
    runs = [replace(run, position=run.position + 2e-5 * stream.standard_normal(len(run))) for run in [steps()] * 3]
    assert spread_of(runs, [(0, 1, 2)]) == pytest.approx(2e-5, rel=0.03)
    noise = [stream.standard_normal(5000) for _ in range(4)]
    assert common_share(noise, [(0, 1, 2, 3)]) == pytest.approx(0.25, abs=0.03)
    assert common_share([noise[0], noise[0]], [(0, 1)]) == pytest.approx(1.0)


def test_an_error_that_repeats_in_each_run_is_no_shaking():
    record, noise = steps(), SHAKEN
    first, second = (draw[0] for draw in drawn_loop_errors([CART], [record], noise)[:2])
    twice, plants = [record, record], [CART, CART]
    assert loop_error(plants, twice, [first, first], noise, 11.0).depends
    assert not loop_error(plants, twice, [first, second], noise, 11.0).depends


@pytest.mark.parametrize("deviation", [1e-6, 0.2e-6])
def test_slow_noise_as_large_as_an_encoder_step_is_no_rounding(deviation):
    """From sample to sample it hardly changes, so that the highest frequencies show the rounding alone."""
    step = 1e-6
    noise = lab.SensorNoise(deviation=deviation, autoregression=(0.97,))
    setup = lab.Setup(surroundings=lab.Surroundings(noise=noise, encoder=step))
    truth = lab.Truth(gain=GAIN, damping=DAMPING)
    records = [lab.step_record(truth, kp=60.0, setup=setup, seed=720450 + k) for k in range(2)]
    likelihood = Likelihood(records, CART, FitOptions())
    assert likelihood.white.share > 0.8
    found = likelihood.judged(CART)
    rounding, slow = step**2 / 12.0, deviation**2
    assert found.noise.share == pytest.approx(rounding / (rounding + slow), rel=0.3)
    missed = [error for draw in drawn_loop_errors([CART] * 2, records, found.noise) for error in draw]
    still = [simulate(CART, record).position - record.position for record in records]
    assert np.std(np.concatenate(missed)) == pytest.approx(np.std(np.concatenate(still)), rel=0.25)


@pytest.mark.parametrize("unpowered", [True, False])
def test_a_draw_begins_as_its_record_does_where_the_record_begins_with_its_step(unpowered):
    axis = CART.with_effect(ActuatorLag(time_constant=0.02))
    time = np.arange(1500) * H
    begun = servolens.Record(
        time=time,
        position=0.0 * time,
        reference=np.full(time.size, 0.1),
        controller=servolens.Controller(kp=60.0),
        voltage_before=0.0 if unpowered else None,
    )
    moved = simulate(axis, begun)
    record = replace(begun, position=moved.position, voltage=moved.voltage, voltage_before=None)
    likelihood = Likelihood([record], axis, FitOptions())
    noise = replace(WHITE, rate=20.0, corner=3.0)
    (run,) = likelihood.runs(noise, unpowered=unpowered)
    (draws,) = shaken([run], [axis], [run.start])
    assert draws.shape[0] == time.size
    assert np.sqrt(np.mean(draws[:30] ** 2)) < 2.0


def test_what_was_applied_before_a_record_matters_no_more_than_its_initial_velocity_where_friction_acts():
    """From rest dry friction swallows the small change by which the sensitivity to that velocity is measured."""
    friction = AsymmetricFriction(level_positive=0.003, level_negative=0.024)
    axis = servolens.Plant(gain=0.5, damping=18.0, effects=(friction, Delay(time=0.0005)))
    time = np.arange(2000) * H
    begun = servolens.Record(
        time=time,
        position=0.0 * time,
        reference=np.full(time.size, 0.06),
        controller=servolens.Controller(kp=2770.0, kd=35.0),
    )
    moved = simulate(axis, begun)
    noise = 3e-6 * np.random.default_rng(1).standard_normal(time.size)
    record = replace(begun, position=moved.position + noise, voltage=moved.voltage)
    likelihood = Likelihood([record], axis, FitOptions())
    likelihood.knows_beginning = True
    beside = NoiseModel.white(3e-6)
    missed = [
        likelihood.misfit(Hypothesis(axis, beside, (), 0.0, 0.0, unpowered=unpowered, local={}), [axis])
        for unpowered in (False, True)
    ]
    assert missed[1] == pytest.approx(missed[0], abs=30.0)


def test_an_initial_state_is_that_of_the_whole_record_also_where_its_end_alone_is_judged():
    """Else a wrong model explains the end by an absurd beginning."""
    record = lab.step_record(lab.NLM1, 60, noise=1e-5, seed=3)
    likelihood = Likelihood([record], CART, FitOptions())
    (run,) = likelihood.runs(NoiseModel.white(1e-5))
    whole, start = least_missed(run, CART, 0)
    end, same = least_missed(run, CART, record.time.size // 2)
    np.testing.assert_array_equal(start, same)
    assert 0.0 < end < whole


@pytest.mark.parametrize("first", [0.0, 1.0, 2.0])
def test_the_noise_of_the_first_sample_where_friction_holds_an_axis_is_no_structure(first):
    axis = CART.with_effect(AsymmetricFriction(level_positive=0.3, level_negative=0.6))
    records, errors = [], []
    for way, kp in ((1.0, 60.0), (-1.0, 200.0)):
        time, stream = np.arange(2500) * H, np.random.default_rng(int(kp))
        waits = servolens.Record(
            time=time,
            position=0.0 * time,
            reference=np.where(time >= 0.3, 0.1, 0.0),
            controller=servolens.Controller(kp=kp),
        )
        noise = WHITE.spread * stream.standard_normal(time.size)
        noise[0] = way * first * WHITE.spread  # a simulation begins there, and friction holds it there
        records.append(replace(waits, position=simulate(axis, waits).position + noise))
        errors.append(prediction_residual(axis, records[-1]))
    assert not loop_error([axis, axis], records, errors, WHITE, 15.0).depends
