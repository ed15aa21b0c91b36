"""Summaries as text, and progress of what takes longer than a second."""

from __future__ import annotations

import re
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from servolens.results import STANDARD_OUTPUT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console

    from servolens.findings import Finding
    from servolens.summary import Summary, Table

    Progress = Callable[[str, int, int], None]

__all__ = ["escaped", "progress_bar", "show"]

BAR, BESIDE = 20, 14
"""Columns of the bar, and of what stands beside it but for the description."""
DELAY = 1.0
"""Work that is done sooner shows no bar [s]."""
NARROWEST_NAME = 12
"""Columns of text into which the first column may be folded."""
HEADING_WIDTHS = (40, 20, 12, 8, 0)
GUTTER = 3
STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def show(summary: Summary, json_file: str | None = None) -> None:
    """Print `summary`: to standard output, or to standard error where the JSON takes that.

    Parameters
    ----------
    summary : Summary
        What to tell.
    json_file : str or None
        Where the JSON goes.
    """
    console = _console(sys.stderr if json_file == STANDARD_OUTPUT else sys.stdout)
    console.print(escaped(summary.title), style="bold")
    for sentence in summary.sentences:
        console.print(escaped(sentence))
    for table in summary.tables:
        console.print()
        _print_table(console, table)
    if summary.findings:
        console.print()
    for finding in _by_severity(summary.findings):
        about = f"{finding.record}: " if finding.record else ""
        console.print(escaped(f"{finding.severity}: {about}{finding.message}"), style=STYLES[finding.severity])


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
        BarColumn(bar_width=BAR),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
        console=console,
        transient=True,
    )
    room = max(console.width - BAR - BESIDE, 8)
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


def escaped(text: str) -> str:
    """Return `text` with everything that would move the cursor or hide text spelled out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def _console(stream: TextIO) -> Console:
    from rich.console import Console

    return Console(file=stream, highlight=False, markup=False, emoji=False)


def _print_table(console: Console, table: Table) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid

    cells = [[escaped(cell) for cell in row] for row in table.rows]
    console.print(escaped(table.title), style="bold")
    headings = _headings(table.columns, cells, console.width)
    if headings is None:
        _print_blocks(console, table.columns, cells)
    else:
        grid = Grid(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
        for i, heading in enumerate(headings):
            numeric = i > 0 and all(_is_number(row[i]) for row in cells)
            grid.add_column(heading, no_wrap=i > 0, justify="right" if numeric else "left", overflow="fold")
        for row in cells:
            grid.add_row(*row)
        console.print(grid)
    if table.note:
        console.print(escaped(table.note))


def _print_blocks(console: Console, columns: tuple[str, ...], cells: list[list[str]]) -> None:
    """Print a table that is too wide for the screen row by row."""
    for row in cells:
        console.print(row[0])
        for name, cell in zip(columns[1:], row[1:], strict=True):
            console.print(f"  {name}: {cell}")


def _headings(columns: tuple[str, ...], cells: list[list[str]], room: int) -> list[str] | None:
    """Return the headings, broken between words only as far as the screen demands; None if no table fits."""
    from rich.cells import cell_len

    for most in HEADING_WIDTHS:
        headings, total = [], -GUTTER
        for i, name in enumerate(columns):
            cell = max((cell_len(row[i]) for row in cells), default=0)
            lines = _broken(name, max(cell, most)) if most else name.split() or [""]
            headings.append("\n".join(lines))
            width = max(cell, *(cell_len(line) for line in lines))
            total += GUTTER + (min(width, NARROWEST_NAME) if i == 0 else width)
        if total <= room:
            return headings
    return None


def _broken(heading: str, width: int) -> list[str]:
    """Break a heading between words; a unit in brackets stays whole."""
    lines = [""]
    for word in re.findall(r"\[[^\]]*\]|\S+", heading):
        together = f"{lines[-1]} {word}".strip()
        if len(together) <= width or not lines[-1]:
            lines[-1] = together
        else:
            lines.append(word)
    return lines


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell in ("–", "")
    return True


def _by_severity(findings: tuple[Finding, ...]) -> list[Finding]:
    order = list(STYLES)
    return sorted(dict.fromkeys(findings), key=lambda finding: order.index(finding.severity))
