"""The figure of what a simulation misses, record by record, without and with the causes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from matplotlib.figure import Figure

from servolens.diagnosis.errors import residual
from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_of
from servolens.report.plots_diagnosis import plot_residuals
from servolens.report.style import ALONE, HALF_WIDTH, panel_figure, styled
from servolens.report.wording import shown
from servolens.summaries.wording import scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.diagnosis import Diagnosis
    from servolens.record import Record
    from servolens.report.content import Drawing
    from servolens.report.curves import Curve, Role

__all__ = ["residuals_figure"]

MOST_RECORDS, MOST_ROWS = 8, 6
"""Records drawn two abreast; one a row."""
HELD_OUT = 2
"""How many of them are the last that were held out."""
DEVIATIONS = 2.0
ENLARGED = 2.0
"""Times from which on what is left with the causes is drawn again, enlarged."""
MODELS: dict[str, Role] = {"gain and damping": "constant", "with the causes": "velocity"}


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Missed:
    """What the simulations of a record miss [m or rad]; not finite where one leaves all bounds."""

    record: Record
    title: str
    by_model: dict[str, NDArray[np.float64]]

    def known(self, *names: str) -> list[str]:
        """Return those of the models `names` whose simulation stays in bounds."""
        return [name for name in names or self.by_model if np.isfinite(self.by_model[name]).all()]

    def largest(self, name: str) -> float:
        """Return the largest size of what a model misses, 0 if it is not known."""
        return float(np.abs(self.by_model[name]).max()) if self.known(name) else 0.0

    def curves(self, factor: float, *names: str) -> list[Curve]:
        """Return what is missed over time, in the unit of a panel."""
        return [curve(name, self.record.time, factor * self.by_model[name], MODELS[name]).thinned() for name in names]


@styled
def residuals_figure(key: str, diagnosis: Diagnosis) -> Drawing:
    """Draw what the simulation misses in each record; with causes, what is left beside it, enlarged."""
    plants = dict(zip(MODELS, [diagnosis.linear.plant, *([diagnosis.plant] if diagnosis.causes else [])], strict=False))
    runs = [*((r, False) for r in diagnosis.records), *((r, True) for r in diagnosis.heldout)]
    drawn = runs if len(runs) <= _most(diagnosis) else [*runs[: _most(diagnosis) - HELD_OUT], *runs[-HELD_OUT:]]
    found = [{name: residual(plant, record) for name, plant in plants.items()} for record, _ in drawn]
    missed = [
        _Missed(record, shown(record.name) + held * " (held out)", own)
        for (record, held), own in zip(drawn, found, strict=True)
    ]
    noise = DEVIATIONS * diagnosis.noise_floor
    times = _enlargement(missed, noise)
    axes = _abreast(missed, noise) if times is None else _side_by_side(missed, noise, times)
    figures = [figure for ax in axes if isinstance(figure := ax.figure, Figure)]
    caption = _caption(diagnosis, missed, enlarged=times is not None, left_out=len(runs) - len(drawn))
    return drawing(key, figures, caption, legend=keys_of(*axes))


def _most(diagnosis: Diagnosis) -> int:
    return MOST_ROWS if diagnosis.causes else MOST_RECORDS


def _enlargement(missed: Sequence[_Missed], noise: float) -> float | None:
    """Return by how much the errors with the causes can be enlarged; None if there are none, or hardly."""
    before, after = MODELS
    left = [m.largest(after) for m in missed if after in m.by_model and m.known(after)]
    if not left:
        return None
    times = max(m.largest(name) for m in missed for name in (before, after)) / max(*left, noise)
    return times if times >= ENLARGED else None


def _abreast(missed: Sequence[_Missed], noise: float) -> list[Axes]:
    """Draw each record in a picture of its own."""
    factor, ylabel = _unit(missed, noise, *MODELS)
    axes = []
    for own in missed:
        ax = panel_figure(1.9, ALONE if len(missed) == 1 else HALF_WIDTH)[1]
        plot_residuals(own.curves(factor, *own.known()), factor * noise, title=own.title, ax=ax)
        axes.append(ax)
    return _in_one_scale(axes, ylabel)


def _side_by_side(missed: Sequence[_Missed], noise: float, times: float) -> list[Axes]:
    """Draw of each record both models, and beside that, enlarged, what is left with the causes."""
    after, title = [*MODELS][1], f"enlarged {float(f'{times:.1g}'):g} times"
    whole, close = _unit(missed, noise, *MODELS), _unit(missed, noise, after)
    left, right = [], []
    for own in missed:
        first, second = (panel_figure(1.9, HALF_WIDTH)[1] for _ in range(2))
        plot_residuals(own.curves(whole[0], *own.known()), whole[0] * noise, title=own.title, ax=first)
        plot_residuals(own.curves(close[0], *own.known(after)), close[0] * noise, title=title, ax=second)
        left.append(first)
        right.append(second)
    both = zip(_in_one_scale(left, whole[1]), _in_one_scale(right, close[1]), strict=True)
    return [ax for pair in both for ax in pair]


def _unit(missed: Sequence[_Missed], noise: float, *names: str) -> tuple[float, str]:
    """Return the factor of the unit in which what models miss is easy to read, and the label of that axis."""
    sizes = [own.largest(name) for own in missed for name in names if name in own.by_model]
    factor, length = scale([*sizes, noise], missed[0].record.length_unit)
    return factor, f"Simulated −\nmeasured [{length}]"


def _in_one_scale(axes: list[Axes], ylabel: str) -> list[Axes]:
    """Give all panels the range of the largest."""
    ends = [ax.get_ylim() for ax in axes]
    for ax in axes:
        ax.set_ylim(min(low for low, _ in ends), max(high for _, high in ends))
        ax.set(xlabel="Time [s]", ylabel=ylabel)
    return axes


def _caption(diagnosis: Diagnosis, missed: Sequence[_Missed], *, enlarged: bool, left_out: int) -> str:
    told = ["Simulated minus measured position."]
    if enlarged:
        told = [
            "Simulated minus measured position; the last picture shows what is left with the causes only, enlarged."
        ]
    told.append(f"Green: the noise of the position, ± {DEVIATIONS:g} standard deviations.")
    if diagnosis.heldout:
        told.append("Records marked as held out took no part in fit and choice; the others were fitted.")
    else:
        told.append("Fitted to these very data: not held out.")
    if left_out:
        told.append(f"{left_out} more records are in the table only.")
    lost = [f"{name} on {shown(own.record.name)}" for own in missed for name in own.by_model if not own.known(name)]
    if lost:
        told.append(f"Not drawn, because the simulation diverges: {', '.join(lost)}.")
    return " ".join(told)
