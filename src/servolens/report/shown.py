"""The main figure of a result, for scripts and notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.prediction import prediction_residual
from servolens.report.curves import curve
from servolens.report.plots import plot_curves
from servolens.report.plots_design import plot_step_responses
from servolens.report.style import FULL_WIDTH, styled
from servolens.summaries.wording import listed, number

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from servolens.design import Design
    from servolens.diagnosis import Diagnosis
    from servolens.identification import Fit, Identification
    from servolens.plant import Plant
    from servolens.prediction import Prediction
    from servolens.record import Record
    from servolens.report.curves import Curve, Role
    from servolens.result import Result

    Lines = list[tuple[str, Role, list[NDArray[np.float64] | None]]]

__all__ = ["plot_result"]

MOST_DRAWN = 6
"""Records of which a figure can be read."""
COLUMNS = 2
"""Of the legend below a figure."""
ROLES: tuple[Role, ...] = ("velocity", "constant", "varying", "third", "second")


@styled
def plot_result(result: Result, ax: Axes | None = None) -> Axes:
    """Draw measured and simulated positions; of a design the step with its gains.

    Parameters
    ----------
    result : Result
        A fit, identification, diagnosis, design or prediction.
    ax : Axes, optional
        Where; a new figure of pyplot's, which a notebook shows, when None.

    Raises
    ------
    InputError
        If the result was read from a file, which holds no records, or a design has no gain.
    """
    about: Any = result
    draw = _step if result.kind == "design" else _responses
    if ax is not None:
        return draw(about, ax)
    from matplotlib import pyplot as plt

    figure, own = plt.subplots(figsize=(FULL_WIDTH, 4.0), layout="constrained")
    try:
        draw(about, own)
    except InputError:
        plt.close(figure)  # a notebook would show it empty
        raise
    lines, inside = own.get_legend_handles_labels(), own.get_legend()
    if inside is not None:
        inside.remove()
    figure.legend(*lines, loc="outside lower center", ncols=COLUMNS, handlelength=3.2)  # inside, lines are everywhere
    return own


def _responses(result: Any, ax: Axes) -> Axes:
    records: Sequence[Record] = result.records[:MOST_DRAWN]
    if not records:
        raise InputError("this result was read from a file, which holds no records; draw .simulate(records).plot()")
    lines = LINES_OF_KIND[result.kind](result, records)
    curves: list[Curve] = []
    for i, record in enumerate(records):
        first = i == 0
        if record.reference is not None:
            curves.append(curve("reference" if first else "", record.time, record.reference, "reference"))
        curves.append(curve("measured" if first else "", record.time, record.position, "measured").thinned())
        for label, role, positions in lines:
            position = positions[i]
            if position is not None:
                curves.append(curve(label if first else "", record.time, position, role).thinned())
    shown = len(records) < len(result.records)
    names = (
        f"The first {len(records)} of {len(result.records)} records"
        if shown
        else listed([r.name for r in records], most=3)
    )
    return plot_curves(curves, xlabel="Time [s]", ylabel=f"Position [{records[0].length_unit}]", title=names, ax=ax)


def _simulated(plants: Mapping[str, tuple[Role, Plant]], records: Sequence[Record]) -> Lines:
    return [(label, role, [_position(plant, record) for record in records]) for label, (role, plant) in plants.items()]


def _position(plant: Plant, record: Record) -> NDArray[np.float64] | None:
    """Return the simulated position; None where the simulation of the axis diverges."""
    try:
        return np.asarray(record.position + prediction_residual(plant, record))
    except NumericalError:
        return None


def _fit(fit: Fit, records: Sequence[Record]) -> Lines:
    return _simulated({"fitted": ("velocity", fit.plant)}, records)


def _identification(found: Identification, records: Sequence[Record]) -> Lines:
    plants: dict[str, tuple[Role, Plant]] = {}
    if found.constant is not None:
        plants["constant damping"] = ("constant", found.constant.plant)
    if found.velocity is not None:
        plants["damping that depends on speed"] = ("velocity", found.velocity.plant)
    return _simulated(plants, records)


def _diagnosis(diagnosis: Diagnosis, records: Sequence[Record]) -> Lines:
    plants: dict[str, tuple[Role, Plant]] = {"gain and damping": ("constant", diagnosis.linear.plant)}
    if diagnosis.causes:
        plants["with the causes"] = ("velocity", diagnosis.plant)
    return _simulated(plants, records)


def _prediction(prediction: Prediction, records: Sequence[Record]) -> Lines:
    return [
        (name, ROLES[j % len(ROLES)], [row[j] for row in prediction.positions[: len(records)]])
        for j, name in enumerate(prediction.models)
    ]


def _step(design: Design, ax: Axes) -> Axes:
    spec = design.spec
    gains: list[tuple[str, Role, float | None]] = [("least", "constant", design.kd)]
    if design.recommended is not None:
        gains.append(("recommended", "velocity", design.recommended.kd))
    curves = []
    for label, role, kd in gains:
        if kd is None:
            raise InputError(f"this design gives no gain to draw ({design.reason})")
        run = design.step(kd, duration=2.4 * spec.settling_time)
        curves.append(curve(f"{label}, {spec.free} = {number(kd)}", run.time, run.position, role).thinned())
    ax = plot_step_responses(curves, spec, length_unit=design.plant.length_unit, ax=ax)
    ax.set_title(f"Step with kp = {number(spec.kp)}")
    return ax


LINES_OF_KIND: dict[str, Callable[[Any, Sequence[Record]], Lines]] = {
    "fit": _fit,
    "identification": _identification,
    "diagnosis": _diagnosis,
    "prediction": _prediction,
}
