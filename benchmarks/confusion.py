"""How often a diagnosis names what the virtual laboratory has hidden, and what it names instead (``make confusion``).

Sections: single effects, pairs, triples, healthy axes, laws foreign to the catalogue, effects near the noise, three
levels of noise, one record only, no voltage or no reference in the log, smooth references. ``--seeds development`` is
for tuning, ``final`` for judging: no threshold may be chosen on the latter.

``python benchmarks/confusion.py --only singles --effects delay backlash --repeats 3`` looks closer at some. Each case
that went wrong is printed with its name; ``--case NAME`` runs that one and shows what was hidden and what was found.
A cause counts half if what was hidden is only among its rivals.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from hidden_cases import BASES, SECTIONS, Case, Outcome, cases, hide, judged, run

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

GOOD_PREDICTION = 1.15
"""A held-out error up to this many noise floors leaves nothing to explain."""


def main() -> None:
    """Run the cases that are asked for, and print what came of them."""
    asked = _arguments()
    os.environ.update({"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})  # a process for each core is enough
    if asked.case:
        for text in asked.case:
            show(Case.parse(text))
        return
    begun = time.perf_counter()
    outcomes = study(cases(asked.only, asked.effects, asked.repeats, BASES[asked.seeds]), asked.processes)
    text = report(outcomes, asked.seeds, time.perf_counter() - begun)
    print(text)
    if asked.out:
        asked.out.write_text(text + "\n", encoding="utf-8")


def study(todo: Sequence[Case], processes: int) -> list[Outcome]:
    """Diagnose every case, and say at once where one went wrong; in the order of the cases."""
    found: dict[Case, Outcome] = {}
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(run, case) for case in todo]
        for done, job in enumerate(as_completed(jobs), start=1):
            outcome = job.result()
            found[outcome.case] = outcome
            if not outcome.right:
                print(f"[{done}/{len(todo)}] {_line(outcome)}", flush=True)
    return [found[case] for case in todo]


def report(outcomes: Sequence[Outcome], seeds: str, seconds: float) -> str:
    """Return the study as Markdown."""
    by_section = {name: [o for o in outcomes if o.case.section == name] for name in SECTIONS}
    parts = [
        f"# What diagnoses name\n\n{len(outcomes)} campaigns, seeds: {seeds}, {seconds:.0f} s in all;"
        f" a diagnosis takes {np.median([o.seconds for o in outcomes]) if outcomes else 0:.1f} s (median).",
        _summary(by_section),
    ]
    if by_section["singles"]:
        parts.append(_singles(by_section["singles"]))
    if foreign := by_section["foreign"]:
        rows = [(o.case.hidden[0], o.verdict, ", ".join(o.causes) or "–") for o in foreign]
        parts.append("## Foreign laws\n\n" + _table(("law", "verdict", "named"), rows))
    wrong = [o for o in outcomes if not o.right]
    parts.append(f"## {len(wrong)} cases that went wrong\n\n" + "\n".join(f"* `{o.case}` {_told(o)}" for o in wrong))
    return "\n\n".join(parts)


def show(case: Case) -> None:
    """Run one case, and print what was hidden and what was found."""
    from servolens import diagnose

    campaign = hide(case)
    print(f"{case}: gain {campaign.truth.gain:.4g}, damping {campaign.truth.damping:.4g}, foreign {campaign.foreign}")
    for name, values in campaign.truth.effects.items():
        print(f"  {name} " + ", ".join(f"{key} {value:.4g}" for key, value in values.items()))
    seen = ", ".join(f"{name} {share:.3g}" for name, share in campaign.shares.items())
    print(f"  visibility {campaign.visibility:.3g} ({seen}), floor {campaign.floor:.3g}")
    for record in (*campaign.records, *campaign.heldout):
        print(f"  {record.name}: {len(record)} samples of {1e3 * record.sample_time:.3g} ms")
    begun = time.perf_counter()
    found = diagnose(campaign.records, heldout=campaign.heldout)
    print(_line(judged(case, campaign, found, time.perf_counter() - begun)))
    for cause in found.causes:
        print(
            f"  {cause.effect} " + ", ".join(f"{key} {q.value:.4g} ± {q.stderr}" for key, q in cause.quantities.items())
        )


def _summary(by_section: dict[str, list[Outcome]]) -> str:
    rows = []
    for name, found in by_section.items():
        if not found:
            continue
        alarms = _share(found, lambda o: bool(o.causes) or o.verdict not in ("healthy", "failed"))
        numbers = {
            "healthy": ("", "", f"false alarms {alarms}"),
            "foreign": ("", "", f"explained by a wrong cause {_share(found, lambda o: o.verdict == 'explained')}"),
            "small": (
                _share(found, lambda o: o.first),
                _share(found, lambda o: o.all_named),
                f"a wrong name alone {_share(found, lambda o: bool(o.causes) and o.all_named == 0)},"
                f" said healthy {_share(found, lambda o: o.verdict == 'healthy')}",
            ),
        }.get(name, (_share(found, lambda o: o.first), _share(found, lambda o: o.all_named), _more(found)))
        rows.append((name, len(found), *numbers, _heldout(found), _coverage(found)))
    heads = ("section", "cases", "hidden named first", "all hidden named", "else", "held out ≤ 1.15 floor", "intervals")
    return "## Shares\n\n" + _table(heads, rows)


def _more(found: Sequence[Outcome]) -> str:
    extra = _share(found, lambda o: len(o.causes) > len(o.case.hidden))
    return f"more causes than hidden {extra}, explained {_share(found, lambda o: o.verdict == 'explained')}"


def _singles(found: Sequence[Outcome]) -> str:
    rows = []
    for name in sorted({o.case.hidden[0] for o in found}):
        own = [o for o in found if o.case.hidden[0] == name]
        others = Counter("+".join(o.causes) or o.verdict for o in own if o.causes != (name,))
        named = ", ".join(f"{what} {count}" for what, count in others.most_common(4)) or "–"
        parameters = sorted({key for o in own for key in o.errors if key.startswith(f"{name}.")})
        errors = ", ".join(f"{key.partition('.')[2]} {_median_error(own, key)}" for key in parameters) or "–"
        alone = _share(own, lambda o: o.causes == (o.case.hidden[0],))
        rows.append(
            (name, len(own), _share(own, lambda o: o.first), alone, named, errors, _coverage(own), _heldout(own))
        )
    heads = ("hidden", "cases", "first", "alone", "named instead", "median errors", "intervals", "held out")
    return "## Single effects\n\n" + _table(heads, rows)


def _median_error(found: Iterable[Outcome], key: str) -> str:
    return f"{100 * float(np.median([o.errors[key] for o in found if key in o.errors])):.2g} %"


def _coverage(found: Iterable[Outcome]) -> str:
    """Return how many of the 95 % intervals of parameters of named effects hold the truth."""
    held = [value for o in found for value in o.held.values()]
    return f"{100 * sum(held) / len(held):.0f} % of {len(held)}" if held else "–"


def _heldout(found: Iterable[Outcome]) -> str:
    ratios = [o.heldout for o in found if math.isfinite(o.heldout)]
    return f"{100 * sum(r <= GOOD_PREDICTION for r in ratios) / len(ratios):.0f} %" if ratios else "–"


def _share(found: Sequence[Outcome], what: Callable[[Outcome], float]) -> str:
    return f"{100 * sum(float(what(o)) for o in found) / len(found):.0f} %"


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _line(outcome: Outcome) -> str:
    return f"{outcome.case} {_told(outcome)}, {outcome.seconds:.1f} s"


def _told(outcome: Outcome) -> str:
    pairs = zip(outcome.causes, outcome.rivals, strict=True)
    causes = ", ".join(cause + (f" (or {', '.join(rivals)})" if rivals else "") for cause, rivals in pairs)
    tail = f"held out {outcome.heldout:.2f}, visibility {outcome.visibility:.3g}"
    return f"{outcome.verdict}: {causes or outcome.said or 'no cause'}; {tail}"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", choices=BASES, default="development", help="which campaigns (default %(default)s)")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections; all by default")
    parser.add_argument("--effects", nargs="+", default=[], help="only cases that hide one of these")
    parser.add_argument("--repeats", type=int, help="of each case; by default as many as the section has")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="at a time (default %(default)s)")
    parser.add_argument("--out", type=Path, help="Markdown file to write as well")
    parser.add_argument(
        "--case", nargs="+", metavar="SECTION:NAME:SEED", help="run these alone, and show what was found"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
