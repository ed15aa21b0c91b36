"""From results to figures of records, models and damping: simulates, scales, thins; :mod:`plots` draws."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.piecewise import varying_residual
from servolens.model import NORMAL_95
from servolens.plant import Plant
from servolens.report.content import Drawing, Picture
from servolens.report.curves import Curve, curve
from servolens.report.drawing import drawing, keys_of, legend_of
from servolens.report.equation import in_order, motion_latex
from servolens.report.figure_data import Numbers
from servolens.report.plots import plot_curves, plot_damping_in_time, plot_damping_laws, plot_percent_errors
from servolens.report.style import ALONE, HALF_WIDTH, NAMED, WIDE, new_figure, panel_figure, stacked_figure, styled
from servolens.report.svg import formula_svg
from servolens.report.wording import shown, symbol_text
from servolens.simulation import simulate
from servolens.summaries.models import determined
from servolens.summaries.names import spoken_parameter
from servolens.summaries.wording import scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.effects.base import Parameter
    from servolens.identification.varying import VaryingDamping
    from servolens.record import Record
    from servolens.report.content import Key
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
    """Draw measured and modelled responses, the models' errors below each."""
    figures, unstable = [], []
    alone = len(matches) == 1
    legend: dict[str, Key] = {}
    for match in matches:
        figure, above, below = stacked_figure(3.9 if alone else 3.5, ALONE if alone else HALF_WIDTH, 1.9)
        unstable += _draw_match(match, above, below)
        legend |= {own.label: own for own in keys_of(above)}
        figures.append(figure)
    if unstable:
        caption += f" Not drawn, because its simulation diverges: {', '.join(unstable)}."
    return drawing(key, figures, caption, legend=[*legend.values()])


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
    """Draw what was logged: position with its reference, and the command below if any record has it."""
    figures = []
    legend: dict[str, Key] = {}
    width = ALONE if len(records) == 1 else HALF_WIDTH
    has_command = any(record.voltage is not None for record in records)
    for record in records:
        if has_command:
            figure, above, below = stacked_figure(2.8, width, 1.7)
            _draw_position(record, above)
            _draw_command(record, above, below)
        else:
            figure, above = panel_figure(2.1, width)
            _draw_position(record, above)
            above.set_xlabel("Time [s]")
        legend |= {own.label: own for own in keys_of(above)}
        figures.append(figure)
    return drawing(key, figures, caption, legend=[*legend.values()])


def _draw_position(record: Record, above: Axes) -> None:
    lines = [curve("position", record.time, record.position, "velocity")]
    if record.reference is not None:
        lines.insert(0, curve("reference", record.time, record.reference, "reference"))
    thin = [line.thinned() for line in lines]
    plot_curves(
        thin, xlabel="", ylabel=f"Position [{record.length_unit}]", title=shown(record.name), legend=False, ax=above
    )


def _draw_command(record: Record, above: Axes, below: Axes) -> None:
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
    """Draw c(t), the true damping with it where it is known."""
    highest = max(float(varying.damping[determined(varying)].max(initial=0.0)) for _, varying in panels)
    left_out = sum(int(np.count_nonzero(~determined(varying))) for _, varying in panels)
    figures, rows, axes = [], [], []
    for i, (title, varying) in enumerate(panels):
        error = NORMAL_95 * np.sqrt(np.maximum(np.diag(varying.covariance)[: varying.damping.size], 0.0))
        known = truth[i].thinned() if i < len(truth) else None
        figure, ax = panel_figure(2.6, ALONE if len(panels) == 1 else HALF_WIDTH)
        told = np.where(determined(varying), varying.damping, np.nan)
        plot_damping_in_time(varying.edges, told, error, truth=known, title=title, legend=False, ax=ax)
        if highest > 0:  # error bars of what the data hardly determine end outside
            lowest = min(float(own.damping[determined(own)].min(initial=0.0)) for _, own in panels)
            ax.set_ylim(1.35 * lowest - 0.1 * highest, 1.35 * highest)
        if not determined(varying)[-1]:
            ax.set_xlim(right=float(varying.edges[1 + np.flatnonzero(determined(varying)).max(initial=0)]))
        pieces = zip(varying.edges[:-1], varying.edges[1:], varying.damping, error, strict=True)
        rows += [(title, *(float(value) for value in piece)) for piece in pieces]
        figures.append(figure)
        axes.append(ax)
    if left_out:
        what, are = ("piece", "is") if left_out == 1 else ("pieces", "are")
        caption += f" {left_out} {what} of which the data say little {are} left out."
    columns = ("Panel", "From [s]", "To [s]", "Damping [1/s]", "Half of the 95 % interval [1/s]")
    return drawing(key, figures, caption, legend=keys_of(*axes), table=Numbers(columns=columns, rows=rows))


