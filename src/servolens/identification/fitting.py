"""The final fit of a plant with given effects: the run that was asked for, whitened, with error bars."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Known, Problem
from servolens.identification.fitted import with_error_bars
from servolens.identification.likelihood import RATES, SOME, Likelihood
from servolens.identification.loop_errors import drawn_loop_errors
from servolens.identification.noise import NoiseModel
from servolens.identification.refine import (
    AT_NOISE,
    DOWN_TO_NOISE,
    Refinement,
    beside_draws,
    followed,
    minimise_error,
)
from servolens.identification.restricted import counting_followed, parts_at
from servolens.identification.rounding import FEW_DRAWS, about_mean, before_rounding, draws_for, spectrum_of
from servolens.identification.runs import ClosedRun, closed_runs
from servolens.identification.score import ScoreTest
from servolens.identification.segments import begins_with_its_step, noise_level, resting_noise, white_noise
from servolens.identification.smoothing import speed_of
from servolens.identification.structure import depends_on_inputs, is_shaking
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.options import FitOptions
    from servolens.identification.runs import Run
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = [
    "INERTIAS",
    "FinalFit",
    "check_loops",
    "final_fit",
    "level_of",
    "likelihood_of",
    "of_other_inertias",
    "runs_of",
    "simulation_error",
]

ROUNDS = 2
"""Times that a residual in closed loop is whitened by what it is found to be."""
INERTIAS = (0.5, 2.0, 4.0, 8.0)
"""Shares of an inertia that are tried: dry friction that holds an axis passes for inertia."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class FinalFit:
    """Where the fit ended, the noise beside it, and the records with what was found of their beginning.

    With it, whether the axis is shaken by what knows nothing of the inputs: then a simulation errs by more than noise;
    and whether what is left knows nothing of them, however much it is.
    """

    refinement: Refinement
    noise: NoiseModel
    records: tuple[Record, ...]
    driven: Literal["closed_loop", "voltage"]
    is_shaken: bool = False
    is_noise: bool = False


def check_loops(records: Sequence[Record], options: FitOptions) -> None:
    """Refuse a closed loop of records of which it is not known.

    Raises
    ------
    InputError
        If a closed loop is asked for and a record has no reference or no gains, or no voltage that is to be compared.
    """
    if options.driven != "closed_loop" and options.compared != "voltage":
        return
    for record in records:
        if not record.has_loop:
            raise InputError(f"{record.name}: closing the loop needs reference, kp and kd")
    closed_runs(records, options)


def likelihood_of(records: Sequence[Record], plant: Plant, options: FitOptions) -> Likelihood:
    """Return the likelihood of `records`, of an axis about like `plant`.

    An observer is none where the voltage alone is to drive, and where outliers would move it.
    """
    is_free = options.driven != "voltage" and options.loss == "squares"
    return Likelihood(records, plant, options, rates=RATES if is_free else RATES[:1], are_phases_own=False)


def runs_of(records: Sequence[Record], plant: Plant, options: FitOptions, noise: NoiseModel, driven: str) -> list[Run]:
    """Return the runs of a final fit, their residuals whitened."""
    if driven == "closed_loop":
        return [*closed_runs(records, options, noise)]
    return [*likelihood_of(records, plant, options).runs(noise)]


def final_fit(likelihood: Likelihood, found: Sequence[Hypothesis], options: FitOptions) -> FinalFit:
    """Fit to the end what the search has found, the likeliest first.

    A model that is wrong makes the measured voltage depend on what it lacks, which biases what the voltage drives: it
    is fitted in closed loop, where that is possible and nothing else was asked for.

    Raises
    ------
    NumericalError
        If none can be simulated as the `options` ask.
    """
    records = likelihood.records
    if options.driven == "closed_loop" or options.compared == "voltage":
        return _closed(records, [h.plant for h in found], options)
    best = found[0]
    if best.unpowered:
        records = tuple(replace(r, voltage_before=0.0) if begins_with_its_step(r) else r for r in records)
        likelihood = likelihood.on(records)
    if options.loss == "huber":
        return _robust(likelihood, best.plant, records)
    best = counting_followed(likelihood, best)
    noise, is_large = best.noise, best.noise.spread > AT_NOISE * sensor_noise(records, options)
    is_independent = is_large and noise.rate == 0.0 and _is_independent(likelihood, best)
    if options.driven == "voltage" and is_large and not is_independent:
        noise = likelihood.white  # what a model lacks is no noise; its colour says nothing of what to weigh
    refined = _observed(likelihood, best.plant, noise, best.starts)
    # a filter of another kind could have whitened what a model lacks, such as a mode that rings
    is_noise = is_independent and noise.counts_followed and noise.parameters < noise.order
    observed = FinalFit(refined, noise, records, "voltage", is_noise=is_noise)
    is_driven = options.driven == "voltage" or best.noise.rate == 0.0 or not all(r.has_loop for r in records)
    if not is_driven and simulation_error(observed, options) > AT_NOISE * sensor_noise(records, options):
        is_shaken = is_shaking(likelihood, replace(best, plant=observed.refinement.plant))
        observed = replace(observed, is_shaken=is_shaken)
        with suppress(NumericalError):
            if not is_shaken:
                return _closed(records, [h.plant for h in found], options)
    return replace(observed, refinement=with_error_bars(likelihood, refined, noise))


