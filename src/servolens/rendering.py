"""A summary as text and as HTML; the page of a report is made by :mod:`servolens.report`."""

from __future__ import annotations

import re
from dataclasses import replace
from html import escape
from io import StringIO
from typing import TYPE_CHECKING

from servolens.findings import listed
from servolens.units import unit

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import Console

    from servolens.findings import Finding
    from servolens.summary import Summary, Table

__all__ = ["as_html", "as_text", "by_severity", "escaped", "grouped", "print_summary", "told_finding"]

NARROWEST_NAME = 12
"""Columns of text into which the first column may be folded."""
HEADING_WIDTHS = (40, 20, 12, 8, 0)
GUTTER = 3
STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def as_text(summary: Summary) -> str:
    """Return `summary` as plain text, as wide as the terminal."""
    from rich.console import Console

    stream = StringIO()
    print_summary(Console(file=stream, highlight=False, markup=False, emoji=False), summary)
    return stream.getvalue().rstrip()


def as_html(summary: Summary) -> str:
    """Return `summary` as a fragment of HTML, for notebooks."""
    parts = [f"<p><b>{escape(summary.title)}</b></p>"]
    parts += [f"<p>{escape(sentence)}</p>" for sentence in summary.sentences]
    for table in summary.tables:
        head = "".join(f"<th>{escape(name)}</th>" for name in table.columns)
        rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in table.rows)
        parts.append(
            f"<table><caption>{escape(table.title)}</caption>"
            f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        )
        parts += [f"<p>{escape(table.note)}</p>"] if table.note else []
    told = [f"<li>{escape(told_finding(finding))}</li>" for finding in by_severity(summary.findings)]
    return "\n".join([*parts, *([f"<ul>{''.join(told)}</ul>"] if told else [])])


def print_summary(console: Console, summary: Summary) -> None:
    """Print `summary` to `console`."""
    console.print(escaped(summary.title), style="bold")
    for sentence in summary.sentences:
        console.print(escaped(sentence))
    for table in summary.tables:
        console.print()
        _print_table(console, table)
    if summary.findings:
        console.print()
    for finding in by_severity(summary.findings):
        console.print(escaped(told_finding(finding)), style=STYLES[finding.severity])


def told_finding(finding: Finding) -> str:
    """Return a finding in one line."""
    about = f"{finding.record}: " if finding.record else ""
    return f"{finding.severity}: {about}{finding.message}"


def escaped(text: str) -> str:
    """Return `text` with everything that would move the cursor or hide text spelled out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


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
        room = console.width - sum(GUTTER + width for width in _widths(headings, cells)[1:])
        for first, *others in cells:
            grid.add_row("\n".join(_broken(first, room)), *others)
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
    own = _widths([""] * len(columns), cells)
    for most in HEADING_WIDTHS:
        broken = [
            _broken(name, max(cell, most)) if most else name.split() for name, cell in zip(columns, own, strict=True)
        ]
        headings = ["\n".join(lines) for lines in broken]
        first, *others = _widths(headings, cells)
        if sum(GUTTER + width for width in others) + min(first, NARROWEST_NAME) <= room:
            return headings
    return None


def _widths(headings: list[str], cells: list[list[str]]) -> list[int]:
    """Return the room that each column takes."""
    from rich.cells import cell_len

    return [
        max(cell_len(text) for text in (*heading.split("\n"), *(row[i] for row in cells)))
        for i, heading in enumerate(headings)
    ]


def _broken(heading: str, width: int) -> list[str]:
    """Break a heading or a row's name between words; a unit in brackets stays whole."""
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


def grouped(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings as people are told them: each once, of all records of which it is true, units with exponents.

    Parameters
    ----------
    findings : iterable of Finding
        In the order in which they are told.

    Examples
    --------
    >>> from servolens.findings import Finding
    >>> found = grouped(Finding(code="gaps", severity="note", message="gaps.", record=name) for name in "abc")
    >>> [finding.record for finding in found]
    ['a, b and c']
    """
    records: dict[tuple[Finding, bool], list[str]] = {}  # what is true of the whole campaign is told of no record
    for finding in dict.fromkeys(findings):
        key = replace(finding, record=None), finding.record is None
        records.setdefault(key, []).extend([finding.record] if finding.record else [])
    return tuple(
        replace(finding, record=listed(names) if names else None, message=unit(finding.message))
        for (finding, _), names in records.items()
    )


def by_severity(findings: tuple[Finding, ...]) -> list[Finding]:
    """Return each finding once, with all records of which it is true, the worst first."""
    order = list(STYLES)
    return sorted(grouped(findings), key=lambda finding: order.index(finding.severity))
