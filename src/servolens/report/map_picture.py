"""The picture of a map over both gains: settling time, overshoot and noise side by side."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from matplotlib.lines import Line2D

from servolens.errors import InputError
from servolens.report.plots_design import Quantity, plot_gain_map
from servolens.report.style import COLOURS, new_figure, styled
from servolens.results import write_atomically

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from servolens.design import GainMap

__all__ = ["TITLES", "checked_kind", "map_figure", "write_map"]

PICTURE_KINDS = ("png", "svg")
"""Kinds of files, by the end of the name."""
DOTS_PER_INCH = 160
TITLES: dict[Quantity, str] = {
    "settling_time": "Settling time",
    "overshoot": "Overshoot",
    "noise": "Noise of the command",
}


@styled
def map_figure(
    found: GainMap,
    *,
    recommended: tuple[float, float] | None = None,
    length_unit: str = "m",
    command_unit: str = "V",
) -> Figure:
    """Return the picture of a map.

    Parameters
    ----------
    found : GainMap
        With at least two gains of each kind.
    recommended : (float, float), optional
        The pair (kp, kd) to use.
    length_unit, command_unit : str
        Of the plant.
    """
    figure = new_figure(3.9, 9.6)
    panels = figure.subplots(1, len(TITLES), sharey=True)
    for ax, (quantity, title) in zip(panels, TITLES.items(), strict=True):
        plot_gain_map(
            found,
            quantity,
            recommended=recommended,
            length_unit=length_unit,
            command_unit=command_unit,
            title=title,
            ax=ax,
        )
        ax.set_ylabel(ax.get_ylabel() if ax is panels[0] else "")
    handles, labels = panels[0].get_legend_handles_labels()
    if found.feasible.any():
        handles.insert(0, Line2D([], [], color=COLOURS["vermilion"]))
        labels.insert(0, "meets the spec inside")
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


@styled
def write_map(
    path: Path,
    found: GainMap,
    *,
    recommended: tuple[float, float] | None = None,
    length_unit: str = "m",
    command_unit: str = "V",
) -> None:
    """Write the picture of a map as PNG or SVG, whole or not at all; see :func:`map_figure`.

    Raises
    ------
    InputError
        If the name ends otherwise, or the file cannot be written.
    """
    kind = checked_kind(path)
    figure = map_figure(found, recommended=recommended, length_unit=length_unit, command_unit=command_unit)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=DOTS_PER_INCH, metadata={"Date": None} if kind == "svg" else None)
    write_atomically(path, buffer.getvalue())


def checked_kind(path: Path) -> str:
    """Return the kind of a picture by the end of its name.

    Raises
    ------
    InputError
        If it is none of those that can be written.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in PICTURE_KINDS:
        raise InputError(f"{path}: a picture is written as .png or .svg; name such a file")
    return kind
