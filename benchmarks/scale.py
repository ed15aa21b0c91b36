"""What a million axes take: cost of an axis measured in a fleet, a model, and a simulated cluster, into docs/fleet.md.

``python benchmarks/scale.py`` studies a fleet of axes with hidden effects, then gives the command that runs a fleet
answers that are ready, to see what it costs itself, and keeps both in ``scale.json`` beside this file. ``--measured``
takes what stands there.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import tempfile
import time
from collections import deque
from concurrent.futures import Executor, Future
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pages import as_table, write_tables

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

PAGE = Path(__file__).parents[1] / "docs" / "fleet.md"
MEASURED = Path(__file__).with_name("scale.json")
AXES, WORKERS = 1_000_000, (2, 64, 256, 1000, 4000)
FEW, MANY = 100, 500
"""Axes of the fleets whose answers are ready; their difference is what an axis costs."""


def main() -> None:
    """Measure, or take what was measured, and write the tables."""
    asked = _arguments()
    if not asked.measured:
        MEASURED.write_text(json.dumps(measured(asked)) + "\n", encoding="utf-8")
    found = json.loads(MEASURED.read_text(encoding="utf-8"))
    write_tables(PAGE, {"cost": costs_of_one(found), "scale": costs_of_all(found)})


def measured(asked: argparse.Namespace) -> dict[str, Any]:
    """Return processor seconds of each axis, and what the command itself takes for one."""
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
    from servolens.fleet import Request, run_fleet
    from servolens.lab.challenge import write_challenge

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_challenge(root / "axes", asked.seed, asked.axes)
        (root / "axes" / "challenge.json").unlink()
        request = Request(effort=asked.effort)
        run_fleet(root / "axes", root / "out", request)
        lines = map(json.loads, (root / "out" / "log.jsonl").read_text(encoding="utf-8").splitlines())
        costs = sorted(round(line["cpu_seconds"], 3) for line in lines if line["cpu_seconds"] is not None)
        answers = [json.loads(path.read_text(encoding="utf-8")) for path in (root / "out" / "results").glob("*.json")]
        record = next((root / "axes").rglob("*.csv"))
        own = [_of_the_command(root / f"{count}", count, record, answers, request) for count in (FEW, MANY)]
    return {
        "seed": asked.seed,
        "effort": asked.effort,
        "cpu_seconds": costs,
        "own_seconds": round((own[1] - own[0]) / (MANY - FEW), 5),
    }


def _of_the_command(root: Path, count: int, record: Path, answers: list[dict[str, Any]], request: Any) -> float:
    """Return the processor seconds that a fleet of `count` axes takes whose answers are ready."""
    from servolens.fleet import run_fleet

    for i in range(count):
        axis = root / "axes" / f"axis{i}"
        axis.mkdir(parents=True)
        (axis / record.name).hardlink_to(record)
    began = time.process_time()
    run_fleet(root / "axes", root / "out", request, executor=Ready(answers))
    return time.process_time() - began


class Ready(Executor):
    """Gives each axis the answer of one that was studied, at once."""

    def __init__(self, answers: list[dict[str, Any]]) -> None:
        self._answers, self._given = answers, 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See :meth:`concurrent.futures.Executor.submit`."""
        job, done = json.loads(args[0]), Future()
        answer = self._answers[self._given % len(self._answers)]
        self._given += 1
        result = {**answer, "axis": job["name"], "measured": job["measured"] or None}
        done.set_result(json.dumps({"result": result, "cost": {}}))
        return done


def costs_of_one(found: dict[str, Any]) -> str:
    """Return the distribution of the costs, and the lognormal one with the same median and spread."""
    costs, drawn = np.array(found["cpu_seconds"]), np.log(found["cpu_seconds"])
    middle, spread = float(drawn.mean()), float(drawn.std(ddof=1))
    shares = (0.1, 0.5, 0.9)
    fitted = np.exp(middle + spread * np.array([-1.2816, 0.0, 1.2816]))
    mean = f"{costs.mean():.1f} ± {costs.std(ddof=1) / np.sqrt(costs.size):.1f}"
    rows = [
        [f"{costs.size} axes", mean, *(f"{q:.1f}" for q in np.quantile(costs, shares)), f"{costs.max():.1f}"],
        ["lognormal", f"{np.exp(middle + 0.5 * spread**2):.1f}", *(f"{q:.1f}" for q in fitted), ""],
    ]
    return as_table(("processor seconds an axis", "mean", "10 %", "median", "90 %", "most"), rows)


def costs_of_all(found: dict[str, Any]) -> str:
    """Return the times of a million axes, by the model and by simulation."""
    from servolens.fleet.run import AHEAD

    costs, own = np.array(found["cpu_seconds"]), float(found["own_seconds"])
    rows = []
    for workers in WORKERS:
        expected = AXES * max(costs.mean() / min(workers, AHEAD), own)
        simulated = makespan(np.random.default_rng(workers).choice(costs, AXES), workers, own, AHEAD)
        busy = 100.0 * AXES * costs.mean() / workers / simulated
        rows.append([workers, _told(expected), _told(simulated), f"{simulated / expected - 1:+.1%}", f"{busy:.0f} %"])
    return as_table(("workers", "model", "simulated", "difference", "workers busy"), rows)


def makespan(costs: NDArray[np.float64], workers: int, own: float, ahead: int) -> float:
    """Return when the last axis is kept, if each goes to the next free worker.

    The command hands out `ahead` axes at a time, and takes `own` seconds for each that is finished before it hands out
    another.
    """
    left = iter(costs.tolist())
    given: deque[tuple[float, float]] = deque((0.0, cost) for cost in islice(left, ahead))
    free, running, kept = [0.0] * workers, [], 0.0
    while given or running:
        if given and free and (not running or max(given[0][0], free[0]) <= running[0]):
            ready, cost = given.popleft()
            heapq.heappush(running, max(ready, heapq.heappop(free)) + cost)
            continue
        done = heapq.heappop(running)
        heapq.heappush(free, done)
        kept = max(kept, done) + own
        cost = next(left, None)
        if cost is not None:
            given.append((kept, cost))
    return kept


def _told(seconds: float) -> str:
    hours = seconds / 3600
    return f"{hours / 24:.3g} days" if hours >= 48 else f"{hours:.3g} h"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axes", type=int, default=24, help="that are studied (default %(default)s)")
    parser.add_argument("--seed", type=int, default=556_000)
    parser.add_argument("--effort", choices=("quick", "normal", "thorough"), default="quick")
    parser.add_argument("--measured", action="store_true", help="take what scale.json holds")
    return parser.parse_args()


if __name__ == "__main__":
    main()
