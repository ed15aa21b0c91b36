"""Linear, nonlinear and diagnosed recommendation, side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design.found import Comparison
from servolens.design.least_kd import tune
from servolens.design.settle import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.found import Design, Response
    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["compare"]


def compare(
    linear: Plant,
    nonlinear: Plant,
    spec: PDSpec,
    *,
    diagnosed: Plant | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Design on each model, and run the simpler models' recommendations on the richer plants.

    Parameters
    ----------
    linear, nonlinear : Plant
        Two models of the same axis.
    spec : PDSpec
        What to reach.
    diagnosed : Plant, optional
        The model that the data support best, where causes were looked for.
    progress : callable, optional
        Called with (description, done, total).
    """
    first = tune(linear, spec, progress=progress)
    second = tune(nonlinear, spec, progress=progress)
    on = _run(nonlinear, first)
    if diagnosed is None:
        return Comparison(plants=(linear, nonlinear), linear=first, nonlinear=second, linear_on_nonlinear=on)
    return Comparison(
        plants=(linear, nonlinear, diagnosed),
        linear=first,
        nonlinear=second,
        linear_on_nonlinear=on,
        diagnosed=tune(diagnosed, spec, progress=progress),
        linear_on_diagnosed=_run(diagnosed, first),
        nonlinear_on_diagnosed=_run(diagnosed, second),
    )


def _run(plant: Plant, design: Design) -> Response | None:
    return None if design.kd is None else evaluate(plant, design.spec, design.kd)