def _is_independent(likelihood: Likelihood, best: Hypothesis) -> bool:
    """Tell whether what is left beside the noise of a hypothesis does not depend on the inputs."""
    try:
        return best.noise.order > 0 and not depends_on_inputs(ScoreTest(likelihood, best))
    except (InputError, NumericalError):
        return False


def _observed(
    likelihood: Likelihood, plant: Plant, noise: NoiseModel, known: Sequence[NDArray[np.float64]] = ()
) -> Refinement:
    """Return the fit driven by the voltage, corrected by an observer as the noise model has it.

    The records begin as `known`, if that misses less.
    """
    runs, options = likelihood.runs(noise), likelihood.options(plant)
    return minimise_error(
        plant,
        runs,
        options,
        noise=likelihood.weighed_by(noise),
        coarse=plant.has_contacts,
        local_minima=True,
        known=Known(known),
    )


def _robust(likelihood: Likelihood, plant: Plant, records: tuple[Record, ...]) -> FinalFit:
    """Return the fit with the robust loss, beside white noise: outliers have no colour."""
    noise = likelihood.white
    refined = _observed(likelihood, plant, noise)
    for _ in range(ROUNDS):
        middle = float(np.median(np.abs(np.concatenate(refined.residuals))))
        noise = NoiseModel.white(1.4826 * middle, noise.rounding)  # 1.4826: of a normal distribution
        refined = _observed(likelihood, refined.plant, noise)
    return FinalFit(with_error_bars(likelihood, refined, noise), noise, records, "voltage")


def _closed(records: tuple[Record, ...], plants: Sequence[Plant], options: FitOptions) -> FinalFit:
    """Return the fit in closed loop; whitened by what it leaves, where that is noise."""
    level = sensor_noise(records, options)
    rounding = 0.0 if options.compared == "voltage" else max(r.encoder_resolution or 0.0 for r in records)
    noise = NoiseModel.white(level, rounding)
    runs = closed_runs(records, options, noise)
    refined = minimise_error(_best_closed(plants, runs, options), runs, options, noise=1.0, coarse=True)
    if options.loss == "squares" and refined.rms_error <= AT_NOISE * level:
        if options.compared == "position":
            with suppress(InputError, NumericalError):
                return _beside_feedback(refined, records, noise, options)
        for _ in range(ROUNDS):
            noise = noise.estimated(refined.residuals, [run.whiten for run in runs])
            runs = closed_runs(records, options, noise)
            refined = minimise_error(refined.plant, runs, options, noise=1.0)
    return FinalFit(refined, noise, records, "closed_loop")


def _beside_feedback(
    refined: Refinement, records: tuple[Record, ...], noise: NoiseModel, options: FitOptions
) -> FinalFit:
    """Return what was `refined` beside white `noise`, beside what the loop makes of the noise that the records have.

    The controller answers to the sensor's noise, and the axis with it. Where dry friction lets it stop differs by less
    than the noise, but for as long as it rests: no spectrum of what is left shows so little, and the estimates move by
    it all the same. So noise is drawn and the loop answers to it. What it leaves on average is taken off, error bars
    are of the rest. What is drawn is the sensor's own noise: its spectrum is changed until what the loop makes of it
    has the spectrum of what the fit leaves (indirect inference: Gourieroux et al. 1993, doi:10.1002/jae.3950080507).

    Raises
    ------
    NumericalError
        If the loop of too many draws diverges.
    """
    runs, own = closed_runs(records, options, noise), before_rounding(noise)
    for _ in range(ROUNDS):
        errors = _fed_back(refined, runs, noise, own)
        means, rest = zip(*map(about_mean, errors), strict=True)
        left = [residual + mean for residual, mean in zip(refined.residuals, means, strict=True)]
        whiten = [run.whiten for run in runs]
        shown = _left_of([error[:, :FEW_DRAWS] for error in rest], refined, runs, options)
        seen = [noise.estimated([error[:, k] for error in shown], whiten) for k in range(FEW_DRAWS)]
        noise = noise.estimated(left, whiten)
        own = own * spectrum_of(noise) / np.mean([spectrum_of(one) for one in seen], axis=0)
        known = zip(closed_runs(records, options, noise), means, strict=True)
        runs = [run.less(run.added(mean[:, None])[:, 0]) for run, mean in known]
        refined = minimise_error(refined.plant, runs, options, noise=1.0)
    unknowns = int(np.isfinite(refined.colour).sum()) + sum(start.size for start in refined.starts)
    larger = float(np.sqrt(noise.inflation(sum(run.samples for run in runs), unknowns)))
    errors = _fed_back(refined, runs, noise, own)
    drawn = [larger * run.added(about_mean(error)[1]) for run, error in zip(runs, errors, strict=True)]
    return FinalFit(beside_draws(refined, runs, options, drawn), noise, records, "closed_loop")


