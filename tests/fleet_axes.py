"""Folders of axes for the tests of fleets: few, short, and studied with little effort."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from servolens import lab

OPTIONS = ("--effort", "quick", "--settling-time", "0.5")


def write_record(path, *, kp=60, seed=1, duration=0.3, level=0.0, truth=None):
    """Log one short step of a virtual axis as a CSV file."""
    record = lab.step_record(truth or lab.NLM1, kp=kp, noise=1e-5, seed=seed, duration=duration)
    rows = zip(record.time, record.reference, record.position, record.voltage, strict=True)
    lines = [f"# kp = {kp} V/m", "# kd = 0 V s/m", "time [s],reference [m],position [m],voltage [V]"]
    lines += [",".join(repr(float(x)) for x in row) for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def make_axes(folder):
    """Write three axes that take little to study, and one that cannot be: with a cause, healthy, and without a gain."""
    write_record(folder / "axis0" / "kp60.csv", seed=100, duration=0.15)
    write_record(folder / "axis1" / "kp60.csv", seed=102, truth=lab.LM1)
    write_record(folder / "axis2" / "kp20.csv", seed=102, truth=lab.LM1, kp=20)
    (folder / "unreadable").mkdir(parents=True)
    (folder / "unreadable" / "log.csv").write_text("no numbers here\n", encoding="utf-8")
    return folder


def command(folder, out, *more):
    return [sys.executable, "-m", "servolens", "fleet", str(folder), "--out", str(out), *OPTIONS, *more]


def start(folder, out, *more):
    """Begin a run of the command, as a process of its own that heeds interrupts even where this one does not."""
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            command(folder, out, *more),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
    finally:
        signal.signal(signal.SIGINT, heeded)


def finish(folder, out, *more):
    """Run the command to its end."""
    done = subprocess.run(command(folder, out, *more), capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode in (0, 1), done.stderr
    assert done.stderr == ""
    return done


def results(out):
    """Return every result without when it was made; fails where one is not whole."""
    found = {}
    for path in sorted((Path(out) / "results").glob("*.json")):
        text = path.read_text(encoding="utf-8")
        json.loads(text)
        found[path.name] = "\n".join(line for line in text.splitlines() if not line.startswith(' "created"'))
    return found


def studied(out):
    """Return the axes in the order in which their results were kept, from the log."""
    path = Path(out) / "log.jsonl"
    if not path.exists():
        return []
    return [json.loads(line)["axis"] for line in path.read_text(encoding="utf-8").splitlines()]


def children(process):
    """Return the processes that a process began (Linux), once they run a program of their own.

    Before, its parent waits for them, and would for ever if they were stopped.
    """
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        found += [int(child) for child in task.read_text(encoding="ascii").split()]
    return [child for child in found if _program(child) not in ("", _program(process))]


def _program(process):
    try:
        return Path(f"/proc/{process}/cmdline").read_text(encoding="utf-8")
    except OSError:
        return ""


def is_running(process):
    """Tell whether a process works, one that is over but not taken leave of does not."""
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
