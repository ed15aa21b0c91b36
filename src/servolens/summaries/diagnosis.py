"""What a diagnosis, and the experiment it proposes, say."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from servolens.diagnosis.logs import is_blamed
from servolens.diagnosis.reasons import MOST_CONFIDENT
from servolens.effects import catalogue
from servolens.quality import fatal, of_the_loop
from servolens.rendering import grouped
from servolens.summaries.diagnosis_tables import candidates_table, parameters_table, records_table
from servolens.summaries.evidence import CLEAR, instrument_sentence, reach_sentence, where_phrase
from servolens.summaries.names import cause_phrase, spoken
from servolens.summaries.wording import capital, length, listed, number, percent, scale, unit
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from servolens.diagnosis.next_experiment import Experiment
    from servolens.diagnosis.result import Cause, Diagnosis
    from servolens.findings import Finding

__all__ = [
    "SURROUNDINGS",
    "advice",
    "cause_phrase",
    "diagnosis_summary",
    "doubt_sentences",
    "experiment_sentence",
    "experiment_summary",
    "findings_of_logs",
    "is_told_already",
    "next_sentences",
    "noise_sentences",
    "other_findings",
    "remaining_sentences",
    "spoken",
    "verdict_sentence",
    "why_enough",
]

FEW_SAMPLES = 200
"""Samples up to which records show little."""
SURROUNDINGS = ("noise_model", "noise_parts", "mains_ripple", "noise_in_loop", "shaken_axis", "bursts")
"""Findings about what the records hold beside the motion: sentences of their own."""
TOLD_WITH_THE_REMAINDER = "immaterial_remainder"
BEYOND_NOISE = 1.5
"""Times the noise from which on a remainder that knows no input is worth a sentence."""


def diagnosis_summary(diagnosis: Diagnosis) -> Summary:
    """Tell what is wrong, why and what knowing it is worth; then each cause, its remedy, and what is still open.

    Parameters
    ----------
    diagnosis : Diagnosis
        Of one axis.
    """
    sentences = [verdict_sentence(diagnosis), *_first_the_log(diagnosis), *remaining_sentences(diagnosis)]
    sentences += noise_sentences(diagnosis)
    for cause in diagnosis.causes:
        looks, *rest = advice(cause, diagnosis)
        sentences += [f"{capital(spoken(cause.effect))}: {looks}", *rest]
    sentences += next_sentences(diagnosis)
    best = candidates_table(diagnosis)
    names = listed([logged.name for logged in diagnosis.experiments])
    return Summary(
        title=f"Diagnosis of {names}: {diagnosis.verdict.replace('_', ' ')}",
        sentences=tuple(sentences),
        tables=(parameters_table(diagnosis), records_table(diagnosis), *([best] if best else [])),
        findings=other_findings(diagnosis),
    )


def experiment_summary(experiment: Experiment, *, length_unit: str, command_unit: str) -> Summary:
    """Tell the experiment to log next, in a sentence and as settings.

    Parameters
    ----------
    experiment : Experiment
        What was found.
    length_unit, command_unit : str
        Of the plant.
    """
    factor, scaled = scale([experiment.start, experiment.reference], length_unit)
    rows = (
        (f"kp [{command_unit}/{length_unit}]", number(experiment.kp)),
        (f"kd [{command_unit} s/{length_unit}]", number(experiment.kd)),
        (f"From [{scaled}]", number(factor * experiment.start)),
        (f"To [{scaled}]", number(factor * experiment.reference)),
        ("And back", "yes" if experiment.back else "no"),
        ("Time at each level [s]", number(experiment.duration)),
        ("Sample time [ms]", number(1e3 * experiment.sample_time)),
    )
    return Summary(
        title="Next experiment",
        sentences=(experiment_sentence(experiment, length_unit, command_unit),),
        tables=(Table(title="Settings", columns=("Setting", "Value"), rows=rows),),
    )


def experiment_sentence(experiment: Experiment, length_unit: str, command_unit: str) -> str:
    """Return what to log next and what it tells apart."""
    factor, scaled = scale([experiment.start, experiment.reference], length_unit)
    first, second = (spoken(name) for name in experiment.separates)
    step = f"a step from {number(factor * experiment.start)} to {number(factor * experiment.reference)} {scaled}"
    gains = f"kp = {number(experiment.kp)} {command_unit}/{length_unit}"
    gains += f" and kd = {number(experiment.kd)} {command_unit} s/{length_unit}" if experiment.kd else " without kd"
    return (
        f"Log next {step}{' and back' if experiment.back else ''}, {number(experiment.duration, 2)} s at each"
        f" level, with {gains}: there {first} and {second} differ by"
        f" {number(experiment.separation, 2)} times the noise (r.m.s. over all samples, which tell that apart)."
    )


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """Return the sentence that matters most; where the logs are in doubt, it says so."""
    if _is_wrong(diagnosis):
        return "A sign or a unit in the logs is wrong: nothing can be said of the axis before it is corrected."
    told = _verdict(diagnosis)
    if not findings_of_logs(diagnosis):
        return capital(told)
    return f"The logs are in doubt; taken as they are, {told}"


def findings_of_logs(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    """Return what the logs themselves have wrong that may look like physics: of each kind one, the gravest first."""
    found = grouped(finding for finding in diagnosis.findings if is_blamed(finding))
    told = []
    for code in dict.fromkeys(finding.code for finding in found):
        first, *more = (finding for finding in found if finding.code == code)
        likewise = f" Likewise {listed([str(finding.record) for finding in more])}." if more else ""
        told.append(replace(first, message=f"{first.message.rstrip('.')}.{likewise}"))
    return tuple(told)


def other_findings(diagnosis: Diagnosis) -> tuple[Finding, ...]:
    """Return the findings that no sentence tells already."""
    told = (*SURROUNDINGS, TOLD_WITH_THE_REMAINDER)
    return grouped(finding for finding in diagnosis.findings if finding.code not in told)


def noise_sentences(diagnosis: Diagnosis) -> list[str]:
    """Say what the records hold beside the motion: the sensor's noise, a ripple of the mains, what shakes the axis."""
    found = [finding for code in SURROUNDINGS for finding in diagnosis.findings if finding.code == code]
    return [capital(unit(finding.message)) for finding in found if not is_told_already(finding, diagnosis)]


