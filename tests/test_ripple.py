"""A ripple of the mains in the sensor is part of the noise, whatever the model beside it lacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servolens import lab
from servolens.diagnosis.case import Case
from servolens.effects import LoadFriction
from servolens.identification.noise import NoiseModel, Whitener
from servolens.plant import Plant

LINES = (50.0, 150.0)


def waves(time, sizes):
    angles = [2.0 * np.pi * line * time for line in LINES]
    return sum(a * np.cos(x) + b * np.sin(x) for x, (a, b) in zip(angles, sizes, strict=True))


@pytest.mark.parametrize("autoregression", [(), (0.9,)], ids=["white", "slow"])
def test_whitened_residual_knows_nothing_of_the_waves(autoregression):
    time = np.arange(2_000) * 1e-3
    stream = np.random.default_rng(1)
    filters = (np.ones(1), *(np.array([1.0, -pole]) for pole in autoregression))
    noise = replace(NoiseModel.white(1.0), filters=filters, scales=np.ones(len(filters)), lines=LINES)
    whiten = Whitener(np.zeros(time.size), np.zeros(time.size), noise, time=time)
    residual = stream.standard_normal(time.size)
    added = waves(time, [(30.0, -20.0), (5.0, 8.0)])
    np.testing.assert_allclose(whiten(residual + added), whiten(residual), atol=1e-10)
    np.testing.assert_allclose(whiten.steady(residual + added), whiten.steady(residual), atol=1e-10)
    free = Whitener(np.zeros(time.size), np.zeros(time.size), replace(noise, lines=()))(residual)
    assert np.sum(whiten(residual) ** 2) == pytest.approx(np.sum(free**2) - 2 * len(LINES), abs=15.0)  # χ² of 4


@pytest.mark.parametrize("force", [0.0, 0.5], ids=["healthy", "beside an unknown force"])
@pytest.mark.parametrize("seed", [31, 32])
def test_amplitude_is_that_of_the_ripple_though_the_model_lacks_a_force(force, seed):
    noise = lab.SensorNoise(deviation=4e-6, hum=5e-6, third_harmonic=2e-6, mains=50.0)
    effects = {"constant_force": {"acceleration": force}} if force else {}
    axis = lab.Truth(gain=5.2, damping=27.0, effects=effects)
    rig = lab.Setup(surroundings=lab.Surroundings(noise=noise))
    runs = tuple(
        lab.step_record(axis, kp=kp, reference=0.1, duration=2.0, seed=seed + i, setup=rig)
        for i, kp in enumerate((350, 200, 130))
    )
    case = Case(runs, (), {}, 24)
    found = case.ripple_beside(case.base)
    assert found.frequencies == LINES
    assert found.amplitude == pytest.approx(5e-6, rel=0.15)


def test_line_that_a_cause_hides_is_learnt_beside_it():
    campaign = lab.hidden_campaign(701584, effects=["load_friction"], world="hum")
    case = Case(tuple(campaign.records), (), {}, 24)
    assert 50.0 not in case.likelihood.white.lines
    friction = LoadFriction(**campaign.truth.effects["load_friction"])
    plant = Plant(gain=campaign.truth.gain, damping=campaign.truth.damping, effects=(friction,))
    assert case.learn_ripple(case.likelihood.judged(plant))
    assert case.likelihood.white.lines == LINES
    assert not case.learn_ripple(case.likelihood.judged(plant))
    assert case.ripple_beside(case.likelihood.judged(plant)).amplitude == pytest.approx(2.03e-5, rel=0.1)


def test_lines_are_looked_for_only_below_half_the_rate_of_what_is_compared():
    """A long record of which every fourth sample is compared: 250 Hz would look like a constant."""
    noise = lab.SensorNoise(deviation=4e-6, hum=5e-6, mains=50.0)
    rig = lab.Setup(surroundings=lab.Surroundings(noise=noise))
    axis = lab.Truth(gain=5.2, damping=27.0)
    runs = tuple(lab.step_record(axis, kp=kp, reference=0.1, duration=25.0, seed=kp, setup=rig) for kp in (350, 200))
    case = Case(runs, (), {}, 24)
    assert case.likelihood.every > 3
    found = case.ripple_beside(case.base)
    assert found.frequencies == (50.0,)
    assert found.amplitude == pytest.approx(5e-6, rel=0.1)
    assert np.sqrt(np.mean(found.at(0, runs[0].time) ** 2)) == pytest.approx(5e-6 / np.sqrt(2.0), rel=0.1)


def test_a_line_above_half_the_rate_takes_nothing_out():
    time = np.arange(300) * 1e-2  # at 100 Hz a line of 100 Hz is a constant
    noise = replace(NoiseModel.white(1.0), lines=(100.0,))
    whiten = Whitener(np.zeros(time.size), np.zeros(time.size), noise, time=time)
    np.testing.assert_array_equal(whiten(np.ones(time.size)), 1.0)
