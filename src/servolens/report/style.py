"""How figures look: one palette (Okabe and Ito's, safe for colour-blind readers), one size of text."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes

    from servolens.report.curves import Role

__all__ = [
    "ALONE",
    "COLOURS",
    "FULL_WIDTH",
    "HALF_WIDTH",
    "LOOKS",
    "NAMED",
    "STYLE",
    "THIRD_WIDTH",
    "VARIABLES",
    "WIDE",
    "axes_of",
    "new_figure",
    "panel_figure",
    "stacked_figure",
    "styled",
]

P = ParamSpec("P")
R = TypeVar("R")

INK, GREY = "#222222", "#767676"
COLOURS = {
    "blue": "#0072B2",
    "vermilion": "#D55E00",
    "green": "#009E73",
    "purple": "#AA4499",
    "orange": "#E69F00",
    "sky": "#56B4E9",
}
LOOKS: dict[Role, dict[str, Any]] = {
    "measured": {"color": "#9a9a9a", "linewidth": 4.0, "linestyle": "-", "zorder": 1, "solid_capstyle": "round"},
    "reference": {"color": GREY, "linewidth": 0.9, "linestyle": (0, (5, 3)), "zorder": 1},
    "command": {"color": COLOURS["purple"], "linewidth": 1.3, "linestyle": "-", "zorder": 3},
    "constant": {"color": COLOURS["vermilion"], "linewidth": 1.5, "linestyle": (0, (5, 1.5)), "zorder": 3},
    "varying": {"color": COLOURS["green"], "linewidth": 1.5, "linestyle": (0, (4, 1, 1, 1)), "zorder": 3},
    "velocity": {"color": COLOURS["blue"], "linewidth": 1.5, "linestyle": "-", "zorder": 4},
    "diagnosed": {"color": COLOURS["green"], "linewidth": 1.5, "linestyle": (0, (6, 1, 1, 1)), "zorder": 5},
    "truth": {"color": "#c2c2c2", "linewidth": 4.0, "linestyle": "-", "zorder": 1, "solid_capstyle": "round"},
    "pieces": {"color": COLOURS["purple"], "linewidth": 1.4, "linestyle": (0, (2, 1.2)), "zorder": 3},
    "first": {"color": COLOURS["blue"], "linewidth": 1.5, "linestyle": "-", "zorder": 3},
    "second": {"color": COLOURS["orange"], "linewidth": 1.5, "linestyle": (0, (5, 1.5)), "zorder": 3},
    "third": {"color": COLOURS["purple"], "linewidth": 1.5, "linestyle": (0, (4, 1, 1, 1)), "zorder": 3},
}
"""What is measured or true is broad and pale, so that a model that fits lies visibly on it."""
MARGINS = (0.12, 0.47, 0.28)
"""Right, below and above a panel [inches]."""
VARIABLES = {
    "ffffff": "paper",
    INK[1:]: "ink",
    "000000": "ink",
    GREY[1:]: "grey",
    "e4e4e4": "line",
    "c2c2c2": "broad",
    "9a9a9a": "broad",
    "b9b9b9": "broad",
    **{colour[1:].lower(): name for name, colour in COLOURS.items()},
}
"""Colours of figures, and the page's variables that stand for them."""
FULL_WIDTH = 5.6
"""Inches of a figure for scripts and notebooks."""
NAMED, ALONE, WIDE, HALF_WIDTH, THIRD_WIDTH = 5.2, 4.9, 4.6, 3.75, 2.6
"""Inches of a figure of the page with names at its side, with two panels, with one, and of two and of three beside each
other where there is room. A phone shows the first at three quarters of its size."""
STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.titley": 1.0,  # where nothing is above the axes; to find that out takes a seventh of the drawing
    "axes.titleweight": "bold",
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "path.simplify": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "servolens",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
}


def styled(function: Callable[P, R]) -> Callable[P, R]:
    """Run `function` under :data:`STYLE`, whatever the user's own settings of matplotlib."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context(STYLE):
            return function(*args, **kwargs)

    return run


def new_figure(height: float, width: float = FULL_WIDTH) -> Figure:
    """Return an empty figure of this size [inches] that belongs to no window."""
    return Figure(figsize=(width, height), layout="constrained")


def panel_figure(height: float, width: float = FULL_WIDTH, left: float = 0.92) -> tuple[Figure, Axes]:
    """Return a figure of this size [inches] and its one panel, with room for its labels at the `left`.

    Room that is known beforehand is much sooner laid out than what has to be measured.
    """
    figure = Figure(figsize=(width, height))
    _leave_room(figure, left)
    return figure, figure.add_subplot()


def stacked_figure(height: float, width: float, ratio: float) -> tuple[Figure, Axes, Axes]:
    """Return a figure like :func:`panel_figure` with two panels, the upper one `ratio` times as high."""
    figure = Figure(figsize=(width, height))
    _leave_room(figure, 0.92)
    above, below = figure.subplots(2, 1, height_ratios=[ratio, 1.0], gridspec_kw={"hspace": 0.12})
    return figure, above, below


def _leave_room(figure: Figure, left: float) -> None:
    width, height = (float(size) for size in figure.get_size_inches())
    right, bottom, top = MARGINS
    figure.subplots_adjust(left=left / width, right=1.0 - right / width, bottom=bottom / height, top=1.0 - top / height)


def axes_of(ax: Axes | None, height: float = 3.0) -> Axes:
    """Return `ax`, or the axes of a new figure."""
    return new_figure(height).add_subplot() if ax is None else ax
