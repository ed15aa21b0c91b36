"""Linear and nonlinear recommendation, side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design.found import Comparison
from servolens.design.least_kd import tune
from servolens.design.settle import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["compare"]


def compare(
    linear: Plant, nonlinear: Plant, spec: PDSpec, *, progress: Callable[[str, int, int], None] | None = None
) -> Comparison:
    """Design on each model and run the linear recommendation on the nonlinear plant.

    Parameters
    ----------
    linear, nonlinear : Plant
        Two models of the same axis.
    spec : PDSpec
        What to reach.
    progress : callable, optional
        Called with (description, done, total).
    """
    first = tune(linear, spec, progress=progress)
    second = tune(nonlinear, spec, progress=progress)
    crossed = None if first.kd is None else evaluate(nonlinear, spec, first.kd)
    return Comparison(linear=first, nonlinear=second, linear_on_nonlinear=crossed)
