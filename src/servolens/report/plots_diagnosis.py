"""Figures of a diagnosis. They draw what they are given and compute nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from servolens.report.style import COLOURS, GREY, INK, LOOKS, axes_of, styled

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox
    from numpy.typing import NDArray

    from servolens.report.curves import Curve

__all__ = ["plot_candidates", "plot_pieces", "plot_record_errors", "plot_residuals", "plot_shares"]

COLOUR_BEFORE, COLOUR_AFTER = LOOKS["constant"]["color"], LOOKS["velocity"]["color"]
COLOUR_OF_NOISE = COLOURS["green"]
BAND_VISIBLE = 0.1
"""Share of the largest error from which on the band of the noise is seen, and its edges do not hide the error."""


@styled
def plot_residuals(curves: Sequence[Curve], noise: float, *, title: str = "", ax: Axes | None = None) -> Axes:
    """Draw what simulations miss over time, and the band in which it is noise.

    Parameters
    ----------
    curves : sequence of Curve
        Simulated minus measured position, by model.
    noise : float
        Half the height of the band, in the unit of the curves.
    title : str
        Above the axes.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 1.75)
    ax.margins(x=0.01)
    ax.axhspan(-noise, noise, color=COLOUR_OF_NOISE, alpha=0.22, linewidth=0, zorder=0, label="noise, ± 2 deviations")
    ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=1)
    for line in curves:  # errors are near noise, of which dashes make a blot
        ax.plot(line.x, line.y, label=line.label, **{**LOOKS[line.role], "linewidth": 0.8, "linestyle": "-"})
    if all(noise > BAND_VISIBLE * float(abs(line.y).max()) for line in curves):
        for edge in (-noise, noise):  # above the noise itself
            ax.axhline(edge, color=COLOUR_OF_NOISE, linewidth=1.1, zorder=5)
    ax.set_title(title)
    return ax


@styled
def plot_shares(
    error: NDArray[np.float64],
    samples: NDArray[np.float64],
    ticks: Sequence[tuple[float, str]],
    worst: NDArray[np.bool_],
    *,
    xlabel: str,
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw the share of the error in each bin of a quantity as bars, and that of the samples as lines across them.

    Parameters
    ----------
    error, samples : ndarray, shape (n,)
        Shares of each bin [%].
    ticks : sequence of (float, str)
        Places on the axis, on which bin i reaches from i to i + 1, and what stands there, the most welcome first.
        Those that would touch one before them are left out.
    worst : ndarray of bool, shape (n,)
        Bins to stress.
    xlabel : str
        "Quantity [unit]".
    title : str
        Above the axes.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 2.4)
    for i, (height, stressed) in enumerate(zip(error, worst, strict=True)):
        ax.bar(i + 0.5, height, width=0.84, color=COLOUR_BEFORE, alpha=1.0 if stressed else 0.35, zorder=2)
    ax.hlines(samples, [i + 0.04 for i in range(samples.size)], [i + 0.96 for i in range(samples.size)], color=INK)
    ax.set_xlim(0.0, float(error.size))
    _label(ax, sorted(_apart(_label(ax, ticks), ticks)))
    ax.set_ylim(0.0, 1.08 * float(max(error.max(), samples.max())))
    ax.grid(visible=False, axis="x")
    ax.set(xlabel=xlabel, title=title)
    return ax


def _label(ax: Axes, ticks: Sequence[tuple[float, str]]) -> list[Bbox]:
    """Write the ticks, and return where each text lies."""
    marks = ax.set_xticks([place for place, _ in ticks], [text for _, text in ticks])
    for mark, (place, _) in zip(marks, ticks, strict=True):  # there is no room beyond the end
        mark.label1.set_horizontalalignment("right" if place >= ax.get_xlim()[1] else "center")
    return [mark.label1.get_window_extent() for mark in marks]


def _apart(boxes: Sequence[Bbox], ticks: Sequence[tuple[float, str]]) -> list[tuple[float, str]]:
    """Return those of `ticks`, the first most welcome, that are as far from each other as a line is high."""
    kept: list[tuple[Bbox, tuple[float, str]]] = []
    for box, tick in zip(boxes, ticks, strict=True):
        if all(max(box.x0 - other.x1, other.x0 - box.x1) >= box.height for other, _ in kept):
            kept.append((box, tick))
    return [tick for _, tick in kept]


@styled
def plot_pieces(  # noqa: PLR0913 - points, their look's labels and two lines, the latter by keyword
    abscissa: NDArray[np.float64],
    value: NDArray[np.float64],
    deviation: NDArray[np.float64],
    *,
    xlabel: str,
    ylabel: str,
    law: Curve | None = None,
    held: float | None = None,
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw what damping, gain or a force has to be in each piece of time against a measured quantity.

    Parameters
    ----------
    abscissa, value, deviation : ndarray, shape (n,)
        The quantity, what varies, and its standard error.
    xlabel, ylabel : str
        "Quantity [unit]".
    law : Curve, optional
        What the model with its causes says.
    held : float, optional
        What the model of gain and damping says.
    title : str
        Above the axes.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 3.2)
    if held is not None:
        ax.axhline(
            held, color=COLOUR_BEFORE, linewidth=1.5, linestyle=LOOKS["constant"]["linestyle"], label="gain and damping"
        )
    ax.errorbar(
        abscissa,
        value,
        yerr=deviation,
        fmt="o",
        markersize=4.0,
        color=COLOURS["purple"],
        markerfacecolor="white",
        markeredgewidth=1.3,
        elinewidth=1.0,
        label="pieces of time, with standard error",
        zorder=3,
    )
    if law is not None:
        ax.plot(law.x, law.y, label=law.label, **{**LOOKS[law.role], "zorder": 4})
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title)
    ax.legend(handlelength=3.0, frameon=True, framealpha=0.9, edgecolor="none")
    return ax


