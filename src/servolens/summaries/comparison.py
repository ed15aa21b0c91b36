"""What a comparison of designs says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.gains import asked_sentence, least_gain, sentence
from servolens.summaries.wording import inside, listed, number, number_up, percent
from servolens.summary import Summary, Table
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.comparison import Comparison
    from servolens.design.found import Design
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec

__all__ = ["comparison_summary", "side_by_side"]

COMPARED = ("linear", "nonlinear", "diagnosed")
WORDS = {
    "linear": "gain and constant damping",
    "nonlinear": "damping that depends on speed",
    "diagnosed": "the model of the diagnosis",
}
MORE_DIGITS = range(5, 7)
"""Of gains that look the same with four."""
CLIFF = 0.02
"""Share of the settling time from which on gains that look the same do not do the same."""


def comparison_summary(
    comparison: Comparison, *, with_best: bool = True, length_unit: str = "m", command_unit: str = "V"
) -> Summary:
    """Tell what each recommendation does on the plant that the data support best.

    Parameters
    ----------
    comparison : Comparison
        Two or three designs.
    with_best : bool
        Whether the design on that plant is told too.
    length_unit, command_unit : str
        Of the plants.
    """
    designs = comparison.designs
    best = COMPARED[len(designs) - 1]
    kd_unit = f"{command_unit} s/{length_unit}"
    told = [*zip(COMPARED, designs, _told_apart(designs), comparison.on_best, strict=False)]
    sentences = [_verdict(*one, best, kd_unit) for one in (told if with_best else told[:-1])]
    sentences += _cliff(designs, comparison.on_best)
    if comparison.linear.kd and designs[-1].kd:
        sentences.append(_saving(comparison.linear.kd, designs[-1].kd, best))
    sentences.append(asked_sentence(comparison.nonlinear.spec, length_unit, command_unit))
    is_told = any(design.kd is not None for design in designs)
    return Summary(
        title="Linear and nonlinear recommendation",
        sentences=tuple(sentences),
        tables=(side_by_side(comparison, kd_unit, command_unit),) if is_told else (),
    )


def side_by_side(comparison: Comparison, kd_unit: str, command_unit: str) -> Table:
    """Return the least gain of each model, and what it does on the plant that the data support best."""
    designs = comparison.designs
    best = COMPARED[len(designs) - 1]
    own = [next(iter(design.verified), None) for design in designs]
    on = comparison.on_best
    intervals = [", ".join("–".join(inside(*interval)) for interval in d.intervals) or "–" for d in designs]
    rows = (
        (f"Least {designs[0].spec.free} [{kd_unit}]", *_told_apart(designs)),
        ("All gains on its own model", *intervals),
        ("Settles on its own model [s]", *map(_settles, own)),
        (f"Settles on the {best} plant [s]", *map(_settles, on)),
        ("Overshoot there [%]", *("–" if r is None else number(100 * r.overshoot, 3) for r in on)),
        (f"Peak command there [{command_unit}]", *("–" if r is None else number(r.peak_voltage) for r in on)),
        ("Meets the spec there", *(_meets(r, design, designs[-1]) for r, design in zip(on, designs, strict=True))),
    )
    columns = ("", *(kind.capitalize() for kind in COMPARED[: len(designs)]))
    told = [f"{kind.capitalize()}: {WORDS[kind]}." for kind in COMPARED[: len(designs)]]
    low = [
        f"{percent(100 * _below(design, designs[-1]))} ({kind})"
        for kind, response, design in zip(COMPARED, on, designs, strict=False)
        if response is not None and not response.meets and _below(design, designs[-1]) > 0.0
    ]
    told += [f"Too low: below the least gain of the {best} model, by {listed(low)}."] if low else []
    return Table(title="Side by side", columns=columns, rows=rows, note=" ".join(told))


def _below(design: Design, best: Design) -> float:
    """Return by which share of it the least gain is below the best one; 0 if it is not, or there is none."""
    return 0.0 if design.kd is None or not best.kd else max(1.0 - design.kd / best.kd, 0.0)


def _settles(response: Response | None) -> str:
    if response is None:
        return "–"
    return "never" if response.settling_time is None else number(response.settling_time)


def _meets(response: Response | None, design: Design, best: Design) -> str:
    """Return yes or no, and why not: a gain below the least one there, or a time that looks as the one asked for."""
    if response is None:
        return "–"
    if response.meets:
        return "yes"
    if _below(design, best) > 0.0:
        return "no, too low"
    spec = design.spec
    took, asked = response.settling_time, spec.settling_time
    looks_alike = took is not None and took > asked and number(took) == number(asked)
    return f"no, {readable(took - asked, 's')} late" if took is not None and looks_alike else "no"


def _told_apart(designs: Sequence[Design]) -> list[str]:
    """Return the least gains with as many digits as tell different ones apart: at a cliff they matter."""
    texts = [least_gain(design) for design in designs]
    gains = [design.kd for design in designs]
    for digits in MORE_DIGITS:
        if len(set(texts)) == len(set(gains)):
            return texts
        texts = ["–" if kd is None else number_up(kd, digits) for kd in gains]
    return texts if len(set(texts)) == len(set(gains)) else [least_gain(design) for design in designs]


def _cliff(designs: Sequence[Design], on_best: Sequence[Response | None]) -> list[str]:
    """Say that gains which look the same do not settle alike, where that is so."""
    texts = _told_apart(designs)
    times: dict[str, list[float]] = {}
    for text, response in zip(texts, on_best, strict=False):
        if response is not None and response.settling_time is not None:
            times.setdefault(text, []).append(response.settling_time)
    if all(max(own) - min(own) <= CLIFF * max(own) for own in times.values()):
        return []
    return [
        "Gains that look the same here differ in a later digit and settle at different times: just below the least gain"
        " the spec is missed, so leave a margin."
    ]


def _verdict(kind: str, design: Design, gain: str, response: Response | None, best: str, kd_unit: str) -> str:
    if design.withheld:
        return f"{kind.capitalize()} model: its gain is withheld. {sentence(design.reason)}"
    if design.kd is None or response is None:
        return f"{kind.capitalize()} model: {sentence(design.reason)}"
    start = f"With the least {kind} gain, {design.spec.free} = {gain} {kd_unit},"
    asked = f"{number(design.spec.settling_time)} s"
    if not response.stable:
        return f"{start} the loop is unstable on the {best} plant."
    if response.settling_time is None:
        return f"{start} the {best} plant does not settle and misses the {asked} target."
    took = f"{start} the {best} plant settles in {number(response.settling_time)} s"
    if response.settling_time > design.spec.settling_time and not response.meets:
        return f"{took} and misses the {asked} target."
    return f"{took} and meets the spec there." if response.meets else f"{took}, but {_broken(design.spec, response)}."


def _broken(spec: PDSpec, response: Response) -> str:
    if spec.overshoot is not None and response.overshoot > spec.overshoot:
        return f"overshoots by {percent(100 * response.overshoot)} where {percent(100 * spec.overshoot)} is allowed"
    if spec.voltage_limit is not None and response.peak_voltage > spec.voltage_limit:
        return f"asks for {number(response.peak_voltage)} where {number(spec.voltage_limit)} is allowed"
    return "does not meet the spec"


def _saving(linear: float, richer: float, best: str) -> str:
    change = 100 * (richer - linear) / linear
    if abs(change) < 0.5:
        return f"The linear and the {best} model ask for the same gain within half a percent."
    how = f"{percent(abs(change))} {'less' if change < 0 else 'more'}"
    return f"The {best} model asks for {how} derivative gain than the linear one."
