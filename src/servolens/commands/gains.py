"""The command that designs on models: design."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from servolens.commands.files import about, check_outputs, load_models
from servolens.commands.options import Documented, SpecOptions, json_option, specification
from servolens.commands.terminal import progress_bar, show
from servolens.results import write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.model import Model

__all__ = ["design"]


@click.command(cls=Documented, epilog="servolens design model.json --kp 100 --settling-time 0.5")
@click.argument("model_files", nargs=-1, required=True, metavar="MODEL.json...")
@specification()
@click.option(
    "--program", "with_program", is_flag=True, help="Solve for the least gain by CasADi and IPOPT as well, and compare."
)
@click.option("--certify", is_flag=True, help="Prove the search by enclosures: smooth plants, a minute or more.")
@click.option("--force", is_flag=True, help="Give the gain although the model's evidence speaks against it.")
@json_option
def design(
    model_files: tuple[str, ...],
    spec: SpecOptions,
    with_program: bool,
    certify: bool,
    force: bool,
    json_file: str | None,
) -> int:
    """Find the derivative gain to use, and the least one, that settle in time.

    With several models the gains hold for all of them. Exit status 1 if no gain meets the specification, or if the
    gain is withheld: the model is known to be wrong, hardly a plant like it would meet the specification, or the step
    lies far beyond what the records showed.
    """
    check_outputs({"--json": json_file}, model_files)
    from servolens.design import PDSpec, recommend, trust, tune
    from servolens.summaries import design_summary

    wanted = PDSpec(**spec.given)
    models = load_models(model_files)
    if "reference" not in spec.given:
        wanted = replace(wanted, reference=_step_of_records(models) or wanted.reference)
    plants = [model.plant for model in models]
    with progress_bar() as progress, about(*model_files):
        result = tune(plants, wanted, with_program=with_program, certify=certify, progress=progress)
        progress("Simulating scenarios", 0, 0)
        result = recommend(models, result)
        of_model, of_gain = trust(models, result)
    is_wrong = of_gain.light == "red" and result.feasible
    if is_wrong and not force:
        result = result.withhold(of_gain.sentence)
    units = {"length_unit": plants[0].length_unit, "command_unit": plants[0].command_unit}
    summary = design_summary(result, lights={"Model": of_model, "Gain": of_gain}, forced=is_wrong and force, **units)
    if json_file:
        lights = {"model": of_model.to_json(), "gain": of_gain.to_json()}
        body = {**result.to_json(), "lights": lights, "forced": is_wrong and force, "model_files": list(model_files)}
        write_json(json_file, "design", body, summary.findings)
    show(summary, json_file)
    return 0 if result.kd is not None else 1


def _step_of_records(models: Sequence[Model]) -> float | None:
    """Return the largest step that all models have seen, to three digits; None where it is not known."""
    steps = [model.evidence.range.step for model in models if model.evidence is not None]
    return float(f"{min(steps):.3g}") if steps else None
