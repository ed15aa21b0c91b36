"""Lost samples and cycles of clocks whose truth is known: they were made so."""

import numpy as np
import pytest

from servolens.clock import clock_of

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


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_many_losses_are_all_seen(share):
    time = np.arange(SAMPLES)[np.random.default_rng(1).random(SAMPLES) > share] * 1e-3
    true = np.flatnonzero(np.diff(time) > 1.5e-3)
    assert np.isin(lost_of(time), true).all()
    assert np.isin(true, lost_of(time)).mean() > 0.95


@pytest.mark.parametrize("intervals", [(1, 3), (3, 1), (1, 2)])
def test_losses_are_found_where_long_and_short_intervals_alternate(intervals):
    time = np.cumsum(np.tile(intervals, 600)).astype(float)
    assert lost_of(time).size == 0
    assert lost_of(np.delete(time, [300, 301, 700])).tolist() == [299, 697]


@pytest.mark.parametrize("first", [2, 5, 700])
@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (1, 10)])
def test_cycle_that_changes_is_followed(first, before, after):
    true = np.where(np.arange(1500) < first, before, after)
    time = np.concatenate(([0.0], np.cumsum(true)))
    assert clock_of(time).cycles.tolist() == true.tolist()
    assert lost_of(np.delete(time, [100, 101, 1200])).tolist() == [99, 1197]


def test_burst_after_a_late_stamp_is_no_loss():
    time = np.arange(1000.0)
    time[500:503] = [502.6, 502.7, 502.8]  # the log's writer had to wait
    assert lost_of(time).size == 0
    time[503:] += 4.0  # so it had, but four samples were dropped meanwhile
    assert 502 in lost_of(time)


@pytest.mark.parametrize("samples", [2, 3, 5])
def test_few_samples_have_a_clock(samples):
    found = clock_of(np.arange(samples) * 1e-3)
    assert found.cycles.tolist() == pytest.approx([1e-3] * (samples - 1))
    assert not found.lost.any()