def is_told_already(finding: Finding, diagnosis: Diagnosis) -> bool:
    """Whether the sentences on the verdict or the remainder say all that a finding says."""
    tells_noise = diagnosis.verdict == "explained"  # where something is left, the finding says what the noise is of
    return finding.code == TOLD_WITH_THE_REMAINDER or (finding.code == "noise_model" and tells_noise)


def remaining_sentences(diagnosis: Diagnosis) -> list[str]:
    """Say what the remainder is worth where there is one, and what the records are too short to show."""
    if _is_wrong(diagnosis):
        return []
    told = _left(diagnosis)
    if diagnosis.verdict in ("partly_explained", "unexplained") and diagnosis.remainder.depends_on_inputs:
        told += [instrument_sentence(i) for i in diagnosis.instruments[:1] if i.significance <= CLEAR]
    samples = sum(len(record) for record in diagnosis.records)
    if 0 < samples <= FEW_SAMPLES:
        seconds = number(sum(record.duration for record in diagnosis.records), 2)
        told.append(
            f"{samples} samples in {seconds} s show little: before you trust this, log faster, and more whole moves up"
            " to rest."
        )
    return told


def why_enough(diagnosis: Diagnosis) -> list[str]:
    """Say of a healthy axis what was done, and why nothing more was needed."""
    told = [
        "Gain and damping were fitted, and what their simulation leaves was tested against the reference: it does not"
        " depend on it, so what is left is noise."
    ]
    if diagnosis.candidates:
        told.append(f"None of the {len(catalogue())} effects of the catalogue makes these records more likely.")
    reach = reach_sentence(diagnosis.where)
    return [*told, reach] if reach else told


