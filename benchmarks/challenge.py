"""Let the entrants answer a challenge of the laboratory and score them (``make challenge``), into docs/challenge.md."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from pages import as_table, write_tables

PAGE = Path(__file__).parents[1] / "docs" / "challenge.md"


def main() -> None:
    """Write the records, answer each case with each entrant, and write the table of scores."""
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "SERVOLENS_PROCESSORS": "1"})
    from entrants import ENTRANTS

    from servolens.fleet.child import end_with_parent
    from servolens.lab.challenge import score_answers, write_challenge

    asked = _arguments(list(ENTRANTS))
    rows, wrong = [], []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "challenge"
        write_challenge(root, asked.seed, asked.cases, asked.world)
        cases = sorted(path for path in root.iterdir() if path.is_dir())
        for entrant in asked.entrants:
            with ProcessPoolExecutor(
                asked.processes, get_context("spawn"), initializer=end_with_parent, initargs=(os.getpid(),)
            ) as pool:
                kept = [_place(asked, entrant, case) for case in cases]
                answered = list(pool.map(answer, [entrant] * len(cases), cases, kept))
            answers = {case.name: found for case, (found, _) in zip(cases, answered, strict=True)}
            score = score_answers(answers, asked.seed, cases=asked.cases, world=asked.world).to_json()
            seconds = sorted(spent for _, spent in answered)[len(cases) // 2]
            rows.append(_row(entrant, score, seconds))
            wrong += [[name, entrant, *_told(one)] for name, one in score["each"].items() if not one["right"]]
            print(entrant, {key: value for key, value in score.items() if key != "each"}, flush=True)
    heads = (
        "entrant",
        "cases right",
        "effects found",
        "named falsely",
        "false alarms",
        "error of sizes",
        "time a case",
    )
    listed = as_table(("case", "entrant", "hidden", "named"), sorted(wrong))
    write_tables(PAGE, {"scores": as_table(heads, rows), "wrong": listed})


def answer(entrant: str, case: Path, kept: Path | None) -> tuple[dict[str, dict[str, float]], float]:
    """Return what an entrant makes of a case, and the processor time that it took [s]; nothing where it fails.

    An answer that a run before has kept is taken.
    """
    from entrants import ENTRANTS

    from servolens import read_record
    from servolens.results import to_text, write_atomically

    if kept is not None and kept.is_file():
        return tuple(json.loads(kept.read_text(encoding="utf-8")))
    records = [read_record(path) for path in sorted(case.glob("run-*.csv"))]
    heldout = [read_record(path) for path in sorted(case.glob("heldout-*.csv"))]
    began = time.process_time()
    try:
        found = ENTRANTS[entrant](records, heldout)
    except Exception as failure:  # an entrant that fails has no answer; the others go on
        print(f"{entrant}, {case.name}: {type(failure).__name__}: {failure}", flush=True)
        found = {}
    spent = time.process_time() - began
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(kept, to_text([found, spent]).encode("utf-8"))
    return found, spent


def _place(asked: argparse.Namespace, entrant: str, case: Path) -> Path | None:
    """Return where an answer is kept."""
    if asked.answers is None:
        return None
    return asked.answers / f"{asked.world}-{asked.seed}" / entrant.replace(" ", "-") / f"{case.name}.json"


def _row(entrant: str, score: dict, seconds: float) -> list[str]:
    error = "–" if score["size_error"] is None else f"{100 * score['size_error']:.2g} %"
    return [
        entrant,
        f"{score['right']} of {score['cases']}",
        f"{score['found']} of {score['hidden']}",
        str(score["false"]),
        f"{score['alarms']} of {score['healthy']}",
        error,
        f"{seconds:.0f} s" if seconds >= 1 else f"{seconds:.1f} s",
    ]


def _told(one: dict) -> tuple[str, str]:
    return tuple(", ".join(one[key]) or "–" for key in ("hidden", "named"))


def _arguments(entrants: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=555_000)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--world", default="white")
    parser.add_argument("--entrants", nargs="+", choices=entrants, default=entrants)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--answers", type=Path, help="folder that keeps each answer, for a run that goes on")
    return parser.parse_args()


if __name__ == "__main__":
    main()
