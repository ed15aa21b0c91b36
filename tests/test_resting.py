"""Where something holds an axis nothing shakes it: seen in the record, and told to the observer."""

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, lab
from servolens.diagnosis.case import Case
from servolens.effects import CoulombFriction, catalogue
from servolens.identification.instruments import noise_free_run
from servolens.identification.noise import NoiseModel
from servolens.identification.observer import observer_of
from servolens.identification.resting import resting
from servolens.identification.score import ScoreTest
from servolens.identification.shaken import shaken
from servolens.identification.structure import depends_on_inputs
from servolens.simulation.digital import HELD

STEP, SENSOR = 2e-3, 1e-5
TIME = STEP * np.arange(3000)


def noise(seed):
    return SENSOR * np.random.default_rng(seed).standard_normal(TIME.size)


def test_an_axis_rests_where_its_position_shows_nothing_but_noise():
    move = 0.1 * (1.0 - np.cos(np.pi * np.clip(TIME - 2.0, 0.0, 1.0)))  # still, then a second of motion, then still
    found = resting(move + noise(1), SENSOR, 0.05)
    still = (TIME < 1.8) | (TIME > 3.2)
    assert np.mean(found[still]) > 0.98
    assert not found[(TIME > 2.0 + STEP) & (TIME < 3.0 - STEP)].any()


@pytest.mark.parametrize("position", [2e-4 * np.sin(40.0 * TIME), 5e-4 * TIME], ids=["swing", "creep"])
def test_what_swings_or_creeps_does_not_rest(position):
    assert np.mean(resting(position + noise(2), SENSOR, 0.05)) < 0.02


def test_a_record_shorter_than_the_loop_remembers_shows_no_rest():
    assert not resting(noise(3)[:150], SENSOR, 0.05).any()
    assert not resting(np.zeros(100), 0.0, 0.5).any()


def test_a_log_without_noise_shows_no_rest():
    """Squares of a travel of a billion times the noise are not exact to the noise: rest was told at random."""
    move = np.clip(TIME - 2.0, 0.0, 1.0)
    assert not resting(move + 1e-9 * noise(4) / SENSOR, 1e-9, 0.05).any()


def test_observer_averages_the_position_of_an_axis_at_rest_and_meets_full_shaking_when_it_sets_out():
    model = NoiseModel.white(SENSOR)
    shaken = replace(model, rate=200.0, corner=5.0, damping=6.0)
    rests = np.zeros(400, dtype=bool)
    rests[100:300] = True
    time, still = STEP * np.arange(400), np.zeros(400)
    moving = observer_of(shaken, time, still, still)
    held = observer_of(shaken, time, still, still, rests=rests)
    assert (held.gains[rests, 1] == HELD).all()
    assert (held.gains[~rests, 1] != HELD).all()
    settled = held.gains[290, 0]
    assert settled == pytest.approx(1.0 / 191.0, rel=0.1)  # a mean of as many samples
    assert held.weight[290] == pytest.approx(1.0, rel=0.01)
    assert moving.weight[290] < 0.95
    assert held.gains[399] == pytest.approx(moving.gains[399], rel=1e-3)


def rubbing_and_shaken():
    """Return records of an axis that dry friction holds most of the time, and their likelihood and hypothesis."""
    around = lab.Surroundings(
        noise=lab.SensorNoise(deviation=2e-5), encoder=1e-6, shaking=lab.Shaking(deviation=0.05, correlation_time=0.16)
    )
    axis = lab.Truth(gain=3.0, damping=4.0, effects={"coulomb_friction": {"level": 0.25}})
    setup = {"duration": 6.0, "sample_time": 5e-3, "setup": lab.Setup(surroundings=around)}
    steps = enumerate([(40.0, 0.2), (30.0, 0.1), (60.0, -0.2)])
    runs = tuple(lab.step_record(axis, kp=kp, reference=(to,), seed=seed, **setup) for seed, (kp, to) in steps)
    likelihood = Case(runs, (), {}, len(catalogue())).likelihood
    return likelihood, likelihood.judged(Plant(gain=3.0, damping=4.0, effects=(CoulombFriction(level=0.3),)))


def test_dry_friction_of_a_shaken_axis_that_mostly_rests_leaves_nothing_that_depends_on_the_inputs():
    """Its shaking was taken for weak, since most of the time nothing of it shows, and the motion for more than that."""
    likelihood, found = rubbing_and_shaken()
    assert found.noise.rate > 0.0
    assert found.noise.corner == pytest.approx(1.0 / 0.16, rel=0.5)
    assert not depends_on_inputs(ScoreTest(likelihood, likelihood.whitened_well(found)))
    assert found.plant.effect("coulomb_friction").level == pytest.approx(0.25, abs=0.04)


def test_draws_are_observed_where_they_rest_and_what_knows_no_noise_as_the_record_is():
    """A log without noise is still wherever it has settled, though nothing holds it."""
    likelihood, found = rubbing_and_shaken()
    runs = likelihood.runs(found.noise)
    plants = [found.plant_of(i) for i in range(len(runs))]
    for draws in shaken(runs, plants, found.starts):
        assert np.std(draws) == pytest.approx(1.0, abs=0.03)
    for run, plant in zip(runs, plants, strict=True):
        assert np.array_equal(noise_free_run(run, plant).signals.rests, run.signals.rests)