def advice(cause: Cause, diagnosis: Diagnosis) -> list[str]:
    """Return what the cause looks like, what to do, what it means for the gain, and what it may be instead."""
    kind = cause.kind
    told = [kind.looks_like or kind.sentence]
    is_guess = diagnosis.verdict == "partly_explained" and cause.confidence < MOST_CONFIDENT
    told += [f"What to do{', if it is that' * is_guess}: {kind.remedy}"] if kind.remedy else []
    told += [f"For the PD gain{', if it is that' * is_guess}: {kind.for_the_gain}"] if kind.for_the_gain else []
    sure = f"Confidence {percent(100 * cause.confidence)} among the effects tried"
    if diagnosis.verdict == "partly_explained":
        sure += ", as far as the error is explained at all"
    rivals, unfitted = [spoken(rival) for rival in _rivals(cause)], _same_structure(cause)
    if rivals:
        told.append(f"{sure}. These data cannot distinguish it from {listed(rivals, last='or')}.")
    elif diagnosis.verdict == "partly_explained" or unfitted:
        told.append(f"{sure}.")
    else:
        told.append(f"{sure}: none does as well with as few parameters.")
    if len(rivals) + len(unfitted) < len(cause.rivals):
        told.append(f"It is the same as {spoken(' + '.join(kind.unites))}.")
    told += [
        f"{capital(spoken(name))} has the same structure and was not fitted: look at the machine to tell which it is."
        for name in unfitted
    ]
    return told


def doubt_sentences(diagnosis: Diagnosis) -> list[str]:
    """Say of each cause that is uncertain how sure it is, and what else it may be."""
    told, alone = [], []
    for cause in diagnosis.causes:
        rivals, name = [spoken(rival) for rival in _rivals(cause)], spoken(cause.effect)
        sure = percent(100 * cause.confidence)
        if rivals:
            others = listed(rivals, last="or")
            told.append(f"Confidence in {name}: {sure}; these data cannot distinguish it from {others}.")
        elif cause.confidence < MOST_CONFIDENT:
            alone.append(f"{name} {sure}")
    return [*told, f"Confidence: {listed(alone)}."] if alone else told


def next_sentences(diagnosis: Diagnosis) -> list[str]:
    """Return what to log next where causes have rivals."""
    plant = diagnosis.plant
    if diagnosis.next_experiment is not None:
        return [experiment_sentence(diagnosis.next_experiment, plant.length_unit, plant.command_unit)]
    if any(_rivals(cause) for cause in diagnosis.causes):
        return ["No safe step like those logged would separate them; look at the machine, or measure something else."]
    return []


def _rivals(cause: Cause) -> list[str]:
    """Return the rivals that were fitted, but for the pair that together is the same thing."""
    unfitted = _same_structure(cause)
    return [r for r in cause.rivals if r not in unfitted and set(r.split(" + ")) != set(cause.kind.unites)]


def _same_structure(cause: Cause) -> list[str]:
    """Return the rivals that are of the same structure and no effects of the catalogue."""
    return [rival for rival in cause.rivals if rival in cause.kind.same_structure]


