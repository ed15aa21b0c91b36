"""The lowest of the many minima that contacts give a likelihood, looked for beside an observer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.likelihood import SOME
from servolens.identification.minimiser import lowest_minimum
from servolens.identification.noise_search import shaken

if TYPE_CHECKING:
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood

__all__ = ["lowest"]

FORGETS = 2.0
"""Rate of the observer, in units of the loops' own: somewhat faster ones tell the parameters less, slower ones leave
minima everywhere. Chosen on axes of the laboratory."""


def lowest(likelihood: Likelihood, hypothesis: Hypothesis, allowance: float) -> Hypothesis | None:
    """Return where `hypothesis` leads from the lowest minimum beside an observer; None where that fails.

    An axis that hunts within a play multiplies a small difference with every bounce: a simulation of a whole record has
    no slope that leads to the truth, however close. An observer forgets bounces that are past, so that what is missed
    grows with the distance; along the direction that the records know least it is looked at from afar.

    Parameters
    ----------
    likelihood : Likelihood
        Of the records.
    hypothesis : Hypothesis
        Of a plant with contacts.
    allowance : float
        Work after which no descent goes on; the search may take so much, and the fit that follows it as much again.
    """
    plant, noise = hypothesis.plant, shaken(likelihood.white, likelihood.rate, FORGETS)
    runs = likelihood.runs(noise, unpowered=hypothesis.unpowered)
    problem = Problem(plant, runs, likelihood.options(plant), likelihood.weighed_by(noise))
    problem.allowance, problem.most_substeps = allowance, likelihood.most_substeps
    try:
        point = problem.start(hypothesis.starts, hypothesis.local)
        problem.weigh_priors(point)
        point, _ = lowest_minimum(problem, point, SOME, converged=True)
    except (InputError, NumericalError):
        return None
    finally:
        likelihood.tally.add(problem.simulated)
    found = replace(
        hypothesis,
        plant=problem.plant_at(point.values, 0),
        noise=noise if any(likelihood.rates) else likelihood.white,
        starts=tuple(point.starts),
        local=problem.local_values(point),
    )
    return likelihood.judged(found.plant, found, allowance=allowance)
