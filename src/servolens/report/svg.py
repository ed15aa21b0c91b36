"""Figures as text that stands inside a page."""

from __future__ import annotations

import io
import re
import warnings
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import MathTextParser

from servolens.report.style import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["formula_svg", "svg"]

ADDRESSES = re.compile(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"')
PATH = re.compile(r'(?<=\sd=")[^"]+')
LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
NAMES = re.compile(r'\sid="([^"]+)"')
USES = re.compile(r'(?:href="#|url\(#)([^")]+)')


@styled
def svg(figure: Figure, key: str) -> str:
    """Return `figure` as an ``<svg>`` element: letters as outlines, so that it looks the same everywhere.

    Parameters
    ----------
    figure : Figure
        To be drawn.
    key : str
        Prefix of the names inside, which share the page with those of other figures.
    """
    buffer = io.StringIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a box stands in a name's place
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<defs>\s*<style.*?</style>\s*</defs>", "", text, flags=re.DOTALL)
    head, body = text.split(">", 1)
    width = re.search(r'width="([\d.]+)pt"', head)
    head = re.sub(r'\s(?:width|height)="[^"]*"', "", ADDRESSES.sub("", head))
    style = f' style="max-width:{float(width[1]) / 72:.2f}in"' if width else ""
    return f'{head} aria-hidden="true" focusable="false"{style}>{_tidy(body, key)}'


@styled
def formula_svg(latex: str, key: str) -> str:
    """Return a formula, written in the part of LaTeX that matplotlib knows, as an ``<svg>`` element."""
    with mpl.rc_context({"text.parse_math": True, "mathtext.fontset": "stix"}):
        font = FontProperties(size=14)
        width, height, depth, *_ = MathTextParser("path").parse(f"${latex}$", dpi=72, prop=font)
        figure = new_figure((height + 6) / 72, (width + 4) / 72)
        figure.set_layout_engine("none")
        figure.text(2 / (width + 4), (depth + 3) / (height + 6), f"${latex}$", fontproperties=font, va="baseline")
        return svg(figure, key)


def _tidy(body: str, key: str) -> str:
    """Drop names that nothing refers to, give the others a prefix, and write coordinates to a hundredth of a point."""
    used = set(USES.findall(body))
    body = NAMES.sub(lambda m: f' id="{key}-{m[1]}"' if m[1] in used else "", body)
    body = re.sub(r'(href="#|url\(#)', rf"\g<1>{key}-", body)
    body = PATH.sub(lambda m: LONG_NUMBER.sub(lambda n: f"{float(n[0]):.2f}", m[0]), body)
    return re.sub(r"<!--.*?-->\s*", "", body, flags=re.DOTALL)
