"""Constant damping by the integral equation, with error bars that know what the noise does."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import NumericalError
from servolens.findings import Finding
from servolens.identification.explained import Explained, excerpt_of, explained
from servolens.identification.fitted import AT_BOUND, GIVEN
from servolens.identification.integral import Pieces, assemble, constraints_on, solve_integral
from servolens.identification.options import FitOptions
from servolens.identification.score import FALSE_ALARM
from servolens.identification.uncertainty import LinearEstimate
from servolens.identification.velocity import law_left
from servolens.model import Model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import Prior
    from servolens.identification.segments import Segment
    from servolens.plant import Plant

__all__ = ["ConstantFit", "contradicted", "fit_constant"]

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


def fit_constant(segments: Sequence[Segment], options: FitOptions) -> ConstantFit:
    """Fit gain and damping to all `segments`; priors are combined with that by their variances.

    Where something shakes the axis, or the controller answers to its noise, the fit by simulation is the answer.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion.
    options : FitOptions
        What is fixed or bounded, and priors; what is asked of parameters other than gain and damping is not used.
    """
    options = options.of(NAMES)
    shares = [Pieces.whole(s.time.size) for s in segments]
    constraints = constraints_on(NAMES, options)
    solution = solve_integral(assemble(segments, shares), constraints=constraints)
    estimate, known = solution.x, options.priors
    begun = segments[0].plant(gain=float(estimate[1]), damping=float(estimate[0]))
    stopped = {k for c in constraints if c.name in solution.active for k in c.coefficients}
    free, held = np.array([k not in stopped for k in range(2)]), tuple(NAMES[k] for k in sorted(stopped))
    left = explained(begun, excerpt_of(segments)[0], FitOptions(held=held))
    covariance = LinearEstimate.of(segments, shares, free=free).covariance(estimate[:-1], left.noise)
    others: tuple[Plant, NDArray[np.float64] | None]
    others = begun if left.hypothesis is None else left.hypothesis.plant, None
    is_better_simulated = left.loop is not None or left.noise.rate > 0.0 or begun.free_damping is not None
    if left.is_enough and free.any() and is_better_simulated:
        refined = left.optimum(left.likelihood.records)
        simulated, spread = np.array(refined.plant.values)[1::-1], np.nan_to_num(refined.covariance[1::-1, 1::-1])
        if _agree((simulated - estimate)[free], covariance[np.ix_(free, free)]) and not _is_law_likelier(
            left, segments
        ):
            estimate, covariance, others = simulated, spread, (refined.plant, refined.covariance)
        else:
            left = replace(left, is_enough=False)
    alone = _model(estimate, covariance, *others)
    if known and not left.is_enough:
        with suppress(NumericalError):  # else the prior is compared with gain and damping alone
            refined = law_left(segments, FitOptions()).optimum(left.likelihood.records)
            alone = Model(plant=refined.plant, covariance=refined.covariance)
    for index, name in enumerate(NAMES):
        if name in known:
            weight = covariance[:, index] / (covariance[index, index] + known[name].deviation ** 2)
            estimate = estimate + weight * (known[name].value - estimate[index])
            covariance = covariance - np.outer(weight, covariance[index])
    estimate = np.clip(estimate, *np.array([options.range_of(name) for name in NAMES]).T)
    covariance[~free], covariance[:, ~free] = np.nan, np.nan
    model = replace(
        _model(estimate, covariance, *others),
        identified_from=tuple(dict.fromkeys(s.record.name for s in segments)),
        reasons=dict.fromkeys(held, AT_BOUND) | dict.fromkeys(options.held, GIVEN),
    )
    return ConstantFit(model, left, contradicted(alone, known))


def _model(
    estimate: NDArray[np.float64], covariance: NDArray[np.float64], plant: Plant, others: NDArray[np.float64] | None
) -> Model:
    """Return the model of an estimate of damping and gain; what else it has follows them from where it is in `plant`.

    As the covariance of all, `others`, has it; where that is not known it stays.
    """
    new, size = estimate[::-1], len(plant.values)
    full = np.full((size, size), np.nan)
    values = np.array([*new, *plant.values[2:]])
    if others is not None and size > 2:
        before, known = np.nan_to_num(others[:2, :2]), np.nan_to_num(covariance[::-1, ::-1])
        follows = np.nan_to_num(others[2:, :2]) @ np.linalg.pinv(before, hermitian=True)
        values[2:] += follows @ (new - np.array(plant.values[:2]))
        full[2:, 2:] = others[2:, 2:] - follows @ (before - known) @ follows.T
        full[2:, :2] = follows @ known
        full[:2, 2:] = full[2:, :2].T
    full[:2, :2] = covariance[::-1, ::-1]
    stopped = np.isnan(np.diag(full))
    full[stopped], full[:, stopped] = np.nan, np.nan
    return Model(plant=plant.with_values(values.tolist()), covariance=full)


def _is_law_likelier(left: Explained, segments: Sequence[Segment]) -> bool:
    """Tell whether damping against speed makes the records likelier: then what seems to shake the axis is its law."""
    law = law_left(segments, FitOptions())
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


def contradicted(free: Model, known: Mapping[str, Prior], held: Model | None = None) -> tuple[Finding, ...]:
    """Name the priors that a fit without them is far from, or one with them, `held` by them, as far as it may be."""
    found = []
    for name, prior in known.items():
        quantity = free.quantities.get(name)
        ended = held.quantities.get(name) if held else None
        is_far = ended is not None and abs(ended.value - prior.value) > CONTRADICTS * prior.deviation
        if ended is not None and ended.reason == AT_BOUND and is_far:
            seen = f"the fit ends as far from it as it may, at {ended.value:.4g}"
        elif quantity is None or quantity.stderr is None:
            continue
        elif abs(quantity.value - prior.value) > CONTRADICTS * np.hypot(quantity.stderr, prior.deviation):
            seen = f"without it the fit gives {quantity.value:.4g} ± {quantity.stderr:.2g}"
        else:
            continue
        message = (
            f"the prior on {name}, {prior.value:g} ± {prior.deviation:g}, contradicts the records: {seen}. "
            "Check its value, unit and width."
        )
        found.append(Finding(code="prior_contradicts_data", severity="warning", message=message))
    return tuple(found)