def _verdict(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == "healthy":
        return _healthy(diagnosis)
    if diagnosis.verdict == "unexplained":
        return _unexplained(diagnosis)
    causes = [cause_phrase(cause) for cause in diagnosis.causes]
    names, them = (listed(causes), "them") if len(causes) > 1 else (causes[0], "it")
    runs_away = _diverges(diagnosis, after=False) and not _diverges(diagnosis, after=True)
    where = _where(diagnosis)
    start = f"{where}; " if where else ""
    start += _named(diagnosis, names, f"part of {'it' if where else 'the error'} is explained by")
    unit_ = diagnosis.plant.length_unit
    errors = (_error(diagnosis, after=False), _error(diagnosis, after=True), diagnosis.noise_floor)
    held = "held-out " if diagnosis.extended.heldout_rms_error is not None else ""
    if runs_away:
        after, noise = (length(error, unit_, beside=errors[1]) for error in errors[1:])
        return (
            f"{start}; with {them} the {held}error is {after} (r.m.s., the noise is {noise}); without, the simulation"
            " diverges."
        )
    loop = " of the loop as the logs state it" if _is_of_the_loop(diagnosis) else ""
    if _diverges(diagnosis, after=True):
        before, noise = length(errors[0], unit_), length(errors[2], unit_)
        without = "" if _diverges(diagnosis, after=False) else f"; without, the {held}error is {before} (r.m.s.)"
        return f"{start}; but with {them} the simulation{loop} diverges{without}. The noise is {noise}."
    before, after, noise = (length(error, unit_, beside=errors[0]) for error in errors)
    falls = errors[1] < errors[0]
    has_phases = any(effect.phase_per_record for effect in diagnosis.plant.effects)
    if has_phases and not falls and diagnosis.remainder.rms < errors[0]:
        times = number(diagnosis.remainder.times_noise or 1.0, 2)
        left = "no more than the noise" if times == "1" else f"{times} times the noise"
        return (
            f"{start}; {'they leave' if len(causes) > 1 else 'it leaves'} {left}, {noise} (r.m.s.),"
            " where the phase is fitted to each record. No simulation can predict that phase: the"
            f" {held}error is {after} with {them}, {before} without."
        )
    if before == after:
        return f"{start}; but the {held}error stays at {after} with {them} (r.m.s., the noise is {noise})."
    if falls:
        return f"{start}; with {them} the {held}error falls from {before} to {after} (r.m.s., the noise is {noise})."
    return (
        f"{start}; but simulations{loop} miss more with {them}: the {held}error is {after} with {them}, {before}"
        f" without (r.m.s., the noise is {noise})."
    )


def _named(diagnosis: Diagnosis, names: str, partly: str) -> str:
    """Return the `names` as the causes, as what explains `partly`, or, at less than even odds, as one of several."""
    if diagnosis.verdict != "explained":
        return f"{partly} {names}"
    if min(cause.confidence for cause in diagnosis.causes) < 0.5:
        return f"one of several explanations is {names}"
    return f"the cause{'s are' if len(diagnosis.causes) > 1 else ' is'} {names}"


def _healthy(diagnosis: Diagnosis) -> str:
    several = len(diagnosis.experiments) > 1
    noise = length(diagnosis.noise_floor, diagnosis.plant.length_unit)
    these, they = ("these records", "they") if several else ("this record", "it")
    explained = f"gain and damping explain how {these} depend{'' if several else 's'} on the reference"
    in_bursts = _has(diagnosis, "bursts")
    if _has(diagnosis, "shaken_axis"):
        bursts = " in bursts" if in_bursts else ""
        return (
            f"{explained}; in addition something shakes the axis{bursts}, and the sensor's noise is {noise} (r.m.s.)."
        )
    if in_bursts:
        return f"{explained}; the noise of the position, {noise} (r.m.s.), comes in bursts."
    if _is_more_than_noise(diagnosis) and _is_of_the_loop(diagnosis):
        return f"driven by the logged voltage, gain and damping explain {these} down to the noise, {noise} (r.m.s.)."
    if _is_more_than_noise(diagnosis):
        return f"{explained}; the sensor's noise is {noise} (r.m.s.)."
    return (
        f"gain and damping explain {these} down to the noise, {noise} (r.m.s.): nothing else is wrong that {they}"
        " could show."
    )


def _unexplained(diagnosis: Diagnosis) -> str:
    contradiction = [finding for finding in diagnosis.findings if finding.code == "records_contradict"]
    if contradiction:
        told = unit(contradiction[0].message)
        return told if told.endswith((".", "?")) else f"{told}."
    for finding in diagnosis.findings:
        if finding.code == "gain_not_shown":
            return unit(finding.message)
    if not diagnosis.remainder.depends_on_inputs and _has(diagnosis, "bursts"):
        return _healthy(diagnosis)
    where = _where(diagnosis)
    start = f"{where}; " if where else ""
    error = length(_error(diagnosis, after=False), diagnosis.plant.length_unit)
    is_off = "diverges" if _diverges(diagnosis, after=False) else f"is {error} (r.m.s.) off"
    return (
        f"{start}nothing in the catalogue explains {'it' if where else 'the error'}: a model of gain and damping"
        f" {is_off}{_data(diagnosis)}, and no effect that was tried makes that much better."
    )


def _first_the_log(diagnosis: Diagnosis) -> list[str]:
    """Say what the logs themselves have wrong, before physics is blamed."""
    blamed = findings_of_logs(diagnosis)
    if not blamed:
        return []
    told = " ".join(f"{finding.record}: {finding.message}" for finding in blamed)
    return [f"Correct the logs first: {told} This may be the reason for what follows."]


def _left(diagnosis: Diagnosis) -> list[str]:
    """Say what remains, where something does."""
    if _has(diagnosis, "heldout_contradicts"):
        return ["Records that were held out are much farther off than those that were fitted: see the warnings below."]
    rest, unit_ = diagnosis.remainder, diagnosis.plant.length_unit
    if not math.isfinite(rest.rms):
        return ["How much the model misses is unknown: a record cannot be simulated with it."]
    if rest.rms == 0 and rest.depends_on_inputs and diagnosis.verdict in ("partly_explained", "unexplained"):
        return [
            "What is left depends on the inputs, but is smaller than the noise: only many samples together show it."
        ]
    size = f"{percent(100 * rest.of_travel)} of the travel, {length(rest.rms, unit_)} (r.m.s.) beyond the noise"
    size += " in the records held out" if rest.heldout else ""
    if diagnosis.verdict in ("healthy", "explained"):
        worth = "That is enough to matter." if rest.material else "That is immaterial for most uses."
        if _is_of_the_loop(diagnosis):
            told = f"In addition the simulation misses {size}, with the loop as the logs state it. {worth}"
        else:
            told = f"In addition the simulation misses {size}. It does not depend on what drives the axis. {worth}"
        return [told] if _is_more_than_noise(diagnosis) else []
    worth = "and it matters" if rest.material else "but immaterial"
    told = f"What is left is unexplained, {worth}: {size}."
    if diagnosis.verdict == "partly_explained":
        return [f"{told} Something else is wrong too, and the causes named may partly take its place."]
    if not rest.material:
        return [f"{told} For most uses gain and damping are enough."]
    return [f"{told} Look at where the error arises, and at the warnings if there are any, before tuning."]


def _is_wrong(diagnosis: Diagnosis) -> bool:
    """Tell whether a wrong sign or unit has left nothing to be said of the axis."""
    return not diagnosis.causes and bool(fatal(diagnosis.findings))


def _is_of_the_loop(diagnosis: Diagnosis) -> bool:
    """Tell whether a log states its loop wrongly."""
    return bool(of_the_loop(diagnosis.findings))


def _is_more_than_noise(diagnosis: Diagnosis) -> bool:
    """Tell whether what a simulation misses is worth a sentence where nothing depends on the inputs."""
    return (diagnosis.remainder.times_noise or 0.0) > BEYOND_NOISE


def _has(diagnosis: Diagnosis, code: str) -> bool:
    return any(finding.code == code for finding in diagnosis.findings)


def _error(diagnosis: Diagnosis, *, after: bool) -> float:
    errors = diagnosis.extended if after else diagnosis.baseline
    return errors.rms_error if errors.heldout_rms_error is None else errors.heldout_rms_error


def _where(diagnosis: Diagnosis) -> str:
    """Return where the error of gain and damping arises; nothing where their simulation diverges."""
    return "" if _diverges(diagnosis, after=False) else where_phrase(diagnosis.where)


def _diverges(diagnosis: Diagnosis, *, after: bool) -> bool:
    """Tell whether simulations leave the axis: they miss, r.m.s., more than all of its travel."""
    ranges = [logged.position_range for logged in (*diagnosis.experiments, *diagnosis.tests)]
    return not _error(diagnosis, after=after) <= max((high - low for low, high in ranges), default=math.inf)


def _data(diagnosis: Diagnosis) -> str:
    return "" if diagnosis.baseline.heldout_rms_error is None else " on held-out data"
