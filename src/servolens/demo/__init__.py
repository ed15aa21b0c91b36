"""The whole workflow on the virtual cart of the paper: records, models, Table I, designs, one page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servolens.demo.experiment import run_experiment
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["run_demo"]


def run_demo(folder: Path | str, *, progress: Callable[[str, int, int], None] | None = None) -> dict[str, Any]:
    """Run the paper's experiments on the virtual cart and write ``report.html`` and ``results.json``.

    Parameters
    ----------
    folder : Path or str
        Where; it is made, with its parents, if it does not exist.
    progress : callable, optional
        Called with (description, done, total).

    Returns
    -------
    dict
        The fields of ``servolens.demo/1`` without the file's header.

    Raises
    ------
    InputError
        If the folder cannot be made or written.
    """
    from servolens.demo.results import results_json
    from servolens.demo.story import write_story
    from servolens.results import write_json

    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target}: cannot be made ({(error.strerror or 'unknown error').lower()})") from None
    done = run_experiment(progress)
    body = results_json(done)
    write_story(target / "report.html", done)
    write_json(target / "results.json", "demo", body, done.findings)
    if progress is not None:
        progress("demo written", done.stages, done.stages)
    return body
