"""What a page is made of: sections of sentences, tables, figures and summaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design import Light
    from servolens.findings import Finding

__all__ = ["Block", "Details", "Drawing", "Findings", "Lights", "Section"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """A figure with its caption.

    Parameters
    ----------
    svg : str
        An ``<svg>`` element, made by :mod:`servolens.report.svg`.
    caption : str
        What one sees, and whether the data are held out; also read aloud in the figure's place.
    formula : bool
        Whether it is a displayed formula; then `caption` is the formula in words.
    """

    svg: str
    caption: str
    formula: bool = False


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Details:
    """Blocks that are folded away on the screen behind one line.

    Parameters
    ----------
    title : str
        The line.
    blocks : tuple of Block
        What it hides.
    """

    title: str
    blocks: tuple[Block, ...]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Warnings and notes, told where they stand.

    Parameters
    ----------
    findings : tuple of Finding
        Worst first.
    """

    findings: tuple[Finding, ...]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Lights:
    """How far data, model and gain can be trusted.

    Parameters
    ----------
    lights : mapping of str to Light
        In order.
    """

    lights: Mapping[str, Light]


Block = str | Summary | Table | Drawing | Details | Findings | Lights
"""A ``str`` is a paragraph of plain text."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of the page.

    Parameters
    ----------
    key : str
        Its anchor.
    title : str
        Its heading, and its line in the table of contents.
    blocks : tuple of Block
        In order.
    """

    key: str
    title: str
    blocks: tuple[Block, ...]
