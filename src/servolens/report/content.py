"""What a page is made of: sections of sentences, tables, figures and summaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design import Light
    from servolens.findings import Finding
    from servolens.report.figure_data import Numbers, Panel

__all__ = ["Block", "Details", "Drawing", "Findings", "Key", "Lights", "Picture", "Playground", "Section"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One of the pictures of a figure.

    Parameters
    ----------
    svg : str
        An ``<svg>`` element, made by :mod:`servolens.report.svg`.
    panels : tuple of Panel
        What is drawn in it, as numbers.
    width : float
        Inches at which its text has the size of the page's small text; 0 is that of the page.
    """

    svg: str
    panels: tuple[Panel, ...] = ()
    width: float = 0.0


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """An entry of a legend.

    Parameters
    ----------
    label : str
        Of the line or the mark.
    svg : str
        The line or the mark.
    """

    label: str
    svg: str


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """A figure with its caption.

    Parameters
    ----------
    pictures : tuple of Picture
        Beside each other, or below each other where there is no room.
    caption : str
        What one sees, and whether the data are held out; also read aloud in the figure's place.
    legend : tuple of Key
        Of all pictures.
    name : str
        Of the file with the figure's numbers, without its ending.
    table : Table or None
        The figure's numbers where they are not curves.
    formula : bool
        Whether it is a displayed formula; then `caption` is the formula in words.
    """

    pictures: tuple[Picture, ...]
    caption: str
    legend: tuple[Key, ...] = ()
    name: str = "figure"
    table: Numbers | None = None
    formula: bool = False


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Playground:
    """A figure that follows sliders for the gains, where the browser runs scripts.

    Parameters
    ----------
    drawing : Drawing
        As it is without them.
    data : str
        What the script has to know, as JSON.
    plants : tuple of (str, str)
        Names and JavaScript of the equations of motion that it needs.
    """

    drawing: Drawing
    data: str
    plants: tuple[tuple[str, str], ...]


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


Block = str | Summary | Table | Drawing | Playground | Details | Findings | Lights
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
