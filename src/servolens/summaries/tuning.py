"""What a study of records says."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servolens.summaries.checks import check_summary
from servolens.summaries.comparison import comparison_summary, side_by_side
from servolens.summaries.diagnosis import (
    SURROUNDINGS,
    doubt_sentences,
    is_told_already,
    remaining_sentences,
    verdict_sentence,
)
from servolens.summaries.diagnosis_tables import parameters_table
from servolens.summaries.gains import (
    asked_sentence,
    least_gain,
    light_sentences,
    sentence,
)
from servolens.summaries.wording import capital, number
from servolens.summary import Summary

if TYPE_CHECKING:
    from servolens.findings import Finding
    from servolens.study import Study

__all__ = ["compared_summary", "gain_sentences", "told_elsewhere", "tuning_summaries"]


def tuning_summaries(study: Study, *, overrule: str = "force=True") -> tuple[Summary, Summary]:
    """Tell what was found, then, as what one should read last, the lights and the gains.

    Parameters
    ----------
    study : Study
        Of one axis.
    overrule : str
        How a withheld gain is asked for; empty where nobody can.
    """
    record = study.records[0]
    checked = check_summary(study.check, length_unit=record.length_unit).sentences
    sentences = [said for said in checked if said.rstrip(".") not in study.lights["data"].sentence]
    tables = []
    if study.diagnosis is not None:
        found = study.diagnosis
        sentences += [verdict_sentence(found), *doubt_sentences(found), *remaining_sentences(found)]
        tables.append(parameters_table(study.diagnosis))
    elif study.fit is not None and study.why_undiagnosed:
        sentences.append(f"No cause was sought: {study.why_undiagnosed.rstrip('.')}.")
    design = study.design
    if design is not None:
        sentences.append(asked_sentence(design.spec, record.length_unit, record.command_unit))
    if study.comparison is not None and design is not None and design.kd is not None:
        unit = f"{record.command_unit} s/{record.length_unit}"
        tables.append(side_by_side(study.comparison, unit, record.command_unit))
    findings = tuple(finding for finding in study.findings if not _is_told(study, finding))
    told = Summary(title="Tuning", sentences=tuple(sentences), tables=tuple(tables), findings=findings)
    lights = light_sentences(study.lights)
    gains = [said for said in gain_sentences(study, overrule=overrule) if said not in study.lights["gain"].sentence]
    return told, Summary(title="The gain", sentences=(*lights, *gains))


def told_elsewhere(study: Study, finding: Finding) -> bool:
    """Tell whether a page's sentences on lights, verdict and noise say all of a finding."""
    return _is_told(study, finding) or (study.diagnosis is not None and finding.code in SURROUNDINGS)


def _is_told(study: Study, finding: Finding) -> bool:
    """Tell whether another sentence says all of a finding: on the diagnosis, or the light of the data."""
    said, message = study.lights["data"].sentence, finding.message.rstrip(".")
    if (message if finding.record else capital(message)) in said:
        return finding.record is None or f"{finding.record}: " in said
    return study.diagnosis is not None and is_told_already(finding, study.diagnosis)


def compared_summary(study: Study) -> Summary:
    """Tell what the models of a study recommend, and how far the last of them can be trusted."""
    record, lights = study.records[0], tuple(light_sentences(study.lights))
    if study.comparison is None:
        return Summary(title="Comparison", sentences=lights, findings=study.findings)
    told = comparison_summary(study.comparison, length_unit=record.length_unit, command_unit=record.command_unit)
    return replace(told, sentences=(*told.sentences, *lights), findings=study.findings)


def gain_sentences(study: Study, *, overrule: str = "force=True") -> tuple[str, ...]:
    """Return the gain to use and the least one, or why there is none; `overrule` as in :func:`tuning_summaries`."""
    design, record = study.design, study.records[0]
    if design is None:
        return (f"No gain was sought: {study.why_none.rstrip('.')}.",)
    if design.withheld:
        how = f" {overrule} gives it all the same." if overrule else ""
        return (f"The gain is withheld: see its light.{how}",)
    if design.kd is None:
        why = sentence(design.reason)
        said = "No gain is given" if study.lights["data"].light == "red" else "No gain meets the spec"
        return (f"{said}: see its light." if why in study.lights["gain"].sentence else why,)
    unit = f"{record.command_unit} s/{record.length_unit}"
    forced = ("Forced: these gains would be withheld.",) if study.forced else ()
    least = f"Least: {design.spec.free} = {least_gain(design)} {unit}"
    chosen = design.recommended
    if chosen is None:
        return (*forced, f"{least}.")
    kp_unit = "1/s" if design.spec.controller == "cascade" else f"{record.command_unit}/{record.length_unit}"
    kp = f"{number(chosen.kp)} {kp_unit}"
    gains = f"Recommended: kp = {kp}, {design.spec.free} = {number(chosen.kd)} {unit}"
    why = "" if study.lights["gain"].light == "green" else f"; with it the axis {chosen.why}"
    return (*forced, f"{gains}{why}.", f"{least}. {sentence(chosen.risk)}")
