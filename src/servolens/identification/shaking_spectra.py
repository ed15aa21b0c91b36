"""Error bars on a shaken axis, which allow for how little is known of what shakes it.

A record holds few correlation times of what shakes an axis slowly, so that many spectra of it are about as likely; and
the likeliest is too small at low frequencies, for parameters and initial states have taken up a part of it. Beside each
spectrum the records say what the parameters are and how well they are known. Error bars are of the mean over them all,
by their restricted likelihood (see :mod:`servolens.identification.restricted`) and the reference prior of a first-order
process (Berger and Yang 1994, doi:10.1017/S0266466600008690).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.noise_search import CORNERS
from servolens.identification.restricted import estimated, parts_at

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import NoiseModel
    from servolens.identification.refine import Refinement

__all__ = ["counting_all_spectra"]

STEP = 2.0**0.5
"""Factor from one spectrum to the next: of the power above its corner, or of the corner while that power stays."""
UNLIKELY = 8.0
"""Difference of −2 log-likelihood from the likeliest spectrum from which on one, of 1/55 its weight, is left alone."""
MOST = 80
"""Spectra that are looked at."""

_Place = tuple[int, int]


class _Beside(NamedTuple):
    """What the records say beside one spectrum.

    −2 log of its probability; by how much the free parameters differ, shape (k,), and their variances, shape (k,).
    """

    misfit: float
    change: NDArray[np.float64]
    variances: NDArray[np.float64]


def counting_all_spectra(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with error bars of all spectra that may shake the axis.

    Where the noise does not shake the axis, nothing changes. Parameters and result are those of
    :func:`~servolens.identification.fitted.with_error_bars`.
    """
    if noise.rate == 0.0:
        return refined
    options, simulated = likelihood.options(refined.plant), 0

    def beside(place: _Place) -> _Beside | None:
        nonlocal simulated
        power, corner = place
        other = replace(
            noise, rate=noise.rate * STEP ** (0.25 * power - 0.5 * corner), corner=noise.corner * STEP**corner
        )
        if not CORNERS[0] <= other.corner / likelihood.rate <= CORNERS[1] and place != (0, 0):
            return None
        runs = likelihood.runs(other, unpowered=unpowered)
        problem = Problem(refined.plant, runs, options, None)
        determinant = sum(run.whiten.log_determinant for run in runs) - float(np.log(other.corner))
        try:
            return _beside(problem, refined, determinant)
        except NumericalError:
            return None
        finally:
            simulated += problem.simulated

    found = list(_likely(beside))
    likelihood.tally.add(simulated)
    if not found:
        return refined
    columns = Problem(refined.plant, likelihood.runs(noise, unpowered=unpowered), options, None).free
    factors = np.ones(len(refined.covariance))
    factors[columns[::-1]] = _widened(found)[::-1]  # of parameters of the records' own the first
    return replace(refined, covariance=refined.covariance * np.outer(factors, factors))


def _likely(beside: Callable[[_Place], _Beside | None]) -> Iterator[_Beside]:
    """Yield what is said beside the spectrum at (0, 0), then beside the likely ones that are reached from there."""
    queue, least, count = [(0, 0)], np.inf, 0
    for place in queue:  # which grows meanwhile
        found = beside(place) if count < MOST else None
        if found is None:
            continue
        yield found
        least, count = min(least, found.misfit), count + 1
        if found.misfit <= least + UNLIKELY:
            i, j = place
            queue += [p for p in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if p not in queue]


def _beside(problem: Problem, refined: Refinement, determinant: float) -> _Beside:
    """Return what the records say beside the noise of `problem`, as far as residuals are linear about the `refined`.

    The `determinant` is −2 log of the noise's Jacobian and of how likely it is beforehand.

    Raises
    ------
    NumericalError
        If the plant cannot be simulated.
    """
    _, parts = parts_at(problem, refined)
    k = problem.free.size
    found = estimated(parts, determinant)
    return _Beside(found.misfit, found.change[:k], found.variances[:k])


def _widened(found: Sequence[_Beside]) -> NDArray[np.float64]:
    """Return how many times each standard deviation is that beside the first alone, shape (k,)."""
    misfits = np.array([beside.misfit for beside in found])
    weights = np.exp(-0.5 * (misfits - misfits.min()))
    weights /= weights.sum()
    variances = weights @ np.array([beside.variances + beside.change**2 for beside in found])
    alone = found[0].variances
    return np.asarray(np.sqrt(np.divide(variances, alone, out=np.ones_like(alone), where=alone > 0.0)))
