"""From matplotlib's figures to a figure of the page: pictures, legend, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from servolens.report.content import Drawing, Key, Picture
from servolens.report.figure_data import panels_of
from servolens.report.style import VARIABLES
from servolens.report.svg import svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from servolens.report.figure_data import Numbers

__all__ = ["drawing", "keys_from", "keys_of", "legend_of"]

LENGTH, HEIGHT = 34, 12
"""Of a sample in a legend, in the page's pixels."""
LARGEST_MARK, PIXELS = 7.5, 96 / 72
"""Largest mark there, in points; pixels in a point."""


def drawing(
    key: str,
    figures: Figure | Sequence[Figure],
    caption: str,
    *,
    legend: Sequence[Key] = (),
    table: Numbers | None = None,
) -> Drawing:
    """Return a figure of the page.

    Parameters
    ----------
    key : str
        Its name, unique in the page.
    figures : Figure or sequence of Figure
        Its pictures.
    caption : str
        Below it.
    legend : sequence of Key
        Above it; a picture may have its own instead.
    table : Numbers, optional
        Its numbers, where they are not the lines that were drawn.
    """
    given = list(figures) if isinstance(figures, Sequence) else [figures]
    pictures = []
    for i, figure in enumerate(given):
        _name_parts(figure)
        text = svg(figure, f"{key}-{i}" if len(given) > 1 else key)
        width = float(figure.get_size_inches()[0]) if len(given) > 1 else 0.0
        pictures.append(Picture(svg=text, panels=panels_of(figure), width=width))
    return Drawing(pictures=tuple(pictures), caption=caption, legend=tuple(legend), name=key, table=table)


def _name_parts(figure: Figure) -> None:
    """Give names to the parts that the page's script moves; see :mod:`servolens.report.svg`."""
    axes = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    for i, ax in enumerate(axes):
        ax.set_gid(f"panel-{i}")
        ax.xaxis.set_gid("axis-x")
        ax.yaxis.set_gid("axis-y")


def keys_of(*axes: Axes) -> list[Key]:
    """Return the legend of these axes: each label once, with a sample of its line, mark or patch."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return keys_from(found)


def legend_of(ax: Axes) -> list[Key]:
    """Return the legend of these axes, and take it out of the picture."""
    found, drawn = keys_of(ax), ax.get_legend()
    if drawn is not None:
        drawn.remove()
    return found


def keys_from(handles: Mapping[str, Any]) -> list[Key]:
    """Return the legend of these artists of matplotlib by their labels."""
    return [Key(label=label, svg=_sample(handle)) for label, handle in handles.items()]


def _sample(handle: Any) -> str:
    from matplotlib.container import ErrorbarContainer
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(handle, ErrorbarContainer):
        handle = handle.lines[0]
    parts = _of_line(handle) if isinstance(handle, Line2D) else _of_patch(handle)
    if isinstance(handle, Patch) and not handle.get_fill():
        parts = _stroke(_paint(handle.get_edgecolor()), float(handle.get_linewidth()))
    size = f'viewBox="0 0 {LENGTH} {HEIGHT}" width="{LENGTH}" height="{HEIGHT}"'
    return f'<svg {size} aria-hidden="true" focusable="false">{parts}</svg>'


def _of_line(line: Any) -> str:
    colour = _paint(line.get_color())
    parts = ""
    if line.get_linestyle() not in ("None", "none", "", " "):
        width = float(line.get_linewidth())
        dashes = line._unscaled_dash_pattern[1]  # matplotlib has no public name for it
        parts = _stroke(colour, width, dashes or ())
    if line.get_marker() not in ("None", "none", "", " ", None):
        face = _paint(line.get_markerfacecolor())
        parts += f'<path d="{_outline(line)}" fill="{face}" stroke="{colour}" stroke-width="1.2"/>'
    return parts


def _stroke(colour: str, width: float, dashes: Sequence[float] = ()) -> str:
    pattern = f' stroke-dasharray="{" ".join(f"{width * d:g}" for d in dashes)}"' if dashes else ""
    return f'<path d="M1 {HEIGHT / 2:g}H{LENGTH - 1}" stroke="{colour}" stroke-width="{width:g}"{pattern}/>'


def _outline(line: Any) -> str:
    """Return the outline of a line's mark in the middle of a sample."""
    from matplotlib.markers import MarkerStyle

    style = MarkerStyle(line.get_marker())
    size = min(float(line.get_markersize()), LARGEST_MARK) * PIXELS
    path: Any = style.get_path().transformed(style.get_transform())
    polygons = [
        "M" + "L".join(f"{LENGTH / 2 + size * x:.1f} {HEIGHT / 2 - size * y:.1f}" for x, y in polygon)
        for polygon in path.to_polygons(closed_only=False)
    ]
    return "".join(polygons)


def _of_patch(handle: Any) -> str:
    from matplotlib.colors import to_hex

    face = handle.get_facecolor()
    colour = to_hex(face[0] if getattr(face, "ndim", 1) > 1 else face)
    opacity = handle.get_alpha()
    seen = "" if opacity is None else f' fill-opacity="{opacity:g}"'
    return f'<rect x="4" y="1" width="{LENGTH - 8}" height="{HEIGHT - 2}" fill="{_paint(colour)}"{seen}/>'


def _paint(colour: Any) -> str:
    """Return a colour, by the page's variable where it has one."""
    from matplotlib.colors import to_hex

    text = to_hex(colour)
    return f"var(--{VARIABLES[text[1:]]})" if text[1:] in VARIABLES else text
