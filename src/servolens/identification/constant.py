"""Constant damping by the integral equation, with error bars that know what the noise does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.findings import Finding
from servolens.identification.explained import Explained, excerpt_of, explained
from servolens.identification.integral import Pieces, assemble, solve_integral
from servolens.identification.score import FALSE_ALARM
from servolens.identification.uncertainty import LinearEstimate
from servolens.identification.velocity import law_left
from servolens.model import Model
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.integral import Prior
    from servolens.identification.segments import Segment

__all__ = ["ConstantFit", "fit_constant"]

CONTRADICTS = 3.0
"""Standard deviations from a prior from which on the records contradict it."""
NAMES = ("damping", "gain")


@final
@dataclass(frozen=True, slots=True, eq=False)
class ConstantFit:
    """The model, what is left beside it, and findings."""

    model: Model
    left: Explained
    findings: tuple[Finding, ...]


def fit_constant(segments: Sequence[Segment], priors: Mapping[str, Prior]) -> ConstantFit:
    """Fit gain and damping to all `segments`; `priors` are combined with that by their variances.

    Where something shakes the axis, or the controller answers to its noise, the fit by simulation is the answer.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion.
    priors : mapping of str to Prior
        Knowledge from elsewhere; that of parameters other than gain and damping is not used.
    """
    shares = [Pieces.whole(s.time.size) for s in segments]
    estimate = solve_integral(assemble(segments, shares)).x
    first = segments[0].record
    known = {name: priors[name] for name in NAMES if name in priors}

    def plant(values: NDArray[np.float64]) -> Plant:
        damping, gain = (float(v) for v in values)
        return Plant(gain=gain, damping=damping, length_unit=first.length_unit, command_unit=first.command_unit)

    left = explained(plant(estimate), excerpt_of(segments)[0])
    covariance = LinearEstimate.of(segments, shares).covariance(estimate[:-1], left.noise)
    if left.is_enough and (left.loop is not None or left.noise.rate > 0.0):
        refined = left.optimum(left.likelihood.records)
        simulated = np.array(refined.plant.values)[::-1]
        if _agree(simulated - estimate, covariance) and not _is_law_likelier(left, segments):
            estimate, covariance = simulated, refined.covariance[::-1, ::-1]
        else:
            left = replace(left, is_enough=False)
    free = Model(plant=plant(estimate), covariance=covariance[::-1, ::-1])
    if known and not left.is_enough:
        refined = law_left(segments, {}).optimum(left.likelihood.records)
        free = Model(plant=refined.plant, covariance=refined.covariance)
    for index, name in enumerate(NAMES):
        if name in known:
            weight = covariance[:, index] / (covariance[index, index] + known[name].deviation ** 2)
            estimate = estimate + weight * (known[name].value - estimate[index])
            covariance = covariance - np.outer(weight, covariance[index])
    model = Model(
        plant=plant(estimate),
        covariance=covariance[::-1, ::-1],
        identified_from=tuple(dict.fromkeys(s.record.name for s in segments)),
    )
    return ConstantFit(model, left, _contradicted(free, known))


def _is_law_likelier(left: Explained, segments: Sequence[Segment]) -> bool:
    """Tell whether damping against speed makes the records likelier: then what seems to shake the axis is its law."""
    law = law_left(segments, {})
    if law.hypothesis is None or left.hypothesis is None:
        return law.hypothesis is not None
    added = len(law.hypothesis.plant.values) - len(left.hypothesis.plant.values)
    return law.hypothesis.misfit + added * float(np.log(left.likelihood.samples)) < left.hypothesis.misfit


def _agree(difference: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
    """Tell whether two estimates differ by chance only: of a model that is right they do.

    Hausman, *Specification tests in econometrics*, Econometrica 46 (1978), doi:10.2307/1913827.
    """
    from scipy.stats import chi2

    statistic = float(difference @ np.linalg.solve(covariance, difference))
    return statistic <= float(chi2.isf(FALSE_ALARM, difference.size))


def _contradicted(free: Model, known: Mapping[str, Prior]) -> tuple[Finding, ...]:
    """Name the priors that a fit without them is far from."""
    found = []
    for name, prior in known.items():
        value, spread = free.quantities[name].value, free.quantities[name].stderr or 0.0
        if abs(value - prior.value) > CONTRADICTS * np.hypot(spread, prior.deviation):
            message = (
                f"the prior on {name}, {prior.value:g} ± {prior.deviation:g}, contradicts the records, which give "
                f"{value:.4g} ± {spread:.2g}; check its value, unit and width."
            )
            found.append(Finding(code="prior_contradicts_data", severity="warning", message=message))
    return tuple(found)
