"""From results to figures of records, models and damping: simulates, scales, thins; :mod:`plots` draws."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.piecewise import varying_residual
from servolens.plant import Plant
from servolens.report.content import Drawing
from servolens.report.curves import Curve, curve
from servolens.report.equation import in_order, motion_latex
from servolens.report.plots import plot_curves, plot_damping_in_time, plot_damping_laws, plot_percent_errors
from servolens.report.style import FULL_WIDTH, new_figure, styled
from servolens.report.svg import formula_svg, svg
from servolens.report.wording import shown, symbol_text
from servolens.simulation import simulate
from servolens.summaries.names import spoken_parameter
from servolens.summaries.wording import scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from servolens.identification.varying import VaryingDamping
    from servolens.record import Record
    from servolens.report.curves import Role

__all__ = [
    "Match",
    "damping_at",
    "damping_in_time_figure",
    "damping_law_figure",
    "errors_figure",
    "law_curve",
    "match_figure",
    "plant_equation",
    "plant_formula",
    "record_figure",
    "varying_position",
]

NORMAL_95 = 1.96


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """One measured response and what models make of it.

    Parameters
    ----------
    record : Record
        The measurement.
    models : tuple of (str, Role, Plant or VaryingDamping)
        Name, look, model.
    title : str
        Above the panel; the record's name when empty.
    of_error : bool
        Whether to show the control error r − y, as the paper's figure 3, instead of the position.
    until : float or None
        Last time shown [s], counted from the record's first sample.
    """

    record: Record
    models: tuple[tuple[str, Role, Plant | VaryingDamping], ...]
    title: str = ""
    of_error: bool = False
    until: float | None = None


@styled
def match_figure(key: str, matches: Sequence[Match], caption: str) -> Drawing:
    """Draw measured and modelled responses, two abreast, the models' errors below each."""
    columns = min(len(matches), 2)
    rows = -(-len(matches) // columns)
    figure = new_figure((4.0 if columns == 1 else 3.7) * rows)
    axes = figure.subplots(2 * rows, columns, squeeze=False, height_ratios=[1.9, 1.0] * rows)
    unstable: list[str] = []
    for i, match in enumerate(matches):
        row, column = divmod(i, columns)
        unstable += _draw_match(match, axes[2 * row, column], axes[2 * row + 1, column])
    for i in range(len(matches), rows * columns):
        row, column = divmod(i, columns)
        axes[2 * row, column].remove()
        axes[2 * row + 1, column].remove()
    _finish(figure, axes[0, 0])
    if unstable:
        caption += f" Not drawn, because its simulation leaves all bounds: {', '.join(unstable)}."
    return Drawing(svg=svg(figure, key), caption=caption)


def _draw_match(match: Match, above: Axes, below: Axes) -> list[str]:
    record = match.record
    inside = slice(0, None if match.until is None else int(np.searchsorted(record.time, record.time[0] + match.until)))
    time = record.time[inside]
    target = record.reference if match.of_error else None
    lines = [curve("measured", time, _seen(record.position, target)[inside], "measured")]
    if record.reference is not None and not match.of_error:
        lines.insert(0, curve("reference", time, record.reference[inside], "reference"))
    misses: list[tuple[str, Role, NDArray[np.float64]]] = []
    unstable = []
    for label, role, model in match.models:
        position = _simulated(model, record)
        if position is None:
            unstable.append(f"{label} on {shown(record.name)}")
            continue
        lines.append(curve(label, time, _seen(position, target)[inside], role))
        misses.append((label, role, (position - record.position)[inside]))
    factor, unit = scale([float(np.abs(miss).max()) for *_, miss in misses], record.length_unit)
    quantity = "Error r − y" if match.of_error else "Position"
    title = match.title or shown(record.name)
    drawn = [line.thinned() for line in lines]
    plot_curves(
        drawn,
        xlabel="",
        ylabel=f"{quantity} [{record.length_unit}]",
        title=title,
        zero_line=match.of_error,
        legend=False,
        ax=above,
    )
    wrong = [curve("", time, factor * miss, role).thinned() for _, role, miss in misses]
    plot_curves(wrong, xlabel="Time [s]", ylabel=f"Model −\nmeasured [{unit}]", zero_line=True, ax=below)
    above.tick_params(labelbottom=False)
    below.set_xlim(above.get_xlim())
    return unstable


@styled
def record_figure(key: str, records: Sequence[Record], caption: str) -> Drawing:
    """Draw what was logged: position with its reference, and the command below; two or three records abreast."""
    columns = 3 if len(records) == 3 else min(len(records), 2)
    rows = -(-len(records) // columns)
    figure = new_figure(2.9 * rows)
    axes = figure.subplots(2 * rows, columns, squeeze=False, height_ratios=[1.7, 1.0] * rows)
    for i in range(rows * columns):
        row, column = divmod(i, columns)
        above, below = axes[2 * row, column], axes[2 * row + 1, column]
        if i >= len(records):
            above.remove()
            below.remove()
            continue
        _draw_record(records[i], above, below)
    _finish(figure, axes[0, 0])
    return Drawing(svg=svg(figure, key), caption=caption)


def _draw_record(record: Record, above: Axes, below: Axes) -> None:
    lines = [curve("position", record.time, record.position, "velocity")]
    if record.reference is not None:
        lines.insert(0, curve("reference", record.time, record.reference, "reference"))
    thin = [line.thinned() for line in lines]
    plot_curves(
        thin, xlabel="", ylabel=f"Position [{record.length_unit}]", title=shown(record.name), legend=False, ax=above
    )
    above.tick_params(labelbottom=False)
    command = [] if record.voltage is None else [curve("", record.time, record.voltage, "command").thinned()]
    label = "Command" if record.command_unit != "V" else "Voltage"
    plot_curves(command, xlabel="Time [s]", ylabel=f"{label} [{record.command_unit}]", ax=below)
    if not command:
        below.set_yticks([])
        below.text(0.5, 0.5, "not logged", transform=below.transAxes, ha="center", va="center")
    below.set_xlim(above.get_xlim())


@styled
def damping_in_time_figure(
    key: str, panels: Sequence[tuple[str, VaryingDamping]], caption: str, *, truth: Sequence[Curve] = ()
) -> Drawing:
    """Draw c(t) in up to two columns, the true damping with it where it is known."""
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = new_figure(2.7 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for i, (title, varying) in enumerate(panels):
        error = NORMAL_95 * np.sqrt(np.maximum(np.diag(varying.covariance)[: varying.damping.size], 0.0))
        known = truth[i].thinned() if i < len(truth) else None
        plot_damping_in_time(varying.edges, varying.damping, error, truth=known, title=title, legend=False, ax=axes[i])
    for spare in axes[len(panels) :]:
        spare.remove()
    highest = max(float(varying.damping.max()) for _, varying in panels)
    axes[0].set_ylim(top=1.35 * highest if highest > 0 else None)
    _finish(figure, axes[0])
    return Drawing(svg=svg(figure, key), caption=caption)


@styled
def damping_law_figure(
    key: str, panels: Sequence[tuple[str, Sequence[Curve], Sequence[Curve]]], caption: str, length_unit: str
) -> Drawing:
    """Draw C(v): of each panel its title, laws and points."""
    figure = new_figure(3.3, FULL_WIDTH if len(panels) > 1 else 0.75 * FULL_WIDTH)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True).ravel()
    for ax, (title, laws, points) in zip(axes, panels, strict=True):
        plot_damping_laws(laws, points, length_unit=length_unit, title=title, ax=ax)
    for ax in axes[1:]:
        ax.set_ylabel("")
    return Drawing(svg=svg(figure, key), caption=caption)


def law_curve(label: str, plant: Plant, fastest: float, role: Role) -> Curve:
    """Return damping against speed from 0 to `fastest` [m/s or rad/s]."""
    speed = np.linspace(0.0, fastest, 201)
    return curve(label, speed, damping_at(plant, speed), role)


def damping_at(plant: Plant, speed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the force that opposes the motion at `speed` [m/s or rad/s] without a command, divided by the speed."""
    import casadi as ca

    from servolens.dynamics import dynamics

    d = dynamics(plant.structure)
    push = ca.Function("push", d.inputs, [d.push])
    moving = np.maximum(speed, 1e-9)
    return np.array([-float(push(0.0, v, 0.0, 0.0, 1.0, plant.values, 0.0)) / v for v in moving])


@styled
def errors_figure(
    key: str,
    rows: Sequence[str],
    models: Sequence[tuple[str, Role]],
    percent: NDArray[np.float64],
    held_out: NDArray[np.bool_],
    caption: str,
) -> Drawing:
    """Draw Table I as dots."""
    figure = new_figure(0.36 * len(rows) + 1.3)
    names, roles = [name for name, _ in models], [role for _, role in models]
    plot_percent_errors([shown(row) for row in rows], names, percent, held_out, roles, ax=figure.add_subplot())
    return Drawing(svg=svg(figure, key), caption=caption)


def plant_formula(key: str, plant: Plant) -> Drawing:
    """Return the equation of motion, in symbols and in words, and what its symbols mean."""
    drawing = plant_equation(key, plant)
    meanings = "; ".join(
        f"{symbol_text(p.symbol)}, {spoken_parameter(p.name)}: {p.meaning}" for p in plant.parameters.values()
    )
    return replace(drawing, caption=f"{drawing.caption} {meanings}.")


def plant_equation(key: str, plant: Plant) -> Drawing:
    """Return the equation of motion, made from what each effect says of itself, in symbols and in words."""
    words = "Acceleration is the gain times the command, less the damping times the speed"
    words += "".join(f"; {e.sentence[0].lower()}{e.sentence[1:].rstrip('.')}" for e in in_order(plant))
    return Drawing(svg=formula_svg(motion_latex(plant), key), caption=f"{words}.", formula=True)


def varying_position(varying: VaryingDamping, record: Record) -> NDArray[np.float64]:
    """Return the position whose difference to the measured one is the error that is reported."""
    return np.asarray(record.position + varying_residual(varying, record))


def _simulated(model: Plant | VaryingDamping, record: Record) -> NDArray[np.float64] | None:
    try:
        if isinstance(model, Plant):
            return simulate(model, record).position
        return varying_position(model, record)
    except NumericalError:
        return None


def _seen(position: NDArray[np.float64], reference: NDArray[np.float64] | None) -> NDArray[np.float64]:
    return position if reference is None else reference - position


def _finish(figure: Figure, ax: Axes) -> None:
    """Name the lines once, above all panels, and align what stands beside them."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), handlelength=2.6, columnspacing=1.4)
    figure.align_ylabels()
