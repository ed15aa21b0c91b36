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

from servolens.report.style import VARIABLES, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["formula_svg", "svg", "with_shared_letters"]

ADDRESSES = re.compile(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"')
PATH = re.compile(r'(?<=\sd=")[^"]+')
LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
ID_ATTRIBUTE = re.compile(r'\sid="([^"]+)"')
COLOUR = re.compile(r"(?<=: )#([0-9a-f]{6})\b")
LETTER = re.compile(r'<path id="letter-[^"]+" d="[^"]*" transform="scale\([\d.]+\)"/>')
PLACE = re.compile(r'(?<=\s)(x|y)="(-?\d+\.\d{3,})"')
LINE_COMMANDS = {"M", "L"}
GROWTH = 1.25
"""How far a picture may be enlarged where there is room."""
SCRIPT_PREFIXES = ("panel-", "axis-", "live-", "xtick_", "ytick_")
"""How names begin that the page's script looks for."""
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
    style = f' style="max-width:{GROWTH * float(width[1]) / 72:.2f}in"' if width else ""
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


def with_shared_letters(html: str) -> str:
    """Return a page whose figures draw their letters from one place, in front of its text, instead of each its own."""
    letters = dict.fromkeys(LETTER.findall(html))
    shared = f'<svg class="letters" aria-hidden="true" focusable="false"><defs>{"".join(letters)}</defs></svg>'
    return LETTER.sub("", html).replace("<body>", f"<body>\n{shared}" if letters else "<body>", 1)


def _tidy(body: str, key: str) -> str:
    """Drop names that nothing refers to, give the others a prefix, and write coordinates to a hundredth of a point.

    Names that the page's script knows become classes; letters have one name everywhere; colours become the page's
    variables, for dark screens.
    """
    used = set(USES.findall(body))
    letters = {name for name in used if re.search(rf'id="{re.escape(name)}" d="[^"]*" transform="scale', body)}
    body = ID_ATTRIBUTE.sub(lambda m: f' id="{_prefix(m[1], key, letters)}"' if m[1] in used else _known(m[1]), body)
    body = USES.sub(lambda m: f"{m[0][: -len(m[1])]}{_prefix(m[1], key, letters)}", body)
    body = COLOUR.sub(lambda m: f"var(--{VARIABLES[m[1]]})" if m[1] in VARIABLES else m[0], body)
    body = PATH.sub(lambda m: _short_path(m[0]), body)
    body = PLACE.sub(lambda m: f'{m[1]}="{_hundredths(float(m[2]))}"', body)
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    return re.sub(r">\s+<", "><", body)


def _prefix(name: str, key: str, letters: set[str]) -> str:
    return f"letter-{name}" if name in letters else f"{key}-{name}"


def _short_path(text: str) -> str:
    """Return a path to a hundredth of a point; where it is nothing but straight lines, by differences."""
    tokens = text.split()
    if not LINE_COMMANDS.issuperset(t for t in tokens if t.isalpha()) or len(tokens) % 3:
        return LONG_NUMBER.sub(lambda n: _hundredths(float(n[0])), " ".join(tokens))
    parts, x, y = [], 0, 0
    for pen, a, b in zip(*[iter(tokens)] * 3, strict=True):
        new = round(100 * float(a)), round(100 * float(b))
        if pen == "M":
            parts.append(f"M{_hundredths(new[0] / 100)} {_hundredths(new[1] / 100)}")
        else:
            right, down = (_hundredths(step / 100) for step in (new[0] - x, new[1] - y))
            parts.append(f"l{right}{'' if down.startswith('-') else ' '}{down}")
        x, y = new
    return "".join(parts)


def _hundredths(value: float) -> str:
    """Return a coordinate without what it need not say."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text.replace("0.", ".", 1) if abs(value) < 1 else text


def _known(name: str) -> str:
    """Return the class that a name of :mod:`servolens.report.drawing` becomes."""
    return f' class="{name}"' if name.startswith(SCRIPT_PREFIXES) else ""
