"""How often a diagnosis names what the virtual laboratory has hidden, and what it names instead (``make confusion``).

``confusion.py`` diagnoses campaigns and appends what came of each to a file, one JSON line a campaign; a campaign that
stands there already is not done again, so that a long run can be stopped and resumed. ``confusion.py render`` makes the
tables of that file and writes them into docs/confusion.md. ``confusion.py show CASE`` runs one campaign and shows what
was hidden and what was found.

Without ``--final`` the seeds are those for development; no threshold may be chosen on the final ones.
``--section singles --effects delay backlash --seeds 3`` looks closer at some. ``--again`` does campaigns again that
stand in the file; the last line of a campaign counts.

A cause counts half if what was hidden is only among its rivals.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from confusion_tables import line, report
from harness import processor_time
from hidden_cases import MAIN, SECTIONS, Case, Outcome, cases, hide, judged, run

from servolens.fleet.child import end_with_parent
from servolens.lab import WORLDS

if TYPE_CHECKING:
    from collections.abc import Sequence

RESULTS = Path(__file__).with_name("confusion.jsonl")
PAGE = Path(__file__).parent.parent / "docs" / "confusion.md"
BEGIN, END = "<!-- tables begin -->", "<!-- tables end -->"
"""What stands between these on the page is written by ``render``."""


def main(arguments: Sequence[str]) -> None:
    """Do what is asked; without a command, run campaigns."""
    commands = {"run": study, "render": render, "show": show}
    command, *rest = arguments if arguments and arguments[0] in commands else ["run", *arguments]
    if command == "run":  # a process for each core is enough
        one = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "SERVOLENS_PROCESSORS")
        os.environ.update(dict.fromkeys(one, "1"))
    commands[command](rest)


def study(arguments: Sequence[str]) -> None:
    """Diagnose campaigns, and add what came of each to the file at once."""
    asked = _run_arguments(arguments)
    kind = "final" if asked.final else "development"
    wanted = cases(asked.world, asked.section, asked.effects, asked.seeds, asked.first, kind)
    done = {} if asked.again else read(asked.results)
    todo = [case for case in wanted if case not in done]
    print(f"{len(wanted)} campaigns, {len(wanted) - len(todo)} of them done before; {kind} seeds", flush=True)
    begun = time.perf_counter()
    with (
        asked.results.open("a", encoding="utf-8") as file,
        ProcessPoolExecutor(
            asked.processes, get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
        ) as pool,
    ):
        jobs = [pool.submit(run, case, asked.limit) for case in todo]
        for count, job in enumerate(as_completed(jobs), start=1):
            outcome = job.result()
            file.write(json.dumps(outcome.to_json(), ensure_ascii=False) + "\n")
            file.flush()
            if asked.verbose or not outcome.right:
                print(f"[{count}/{len(todo)}] {line(outcome)}", flush=True)
    found = read(asked.results)
    print(f"\n{time.perf_counter() - begun:.0f} s\n\n" + report([found[case] for case in wanted]))


def render(arguments: Sequence[str]) -> None:
    """Write the tables of the file into the page, or print them."""
    parser = argparse.ArgumentParser(prog="confusion.py render", description="Make the tables of a file of results.")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON lines (default %(default)s)")
    parser.add_argument("--out", type=Path, default=PAGE, help="page to write into (default %(default)s); - prints")
    parser.add_argument("--development", action="store_true", help="of the development seeds, not of the final ones")
    asked = parser.parse_args(arguments)
    kind = "development" if asked.development else "final"
    chosen = [outcome for case, outcome in read(asked.results).items() if case.kind == kind]
    text = f"{len(chosen)} campaigns, {kind} seeds.\n\n{report(chosen)}"
    if str(asked.out) == "-":
        print(text)
        return
    page = asked.out.read_text(encoding="utf-8")
    if BEGIN not in page or END not in page:
        raise SystemExit(f"{asked.out} has no lines {BEGIN} and {END} to write the tables between")
    before, _, after = page.partition(BEGIN)
    asked.out.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after.partition(END)[2]}", encoding="utf-8")
    print(f"Wrote {asked.out}")


def read(path: Path) -> dict[Case, Outcome]:
    """Return the outcomes of a file; the last line of a case counts, a line cut short by an interruption does not."""
    found: dict[Case, Outcome] = {}
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            outcome = Outcome.from_json(json.loads(text))
        except json.JSONDecodeError:
            continue
        found[outcome.case] = outcome
    return found


def show(arguments: Sequence[str]) -> None:
    """Run cases, and print what was hidden and what was found."""
    parser = argparse.ArgumentParser(prog="confusion.py show", description="Run single campaigns and show them.")
    parser.add_argument("case", nargs="+", metavar="WORLD:SECTION:NAME:SEED")
    for text in parser.parse_args(arguments).case:
        _show(Case.parse(text))


def _show(case: Case) -> None:
    from servolens import diagnose

    campaign = hide(case)
    print(f"{case}: gain {campaign.truth.gain:.4g}, damping {campaign.truth.damping:.4g}, foreign {campaign.foreign}")
    for name, values in campaign.truth.effects.items():
        print(f"  {name} " + ", ".join(f"{key} {value:.4g}" for key, value in values.items()))
    seen = ", ".join(f"{name} {share:.3g}" for name, share in campaign.shares.items())
    print(f"  visibility {campaign.visibility:.3g} ({seen}), floor {campaign.floor:.3g}")
    print(f"  {campaign.surroundings}")
    for record in (*campaign.records, *campaign.heldout):
        print(f"  {record.name}: {len(record)} samples of {1e3 * record.sample_time:.3g} ms")
    wall, cpu = time.perf_counter(), processor_time()
    found = diagnose(campaign.records, heldout=campaign.heldout)
    print(line(judged(case, campaign, found, time.perf_counter() - wall, processor_time() - cpu)))
    for cause in found.causes:
        numbers = (f"{key} {q.value:.4g} ± {q.stderr}" for key, q in cause.quantities.items())
        print(f"  {cause.effect} " + ", ".join(numbers))
    for finding in found.findings:
        print(f"  {finding.code}: {finding.message}")


def _run_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="confusion.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=list(WORLDS), help="all by default")
    parser.add_argument(
        "--section", nargs="+", choices=SECTIONS, default=list(MAIN), help=f"by default {', '.join(MAIN)}"
    )
    parser.add_argument("--effects", nargs="+", default=[], help="only campaigns that hide one of these")
    parser.add_argument("--seeds", type=int, metavar="N", help="of each row; by default as many as the section has")
    parser.add_argument("--first", type=int, default=0, metavar="K", help="number of the first seed of each row")
    parser.add_argument("--final", action="store_true", help="the seeds for judging, not those for development")
    parser.add_argument("--processes", type=int, default=2, help="at a time (default %(default)s)")
    parser.add_argument("--limit", type=float, default=math.inf, metavar="S", help="seconds for a diagnosis at most")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON lines (default %(default)s)")
    parser.add_argument("--again", action="store_true", help="do campaigns again that stand in the file")
    parser.add_argument("--verbose", action="store_true", help="print every campaign, not only what went wrong")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
