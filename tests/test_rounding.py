"""Draws of an encoder's rounding, and what a sum of squares of them reaches by chance."""

import numpy as np
import pytest
from scipy.stats import chi2

from servolens import Plant, Record
from servolens.identification.noise import NoiseModel
from servolens.identification.observed import ObservedRun, Signals
from servolens.identification.rounding import DRAWS, dominates, is_rounded, limit_of, rounded

STEP = 1e-5
TIME = np.arange(2000) * 1e-3
AXIS = Plant(gain=2.0, damping=5.0)


def run_of(position):
    """Return a run at the voltage that keeps an axis of this constant speed going."""
    speed = (position[-1] - position[0]) / TIME[-1]
    voltage = np.full(TIME.size, AXIS.damping * speed / AXIS.gain)
    record = Record(time=TIME, position=position, voltage=voltage, encoder_resolution=STEP)
    return ObservedRun(Signals.of(record, STEP, AXIS, 10.0), 0, NoiseModel.white(0.0, STEP))


def test_limit_of_a_multiple_of_chi_square_is_its_quantile():
    draws = 3.0 * np.random.default_rng(5).chisquare(7, 40_000)
    assert limit_of(draws, 1e-3) == pytest.approx(3.0 * chi2.isf(1e-3, 7), rel=0.03)


def test_limit_of_nothing_is_nothing():
    assert limit_of(np.zeros(10), 1e-3) == pytest.approx(0.0, abs=1e-200)


def test_rounding_at_rest_is_one_error_all_along():
    run = run_of(np.full(TIME.size, 0.02))
    (drawn,) = rounded([run], [AXIS], [np.array([0.02, 0.0])])
    assert drawn.shape == (TIME.size, DRAWS)
    assert np.all(np.ptp(drawn, axis=0) < 1e-9)
    assert np.ptp(drawn[0]) > 0.0


def test_rounding_of_a_fast_motion_is_white():
    run = run_of(0.0173 * TIME)  # 1.73 steps a sample
    (drawn,) = rounded([run], [AXIS], [np.array([0.0, 0.0173])])
    centred = drawn - drawn.mean(axis=0)
    together = np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2)
    assert abs(together) < 0.4
    assert np.std(drawn) == pytest.approx(1.0, rel=0.01)  # of a uniform error: STEP / √12


def test_rounding_dominates_from_half_the_variance_on():
    assert dominates(NoiseModel.white(0.5 * STEP / np.sqrt(12.0), STEP))
    assert not dominates(NoiseModel.white(STEP, STEP))
    assert is_rounded(NoiseModel.white(STEP, STEP))
    assert not is_rounded(NoiseModel.white(STEP, 0.0))
