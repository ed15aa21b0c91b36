"""The command convert: from logs of any form to a campaign that states how they are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from servolens.commands.files import load_logs, writing
from servolens.commands.options import Documented, Recordings, json_option, recordings
from servolens.commands.terminal import progress_bar, show
from servolens.results import write_json

__all__ = ["convert"]


@click.command(cls=Documented, epilog="servolens convert run1.xlsx run2.xlsx --out campaign.toml")
@recordings()
@click.option(
    "--out", metavar="FILE", required=True, help="Write the campaign (.toml); logs outside its folder are copied."
)
@json_option
def convert(recordings: Recordings, out: str, json_file: str | None) -> int:
    """Guess how logs are to be read, show the evidence, write it down.

    Columns, units and gains are guessed as in every command. Where two readings are plausible, the command asks which
    one is right: answer with --column, --unit or --setting. The campaign states everything: nothing is guessed again.
    """
    from servolens.conversion import write_campaign
    from servolens.summaries import reading_summary

    if not out.lower().endswith(".toml"):
        raise click.UsageError(f"--out {out[:40]} is no .toml file; commands know a campaign by that name")
    with progress_bar() as progress:
        logs = load_logs(recordings, {"--out": out, "--json": json_file}, progress)
    readings = [log.reading for log in logs]
    with writing(Path(out)):
        copied = write_campaign(logs, Path(out))
    summary = reading_summary(readings)
    if json_file:
        rows = [
            {"name": r.record.name, "source": r.record.source, "guesses": [g.to_json() for g in r.guesses]}
            for r in readings
        ]
        write_json(json_file, "conversion", {"campaign": out, "records": rows}, summary.findings)
    beside = f" and copied {len(copied)} log{'s' if len(copied) > 1 else ''} beside it" if copied else ""
    show(replace(summary, sentences=(*summary.sentences, f"Wrote {out}{beside}.")), json_file)
    return 0
