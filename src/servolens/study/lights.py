"""How far data, model and gain of a study can be trusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design import Light, trust
from servolens.findings import listed
from servolens.quality import assess, fatal, of_the_loop
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design import Design, PDSpec
    from servolens.diagnosis import Diagnosis
    from servolens.findings import Finding
    from servolens.model import Model
    from servolens.quality import RecordQuality

__all__ = ["data_light", "diagnosis_lights", "is_fit", "study_lights"]

MOST_NAMED = 3
OF_ALL_RECORDS = (
    "records_contradict",
    "limit_contradicts_log",
    "loop_faster_than_log",
    "time_steps_assumed",
    "knocked_axis",
)
"""Findings of a diagnosis that speak against the records."""
SETTINGS = ("settings_contradict_log", "gains_contradict_log")
"""Findings that name the setting which a log fits."""


def is_fit(quality: RecordQuality) -> bool:
    """Tell whether a model can be found from a record, if not be trusted: a wrong sign or unit is no obstacle."""
    return quality.usable or all(fatal([finding]) for finding in quality.findings if finding.severity == "error")


def data_light(check: Sequence[RecordQuality], others: Sequence[Finding] = ()) -> Light:
    """Judge the records: red where a sign or a unit is wrong or none is fit, amber where something is to be known.

    Of the `others`, findings on what was made of the records, those count that speak against these.
    """
    against = [finding for finding in others if finding.code in OF_ALL_RECORDS]
    findings = [*against, *(finding for quality in check for finding in quality.findings)]
    wrong = fatal(findings)
    if wrong:
        return Light(light="red", sentence=_told(wrong))
    errors = [finding for finding in findings if finding.severity == "error"]
    unfit = [quality.name for quality in check if not quality.usable]
    if len(unfit) == len(check):
        return Light(light="red", sentence=f"No model can be found from these data. {_told(errors)}")
    if unfit:
        named = ", ".join(unfit[:MOST_NAMED]) + (" and others" if len(unfit) > MOST_NAMED else "")
        return Light(light="amber", sentence=f"Left out as unfit: {named}. {_told(errors)}")
    warnings = [finding for finding in findings if finding.severity == "warning"]
    if warnings:
        return Light(light="amber", sentence=_told(warnings))
    count = {1: "The record", 2: "Both records"}.get(len(check), f"All {len(check)} records")
    them = "it" if len(check) == 1 else "them"
    return Light(light="green", sentence=f"{count} can be used, and nothing in the data speaks against {them}.")


def diagnosis_lights(diagnosis: Diagnosis) -> dict[str, Light]:
    """Return the lights of ``"data"`` and ``"model"`` of a diagnosis, which has no gain."""
    check = [assess(record) for record in (*diagnosis.records, *diagnosis.heldout)]
    return {"data": data_light(check, diagnosis.findings), "model": trust(diagnosis.model, None)[0]}


def study_lights(
    data: Light, model: Model | None, design: Design | None, why_none: str, findings: Sequence[Finding] = ()
) -> dict[str, Light]:
    """Return the lights of ``"data"``, ``"model"`` and ``"gain"``; on wrong data no gain is to be given.

    Beside `findings` that what the records state of their loop is wrong, no gain is sure.
    """
    if model is None:
        of_model = Light(light="red", sentence="No model was found.")
        of_gain = Light(light="red", sentence=f"No gain was sought: {why_none.rstrip('.')}.")
        return {"data": data, "model": of_model, "gain": of_gain}
    of_model, of_gain = trust(model, design)
    if design is None:
        of_gain = Light(light="red", sentence=f"No gain was sought: {why_none.rstrip('.')}.")
    elif data.light == "red":
        of_gain = Light(light="red", sentence="A gain would rest on wrong data; correct the records first.")
    elif of_gain.light != "red" and (wrong := of_the_loop(findings)):
        warning = _of_another_loop(wrong, design.spec, model)
        of_gain = Light(
            light="amber", sentence=warning if of_gain.light == "green" else f"{warning} {of_gain.sentence}"
        )
    return {"data": data, "model": of_model, "gain": of_gain}


def _of_another_loop(wrong: Sequence[Finding], spec: PDSpec, model: Model) -> str:
    """Say for which loop a gain was computed where the log says that its own is not the one that is stated."""
    plant, records = model.plant, listed(list(dict.fromkeys(str(finding.record) for finding in wrong)), MOST_NAMED)
    kp = f"kp = {spec.kp:.4g} {'1/s' if spec.controller == 'cascade' else f'{plant.command_unit}/{plant.length_unit}'}"
    sampled = f", {spec.derivative_words} and a sample time of {readable(spec.sample_time, 's')}"
    loop = f"an ideal continuous PD with {kp}" if spec.control == "continuous" else f"a loop with {kp}{sampled}"
    fits = "fits another setting" if wrong[0].code in SETTINGS else "does not fit the loop that is stated for it"
    return f"Computed for {loop}; but the log of {records} {fits}: correct it and repeat."


def _told(findings: Sequence[Finding]) -> str:
    """Return the first of the findings, and how many more there are."""
    first, *others = findings
    about = f"{first.record}: {first.message}" if first.record else first.message[:1].upper() + first.message[1:]
    told = about if about.endswith("?") else f"{about.rstrip('.')}."
    more = {0: "", 1: " Another finding is in the list."}.get(len(others), f" {len(others)} more are in the list.")
    return f"{told}{more}"
