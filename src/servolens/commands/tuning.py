"""Commands that go from records to a gain: tune, compare."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from servolens.commands.files import about, check_apart, check_outputs, check_page, load_records, priors_from, writing
from servolens.commands.options import (
    Documented,
    Recordings,
    SpecOptions,
    effort_option,
    heldout_option,
    json_option,
    prior_option,
    recordings,
    references_option,
    specification,
)
from servolens.commands.terminal import progress_bar, show
from servolens.results import STANDARD_OUTPUT, write_json

if TYPE_CHECKING:
    from servolens.study import Study

__all__ = ["compare", "tune"]


@click.command(cls=Documented, epilog="servolens tune kp60.csv kp80.csv --settling-time 0.5 --report tuning.html")
@recordings(kp=("--record-kp",), kd=("--record-kd", "--kd"))
@specification(required=("--settling-time",), of_records=True)
@references_option
@heldout_option
@prior_option
@effort_option
@click.option("--report", metavar="FILE.html|.pdf", help="Write a self-contained page; PDF by Chromium.")
@click.option("--force", is_flag=True, help="Give the gain although its light is red.")
@json_option
def tune(  # noqa: PLR0913 - a command's options
    recordings: Recordings,
    spec: SpecOptions,
    references: tuple[float, ...],
    heldout: tuple[str, ...],
    priors: tuple[tuple[str, float, float], ...],
    effort: str,
    report: str | None,
    force: bool,
    json_file: str | None,
) -> int:
    """Go from records to a gain, and tell how far it can be trusted.

    Checks the records, identifies the axis, finds what gain and damping lack, and designs on the model that the data
    support best: the gain to use and the least one, with a light each for data, model and gain. Without --kp,
    --sample-time, --derivative-filter and --reference: those of a record with that kp, by default the largest; with
    --reference alone, the largest with which so large a step was run. Exit status 1 if no gain meets the
    specification, or if it is withheld because its light is red.
    """
    if report == STANDARD_OUTPUT:
        raise click.UsageError("--report needs the name of a file")
    outputs = {"--report": report, "--json": json_file}
    found = _studied(
        recordings,
        spec,
        outputs,
        priors=priors,
        effort=effort,
        heldout=heldout,
        references=references,
        force=force,
    )
    if json_file:
        write_json(json_file, "tuning", found.to_json(), found.findings)
    if report:
        from servolens.report import write_study

        with progress_bar() as progress, writing(Path(report)):
            write_study(Path(report), found, progress=progress)
    from servolens.summaries import tuning_summaries

    for summary in tuning_summaries(found, overrule="--force"):
        show(summary, json_file)
        click.echo(err=json_file == STANDARD_OUTPUT)
    return 0 if found.design is not None and found.design.kd is not None else 1


@click.command(cls=Documented, epilog="servolens compare kp80.csv kp100.csv --kp 100 --settling-time 0.5")
@recordings(kp=("--record-kp",), kd=("--record-kd", "--kd"))
@specification(of_records=True)
@prior_option
@effort_option
@json_option
def compare(
    recordings: Recordings,
    spec: SpecOptions,
    priors: tuple[tuple[str, float, float], ...],
    effort: str,
    json_file: str | None,
) -> int:
    """Compare the gains of the linear and the diagnosed model.

    These and one whose damping depends on speed come from the records; all gains are run on the model that the data
    support best. Exit status 1 if no gain meets the specification there, or if it is withheld as in `servolens tune`.
    """
    found = _studied(recordings, spec, {"--json": json_file}, priors=priors, effort=effort)
    if json_file:
        lights = {name: light.to_json() for name, light in found.lights.items()}
        fits = {} if found.fit is None else found.fit.to_json()["models"]
        body = {"linear": None, "nonlinear": None, "diagnosed": None, "reason": found.why_none or None}
        body |= {} if found.comparison is None else found.comparison.to_json()
        write_json(json_file, "comparison", {**body, "models": fits, "lights": lights}, found.findings)
    from servolens.summaries import compared_summary

    show(compared_summary(found), json_file)
    return 0 if found.design is not None and found.design.kd is not None else 1


def _studied(
    recordings: Recordings,
    spec: SpecOptions,
    outputs: dict[str, str | None],
    *,
    priors: tuple[tuple[str, float, float], ...],
    effort: str,
    heldout: tuple[str, ...] = (),
    references: tuple[float, ...] = (),
    force: bool = False,
) -> Study:
    """Read the records and study them."""
    check_outputs(outputs, (*recordings.paths, *heldout))
    check_page(outputs.get("--report"))
    from servolens.study import completed_spec, default_sentence, study_records

    known = priors_from(priors)
    with progress_bar() as progress:
        records = load_records(recordings, outputs, progress)
        others = load_records(replace(recordings, paths=heldout), outputs, progress) if heldout else ()
        check_apart(records, others)
        wanted = completed_spec(records, spec.given)
        with about(*recordings.paths, *heldout):
            found = study_records(
                records,
                wanted,
                references=references,
                heldout=others,
                priors=known,
                effort=effort,
                force=force,
                progress=progress,
            )
        return found.noting(default_sentence(records, spec.given))
