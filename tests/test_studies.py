"""The long studies of the benchmarks: how they judge, and what they leave behind when they are killed."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fleet_axes import children, is_running

from servolens.lab.laws import KNOTS
from servolens.model import Quantity

CONFUSION = Path(__file__).parent.parent / "benchmarks" / "confusion.py"

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks at processes as Linux shows them")


LEVELS = (0.028, 0.018, 0.022, 0.026, 0.006)
MAP = {f"{side}_{i}": level for side in ("positive", "negative") for i, level in enumerate(LEVELS)}


def found_map(stderr):
    """Return a map whose first knot was found one standard error off, and whose levels are right to a third of one."""
    levels = {name: Quantity(value=level + 3e-5, unit="m/s^2", stderr=9e-5) for name, level in MAP.items()}
    ends = {
        "low": Quantity(value=-0.069, unit="m", stderr=stderr),
        "high": Quantity(value=0.08, unit="m", stderr=stderr),
    }
    return {**levels, **ends}


def test_levels_of_a_friction_map_are_judged_with_the_places_of_their_knots(monkeypatch):
    monkeypatch.syspath_prepend(CONFUSION.parent)
    judged_parameters = importlib.import_module("judging").judged_parameters
    truth = {**MAP, "low": -0.068, "high": 0.08}
    errors, held = judged_parameters("friction_map", truth, found_map(stderr=1e-3))
    assert held == dict.fromkeys(truth, True)
    assert errors["positive_1"] == pytest.approx(3e-5 / 0.018)
    errors, held = judged_parameters("friction_map", truth, found_map(stderr=None))  # the places were stated
    assert held.keys() == MAP.keys()
    level = np.interp(np.linspace(-0.069, 0.08, KNOTS)[1], np.linspace(-0.068, 0.08, KNOTS), LEVELS)
    assert errors["positive_1"] == pytest.approx(abs(0.018 + 3e-5 - level) / level)


def test_study_that_is_killed_leaves_no_worker(tmp_path):
    """A diagnosis takes longer than the test waits: it does not end by itself."""
    options = ["--world", "shaken", "--section", "pairs", "--seeds", "1", "--processes", "1"]
    results = tmp_path / "results.jsonl"
    run = subprocess.Popen(
        [sys.executable, str(CONFUSION), *options, "--results", str(results)], stdout=subprocess.DEVNULL
    )
    try:
        workers = began(run)
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    end = time.monotonic() + 10.0
    while left := [worker for worker in workers if is_running(worker)]:
        if time.monotonic() > end:
            for worker in left:
                os.kill(worker, signal.SIGKILL)
            pytest.fail("a worker goes on without the study")
        time.sleep(0.05)
    assert workers


def began(run):
    """Return the processes that a study has started, as soon as one of them is at work."""
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        assert run.poll() is None, "the study ended too early"
        found = children(run.pid)
        if any(processor_seconds(process) > 4.0 for process in found):
            return found
        time.sleep(0.05)
    raise AssertionError("no worker has begun")


def processor_seconds(process):
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
