"""The gain with its cliff and its spread, as a figure that follows sliders where the browser runs scripts."""

from __future__ import annotations

import json
from contextlib import suppress
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.design import settling_time, step_response
from servolens.design.scenarios import drawn
from servolens.errors import NumericalError
from servolens.processors import in_parallel
from servolens.report.content import Playground
from servolens.report.curves import curve
from servolens.report.drawing import drawing, keys_of
from servolens.report.figures_design import highest, last_gain, settling_curve
from servolens.report.gain_names import gain_names
from servolens.report.plots_design import Mark, plot_settling_times, plot_step_responses
from servolens.report.simulated import axis_json, design_json, plant_of
from servolens.report.style import HALF_WIDTH, panel_figure, styled
from servolens.summaries.gains import least_gain
from servolens.summaries.wording import number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.design import Design, PDSpec
    from servolens.design.scenarios import Scenario
    from servolens.effects import Effect
    from servolens.model import Model
    from servolens.plant import Plant
    from servolens.simulation import Simulation

    Band = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

__all__ = ["playground"]

FIRST_TRIED = 9
"""Gains over the whole range that are tried where the axis diverges with the one to begin with."""

SCENARIOS, SEED = 16, 2
"""Axes as they may be that the page shows; no other draws have this seed."""
GAINS_DRAWN, GAINS_OF_SPREAD, INSTANTS_OF_SPREAD = 161, 81, 201
"""Gains of the curve of settling time, and of its spread; instants of the spread of a step."""
SHOWN = 2.4
"""Settling times for which a step is drawn."""
SLIDER_BEGIN, SLIDER_END = 0.25, 2.5
"""Range of the slider of kp, as a share of the kp of the spec."""


@styled
def playground(key: str, model: Model, design: Design) -> Playground | None:
    """Return the step and the settling time of `design`, and what is needed to move its gains.

    None where the simulated axis diverges with every gain: it has the wrong sign, or cannot be held.

    Parameters
    ----------
    key : str
        Unique in the page.
    model : Model
        The one that the data support best, with its covariance and what it leaves unexplained.
    design : Design
        On it.
    """
    spec, plant = design.spec, model.plant
    names = gain_names(spec, plant)
    last = last_gain([design])
    begun = _begin(design, plant, last)
    if begun is None:
        return None
    shown, step = begun
    scenarios = drawn([model], [spec], SCENARIOS, np.random.default_rng([0, SEED]))
    gains = np.linspace(0.0, last, GAINS_DRAWN)
    line = settling_curve("as identified", plant, spec, gains, "velocity")
    top = highest([line], spec.settling_time)
    stepped = curve("as identified", step.time, step.position, "velocity").thinned()
    figures, (left, right) = zip(*(panel_figure(3.3, HALF_WIDTH, 0.75) for _ in range(2)), strict=True)
    plot_step_responses(
        [stepped],
        spec,
        length_unit=plant.length_unit,
        legend=False,
        spread=_step_spread(scenarios, spec, shown),
        ax=left,
    )
    _fit_step(left, spec)
    plot_settling_times(
        [line],
        [("velocity", () if design.withheld else design.intervals)],
        _marks(design),
        limit=spec.settling_time,
        gain=names.free_label,
        spread=_settling_spread(scenarios, spec, np.linspace(0.0, last, GAINS_OF_SPREAD), top),
        legend=False,
        top=top,
        ax=right,
    )
    left.set_title("The step")
    right.set_title("Settling time, its cliffs and its spread")
    right.set_xlim(0.0, last)
    caption = _caption(design, plant, shown)
    structures = {plant.structure: "nominal"}
    for scenario in scenarios:
        structures.setdefault(scenario.plant.structure, f"scenario{len(structures)}")
    data = _data(design, plant, scenarios, structures, last, shown)
    return Playground(
        drawing=drawing(key, list(figures), caption, legend=keys_of(left, right)),
        data=json.dumps(data, separators=(",", ":"), allow_nan=False),
        plants=tuple((name, plant_of(spec, structure)) for structure, name in structures.items()),
    )


def _caption(design: Design, plant: Plant, shown: float) -> str:
    spec = design.spec
    names = gain_names(spec, plant)
    gains = f"{names.kp} = {number(spec.kp)} {names.kp_unit} and {names.free} = {number(shown)} {names.free_unit}"
    first, shaded = "with", ""
    if design.kd is not None:
        first, shaded = "as designed with", "; shaded, the gains that meet the spec"
    return (
        f"The gain with its cliff and its spread. First the step of {number(abs(spec.reference))} {plant.length_unit},"
        f" {first} {gains}, the band and the time it holds from (dashed); then when the step settles, against"
        f" {names.free}{shaded}. Pale: {SCENARIOS} axes as they may be, drawn from what the data leave open, gains"
        " realised within 2 %, steps up and back. Where the line jumps, a swing touches the band: a gain beside such a"
        " cliff can miss the target by a whole swing. Simulated, no measured data."
    )


def _shown_gain(design: Design, last: float) -> float:
    """Return the gain with which the figure begins: the one to use, or where there is none one in the middle."""
    if design.recommended is not None:
        return design.recommended.kd
    return design.kd if design.kd is not None else float(f"{0.5 * last:.3g}")


