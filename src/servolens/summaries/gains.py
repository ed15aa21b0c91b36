"""What a design says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.wording import inside, length, number, percent
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design.found import Design, Light
    from servolens.design.gain_plane import GainMap
    from servolens.design.gains_found import GainsFound
    from servolens.design.limit_cycle import Hunting
    from servolens.design.spec import PDSpec

__all__ = [
    "asked_sentence",
    "design_summary",
    "least_gain",
    "light_sentences",
    "map_summary",
    "sentence",
]

AIMS = {
    "noise": "the least noise of the command",
    "settling_time": "the least settling time",
    "margin": "the largest margin",
}
FRAGILE = 0.05
"""A margin below this share of the gain is worth a sentence."""


def design_summary(
    design: Design,
    *,
    lights: Mapping[str, Light] | None = None,
    forced: bool = False,
    in_python: bool = False,
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
    in_python : bool
        Whether the reader calls functions; otherwise what may be asked for next is told as options of commands.
    length_unit, command_unit : str
        Of the plant.
    """
    spec = design.spec
    kd_unit = f"{command_unit} s/{length_unit}"
    why = "" if design.recommended is None else sentence(design.recommended.why)
    trusted = light_sentences(lights or {}, told=why)
    if design.kd is None:
        how = "tune(…, force=True)" if in_python else "--force"
        why = f"The gain is withheld; {how} gives it all the same." if design.withheld else sentence(design.reason)
        sentences = [
            *([] if any(why in said for said in trusted) else [why]),
            *trusted,
            asked_sentence(spec, length_unit, command_unit),
        ]
        tables = (_intervals(design, kd_unit),) if design.withheld else ()
        return Summary(title="Design", sentences=tuple(sentences), tables=tables)
    sentences = [
        *(["Forced: this gain would be withheld."] if forced else []),
        *_recommended(design, kd_unit),
        f"{spec.free} = {least_gain(design)} {kd_unit} is the least gain that {_aim(spec)}{_elsewhere(design)}.",
        *_margin(design, kd_unit),
        *_simulated(design, command_unit),
        *([] if design.recommended is None else [sentence(design.recommended.risk)]),
        *_hunting(design, length_unit, in_python=in_python),
        *_tracking(design, length_unit),
        *trusted,
        asked_sentence(spec, length_unit, command_unit),
        *_program(design),
    ]
    return Summary(
        title="Design",
        sentences=tuple(sentences),
        tables=(_intervals(design, kd_unit), *_responses(design, command_unit)),
    )


def gains_summary(found: GainsFound, *, length_unit: str = "m", command_unit: str = "V") -> Summary:
    """Tell the best of several gains, and what the loop does with them.

    Parameters
    ----------
    found : GainsFound
        What was found.
    length_unit, command_unit : str
        Of the plant.
    """
    if found.kd is None or found.margins is None:
        return Summary(title="Several gains", sentences=(sentence(found.reason),))
    spec, margins, unit = found.spec, found.margins, f"{command_unit}/{length_unit}"
    aim = f"the least {spec.free}" if found.wishes.objective == "kd" else AIMS[found.wishes.objective]
    kp_unit = "1/s" if spec.controller == "cascade" else unit
    time = max(response.settling_time or 0.0 for response in found.verified)
    delay = "no delay" if margins.delay_margin == float("inf") else f"{number(1e3 * margins.delay_margin, 3)} ms"
    integral = f", ki = {number(spec.ki)} {command_unit}/({length_unit} s)" if spec.ki else ""
    integral = f", kiv = {number(spec.kiv)} {unit}" if spec.kiv else integral
    told = [
        f"kp = {number(spec.kp)} {kp_unit}, {spec.free} = {number(found.kd)} {command_unit} s/{length_unit},"
        f" {spec.derivative_words}{integral}: {aim} of all gains that meet what was"
        " asked.",
        f"Simulated with them, the step settles in {number(time)} s; Ms = {number(margins.peak_sensitivity, 3)},"
        f" Mt = {number(margins.peak_complementary, 3)}, delay margin {delay} (of the linearised loop).",
    ]
    if found.voltage_noise is not None:
        told.append(f"Measurement noise moves the command by {number(found.voltage_noise, 3)} {command_unit} r.m.s.")
        told += [spec.noise_remark] if spec.noise_remark else []
    if found.probability is not None and found.interval is not None:
        low, high = (number(100 * end, 3) for end in found.interval)
        told.append(
            f"All of it also holds in {found.wishes.scenarios} scenarios; of others, {percent(100 * found.probability)}"
            f" meet the specification ({low} to {high} %)."
        )
    told.append("They stand at the edge of what is feasible; the gain recommended below keeps away from it.")
    return Summary(title="Several gains", sentences=tuple(told))


