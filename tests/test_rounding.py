"""Draws of an encoder's rounding, and what a sum of squares of them reaches by chance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from servolens import Plant, Record, fit, lab
from servolens.effects import Cogging, EndStop
from servolens.identification.noise import NoiseModel
from servolens.identification.observed import ObservedRun
from servolens.identification.resampling import profile
from servolens.identification.rounding import (
    DRAWS,
    before_rounding,
    dominates,
    drawn_noise,
    draws_for,
    is_rounded,
    law_of_squares,
    own_spectra,
    parted,
    rounded,
    spectrum_of,
)
from servolens.identification.signals import Signals
from servolens.identification.slow_noise import filters_of

STEP = 1e-5
TIME = np.arange(2000) * 1e-3
AXIS = Plant(gain=2.0, damping=5.0)


def run_of(position):
    """Return a run at the voltage that keeps an axis of this constant speed going."""
    speed = (position[-1] - position[0]) / TIME[-1]
    voltage = np.full(TIME.size, AXIS.damping * speed / AXIS.gain)
    shown = STEP * np.round(position / STEP)
    record = Record(time=TIME, position=shown, voltage=voltage, encoder_resolution=STEP)
    return ObservedRun(Signals.of(record, STEP, AXIS, 10.0), 0, NoiseModel.white(0.0, STEP))


def draws_of(run, plant, start):
    of = [run], [plant], [np.array(start)]
    return rounded(*of, own_spectra(*of))


def test_law_of_a_multiple_of_chi_square_has_its_quantile():
    draws = 3.0 * np.random.default_rng(5).chisquare(7, 40_000)
    assert law_of_squares(draws).isf(1e-3) == pytest.approx(3.0 * chi2.isf(1e-3, 7), rel=0.03)


def test_nothing_has_the_law_of_nothing():
    assert law_of_squares(np.zeros(10)).isf(1e-3) == pytest.approx(0.0, abs=1e-200)


def test_rounding_at_rest_is_one_error_all_along():
    """But beside an edge, where noise would show that is too small to be seen elsewhere."""
    run = run_of(np.full(TIME.size, 0.02))
    (drawn,) = draws_of(run, AXIS, [0.02, 0.0])
    assert drawn.shape == (TIME.size, DRAWS)
    rests = np.ptp(drawn, axis=0) < 1e-9
    assert np.mean(rests) > 0.9
    assert np.ptp(drawn[0, rests]) > 0.0


def quick_noise_of(speed, share, ripple=0.0):
    """Return the sizes of the quick noise in draws of a steady motion, both in steps of the encoder a sample.

    Beside a `ripple` of 50 Hz, in steps.
    """
    begun, noise = 0.3 * STEP, share * np.random.default_rng(3).standard_normal(TIME.size)
    noise += ripple * np.sin(2.0 * np.pi * 50.0 * TIME + 1.0)
    shown = STEP * np.round((begun + speed * STEP * np.arange(TIME.size)) / STEP + noise)
    velocity = speed * STEP / TIME[1]
    voltage = np.full(TIME.size, AXIS.damping * velocity / AXIS.gain)
    record = Record(time=TIME, position=shown, voltage=voltage, encoder_resolution=STEP)
    lines = (50.0,) if ripple else ()
    run = ObservedRun(Signals.of(record, STEP, AXIS, 10.0), 0, replace(NoiseModel.white(0.0, STEP), lines=lines))
    return np.sqrt(own_spectra([run], [AXIS], [np.array([begun, velocity])]).min(axis=1)) / STEP


@pytest.mark.parametrize(("share", "tolerance"), [(0.1, 0.25), (0.3, 0.12)])
@pytest.mark.parametrize("speed", [0.0, 0.00173, 0.0173, 0.173, 1.73])
def test_noise_smaller_than_a_step_is_found_by_what_it_makes_of_the_steps(speed, share, tolerance):
    assert np.median(quick_noise_of(speed, share)) == pytest.approx(share, rel=tolerance)


@pytest.mark.parametrize(
    ("speed", "most"), [(0.0, 0.04), (0.00173, 0.004), (0.0173, 0.01), (0.173, 0.04), (1.73, 0.04)]
)
def test_where_no_noise_is_seen_there_may_be_as_much_as_would_not_show(speed, most):
    """Of a slow motion little more than the axis moves from sample to sample, or it would turn back at a step."""
    found = quick_noise_of(speed, 0.0)
    assert found.min() == 0.0
    assert found.max() <= most


@pytest.mark.parametrize("share", [0.03, 0.1])
def test_quick_noise_is_told_from_a_ripple_of_the_mains_below_the_step(share):
    assert np.median(quick_noise_of(0.0173, share, ripple=0.2)) == pytest.approx(share, rel=0.25)


def test_rounding_of_a_fast_motion_is_white():
    run = run_of(0.0173 * TIME)  # 1.73 steps a sample
    (drawn,) = draws_of(run, AXIS, [0.0, 0.0173])
    centred = drawn - drawn.mean(axis=0)
    together = np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2)
    assert abs(together) < 0.4
    assert np.std(drawn) == pytest.approx(1.0, rel=0.01)  # of a uniform error: STEP / √12


TRUTH = lab.Truth(gain=1.9, damping=6.0, effects={})


def stage(noise, seed):
    """A loop whose derivative hands the encoder's steps on to the motor; it stops where no step is."""
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=noise), encoder=2e-5)
    levels = (0.1 + 3.1e-6 * seed, 0.03 - 1.7e-6 * seed)
    return lab.step_record(TRUTH, kp=80, kd=5, reference=levels, seed=seed, setup=lab.Setup(surroundings=around))


