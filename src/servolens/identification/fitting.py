"""The final fit of a plant with given effects: the run that was asked for, whitened, with error bars."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.likelihood import RATES, Likelihood, begins_with_its_step
from servolens.identification.noise import NoiseModel, Whitener, observer_gains
from servolens.identification.refine import AT_NOISE, Refinement, minimise_error
from servolens.identification.runs import ClosedRun, closed_runs
from servolens.identification.segments import noise_level, white_noise
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Hypothesis
    from servolens.identification.options import FitOptions
    from servolens.identification.runs import Run
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["FinalFit", "driven_by", "final_fit", "level_of", "likelihood_of", "runs_of", "simulation_error"]

ROUNDS = 2
"""Times that a residual in closed loop is whitened by what it is found to be."""
LAST = 0.1
"""Share of a step in which a settled axis shows the sensor's noise."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class FinalFit:
    """Where the fit ended, the noise beside it, and the records with what was found of their beginning."""

    refinement: Refinement
    noise: NoiseModel
    records: tuple[Record, ...]


def driven_by(records: Sequence[Record], options: FitOptions) -> Literal["closed_loop", "voltage"]:
    """Return how the runs are simulated.

    Raises
    ------
    InputError
        If a closed loop is asked for and a record has no reference or no gains.
    """
    if options.driven != "closed_loop" and options.compared != "voltage":
        return "voltage"
    lacking = [record.name for record in records if not _can_close(record)]
    if lacking:
        raise InputError(f"{lacking[0]}: closing the loop needs reference, kp and kd")
    return "closed_loop"


def likelihood_of(records: Sequence[Record], plant: Plant, options: FitOptions) -> Likelihood:
    """Return the likelihood of `records`, of an axis about like `plant`.

    An observer is none where the voltage alone is to drive, and where outliers would move it.
    """
    is_free = options.driven != "voltage" and options.loss == "squares"
    return Likelihood(records, plant, options, rates=RATES if is_free else RATES[:1], are_phases_own=False)


def runs_of(records: Sequence[Record], plant: Plant, options: FitOptions, noise: NoiseModel) -> list[Run]:
    """Return the runs that a fit with these `options` compares, their residuals whitened."""
    if driven_by(records, options) == "closed_loop":
        return [*closed_runs(records, options, noise)]
    return [*likelihood_of(records, plant, options).runs(noise)]


def final_fit(likelihood: Likelihood, found: Sequence[Hypothesis], options: FitOptions) -> FinalFit:
    """Fit to the end what the search has found, the likeliest first.

    Raises
    ------
    NumericalError
        If none can be simulated as the `options` ask.
    """
    if driven_by(likelihood.records, options) == "closed_loop":
        return _closed(likelihood.records, [h.plant for h in found], options)
    best = found[0]
    records = likelihood.records
    if best.unpowered:
        records = tuple(replace(r, voltage_before=0.0) if begins_with_its_step(r) else r for r in records)
        likelihood = likelihood.on(records)
    if options.loss == "huber":
        return _robust(likelihood, best, records)
    refined = minimise_error(
        best.plant,
        likelihood.runs(best.noise),
        likelihood.options(best.plant),
        noise=1.0,
        coarse=best.plant.has_contacts,
        local_minima=True,
    )
    return FinalFit(refined, best.noise, records)


def _robust(likelihood: Likelihood, best: Hypothesis, records: tuple[Record, ...]) -> FinalFit:
    """Return the fit with the robust loss, beside white noise: outliers have no colour."""
    noise, plant = likelihood.white, best.plant
    for _ in range(ROUNDS):
        refined = minimise_error(
            plant, likelihood.runs(noise), likelihood.options(plant), noise=1.0, coarse=True, local_minima=True
        )
        plant, size = refined.plant, np.abs(np.concatenate(refined.residuals))
        noise = NoiseModel.white(float(1.4826 * np.median(size)), likelihood.white.rounding)  # of a normal distribution
    return FinalFit(refined, noise, records)


def _closed(records: tuple[Record, ...], plants: Sequence[Plant], options: FitOptions) -> FinalFit:
    """Return the fit in closed loop, whitened by what it leaves; begun where the error is least."""
    noise = NoiseModel.white(sensor_noise(records, options))
    runs = closed_runs(records, options, noise)
    start = min(plants, key=lambda plant: _misfit(plant, runs))
    refined = minimise_error(start, runs, options, noise=1.0, coarse=True)
    for _ in range(ROUNDS if options.loss == "squares" else 0):
        whiteners = [Whitener(run.measured, noise) for run in runs]
        noise = NoiseModel.white(1.0).estimated(refined.residuals, whiteners)
        noise = replace(noise, floor=sensor_noise(records, options))
        runs = closed_runs(records, options, noise)
        refined = minimise_error(refined.plant, runs, options, noise=1.0)
    return FinalFit(refined, noise, records)


def _misfit(plant: Plant, runs: Sequence[ClosedRun]) -> float:
    try:
        parts = [run.residual(plant, run.start, substeps_for(plant, run.sample_time)) for run in runs]
    except (InputError, NumericalError):
        return float(np.inf)
    return sum(float(part @ part) for part in parts)


def sensor_noise(records: Sequence[Record], options: FitOptions) -> float:
    """Return the noise in what is compared, as the records show it without any model.

    Of a position no less than a settled axis shows at the end of its steps, which contains what changes slowly.
    """
    if options.compared == "voltage":
        return max((white_noise(r.voltage) for r in records if r.voltage is not None), default=0.0)
    fast = float(np.sqrt(np.mean([noise_level(record) ** 2 for record in records])))
    resting = [spread for record in records for step in record.steps() if (spread := _resting(step)) > 0.0]
    return max(fast, float(np.median(resting)) if resting else 0.0)


def _resting(step: Record) -> float:
    """Return the standard deviation of the end of a step about a straight line; 0 where it is short, or no rest."""
    count = int(LAST * len(step))
    if count < 20:
        return 0.0
    time, end = step.time[-count:] - step.time[-1], step.position[-count:]
    if abs(float(end[-1] - end[0])) > 10.0 * noise_level(step):
        return 0.0
    return float(np.std(end - np.polyval(np.polyfit(time, end, 1), time)))


def level_of(noise: NoiseModel, records: Sequence[Record], options: FitOptions) -> float:
    """Return the standard deviation of the noise: the noise model's, unless that contains far more than noise."""
    shown = sensor_noise(records, options)
    alpha, _ = observer_gains(noise.rate, float(np.median(np.diff(records[0].time[:64]))))
    modelled = noise.spread * float(np.sqrt(1.0 - alpha))  # an observer's prediction errors contain its own
    return modelled if options.loss == "huber" or modelled <= AT_NOISE * shown else shown


def simulation_error(found: FinalFit, options: FitOptions) -> float:
    """Return the root mean square error in closed loop, where all loops can be closed; else of what was compared."""
    refined = found.refinement
    if found.noise.rate == 0.0 or not all(_can_close(record) for record in found.records):
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


def _can_close(record: Record) -> bool:
    return record.reference is not None and record.controller is not None
