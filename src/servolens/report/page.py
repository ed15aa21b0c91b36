"""One self-contained HTML page: no address, nothing to load, and whole where no script runs."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from datetime import UTC, datetime
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servolens import __version__
from servolens.rendering import by_severity
from servolens.report.content import Details, Drawing, Playground
from servolens.report.printing import checked_page, printed
from servolens.report.simulated import plants_script, simulator_script
from servolens.report.style import HALF_WIDTH, THIRD_WIDTH
from servolens.report.svg import with_shared_letters
from servolens.results import write_atomically

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from servolens.report.content import Block, Findings, Lights, Section
    from servolens.summary import Table

__all__ = ["render_page", "write_page"]

FOLDER = Path(__file__).parent
PHONE, TABLET, GUTTER, UNBROKEN = 42, 92, 2, 12
"""Letters that a row of a table has room for; what the edge of a column takes; what is not broken between words."""
BEFORE_UNIT = re.compile(r"(?<=\d) (?=(?:%|[nµmk]?(?:m|s|rad|V|A|N|Hz)\b))|(?<=\d [VAN]) (?=s/)")
RANGE = re.compile(r"(?<=\d)–(?=\d)")


def write_page(
    path: Path, title: str, lead: str, more: Sequence[str | Findings | Lights], sections: Sequence[Section]
) -> None:
    """Write the page of :func:`render_page`, whole or not at all; where `path` ends in ``.pdf``, printed.

    Raises
    ------
    InputError
        If the file cannot be written, its name ends otherwise than in .html or .pdf, or a PDF cannot be printed.
    """
    checked_page(path)
    html = render_page(title, lead, more, sections)
    content = printed(html) if path.suffix.lower() == ".pdf" else html.encode("utf-8", "replace")
    write_atomically(path, content)


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
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=_unbroken,
    )
    made = f"Made by servolens {__version__} on {datetime.now(UTC):%Y-%m-%d %H:%M} UTC."
    count_up = count(1)
    scripts = _scripts(sections)
    html = environment.get_template("page.html").render(
        title=title,
        lead=lead,
        more=more,
        sections=sections,
        made=made,
        css=(FOLDER / "page.css").read_text(encoding="utf-8"),
        scripts=scripts,
        policy=_policy(scripts),
        counter=lambda: next(count_up),
        kind_of=lambda block: type(block).__name__,
        breadth=_breadth,
        size=_size,
        numbers=_numbers,
        inert=_inert,
        by_severity=by_severity,
    )
    return with_shared_letters(html)


def _unbroken(value: Any) -> Any:
    """Return a text whose lines do not break between a number and its unit, nor within a range of numbers."""
    if type(value) is not str:  # what is safe is no text
        return value
    kept = BEFORE_UNIT.sub("\u00a0", value)
    return RANGE.sub("\u2060–\u2060", kept)


def _scripts(sections: Sequence[Section]) -> list[str]:
    """Return the page's scripts: none where there is no figure, the simulator only where there are sliders."""
    blocks = [block for section in sections for block in _all(section.blocks)]
    if not any(isinstance(block, Drawing | Playground) for block in blocks):
        return []
    found = [_script("figures.js")]
    plants = dict(plant for block in blocks if isinstance(block, Playground) for plant in block.plants)
    if plants:
        found += [simulator_script() + plants_script([*plants.items()]) + _script("sliders.js")]
    return found


def _all(blocks: Iterable[Block]) -> Iterator[Block]:
    """Return the blocks and those that are folded away in them."""
    for block in blocks:
        yield block
        if isinstance(block, Details):
            yield from _all(block.blocks)


def _script(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def _policy(scripts: Sequence[str]) -> str:
    """Return the page's content security policy: it loads nothing, and runs its own scripts only.

    Its scripts evaluate no text; tools that test pages do, and may.
    """
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join((*(f"'sha256-{value}'" for value in hashes), "'unsafe-eval'")) if hashes else "'none'"
    return f"default-src 'none'; style-src 'unsafe-inline'; script-src {allowed}; base-uri 'none'; form-action 'none'"


def _numbers(drawing: Drawing) -> str:
    """Return what the page's script has to know of a figure, as JSON inside a page."""
    table = None if drawing.table is None else drawing.table.to_json()
    pictures = [[panel.to_json() for panel in picture.panels] for picture in drawing.pictures]
    told = {"name": drawing.name, "pictures": pictures, **({} if table is None else {"table": table})}
    return _inert(json.dumps(told, separators=(",", ":"), ensure_ascii=False, allow_nan=False))


def _inert(text: str) -> str:
    """Return JSON in which no browser can find the end of the element that it stands in."""
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _size(drawing: Drawing) -> str:
    """Return the class of a figure, by how many of its pictures stand beside each other."""
    width = drawing.pictures[0].width
    if not width or width > HALF_WIDTH:
        return " full"
    return " third" if width <= THIRD_WIDTH else " half"


def _least_room(text: str) -> int:
    """Return how many letters of a cell have to stand in one line: its longest word, or all where they are few."""
    return max(min(len(text), UNBROKEN), *(len(word) for word in text.split() or [""]))


def _breadth(table: Table) -> str:
    """Return the class of a table that needs more room than a phone or a tablet has, by its longest words."""
    columns = zip(table.columns, *table.rows, strict=True)
    letters = sum(max(_least_room(text) for text in column) + GUTTER for column in columns)
    return " broad wide" if letters > TABLET else " wide" if letters > PHONE else ""
