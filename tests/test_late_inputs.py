"""Sampling instants that are not those stated: how large that is, and what it does to a voltage and to error bars."""

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, Prior, fit, lab
from servolens.effects import DeadZone, ForceLimit, Saturation
from servolens.identification.late_errors import counting_late_inputs
from servolens.identification.late_inputs import about, instants, jumps_of
from servolens.identification.likelihood import Likelihood
from servolens.identification.noise import NoiseModel
from servolens.identification.options import FitOptions
from servolens.identification.refine import minimise_error
from servolens.identification.signals import Signals, clock_error

H = 1e-3
TIME = H * np.arange(3000)


def moving():
    """Return the speed [m/s] of an axis that rests most of the time and is quick in between."""
    return 0.4 * np.exp(-(TIME % 1.0) / 0.03) * np.sign(np.sin(np.pi * TIME) + 1e-9)


@pytest.mark.parametrize("size", [3e-5, 2e-4])
def test_jitter_is_seen_however_far_it_exceeds_the_noise_of_the_sensor(size):
    """Weighed by what it had found, the regression went to and fro between nothing and too much."""
    for seed in range(40):
        stream, speed = np.random.default_rng(seed), moving()
        left = 1.3e-6 * stream.standard_normal(TIME.size) + size * speed * stream.standard_normal(TIME.size)
        jitter, floor = instants([left], [speed])
        assert jitter == pytest.approx(size, rel=0.25)  # third differences of some 150 quick samples
        assert floor == pytest.approx(1.3e-6, rel=0.25)


def test_noise_alone_shows_no_jitter():
    found = [
        instants([1e-5 * np.random.default_rng(seed).standard_normal(TIME.size)], [moving()]) for seed in range(40)
    ]
    assert sum(jitter > 0.0 for jitter, _ in found) <= 1
    np.testing.assert_allclose([floor for _, floor in found], 1e-5, rtol=0.1)


VOLTAGE = np.array([0.0, 0.05, 5.0, -1.0, -9.0, -8.0])
SPEED = np.array([0.0, 0.0, 0.1, 0.3, 0.2, -0.1])


@pytest.mark.parametrize(
    ("effect", "force"),
    [
        (Saturation(limit=3.0), lambda u, v: 2.0 * np.clip(u, -3.0, 3.0)),
        (DeadZone(width=0.2), lambda u, v: 2.0 * np.sign(u) * np.maximum(np.abs(u) - 0.2, 0.0)),
        (ForceLimit(acceleration=4.0), lambda u, v: np.clip(2.0 * u - 6.0 * v, -4.0, 4.0)),
    ],
    ids=lambda case: getattr(case, "name", ""),
)
def test_a_voltage_jumps_by_what_reaches_the_axis(effect, force):
    plant = Plant(gain=2.0, damping=6.0, effects=(effect,))
    noise = replace(about(NoiseModel.white(1e-5), plant), jitter=1e-5)
    before = np.concatenate([VOLTAGE[:1], VOLTAGE[:-1]])
    wanted = force(VOLTAGE, SPEED) - force(before, SPEED)
    np.testing.assert_allclose(jumps_of(noise, TIME[:6], SPEED, VOLTAGE), wanted, atol=1e-12)
    on_time = replace(noise, gain=0.0)
    np.testing.assert_array_equal(jumps_of(on_time, TIME[:6], SPEED, VOLTAGE), 0.0)


def late(noise, share=0.04):
    return lab.Surroundings(
        noise=lab.SensorNoise(deviation=noise), encoder=noise, jitter=lab.Jitter(share=share, stated=False)
    )


AXES = {
    "saturation": (lab.Truth(gain=20.0, damping=16.0, effects={"saturation": {"limit": 3.0}}), 5e-6, (45.0, 10.0)),
    "flexible_coupling": (
        lab.Truth(
            gain=2.0,
            damping=6.0,
            effects={"flexible_coupling": {"frequency": 15.0, "damping_ratio": 0.03, "load_ratio": 0.4}},
        ),
        3e-7,
        (40.0, 25.0),
    ),
    "delay": (lab.Truth(gain=2.0, damping=6.0, effects={"delay": {"time": 0.01}}), 3e-7, (40.0, 25.0)),
}


def runs_of(name, seed=0):
    """Return two records of an axis whose instants are late or early, which no record states."""
    truth, noise, gains = AXES[name]
    setup = lab.Setup(surroundings=late(noise))
    return [
        lab.step_record(truth, kp, reference=(0.1, 0.0, -0.05), duration=0.7, seed=100 * seed + i, setup=setup)
        for i, kp in enumerate(gains)
    ]


def away(name, truth, runs):
    """Return how many standard errors the parameters of an effect are from the truth, fitted from there."""
    own = truth.effects[name]
    found = fit([Plant.effect_from(name, own)], runs).quantities
    return [(found[f"{name}.{key}"].value - value) / found[f"{name}.{key}"].stderr for key, value in own.items()]


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_error_bars_allow_for_late_jumps_of_the_voltage(name):
    sizes = np.array([away(name, AXES[name][0], runs_of(name, seed)) for seed in range(16)])
    assert np.sqrt(np.mean(sizes**2, axis=0)).max() < 1.4  # 1 ± 0.18 if they are right
    assert np.mean(np.abs(sizes) < 1.96) > 0.85


