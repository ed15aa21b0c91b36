"""How the recommended gain does on axes whose truth the virtual laboratory has hidden (``make tried-gains``).

``tried_gains.py`` measures axes, goes the whole chain from their records, runs the gains on the true axis, and appends
what came of each to a file, one JSON line an axis; an axis that stands there already is not done again, so that a long
run can be stopped and resumed. ``tried_gains.py render`` makes the tables of that file and writes them into
docs/tried-gains.md. ``--minutes 15`` stops after so long, with the axis that is being done then.

Without ``--final`` the seeds are those for development; no threshold may be chosen on the final ones.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gain_axes import SECTIONS, Axis, Outcome, run
from scipy.stats import binomtest

from servolens.lab import WORLDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

RESULTS = Path(__file__).with_name("tried_gains.jsonl")
PAGE = Path(__file__).parent.parent / "docs" / "tried-gains.md"
BEGIN, END = "<!-- tables begin -->", "<!-- tables end -->"
"""What stands between these on the page is written by ``render``."""
AXES = {"catalogue": 200, "foreign": 100}
HEADS = ("world", "axes", "gain given", "recommended meets the spec", "least gain", "linear model's least gain")


def main(arguments: Sequence[str]) -> None:
    """Do what is asked; without a command, try gains."""
    command, *rest = arguments if arguments[:1] in (["render"], ["run"]) else ["run", *arguments]
    (render if command == "render" else study)(rest)


def study(arguments: Sequence[str]) -> None:
    """Try gains, and add what came of each axis to the file at once."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for section, count in AXES.items():
        parser.add_argument(f"--{section}", type=int, default=count, metavar="N", help="axes (default %(default)s)")
    parser.add_argument("--final", action="store_true", help="the seeds for judging, not those for development")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no further axis is begun")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON lines (default %(default)s)")
    asked = parser.parse_args(arguments)
    kind = "final" if asked.final else "development"
    done = read(asked.results)
    todo = [axis for axis in _in_turn(kind, asked.catalogue, asked.foreign) if axis not in done]
    begun = time.perf_counter()
    with asked.results.open("a", encoding="utf-8") as file:
        for axis in todo:
            if time.perf_counter() - begun > 60.0 * asked.minutes:
                break
            outcome = run(axis)
            file.write(json.dumps(outcome.to_json(), ensure_ascii=False) + "\n")
            file.flush()
            print(told(outcome), flush=True)


def render(arguments: Sequence[str]) -> None:
    """Write the tables of the file into the page."""
    parser = argparse.ArgumentParser(prog="tried_gains.py render", description="Make the tables of a file of results.")
    parser.add_argument("--results", type=Path, default=RESULTS, help="JSON lines (default %(default)s)")
    parser.add_argument("--out", type=Path, default=PAGE, help="page to write into (default %(default)s)")
    asked = parser.parse_args(arguments)
    before, _, after = asked.out.read_text(encoding="utf-8").partition(BEGIN)
    text = report([outcome for outcome in read(asked.results).values() if outcome.axis.kind == "final"])
    asked.out.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after.partition(END)[2]}", encoding="utf-8")
    print(f"Wrote {asked.out}")


def read(path: Path) -> dict[Axis, Outcome]:
    """Return the outcomes of a file; a line cut short by an interruption does not count."""
    found: dict[Axis, Outcome] = {}
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            outcome = Outcome.from_json(json.loads(text))
        except json.JSONDecodeError:
            continue
        found[outcome.axis] = outcome
    return found


def report(outcomes: Sequence[Outcome]) -> str:
    """Return all tables."""
    own, foreign = ([o for o in outcomes if o.axis.section == section] for section in SECTIONS)
    parts = []
    if own:
        parts.append(f"### One or two effects of the catalogue\n\n{_shares(own)}\n\n{_withheld(own)}")
    if foreign:
        parts.append(f"### Laws that are not in the catalogue\n\n{_shares(foreign)}\n\n{_withheld(foreign)}")
    wrong = [o for o in outcomes if o.given and not o.meets("recommended")]
    listed = "\n".join(f"* {told(o)}" for o in wrong) or "None."
    return "\n\n".join([*parts, f"### Gains that were given and miss the spec\n\n{listed}"])


def told(outcome: Outcome) -> str:
    """Return what came of an axis, in one line."""
    axis = outcome.axis
    runs = ", ".join(f"{name} {one.kd:.4g} {_steps(one.settles)}" for name, one in outcome.runs.items())
    asked = "no spec" if outcome.settling_time is None else f"asked {outcome.settling_time:g} s"
    return (
        f"{axis.section} {axis.number} ({axis.world}, {' + '.join(outcome.hidden)}):"
        f" {outcome.verdict or 'no diagnosis'}, gain {outcome.lights['gain']}; {asked}; {runs or outcome.said}"
    )


def _steps(settles: Iterable[float | None]) -> str:
    return "/".join("never" if one is None else f"{one:.3g} s" for one in settles)


def _in_turn(kind: str, catalogue: int, foreign: int) -> list[Axis]:
    """Return the axes so that a run that is cut short has seen both sections."""
    both = [[Axis(name, kind, i) for i in range(n)] for name, n in zip(SECTIONS, (catalogue, foreign), strict=True)]
    return sorted(
        (axis for part in both for axis in part), key=lambda a: (a.number + 1) * (2 if a.section == "foreign" else 1)
    )


def _shares(own: Sequence[Outcome]) -> str:
    worlds = [world for world in WORLDS if any(o.axis.world == world for o in own)]
    rows = [_row(f"`{world}`", [o for o in own if o.axis.world == world]) for world in worlds]
    last = [f"**{cell}**" for cell in _row("all", own, bounds=True)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (HEADS, ["---"] * len(HEADS), *rows, last))


def _row(name: str, own: Sequence[Outcome], *, bounds: bool = False) -> list[str]:
    given = [o for o in own if o.given]
    counts = [_share(given, lambda o, g=gain: o.meets(g), bounds=bounds) for gain in ("recommended", "least", "linear")]
    return [name, str(len(own)), str(len(given)), *counts]


def _share(own: Sequence[Outcome], holds: Callable[[Outcome], bool], *, bounds: bool) -> str:
    if not own:
        return "–"
    count = sum(map(holds, own))
    if not bounds:
        return f"{count} of {len(own)}"
    low, high = (100.0 * end for end in binomtest(count, len(own)).proportion_ci(0.95, method="exact"))
    return f"{100.0 * count / len(own):.1f} % ({low:.1f} to {high:.1f} %)"


def _withheld(own: Sequence[Outcome]) -> str:
    """Return what was not given, and how often that was right."""
    withheld, none = [o for o in own if o.withheld], sum("recommended" not in o.runs for o in own)
    failing = [o for o in own if "recommended" in o.runs and not o.meets("recommended")]
    kept = f"withheld on {len(withheld)}, where it would have met the spec on {sum(map(_would, withheld))}"
    text = (
        f"Of {len(own)} axes a gain was found on {len(own) - none}, and {kept if withheld else 'withheld on none'}. Of"
        f" all gains that were found, {len(failing) or 'none'} would have failed"
    )
    if not failing:
        return f"{text}."
    caught = sum(o.withheld for o in failing)
    low, high = (100.0 * end for end in binomtest(caught, len(failing)).proportion_ci(0.95, method="exact"))
    share = 100.0 * caught / len(failing)
    return f"{text}; {caught} of these were withheld ({share:.0f} %, {low:.0f} to {high:.0f} %)."


def _would(outcome: Outcome) -> bool:
    return outcome.meets("recommended")


if __name__ == "__main__":
    main(sys.argv[1:])
