"""Commands that find causes: diagnose, next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from servolens.commands.files import (
    about,
    check_apart,
    check_outputs,
    check_page,
    load_records,
    priors_from,
    refusal,
    writing,
)
from servolens.commands.options import (
    Documented,
    Recordings,
    effort_option,
    finite,
    force_option,
    heldout_option,
    json_option,
    prior_option,
    recordings,
)
from servolens.commands.terminal import progress_bar, show
from servolens.results import STANDARD_OUTPUT, write_json
from servolens.summary import Summary

__all__ = ["diagnose", "next_"]


@click.command(cls=Documented, epilog="servolens diagnose kp60.csv kp80.csv --heldout kp100.csv --out model.json")
@recordings()
@heldout_option
@prior_option
@effort_option
@click.option("--out", metavar="FILE", help="Write the extended model.")
@click.option("--report", metavar="FILE.html|.pdf", help="Write a self-contained page; PDF by Chromium.")
@force_option
@json_option
def diagnose(
    recordings: Recordings,
    heldout: tuple[str, ...],
    priors: tuple[tuple[str, float, float], ...],
    effort: str,
    out: str | None,
    report: str | None,
    force: bool,
    json_file: str | None,
) -> int:
    """Find what the simulation gets wrong, and why.

    Names the effects that a model of gain and damping lacks, what else they may be, what to do about them, and how much
    better the extended model is on records it has not seen. Without --heldout each record in turn is left out.
    Exit status 1, and no model, if a sign or a unit in the records is wrong.
    """
    if out == json_file == STANDARD_OUTPUT:
        raise click.UsageError("--out and --json cannot both go to standard output")
    if report == STANDARD_OUTPUT:
        raise click.UsageError("--report needs the name of a file")
    outputs = {"--out": out, "--report": report, "--json": json_file}
    check_outputs(outputs, (*recordings.paths, *heldout))
    check_page(report)
    from servolens.diagnosis import diagnose as find
    from servolens.summaries import diagnosis_summary

    known = priors_from(priors)
    with progress_bar() as progress:
        records = load_records(recordings, outputs, progress)
        others = load_records(replace(recordings, paths=heldout), outputs, progress) if heldout else ()
        check_apart(records, others)
        with about(*recordings.paths, *heldout):
            result = find(records, heldout=others, priors=known, effort=effort, progress=progress)
    refused = refusal(result.findings, force=force)
    findings = (*refused, *result.findings)
    if out and not refused:
        write_json(out, "model", result.model.to_json(), findings)
    if json_file:
        write_json(json_file, "diagnosis", result.to_json(), findings)
    if report:
        from servolens.report import write_diagnosis_report

        with writing(Path(report)):
            write_diagnosis_report(Path(report), result)
    summary = diagnosis_summary(result)
    show(
        replace(summary, findings=(*refused, *summary.findings)),
        STANDARD_OUTPUT if out == STANDARD_OUTPUT else json_file,
    )
    return 1 if refused else 0


@click.command("next", cls=Documented, epilog="servolens next diagnosis.json")
@click.argument("file", metavar="DIAGNOSIS.json|MODEL.json")
@click.option("--kp", type=finite, metavar="NUMBER", help="For a model alone: a gain around which to look.")
@click.option(
    "--reference",
    type=finite,
    metavar="NUMBER",
    help="For a model alone: the step [m or rad].  [default: 0.1, or less that asks for 10 V]",
)
@json_option
def next_(file: str, kp: float | None, reference: float | None, json_file: str | None) -> int:
    """Propose the experiment that best tells rivals apart.

    Reads what `servolens diagnose --json` wrote; a model alone names no rivals, and is compared with itself without its
    least certain effect, with gains and steps as --kp and --reference say: it does not know those that were logged.
    Exit status 1 if there is nothing to tell apart.
    """
    check_outputs({"--json": json_file}, [file])
    from servolens.diagnosis.proposal import propose
    from servolens.summaries import experiment_summary

    with about(file):
        found = propose(file, kp=kp, reference=reference)
    if json_file:
        write_json(json_file, "next", found.to_json(), found.findings)
    if found.experiment is None:
        show(Summary(title="Next experiment", sentences=(_sentence(found.reason),), findings=found.findings), json_file)
        return 1
    units = {"length_unit": found.length_unit, "command_unit": found.command_unit}
    show(replace(experiment_summary(found.experiment, **units), findings=found.findings), json_file)
    return 0


def _sentence(reason: str | None) -> str:
    text = reason or "there is nothing to tell apart"
    return f"{text[:1].upper()}{text[1:]}."
