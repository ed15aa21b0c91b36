"""Lost samples and cycles of clocks whose truth is known: they were made so."""

import numpy as np
import pytest

from servolens.clock import clock_of, cycle_of, rounded_ticks
from servolens.ticks import Ticks

SAMPLES = 3000
LOST = np.arange(50, 2950, 97)


def late(rng, size):
    """Return stamps of which each is early or late by itself."""
    return np.arange(SAMPLES) + size * rng.uniform(-1, 1, SAMPLES)


def wandering(rng, size):
    """Return stamps whose intervals differ, each by itself."""
    return np.cumsum(1 + size * rng.uniform(-1, 1, SAMPLES))


def lost_of(time):
    return np.flatnonzero(clock_of(time).lost)


@pytest.mark.parametrize(("clock", "size"), [(late, 0.1), (late, 0.3), (wandering, 0.3), (wandering, 0.45)])
@pytest.mark.parametrize("seed", range(5))
def test_clock_that_jitters_loses_nothing_and_does_not_change(clock, size, seed):
    found = clock_of(clock(np.random.default_rng(seed), size))
    assert np.count_nonzero(found.lost) <= 1  # where a stamp is late by 0.6 of an interval, chance may look so
    assert set(found.cycles) == {found.cycles[0]}


@pytest.mark.parametrize(("clock", "size", "share"), [(late, 0.1, 1.0), (late, 0.3, 0.9), (wandering, 0.2, 0.9)])
@pytest.mark.parametrize("seed", range(5))
def test_losses_are_found_in_a_clock_that_jitters(clock, size, share, seed):
    time = np.delete(clock(np.random.default_rng(seed), size), LOST)
    true = LOST - np.arange(LOST.size) - 1
    found = lost_of(time)
    assert np.isin(true, found).mean() >= share
    assert np.min(np.abs(found[:, None] - true), axis=1).max() <= 1  # beside it where the next interval is longer


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_many_losses_are_all_seen(share):
    time = np.arange(SAMPLES)[np.random.default_rng(1).random(SAMPLES) > share] * 1e-3
    true = np.flatnonzero(np.diff(time) > 1.5e-3)
    assert np.isin(lost_of(time), true).all()
    assert np.isin(true, lost_of(time)).mean() > 0.95


def every_third_lost(_):
    return np.arange(SAMPLES) % 3 != 2


def some_lost(share):
    return lambda rng: rng.random(SAMPLES) > share


@pytest.mark.parametrize("kept", [every_third_lost, *map(some_lost, (0.01, 0.1, 0.2, 0.3, 0.4))])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 5])
def test_ticks_of_an_even_clock_are_those_that_were_however_many_samples_are_lost(kept, seed, count):
    there = np.flatnonzero(kept(np.random.default_rng(seed)))
    ticks = Ticks.of(there * 5e-3, count)
    assert ticks.step == pytest.approx(5e-3 / count)
    assert np.array_equal(ticks.index, count * (there - there[0]))


@pytest.mark.parametrize("clock", [late, wandering])
@pytest.mark.parametrize("seed", range(3))
def test_ticks_of_a_clock_that_jitters_are_its_samples(clock, seed):
    time = clock(np.random.default_rng(seed), 0.3)
    ticks = Ticks.of(time)
    assert ticks.index is None
    assert ticks.step == pytest.approx(1.0, rel=1e-3 if clock is late else 1e-2)


@pytest.mark.parametrize("samples", [8, 14, 40])
def test_cycle_that_changes_for_a_while_loses_nothing(samples):
    true = np.repeat([1.0, 2.0, 1.0], [200, samples, 200])
    found = clock_of(np.concatenate(([0.0], np.cumsum(true))))
    assert found.cycles.tolist() == true.tolist()
    assert not found.lost.any()


@pytest.mark.parametrize("first", [2, 5, 700])
@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (1, 10)])
def test_cycle_that_changes_is_followed(first, before, after):
    true = np.where(np.arange(1500) < first, before, after)
    time = np.concatenate(([0.0], np.cumsum(true)))
    assert clock_of(time).cycles.tolist() == true.tolist()
    assert lost_of(np.delete(time, [100, 101, 1200])).tolist() == [99, 1197]


@pytest.mark.parametrize("samples", [2, 3, 5])
def test_few_samples_have_a_clock(samples):
    found = clock_of(np.arange(samples) * 1e-3)
    assert found.cycles.tolist() == pytest.approx([1e-3] * (samples - 1))
    assert not found.lost.any()


@pytest.mark.parametrize("cycle", [2.5, 2.4, 3.3, 2.2, 4.7])
@pytest.mark.parametrize("share", [0.0, 0.003, 0.05])
@pytest.mark.parametrize("rounded", [np.round, np.floor], ids=["rounded", "cut"])
def test_losses_and_cycle_of_rounded_stamps_are_found_together(cycle, share, rounded):
    """Of 2.5 ms in stamps of whole milliseconds the cycle was 3 ms, and lost samples were not found."""
    kept = np.random.default_rng(3).uniform(size=1500) >= share
    kept[:3] = True
    place = np.flatnonzero(kept)
    time = 1e-3 * rounded(place * cycle)
    clock = clock_of(time)
    assert clock.passed.tolist() == np.diff(place).tolist()
    assert clock.lost.tolist() == (np.diff(place) > 1).tolist()
    assert cycle_of(time) == pytest.approx(1e-3 * cycle, rel=1e-4)


def test_stamps_of_whole_cycles_and_late_ones_are_not_rounded():
    whole = np.delete(np.arange(400), [30, 31, 200]) * 2e-3
    late = 5e-3 * np.arange(400) + 1e-3 * (np.random.default_rng(2).uniform(size=400) < 0.1)
    even = 2.5e-3 * np.arange(400)
    assert [rounded_ticks(time) for time in (whole, late, even)] == [None, None, None]


@pytest.mark.parametrize("samples", [10, 50, 400])
@pytest.mark.parametrize(("cycle", "slipped"), [(10.0, 11.0), (10.0, 15.0), (1.0, 1.5), (5.0, 6.0)])
def test_one_stamp_that_slips_is_no_rounding_of_all(samples, cycle, slipped):
    """The cycle of 50 stamps at 10 ms with one interval of 15 ms was 10.15 ms."""
    for place in range(samples - 1):
        time = 1e-3 * np.concatenate(([0.0], np.cumsum(np.where(np.arange(samples - 1) == place, slipped, cycle))))
        assert rounded_ticks(time) is None
        assert cycle_of(time) == pytest.approx(1e-3 * cycle, rel=1e-9)