@styled
def damping_law_figure(
    key: str, panels: Sequence[tuple[str, Sequence[Curve], Sequence[Curve]]], caption: str, length_unit: str
) -> Drawing:
    """Draw C(v): of each panel its title, laws and points."""
    figures, axes = [], []
    for title, laws, points in panels:
        figure, ax = panel_figure(3.0, HALF_WIDTH if len(panels) > 1 else WIDE, 0.7)
        plot_damping_laws(laws, points, length_unit=length_unit, title=title, legend=False, ax=ax)
        axes.append(ax)
        figures.append(figure)
    top = max(ax.get_ylim()[1] for ax in axes)
    for ax in axes:
        ax.set_ylim(top=top)
    return drawing(key, figures, caption, legend=keys_of(*axes))


def law_curve(label: str, plant: Plant, speeds: tuple[float, float], role: Role) -> Curve:
    """Return damping against speed between two `speeds` [m/s or rad/s]."""
    speed = np.linspace(*speeds, 201)
    return curve(label, speed, damping_at(plant, speed), role)


def damping_at(plant: Plant, speed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the force that opposes the motion at `speed` [m/s or rad/s] without a command, divided by the speed."""
    import casadi as ca

    from servolens.dynamics import dynamics

    d = dynamics(plant.structure)
    push = ca.Function("push", d.inputs, [d.push])
    moving = np.maximum(speed, 1e-9)
    return np.array([-float(push(0.0, v, 0.0, 0.0, 1.0, plant.driven_values, 0.0)) / v for v in moving])


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
    figure = new_figure(0.36 * len(rows) + 0.8, NAMED)
    ax = figure.add_subplot()
    names, roles = [name for name, _ in models], [role for _, role in models]
    plot_percent_errors([shown(row) for row in rows], names, percent, held_out, roles, ax=ax)
    return drawing(key, figure, caption, legend=legend_of(ax))


def plant_formula(key: str, plant: Plant) -> Drawing:
    """Return the equation of motion, in symbols and in words, and what its symbols mean."""
    drawing = plant_equation(key, plant)
    fitted = {name: spec for name, spec in plant.parameters.items() if name not in plant.usual}
    return replace(drawing, caption=f"{drawing.caption} {'; '.join(map(_meaning, fitted.values()))}.")


def _meaning(spec: Parameter) -> str:
    """Return what a symbol means, by its name too where that is not the symbol spelled out."""
    is_spelled = re.sub(r"[\\_{}]", "", spec.symbol) == spec.name
    return f"{symbol_text(spec.symbol)}{'' if is_spelled else f', {spoken_parameter(spec.name)}'}: {spec.meaning}"


def plant_equation(key: str, plant: Plant) -> Drawing:
    """Return the equation of motion, made from what each effect says of itself, in symbols and in words."""
    words = "Acceleration is the gain times the command, less the damping times the speed"
    words += "".join(f"; {e.sentence[0].lower()}{e.sentence[1:].rstrip('.')}" for e in in_order(plant))
    picture = Picture(svg=formula_svg(motion_latex(plant), key))
    return Drawing(pictures=(picture,), caption=f"{words}.{_of_contacts(plant)}", formula=True)


def _of_contacts(plant: Plant) -> str:
    """Say what the stiffness and the damping of contacts are, which the formula calls k and d."""
    frequencies = {name for name in plant.parameters if name.endswith(".contact_frequency")}
    if not frequencies:
        return ""
    known = "are those of a stiff one and were not fitted" if frequencies <= set(plant.usual) else "follow from ν and χ"
    return f" The contact's stiffness k and damping d {known}."


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
