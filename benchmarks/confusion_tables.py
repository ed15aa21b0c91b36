"""The tables of the study of diagnoses, from its outcomes, as Markdown."""

from __future__ import annotations

import math
from statistics import median
from typing import TYPE_CHECKING

from hidden_cases import MAIN, SECTIONS, Outcome

from servolens.lab import WORLDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from hidden_cases import Found

__all__ = ["line", "report"]

BINS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.0))
"""Of confidence."""
MOST_WRONG = 200
"""Cases that went wrong that are listed."""


def report(outcomes: Sequence[Outcome]) -> str:
    """Return all tables."""
    worlds = [world for world in WORLDS if any(o.case.world == world for o in outcomes)]
    parts = ["### Shares\n\n" + _shares(outcomes, worlds)]
    causes = [(o, cause) for o in outcomes for cause in o.causes]
    if causes:
        parts.append("### Confidence\n\nCauses that are right, of all that were named with such a confidence.\n\n"
                     + _reliability(causes, worlds))  # fmt: skip
    parts.append("### Time\n\nOf a diagnosis, in seconds of the process on all cores.\n\n" + _times(outcomes, worlds))
    for section, title in (("singles", "Single effects"), ("foreign", "Foreign laws")):
        own = [o for o in outcomes if o.case.section == section]
        if own:
            parts.append(f"### {title}\n\n" + (_effects if section == "singles" else _laws)(own, worlds))
    wrong = [o for o in outcomes if not o.right]
    listed = "\n".join(f"* `{o.case}` {_told(o)}" for o in wrong[:MOST_WRONG])
    more = f"\n* and {len(wrong) - MOST_WRONG} more" if len(wrong) > MOST_WRONG else ""
    parts.append(f"### {len(wrong)} cases that went wrong\n\n{listed or 'None.'}{more}")
    return "\n\n".join(parts)


def line(outcome: Outcome) -> str:
    """Return what came of a case, in one line."""
    return f"{outcome.case} {_told(outcome)}, {outcome.cpu:.1f} s"


def _shares(outcomes: Sequence[Outcome], worlds: Sequence[str]) -> str:
    rows = []
    for world in worlds:
        for section in SECTIONS:
            own = [o for o in outcomes if (o.case.world, o.case.section) == (world, section)]
            if own:
                rows.append((world, section, len(own), *_numbers(section, own), _intervals(own), _unfinished(own)))
    heads = ("world", "section", "campaigns", "named first", "of these explained", "all named", "else",
             "95 % intervals that hold the truth", "no answer")  # fmt: skip
    return _table(heads, rows)


def _numbers(section: str, own: Sequence[Outcome]) -> tuple[str, str, str, str]:
    """Return named first, of these explained, all named, and what else matters."""
    if section == "healthy":
        alarms = f"false alarms {_share(own, lambda o: bool(o.causes))}"
        return "", "", "", f"{alarms}; healthy {_share(own, lambda o: o.verdict == 'healthy')}"
    if section == "foreign":
        strange = [o for o in own if not o.kin]
        explained = f"explained {_share(strange, lambda o: o.verdict == 'explained')}"
        healthy = f"healthy {_share(strange, lambda o: o.verdict == 'healthy')}"
        alike = [o for o in own if o.kin]
        named = f"; same structure, named {_share(alike, lambda o: any(map(o.is_right, o.causes)))}" if alike else ""
        return "", "", "", f"{explained}; {healthy}{named}"
    first = [o for o in own if o.first == 1.0]
    explained = _share(first, lambda o: o.verdict == "explained")
    more = f"more causes than hidden {_share(own, lambda o: len(o.causes) > len(o.case.hidden))}"
    healthy = f"; healthy {_share(own, lambda o: o.verdict == 'healthy')}"
    return _share(own, lambda o: o.first), explained, _share(own, lambda o: o.all_named), more + healthy


def _unfinished(own: Sequence[Outcome]) -> str:
    late, failed = (sum(o.verdict == verdict for o in own) for verdict in ("out of time", "failed"))
    said = [f"{late} out of time"] * bool(late) + [f"{failed} failed"] * bool(failed)
    return ", ".join(said) or "–"


