"""Commands that write a page: demo, report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from servolens.commands.files import about, check_outputs, check_page, load_records, writing
from servolens.commands.options import (
    Documented,
    Recordings,
    SpecOptions,
    effort_option,
    json_option,
    recordings,
    specification,
)
from servolens.commands.terminal import progress_bar, show
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.results import STANDARD_OUTPUT, write_json

__all__ = ["demo", "report"]


@click.command(cls=Documented, epilog="servolens demo --out servolens-demo")
@click.option("--out", default="servolens-demo", show_default=True, metavar="DIR", help="Folder; created if needed.")
@json_option
def demo(out: str, json_file: str | None) -> int:
    """Run the whole workflow on the built-in virtual cart.

    Three step records and the eight gain pairs of a published table; models, their prediction errors, figures and the
    design comparison; then an axis in which the laboratory hides an effect, found from its records and designed on. As
    DIR/report.html and DIR/results.json.
    """
    folder = Path(out)
    if not out.strip() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{out or '--out'}: is not a folder; name one, it is created if needed")
    check_outputs({"--json": json_file})
    from servolens.demo import run_demo
    from servolens.summaries import demo_summary, hidden_summary

    with progress_bar() as progress, writing(folder):
        body = run_demo(folder, progress=progress)
    if json_file:
        told = json.loads((folder / "results.json").read_text(encoding="utf-8"))["findings"]
        write_json(json_file, "demo", body, [Finding(**finding) for finding in told])
    show(demo_summary(body, out), json_file)
    click.echo(err=json_file == STANDARD_OUTPUT)
    show(hidden_summary(body), json_file)
    return 0


@click.command(cls=Documented, epilog="servolens report kp60.csv --kp 100 --settling-time 0.5 --out report.html")
@recordings(kp=("--record-kp",), kd=("--record-kd", "--kd"))
@specification(required=(), of_records=True)
@effort_option
@click.option("--out", required=True, metavar="FILE.html|.pdf", help="The page to write; PDF by Chromium.")
@json_option
def report(recordings: Recordings, spec: SpecOptions, effort: str, out: str, json_file: str | None) -> int:
    """Write everything about the records into one self-contained page.

    All that `servolens tune` finds, with --kp and --settling-time or for a specification that suits the records.
    Without --settling-time, --kp and --kd are the gains of the loop that made the records.
    """
    recordings, wanted = _split(recordings, spec)
    outputs = {"--out": out, "--json": json_file}
    check_outputs(outputs, recordings.paths)
    check_page(out)
    from servolens.report import write_report
    from servolens.study import completed_spec

    with progress_bar() as progress:
        records = load_records(recordings, outputs, progress)
        spec_wanted = completed_spec(records, wanted) if wanted else None
        with about(*recordings.paths), writing(Path(out)):
            body = write_report(Path(out), records, spec=spec_wanted, effort=effort, progress=progress)
    if json_file:
        write_json(json_file, "report", body, [Finding(**finding) for finding in body["findings"]])
    click.echo(f"Wrote {out}", err=json_file == STANDARD_OUTPUT)
    return 0


def _split(recordings: Recordings, spec: SpecOptions) -> tuple[Recordings, dict[str, Any]]:
    """Tell the gains that made the records from the gain to design for."""
    given = dict(spec.given)
    if "settling_time" in given:
        if "kp" not in given:
            raise click.UsageError("--settling-time needs --kp, the proportional gain to design for")
        return recordings, given
    kp = given.pop("kp", None)
    if given:
        raise click.UsageError(f"--{next(iter(given)).replace('_', '-')} needs --kp and --settling-time")
    if kp is not None and "kp" not in recordings.settings:
        recordings = replace(recordings, settings={"kp": kp, **recordings.settings})
    return recordings, {}
