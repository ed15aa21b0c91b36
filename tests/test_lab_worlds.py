"""The worlds of the laboratory: each has the statistics it states, is drawn by seed, and leaves the axis as it is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from servolens import lab
from servolens.errors import InputError

LOOP = {"rate": np.sqrt(1.9 * 60), "damping": 6.0}
H = 1e-3
RUNNING = np.arange(20_000) * H


def lagged(signal, lag=1):
    signal = signal - signal.mean()
    return float(signal[lag:] @ signal[:-lag] / (signal @ signal))


def drawn(world, seed, time=RUNNING):
    around = lab.surroundings(world, seed, **LOOP)
    return around, around.drawn(time, np.random.default_rng(seed))


def test_every_world_has_a_sentence_and_white_is_the_first():
    assert next(iter(lab.WORLDS)) == "white"
    assert set(lab.WORLDS) == {"white", "coloured", "hum", "coarse", "jittered", "shaken", "repeated"}
    assert all(sentence.endswith(".") for sentence in lab.WORLDS.values())


@pytest.mark.parametrize("world", lab.WORLDS)
def test_the_same_seed_gives_the_same_surroundings_and_another_other_ones(world):
    assert lab.surroundings(world, 1) == lab.surroundings(world, 1)
    if world not in ("white", "repeated"):
        assert lab.surroundings(world, 1) != lab.surroundings(world, 2)


@pytest.mark.parametrize("world", lab.WORLDS)
def test_records_can_be_made_again_and_keep_their_reference(world):
    around = lab.surroundings(world, 4, **LOOP)
    one, again, other = (
        lab.step_record(lab.NLM3, 60, duration=0.3, seed=seed, setup=lab.Setup(surroundings=around))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.position, again.position)
    np.testing.assert_array_equal(one.time, again.time)
    assert np.any(one.position != other.position)
    np.testing.assert_array_equal(one.reference, lab.step_record(lab.NLM3, 60, duration=0.3).reference)
    assert one.encoder_resolution == around.encoder


@pytest.mark.parametrize("autoregression", [(0.8,), (0.95,), (0.99,), (1.3, -0.4)], ids=str)
def test_coloured_noise_has_its_size_and_its_correlation(autoregression):
    noise = lab.SensorNoise(deviation=1e-5, autoregression=autoregression)
    runs = [noise.drawn(RUNNING, np.random.default_rng(seed)) for seed in range(20)]
    first = autoregression[0] / (1 - sum(autoregression[1:]))  # Yule and Walker
    # 20 · 20 000 samples with (1 + φ)/(1 − φ) of them worth one: at most 200, so 2000 that are independent
    assert np.std(runs) == pytest.approx(1e-5, rel=4 / np.sqrt(2 * 2000))
    assert np.mean([lagged(run) for run in runs]) == pytest.approx(first, abs=4 / np.sqrt(20 * 20_000) + 1e-3)


def test_noise_is_as_large_at_the_first_sample_as_later():
    noise = lab.SensorNoise(deviation=1e-5, autoregression=(0.99,))
    firsts = [noise.drawn(RUNNING[:2], np.random.default_rng(seed))[0] for seed in range(2000)]
    assert np.std(firsts) == pytest.approx(1e-5, rel=4 / np.sqrt(2 * 2000))


def test_coloured_worlds_have_poles_between_four_fifths_and_all_but_one():
    slowest = [lab.surroundings("coloured", seed).noise.slowest for seed in range(300)]
    assert min(slowest) >= 0.8
    assert max(slowest) <= 0.99
    assert {len(lab.surroundings("coloured", seed).noise.autoregression) for seed in range(300)} == {1, 2}


@pytest.mark.parametrize("seed", range(6))
def test_hum_is_a_line_of_the_mains_with_the_amplitude_stated(seed):
    around, run = drawn("hum", seed)
    noise = around.noise
    assert noise.mains in (50.0, 60.0)
    for frequency, amplitude in ((noise.mains, noise.hum), (3 * noise.mains, noise.third_harmonic)):
        line = 2 * np.mean(run.noise * np.exp(2j * np.pi * frequency * RUNNING))
        # 20 s hold whole periods of both; white noise leaves √(4/n) of its deviation, taken four times
        assert abs(line) == pytest.approx(amplitude, abs=4 * noise.deviation * np.sqrt(4 / RUNNING.size))


def test_hum_has_another_phase_in_every_run():
    noise = lab.SensorNoise(hum=1e-5)
    one, other = (noise.drawn(RUNNING[:100], np.random.default_rng(seed)) for seed in (1, 2))
    assert np.abs(one - other).max() > 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_coarse_encoders_round_by_far_more_than_their_noise(seed):
    around = lab.surroundings("coarse", seed, travel=0.1)
    assert 5e-6 <= around.encoder <= 4e-5
    assert 10 <= around.encoder / around.noise.deviation <= 30
    record = lab.step_record(lab.NLM3, 60, seed=1, duration=0.5, setup=lab.Setup(surroundings=around))
    counts = record.position / around.encoder
    np.testing.assert_allclose(counts, np.rint(counts), rtol=0, atol=1e-6)


@pytest.mark.parametrize("stated", [True, False], ids=["stated", "nominal"])
def test_jittered_samples_are_taken_at_their_own_instants(stated):
    jitter = lab.Jitter(share=0.05, stated=stated)
    around = lab.Surroundings(encoder=0.0, jitter=jitter)
    setup = lab.Setup(feedforward=np.full(1001, 3.0), trajectory=np.zeros(1001), surroundings=around)
    record = lab.step_record(lab.LM1, kp=0.0, kd=0.0, seed=3, setup=setup)
    nominal = np.arange(1001) * H
    instants = around.drawn(nominal, np.random.default_rng(3)).instants
    assert np.std(instants - nominal) == pytest.approx(0.05 * H, rel=4 / np.sqrt(2 * 1001))
    np.testing.assert_array_equal(record.time, instants if stated else nominal)
    # a constant voltage: the closed form at the true instants
    c, push = lab.LM1.damping, 3.0 * lab.LM1.gain
    expected = push / c * (instants - (1 - np.exp(-c * instants)) / c)
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-12)


def test_voltage_is_held_from_one_jittered_instant_to_the_next():
    around = lab.Surroundings(encoder=0.0, jitter=lab.Jitter(share=0.05))
    delay = {"delay": {"time": 0.0024}}
    axis = lab.Truth(gain=1.9, damping=6.0, effects=delay)
    record = lab.step_record(axis, 60, 2, seed=3, duration=0.3, setup=lab.Setup(surroundings=around))
    x = v = 0.0
    edges = np.sort(np.concatenate([record.time, record.time + 0.0024]))
    edges = edges[edges <= record.time[-1]]
    places = {0.0: 0.0}
    for a, b in itertools.pairwise(edges):
        k = max(int(np.searchsorted(record.time + 0.0024, a, side="right")) - 1, 0)
        u, h = 1.9 * record.voltage[k] / 6.0, b - a
        x, v = x + u * h + (v - u) * (1 - np.exp(-6.0 * h)) / 6.0, u + (v - u) * np.exp(-6.0 * h)
        places[b] = x
    np.testing.assert_allclose(record.position, [places[t] for t in record.time], rtol=0, atol=1e-12)


def test_jittered_worlds_state_the_instants_in_half_of_the_draws():
    stated = [lab.surroundings("jittered", seed).jitter.stated for seed in range(200)]
    assert 70 < sum(stated) < 130  # four standard deviations


def test_shaking_has_its_size_and_its_correlation_time():
    shaking = lab.Shaking(deviation=0.3, correlation_time=0.02)
    runs = [shaking.drawn(RUNNING.size, H, np.random.default_rng(seed)) for seed in range(10)]
    assert np.std(runs) == pytest.approx(0.3, rel=4 * np.sqrt(40 / (2 * 200_000)))
    assert np.mean([lagged(run, 20) for run in runs]) == pytest.approx(np.exp(-1.0), abs=0.03)


def test_shaking_moves_the_axis_as_an_integration_of_its_own_says():
    around = lab.Surroundings(encoder=0.0, shaking=lab.Shaking(deviation=0.5, correlation_time=0.05))
    record = lab.step_record(lab.LM1, 60, seed=2, duration=0.4, setup=lab.Setup(surroundings=around))
    push = around.drawn(record.time, np.random.default_rng(2)).shaking
    c, x, v, expected = lab.LM1.damping, 0.0, 0.0, []
    for k in range(len(record)):
        expected.append(x)
        ahead = push[min(k + 1, len(record) - 1)]
        a, b = lab.LM1.gain * record.voltage[k] + push[k], (ahead - push[k]) / H
        # v̇ = a + b t − c v in closed form
        settled, fade = (a - b / c) / c, np.exp(-c * H)
        x += settled * H + b * H**2 / (2 * c) + (v - settled) * (1 - fade) / c
        v = settled + b * H / c + (v - settled) * fade
    np.testing.assert_allclose(record.position, expected, rtol=0, atol=1e-12)
    still = lab.step_record(lab.LM1, 60, encoder=0.0, duration=0.4)
    assert np.abs(record.position - still.position).max() > 1e-4
    np.testing.assert_array_equal(record.reference, still.reference)


def test_shaking_breaks_a_resting_axis_away_only_beyond_its_friction():
    sticky = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})

    def travel(deviation):
        around = lab.Surroundings(encoder=0.0, shaking=lab.Shaking(deviation=deviation, correlation_time=0.05))
        record = lab.step_record(sticky, 60, reference=0.0, seed=2, duration=1.0, setup=lab.Setup(surroundings=around))
        return np.abs(record.position).max()

    assert travel(0.01) == 0.0
    assert travel(1.0) > 1e-5


@pytest.mark.parametrize("correlation_time", [0.01, 0.1])
def test_position_error_of_a_shaken_loop_is_the_one_foretold(correlation_time):
    gain, damping, kp = 1.9, 12.0, 60
    shaking = lab.Shaking(deviation=0.2, correlation_time=correlation_time)
    around = lab.Surroundings(encoder=0.0, shaking=shaking)
    axis = lab.Truth(gain=gain, damping=damping)
    records = lab.step_records(
        axis, kp, repeats=40, reference=0.0, duration=4.0, seed=1, setup=lab.Setup(surroundings=around)
    )
    late = np.array([record.position[1000:] for record in records])
    foretold = shaking.position_error(np.sqrt(gain * kp), damping)
    # 40 runs of 3 s, each some 18 independent pieces, are known to 2.6 %, taken four times
    assert late.std() == pytest.approx(foretold, rel=0.1)


def test_shaken_worlds_err_by_three_to_twenty_times_the_noise():
    errors = [
        lab.surroundings("shaken", seed, noise=1e-5, **LOOP).shaking.position_error(LOOP["rate"], LOOP["damping"])
        for seed in range(100)
    ]
    assert min(errors) >= 3e-5
    assert max(errors) <= 2e-4
    assert max(errors) / min(errors) > 4


@pytest.mark.parametrize("world", ["shaken", "coloured", "jittered"])
def test_many_runs_at_once_are_the_runs_one_by_one(world):
    around = lab.surroundings(world, 3, **LOOP)
    settings = {"duration": 0.2, "setup": lab.Setup(surroundings=around)}
    together = lab.step_records(lab.NLM1, 60, 1, repeats=3, seed=4, **settings)
    for record, stream in zip(together, np.random.default_rng(4).spawn(3), strict=True):
        alone = lab.step_record(lab.NLM1, 60, 1, seed=stream, **settings)
        np.testing.assert_allclose(record.position, alone.position, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(record.time, alone.time)


@pytest.mark.parametrize("world", lab.WORLDS)
def test_campaigns_of_all_worlds_are_of_the_same_axis(world):
    white, other, again = (lab.hidden_campaign(21, heldout=1, world=w) for w in ("white", world, world))
    assert other.world == world
    assert (other.truth.gain, other.truth.damping) == (white.truth.gain, white.truth.damping)
    repeats, kept = other.surroundings.repeats, len(other.records) // other.surroundings.repeats
    for i, record in enumerate(other.records):
        np.testing.assert_array_equal(record.reference, white.records[i // repeats].reference)
        assert record.controller == white.records[i // repeats].controller
        np.testing.assert_array_equal(record.position, again.records[i].position)
    assert (kept == len(white.records)) or (world == "repeated" and kept == 2)
    assert len({record.name for record in other.records}) == len(other.records)
    np.testing.assert_array_equal(other.heldout[0].reference, white.heldout[0].reference)
    assert other.visibility == 0.0
    assert other.floor > 0.0


def test_repeated_runs_differ_by_noise_alone():
    campaign = lab.hidden_campaign(22, effects=["coulomb_friction"], visibility=30.0, world="repeated")
    repeats = campaign.surroundings.repeats
    assert repeats in (2, 3)
    for first in range(0, len(campaign.records), repeats):
        one, other = campaign.records[first], campaign.records[first + 1]
        assert one.controller == other.controller
        spread = np.std(one.position - other.position) / np.sqrt(2)
        assert 0.2 * campaign.floor < spread < 5 * campaign.floor


@pytest.mark.parametrize("world", [world for world in lab.WORLDS if world != "white"])
def test_an_effect_is_as_visible_in_its_world_as_asked(world):
    campaign = lab.hidden_campaign(23, effects=["coulomb_friction"], visibility=20.0, records=2, world=world)
    assert campaign.visibility == pytest.approx(20.0, rel=0.2)
    assert list(campaign.shares) == ["coulomb_friction"]
    assert campaign.floor >= 0.5 * np.hypot(campaign.noise, campaign.encoder / np.sqrt(12))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lab.hidden_campaign(1, world="windy"), "no world 'windy'; there are white, coloured"),
        (lambda: lab.surroundings("windy", 1), "no world 'windy'"),
        (lambda: lab.surroundings("shaken", 1, rate=0.0), "rate must be positive and finite, got 0.0"),
        (lambda: lab.SensorNoise(deviation=-1.0), "noise: deviation must be at least 0"),
        (lambda: lab.SensorNoise(deviation=1.0, autoregression=(1.0,)), r"autoregression \(1.0,\) is not stationary"),
        (lambda: lab.Shaking(deviation=1.0, correlation_time=0.0), "correlation_time must be positive"),
        (lambda: lab.Jitter(share=0.5), "share must lie between 0 and 0.2, got 0.5"),
        (lambda: lab.Surroundings(repeats=0), "repeats must be at least 1, got 0"),
        (
            lambda: lab.step_record(lab.LM1, 60, setup=lab.Setup(surroundings=lab.surroundings("shaken", 1))),
            "noise needs a seed",
        ),
    ],
    ids=["campaign", "world", "rate", "deviation", "stationary", "correlation", "jitter", "repeats", "seed"],
)
def test_what_cannot_be_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