def map_summary(
    found: GainMap,
    *,
    recommended: tuple[float, float] | None,
    light: Light,
    length_unit: str = "m",
    command_unit: str = "V",
) -> Summary:
    """Tell what a map over both gains shows.

    Parameters
    ----------
    found : GainMap
        The map.
    recommended : (float, float) or None
        The pair (kp, kd) to use for the kp of the spec.
    light : Light
        How far that can be trusted.
    length_unit, command_unit : str
        Of the plant.
    """
    pair, share = found.least_noise, float(found.feasible.mean())
    size = f"{found.kp.size} × {found.kd.size} pairs, kp {number(found.kp[0])} to {number(found.kp[-1])}"
    sentences = [
        f"Simulated {size} {command_unit}/{length_unit} and kd {number(found.kd[0])} to {number(found.kd[-1])}"
        f" {command_unit} s/{length_unit}; {percent(100 * share)} of them meet the spec."
    ]
    if pair is not None:
        least = float(found.noise[found.feasible].min())
        sentences.append(
            f"Of these, kp = {number(pair[0])} and kd = {number(pair[1])} make the least noise, {number(least, 3)}"
            f" {command_unit}/{length_unit}: a pair at the edge, with no margin."
        )
        sentences += [found.spec.noise_remark] if found.spec.noise_remark else []
    if recommended is not None:
        sentences.append(f"For kp = {number(recommended[0])}, the recommended kd is {number(recommended[1])}.")
    sentences += light_sentences({"Gain": light})
    sentences.append(asked_sentence(found.spec, length_unit, command_unit))
    return Summary(title="Map", sentences=tuple(sentences))


def light_sentences(lights: Mapping[str, Light], *, told: str = "") -> list[str]:
    """Return for each light its colour and, but for what is `told` beside it, why."""
    return [
        f"{name.capitalize()}: {light.light}. {light.sentence.removeprefix(told).strip()}".rstrip()
        for name, light in lights.items()
    ]


def _recommended(design: Design, kd_unit: str) -> list[str]:
    """Tell the gain to use; nothing where none was looked for."""
    chosen = design.recommended
    if chosen is None:
        return []
    why = sentence(chosen.why, capital=False)
    return [f"{design.spec.free} = {number(chosen.kd)} {kd_unit} is recommended: it {why}"]


def least_gain(design: Design) -> str:
    """Return the least gain rounded up, so that it meets the spec as it is written."""
    return "–" if design.kd is None else inside(design.kd, design.intervals[0][1])[0]


def _aim(spec: PDSpec) -> str:
    return f"settles within {number(spec.settling_time)} s"


def asked_sentence(spec: PDSpec, length_unit: str, command_unit: str) -> str:
    """Return what was asked for."""
    kp_unit = "1/s" if spec.controller == "cascade" else f"{command_unit}/{length_unit}"
    parts = [
        f"a step of {number(spec.reference)} {length_unit} with kp = {number(spec.kp)} {kp_unit}"
        f" stays within ±{percent(100 * spec.band)} from {number(spec.settling_time)} s on"
    ]
    if spec.overshoot is not None:
        parts.append(f"overshoots by at most {percent(100 * spec.overshoot)}")
    if spec.voltage_limit is not None:
        parts.append(f"asks for at most {number(spec.voltage_limit)} {command_unit}")
    parts += _limits(spec, length_unit, command_unit)
    if not spec.hunting:
        parts.append("comes to rest from all starts that are tried")
    remark = f" {spec.noise_remark}" if "noise_gain" in spec.limits and spec.noise_remark else ""
    return f"Asked: {', '.join(parts)}; {_loop(spec, length_unit, command_unit)}.{remark}"


def _limits(spec: PDSpec, length_unit: str, command_unit: str) -> list[str]:
    """Return what is asked of the linearised loop."""
    unit = f"{command_unit}/{length_unit}"
    words = {
        "peak_sensitivity": ("keeps Ms to at most", 1.0, ""),
        "peak_complementary": ("keeps Mt to at most", 1.0, ""),
        "delay_margin": ("has a delay margin of at least", 1e3, " ms"),
        "noise_gain": ("makes of measurement noise at most", 1.0, f" {unit}"),
    }
    told = [(words[name], limit) for name, limit in spec.limits.items()]
    return [f"{text} {number(factor * limit)}{end}" for (text, factor, end), limit in told]