def drawn_of(record, noise):
    axis = Plant(gain=1.9, damping=6.0)
    run = ObservedRun(Signals.of(record, 2e-5, axis, 10.0), 0, NoiseModel.white(noise, 2e-5))
    (drawn,) = draws_of(run, axis, [record.position[0], 0.0])
    return run, drawn


@pytest.mark.parametrize("noise", [1e-6, 2e-6], ids=lambda noise: f"{noise / 2e-5:.2f} steps")
def test_draws_miss_on_average_what_the_records_of_the_axis_miss(noise):
    kept = []
    for seed in range(6):
        run, drawn = drawn_of(stage(noise, seed), noise)
        missed = run.whiten(run.missed(Plant(gain=1.9, damping=6.0), run.start, 4))
        usual = drawn.mean(axis=1)
        kept.append(float(missed @ usual) / float(usual @ usual))
    assert np.mean(kept) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("noise", [1.3e-5, 4e-5], ids=lambda noise: f"{noise / 2e-5:.2f} steps")
def test_draws_are_as_large_as_what_the_records_of_the_axis_miss(noise):
    sizes = []
    for seed in range(4):
        run, drawn = drawn_of(stage(noise, seed), noise)
        missed = run.whiten(run.missed(Plant(gain=1.9, damping=6.0), np.zeros(2), 4))
        sizes.append(np.sqrt(np.mean(drawn**2) / np.mean(missed**2)))
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.05)
    assert np.max(sizes) < 1.08


@pytest.mark.slow
def test_what_rounding_does_to_estimates_is_taken_off_them():
    fits = [fit((), [stage(1e-6, seed)]).quantities["damping"] for seed in range(20, 36)]
    errors = np.array([found.value - 6.0 for found in fits])
    assert np.sqrt(np.mean(errors**2)) < 8e-5  # left on, it makes 1.5e-4
    shares = np.abs(errors) / [found.stderr for found in fits]
    assert np.mean(shares < 1.96) >= 0.8
    assert np.median(shares) > 0.2


def between_teeth(seed):
    """A loop at rest between two teeth, which goes to and fro over a step, less so the more noise there is."""
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=2.283e-6), encoder=5.781e-5)
    teeth = {"amplitude": 1.49557, "pitch": 0.0261715, "phase": 1.08222}
    truth = lab.Truth(gain=1.83251, damping=23.0971, effects={"cogging": teeth})
    loops = (569.0, 0.0, (0.26, 0.00288), 1.6), (1070.0, 29.0, (-0.142, 0.0548), 1.934)
    setup = lab.Setup(surroundings=around)
    return truth, [
        lab.step_record(truth, kp, kd, reference=levels, duration=end, seed=2 * seed + i, setup=setup)
        for i, (kp, kd, levels, end) in enumerate(loops)
    ]