def _begin(design: Design, plant: Plant, last: float) -> tuple[float, Simulation] | None:
    """Return the gain with which the figure begins and its step: another one where the axis diverges with it."""
    for gain in (_shown_gain(design, last), *np.linspace(0.0, last, FIRST_TRIED).tolist()):
        with suppress(NumericalError):
            return gain, step_response(plant, design.spec, gain, SHOWN * design.spec.settling_time)
    return None


def _marks(design: Design) -> list[Mark]:
    """Return the least gain, on its cliff, and the one to use."""
    found = []
    least = next(iter(design.verified), None)
    if design.kd is not None and least is not None and least.settling_time is not None:
        says = f"least, {least_gain(design)}"
        found.append(Mark(label=says, kd=design.kd, settling_time=least.settling_time, role="constant"))
    chosen = design.recommended
    if chosen is not None and chosen.settling_time is not None:
        says = f"recommended, {number(chosen.kd)}"
        found.append(Mark(label=says, kd=chosen.kd, settling_time=chosen.settling_time, role="command"))
    return found


def _fit_step(ax: Any, spec: PDSpec) -> None:
    """Leave room for the overshoot of other gains."""
    ends = sorted((-0.15 * spec.reference, 1.65 * spec.reference))
    ax.set(xlim=(0.0, SHOWN * spec.settling_time), ylim=ends)


def _step_spread(scenarios: Sequence[Scenario], spec: PDSpec, gain: float) -> Band:
    """Return from where to where the positions reach, steps back turned over."""
    time = np.linspace(0.0, SHOWN * spec.settling_time, INSTANTS_OF_SPREAD)
    found = [run for run in in_parallel(lambda s: _position(s, gain, time), scenarios) if run is not None]
    if not found:
        return time, np.full(INSTANTS_OF_SPREAD, np.nan), np.full(INSTANTS_OF_SPREAD, np.nan)
    return time, np.min(found, axis=0), np.max(found, axis=0)


def _position(scenario: Scenario, gain: float, time: NDArray[np.float64]) -> NDArray[np.float64] | None:
    try:
        run = step_response(
            scenario.plant, scenario.spec, scenario.realised * gain, float(time[-1]), back=scenario.back
        )
    except NumericalError:
        return None
    position = np.interp(time, run.time, run.position)
    return scenario.spec.reference - position if scenario.back else position


def _settling_spread(scenarios: Sequence[Scenario], spec: PDSpec, gains: NDArray[np.float64], top: float) -> Band:
    """Return the first and the last settling time at each gain; up to the `top` where one does not settle by then."""
    watched = min(1.02 * top, 4.0 * spec.settling_time)

    def ends(gain: float) -> tuple[float, float]:
        times = [_settles(scenario, gain, watched) for scenario in scenarios]
        known = [t for t in times if t is not None]
        return min(known, default=top), max(known) if len(known) == len(times) else top

    low, high = np.array(in_parallel(ends, gains.tolist())).T
    return gains, low, high


def _settles(scenario: Scenario, gain: float, watched: float) -> float | None:
    spec = scenario.spec
    try:
        run = step_response(scenario.plant, spec, scenario.realised * gain, watched, back=scenario.back)
    except NumericalError:
        return None
    left = (spec.reference - run.position) if not scenario.back else run.position
    return settling_time(run.time, left / spec.reference, spec.band)


def _data(
    design: Design,
    plant: Plant,
    scenarios: Sequence[Scenario],
    structures: dict[tuple[type[Effect], ...], str],
    last: float,
    shown: float,
) -> dict[str, Any]:
    """Return what ``page.js`` has to know."""
    spec = design.spec
    names = gain_names(spec, plant)
    integral = spec.kiv if spec.controller == "cascade" else spec.ki
    sliders = [
        _slider("kp", names.kp, names.kp_unit, spec.kp, SLIDER_BEGIN * spec.kp, SLIDER_END * spec.kp),
        _slider("free", names.free, names.free_unit, shown, 0.0, last),
    ]
    if integral:
        sliders.append(_slider("integral", names.integral, names.integral_unit, integral, 0.0, 3.0 * integral))
    own = [axis_json(structures[s.plant.structure], s.plant, s.spec, shown, s) for s in scenarios]
    return {
        "design": design_json(spec, plant),
        "nominal": axis_json(structures[plant.structure], plant, spec, shown),
        "scenarios": own,
        "sliders": sliders,
        "lengthUnit": plant.length_unit,
        "commandUnit": plant.command_unit,
        "shown": SHOWN,
        "gains": [0.0, last, GAINS_DRAWN, GAINS_OF_SPREAD],
        "settledWithin": 4.0,
        "times": INSTANTS_OF_SPREAD,
        "designed": sliders and [slider["value"] for slider in sliders],
    }


def _slider(key: str, name: str, unit: str, value: float, low: float, high: float) -> dict[str, Any]:
    """Return a slider; its steps are a power of ten, about a thousandth of its range or finer."""
    step = 10.0 ** (ceil(np.log10(high - low)) - 4)
    return {"key": key, "name": name, "unit": unit, "value": value, "low": low, "high": high, "step": step}
