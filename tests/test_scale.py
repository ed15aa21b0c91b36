"""The simulated cluster of benchmarks/scale.py, where the schedule can be told by hand."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
makespan = import_module("scale").makespan


@pytest.mark.parametrize(
    ("costs", "workers", "own", "ahead", "expected"),
    [
        (np.ones(10), 2, 0.0, 1000, 5.0),
        (np.ones(10), 20, 0.0, 1000, 1.0),
        (np.ones(10), 20, 0.0, 2, 5.0),
        (np.array([3.0, 1.0, 1.0, 1.0]), 2, 0.0, 1000, 3.0),
        (np.ones(100), 100, 0.5, 1000, 51.0),
    ],
    ids=["shared", "one each", "two at a time", "the long one is the end", "results kept one by one"],
)
def test_axes_go_to_the_next_free_worker(costs, workers, own, ahead, expected):
    assert makespan(costs, workers, own, ahead) == pytest.approx(expected)


def test_no_schedule_beats_the_work_or_the_longest_axis():
    costs = np.random.default_rng(1).exponential(10.0, 2000)
    for workers in (1, 7, 100):
        end = makespan(costs, workers, 0.0, 1000)
        least = max(costs.sum() / workers, costs.max())
        assert least * (1 - 1e-12) <= end <= costs.sum() / workers + costs.max()  # Graham (1966)