@pytest.mark.slow
def test_error_bars_of_a_force_that_depends_on_the_place_hold_beside_a_coarse_encoder():
    shares = []
    for seed in range(8):
        truth, records = between_teeth(seed)
        expected = truth.effects["cogging"]
        found = fit([Cogging(**expected)], records).quantities
        shares.append([(found[f"cogging.{k}"].value - v) / found[f"cogging.{k}"].stderr for k, v in expected.items()])
    # chance reaches that with one of three in 3 000 times; of the phase it was 3.2 with its bias left on
    assert np.sqrt(np.mean(np.square(shares), axis=0)).max() < 2.0


def test_profile_beside_a_coarse_encoder_is_that_of_the_estimate():
    found = fit((), [stage(1e-6, 25)])
    damping = found.quantities["damping"]
    low, high = profile(found, "damping").interval
    assert 0.5 * (low + high) == pytest.approx(damping.value, abs=0.2 * damping.stderr)
    assert high - low == pytest.approx(2.0 * 1.96 * damping.stderr, rel=0.1)


def test_friction_that_is_nothing_but_rounding_ends_at_none():
    level = fit("coulomb_friction", [stage(1e-6, 20)]).quantities["coulomb_friction.level"]
    assert (level.value, level.stderr) == (0.0, None)
    assert level.reason == "it ended at the end of its range"


def test_a_stop_that_an_axis_rests_against_is_known_no_better_than_the_encoders_step():
    """For an encoder shows one and the same step there, however long it is looked at."""
    around, runs = lab.Surroundings(noise=lab.SensorNoise(deviation=1e-6), encoder=2e-5), ((40.0, 0.0), (100.0, 5.0))
    for seed, high in enumerate((0.0960052, 0.0960118, 0.0960173)):
        stopped = lab.Truth(gain=1.9, damping=6.0, effects={"end_stop": {"low": -1.0, "high": high}})
        records = [
            lab.step_record(
                stopped, kp, kd, reference=(0.1, 0.0), duration=0.8, seed=seed, setup=lab.Setup(surroundings=around)
            )
            for kp, kd in runs
        ]
        found = fit([EndStop(low=-1.0, high=0.09)], records, fixed={"end_stop.low": -1.0}).quantities["end_stop.high"]
        assert abs(found.value - high) < 3.0 * found.stderr
        assert 0.02 * 2e-5 < found.stderr < 2e-5


@pytest.mark.slow
def test_a_stop_that_is_one_for_all_records_is_known_no_better_from_many():
    """Its place within an encoder's step is the same in each of them, and does not average out."""
    stopped = lab.Truth(gain=1.9, damping=6.0, effects={"end_stop": {"low": -1.0, "high": 0.0960052}})
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=1e-6), encoder=2e-5)
    records = [
        lab.step_record(
            stopped, kp, 0, reference=(0.1, 0.0), duration=0.8, seed=kp, setup=lab.Setup(surroundings=around)
        )
        for kp in (40, 45, 50, 55, 60, 65)
    ]
    one, many = (
        fit([EndStop(low=-1.0, high=0.09)], runs, fixed={"end_stop.low": -1.0}).quantities["end_stop.high"].stderr
        for runs in (records[:1], records)
    )
    assert many > 0.7 * one


def test_a_stop_that_is_not_there_stays_away():
    """It lies at the end of its range, which a shift by an encoder's step would leave."""
    assert EndStop(low=-1e12, high=0.09).shifted(-1e-3) == EndStop(low=-1e12, high=0.089)


def test_rounding_without_a_loop_has_no_mean():
    record = stage(1e-6, 3).with_({"reference": None})
    run, drawn = drawn_of(record, 1e-6)
    mean, rest = parted(run, drawn)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(rest, drawn)


def test_draws_about_their_mean_are_as_large_as_a_further_one():
    run, drawn = drawn_of(stage(1e-6, 3), 1e-6)
    mean, rest = parted(run, drawn)
    np.testing.assert_allclose(mean, drawn.mean(axis=1))
    np.testing.assert_allclose(rest.mean(axis=1), 0.0, atol=1e-9)
    further = np.std(drawn, axis=1, ddof=1) * np.sqrt(1.0 + 1.0 / DRAWS)
    np.testing.assert_allclose(np.sqrt(np.mean(rest**2, axis=1)), further, rtol=1e-9, atol=1e-12)


