"""What a design and a comparison say."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.wording import inside, number, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design.found import Comparison, Design, Light, Response
    from servolens.design.spec import PDSpec

__all__ = ["comparison_summary", "design_summary"]

FRAGILE = 0.05
"""A margin below this share of the gain is worth a sentence."""


def design_summary(
    design: Design,
    *,
    lights: Mapping[str, Light] | None = None,
    forced: bool = False,
    length_unit: str = "m",
    command_unit: str = "V",
) -> Summary:
    """Tell the gain to use, the least gain, where else the spec holds, and what the simulated step does there.

    Parameters
    ----------
    design : Design
        What was found.
    lights : mapping of str to Light, optional
        How far what it names can be trusted.
    forced : bool
        Whether the gain is given although it should be withheld.
    length_unit, command_unit : str
        Of the plant.
    """
    spec = design.spec
    kd_unit = f"{command_unit} s/{length_unit}"
    trusted = [f"{name}: {light.light}. {light.sentence}" for name, light in (lights or {}).items()]
    if design.kd is None:
        verdict = "The gain is withheld; --force gives it all the same." if design.withheld else _stop(design.reason)
        sentences = [verdict, *trusted, _asked(spec, length_unit, command_unit)]
        tables = (_intervals(design, kd_unit),) if design.withheld else ()
        return Summary(title="Design", sentences=tuple(sentences), tables=tables)
    sentences = [
        *(["Forced: this gain would be withheld."] if forced else []),
        *_recommended(design, kd_unit),
        f"kd = {_gain(design)} {kd_unit} is the least gain that {_aim(spec)}{_elsewhere(design)}.",
        *_margin(design, kd_unit),
        *_simulated(design, command_unit),
        *trusted,
        _asked(spec, length_unit, command_unit),
        *_program(design),
    ]
    return Summary(
        title="Design",
        sentences=tuple(sentences),
        tables=(_intervals(design, kd_unit), _responses(design, command_unit)),
    )


def comparison_summary(comparison: Comparison, *, length_unit: str = "m", command_unit: str = "V") -> Summary:
    """Tell what each recommendation does on the nonlinear plant; parameters as in :func:`design_summary`."""
    linear, nonlinear = comparison.linear, comparison.nonlinear
    kd_unit = f"{command_unit} s/{length_unit}"
    sentences = [
        _verdict("linear", linear, comparison.linear_on_nonlinear, kd_unit),
        _verdict("nonlinear", nonlinear, next(iter(nonlinear.verified), None), kd_unit),
    ]
    if linear.kd and nonlinear.kd:
        sentences.append(_saving(linear.kd, nonlinear.kd))
    sentences.append(_asked(nonlinear.spec, length_unit, command_unit))
    return Summary(
        title="Linear and nonlinear recommendation",
        sentences=tuple(sentences),
        tables=(_side_by_side(comparison, kd_unit, command_unit),) if linear.feasible or nonlinear.feasible else (),
    )


def _recommended(design: Design, kd_unit: str) -> list[str]:
    chosen = design.recommended
    if chosen is None:
        return []
    return [
        f"kd = {number(chosen.kd)} {kd_unit} is recommended: it {_stop(chosen.why, capital=False)}",
        _stop(chosen.risk),
    ]


def _gain(design: Design) -> str:
    """Return the least gain rounded up, so that it meets the spec as it is written."""
    return "–" if design.kd is None else inside(design.kd, design.intervals[0][1])[0]


def _aim(spec: PDSpec) -> str:
    return f"settles within {number(spec.settling_time)} s"


def _asked(spec: PDSpec, length_unit: str, command_unit: str) -> str:
    parts = [
        f"a step of {number(spec.reference)} {length_unit} with kp = {number(spec.kp)} {command_unit}/{length_unit}"
        f" stays within ±{percent(100 * spec.band)} from {number(spec.settling_time)} s on"
    ]
    if spec.overshoot is not None:
        parts.append(f"overshoots by at most {percent(100 * spec.overshoot)}")
    if spec.voltage_limit is not None:
        parts.append(f"asks for at most {number(spec.voltage_limit)} {command_unit}")
    loop = (
        "an ideal continuous PD"
        if spec.control == "continuous"
        else f"a digital PD sampled every {number(1e3 * spec.sample_time)} ms"
    )
    if spec.control == "sampled" and spec.derivative_filter < 1:
        loop += f" with a derivative filter of {number(spec.derivative_filter)}"
    return f"Asked: {', '.join(parts)}; {loop}."


def _elsewhere(design: Design) -> str:
    if len(design.intervals) < 2:
        return ""
    rest = [" to ".join(inside(*interval)) for interval in design.intervals[1:]]
    return f"; the spec also holds for {' and for '.join(rest)}"


def _margin(design: Design, kd_unit: str) -> list[str]:
    kd, high = design.kd or 0.0, design.intervals[0][1]
    if high >= design.certificate.searched[1]:
        return [f"Every larger gain up to the end of the search, {number(high)} {kd_unit}, meets it too."]
    fragile = high - kd < FRAGILE * kd
    tail = ": a narrow interval, so this gain is fragile" if fragile else ""
    return [f"It may rise to {inside(kd, high)[1]} {kd_unit} before the spec breaks{tail}."]


def _simulated(design: Design, command_unit: str) -> list[str]:
    if not design.verified:
        return []
    worst = max(design.verified, key=lambda r: r.settling_time if r.settling_time is not None else float("inf"))
    models = "" if len(design.verified) == 1 else f" (the slowest of {len(design.verified)} models)"
    if worst.settling_time is None:
        return [f"Simulated with it, the step does not settle before the simulation ends{models}."]
    return [
        f"Simulated with it{models}, the step settles in {number(worst.settling_time)} s, overshoots by"
        f" {percent(100 * worst.overshoot)} and asks for {number(worst.peak_voltage)} {command_unit} at most."
    ]


def _program(design: Design) -> list[str]:
    if design.disagreement is not None:
        return [_stop(design.disagreement)]
    if not design.candidates:
        return []
    return ["CasADi's nonlinear program finds the same least gains within the search's gap."]


def _intervals(design: Design, kd_unit: str) -> Table:
    rows = [(str(i), *inside(*interval)) for i, interval in enumerate(design.intervals, start=1)]
    return Table(
        title="Gains that meet the spec",
        columns=("Interval", f"kd from [{kd_unit}]", f"kd to [{kd_unit}]"),
        rows=tuple(rows),
        note=_searched(design),
    )


def _searched(design: Design) -> str:
    certificate = design.certificate
    end = " (beyond, this plant would be too slow)" if certificate.end_from_plant else ""
    trusted = {
        "enclosure": "proven by enclosures",
        "sensitivity": "by the measured sensitivity to the gain",
    }[certificate.kind]
    return (
        f"Searched from 0 to {number(certificate.searched[1])}{end}, "
        f"each step watched for {number(certificate.horizon)} s; "
        f"what is overlooked is narrower than {number(certificate.gap, 2)} ({trusted})."
    )


def _responses(design: Design, command_unit: str) -> Table:
    rows = [
        (
            f"model {i}",
            number(r.settling_time),
            number(100 * r.overshoot, 3),
            number(r.peak_voltage),
            "yes" if r.meets else "no",
        )
        for i, r in enumerate(design.verified, start=1)
    ]
    return Table(
        title=f"Simulated with kd = {_gain(design)}",
        columns=("Model", "Settles [s]", "Overshoot [%]", f"Peak [{command_unit}]", "Meets"),
        rows=tuple(rows),
    )


def _verdict(kind: str, design: Design, response: Response | None, kd_unit: str) -> str:
    if design.kd is None or response is None:
        return f"{kind.capitalize()} model: {_stop(design.reason)}"
    start = f"With the {kind} recommendation kd = {_gain(design)} {kd_unit}"
    asked = f"{number(design.spec.settling_time)} s"
    if not response.stable:
        return f"{start} the loop is unstable on the nonlinear plant."
    if response.settling_time is None:
        return f"{start} the nonlinear plant does not settle and misses the {asked} target."
    took = f"{start} the nonlinear plant settles in {number(response.settling_time)} s"
    if response.settling_time > design.spec.settling_time and not response.meets:
        return f"{took} and misses the {asked} target."
    return f"{took} and meets the spec there." if response.meets else f"{took}, but {_broken(design.spec, response)}."


def _broken(spec: PDSpec, response: Response) -> str:
    if spec.overshoot is not None and response.overshoot > spec.overshoot:
        return f"overshoots by {percent(100 * response.overshoot)} where {percent(100 * spec.overshoot)} is allowed"
    if spec.voltage_limit is not None and response.peak_voltage > spec.voltage_limit:
        return f"asks for {number(response.peak_voltage)} where {number(spec.voltage_limit)} is allowed"
    return "does not meet the spec"


def _saving(linear: float, nonlinear: float) -> str:
    change = 100 * (nonlinear - linear) / linear
    if abs(change) < 0.5:
        return "Both recommendations are the same within half a percent."
    return f"The nonlinear model asks for {percent(abs(change))} {'less' if change < 0 else 'more'} derivative gain."


def _side_by_side(comparison: Comparison, kd_unit: str, command_unit: str) -> Table:
    designs = (comparison.linear, comparison.nonlinear)
    own = [next(iter(d.verified), None) for d in designs]
    on = [comparison.linear_on_nonlinear, own[1]]
    intervals = [", ".join("–".join(inside(*interval)) for interval in d.intervals) or "–" for d in designs]
    rows = (
        (f"kd [{kd_unit}]", *(_gain(d) for d in designs)),
        ("All gains on its own model", *intervals),
        ("Settles on its own model [s]", *("–" if r is None else number(r.settling_time) for r in own)),
        ("Settles on the nonlinear plant [s]", *("–" if r is None else number(r.settling_time) for r in on)),
        ("Overshoot there [%]", *("–" if r is None else number(100 * r.overshoot, 3) for r in on)),
        (f"Peak there [{command_unit}]", *("–" if r is None else number(r.peak_voltage) for r in on)),
        ("Meets the spec there", *("–" if r is None else "yes" if r.meets else "no" for r in on)),
    )
    return Table(title="Side by side", columns=("", "Linear", "Nonlinear"), rows=rows)


def _stop(reason: str | None, *, capital: bool = True) -> str:
    text = (reason or "no gain meets the spec").rstrip(".")
    return f"{text[0].upper() if capital else text[0]}{text[1:]}."
