"""Differences as wide as a standard error, for errors that contacts leave rough on a small scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.identification.conditioning import well_conditioned
from servolens.identification.error_problem import COARSE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.identification.error_problem import Point, Problem
    from servolens.identification.linear_model import Linearised

__all__ = ["linearised_widely"]

NON_SMOOTH, WIDER = 1.5, 1e-2
"""Ratio of standard errors by wide and by narrow differences that betrays an error that is not smooth on a small scale;
the share of a parameter that is wide."""


def linearised_widely(problem: Problem, point: Point) -> tuple[Linearised, bool]:
    """Linearise over a standard error of each parameter; and tell whether contacts leave the error smooth.

    Then standard errors depend on how far one looks, and small local minima would count as information. What
    contacts disturb is looked at as widely as the way was found; else the width is approached from above, for such
    an error has many small widths that confirm themselves. Where wide differences claim to know a parameter better than
    fine ones do, they are too wide: of parameters that are known together alone, a standard error of one moves much.
    """
    finely = problem.linearise(point)
    fine = _widths(problem, point, finely.information)
    if fine is None:
        return finely, True
    narrow = np.minimum(fine, 0.1 * np.abs(point.values))
    found = problem.linearise(point, narrow)
    seen = _widths(problem, point, found.information)
    if seen is not None and (NON_SMOOTH * seen < fine).any():
        return finely, True
    touched = problem.touched
    if touched.any():
        wide = problem.linearise(point, np.where(touched, problem.share_of(point, WIDER), narrow))
        if not any(_is_wider(problem, point, seen, fine) for seen in (found, wide)):
            return found, True
        return problem.linearise(point, np.where(touched, problem.share_of(point, COARSE), narrow)), False
    if not _is_wider(problem, point, found, fine):
        return found, True
    widths = problem.share_of(point, COARSE)
    for _ in range(4):
        found = problem.linearise(point, widths)
        errors = _widths(problem, point, found.information)
        if errors is None or (errors > 0.5 * widths).all():
            break
        widths = np.minimum(widths, errors)
    return found, True


def _is_wider(problem: Problem, point: Point, found: Linearised, fine: NDArray[np.float64]) -> bool:
    """Tell whether standard errors are wider than the fine ones: of what contacts touch, if there are any."""
    wide = _widths(problem, point, found.information)
    judged = problem.touched if problem.touched.any() else np.full_like(problem.touched, True)
    return wide is not None and not (wide < NON_SMOOTH * fine)[judged].all()


def _widths(problem: Problem, point: Point, information: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the standard errors if the noise were white; None where the data do not determine all, or none is free."""
    if problem.free.size == 0 or not ((np.diag(information) > 0).all() and well_conditioned(information)):
        return None
    variance = problem.variance(point) * np.diag(np.linalg.inv(information))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
