"""What a comparison of designs says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.gains import asked_sentence, least_gain, sentence
from servolens.summaries.wording import inside, number, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from servolens.design.comparison import Comparison
    from servolens.design.found import Design
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec

__all__ = ["comparison_summary", "side_by_side"]

KINDS = ("linear", "nonlinear", "diagnosed")


def comparison_summary(comparison: Comparison, *, length_unit: str = "m", command_unit: str = "V") -> Summary:
    """Tell what each recommendation does on the plant that the data support best.

    Parameters
    ----------
    comparison : Comparison
        Two or three designs.
    length_unit, command_unit : str
        Of the plants.
    """
    designs = comparison.designs
    best = KINDS[len(designs) - 1]
    kd_unit = f"{command_unit} s/{length_unit}"
    sentences = [
        _verdict(kind, design, response, best, kd_unit)
        for kind, design, response in zip(KINDS, designs, comparison.on_best, strict=False)
    ]
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
    best = KINDS[len(designs) - 1]
    own = [next(iter(design.verified), None) for design in designs]
    on = comparison.on_best
    intervals = [", ".join("–".join(inside(*interval)) for interval in d.intervals) or "–" for d in designs]
    rows = (
        (f"Least {designs[0].spec.free} [{kd_unit}]", *(least_gain(d) for d in designs)),
        ("All gains on its own model", *intervals),
        ("Settles on its own model [s]", *("–" if r is None else number(r.settling_time) for r in own)),
        (f"Settles on the {best} plant [s]", *("–" if r is None else number(r.settling_time) for r in on)),
        ("Overshoot there [%]", *("–" if r is None else number(100 * r.overshoot, 3) for r in on)),
        (f"Peak there [{command_unit}]", *("–" if r is None else number(r.peak_voltage) for r in on)),
        ("Meets the spec there", *("–" if r is None else "yes" if r.meets else "no" for r in on)),
    )
    columns = ("", *(kind.capitalize() for kind in KINDS[: len(designs)]))
    return Table(title="Side by side", columns=columns, rows=rows)


def _verdict(kind: str, design: Design, response: Response | None, best: str, kd_unit: str) -> str:
    if design.withheld:
        return f"{kind.capitalize()} model: its gain is withheld. {sentence(design.reason)}"
    if design.kd is None or response is None:
        return f"{kind.capitalize()} model: {sentence(design.reason)}"
    start = f"With the least {kind} gain, {design.spec.free} = {least_gain(design)} {kd_unit},"
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
    return f"The {best} model asks for {percent(abs(change))} {'less' if change < 0 else 'more'} derivative gain."
