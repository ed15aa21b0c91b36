"""Error bars on a shaken axis with a coupling, a play or a stop, by draws of what its observer leaves.

The observer assumes that what shakes the axis changes the velocity of one mass, at any time alike. But a flexible
coupling rings for it, a load waits within a play, and a stop turns the velocity back at an instant that depends on what
shook the axis before. What is missed is then neither white nor always as large, and a few touches or one mode of little
damping decide on a parameter, which takes it up, so that no residual shows it. So the whole axis is simulated as it is
shaken, the observer follows each draw of it, and the error bars are those of the estimates that would come of it
(parametric bootstrap, linear about the optimum: Efron and Tibshirani 1993, chapter 6).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Transmission
from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.restricted import SEEN, parts_at
from servolens.identification.rounding import DRAWS
from servolens.identification.shaken import shaken

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import NoiseModel
    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.identification.refine import Refinement
    from servolens.plant import Plant

__all__ = ["counting_answers_to_shaking"]


def counting_answers_to_shaking(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with error bars that allow for how the axis answers to its shaking.

    Where nothing shakes the axis, or it is one mass that meets nothing, nothing changes. Parameters and result are
    those of :func:`~servolens.identification.fitted.with_error_bars`.
    """
    if noise.rate == 0.0 or likelihood.simulates or not _answers_otherwise(refined.plant):
        return refined
    runs = likelihood.runs(noise, unpowered=unpowered)
    problem = Problem(refined.plant, runs, likelihood.options(refined.plant), None)
    covariance = refined.covariance.copy()
    with suppress(InputError, NumericalError):
        variances = _variances(problem, runs, refined)
        columns = problem.free[::-1]  # of parameters of the records' own the first
        drawn = np.zeros(len(covariance))
        drawn[columns] = variances[::-1]
        known = np.nan_to_num(np.diag(covariance))
        ratios = np.divide(drawn, known, out=np.ones_like(known), where=known > 0.0)
        factors = np.sqrt(np.maximum(ratios, 1.0))
        covariance *= np.outer(factors, factors)
    likelihood.tally.add(problem.simulated + 2 * DRAWS * sum(run.simulated for run in runs))
    return replace(refined, covariance=covariance)


def _answers_otherwise(plant: Plant) -> bool:
    """Tell whether a force on the axis does more to it than change the velocity of one mass."""
    return any(isinstance(effect, Transmission) or effect.contact_rate > 0.0 for effect in plant.effects)


def _variances(
    problem: Problem, runs: Sequence[ObservedRun | SimulatedRun], refined: Refinement
) -> NDArray[np.float64]:
    """Return the mean square of each free parameter's error over the draws, shape (k,)."""
    _, parts = parts_at(problem, refined)
    plants = [refined.plant_of(i) for i in range(len(runs))]
    drawn = shaken(runs, plants, refined.starts)
    sensitivity = np.vstack([part.sensitivity for part in parts])
    lengths = np.linalg.norm(sensitivity, axis=0)
    lengths[lengths == 0.0] = 1.0
    answers = np.linalg.pinv(sensitivity / lengths, rcond=SEEN**0.5) / lengths[:, None]
    ends = np.cumsum([0, *(part.left.size for part in parts)])
    errors = sum(
        answers[: problem.free.size, end : end + draws.shape[0]] @ draws
        for end, draws in zip(ends, drawn, strict=False)
    )
    return np.asarray(np.mean(np.square(errors), axis=1))
