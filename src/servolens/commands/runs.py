"""Commands on measured runs: check, identify, predict."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from servolens.commands.files import (
    about,
    check_outputs,
    load_models,
    load_records,
    priors_from,
    quality_findings,
    refusal,
)
from servolens.commands.options import (
    Documented,
    Recordings,
    finite,
    force_option,
    json_option,
    prior_option,
    recordings,
)
from servolens.commands.terminal import progress_bar, show
from servolens.errors import NumericalError, ServolensError
from servolens.findings import Finding, together
from servolens.results import STANDARD_OUTPUT, write_json
from servolens.summary import Summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.model import Model

__all__ = ["check", "identify", "predict"]


@click.command(cls=Documented, epilog="servolens check kp60.csv kp80.csv")
@recordings()
@json_option
def check(recordings: Recordings, json_file: str | None) -> int:
    """Tell whether records can be trusted.

    Looks at sampling, gaps, quantisation, clipped voltage, excitation, whether the log contradicts its gains, and
    whether the records contradict each other.
    Exit status 1 if a record is unfit for identification, or a sign or a unit in it is wrong.
    """
    from servolens.checking import contradictions
    from servolens.inputs import as_it_ran
    from servolens.quality import assess
    from servolens.summaries import check_summary

    with progress_bar() as progress:
        records = [as_it_ran(record) for record in load_records(recordings, {"--json": json_file}, progress)]
        qualities = []
        for done, record in enumerate(records):
            progress("Checking the records", done, len(records))
            qualities.append(assess(record))
        of_all = contradictions(records, qualities)
    summary = check_summary(qualities, of_all, length_unit=records[0].length_unit)
    if json_file:
        write_json(json_file, "check", {"records": [quality.to_json() for quality in qualities]}, summary.findings)
    show(summary, json_file)
    return 0 if all(quality.usable for quality in qualities) else 1


@click.command(cls=Documented, epilog="servolens identify kp60.csv kp80.csv --out model.json")
@recordings()
@click.option(
    "--model",
    type=click.Choice(["constant", "varying", "velocity", "all"]),
    default="all",
    show_default=True,
    help="What damping may depend on: nothing, time, speed.",
)
@click.option(
    "--delta", type=finite, metavar="NUMBER", help="Varying: damping falls by at most this from piece to piece [1/s]."
)
@click.option(
    "--piece", type=finite, metavar="NUMBER", help="Varying: length of a piece [s]; by default from the reversals."
)
@prior_option
@click.option("--out", metavar="FILE", help="Write the model: the chosen one, with 'all' the velocity model.")
@force_option
@json_option
def identify(
    recordings: Recordings,
    model: str,
    delta: float | None,
    piece: float | None,
    priors: tuple[tuple[str, float, float], ...],
    out: str | None,
    force: bool,
    json_file: str | None,
) -> int:
    """Identify the axis from measured steps.

    Fits constant damping, damping that varies in time and damping that depends on speed, each with errors and units.
    Exit status 1, and no model, if a sign or a unit in the records is wrong.
    """
    if out == json_file == STANDARD_OUTPUT:
        raise click.UsageError("--out and --json cannot both go to standard output")
    if model == "varying" and (out or priors):
        what = "--out writes no time-varying model: it holds for its own step alone" if out else "--prior is for others"
        raise click.UsageError(f"{what}; choose --model constant, velocity or all")
    from servolens.identification import identify as fit
    from servolens.summaries import identification_summary

    with progress_bar() as progress:
        records = load_records(recordings, {"--out": out, "--json": json_file}, progress)
        quality = quality_findings(records)
        progress("Fitting the models", 0, 0)
        refused = refusal(quality, force=force)
        try:
            with about(*recordings.paths):
                result = fit(records, model=model, delta=delta, piece=piece, priors=priors_from(priors))  # type: ignore[arg-type] # click.Choice
        except ServolensError as error:
            if not refused:
                raise
            return _unidentified(f"{error}", (*refused, *quality), json_file)
    findings = together(refused, quality, result.findings)
    if out and not refused:
        write_json(out, "model", _with_fatal(result.model, quality).to_json(), findings)
    if json_file:
        write_json(json_file, "identification", result.to_json(), findings)
    stream = STANDARD_OUTPUT if out == STANDARD_OUTPUT else json_file
    show(replace(identification_summary(result), findings=findings), stream)
    return 1 if refused else 0


def _with_fatal(model: Model, quality: Sequence[Finding]) -> Model:
    """Let a model that is written by force remember what speaks against it."""
    from servolens.quality import against_model

    against = tuple(f"{finding.record}: {finding.message}" for finding in against_model(quality))
    return replace(model, evidence=model.evidence and replace(model.evidence, fatal=against))


def _unidentified(reason: str, findings: tuple[Finding, ...], json_file: str | None) -> int:
    """Tell of records with a wrong sign, unit or order of columns from which nothing could be identified."""
    if json_file:
        write_json(json_file, "identification", {"models": {}, "reason": reason}, findings)
    show(
        Summary(title="Identification", sentences=(f"Nothing was identified: {reason}.",), findings=findings), json_file
    )
    return 1


@click.command(cls=Documented, epilog="servolens predict model.json kp100.csv")
@click.argument("model_file", metavar="MODEL.json")
@recordings()
@json_option
def predict(model_file: str, recordings: Recordings, json_file: str | None) -> int:
    """Simulate records with a model and tell how far it is off.

    Each record's reference is simulated with its own gains; a record without them from its logged voltage.
    """
    from servolens.identification.fit_findings import assumed_damping
    from servolens.inputs import as_records, check_units
    from servolens.prediction import Prediction, prediction_error
    from servolens.summaries import prediction_summary

    check_outputs({"--json": json_file}, [model_file])
    (model,) = load_models([model_file])
    with progress_bar() as progress:
        records = as_records(load_records(recordings, {"--json": json_file}, progress))
        for record in records:
            check_units(model.plant, record)
        errors, failed = [], {}
        for done, record in enumerate(records):
            progress("Simulating the records", done, len(records))
            with about(record.source or record.name):
                try:
                    errors.append(prediction_error(model.plant, record))
                except NumericalError as error:
                    failed[record.name] = f"{error}"
    if not errors:
        raise NumericalError(next(iter(failed.values())))
    driven = [record.name for record in records if not record.has_loop]
    lost = [Finding(code="not_simulated", severity="error", message=f"{m}.", record=n) for n, m in failed.items()]
    assumed = assumed_damping(model.plant, records)
    findings = together(quality_findings(records), _voltage_driven(driven), assumed, lost)
    prediction = Prediction(
        models=("the model",), errors=tuple((error,) for error in errors), identified_from=model.identified_from
    )
    if json_file:
        rows = [{**e.to_json(), "held_out": prediction.is_held_out(e.name)} for e in errors]
        rows += [{**dict.fromkeys(rows[0]), "name": name, "reason": reason} for name, reason in failed.items()]
        write_json(json_file, "prediction", {"model": model_file, "records": rows}, findings)
    summary = prediction_summary(prediction, voltage_driven=driven, length_unit=model.plant.length_unit)
    show(replace(summary, findings=findings), json_file)
    return 0


def _voltage_driven(names: Sequence[str]) -> tuple[Finding, ...]:
    message = "no reference or no gains are logged; it was simulated from its voltage, not in closed loop."
    return tuple(Finding(code="voltage_driven", severity="note", message=message, record=name) for name in names)
