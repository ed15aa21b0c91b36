"""Error bars on shaken axes that do not answer to shaking as one free mass does: couplings and stops."""

import numpy as np
import pytest
from scipy.stats import chi2

from servolens import Plant, effects, lab
from servolens.identification.fitted import with_error_bars
from servolens.identification.fitting import likelihood_of
from servolens.identification.options import FitOptions
from servolens.identification.refine import minimise_error
from servolens.identification.shaken_errors import counting_answers_to_shaking

SEEDS = range(720_700, 720_706)
STOP = {"low": -0.045, "high": 0.096}
COUPLING = {"frequency": 15.0, "damping_ratio": 0.03, "load_ratio": 0.4}
AXES = {
    "end_stop": (STOP, effects.EndStop(**STOP), ("end_stop.low", "end_stop.high")),
    "flexible_coupling": (
        COUPLING,
        effects.FlexibleCoupling(**COUPLING),
        tuple(f"flexible_coupling.{name}" for name in COUPLING),
    ),
}


def shaken_records(seed, hidden):
    truth = lab.Truth(gain=1.9, damping=6.0, effects=hidden)
    shaking = lab.Shaking(deviation=0.2, correlation_time=0.05)
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=1e-5), shaking=shaking)
    steps = ((40.0, 0.0, (0.1, 0.0, 0.1)), (100.0, 5.0, (0.1, 0.0, -0.05)))
    setup = lab.Setup(surroundings=around)
    return [
        lab.step_record(truth, kp, kd, seed=seed + int(kp), reference=levels, duration=0.8, setup=setup)
        for kp, kd, levels in steps
    ]


def fitted(seed, hidden, plant):
    likelihood = likelihood_of(shaken_records(seed, hidden), plant, FitOptions())
    found = likelihood.judged(plant)
    assert found.noise.rate > 0.0
    refined = minimise_error(found.plant, likelihood.runs(found.noise), likelihood.options(plant), noise=None)
    return likelihood, refined, found.noise


@pytest.mark.parametrize("name", AXES)
def test_error_bars_count_how_a_coupling_or_a_stop_answers_to_shaking(name):
    """The observer knows one free mass: the stop was five standard errors off, a coupling's frequency two and more."""
    values, effect, judged = AXES[name]
    plant = Plant(gain=1.9, damping=6.0, effects=(effect,))
    places = [list(plant.parameters).index(parameter) for parameter in judged]
    away = []
    for seed in SEEDS:
        likelihood, refined, noise = fitted(seed, {name: values}, plant)
        counted = with_error_bars(likelihood, refined, noise)
        errors = np.sqrt(np.diag(counted.covariance))
        away.append(((np.array(counted.plant.values) - plant.values) / errors)[places])
    assert (np.sum(np.square(away), axis=0) < chi2.isf(0.001, len(SEEDS))).all()
    assert (np.sum(np.square(away), axis=0) > chi2.isf(0.999, len(SEEDS))).all()


def test_error_bars_of_one_free_mass_stay_as_its_innovations_have_them():
    plant = Plant(gain=1.9, damping=6.0, effects=(effects.ConstantForce(acceleration=0.2),))
    likelihood, refined, noise = fitted(720_600, {"constant_force": {"acceleration": 0.2}}, plant)
    assert counting_answers_to_shaking(likelihood, refined, noise) is refined
