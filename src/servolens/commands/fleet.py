"""The command on many axes: fleet."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import click

from servolens.commands.files import check_outputs
from servolens.commands.options import (
    Documented,
    Recordings,
    SpecOptions,
    effort_option,
    finite,
    json_option,
    prior_option,
    recordings,
    specification,
    stacked,
)
from servolens.commands.terminal import progress_bar, show
from servolens.results import STANDARD_OUTPUT, write_json

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.commands.options import Command
    from servolens.fleet import Request

__all__ = ["fleet"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Means:
    """What a fleet may use, and how its table is written.

    Attributes
    ----------
    cores : int, optional
        Processors; all when None.
    dask : str, optional
        Address of a Dask scheduler.
    time_limit, memory_limit : float
        Of one axis [s], [MiB].
    retry, plain : bool
        Whether failed axes are studied again, whether the table is CSV.
    """

    cores: int | None
    dask: str | None
    time_limit: float
    memory_limit: float
    retry: bool
    plain: bool


MEANS = (
    click.option("--cores", type=click.IntRange(min=1), metavar="N", help="Processors to use.  [default: all]"),
    click.option("--dask", metavar="ADDRESS", help="Study the axes on the Dask cluster with this scheduler."),
    click.option(
        "--time-limit",
        type=finite,
        metavar="NUMBER",
        default=3600,
        show_default=True,
        help="Longest time for one axis [s].",
    ),
    click.option(
        "--memory-limit",
        type=finite,
        metavar="NUMBER",
        default=4096,
        show_default=True,
        help="Largest memory of one axis [MiB].",
    ),
    click.option("--retry", is_flag=True, help="Study axes again that failed."),
    click.option("--csv", "plain", is_flag=True, help="Write the table as CSV even if Parquet is possible."),
)


def _means(command: Command) -> Command:
    """Give a command these options, as one ``means``."""

    @wraps(command)
    def run(**options: Any) -> int:
        chosen = Means(**{field.name: options.pop(field.name) for field in fields(Means)})
        return command(means=chosen, **options)

    return stacked(run, MEANS)


@click.command(cls=Documented, epilog="servolens fleet axes --out results --settling-time 0.5")
@recordings(kp=("--record-kp",), kd=("--record-kd", "--kd"), folder=True)
@specification(required=(), of_records=True)
@prior_option
@effort_option
@click.option("--out", required=True, metavar="FOLDER", help="Results; created if needed. Finished axes are kept.")
@_means
@json_option
def fleet(
    recordings: Recordings,
    spec: SpecOptions,
    priors: tuple[tuple[str, float, float], ...],
    effort: str,
    out: str,
    means: Means,
    json_file: str | None,
) -> int:
    """Study every axis of a folder, each as `servolens tune` does.

    An axis is a sub-folder of records or a campaign TOML; dates in their names, or dated sub-folders, are measurements
    of the same axis. Writes a result and a page for each, one table, and fleet.html. Run the same command again to go
    on after an interruption. Without --settling-time each axis gets a specification that suits its records. Exit
    status 1 if an axis could not be studied.
    """
    if means.cores and means.dask:
        raise click.UsageError("--cores is for this machine; give --cores or --dask")
    if spec.given and "settling_time" not in spec.given:
        raise click.UsageError(f"--{next(iter(spec.given)).replace('_', '-')} needs --settling-time")
    check_outputs({"--json": json_file})
    from servolens.fleet import dask_executor, run_fleet
    from servolens.summaries import fleet_summary

    limits = {"time_limit": means.time_limit, "memory_limit": means.memory_limit}
    request = _request(recordings, spec, priors, effort=effort, **limits)
    cluster = dask_executor(means.dask) if means.dask else nullcontext()
    with progress_bar() as progress, _ended_gently(), cluster as executor:
        found = run_fleet(
            recordings.paths[0], out, request, executor=executor, cores=means.cores, retry=means.retry,
            plain_table=means.plain, progress=progress,
        )  # fmt: skip
    body = found.to_json()
    if json_file:
        write_json(json_file, "fleet", body)
    show(fleet_summary(body), json_file)
    click.echo(f"\nWrote {Path(out) / 'fleet.html'}", err=json_file == STANDARD_OUTPUT)
    return 1 if found.failed else 0


def _request(
    recordings: Recordings, spec: SpecOptions, priors: tuple[tuple[str, float, float], ...], **options: Any
) -> Request:
    from servolens.commands.files import priors_from
    from servolens.fleet import Request

    known = priors_from(priors)
    root = recordings.data_root
    return Request(
        spec=spec.given,
        settings=recordings.settings,
        columns=recordings.columns,
        units=recordings.units,
        priors={name: (prior.value, prior.deviation) for name, prior in known.items()},
        data_root=None if root is None else str(Path(root).absolute()),
        **options,
    )


@contextmanager
def _ended_gently() -> Iterator[None]:
    """Take the system's wish that this process ends for an interruption from the keyboard."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        with suppress(ValueError, TypeError):
            signal.signal(signal.SIGTERM, before)
