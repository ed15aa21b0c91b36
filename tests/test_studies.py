"""The long studies of the benchmarks: what they leave behind when they are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fleet_axes import children, is_running

CONFUSION = Path(__file__).parent.parent / "benchmarks" / "confusion.py"

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks at processes as Linux shows them")


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
