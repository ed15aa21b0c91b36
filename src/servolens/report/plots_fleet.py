"""Figures of many axes: how parameters are distributed, what causes were named, how a parameter drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from matplotlib.ticker import MaxNLocator

from servolens.report.style import COLOURS, FULL_WIDTH, axes_of, new_figure, styled
from servolens.report.svg import svg
from servolens.report.wording import shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

__all__ = ["History", "Spread", "histories_svg", "plot_counts", "plot_history", "plot_spread", "spreads_svg"]

BAR_HEIGHT, PANEL_HEIGHT = 0.28, 1.75
"""Heights of a bar and of a panel [inches]."""
PANELS_PER_ROW = 2


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Values of one parameter over many axes.

    Parameters
    ----------
    label : str
        Quantity and unit.
    values : tuple of float
        One for each study that has it.
    far : tuple of float
        Those of them that lie far from the others.
    """

    label: str
    values: tuple[float, ...]
    far: tuple[float, ...] = ()


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """One parameter of one axis over time.

    Parameters
    ----------
    title, label : str
        Above the panel; quantity and unit.
    days : tuple of float
        Since the first measurement.
    values : tuple of float
        At these days.
    errors : tuple of float
        Half widths of 95 % intervals; NaN where they are not known.
    line : tuple of (float, float) or None
        Value of the trend on the first and on the last day.
    """

    title: str
    label: str
    days: tuple[float, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    line: tuple[float, float] | None = None


@styled
def plot_spread(spread: Spread, ax: Axes | None = None) -> Axes:
    """Draw a histogram of the values, and a mark for each that lies far from the others."""
    ax = axes_of(ax, PANEL_HEIGHT)
    values = np.array(spread.values)
    ax.hist(values, bins=_bins(values).tolist(), color=COLOURS["blue"], edgecolor="white", linewidth=0.5)
    if spread.far:
        level = np.zeros(len(spread.far))
        ax.plot(
            spread.far, level, marker="v", color=COLOURS["vermilion"], linestyle="none", clip_on=False, markersize=5
        )
    ax.set_xlabel(spread.label)
    ax.set_ylabel("Studies")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.margins(x=0.03)
    return ax


@styled
def plot_counts(counts: Mapping[str, int], ax: Axes | None = None) -> Axes:
    """Draw a bar for each of the names, the first on top."""
    ax = axes_of(ax, 0.6 + BAR_HEIGHT * len(counts))
    names = [shown(name, 34) for name in counts]
    places = np.arange(len(names))
    bars = ax.barh(places, list(counts.values()), color=COLOURS["blue"], height=0.7)
    ax.bar_label(bars, padding=3, fontsize=8.5)
    ax.set_yticks(places, names)
    ax.invert_yaxis()
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("Studies")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.margins(x=0.08, y=0.02)
    return ax


@styled
def plot_history(history: History, ax: Axes | None = None) -> Axes:
    """Draw the values with their 95 % intervals over the days, and the trend."""
    ax = axes_of(ax, PANEL_HEIGHT)
    errors = np.nan_to_num(np.array(history.errors))
    ax.errorbar(
        history.days, history.values, yerr=errors, fmt="o", markersize=3.5, linewidth=1.1, capsize=2.5,
        color=COLOURS["blue"], zorder=3,
    )  # fmt: skip
    if history.line is not None:
        ends = (min(history.days), max(history.days))
        ax.plot(ends, history.line, color=COLOURS["vermilion"], linewidth=1.3, zorder=2)
    ax.set_title(shown(history.title, 44))
    ax.set_xlabel("Days")
    ax.set_ylabel(history.label)
    return ax


def spreads_svg(spreads: Sequence[Spread], key: str) -> str:
    """Return panels of :func:`plot_spread`, two in a row, as an ``<svg>`` element."""
    return _panels([lambda ax, one=one: plot_spread(one, ax) for one in spreads], key)


def histories_svg(histories: Sequence[History], key: str) -> str:
    """Return panels of :func:`plot_history`, two in a row, as an ``<svg>`` element."""
    return _panels([lambda ax, one=one: plot_history(one, ax) for one in histories], key)


@styled
def _panels(draw: Sequence[object], key: str) -> str:
    rows = math.ceil(len(draw) / PANELS_PER_ROW)
    columns = min(PANELS_PER_ROW, len(draw))
    figure = new_figure(PANEL_HEIGHT * rows + 0.3, FULL_WIDTH if columns > 1 else FULL_WIDTH / 2)
    for place, one in enumerate(draw, start=1):
        assert callable(one)  # noqa: S101 - made above
        one(figure.add_subplot(rows, columns, place))
    return svg(figure, key)


def _bins(values: np.ndarray) -> np.ndarray:
    """Return edges of bars: as Freedman and Diaconis advise, from 5 to 40 of them."""
    low, high = float(np.min(values)), float(np.max(values))
    if not high > low:
        width = abs(low) * 0.1 or 1.0
        return np.linspace(low - width, high + width, 6)
    quartiles = np.subtract(*np.percentile(values, [75, 25]))
    width = 2.0 * quartiles / len(values) ** (1 / 3)
    count = 40 if width <= 0 else int(min(max(math.ceil((high - low) / width), 5), 40))
    return np.linspace(low, high, count + 1)
