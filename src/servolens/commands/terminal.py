"""Summaries as text, and progress of what takes longer than a second."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from servolens.rendering import escaped, print_summary
from servolens.results import STANDARD_OUTPUT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console

    from servolens.summary import Summary

    Progress = Callable[[str, int, int], None]

__all__ = ["progress_bar", "show"]

BAR_COLUMNS, OTHER_COLUMNS = 20, 14
"""Columns of the bar, and of what stands beside it but for the description."""
DELAY = 1.0
"""Work that is done sooner shows no bar [s]."""


def show(summary: Summary, json_file: str | None = None) -> None:
    """Print `summary`: to standard output, or to standard error where the JSON takes that.

    Parameters
    ----------
    summary : Summary
        What to tell.
    json_file : str or None
        Where the JSON goes.
    """
    print_summary(_console(sys.stderr if json_file == STANDARD_OUTPUT else sys.stdout), summary)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a callable of (description, done, total); a bar appears on standard error if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda description, done, total: None
        return
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console = _console(sys.stderr)
    bar = Bar(
        SpinnerColumn(),
        BarColumn(bar_width=BAR_COLUMNS),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
        console=console,
        transient=True,
    )
    room = max(console.width - BAR_COLUMNS - OTHER_COLUMNS, 8)
    task = bar.add_task("Working", total=None)
    timer = threading.Timer(DELAY, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda description, done, total: bar.update(
            task, description=escaped(description)[:room], completed=done, total=total or None
        )
    finally:
        timer.cancel()
        timer.join()
        bar.stop()


def _console(stream: TextIO) -> Console:
    from rich.console import Console

    return Console(file=stream, highlight=False, markup=False, emoji=False)
