"""The paper's error measures, and fits of plants with given effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import servolens
from servolens.effects import ActuatorLag, Backlash, CoulombFriction, Saturation
from servolens.errors import InputError
from servolens.lab import LM1, NLM1, Setup, Truth, step_record, table_one
from servolens.plant import Plant
from servolens.prediction import beginning, predict, prediction_error, prediction_residual
from servolens.quality.beginning import initial_motion
from servolens.record import Controller, Record
from servolens.simulation import simulate, simulate_loop

LINEAR = Plant(gain=LM1.gain, damping=LM1.damping)


def test_percent_error_is_the_mean_error_over_the_step() -> None:
    record = step_record(LM1, 60.0, encoder=0.0)
    off = record.with_({"position": record.position + np.where(record.time > 0, 0.0071, 0.0)})
    error = prediction_error(LINEAR, off)
    assert error.mean_abs_error == pytest.approx(0.0071, rel=1e-3)
    assert error.percent_error == pytest.approx(7.1, rel=1e-3)
    assert error.rms_error == pytest.approx(0.0071, rel=1e-3)


def test_fit_percent_is_the_normalised_root_mean_square_error() -> None:
    record = step_record(LM1, 60.0, encoder=0.0)
    assert prediction_error(LINEAR, record).fit_percent == pytest.approx(100.0, abs=1e-3)
    wrong = Plant(gain=1.0, damping=3.0)
    from servolens.simulation import simulate

    model = simulate(wrong, record).position
    y = record.position
    expected = 100.0 * (1.0 - np.linalg.norm(y - model) / np.linalg.norm(y - y.mean()))
    assert prediction_error(wrong, record).fit_percent == pytest.approx(expected)


@pytest.mark.parametrize("before", [0.0, None])
def test_a_record_that_begins_at_its_step_may_be_of_an_axis_without_a_voltage_before_or_with_it(before) -> None:
    time, controller = np.arange(1000) * 1e-3, Controller(kp=60.0)
    plant = Plant(gain=1.9, damping=6.0, effects=(ActuatorLag(time_constant=0.02),))
    reference = np.full(time.size, 0.1)
    run = simulate_loop(plant, controller, time, reference, before=before)
    record = Record(time=time, position=run.position, reference=reference, voltage=run.voltage, controller=controller)
    assert prediction_error(plant, record).rms_error < 1e-9


def slow_noise(size: float, count: int, seed: int, kept: float) -> np.ndarray:
    white = np.random.default_rng(seed).standard_normal(count)
    white[0] /= np.sqrt(1.0 - kept**2)
    return np.asarray(size * np.sqrt(1.0 - kept**2) * lfilter([1.0], [1.0, -kept], white))


def pushed(begin: float, kept: float, seed: int) -> Record:
    """A log from `begin` on, in closed form, of an axis at rest until time 0 and then under a constant voltage."""
    time = begin + np.arange(800) * 1e-3
    moved = 0.3 * (time - (1.0 - np.exp(-6.0 * time)) / 6.0)
    position = moved + slow_noise(3e-5, time.size, seed, kept)
    return Record(time=time, position=position, voltage=np.ones(time.size), controller=None)


@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_speed_at_which_a_log_begins_is_told_from_as_many_samples_as_noise_allows(kept) -> None:
    truth = 0.3 * (1.0 - np.exp(-6.0 * 0.2))
    for seed in range(30):
        assert initial_motion(pushed(0.2, kept, seed)) == pytest.approx(truth, rel=0.15 if kept else 0.03)


@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_axis_that_is_pushed_off_at_once_does_not_seem_to_move_before(kept) -> None:
    assert sum(initial_motion(pushed(0.0, kept, seed)) != 0.0 for seed in range(300)) <= 1


def test_wrong_plant_does_not_make_up_for_what_it_lacks_by_another_velocity() -> None:
    clean = step_record(LM1, 60.0, encoder=0.0)
    record = clean.with_({"position": clean.position + slow_noise(5e-5, len(clean), 7, 0.0)}).slice(0.04, 0.9)
    told = initial_motion(record)
    for wrong in (replace(LINEAR, damping=5.0 * LM1.damping), replace(LINEAR, gain=2.0 * LM1.gain)):
        assert 0.0 <= beginning(wrong, record).velocity <= 1.3001 * told


@pytest.mark.parametrize("kept", [0.0, 0.95])
@pytest.mark.parametrize("begin", [0.04, 0.11])
def test_log_that_begins_in_motion_is_missed_by_no_more_than_its_noise(kept, begin) -> None:
    clean = step_record(LM1, 60.0, encoder=0.0)
    noise = slow_noise(5e-5, len(clean), 7, kept)
    record = clean.with_({"position": clean.position + noise}).slice(begin, float(clean.time[-1]))
    missed, after = prediction_residual(LINEAR, record), noise[-len(record) :]
    assert np.sqrt(np.mean(missed**2)) < 1.2 * np.sqrt(np.mean(after**2))
    begun = beginning(LINEAR, record)
    exact = simulate(LINEAR, clean)
    assert begun.velocity == pytest.approx(exact.velocity[-len(record)], rel=0.02)
    assert begun.record is record


@pytest.mark.parametrize("kept", [0.0, 0.9])
@pytest.mark.parametrize("begin", [0.1, 0.61])
def test_motion_that_loud_noise_hides_at_the_beginning_is_told_by_the_rest_of_the_log(kept, begin) -> None:
    time = np.arange(2500) * 1e-3
    sine = 0.05 * np.sin(2 * np.pi * 1.3 * time)
    clean = step_record(LM1, 40.0, 1.0, encoder=0.0, setup=Setup(trajectory=sine))
    hidden = 0
    for seed in range(12):
        noise = slow_noise(1e-4, len(clean), seed, kept)
        record = clean.with_({"position": clean.position + noise}).slice(begin, 3.0)
        hidden += initial_motion(record) == 0.0
        missed, after = prediction_residual(LINEAR, record), noise[-len(record) :]
        assert np.sqrt(np.mean(missed**2)) < 1.2 * np.sqrt(np.mean(after**2))
    assert (hidden > 2) == (begin == 0.1)


@pytest.mark.parametrize("begin", [0.0, 0.02, 0.2])
def test_axis_at_rest_is_not_set_in_motion_by_what_a_plant_lacks(begin) -> None:
    lacking = {
        "coulomb_friction": {"level": 0.3},
        "delay": {"time": 0.01},
        "backlash": {"gap": 2e-3, "load_share": 0.3},
        "return_spring": {"stiffness": 20.0},
        "constant_force": {"acceleration": 0.5},
        "flexible_coupling": {"frequency": 8.0, "damping_ratio": 0.05, "load_ratio": 0.3},
    }
    for name, sizes in lacking.items():
        truth = Truth(gain=LM1.gain, damping=LM1.damping, effects={name: sizes})
        clean = step_record(truth, 60.0, 1.0, encoder=0.0, setup=Setup(rest=begin))
        for size, kept in ((1e-5, 0.0), (1e-4, 0.9), (1e-3, 0.0)):
            record = clean.with_({"position": clean.position + slow_noise(size, len(clean), 3, kept)})
            assert beginning(LINEAR, record).velocity == 0.0


@pytest.mark.parametrize("place", [-0.999, -0.4, 0.0, 0.7, 0.999])
def test_motor_that_rests_anywhere_within_its_gap_is_found_where_it_does(place) -> None:
    own = {"gap": 2e-3, "load_share": 0.35}
    plant = replace(LINEAR, effects=(Backlash(**own),))
    truth = Truth(gain=LM1.gain, damping=LM1.damping, effects={"backlash": own})
    setup = Setup(place=place, rest=0.05)
    clean = step_record(truth, 60.0, 2.0, encoder=0.0, setup=setup)
    assert np.abs(simulate(plant, clean, initial_place=place).shown(plant) - clean.position).max() < 1e-7
    record = clean.with_({"position": clean.position + slow_noise(1e-5, len(clean), 5, 0.0)})
    assert beginning(plant, record).place == pytest.approx(place, abs=0.03)  # the noise is 0.01 of half the gap
    assert prediction_error(plant, record).rms_error < 1.05e-5


@pytest.mark.parametrize("place", [1.5, float("nan"), "0.5", None, [0.5], np.array([0.5]), np.array([0.1, 0.2])])
def test_place_within_a_gap_is_a_number_from_one_end_to_the_other(place) -> None:
    record = step_record(LM1, 60.0)
    with pytest.raises(InputError, match="initial_place must be a number from -1 to 1, got "):
        simulate(LINEAR, record, initial_place=place)
    with pytest.raises(InputError, match="place must be a number from -1 to 1, got "):
        Setup(place=place)


@pytest.mark.parametrize("velocity", [float("inf"), float("nan"), "0.5", None, [0.5]])
def test_initial_velocity_is_a_finite_number(velocity) -> None:
    with pytest.raises(InputError, match="initial_velocity must be a finite number, got "):
        simulate(LINEAR, step_record(LM1, 60.0), initial_velocity=velocity)


def test_wrong_plant_is_compared_from_within_its_gap() -> None:
    """Secants towards an end once left the gap."""
    truth = Truth(gain=LM1.gain, damping=LM1.damping, effects={"backlash": {"gap": 2e-3, "load_share": 0.35}})
    dice = np.random.default_rng(4)
    for place in (-0.999, -0.7, 0.2, 0.9, 0.999):
        record = step_record(truth, 60.0, 2.0, encoder=0.0, duration=0.4, setup=Setup(place=place, rest=0.05))
        for _ in range(30):
            gap, share, gain, damping = np.array([2e-3, 0.35, LM1.gain, LM1.damping]) * dice.uniform(0.5, 2.0, 4)
            plant = Plant(gain=gain, damping=damping, effects=(Backlash(gap=gap, load_share=share),))
            assert abs(beginning(plant, record).place) <= 1.0


def test_a_falling_step_has_the_same_size_as_a_rising_one() -> None:
    up = step_record(LM1, 60.0, encoder=0.0)
    down = step_record(LM1, 60.0, encoder=0.0, reference=(0.1, 0.0), duration=1.5).steps()[1]
    assert down.step_size == pytest.approx(up.step_size, rel=1e-2)


def test_table_has_a_row_a_record_and_a_column_a_model() -> None:
    records = table_one(NLM1, 3)
    table = predict({"Lm1": LINEAR, "same": LINEAR}, records)
    assert table.models == ("Lm1", "same")
    assert [row[0].name for row in table.errors] == [record.name for record in records]
    assert table.average_percent[0] == table.average_percent[1]
    assert table.average_percent[0] == pytest.approx(np.mean([row[0].percent_error for row in table.errors]))


@pytest.mark.parametrize("kd", [0.0, 2.0])
def test_coulomb_friction_is_recovered_within_three_standard_errors(kd: float) -> None:
    cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    records = [step_record(cart, kp, kd, noise=1e-5, seed=int(kp)) for kp in (60.0, 100.0)]
    found = servolens.fit([CoulombFriction(level=1.0)], records)
    for name, true in (("gain", 1.9), ("damping", 6.0), ("coulomb_friction.level", 0.4)):
        quantity = found.quantities[name]
        assert quantity.stderr is not None
        assert abs(quantity.value - true) < 3 * quantity.stderr
        assert quantity.stderr < 0.01 * true


def test_friction_is_found_from_the_voltage_alone() -> None:
    cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.4}})
    record = step_record(cart, 60.0, noise=1e-5, seed=1).with_({"reference": None, "controller": None})
    level = servolens.fit([CoulombFriction(level=1.0)], record).plant.effect("coulomb_friction")
    assert level.level == pytest.approx(0.4, rel=0.05)  # type: ignore[union-attr]  # it was asked for


def test_saturation_is_found_where_it_binds() -> None:
    cart = Truth(gain=1.9, damping=6.0, effects={"saturation": {"limit": 4.0}})
    records = [step_record(cart, kp, noise=1e-5, seed=int(kp)) for kp in (60.0, 100.0)]
    found = servolens.fit([Saturation(limit=6.0)], records).plant.effect("saturation")
    assert found.limit == pytest.approx(4.0, rel=1e-2)  # type: ignore[union-attr]  # it was asked for


def test_a_fit_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="no record was given"):
        servolens.fit([CoulombFriction(level=1.0)], [])


def test_plant_itself_misses_little_more_than_the_noise_where_no_reference_is_logged():
    record = step_record(LM1, 60.0, 0.5, reference=(0.1,), noise=1e-5, seed=2, setup=Setup(log_reference=False))
    truth = Plant(gain=LM1.gain, damping=LM1.damping)
    assert np.sqrt(np.mean(prediction_residual(truth, record) ** 2)) < 6e-5


def test_names_that_the_user_gave_to_models_keep_their_letters() -> None:
    record = step_record(LM1, 60)
    plant = Plant(gain=1.9, damping=6.0)
    assert predict(plant, record).summary().sentences[0].startswith("The model is ")
    assert predict([plant, plant], record).summary().sentences[1].startswith("Model 2 is ")
    named = predict({"arm": plant, "Arm": plant}, record).summary().sentences
    assert [said.partition(" is ")[0] for said in named[:2]] == ['The model "arm"', 'The model "Arm"']
