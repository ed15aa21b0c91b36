"""Error bars of an axis that runs away from a simulation: it was held on a slope that it slides off by itself.

Between the teeth of a motor, or upright, a position loop holds what would fall. Driven by the logged voltage alone the
simulation then leaves the axis, exponentially: a hundred-thousandth of an amplitude decides whether it is a tooth off,
and the sensitivities there say that the records know the amplitude far better than they do. What is
predicted has to forget its errors (L. Ljung, *System Identification*, 1999, section 4.3), so that such error bars are
those of a fit with an observer. They are rather too wide than too narrow, for an observer forgets more than it has to.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Known
from servolens.identification.noise_search import CORNER
from servolens.identification.observed import ObservedRun
from servolens.identification.refine import minimise_error
from servolens.simulation.rates import substeps_for, work_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import NoiseModel
    from servolens.identification.refine import Refinement
    from servolens.plant import Plant

__all__ = ["counting_unsteadiness"]

GROWS = 3.0
"""Times that a knock may move the axis farther than it moves one that nothing pulls: what is held moves less. At 10 the
errors of one of two axes that were looked at (development seeds) still were three times the error bars."""
KNOCKS = 12
"""For each record, evenly in time."""
RATES = tuple(2.0**k for k in range(-6, 5))
"""Of the observers that are tried, the slowest first, which keeps most of what the records say; in units of the loops'
own."""


def counting_unsteadiness(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with the error bars of an observer where a simulation runs away.

    Where the observer that the noise asks for forgets its errors, nothing changes; nor where none does. Parameters and
    result are those of :func:`~servolens.identification.fitted.with_error_bars`.
    """
    plant = refined.plant
    if not _may_fall(plant.structure):
        return refined
    plants = [refined.plant_of(i) for i in range(len(likelihood.records))]
    with suppress(InputError, NumericalError):
        if all(_forgets(likelihood, noise, plants, refined.starts, unpowered=unpowered)):
            return refined
        for rate in (rate * likelihood.rate for rate in RATES if rate * likelihood.rate > noise.rate):
            observed = replace(noise, rate=rate, corner=noise.corner or CORNER * likelihood.rate)
            if all(_forgets(likelihood, observed, plants, refined.starts, unpowered=unpowered)):
                runs, options = likelihood.runs(observed, unpowered=unpowered), likelihood.options(plant)
                weights, known = likelihood.weighed_by(observed), Known(refined.starts, refined.local)
                other = minimise_error(plant, runs, options, noise=weights, known=known)
                return _widened(refined, other)
    return refined


def _widened(refined: Refinement, other: Refinement) -> Refinement:
    """Return the refinement with the error bars of the `other` one, where those are wider."""
    ratios = np.diag(other.covariance) / np.diag(refined.covariance)
    factors = np.sqrt(np.maximum(np.nan_to_num(ratios, nan=1.0, posinf=1.0), 1.0))
    return replace(refined, covariance=refined.covariance * np.outer(factors, factors))


def _forgets(
    likelihood: Likelihood,
    noise: NoiseModel,
    plants: Sequence[Plant],
    starts: Sequence[NDArray[np.float64]],
    *,
    unpowered: bool,
) -> Iterator[bool]:
    """Yield for each knock whether the axis, predicted beside `noise`, forgets it as one would that nothing pulls."""
    runs = likelihood.runs(noise, unpowered=unpowered)
    for run, plant, start in zip(runs, plants, starts, strict=True):
        if not isinstance(run, ObservedRun):
            continue
        voltage, time, steps = run.signals.voltage, run.signals.time, substeps_for(plant, run.sample_time)
        as_is = run.missed(plant, start, steps)
        likelihood.tally.add((KNOCKS + 1) * work_of(plant, run.simulated, run.sample_time, steps))
        speed = noise.floor * likelihood.rate
        for k in np.linspace(0, time.size - 2, KNOCKS, dtype=int):
            push = np.zeros(voltage.size)
            push[k] = speed / (abs(plant.gain) * float(time[k + 1] - time[k]))
            moved = float(np.max(np.abs(run.missed(plant, start, steps, push=push) - as_is)))
            free = speed * min(float(time[-1] - time[k]), 1.0 / max(plant.damping, 1e-9))
            yield moved <= GROWS * free


@lru_cache(maxsize=256)
def _may_fall(structure: tuple[type[Effect], ...]) -> bool:
    """Whether a force depends on the position, so that the axis may slide off where it was held."""
    import casadi as ca

    from servolens.dynamics import dynamics

    d = dynamics(structure)
    return bool(ca.depends_on(d.push, d.position))