def _fed_back(
    refined: Refinement, runs: Sequence[ClosedRun], noise: NoiseModel, own: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return draws of what the loop makes of noise of this spectrum, and rounds, of each run, shape (n, draws).

    So many draws of so many samples as elsewhere, or more of short records.
    """
    plants = [refined.plant_of(run.group) for run in runs]
    count = draws_for(sum(run.samples for run in runs))
    smooth = [replace(run.record, encoder_resolution=None) for run in runs]  # as a fit simulates them
    draws = drawn_loop_errors(plants, smooth, noise, unrounded=own, count=count)
    if len(draws) < count // 2:
        raise NumericalError("the loop diverges beside the noise")
    return [np.column_stack(of_run) for of_run in zip(*draws, strict=True)]


def _left_of(
    errors: Sequence[NDArray[np.float64]], refined: Refinement, runs: Sequence[ClosedRun], options: FitOptions
) -> list[NDArray[np.float64]]:
    """Return what a fit of the `runs` leaves of errors of their measured positions, shape (n, draws) each.

    Parameters and initial states take up the rest: an axis begins anywhere within a step of the encoder.
    """
    records = [run.record for run in runs]
    _, plain = parts_at(Problem(refined.plant, closed_runs(records, options), options, None), refined)
    _, parts = parts_at(Problem(refined.plant, runs, options, None), refined, whole=True)
    seen = np.concatenate([part.sensitivity for part in parts])
    added = [-run.added(error) for run, error in zip(runs, errors, strict=True)]
    none = np.zeros((seen.shape[0] - sum(rows.shape[0] for rows in added), errors[0].shape[1]))  # of priors
    sizes = np.maximum(np.linalg.norm(seen, axis=0), 1e-300)
    moved = np.linalg.lstsq(seen / sizes, np.concatenate([*added, none]), rcond=None)[0] / sizes[:, None]
    return [error - part.sensitivity @ moved for error, part in zip(errors, plain, strict=False)]


def of_other_inertias(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with other inertias, all forces in proportion; none whose parameters leave their ranges."""
    for share in INERTIAS:
        with suppress(InputError):
            yield replace(plant.scaled(share), inertia=plant.inertia)  # which is stated, and no guess


def _best_closed(plants: Sequence[Plant], runs: Sequence[ClosedRun], options: FitOptions) -> Plant:
    """Return the plant from which the search in closed loop begins: of other inertias too, where noise is not reached.

    Raises
    ------
    NumericalError
        If none of the `plants` can be simulated.
    """
    enough = DOWN_TO_NOISE**2 * sum(run.samples for run in runs)
    ends: list[tuple[float, Plant]] = []
    for plant in (*plants[:2], *of_other_inertias(plants[0])):
        with suppress(InputError, NumericalError):
            held = plant.with_named({n: v for n, v in plants[0].named.items() if n in options.held})
            end, misfit = followed(held, runs, options, noise=1.0, iterations=SOME)
            ends.append((misfit, end))
            if misfit <= enough:
                break
    if not ends:
        raise NumericalError("no start of this model can be simulated in closed loop on these records")
    return min(ends, key=lambda pair: pair[0])[1]


def sensor_noise(records: Sequence[Record], options: FitOptions) -> float:
    """Return the noise in what is compared, as the records show it without any model.

    Of a position no less than a settled axis shows at the end of its steps, which contains what changes slowly.
    """
    if options.compared == "voltage":
        return max((white_noise(r.voltage) for r in records if r.voltage is not None), default=0.0)
    fast = float(np.sqrt(np.mean([noise_level(record) ** 2 for record in records])))
    return max(fast, resting_noise(records))


def level_of(found: FinalFit, records: Sequence[Record], options: FitOptions) -> float:
    """Return the standard deviation of the noise: the noise model's, unless that contains far more than noise.

    Of noise so slow that no settled axis shows it, what is left of it.
    """
    noise, shown = found.noise, sensor_noise(records, options)
    if found.is_noise:
        return max(found.refinement.rms_error, shown)
    speeds = np.concatenate([speed_of(record.time, record.position) for record in records])
    modelled = float(np.hypot(noise.spread, noise.jitter * np.sqrt(np.mean(speeds**2))))
    return modelled if options.loss == "huber" or modelled <= AT_NOISE * shown else shown


def simulation_error(found: FinalFit, options: FitOptions) -> float:
    """Return the root mean square error in closed loop, where all loops can be closed; else of what was compared."""
    refined = found.refinement
    if (
        found.driven == "closed_loop"
        or found.is_shaken
        or found.noise.rate == 0.0
        or not all(record.has_loop for record in found.records)
    ):
        return refined.rms_error
    runs = closed_runs(found.records, replace(options, compared="position"))
    plants = [refined.plant_of(i) for i in range(len(runs))]
    try:
        missed: list[NDArray[np.float64]] = [
            run.missed(plant, run.start, substeps_for(plant, run.sample_time))
            for run, plant in zip(runs, plants, strict=True)
        ]
    except NumericalError:
        return float(np.inf)
    return max(refined.rms_error, float(np.sqrt(np.mean(np.concatenate(missed) ** 2))))
