"""Figures of measured responses, models and damping. They draw what they are given and compute nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from servolens.report.style import GREY, INK, LOOKS, axes_of, styled

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.report.curves import Curve, Role

__all__ = ["plot_curves", "plot_damping_in_time", "plot_damping_laws", "plot_percent_errors"]

MARKERS = {"first": "o", "second": "s", "third": "^", "pieces": "D", "measured": "."}


@styled
def plot_curves(
    curves: Sequence[Curve],
    *,
    xlabel: str,
    ylabel: str,
    title: str = "",
    zero_line: bool = False,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw `curves` in the look of their roles.

    Parameters
    ----------
    curves : sequence of Curve
        In the legend's order.
    xlabel, ylabel : str
        "Quantity [unit]".
    title : str
        Above the axes.
    zero_line : bool
        Whether to mark zero.
    legend : bool
        Whether to name the curves.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax)
    if zero_line:
        ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=1)
    for line in curves:
        ax.plot(line.x, line.y, label=line.label or "_nolegend_", **LOOKS[line.role])
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title)
    ax.margins(x=0.01)
    if legend and any(line.label for line in curves):
        ax.legend(handlelength=3.2)
    return ax


@styled
def plot_damping_in_time(
    edges: NDArray[np.float64],
    damping: NDArray[np.float64],
    error: NDArray[np.float64],
    *,
    truth: Curve | None = None,
    title: str = "",
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw piecewise-constant damping against the time since the step (the paper's figures 4 and 5).

    Parameters
    ----------
    edges : ndarray, shape (n + 1,)
        [s].
    damping, error : ndarray, shape (n,)
        Damping of each piece [1/s] and half the width of its 95 % interval.
    truth : Curve, optional
        The damping that the axis really had.
    title : str
        Above the axes.
    legend : bool
        Whether to name the lines.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax)
    if truth is not None:
        ax.plot(truth.x, truth.y, label=truth.label, **LOOKS["truth"])
    colour = LOOKS["varying"]["color"]
    ax.stairs(damping, edges, baseline=None, color=colour, linewidth=2.0, label="identified, 95 % interval", zorder=4)
    middle = 0.5 * (edges[1:] + edges[:-1])
    ax.errorbar(
        middle, damping, yerr=error, fmt="o", markersize=3.5, color=colour, capsize=3.5, elinewidth=1.2, zorder=5
    )
    ax.set(xlabel="Time since the step [s]", ylabel="Damping c [1/s]", title=title)
    ax.set_xlim(float(edges[0]), float(edges[-1]))
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    if legend:
        ax.legend(loc="upper left")
    return ax


@styled
def plot_damping_laws(
    laws: Sequence[Curve],
    points: Sequence[Curve] = (),
    *,
    length_unit: str = "m",
    title: str = "",
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw damping against speed (the paper's figure 8).

    Parameters
    ----------
    laws : sequence of Curve
        C(v): speed and damping.
    points : sequence of Curve
        Speed and damping of the pieces, drawn as markers.
    length_unit : str
        Of the axis.
    title : str
        Above the axes.
    legend : bool
        Whether to name lines and marks.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax)
    for law in laws:
        ax.plot(law.x, law.y, label=law.label or "_nolegend_", **LOOKS[law.role])
    for cloud in points:
        ax.plot(
            cloud.x,
            cloud.y,
            linestyle="none",
            marker=MARKERS.get(cloud.role, "o"),
            markersize=5.5,
            markerfacecolor="white",
            markeredgewidth=1.4,
            color=LOOKS[cloud.role]["color"],
            label=cloud.label or "_nolegend_",
            zorder=5,
        )
    ax.set(xlabel=f"Speed |v| [{length_unit}/s]", ylabel="Damping C(v) [1/s]", title=title)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    ax.margins(x=0.02)
    if legend and any(item.label for item in (*laws, *points)):
        ax.legend(handlelength=3.2)
    return ax


@styled
def plot_percent_errors(
    rows: Sequence[str],
    models: Sequence[str],
    percent: NDArray[np.float64],
    held_out: NDArray[np.bool_],
    roles: Sequence[Role],
    *,
    ax: Axes | None = None,
) -> Axes:
    """Draw the paper's Table I as dots on a logarithmic scale.

    Parameters
    ----------
    rows : sequence of str, length n
        Records, from above.
    models : sequence of str, length m
        Models, in the legend's order.
    percent, held_out : ndarray, shape (n, m)
        Errors [% of the step]; whether the record was not used for the model (filled) or was (hollow).
    roles : sequence of Role, length m
        Looks of the models.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 0.38 * len(rows) + 1.1)
    count = len(models)
    for j, (name, role) in enumerate(zip(models, roles, strict=True)):
        colour = LOOKS[role]["color"]
        heights = [i + 0.22 * ((j % 3) - 1) for i in range(len(rows))]
        shape = ("o", "s", "^")[j % 3]
        ax.plot([], [], linestyle="none", marker=shape, color=colour, markersize=5.5, label=name)
        for height, value, held in zip(heights, percent[:, j], held_out[:, j], strict=True):
            face = colour if held else "white"
            ax.plot(
                value, height, marker=shape, color=colour, markersize=5.5, markerfacecolor=face, markeredgewidth=1.3
            )
    for i in range(1, len(rows)):
        ax.axhline(i - 0.5, color="#e4e4e4", linewidth=0.7)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("Mean absolute error [% of the step], logarithmic")
    if not held_out.all():
        ax.plot([], [], linestyle="none", marker="o", color=INK, markerfacecolor="white", label="identified from it")
    ax.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, 1.0 + 0.55 / len(rows) + 0.09),
        ncols=min(count + 1, 7),
        columnspacing=1.2,
        handletextpad=0.2,
    )
    return ax
