"""One self-contained HTML page: no address, no script, nothing to load."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from servolens import __version__
from servolens.results import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.report.content import Findings, Lights, Section

__all__ = ["render_page", "write_page"]

FOLDER = Path(__file__).parent


def write_page(
    path: Path, title: str, lead: str, more: Sequence[str | Findings | Lights], sections: Sequence[Section]
) -> None:
    """Write the page of :func:`render_page`, whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    write_atomically(path, render_page(title, lead, more, sections).encode("utf-8", "replace"))


def render_page(title: str, lead: str, more: Sequence[str | Findings | Lights], sections: Sequence[Section]) -> str:
    """Return the page.

    Parameters
    ----------
    title : str
        Heading and name of the window.
    lead : str
        The most important sentence.
    more : sequence of str, Findings or Lights
        What follows it at once.
    sections : sequence of Section
        In order; their titles are the table of contents.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(FOLDER), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    made = f"Made by servolens {__version__} on {datetime.now(UTC):%Y-%m-%d %H:%M} UTC."
    numbers = count(1)
    return environment.get_template("page.html").render(
        title=title,
        lead=lead,
        more=more,
        sections=sections,
        made=made,
        counter=lambda: next(numbers),
        kind_of=lambda block: type(block).__name__,
    )
