"""From a comparison to its figures: scans the gain, simulates the recommendations; :mod:`plots_design` draws."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design import settling_time, step_response
from servolens.design.settle import horizon
from servolens.errors import NumericalError
from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_from, keys_of
from servolens.report.figure_data import Numbers
from servolens.report.gain_names import gain_names
from servolens.report.map_picture import TITLES
from servolens.report.plots_design import Mark, plot_gain_map, plot_settling_times, plot_step_responses
from servolens.report.style import COLOURS, HALF_WIDTH, THIRD_WIDTH, WIDE, new_figure, panel_figure, styled
from servolens.summaries.wording import inside, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.design import Comparison, Design, GainMap, PDSpec, Response
    from servolens.plant import Plant
    from servolens.report.content import Drawing
    from servolens.report.curves import Curve, Role
    from servolens.report.gain_names import GainNames

__all__ = [
    "Column",
    "columns",
    "draw_settling",
    "gains_figure",
    "highest",
    "last_gain",
    "settling_curve",
    "settling_figure",
    "steps_figure",
]

COMPARED: tuple[tuple[str, Role], ...] = (("linear", "constant"), ("nonlinear", "velocity"), ("diagnosed", "diagnosed"))
GAINS_DRAWN = 201
JUMP = 0.06
"""A change of settling time from one gain to the next by this share of the loop's undamped period is a gap."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One of the models of a comparison: its plant, and its gain run on the plant that the data support best."""

    name: str
    role: Role
    plant: Plant
    design: Design
    on_best: Response | None


def columns(comparison: Comparison) -> list[Column]:
    """Return the models of a comparison; the last is the one that the data support best."""
    found = zip(COMPARED, comparison.plants, comparison.designs, comparison.on_best, strict=False)
    return [
        Column(name=name, role=role, plant=plant, design=design, on_best=on_best)
        for (name, role), plant, design, on_best in found
    ]


@styled
def settling_figure(key: str, models: Sequence[Column], caption: str) -> Drawing:
    """Draw settling time against Kd of all models, feasible gains shaded, recommendations marked on the last one."""
    figure, ax = panel_figure(3.2, WIDE, 0.6)
    draw_settling(models, ax)
    ax.set_title("Settling time on each model")
    return drawing(key, figure, caption, legend=keys_of(ax))


def draw_settling(models: Sequence[Column], ax: Axes, *, legend: bool = False) -> None:
    """Draw what :func:`settling_figure` shows; with a `legend`, inside matplotlib's figure."""
    best = models[-1]
    spec = best.design.spec
    gains = np.linspace(0.0, last_gain([model.design for model in models]), GAINS_DRAWN)
    curves = [settling_curve(f"{model.name} model", model.plant, spec, gains, model.role) for model in models]
    plot_settling_times(
        curves,
        [(model.role, model.design.intervals) for model in models],
        [*_marks(models), *_recommended(best)],
        limit=spec.settling_time,
        gain=gain_names(spec, best.plant).free_label,
        legend=legend,
        top=highest(curves, spec.settling_time),
        ax=ax,
    )


def _marks(models: Sequence[Column]) -> list[Mark]:
    """Return the least gains that all models give, where they end up on the last one."""
    marks, best = [], models[-1]
    for model in models:
        found = model.on_best
        if found is not None and found.settling_time is not None:
            where = "" if model is best else f" on the {best.name} plant"
            says = f"least {model.name} gain {_least(model.design)}{where}: {number(found.settling_time, 3)} s"
            marks.append(Mark(label=says, kd=found.kd, settling_time=found.settling_time, role=model.role))
    return marks


def _recommended(model: Column) -> list[Mark]:
    chosen = model.design.recommended
    if chosen is None or chosen.settling_time is None:
        return []
    says = f"recommended gain {number(chosen.kd)}: {number(chosen.settling_time, 3)} s"
    return [Mark(label=says, kd=chosen.kd, settling_time=chosen.settling_time, role="command")]


