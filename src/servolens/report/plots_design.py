"""Figures of a design: settling time against the gain, and the step responses of its recommendations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, final

import numpy as np
from matplotlib.ticker import EngFormatter

from servolens.report.style import COLOURS, GREY, INK, LOOKS, axes_of, styled

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.design import GainMap, PDSpec
    from servolens.report.curves import Curve, Role


Quantity = Literal["settling_time", "overshoot", "noise"]
"""What a map over both gains shows."""
__all__ = ["Mark", "Quantity", "plot_gain_map", "plot_settling_times", "plot_step_responses"]
SPREAD = COLOURS["orange"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A recommended gain and the settling time it has on a model.

    Parameters
    ----------
    label : str
        Beside the mark.
    kd, settling_time : float
        Where it stands [V s/m], [s].
    role : Role
        Its look.
    """

    label: str
    kd: float
    settling_time: float
    role: Role


@styled
def plot_settling_times(  # noqa: PLR0913 - what is asked for, by keyword
    curves: Sequence[Curve],
    intervals: Sequence[tuple[Role, Sequence[tuple[float, float]]]],
    marks: Sequence[Mark],
    *,
    limit: float,
    gain: str = "Derivative gain Kd [V s/m]",
    spread: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None,
    legend: bool = True,
    top: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw settling time against a gain.

    Parameters
    ----------
    curves : sequence of Curve
        Kd and settling time, a model each.
    intervals : sequence of (Role, intervals)
        Feasible gains of each model, shaded.
    marks : sequence of Mark
        Recommendations.
    limit : float
        The settling time asked for [s].
    gain : str
        "Quantity [unit]" of the gain.
    spread : tuple of ndarray, optional
        Gains, and from where to where the settling time reaches there [s]; NaN where it has no end.
    legend : bool
        Whether to name lines and marks.
    top : float, optional
        Upper end of the axis [s].
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 3.8)
    for role, spans in intervals:
        for low, high in spans:
            ax.axvspan(low, high, color=LOOKS[role]["color"], alpha=0.13, linewidth=0, zorder=0, gid="live-designed")
    ax.axhline(limit, color=INK, linewidth=1.0, linestyle=(0, (5, 3)), zorder=2)
    if spread is not None:
        found = ax.fill_between(*spread, color=SPREAD, alpha=0.4, linewidth=0, label="spread of the axis")
        found.set_gid("live-settling-spread")
    for line in curves:
        drawn = ax.plot(line.x, line.y, label=line.label or "_nolegend_", **{**LOOKS[line.role], "linestyle": "-"})
        drawn[0].set_gid(f"live-settling-{line.role}")
    for mark in marks:
        _draw_mark(ax, mark, meets=mark.settling_time <= limit * (1 + 1e-9))
    ax.set(xlabel=gain, ylabel="Settling time [s]")
    ax.set_ylim(0.0, top)
    ax.margins(x=0.0)
    if curves:
        ax.set_xlim(float(curves[0].x[0]), float(curves[0].x[-1]))
    ax.annotate(
        f"asked for: {limit:g} s",
        (0.0, limit),
        xycoords=("axes fraction", "data"),
        xytext=(4, -4),
        textcoords="offset points",
        va="top",
        fontsize=8.5,
        zorder=6,
        bbox={"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )
    if legend:
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return ax


def _draw_mark(ax: Axes, mark: Mark, *, meets: bool) -> None:
    ax.plot(
        mark.kd,
        mark.settling_time,
        marker="o" if meets else "X",
        markersize=8 if meets else 9,
        color=LOOKS[mark.role]["color"],
        markeredgecolor="white",
        linestyle="none",
        label=mark.label,
        zorder=7,
        gid="live-designed",
    )


@styled
def plot_step_responses(
    curves: Sequence[Curve],
    spec: PDSpec,
    *,
    length_unit: str = "m",
    zoom: tuple[float, float] | None = None,
    legend: bool = True,
    spread: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw step responses with the band they have to stay in.

    Parameters
    ----------
    curves : sequence of Curve
        Time and position.
    spec : PDSpec
        Gives the step, the band, and from when on it holds.
    length_unit : str
        Of the axis.
    zoom : (float, float), optional
        Times [s] between which only the surroundings of the band are shown; everything when None.
    legend : bool
        Whether to name the curves.
    spread : tuple of ndarray, optional
        Times, and from where to where the position reaches there.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 3.3)
    reference, band = spec.reference, spec.band
    low, high = reference * (1 - band), reference * (1 + band)
    ax.axhspan(low, high, color="#009E73", alpha=0.16, linewidth=0, zorder=0)
    ax.axvline(spec.settling_time, color=INK, linewidth=1.0, linestyle=(0, (5, 3)), zorder=2)
    ax.axhline(reference, color=GREY, linewidth=0.8, zorder=1)
    if spread is not None:
        found = ax.fill_between(*spread, color=SPREAD, alpha=0.4, linewidth=0, label="spread of the axis")
        found.set_gid("live-step-spread")
    for line in curves:
        ax.plot(line.x, line.y, label=line.label or "_nolegend_", **LOOKS[line.role])[0].set_gid(
            f"live-step-{line.role}"
        )
    ax.set(xlabel="Time since the step [s]", ylabel=f"Position [{length_unit}]")
    ax.margins(x=0.0)
    if zoom is not None:
        width = 3.0 * band * abs(reference)
        ax.set_xlim(*zoom)
        ax.set_ylim(reference - width, reference + width)
    if legend:
        ax.legend(loc="lower right", handlelength=3.2)
    return ax


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Shade:
    """How one quantity of a map is shown.

    Parameters
    ----------
    label : str
        Beside the scale, with the unit in braces.
    levels : callable
        From the map, where the colour changes.
    shown : callable
        From the map, what is drawn.
    """

    label: str
    levels: Callable[[GainMap], NDArray[np.float64]]
    shown: Callable[[GainMap], NDArray[np.float64]]


SHADES = {
    "settling_time": Shade(
        label="Settling time [s]",
        levels=lambda found: found.spec.settling_time * np.array([0.0, 0.4, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0]),
        shown=lambda found: found.settling_time,
    ),
    "overshoot": Shade(
        label="Overshoot [%]",
        levels=lambda _found: np.array([0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]),
        shown=lambda found: 100.0 * np.where(np.isfinite(found.overshoot), found.overshoot, np.nan),
    ),
    "noise": Shade(
        label="Noise gain [{command}/{length}]",
        levels=lambda found: _round_levels(found.noise),
        shown=lambda found: found.noise,
    ),
}
LEVELS = 5
"""Of noise, at most."""


@styled
def plot_gain_map(
    found: GainMap,
    quantity: Quantity = "settling_time",
    *,
    recommended: tuple[float, float] | None = None,
    length_unit: str = "m",
    command_unit: str = "V",
    labels: tuple[str, str] | None = None,
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw one quantity over both gains, the feasible region outlined, the feasible pair of least noise marked.

    White is where there is no such number: the step does not settle in the time that the map shows, or the loop is
    unstable.

    Parameters
    ----------
    found : GainMap
        What to draw; at least two gains of each kind.
    quantity : {"settling_time", "overshoot", "noise"}
        Shaded.
    recommended : (float, float), optional
        The pair (kp, kd) to use.
    length_unit, command_unit : str
        Of the plant.
    labels : tuple of str, optional
        "Quantity [unit]" of both gains; None are those of a PD.
    title : str
        Above the axes.
    ax : Axes, optional
        Where; a new figure when None.
    """
    ax = axes_of(ax, 3.8)
    shade = SHADES[quantity]
    levels = shade.levels(found)
    filled = ax.contourf(found.kp, found.kd, shade.shown(found).T, levels, cmap="Blues", extend="max", alpha=0.85)
    if ax.figure is not None:
        label = shade.label.format(command=command_unit, length=length_unit)
        ax.figure.colorbar(
            filled, ax=ax, label=label, location="bottom", ticks=levels[::2], format=_short, aspect=30
        )  # every second level, so that numbers do not run into each other
    if found.feasible.any() and not found.feasible.all():
        ax.contour(found.kp, found.kd, found.feasible.T.astype(float), [0.5], colors=COLOURS["vermilion"])
    marks = (("least noise", found.least_noise, "o"), ("recommended", recommended, "*"))
    for name, pair, marker in marks:
        if pair is not None:
            size = {"o": 6, "*": 11}[marker]
            ax.plot(*pair, marker, markersize=size, color=INK, markeredgecolor="white", label=name, zorder=5)
    ax.set(xlim=(found.kp[0], found.kp[-1]), ylim=(found.kd[0], found.kd[-1]), title=title)
    kp, kd = labels or (f"Kp [{command_unit}/{length_unit}]", f"Kd [{command_unit} s/{length_unit}]")
    ax.set(xlabel=kp, ylabel=kd)
    ax.grid(visible=False)
    return ax


def _short(value: float, _place: int | None = None) -> str:
    """Return a number for a scale, thousands with their prefix."""
    return EngFormatter(sep="")(value) if abs(value) >= 1e3 else f"{value:g}"


def _round_levels(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return round numbers over the range of `values`."""
    from matplotlib.ticker import MaxNLocator

    return np.asarray(MaxNLocator(LEVELS).tick_values(0.0, float(values.max())), dtype=np.float64)