def test_rounding_dominates_from_half_the_variance_on():
    assert dominates(NoiseModel.white(0.5 * STEP / np.sqrt(12.0), STEP))
    assert not dominates(NoiseModel.white(STEP, STEP))
    assert not is_rounded(NoiseModel.white(STEP, 0.0))


def rounded_beside(quick):
    """Return the noise of a resting sensor with so much white noise, in steps of its encoder."""
    return NoiseModel.white(STEP * np.hypot(quick, 1.0 / np.sqrt(12.0)), STEP)


def test_rounding_beside_quick_noise_is_white_noise_itself():
    places = np.linspace(-0.5, 0.5, 41)
    for quick, most in ((0.3, None), (0.55, 0.0025)):
        tails = np.arange(-6, 7)[:, None] - places  # what the encoder shows of each place, on average: a closed form
        chance = norm.cdf((tails + 0.5) / quick) - norm.cdf((tails - 0.5) / quick)
        mean = np.arange(-6, 7) @ chance - places
        assert is_rounded(rounded_beside(quick)) == (most is None)
        assert np.max(np.abs(mean)) > 0.02 if most is None else np.max(np.abs(mean)) < most


def test_slow_noise_does_not_make_rounding_white():
    slow = NoiseModel.white(STEP, STEP)
    slow = replace(slow, filters=(np.ones(1), np.array([1.0, -0.95])), scales=STEP * np.array([1.0, 0.3]))
    assert is_rounded(slow)
    quick = replace(slow, scales=STEP * np.array([4.0, 1.2]))
    assert not is_rounded(quick)


def test_slow_noise_of_half_a_step_is_found_beside_an_axis_that_rests():
    """It takes the axis over many steps: what an axis shows that rests without it is not to be taken off."""
    axis, spread, pole = Plant(gain=1.9, damping=6.0), 1.1e-5, 0.97
    around = lab.Surroundings(noise=lab.SensorNoise(deviation=spread, autoregression=(pole,)), encoder=2e-5)
    angle = np.linspace(0.0, np.pi, 4097)
    slowly = (1.0 - pole**2) * spread**2 / (1.0 + pole**2 - 2.0 * pole * np.cos(angle))
    filters, scales = filters_of(slowly + (2e-5) ** 2 / 12.0, 24)
    noise = replace(NoiseModel.white(1.0, 2e-5), filters=filters, scales=scales, spread=float(scales[0]))
    setup = lab.Setup(surroundings=around)
    record = lab.step_record(TRUTH, kp=80, kd=1, reference=(0.1, 0.03), seed=4, setup=setup)
    run = ObservedRun(Signals.of(record, 2e-5, axis, 10.0), 0, noise)
    found = own_spectra([run], [axis], [np.zeros(2)]).mean(axis=0)
    share = found[:20] / np.interp(np.linspace(0.0, np.pi, found.size), angle, slowly)[:20]
    assert np.mean(share) == pytest.approx(1.0, abs=0.25)
    assert share.min() > 0.5  # without a second look next to nothing


def test_error_bars_are_of_more_draws_where_these_cost_little():
    assert draws_for(1_000) == draws_for(9_000) == 4 * DRAWS
    assert draws_for(1_000_000) == DRAWS


@pytest.mark.parametrize("slow", [0.5, 3.0])
def test_noise_before_rounding_has_the_spectrum_of_what_is_shown_once_it_is_rounded(slow):
    quick, pole = 0.55, np.exp(-0.02)
    angle = np.linspace(0.0, np.pi, 4097)
    slowly = (1.0 - pole**2) * slow**2 / (1.0 + pole**2 - 2.0 * pole * np.cos(angle))
    filters, scales = filters_of(slowly + quick**2 + 1.0 / 12.0, 24)
    noise = replace(NoiseModel.white(1.0, 1.0), filters=filters, scales=scales, spread=float(scales[0]))
    assert not is_rounded(noise)
    own = drawn_noise(before_rounding(noise), 20_000, np.random.default_rng(3), 8)
    shown = np.round(own + 0.3)
    quick_part = np.abs(np.fft.rfft(shown, axis=0)[5_000:]) ** 2 / 20_000
    assert np.mean(quick_part) == pytest.approx(np.mean(spectrum_of(noise)[512:]), rel=0.03)