def test_error_bars_of_a_drive_allow_for_what_its_integral_remembers():
    """A jump that came late was three to five of them away, for the observer does not move the integral."""
    campaign = lab.hidden_campaign(902479, effects=["speed_servo"], world="jittered")
    assert not campaign.surroundings.jitter.stated
    assert np.abs(away("speed_servo", campaign.truth, campaign.records)).max() < 2.5


def widened(truth, runs, priors=()):
    """Return the standard errors of a fit from the truth with late inputs, and how many times wider these make them."""
    effects = tuple(Plant.effect_from(name, own) for name, own in truth.effects.items())
    plant = Plant(gain=truth.gain, damping=truth.damping, effects=effects)
    likelihood = Likelihood(runs, plant, FitOptions(priors=dict(priors)))
    noise = replace(about(likelihood.white, plant), jitter=4e-5)
    options, weights = likelihood.options(plant), likelihood.weighed_by(noise)
    refined = minimise_error(plant, likelihood.runs(noise), options, noise=weights)
    counted = counting_late_inputs(likelihood, refined, noise)
    errors = np.sqrt(np.diag(counted.covariance))
    return dict(zip(plant.parameters, errors, strict=True)), errors / np.sqrt(np.diag(refined.covariance))


def test_error_bars_are_widened_by_what_the_observer_does_not_know_and_by_nothing_else():
    _, factors = widened(AXES["flexible_coupling"][0], runs_of("flexible_coupling"))
    assert factors.min() >= 1.0
    assert factors.max() > 1.5
    plain = lab.Truth(gain=2.0, damping=6.0)
    setup = lab.Setup(surroundings=late(3e-7))
    runs = [lab.step_record(plain, kp, reference=(0.1, 0.0), duration=0.7, seed=kp, setup=setup) for kp in (25, 40)]
    _, factors = widened(plain, runs)
    np.testing.assert_allclose(factors, 1.0, atol=0.01)


def test_late_jumps_move_no_parameter_beyond_its_prior():
    prior = {"gain": Prior(value=2.0, deviation=1e-6)}
    errors, _ = widened(AXES["flexible_coupling"][0], runs_of("flexible_coupling"), prior)
    assert errors["gain"] <= 1.001e-6


def test_a_parameter_that_no_record_shows_has_no_error_bar_beside_late_jumps_either():
    truth = lab.Truth(gain=2.0, damping=6.0, effects={"end_stop": {"low": -0.04, "high": 0.3}})
    setup = lab.Setup(surroundings=late(5e-6))
    runs = [lab.step_record(truth, kp, reference=(0.1, -0.1), seed=kp, setup=setup) for kp in (40, 60)]
    found = fit([Plant.effect_from("end_stop", truth.effects["end_stop"])], runs).quantities
    assert found["end_stop.high"].stderr is None
    assert found["end_stop.low"].value == pytest.approx(-0.04, abs=5 * found["end_stop.low"].stderr)


def test_a_clock_disturbs_a_loop_by_no_more_than_its_amplifier_passes():
    record = runs_of("saturation")[0]
    plant = Plant(gain=20.0, damping=16.0, effects=(Saturation(limit=1.0),))
    signals, jitter = Signals.of(record, 5e-6, plant, 30.0), 4e-5
    jumps = 20.0 * np.diff(np.clip(signals.voltage, -1.0, 1.0))
    read = jitter**2 * np.mean(signals.speed**2)
    stiffness, damping = 20.0 * record.controller.kp, 16.0 + 20.0 * record.controller.kd
    moved = jitter**2 * np.sum(jumps**2) / record.duration / (2.0 * stiffness * damping)
    noise = replace(about(NoiseModel.white(5e-6), plant), jitter=jitter)
    assert clock_error(noise, signals) == pytest.approx(np.sqrt(read + moved), rel=1e-9)


@pytest.mark.parametrize("samples", [0, 2, 3])
def test_a_record_of_few_samples_tells_nothing_of_the_instants(samples):
    stream, speed = np.random.default_rng(1), moving()
    left = 1.3e-6 * stream.standard_normal(TIME.size) + 4e-5 * speed * stream.standard_normal(TIME.size)
    assert instants([left, np.zeros(samples)], [speed, np.ones(samples)]) == instants([left], [speed])


def test_what_reaches_an_axis_is_known_of_a_fit_that_was_read_from_a_file():
    fitted = fit([Saturation(limit=3.0)], runs_of("saturation"))
    again = type(fitted).from_json(fitted.to_json())
    assert again.noise_model.jitter == fitted.noise_model.jitter > 0.0
    (effect,) = again.noise_model.pushed.effects
    assert effect.limit == pytest.approx(fitted.noise_model.pushed.effects[0].limit, rel=1e-6)