@styled
def steps_figure(key: str, models: Sequence[Column], caption: str) -> Drawing:
    """Draw the step responses of all recommendations on the last of the models, the band magnified."""
    best = models[-1]
    spec = best.design.spec
    free = gain_names(spec, best.plant).free
    tried: list[tuple[str, Role, float]] = [
        (f"least {model.name} gain, {free} = {_least(model.design)}", model.role, model.design.kd)
        for model in models
        if model.design.kd is not None
    ]
    chosen = best.design.recommended
    if chosen is not None:
        tried.append((f"recommended, {free} = {number(chosen.kd)}", "command", chosen.kd))
    curves = []
    for label, role, kd in tried:
        with suppress(NumericalError):  # a gain that the table says to be unstable
            run = step_response(best.plant, spec, kd, 2.4 * spec.settling_time)
            curves.append(curve(label, run.time, run.position, role).thinned())
    window = (0.35 * spec.settling_time, 2.0 * spec.settling_time)
    titles = ("The whole step", f"Magnified: the band of ±{100 * spec.band:g} %")
    figures, axes = [], []
    for zoom, title in ((None, titles[0]), (window, titles[1])):
        figure, ax = panel_figure(3.0, HALF_WIDTH, 0.75)
        plot_step_responses(curves, spec, length_unit=best.plant.length_unit, zoom=zoom, legend=False, ax=ax)
        ax.set_title(title)
        axes.append(ax)
        figures.append(figure)
    return drawing(key, figures, caption, legend=keys_of(axes[0]))


@styled
def gains_figure(key: str, found: GainMap, design: Design, plant: Plant, caption: str) -> Drawing:
    """Draw settling time, overshoot and noise over both gains, with the gain that a design recommends."""
    from matplotlib.lines import Line2D

    chosen, names = design.recommended, gain_names(design.spec, plant)
    figures, axes = [], []
    for quantity, title in TITLES.items():
        figure = new_figure(3.5, THIRD_WIDTH)
        ax = plot_gain_map(
            found,
            quantity,
            recommended=None if chosen is None else (chosen.kp, chosen.kd),
            length_unit=plant.length_unit,
            command_unit=plant.command_unit,
            labels=(names.kp_label, f"{names.free} [{names.free_unit}]"),
            title=title,
            ax=figure.add_subplot(),
        )
        figures.append(figure)
        axes.append(ax)
    border = {"meets the spec inside": Line2D([], [], color=COLOURS["vermilion"])} if found.feasible.any() else {}
    legend = [*keys_from(border), *keys_of(axes[0])]
    return drawing(key, figures, caption, legend=legend, table=_map_numbers(found, names))


def _map_numbers(found: GainMap, names: GainNames) -> Numbers:
    kp, kd = np.meshgrid(found.kp, found.kd, indexing="ij")
    values = (kp, kd, found.settling_time, found.overshoot, found.noise, found.feasible.astype(np.float64))
    columns = (
        names.kp_label,
        f"{names.free} [{names.free_unit}]",
        "Settling time [s]",
        "Overshoot [1]",
        f"Noise gain [{names.free_unit.replace(' s', '')}]",
        "Meets the spec [1 or 0]",
    )
    return Numbers(columns=columns, rows=list(zip(*(v.ravel().tolist() for v in values), strict=True)))


def settling_curve(label: str, plant: Plant, spec: PDSpec, gains: NDArray[np.float64], role: Role) -> Curve:
    """Return settling time against the gain that is sought, broken where it jumps."""
    swing = 2.0 * np.pi / max(spec.rate(plant.gain), 1e-6)
    watched = max(4.0 * spec.settling_time, min(2.0 * swing, horizon(plant, spec)))
    times = np.array([_settles(plant, spec, float(kd), watched) for kd in gains])
    jumps = np.flatnonzero(np.abs(np.diff(times)) > JUMP * swing) + 1
    return curve(label, np.insert(gains, jumps, np.nan), np.insert(times, jumps, np.nan), role)


def highest(curves: Sequence[Curve], limit: float) -> float:
    """Return the upper end of the axis: what is near the limit, or the quickest half where nothing is."""
    times = np.concatenate([line.y[np.isfinite(line.y)] for line in curves])
    if times.size == 0 or times.min() < 2.0 * limit:
        return 3.2 * limit
    return 1.1 * float(np.quantile(times, 0.5))


def _settles(plant: Plant, spec: PDSpec, kd: float, watched: float) -> float:
    try:
        run = step_response(plant, spec, kd, watched)
    except NumericalError:
        return float("nan")
    found = settling_time(run.time, (spec.reference - run.position) / abs(spec.reference), spec.band)
    return float("nan") if found is None else found


def last_gain(designs: Sequence[Design]) -> float:
    """Return up to which gain figures of these designs reach."""
    ends = [high for design in designs for _, high in design.intervals]
    searched = max(design.certificate.searched[1] for design in designs)
    return min(1.15 * max(ends), searched) if ends else searched or 1.0  # where none was searched, any will do


def _least(design: Design) -> str:
    """Return the least gain, rounded so that it still meets the spec."""
    return inside(*design.intervals[0])[0]
