"""A fleet as a machine builder has it: axes of three records of 3 000 samples, on two processors, into docs/fleet.md.

``python benchmarks/fleet_run.py --axes 1000`` is the whole of it (hours); the page says how many were run. Workers are
busy for the share of the time in which they had an axis; what everything but the studies takes is compared in processor
time, so that other work on the machine changes neither. ``--dask`` runs the same axes on a scheduler and two workers of
Dask.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pages import as_table, write_tables

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.lab import Truth

PAGE = Path(__file__).parents[1] / "docs" / "fleet.md"
MEASURED = Path(__file__).with_name("fleet_run.json")
GAINS = ((40, 0), (60, 0), (80, 2))
WORKERS = 2
BODY = "import sys; from fleet_run import fleet; fleet(*sys.argv[1:])"


def main() -> None:
    """Measure, keep the figures beside this file, and write the table."""
    asked = _arguments()
    found = json.loads(MEASURED.read_text(encoding="utf-8")) if MEASURED.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        axes = Path(folder) / "axes"
        make_axes(axes, asked.axes)
        found["dask" if asked.dask else "local"] = measured(axes, Path(folder) / "out", dask=asked.dask)
    MEASURED.write_text(json.dumps(found) + "\n", encoding="utf-8")
    write_tables(PAGE, {"fleet": told(found)})


def make_axes(folder: Path, count: int) -> None:
    """Write axes of four kinds in turn: dry friction, damping that falls with speed, none, and a spring."""
    from servolens import lab

    for i in range(count):
        own = folder / f"axis{i:04d}"
        own.mkdir(parents=True)
        for k, (kp, kd) in enumerate(GAINS):
            run = lab.step_record(
                _truth(i), kp, kd, reference=(0.1, 0.0), duration=1.5, noise=1e-5, seed=len(GAINS) * i + k
            )
            head = f"# kp = {kp} V/m\n# kd = {kd} V s/m\ntime,reference,position,voltage"
            columns = np.column_stack([run.time, run.reference, run.position, run.voltage])
            np.savetxt(own / f"kp{kp}.csv", columns, fmt="%.12g", delimiter=",", header=head, comments="")


def _truth(i: int) -> Truth:
    from servolens import lab

    size = 0.5 + np.random.default_rng(i).random()
    hidden: dict[str, dict[str, float]] = {}
    match i % 4:
        case 0:
            hidden = {"coulomb_friction": {"level": 0.4 * size}}
        case 1:
            hidden = {"velocity_decay_damping": {"alpha1": 17.0 * size, "alpha2": 13.0}}
        case 2:
            hidden = {"return_spring": {"stiffness": 8.0 * size}}
    return lab.Truth(gain=1.9 * size, damping=6.0, effects=hidden)


def measured(axes: Path, out: Path, *, dask: bool) -> dict[str, Any]:
    """Return what a run took; it runs in a process of its own, whose time and that of all it began is counted."""
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    before = _processor_seconds()
    with ExitStack() as stack:
        address = stack.enter_context(_cluster()) if dask else ""
        subprocess.run([sys.executable, "-c", BODY, str(axes), str(out), address], check=True)
    spent = _processor_seconds() - before
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    studies = np.array([line["cpu_seconds"] for line in lines])
    memory = np.array([line["memory"] for line in lines])
    quarter = max(len(lines) // 4, 1)
    wall = json.loads((out / "wall.json").read_text(encoding="ascii"))
    return {
        "axes": len(lines),
        "done": sum(line["status"] == "done" for line in lines),
        "wall": wall,
        "busy": float(sum(line["seconds"] for line in lines) / (WORKERS * wall)),
        "studies": float(studies.sum()),
        "beside": float(spent - studies.sum()),
        "largest": max(line["largest"] for line in lines),
        "early": float(np.median(memory[quarter : 2 * quarter])),
        "late": float(np.median(memory[-quarter:])),
    }


def fleet(axes: str, out: str, address: str) -> None:
    """Run the fleet and keep the time that passed."""
    from servolens.fleet import Request, dask_executor, run_fleet

    request, began = Request(effort="quick", spec={"settling_time": 0.5}), time.monotonic()
    if address:
        with dask_executor(address) as executor:
            run_fleet(axes, out, request, executor=executor)
    else:
        run_fleet(axes, out, request, cores=WORKERS)
    (Path(out) / "wall.json").write_text(json.dumps(time.monotonic() - began), encoding="ascii")


@contextmanager
def _cluster() -> Iterator[str]:
    """Yield the address of a scheduler with two workers, as processes of their own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    script = [sys.executable, "-m"]
    started = [
        subprocess.Popen([*script, *words, "--no-dashboard"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for words in (
            ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)],
            *[["distributed.cli.dask_worker", address, "--no-nanny", "--nthreads", "1"]] * WORKERS,
        )
    ]
    try:
        yield address
    finally:
        for process in started:
            process.terminate()
            process.wait()


def _processor_seconds() -> float:
    """Return what processes that this one began, and that are over, have taken."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def told(found: dict[str, Any]) -> str:
    """Return the table of what was measured."""
    heads = ("", "axes", "time", "workers busy", "processor seconds of the studies", "… of all else", "memory")
    rows = []
    for key, name in (("local", "processes of the command"), ("dask", "Dask")):
        if key in found:
            one = found[key]
            share = 100.0 * one["beside"] / one["studies"]
            rows.append(
                [
                    name,
                    f"{one['axes']}, {one['done']} studied",
                    f"{one['wall'] / 60:.1f} min",
                    f"{100 * one['busy']:.1f} %",
                    f"{one['studies']:.0f}",
                    f"{one['beside']:.0f} ({share:.1f} %)",
                    f"at most {one['largest']:.0f} MiB; {one['early']:.0f} early, {one['late']:.0f} late",
                ]
            )
    return as_table(heads, rows)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axes", type=int, default=60, help="that are studied (default %(default)s)")
    parser.add_argument("--dask", action="store_true", help="on a cluster of Dask on this machine")
    return parser.parse_args()


if __name__ == "__main__":
    main()
