"""What is asked of a model beside an encoder that is coarser than its noise: rounding goes round the loop too."""

from dataclasses import replace

import numpy as np
import pytest

from servolens import Plant, lab
from servolens.diagnosis.case import Case
from servolens.effects import CoulombFriction, GainDrift, ReturnSpring, catalogue
from servolens.identification.loop_errors import drawn_loop_errors, loop_error
from servolens.identification.noise import NoiseModel
from servolens.identification.observed import ObservedRun
from servolens.identification.rounding import is_coarse, own_spectra
from servolens.identification.score import FALSE_ALARM, ScoreTest
from servolens.identification.signals import Signals
from servolens.identification.structure import TESTS, answers

STEP = 1e-4


def hung_on_a_spring(seed):
    """Return runs of which rounding is all of the noise, and the plant."""
    truth = lab.Truth(gain=50.0, damping=6.0, effects={"return_spring": {"stiffness": 60.0}})
    gains, reference = ((6.0, 0.3), (10.0, 0.4)), 1.0 + 0.02 * seed
    setup = {"duration": 4.0, "sample_time": 2e-3, "encoder": 4.36e-3, "noise": 1e-4}
    runs = [lab.step_record(truth, *g, reference=reference, seed=10 * seed + i, **setup) for i, g in enumerate(gains)]
    return runs, Plant(gain=50.0, damping=6.0, effects=(ReturnSpring(stiffness=60.0),))


def held_by_friction(seed):
    """Return runs of the same gain that begin at the same place, and the plant."""
    truth = lab.Truth(gain=18.0, damping=6.0, effects={"coulomb_friction": {"level": 0.7}})
    setup, levels = {"duration": 1.0, "encoder": STEP, "noise": 5e-6}, ((0.1, 0.0), (0.1, 0.06, 0.16))
    runs = [lab.step_record(truth, 40.0, 1.0, reference=r, seed=20 * seed + i, **setup) for i, r in enumerate(levels)]
    return runs, Plant(gain=18.0, damping=6.0, effects=(CoulombFriction(level=0.7),))


@pytest.mark.parametrize("axis", [hung_on_a_spring, held_by_friction], ids=lambda axis: axis.__name__)
@pytest.mark.parametrize("seed", [1, 4])
def test_a_true_model_leaves_nothing_that_depends_on_the_inputs(axis, seed):
    records, plant = axis(seed)
    case = Case(tuple(records), (), {}, len(catalogue()))
    assert case.is_enough(case.likelihood.judged(plant))


def test_an_instrument_like_a_parameter_of_the_model_is_not_its_feedback_noise():
    """Hat functions over time add up to the gain; what the noise in the voltage makes different is no instrument."""
    records, plant = hung_on_a_spring(2)
    case = Case(tuple(records), (), {}, len(catalogue()))
    found = case.likelihood.whitened_well(case.likelihood.judged(plant))
    for answer in answers(ScoreTest(case.likelihood, found)):
        assert answer.chance > FALSE_ALARM / TESTS


@pytest.mark.parametrize(("drift", "steps"), [(0.0, (0.354,)), (0.1, (0.354, -0.2, 0.3, -0.1))])
def test_what_a_loop_with_a_derivative_does_at_rest_is_rounding_and_no_drift_of_the_gain(drift, steps):
    """It goes to and fro where the encoder shows nothing: less so, the less the axis answers to the voltage."""
    truth = lab.Truth(gain=100.0, damping=5.6, effects={"gain_drift": {"rate": drift}} if drift else {})
    gains, setup = ((9.0, 0.244), (20.25, 0.574), (5.76, 0.232)), {"duration": 2.5, "encoder": 6e-3, "noise": 1.2e-5}
    turned = [np.array(steps) * (1.0 if kp > 6.0 else -0.8) for kp, _ in gains]
    logs = zip(gains, turned, strict=True)
    records = [lab.step_record(truth, *g, reference=r, seed=50 + i, **setup) for i, (g, r) in enumerate(logs)]
    case = Case(tuple(records), (), {}, len(catalogue()))
    simple = case.likelihood.judged(Plant(gain=100.0, damping=5.6))
    richer = case.likelihood.judged(Plant(gain=100.0, damping=5.6, effects=(GainDrift(rate=0.1),)), simple)
    test = ScoreTest(case.likelihood, replace(simple, noise=richer.noise))
    assert richer.total < simple.total
    assert test.may_be_chance(richer.plant, 17.0) is (drift == 0.0)


def test_a_missing_spring_still_shows_beside_a_coarse_encoder():
    records, plant = hung_on_a_spring(1)
    case = Case(tuple(records), (), {}, len(catalogue()))
    assert not case.is_enough(case.likelihood.judged(replace(plant, effects=())))


def test_an_error_as_large_as_the_sensor_makes_it_is_told_from_a_larger_one():
    records, plant = held_by_friction(1)
    noise, plants = NoiseModel.white(STEP / np.sqrt(12.0), STEP), [plant] * 2
    drawn = drawn_loop_errors(plants, records, noise)[3]
    assert not loop_error(plants, records, drawn, noise, 20.0).is_larger
    assert loop_error(plants, records, [2.0 * error for error in drawn], noise, 20.0).is_larger


def test_records_of_a_draw_begin_at_the_same_place_of_the_encoder():
    """Of the same run twice, without noise: what rounding does to one, it does to the other."""
    (record, _), plant = held_by_friction(1)
    drawn = drawn_loop_errors([plant] * 2, [record] * 2, NoiseModel.white(STEP / np.sqrt(12.0), STEP))
    for one, other in drawn:
        np.testing.assert_array_equal(one, other)
    assert np.ptp([np.std(one) for one, _ in drawn]) > 0.0


def test_rounding_of_an_axis_that_rests_looks_larger_than_it_is():
    """Half a step away for long, it is three times its mean square."""
    (record, _), plant = held_by_friction(1)
    resting = replace(NoiseModel.white(0.45 * STEP, STEP), floor=0.45 * STEP)
    run = ObservedRun(Signals.of(record, 1e-6, plant, 10.0), 0, NoiseModel.white(0.0, STEP))
    spectrum = own_spectra([run], [plant], [np.array([record.position[0], 0.0])])
    assert not is_coarse(resting)
    assert is_coarse(resting, spectrum)


def test_rounding_is_most_of_the_noise_beside_an_observer_too():
    observed = replace(NoiseModel.white(0.2 * STEP, STEP), rate=30.0, corner=30.0)
    assert is_coarse(observed)
    assert not is_coarse(replace(observed, spread=STEP, floor=STEP))
