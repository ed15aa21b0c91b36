"""Error bars on shaken axes: what shakes them is known no better than a record of it is long."""

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, effects, fit, lab
from servolens.identification.fitting import likelihood_of
from servolens.identification.options import FitOptions
from servolens.identification.refine import minimise_error
from servolens.identification.shaking_spectra import counting_all_spectra

TRUTH = lab.Truth(gain=1.9, damping=6.0, effects={"constant_force": {"acceleration": 0.2}})
PLANT = Plant(gain=1.9, damping=6.0, effects=(effects.ConstantForce(acceleration=0.2),))
NAMES = [*PLANT.parameters]
SHAKING, SENSOR = lab.Shaking(deviation=0.02, correlation_time=0.4), 1e-5


def shaken_records(seed):
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=SENSOR), shaking=SHAKING)
    steps = ((40.0, 0.0, (0.1, 0.0, 0.1)), (100.0, 5.0, (0.1, 0.0, -0.05)))
    setup = lab.Setup(surroundings=around)
    return [
        lab.step_record(TRUTH, kp, kd, seed=seed + int(kp), reference=levels, duration=0.8, setup=setup)
        for kp, kd, levels in steps
    ]


def true_noise(likelihood):
    """Return the noise model of the laboratory's shaking, in units of the sensor's noise."""
    left = np.exp(-1e-3 / SHAKING.correlation_time)
    power = (SHAKING.deviation / SENSOR) ** 2 * (1.0 + left) / (1.0 - left)
    return replace(likelihood.white, rate=power**0.25, corner=1.0 / SHAKING.correlation_time)


def refined(likelihood, noise):
    return minimise_error(PLANT, likelihood.runs(noise), likelihood.options(PLANT), noise=None)


def test_error_bars_do_not_hang_on_the_likeliest_spectrum():
    alone, counted, truly = [], [], []
    for seed in range(720_600, 720_606):
        likelihood = likelihood_of(shaken_records(seed), PLANT, FitOptions())
        noise = likelihood.judged(PLANT).noise
        found, true = refined(likelihood, noise), refined(likelihood, true_noise(likelihood))
        places = [NAMES.index(name) for name in ("gain", "constant_force.acceleration")]
        errors = [
            np.sqrt(np.diag(each.covariance))[places]
            for each in (found, counting_all_spectra(likelihood, found, noise), true)
        ]
        for kind, one in zip((alone, counted, truly), errors, strict=True):
            kind.append(one)
    ratio, wider = np.median(np.divide(counted, truly), axis=0), np.median(np.divide(counted, alone), axis=0)
    assert (ratio > 0.75).all()
    assert (ratio < 1.35).all()
    assert wider[1] > 1.15  # a constant force is known by the mean of what shakes the axis
    assert wider[0] < wider[1]  # the gain is known by motion


def test_nothing_changes_where_nothing_shakes_the_axis():
    record = lab.step_record(TRUTH, 40.0, seed=720_610)
    likelihood = likelihood_of([record], PLANT, FitOptions())
    found = refined(likelihood, likelihood.white)
    assert counting_all_spectra(likelihood, found, likelihood.white) is found


def test_parameters_at_a_bound_or_held_have_no_error_bar_that_could_widen():
    options = FitOptions(held=("gain",), bounds={"damping": (0.0, 5.0)})
    likelihood = likelihood_of(shaken_records(720_620), PLANT, options)
    noise = true_noise(likelihood)
    found = minimise_error(replace(PLANT, damping=5.0), likelihood.runs(noise), likelihood.options(PLANT), noise=None)
    wide = counting_all_spectra(likelihood, found, noise)
    assert found.at_bound == ("damping",)
    for name in ("gain", "damping"):
        assert np.isnan(wide.covariance[NAMES.index(name)]).all()
    place = NAMES.index("constant_force.acceleration")
    assert wide.covariance[place, place] > found.covariance[place, place]


def test_error_bars_of_dry_friction_are_no_artefact_of_small_differences():
    truth = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    shaking = lab.Shaking(deviation=0.1, correlation_time=0.05)
    setup = lab.Setup(surroundings=lab.Surroundings(noise=lab.SensorNoise(deviation=SENSOR), shaking=shaking))
    for seed in (720_631, 720_638, 720_645, 720_652):
        records = [lab.step_record(truth, kp, seed=seed + kp, setup=setup) for kp in (40, 100)]
        plant = Plant(gain=1.9, damping=6.0, effects=(effects.CoulombFriction(level=0.3),))
        likelihood = likelihood_of(records, plant, FitOptions())
        hypothesis = likelihood.judged(plant)
        noise = hypothesis.noise
        found = minimise_error(hypothesis.plant, likelihood.runs(noise), likelihood.options(plant), noise=None)
        wide = counting_all_spectra(likelihood, found, noise)
        ratio = np.sqrt(np.diag(wide.covariance) / np.diag(found.covariance))
        assert noise.rate > 0.0
        assert (ratio > 0.8).all()
        assert (ratio < 1.6).all()


def test_a_fit_allows_for_the_spectra_once():
    records = shaken_records(720_660)
    found = fit("constant_force", records)
    likelihood, noise = likelihood_of(records, found.plant, FitOptions()), found.noise_model
    alone = minimise_error(
        found.plant, likelihood.runs(noise), likelihood.options(found.plant), noise=likelihood.weighed_by(noise)
    )
    once = counting_all_spectra(likelihood, alone, noise)
    assert noise.rate > 0.0
    assert np.diag(once.covariance)[NAMES.index("constant_force.acceleration")] > 1.2 * np.diag(alone.covariance)[-1]
    assert np.diag(found.model.covariance) == pytest.approx(np.diag(once.covariance), rel=0.05)
