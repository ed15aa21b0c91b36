"""Constant damping by the integral equation, with error bars that know what the noise does."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import NumericalError
from servolens.findings import Finding
from servolens.identification.explained import Explained, excerpt_of, explained
from servolens.identification.fitted import AT_BOUND, GIVEN, model_of
from servolens.identification.integral import Pieces, assemble, constraints_on, solve_integral
from servolens.identification.score import FALSE_ALARM
from servolens.identification.segments import runs_free
from servolens.identification.uncertainty import LinearEstimate
from servolens.identification.velocity import first_samples, law_left, records_of
from servolens.model import Model
from servolens.plant import FREE_DAMPING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import FitOptions, Prior
    from servolens.identification.segments import Segment
    from servolens.plant import Plant

__all__ = ["ConstantFit", "contradicted", "fit_constant"]

CONTRADICTS = 3.0
"""Standard deviations from a prior from which on the records contradict it."""
NAMES = ("damping", "gain")
NOT_NOISE = "this model does not explain the records to noise level, so its error is not known"


@final
@dataclass(frozen=True, slots=True, eq=False)
class ConstantFit:
    """The model, what is left beside it, and findings."""

    model: Model
    left: Explained
    findings: tuple[Finding, ...]


def fit_constant(segments: Sequence[Segment], options: FitOptions) -> ConstantFit:
    """Fit gain and damping to all `segments`; priors are combined with that by their variances.

    Where something shakes the axis, the controller answers to its noise, or the motor is off while the axis moves, the
    fit by simulation is the answer.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion.
    options : FitOptions
        What is fixed or bounded, and priors; what is asked of parameters of the damping law is not used.
    """
    beside, options = options.of((FREE_DAMPING.name,)), options.of((*NAMES, FREE_DAMPING.name))
    shares = [Pieces.whole(s.time.size) for s in segments]
    constraints = constraints_on(NAMES, options)
    solution = solve_integral(assemble(segments, shares), constraints=constraints)
    estimate, known = solution.x, options.of(NAMES).priors
    stopped = {k for c in constraints if c.name in solution.active for k in c.coefficients}
    free, held = np.array([k not in stopped for k in range(2)]), tuple(NAMES[k] for k in sorted(stopped))
    begun = segments[0].plant(gain=float(estimate[1]), damping=float(estimate[0])).with_named(beside.values)
    left = explained(begun, excerpt_of(segments)[0], beside.holding(*held))
    covariance = LinearEstimate.of(segments, shares, free=free).covariance(estimate[:-1], left.noise)
    rest = _without_errors(begun if left.hypothesis is None else left.hypothesis.plant)
    is_better_simulated = left.loop is not None or left.noise.rate > 0.0 or begun.free_damping is not None
    if left.is_enough and is_better_simulated and (free.any() or begun.free_damping is not None):
        refined = _simulated(left, segments, beside.holding(*held))
        simulated = np.array(refined.plant.values)[1::-1]
        agrees = not free.any() or _agree((simulated - estimate)[free], covariance[np.ix_(free, free)])
        if agrees and not _is_law_likelier(left, segments, beside):
            estimate, covariance, rest = simulated, _of_both(refined), refined
        else:
            left = replace(left, is_enough=False)
    alone = _alone(_model(estimate, covariance, rest), left, segments, options, held)
    for index, name in enumerate(NAMES):
        if name in known:
            weight = covariance[:, index] / (covariance[index, index] + known[name].deviation ** 2)
            estimate = estimate + weight * (known[name].value - estimate[index])
            covariance = covariance - np.outer(weight, covariance[index])
    estimate = np.clip(estimate, *np.array([options.range_of(name) for name in NAMES]).T)
    covariance[~free], covariance[:, ~free] = np.nan, np.nan
    model = _model(estimate, covariance, rest)
    inside = np.clip(model.plant.free_damping or 0.0, *options.range_of(FREE_DAMPING.name))
    model = replace(
        model,
        plant=model.plant.with_named({FREE_DAMPING.name: float(inside)}),
        identified_from=tuple(dict.fromkeys(s.record.name for s in segments)),
        reasons={**model.reasons, **dict.fromkeys(held, AT_BOUND), **dict.fromkeys(options.held, GIVEN)},
    )
    return ConstantFit(model, left, contradicted(alone, options.priors))


def _without_errors(plant: Plant) -> Model:
    """Return a model of which only gain and damping have errors, from elsewhere."""
    return Model(plant=plant, reasons={FREE_DAMPING.name: NOT_NOISE})


def _simulated(left: Explained, segments: Sequence[Segment], options: FitOptions) -> Model:
    """Return the fit by simulation to what was judged, or to more where the motor is off only later."""
    records = left.likelihood.records
    is_later = segments[0].runs_free and not any(map(runs_free, records))
    refined = left.optimum(records_of(first_samples(segments)[0]) if is_later else records)
    return model_of(refined, records, options.held)


def _of_both(model: Model) -> NDArray[np.float64]:
    """Return the covariance of damping and gain, 0 of what was not free."""
    return np.nan_to_num(np.array(model.covariance, dtype=np.float64))[1::-1, 1::-1]


def _alone(
    model: Model, left: Explained, segments: Sequence[Segment], options: FitOptions, held: Sequence[str]
) -> Model:
    """Return the model that priors are compared with: fitted without them, and where it is not the axis, with the law.

    Where that cannot be simulated, it is the `model` itself.
    """
    if not options.priors or (left.is_enough and FREE_DAMPING.name not in options.priors):
        return model
    asked = replace(options.of((FREE_DAMPING.name,)), priors={})
    with suppress(NumericalError):
        if not left.is_enough:
            other = law_left(segments, asked)
        else:
            other = explained(model.plant, left.likelihood.records, asked.holding(*held))
        return _simulated(other, segments, asked)
    return model


def _model(estimate: NDArray[np.float64], covariance: NDArray[np.float64], beside: Model) -> Model:
    """Return the model of an estimate of damping and gain; what else it has follows them from where it is `beside`.

    As the covariance of all has it there; where that is not known it stays.
    """
    plant, others = beside.plant, beside.covariance
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
    reasons = {name: why for name, why in beside.reasons.items() if name == FREE_DAMPING.name}
    return Model(plant=plant.with_values(values.tolist()), covariance=full, reasons=reasons)


def _is_law_likelier(left: Explained, segments: Sequence[Segment], options: FitOptions) -> bool:
    """Tell whether damping against speed makes the records likelier: then what seems to shake the axis is its law."""
    law = law_left(segments, options)
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