def _loop(spec: PDSpec, length_unit: str, command_unit: str) -> str:
    """Return the loop in words."""
    if spec.control == "continuous":
        return "an ideal continuous PD"
    law, added = "PD", []
    if spec.controller == "cascade":
        law = "cascade of P position and PI speed" if spec.kiv else "cascade of P position and P speed"
        added += [f"kiv = {number(spec.kiv)} {command_unit}/{length_unit}"] if spec.kiv else []
    elif spec.ki:
        law = "PID"
        added.append(f"ki = {number(spec.ki)} {command_unit}/({length_unit} s)")
    if spec.setpoint_weight != 1:
        added.append(f"a set-point weight of {number(spec.setpoint_weight)}")
    if spec.derivative_settings != {"derivative_filter": 1.0}:
        added.append(spec.derivative_words)
    if spec.anti_windup != "none":
        added.append(f"{spec.anti_windup.replace('_', ' ')} against windup")
    tail = f" with {', '.join(added)}" if added else ""
    return f"a digital {law} sampled every {number(1e3 * spec.sample_time)} ms{tail}"


def _hunting(design: Design, length_unit: str, *, in_python: bool) -> list[str]:
    """Tell of gains with which the axis does not come to rest from all starts."""
    chosen, name = design.recommended, design.spec.free
    gains = {"least": least_gain(design), "recommended": "–" if chosen is None else number(chosen.kd)}
    found = {gains[which]: (which, one) for which, one in design.hunting.items() if one is not None}
    told = [
        f"Hunting: with {name} = {gain}, {'the least' if which == 'least' else 'recommended'},"
        f" {_swings(one, abs(design.spec.reference), length_unit)}."
        for gain, (which, one) in found.items()
    ]
    how = "A spec with hunting=False" if in_python else "Option --no-hunting"
    return [*told, f"{how} seeks a gain with which it comes to rest."] if told else []


def _tracking(design: Design, length_unit: str) -> list[str]:
    """Tell what feedforward is worth."""
    found = design.tracking
    if found is None:
        return []
    without, with_it, worst = (length(x, length_unit) for x in (found.without, found.with_it, found.worst))
    return [
        f"On a smooth move of {number(found.size)} {length_unit} in {number(found.duration)} s it lags by {without}"
        f" (r.m.s.); with feedforward of speed, acceleration and friction from this model by {with_it}, in plants as"
        f" above by up to {worst}."
    ]


def _swings(found: Hunting, step: float, length_unit: str) -> str:
    starts = f"{percent(100 * found.share)} of the starts tried"
    if found.period is None:
        return f"the axis runs away from {starts}, such as {number(found.start, 3)} {length_unit} off the reference"
    size, share = number(found.amplitude, 3), percent(100 * found.amplitude / step)
    return (
        f"the axis keeps swinging by ±{size} {length_unit} ({share} of the step) every {number(found.period, 3)} s,"
        f" from {starts}"
    )


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
        return [sentence(design.disagreement)]
    if not design.candidates:
        return []
    return ["CasADi's nonlinear program finds the same least gains within the search's gap."]


def _intervals(design: Design, kd_unit: str) -> Table:
    rows = [(str(i), *inside(*interval)) for i, interval in enumerate(design.intervals, start=1)]
    return Table(
        title="Gains that meet the spec",
        columns=("Interval", f"{design.spec.free} from [{kd_unit}]", f"{design.spec.free} to [{kd_unit}]"),
        rows=tuple(rows),
        note=_searched(design),
    )


def _searched(design: Design) -> str:
    certificate = design.certificate
    why = "the speed loop would be unstable" if design.spec.controller == "cascade" else "this plant would be too slow"
    end = f" (beyond, {why})" if certificate.end_from_plant else ""
    trusted = {
        "enclosure": "proven by enclosures",
        "sensitivity": "by the measured sensitivity to the gain",
    }[certificate.kind]
    return (
        f"Searched from 0 to {number(certificate.searched[1])}{end}, "
        f"each step watched for {number(certificate.horizon)} s; "
        f"intervals narrower than {number(certificate.gap, 2)} may be missing ({trusted})."
    )


def _responses(design: Design, command_unit: str) -> list[Table]:
    """Return what the least gain does on each of several models; of one model a sentence says it."""
    if len(design.verified) < 2:
        return []
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
    table = Table(
        title=f"Simulated with {design.spec.free} = {least_gain(design)}",
        columns=("Model", "Settles [s]", "Overshoot [%]", f"Peak [{command_unit}]", "Meets"),
        rows=tuple(rows),
    )
    return [table]


def sentence(reason: str | None, *, capital: bool = True) -> str:
    """Return a reason as a sentence with a full stop."""
    text = (reason or "no gain meets the spec").rstrip(".")
    return f"{text[0].upper() if capital else text[0]}{text[1:]}."
