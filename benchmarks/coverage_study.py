"""What the studies of intervals share: surroundings, batches of repetitions, their file, their tables.

A batch is some repetitions of one set-up in one world, each with surroundings of its own. What came of it is appended
to a file as one JSON line; a batch that stands there already is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servolens import lab
from servolens.fleet.child import end_with_parent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from servolens import Record

__all__ = ["Batch", "Job", "Step", "campaign", "carried_out"]

BASES = {"development": 700_000, "final": 900_000}
"""First seeds: what is tuned on the one kind is judged on the other."""
CASES = {
    "AR 0.95": lab.Surroundings(noise=lab.SensorNoise(deviation=1e-5, autoregression=(0.95,))),
    "AR 0.99": lab.Surroundings(noise=lab.SensorNoise(deviation=1e-5, autoregression=(0.99,))),
    "20 µm, noise 1 µm": lab.Surroundings(noise=lab.SensorNoise(deviation=1e-6), encoder=2e-5),
}
"""Surroundings that are stated, beside the worlds, which draw theirs."""
WORLDS = (*lab.WORLDS, *CASES)
AT_ONCE = 10
"""Repetitions of a batch."""
RESULTS = Path(__file__).with_name("coverage.jsonl")
PAGE = Path(__file__).parent.parent / "docs" / "coverage.md"


@dataclass(frozen=True, slots=True)
class Step:
    """One run of a set-up: gains, levels that are visited [m], time at each [s]."""

    kp: float
    kd: float
    levels: tuple[float, ...] = (0.1,)
    each: float = 1.0


@dataclass(frozen=True, slots=True)
class Job:
    """A batch that is to be done: which study, world and set-up, and the numbers of its repetitions."""

    study: str
    world: str
    what: str
    kind: str
    first: int
    count: int

    @property
    def seeds(self) -> range:
        """Seeds of its repetitions."""
        return range(BASES[self.kind] + self.first, BASES[self.kind] + self.first + self.count)


@dataclass(frozen=True, slots=True)
class Batch:
    """What came of a job.

    Attributes
    ----------
    held : dict of str to list of bool or None
        Of each parameter, whether its interval held the truth; None where there is no interval.
    errors : dict of str to list of float
        Relative; of a phase in rad.
    findings : dict of str to int
        Fits that had a finding of such a code that is more than a note.
    failed : list of str
        What fits that failed said.
    seconds : float
        Time in fits, on all cores.
    """

    job: Job
    held: dict[str, list[bool | None]] = field(default_factory=dict)
    errors: dict[str, list[float]] = field(default_factory=dict)
    findings: dict[str, int] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, name: str, error: float, held: bool | None) -> None:
        """Note one parameter of one repetition."""
        self.held.setdefault(name, []).append(held)
        self.errors.setdefault(name, []).append(error)

    def note(self, findings: Iterable[object]) -> None:
        """Note the findings of one fit."""
        for code in {f.code for f in findings if f.severity != "note"}:  # type: ignore[attr-defined]
            self.findings[code] = self.findings.get(code, 0) + 1


def campaign(truth: lab.Truth, steps: Sequence[Step], world: str, seed: int) -> tuple[Record, ...]:
    """Return the records of one repetition; in the repeated world each run is there several times.

    Each run begins anywhere within a step of the encoder, as no axis knows where its encoder's steps are.
    """
    around = CASES.get(world) or lab.surroundings(
        world,
        seed,
        rate=float(np.sqrt(truth.gain * steps[0].kp)),
        damping=truth.damping + truth.gain * steps[0].kd,
    )
    streams = iter(np.random.default_rng(seed).spawn(len(steps) * around.repeats))
    places = iter(np.random.default_rng((seed, 1)).uniform(-0.5, 0.5, len(steps) * around.repeats))
    return tuple(
        lab.step_record(
            truth,
            step.kp,
            step.kd,
            reference=step.levels,
            duration=step.each,
            seed=next(streams),
            setup=lab.Setup(
                surroundings=around,
                name=f"kp {step.kp:g}, kd {step.kd:g}, run {repeat + 1}",
                start=next(places) * (around.encoder or 0.0),
            ),
        )
        for step in steps
        for repeat in range(around.repeats)
    )


def carried_out(study: str, whats: Sequence[str], work: Callable[[Job], Batch], repeats: int, said: str) -> None:
    """Do what the command line asks for, and print the table; ``render`` as its first word writes it to the page."""
    asked = _arguments(said, whats, repeats)
    # a process for each core is enough
    os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "SERVOLENS_PROCESSORS"), "1"))
    kind = "final" if asked.final else "development"
    if asked.render:
        _render(study, [b for b in _read(asked.results).values() if (b.job.study, b.job.kind) == (study, kind)])
        return
    wanted = [
        Job(study, world, what, kind, first, min(AT_ONCE, asked.first + asked.repeats - first))
        for world in asked.world
        for what in asked.what or whats
        for first in range(asked.first, asked.first + asked.repeats, AT_ONCE)
    ]
    done = {} if asked.again else _read(asked.results)
    with (
        asked.results.open("a", encoding="utf-8") as file,
        ProcessPoolExecutor(
            asked.processes, get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
        ) as pool,
    ):
        jobs = [pool.submit(work, job) for job in wanted if job not in done]
        for count, job in enumerate(as_completed(jobs), start=1):
            file.write(json.dumps(asdict(job.result()), ensure_ascii=False) + "\n")
            file.flush()
            print(f"\r{count} of {len(jobs)} batches", end="", flush=True)
    found = _read(asked.results)
    print("\n\n" + _table([found[job] for job in wanted]))


def _arguments(said: str, whats: Sequence[str], repeats: int) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=said, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="set-up", help=f"all by default: {', '.join(whats)}")
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=list(WORLDS), help="all by default")
    parser.add_argument("--repeats", "--seeds", type=int, default=repeats, help="of each (default %(default)s)")
    parser.add_argument("--first", type=int, default=0, metavar="K", help="number of the first repetition")
    parser.add_argument("--final", action="store_true", help="the seeds for judging, not those for development")
    parser.add_argument("--processes", type=int, default=2, help="at a time (default %(default)s)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON lines (default %(default)s)")
    parser.add_argument("--again", action="store_true", help="do batches again that stand in the file")
    parser.add_argument("--render", action="store_true", help="write the table of the file into docs/coverage.md")
    asked = parser.parse_args()
    if unknown := set(asked.what) - set(whats):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(whats)}")
    return asked


def _read(path: Path) -> dict[Job, Batch]:
    """Return the batches of a file; the last line of a job counts."""
    found: dict[Job, Batch] = {}
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            data = json.loads(text)
        except json.JSONDecodeError:  # cut short by an interruption
            continue
        batch = Batch(**{**data, "job": Job(**data["job"])})
        found[batch.job] = batch
    return found


def _render(study: str, batches: Sequence[Batch]) -> None:
    begin, end = f"<!-- {study} begin -->", f"<!-- {study} end -->"
    page = PAGE.read_text(encoding="utf-8")
    if begin not in page or end not in page:
        raise SystemExit(f"{PAGE} has no lines {begin} and {end} to write the table between")
    before, _, after = page.partition(begin)
    text = f"{before}{begin}\n\n{_table(batches)}\n\n{end}{after.partition(end)[2]}"
    PAGE.write_text(text, encoding="utf-8")
    print(f"Wrote {PAGE}")


def _table(batches: Sequence[Batch]) -> str:
    """Return the share of intervals that hold the truth, by parameter and world, and what the fits found wrong."""
    worlds = [world for world in WORLDS if any(b.job.world == world for b in batches)]
    rows = [["", "parameter", *worlds], ["---"] * (len(worlds) + 2)]
    for what in dict.fromkeys(b.job.what for b in batches):
        own = [b for b in batches if b.job.what == what]
        for i, name in enumerate(dict.fromkeys(name for b in own for name in b.held)):
            cells = [_share([b for b in own if b.job.world == world], name) for world in worlds]
            rows.append(["" if i else what, name.rpartition(".")[2], *cells])
    rows.append(["all", "", *(_share([b for b in batches if b.job.world == world]) for world in worlds)])
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    count = sum(b.job.count for b in batches)
    time = sum(b.seconds for b in batches) / max(count, 1)
    doubts = [
        *_doubts(batches, worlds),
        *(f"* {b.job.what}, {b.job.world}: {b.failed[0]}" for b in batches if b.failed),
    ]
    heads = f"{count} fits, {time:.2f} s each on average; {sum(len(b.failed) for b in batches)} failed."
    return "\n\n".join([heads, table] + ["Findings and failures:\n\n" + "\n".join(doubts)] * bool(doubts))


def _doubts(batches: Sequence[Batch], worlds: Sequence[str]) -> Iterator[str]:
    """Yield a line for each set-up and world whose fits had findings that are more than notes."""
    for what in dict.fromkeys(b.job.what for b in batches):
        for world in worlds:
            own = [b for b in batches if (b.job.what, b.job.world) == (what, world)]
            found: Counter[str] = Counter()
            for batch in own:
                found.update(batch.findings)
            count = sum(b.job.count for b in own)
            said = ", ".join(f"`{code}` in {number} of {count}" for code, number in found.most_common(3))
            if said:
                yield f"* {what}, {world}: {said}"


def _share(batches: Sequence[Batch], name: str | None = None) -> str:
    held = [value for b in batches for key, values in b.held.items() for value in values if name in (None, key)]
    known = [value for value in held if value is not None]
    if not known:
        return "no interval" if held else "–"
    bare = f" ({len(held) - len(known)} without)" if len(known) < len(held) else ""
    return f"{100 * sum(known) / len(known):.0f} %" + bare
