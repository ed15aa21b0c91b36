"""The numbers behind a figure: read from what was drawn, written for the page's cursor and for its CSV files."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

__all__ = ["Line", "Numbers", "Panel", "Scale", "encoded", "panels_of"]

DIGITS_OF_RANGE = 4
"""Digits of the range of a line to which its numbers are kept."""
POINTS_OF_A_LINE = 2


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """An axis of a panel.

    Parameters
    ----------
    label : str
        "Quantity [unit]".
    low, high : float
        Its ends: left or below first.
    kind : {"linear", "log", "named"}
        Whether its places have names instead of numbers.
    told : bool
        Whether numbers stand beside it; else they stand at the panel below.
    """

    label: str
    low: float
    high: float
    kind: Literal["linear", "log", "named"]
    told: bool = True

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {"label": self.label, "low": self.low, "high": self.high, "kind": self.kind, "told": self.told}


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """A line or a row of marks.

    Parameters
    ----------
    label : str
        As in the legend; empty for none.
    colour : str
        "#rrggbb".
    x, y : ndarray, shape (n,)
        NaN breaks the line.
    """

    label: str
    colour: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    def to_json(self) -> dict[str, Any]:
        """Return the fields, numbers by :func:`encoded`."""
        return {"label": self.label, "colour": self.colour, "x": encoded(self.x), "y": encoded(self.y)}


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """Axes in a picture.

    Parameters
    ----------
    title : str
        Above them.
    box : tuple of float
        Left, top, width and height in the units of the ``<svg>`` element.
    x, y : Scale
        Its axes.
    lines : tuple of Line
        What is drawn.
    """

    title: str
    box: tuple[float, float, float, float]
    x: Scale
    y: Scale
    lines: tuple[Line, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {
            "title": self.title,
            "box": [round(value, 2) for value in self.box],
            "x": self.x.to_json(),
            "y": self.y.to_json(),
            "lines": [line.to_json() for line in self.lines],
        }


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """A figure's numbers where they are not lines.

    Parameters
    ----------
    columns : tuple of str
        "Quantity [unit]".
    rows : sequence of rows
        Text or numbers.
    """

    columns: tuple[str, ...]
    rows: Sequence[Sequence[Any]]

    def to_json(self) -> dict[str, Any]:
        """Return the columns, numbers by :func:`encoded`."""
        cells = list(zip(*self.rows, strict=True)) or [()] * len(self.columns)
        return {"columns": list(self.columns), "cells": [_column(column) for column in cells]}


def _column(cells: Sequence[str | float]) -> list[str] | dict[str, Any]:
    if any(isinstance(cell, str) for cell in cells):
        return [str(cell) for cell in cells]
    return encoded(np.array(cells, dtype=np.float64))


def panels_of(figure: Figure) -> tuple[Panel, ...]:
    """Return the panels of a figure that has been drawn, but for scales of colours."""
    width, height = (72.0 * float(size) for size in figure.get_size_inches())
    found = []
    for ax in figure.axes:
        if ax.get_label() == "<colorbar>":
            continue
        place = ax.get_position()
        box = (width * place.x0, height * (1.0 - place.y1), width * place.width, height * place.height)
        title = " ".join((ax.get_title(loc="left") or ax.get_title()).split())
        scales = [_scale(axis, ends) for axis, ends in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim()))]
        found.append(Panel(title=title, box=box, x=scales[0], y=scales[1], lines=tuple(_lines(ax))))
    last = found[-1]
    return tuple(p if p.x.told else replace(p, x=replace(p.x, label=last.x.label)) for p in found)


def _scale(axis: Axis, ends: tuple[float, float]) -> Scale:
    from matplotlib.ticker import FixedLocator

    named = isinstance(axis.get_major_locator(), FixedLocator)
    kind: Literal["linear", "log", "named"] = "named" if named else "log" if axis.get_scale() == "log" else "linear"
    label = " ".join(axis.get_label_text().split())
    told = axis.get_tick_params().get("labelbottom", True) is not False
    return Scale(label=label, low=float(ends[0]), high=float(ends[1]), kind=kind, told=told)


def _lines(ax: Axes) -> list[Line]:
    """Return what is drawn in data coordinates, without lines that only mark a place."""
    from matplotlib.colors import to_hex

    found = []
    for line in ax.get_lines():
        if line.get_transform() == ax.transData and _count(line):
            label = str(line.get_label())
            found.append(
                Line(
                    label="" if label.startswith("_") else label,
                    colour=to_hex(line.get_color()),
                    x=np.asarray(line.get_xdata(), dtype=np.float64),
                    y=np.asarray(line.get_ydata(), dtype=np.float64),
                )
            )
    return found


def _count(line: Line2D) -> bool:
    return np.size(line.get_xdata()) >= POINTS_OF_A_LINE or not str(line.get_label()).startswith("_")


def encoded(values: NDArray[np.float64]) -> dict[str, Any]:
    """Return numbers as multiples of a power of ten, each as the difference to the one before; null is no number.

    Examples
    --------
    >>> encoded(np.array([0.0, 0.001, 0.003]))
    {'e': -7, 'd': [0, 10000, 20000]}
    >>> encoded(np.array([0.0, 0.001, 0.002]))
    {'e': -7, 'from': 0, 'step': 10000, 'n': 3}
    """
    finite = np.isfinite(values)
    if not finite.any():
        return {"e": 0, "d": [None] * int(values.size)}
    span = float(np.ptp(values[finite])) or float(np.abs(values[finite]).max()) or 1.0
    exponent = math.floor(math.log10(span)) - DIGITS_OF_RANGE
    whole = np.rint(np.where(finite, values, 0.0) / 10.0**exponent)
    steps = np.diff(whole)
    if finite.all() and values.size > POINTS_OF_A_LINE and (np.abs(steps - steps[0]) <= 1).all():
        step = (whole[-1] - whole[0]) / (values.size - 1)
        if np.abs(whole - (whole[0] + step * np.arange(values.size))).max() <= 1:
            return {"e": exponent, "from": int(whole[0]), "step": _short(step), "n": int(values.size)}
    told: list[int | None] = []
    last = 0.0
    for value, known in zip(whole.tolist(), finite.tolist(), strict=True):
        told.append(int(value - last) if known else None)
        last = value if known else last
    return {"e": exponent, "d": told}


def _short(value: float) -> float:
    """Return a number to nine digits, whole where it is."""
    rounded = float(f"{value:.9g}")
    return int(rounded) if rounded == int(rounded) and abs(rounded) < 1e15 else rounded
