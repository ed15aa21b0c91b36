"""The observer: Kalman's gains, for an axis that is shaken and for sampling instants that are not those stated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import servolens
from servolens import lab
from servolens.effects import CoulombFriction, QuadraticDrag
from servolens.identification.likelihood import Likelihood
from servolens.identification.noise import NoiseModel
from servolens.identification.observer import observer_of
from servolens.identification.options import FitOptions
from servolens.plant import Plant

H, GAIN, DAMPING = 1e-3, 2.0, 8.0
TIME = np.arange(4000) * H
WHITE = replace(NoiseModel.white(1e-5), gain=GAIN, damping=DAMPING)


def transition(corner):
    """Return what a sample later is left of position, velocity and a shaking that is held between samples."""
    left, kept = np.exp(-DAMPING * H), np.exp(-corner * H)
    given = (1.0 - left) / DAMPING
    return np.array([[1.0, given, 0.5 * given * H], [0.0, left, given], [0.0, 0.0, kept]])


def test_nothing_is_observed_where_nothing_shakes_and_the_clock_is_true():
    assert observer_of(WHITE, TIME, 0.0 * TIME, 0.0 * TIME) is None


@pytest.mark.parametrize("rate", [20.0, 200.0])
@pytest.mark.parametrize("corner", [2.0, 40.0, 600.0])
def test_gains_of_a_shaken_axis_are_those_of_the_riccati_equation(rate, corner):
    observer = observer_of(replace(WHITE, rate=rate, corner=corner), TIME, 0.0 * TIME, 0.0 * TIME)
    a, c = transition(corner), np.array([[1.0, 0.0, 0.0]])
    kept = a[2, 2]
    power = rate**4 * (1.0 - kept) / (1.0 + kept)
    p = solve_discrete_are(a.T, c.T, np.diag([0.0, 0.0, power * (1.0 - kept**2)]), np.ones((1, 1)))
    innovation = p[0, 0] + 1.0
    np.testing.assert_allclose(observer.gains[-1], p[:, 0] / innovation, rtol=1e-6)
    assert observer.weight[-1] == pytest.approx(innovation**-0.5, rel=1e-8)
    assert observer.remembered == pytest.approx(kept, rel=1e-12)


def late_axis(rng, jitter):
    """Return position, velocity and voltage of an axis that is sampled and driven late, or early, unseen."""
    voltage = np.where((TIME % 1.0) < 0.5, 3.0, -3.0) + 0.05 * rng.standard_normal(TIME.size)
    instants = TIME + jitter * rng.standard_normal(TIME.size)
    y, v = np.zeros(TIME.size), np.zeros(TIME.size)
    for k, step in enumerate(np.diff(instants)):
        left, ends = np.exp(-DAMPING * step), GAIN * voltage[k] / DAMPING
        v[k + 1] = ends + (v[k] - ends) * left
        y[k + 1] = y[k] + ends * step + (v[k] - ends) * (1.0 - left) / DAMPING
    return y + 1e-5 * rng.standard_normal(TIME.size), v, voltage


def test_innovations_of_an_axis_with_an_unseen_jitter_are_white_and_as_large_as_expected():
    sums, squares, simulated = [], [], []
    for seed in range(12):
        y, v, voltage = late_axis(np.random.default_rng(seed), 3e-5)
        observer = observer_of(replace(WHITE, jitter=3e-5), TIME, v, voltage)
        left = np.exp(-DAMPING * H)
        given = (1.0 - left) / DAMPING
        place, speed, missed = 0.0, 0.0, np.zeros(TIME.size)
        for k in range(TIME.size):
            missed[k] = y[k] - place
            at, now = place + observer.gains[k, 0] * missed[k], speed + observer.gains[k, 1] * missed[k]
            ends = GAIN * voltage[k] / DAMPING
            place, speed = at + ends * H + (now - ends) * given, ends + (now - ends) * left
        white = missed * observer.weight / 1e-5
        sums.append(float(np.mean(white[1:] * white[:-1])))
        squares.append(float(np.mean(white**2)))
        held, rested = 0.0, 0.0  # the same without corrections
        for k in range(TIME.size):
            missed[k] = y[k] - held
            ends = GAIN * voltage[k] / DAMPING
            held, rested = held + ends * H + (rested - ends) * given, ends + (rested - ends) * left
        simulated.append(float(np.mean((missed / 1e-5) ** 2)))
    count = 12 * TIME.size
    assert np.mean(sums) == pytest.approx(0.0, abs=4.0 / np.sqrt(count))
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count))
    assert np.mean(simulated) > 5.0  # what the jitter does is no trifle


def unstated(seed):
    """Return the first campaign from `seed` on whose instants jitter unstated, and how much [s]."""
    for s in range(seed, seed + 20):
        jitter = lab.surroundings("jittered", s).jitter
        if not jitter.stated:
            truth = lab.Truth(gain=2.0, damping=8.0, effects={})
            around = lab.surroundings("jittered", s)
            runs = [lab.step_record(truth, kp=kp, seed=s + kp, setup=lab.Setup(surroundings=around)) for kp in (40, 90)]
            return runs, jitter.share * runs[0].sample_time
    raise AssertionError("the laboratory always states its jitter")


@pytest.mark.parametrize("seed", [7201, 7231, 7261])
def test_jitter_is_measured_where_it_is_not_stated(seed):
    runs, jitter = unstated(seed)
    found = Likelihood(runs, Plant(gain=2.0, damping=8.0), FitOptions()).judged(Plant(gain=1.9, damping=7.0))
    assert found.noise.jitter == pytest.approx(jitter, rel=0.25)
    assert found.noise.rate == 0.0
    assert found.noise.order == 0


def test_friction_of_a_shaken_axis_is_fitted_beside_what_shakes_it():
    truth = lab.Truth(gain=2.0, damping=8.0, effects={"coulomb_friction": {"level": 0.3}})
    around = lab.surroundings("shaken", 7301, rate=11.0, damping=12.0)
    runs = [lab.step_record(truth, kp=kp, seed=kp, setup=lab.Setup(surroundings=around)) for kp in (40, 90)]
    fit = servolens.fit([CoulombFriction(level=0.4)], runs)
    assert fit.driven == "voltage"
    assert fit.noise_model.rate > 0.0
    assert "above_noise" not in [finding.code for finding in fit.findings]
    level = fit.quantities["coulomb_friction.level"]
    assert abs(level.value - 0.3) < 3.5 * level.stderr < 0.1


def without(record, lost):
    """Return a record that lacks samples."""
    signals = ("time", "position", "reference", "voltage")
    return replace(record, **{name: np.delete(getattr(record, name), lost) for name in signals})


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_an_observer_is_judged_by_the_samples_that_it_sees(lost):
    """Of more than 16 000 samples every few are compared: one that follows slow noise at the others misses less.

    Where samples were lost it has nothing to follow, and sees no more.
    """
    truth = lab.Truth(gain=2.0, damping=8.0, effects={"quadratic_drag": {"drag": 5.0}})
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=2e-4, autoregression=(0.99,)))
    setup = lab.Setup(surroundings=around)
    runs = [lab.step_record(truth, kp, seed=kp, duration=6.0 / (1.0 - lost), setup=setup) for kp in (4, 5, 6)]
    rng = np.random.default_rng(1)
    runs = [without(run, 20 + np.flatnonzero(rng.random(len(run) - 21) < lost)) for run in runs]
    plain = Plant(gain=2.0, damping=8.0)
    likelihood = Likelihood(runs, plain, FitOptions())
    assert likelihood.samples < sum(len(run) for run in runs)
    true = replace(plain, effects=(QuadraticDrag(drag=5.0),))
    assert likelihood.judged(true).total < likelihood.judged(plain).total