@styled
def plot_candidates(
    names: Sequence[str],
    left: NDArray[np.float64],
    chosen: Sequence[bool],
    *,
    floor: float,
    xlabel: str,
    spread: NDArray[np.float64] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw what each candidate leaves of the error as a dot, on a logarithmic scale, with the noise as a line.

    Parameters
    ----------
    names : sequence of str, length n
        From above.
    left : ndarray, shape (n,)
        Positive.
    chosen : sequence of bool, length n
        Which dot is that of the answer.
    floor : float
        The noise, in the unit of `left`.
    xlabel : str
        "Quantity [unit]".
    spread : ndarray, shape (n, 2), optional
        From where to where a bar reaches through each dot.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 0.27 * len(names) + 1.0)
    for i, (value, answer) in enumerate(zip(left, chosen, strict=True)):
        colour = COLOUR_AFTER if answer else GREY
        if spread is not None:
            ax.plot(spread[i], [i, i], color=colour, linewidth=2.0, marker="|", markersize=7.0, zorder=3)
        ax.plot(value, i, marker="o", color=colour, markersize=6.5 if answer else 5.0, zorder=4)
    ax.axvline(floor, color=COLOUR_OF_NOISE, linewidth=1.6, zorder=3, label="noise of the position")
    shown = left if spread is None else spread
    _error_axis(ax, min(float(shown.min()), floor), max(float(shown.max()), floor))
    _rows(ax, names)
    for label, answer in zip(ax.get_yticklabels(), chosen, strict=True):
        label.set_fontweight("bold" if answer else "normal")
    ax.set_xlabel(xlabel)
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return ax


@styled
def plot_record_errors(
    rows: Sequence[str],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    floor: NDArray[np.float64],
    held_out: NDArray[np.bool_],
    *,
    xlabel: str,
    ax: Axes | None = None,
) -> Axes:
    """Draw each record's error without and with the causes, and its noise.

    Parameters
    ----------
    rows : sequence of str, length n
        Records, from above.
    before, after, floor : ndarray, shape (n,)
        Errors and noise; positive, or not finite where there is none to draw.
    held_out : ndarray of bool, shape (n,)
        Whether the record took no part in the fit (filled) or did (hollow).
    xlabel : str
        "Quantity [unit]".
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 0.32 * len(rows) + 1.2)
    for i, (old, new, noise, held) in enumerate(zip(before, after, floor, held_out, strict=True)):
        ax.plot([old, new], [i, i], color="#b9b9b9", linewidth=2.2, zorder=2)
        ax.plot([noise, noise], [i - 0.3, i + 0.3], color=COLOUR_OF_NOISE, linewidth=2.0, zorder=2)
        for value, colour, shape in ((old, COLOUR_BEFORE, "s"), (new, COLOUR_AFTER, "o")):
            face = colour if held else "white"
            ax.plot(
                value,
                i,
                marker=shape,
                color=colour,
                markerfacecolor=face,
                markersize=6.5,
                markeredgewidth=1.5,
                zorder=4,
            )
    for name, colour, shape in (("gain and damping", COLOUR_BEFORE, "s"), ("with the causes", COLOUR_AFTER, "o")):
        ax.plot([], [], linestyle="none", marker=shape, color=colour, markersize=6.0, label=name)
    ax.plot([], [], color=COLOUR_OF_NOISE, linewidth=2.0, label="noise")
    if not held_out.all():
        ax.plot([], [], linestyle="none", marker="o", color=INK, markerfacecolor="white", label="fitted to it")
    if held_out.any():
        ax.plot([], [], linestyle="none", marker="o", color=INK, label="not fitted to it")
    seen = [v for v in (*before, *after, *floor) if 0 < v < float("inf")]
    _error_axis(ax, min(seen, default=1.0), max(seen, default=1.0))
    _rows(ax, rows)
    ax.set_xlabel(xlabel)
    ax.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=5, columnspacing=1.2, handletextpad=0.3)
    return ax


def _error_axis(ax: Axes, low: float, high: float) -> None:
    """Make the axis of errors logarithmic, with as many numbers as fit."""
    ax.set_xscale("log")
    ax.set_xlim(low / 1.6, high * 1.4)
    wide = high / low > 60.0
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


def _rows(ax: Axes, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), list(names))
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0, labelcolor=INK)
    ax.grid(visible=False, axis="y")
    ax.spines["left"].set_color(GREY)