def _intervals(own: Iterable[Outcome]) -> str:
    """Return how many of the 95 % intervals of parameters of hidden effects that were named hold the truth."""
    held = [value for o in own for cause in o.causes for value in cause.held.values()]
    known = [value for value in held if value is not None]
    if not held:
        return "–"
    bare = f", {len(held) - len(known)} without" if len(known) < len(held) else ""
    return (f"{100 * sum(known) / len(known):.0f} % of {len(known)}" if known else "none") + bare


def _reliability(causes: Sequence[tuple[Outcome, Found]], worlds: Sequence[str]) -> str:
    rows = []
    for low, high in BINS:
        inside = [x for x in causes if low <= x[1].confidence < high or x[1].confidence == high == 1.0]
        rows.append((f"{low:g} … {high:g}", *_by_world(inside, worlds)))
    rows.append(("above 0.9", *_by_world([x for x in causes if x[1].confidence > 0.9], worlds)))
    return _table(("confidence", *worlds, "all"), rows)


def _by_world(causes: Sequence[tuple[Outcome, Found]], worlds: Sequence[str]) -> list[str]:
    return [*(_right([x for x in causes if x[0].case.world == world]) for world in worlds), _right(causes)]


def _right(causes: Sequence[tuple[Outcome, Found]]) -> str:
    if not causes:
        return "–"
    right = sum(o.is_right(cause) for o, cause in causes)
    return f"{right} of {len(causes)} ({100 * right / len(causes):.0f} %)"


def _times(outcomes: Sequence[Outcome], worlds: Sequence[str]) -> str:
    rows = []
    for world in worlds:
        for section in MAIN:
            own = [o for o in outcomes if (o.case.world, o.case.section) == (world, section)]
            if own:
                worst = max(own, key=lambda o: o.cpu)
                clock = f"{median(o.seconds for o in own):.1f}"
                rows.append((world, section, f"{median(o.cpu for o in own):.1f}", f"{worst.cpu:.1f}",
                             f"`{worst.case}`", clock))  # fmt: skip
    return _table(("world", "section", "median", "worst", "which", "median on the clock"), rows)


def _effects(own: Sequence[Outcome], worlds: Sequence[str]) -> str:
    rows = []
    for name in sorted({o.case.hidden[0] for o in own}):
        mine = [o for o in own if o.case.hidden[0] == name]
        cells = [[o for o in mine if o.case.world == world] for world in worlds]
        named = [f"{sum(o.first for o in cell):g} of {len(cell)}" if cell else "–" for cell in cells]
        rows.append((f"`{name}`", *named, _intervals(mine)))
    return "Named first.\n\n" + _table(("effect", *worlds, "intervals, all worlds"), rows)


def _laws(own: Sequence[Outcome], worlds: Sequence[str]) -> str:
    rows = []
    for name in sorted({o.case.hidden[0] for o in own}):
        cells = []
        for world in worlds:
            verdicts = [_briefly(o) for o in own if (o.case.hidden[0], o.case.world) == (name, world)]
            cells.append("; ".join(verdicts) or "–")
        rows.append((f"`{name}`", *cells))
    return "Verdicts, with what was named.\n\n" + _table(("law", *worlds), rows)


def _briefly(outcome: Outcome) -> str:
    return outcome.verdict + (f": {' + '.join(outcome.names)}" if outcome.causes else "")


def _share(own: Sequence[Outcome], what: Callable[[Outcome], float]) -> str:
    if not own:
        return "–"
    percent = 100 * sum(float(what(o)) for o in own) / len(own)
    return f"{percent:.1f} %" if len(own) >= 100 and percent % 1 else f"{percent:.0f} %"


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in cells) + " |" for cells in lines)


def _told(outcome: Outcome) -> str:
    causes = ", ".join(
        f"{cause.effect} {cause.confidence:.2f}" + (f" (or {', '.join(cause.rivals)})" if cause.rivals else "")
        for cause in outcome.causes
    )
    seen = "" if math.isnan(outcome.visibility) else f"; visibility {outcome.visibility:.3g}"
    return f"{outcome.verdict}: {causes or outcome.said or 'no cause'}{seen}"
