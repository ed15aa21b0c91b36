"""The commands that design on models: design, map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from servolens.commands.files import about, check_outputs, load_models, writing
from servolens.commands.options import (
    Documented,
    SpecOptions,
    finite,
    json_option,
    references_option,
    several_gains,
    specification,
)
from servolens.commands.terminal import progress_bar, show
from servolens.results import STANDARD_OUTPUT, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design import PDSpec
    from servolens.model import Model

__all__ = ["design", "map_"]


@click.command(cls=Documented, epilog="servolens design model.json --kp 100 --settling-time 0.5")
@click.argument("model_files", nargs=-1, required=True, metavar="MODEL.json...")
@specification()
@references_option
@several_gains()
@click.option(
    "--program", "with_program", is_flag=True, help="Solve for the least gain by CasADi and IPOPT as well, and compare."
)
@click.option("--certify", is_flag=True, help="Prove the search by enclosures: smooth plants, a minute or more.")
@click.option("--force", is_flag=True, help="Give the gain although the model's evidence speaks against it.")
@json_option
def design(
    model_files: tuple[str, ...],
    spec: SpecOptions,
    references: tuple[float, ...],
    wishes: dict[str, Any] | None,
    with_program: bool,
    certify: bool,
    force: bool,
    json_file: str | None,
) -> int:
    """Find the derivative gain to use, and the least one.

    With several models the gains hold for all of them. Exit status 1 if no gain meets the specification, or if the
    gain is withheld: the model is known to be wrong, hardly a plant like it would meet the specification, or the step
    lies far beyond what the records showed. With --free or --objective, kp and the derivative filter are chosen first.
    """
    check_outputs({"--json": json_file}, model_files)
    from servolens.design import GainWishes, PDSpec, recommend, trust, tune, tune_gains
    from servolens.summaries import design_summary, gains_summary

    wanted = PDSpec(**spec.given)
    models = load_models(model_files)
    wanted = _stepping(wanted, spec, models)
    for size in references:
        replace(wanted, reference=size)  # refuses it here, not as a fault of the files
    plants = [model.plant for model in models]
    asked = None if wishes is None else GainWishes(**wishes)
    with progress_bar() as progress, about(*model_files):
        chosen = None if asked is None else tune_gains(models, wanted, asked, progress=progress)
        wanted = wanted if chosen is None else chosen.spec
        result = tune(plants, wanted, with_program=with_program, certify=certify, progress=progress)
        progress("Simulating gains on uncertain plants", 0, 0)
        result = recommend(models, result, references=references)
        of_model, of_gain = trust(models, result)
    is_wrong = of_gain.light == "red" and result.feasible
    if is_wrong and not force:
        result = result.withhold(of_gain.sentence)
        chosen = None
    units = {"length_unit": plants[0].length_unit, "command_unit": plants[0].command_unit}
    named = {"Model": of_model, "Gain": of_gain}
    summary = design_summary(result, lights=named, forced=is_wrong and force, in_python=False, **units)
    if json_file:
        lights = {"model": of_model.to_json(), "gain": of_gain.to_json()}
        body = {**result.to_json(), "lights": lights, "forced": is_wrong and force, "model_files": list(model_files)}
        body |= {} if chosen is None else {"gains": chosen.gains, "several": chosen.to_json()}
        write_json(json_file, "design", body, summary.findings)
    if chosen is not None:
        show(gains_summary(chosen, **units), json_file)
        click.echo(err=json_file == STANDARD_OUTPUT)
    show(summary, json_file)
    return 0 if result.kd is not None and (chosen is None or chosen.kd is not None) else 1


@click.command(name="map", cls=Documented, epilog="servolens map model.json --kp 100 --settling-time 0.5 --out map.png")
@click.argument("model_files", nargs=-1, required=True, metavar="MODEL.json...")
@specification()
@click.option(
    "--kp-range",
    type=finite,
    nargs=2,
    metavar="LOW HIGH",
    help="Proportional gains of the map.  [default: 0.2 to 2.5 times --kp]",
)
@click.option("--count", type=click.IntRange(2, 1000), default=100, show_default=True, help="Gains of each kind.")
@click.option("--out", required=True, metavar="FILE.png|.svg", help="The picture to write.")
@json_option
def map_(
    model_files: tuple[str, ...],
    spec: SpecOptions,
    kp_range: tuple[float, float] | None,
    count: int,
    out: str,
    json_file: str | None,
) -> int:
    """Draw settling time, overshoot and noise over both gains.

    With the region that meets the specification, the pair in it that makes the least noise, and the gain that
    `servolens design` recommends for --kp, unless it is withheld there. With several models each pair shows the worst
    of them. --kd-max is the end of the map. Exit status 1 if no pair of the map meets the specification.
    """
    check_outputs({"--out": out, "--json": json_file}, model_files)
    from servolens.design import PDSpec, gain_map, map_axes, recommend, trust, tune
    from servolens.report.map_picture import checked_kind, write_map
    from servolens.summaries import map_summary

    checked_kind(Path(out))
    models = load_models(model_files)
    wanted = _stepping(PDSpec(**spec.given), spec, models)
    plants = [model.plant for model in models]
    units = {"length_unit": plants[0].length_unit, "command_unit": plants[0].command_unit}
    axes = map_axes(plants, wanted, kp=kp_range, count=count)
    with progress_bar() as progress, about(*model_files):
        progress("Simulating pairs of gains", 0, 0)
        found = gain_map(plants, wanted, *axes)
        designed = recommend(models, tune(plants, wanted, progress=progress))
        _, light = trust(models, designed)
        chosen = None if light.light == "red" else designed.recommended
        pair = None if chosen is None else (chosen.kp, chosen.kd)
        with writing(Path(out)):
            write_map(Path(out), found, recommended=pair, **units)
    summary = map_summary(found, recommended=pair, light=light, **units)
    if json_file:
        recommended = None if pair is None else {"kp": pair[0], "kd": pair[1]}
        body = {
            **found.to_json(),
            "recommended": recommended,
            "light": light.to_json(),
            "model_files": list(model_files),
        }
        write_json(json_file, "map", body, summary.findings)
    show(summary, json_file)
    click.echo(f"Wrote {out}", err=json_file == STANDARD_OUTPUT)
    return 0 if found.feasible.any() else 1


def _stepping(wanted: PDSpec, spec: SpecOptions, models: Sequence[Model]) -> PDSpec:
    """Return the spec with the step of the records, where none is given."""
    if "reference" in spec.given:
        return wanted
    return replace(wanted, reference=_step_of_records(models) or wanted.reference)


def _step_of_records(models: Sequence[Model]) -> float | None:
    """Return the largest step that all models have seen, to three digits; None where it is not known."""
    steps = [model.evidence.range.step for model in models if model.evidence is not None]
    return float(f"{min(steps):.3g}") if steps else None
