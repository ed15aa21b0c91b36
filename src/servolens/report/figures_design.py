"""From a comparison to its figures: scans the gain, simulates the recommendations; :mod:`plots_design` draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.design import settling_time, step_response
from servolens.errors import NumericalError
from servolens.report.content import Drawing
from servolens.report.curves import curve
from servolens.report.plots_design import Mark, plot_settling_times, plot_step_responses
from servolens.report.style import new_figure, styled
from servolens.report.svg import svg
from servolens.summaries.wording import inside, number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.design import Comparison, Design, PDSpec
    from servolens.plant import Plant
    from servolens.report.curves import Curve, Role

__all__ = ["settling_figure", "steps_figure"]

GAINS = 201
JUMP = 0.06
"""A change of settling time from one gain to the next by this share of the loop's undamped period is a gap."""


@styled
def settling_figure(key: str, comparison: Comparison, linear: Plant, nonlinear: Plant, caption: str) -> Drawing:
    """Draw settling time against Kd of both models, feasible gains shaded, recommendations marked."""
    spec = comparison.nonlinear.spec
    top = _last_gain((comparison.linear, comparison.nonlinear))
    gains = np.linspace(0.0, top, GAINS)
    curves = [
        _settling_curve("linear model", linear, spec, gains, "constant"),
        _settling_curve("nonlinear model", nonlinear, spec, gains, "velocity"),
    ]
    marks: list[Mark] = []
    on = comparison.linear_on_nonlinear
    if on is not None and on.settling_time is not None:
        says = (
            f"linear recommendation {_least(comparison.linear)} on the nonlinear plant: {number(on.settling_time, 3)} s"
        )
        marks.append(Mark(label=says, kd=on.kd, settling_time=on.settling_time, role="constant"))
    own = next(iter(comparison.nonlinear.verified), None)
    if own is not None and own.settling_time is not None:
        says = f"nonlinear recommendation {_least(comparison.nonlinear)}: {number(own.settling_time, 3)} s"
        marks.append(Mark(label=says, kd=own.kd, settling_time=own.settling_time, role="velocity"))
    figure = new_figure(4.0)
    plot_settling_times(
        curves,
        [("constant", comparison.linear.intervals), ("velocity", comparison.nonlinear.intervals)],
        marks,
        limit=spec.settling_time,
        kd_unit=f"{nonlinear.command_unit} s/{nonlinear.length_unit}",
        top=_highest(curves, spec.settling_time),
        ax=figure.add_subplot(),
    )
    return Drawing(svg=svg(figure, key), caption=caption)


@styled
def steps_figure(key: str, comparison: Comparison, nonlinear: Plant, caption: str) -> Drawing:
    """Draw the step responses of both recommendations on the nonlinear plant, the band magnified."""
    spec = comparison.nonlinear.spec
    designs: list[tuple[str, Role, Design]] = [
        ("linear", "constant", comparison.linear),
        ("nonlinear", "velocity", comparison.nonlinear),
    ]
    curves = []
    for name, role, design in designs:
        if design.kd is not None:
            run = step_response(nonlinear, spec, design.kd, 2.4 * spec.settling_time)
            label = f"{name} recommendation, Kd = {_least(design)}"
            curves.append(curve(label, run.time, run.position, role).thinned())
    figure = new_figure(3.4)
    whole, magnified = figure.subplots(1, 2)
    window = (0.35 * spec.settling_time, 2.0 * spec.settling_time)
    titles = ("The whole step", f"Magnified: the band of ±{100 * spec.band:g} %")
    for ax, zoom, title in ((whole, None, titles[0]), (magnified, window, titles[1])):
        plot_step_responses(
            curves,
            reference=spec.reference,
            band=spec.band,
            settling_time=spec.settling_time,
            length_unit=nonlinear.length_unit,
            zoom=zoom,
            title=title,
            legend=False,
            ax=ax,
        )
    magnified.set_ylabel("")
    handles, labels = whole.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), handlelength=3.2)
    return Drawing(svg=svg(figure, key), caption=caption)


def _settling_curve(label: str, plant: Plant, spec: PDSpec, gains: NDArray[np.float64], role: Role) -> Curve:
    swing = 2.0 * np.pi / np.sqrt(max(abs(plant.gain) * spec.kp, 1e-12))
    watched = max(4.0 * spec.settling_time, 2.0 * swing)
    times = np.array([_settles(plant, spec, float(kd), watched) for kd in gains])
    jumps = np.flatnonzero(np.abs(np.diff(times)) > JUMP * swing) + 1
    return curve(label, np.insert(gains, jumps, np.nan), np.insert(times, jumps, np.nan), role)


def _highest(curves: Sequence[Curve], limit: float) -> float:
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


def _last_gain(designs: Sequence[Design]) -> float:
    ends = [high for design in designs for _, high in design.intervals]
    searched = designs[-1].certificate.searched[1]
    return min(1.15 * max(ends), searched) if ends else searched


def _least(design: Design) -> str:
    """Return the least gain, rounded so that it still meets the spec."""
    return inside(*design.intervals[0])[0]
