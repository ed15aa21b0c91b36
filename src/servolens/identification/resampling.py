"""What a parameter could be besides its best value: profile likelihood and bootstrap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError, described, whole_number
from servolens.identification.fitting import runs_of
from servolens.identification.observed import ObservedRun
from servolens.identification.refine import minimise_error, minimise_likewise
from servolens.identification.runs import ClosedRun, Resampled
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.plant_fit import Fit
    from servolens.identification.refine import Refinement
    from servolens.identification.runs import Run
    from servolens.plant import Plant

__all__ = ["Bootstrap", "Profile", "bootstrap", "profile"]

CHI_SQUARE_95 = 3.841458820694124
"""95 % quantile of χ² with one degree of freedom."""
MOST_STEPS = 40
BLOCK = 5.0
"""Length of a block of residuals, in times that they are correlated for."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Profile:
    """How well each value of one parameter explains the data, all others refitted.

    Attributes
    ----------
    name : str
        Qualified name.
    values : ndarray, shape (n,)
        Increasing; the best one among them.
    excess : ndarray, shape (n,)
        Twice the loss of log-likelihood against the best value; 3.84 is the end of the 95 % interval.
    interval : tuple of float or None
        95 % interval; None for an end that was not found within the parameter's range.
    """

    name: str
    values: NDArray[np.float64]
    excess: NDArray[np.float64]
    interval: tuple[float | None, float | None]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bootstrap:
    """Estimates from data made again of the fitted response and its own residuals.

    Attributes
    ----------
    names : tuple of str
        The parameters that were fitted.
    values : ndarray, shape (repeats, k)
        Their estimates.
    failed : int
        Repeats that could not be fitted.
    """

    names: tuple[str, ...]
    values: NDArray[np.float64]
    failed: int

    @property
    def stderr(self) -> NDArray[np.float64]:
        """Standard error of each parameter, shape (k,)."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def intervals(self) -> NDArray[np.float64]:
        """95 % percentile interval of each parameter, shape (k, 2)."""
        return np.asarray(np.percentile(self.values, [2.5, 97.5], axis=0).T)


def profile(fit: Fit, name: str) -> Profile:
    """Follow the likelihood of one parameter to both sides until it leaves the 95 % interval.

    What is followed is what the fit minimised: the whitened residual, or its robust loss, with the priors. It counts in
    units of the residual's variance, enlarged by as much as colour that is left enlarges the parameter's variance
    (the ratio of the sandwich to the plain one; Pace and Salvan, doi:10.1111/insr.12131).

    Parameters
    ----------
    fit : Fit
        The fit; its data are used again.
    name : str
        Qualified name of a parameter that was fitted, e.g. ``"saturation.limit"``.

    Raises
    ------
    InputError
        If no such parameter was fitted.
    NumericalError
        If the fit itself cannot be repeated.
    """
    runs, index = _runs(fit), _fitted(fit, name)
    best = fit.plant.values[index]
    width = np.sqrt(fit.model.covariance[index, index]) if fit.model.covariance is not None else np.nan
    width = float(width) if np.isfinite(width) and width > 0 else 0.05 * max(abs(best), 1e-3)
    found = [(best, 0.0)]
    ends = [_followed(fit, runs, name, step, found) for step in (-0.5 * width, 0.5 * width)]
    values, excess = np.array(sorted(found)).T
    return Profile(name=name, values=values, excess=excess, interval=(ends[0], ends[1]))


def bootstrap(fit: Fit, *, repeats: int = 100, seed: int) -> Bootstrap:
    """Fit data made of the fitted response and innovations like its own, `repeats` times.

    Innovations are the residual whitened by the fit's noise model; they are drawn in blocks, which keep what colour is
    left (moving blocks; Künsch 1989, doi:10.1214/aos/1176347265). What an observer is corrected by stays as measured
    (the fixed design of Gonçalves and Kilian 2004, doi:10.1016/j.jeconom.2003.10.030). Where an encoder's rounding
    dominates the noise, blocks do not know what the loop makes of it, and scatter more than the fit's error bars say;
    of a fit in closed loop they do not know what it makes of any noise, and may scatter less.

    Parameters
    ----------
    fit : Fit
        The fit.
    repeats : int
        At least 2.
    seed : int
        Of the blocks that are drawn.

    Raises
    ------
    InputError
        If `repeats` is less than 2.
    NumericalError
        If most repeats cannot be fitted.
    """
    repeats, seed = whole_number(repeats, 2, "repeats"), whole_number(seed, 0, "seed")
    runs = _runs(fit)
    left = [run.residual(*where) for run, where in zip(runs, _ends(fit, runs), strict=True)]
    names = [
        name for name in fit.plant.parameters if name not in (*fit.options.held, *fit.plant.derived, *fit.plant.usual)
    ]
    index = [list(fit.plant.parameters).index(name) for name in names]
    found, failed = [], 0
    for stream in np.random.default_rng(seed).spawn(repeats):
        again = [Resampled(run, r, _drawn(r, run.samples, stream)) for run, r in zip(runs, left, strict=True)]
        try:
            refined = minimise_error(fit.plant, again, fit.options, noise=1.0)
        except (InputError, NumericalError):
            failed += 1
            continue
        found.append([refined.plant.values[i] for i in index])
    if failed > repeats // 2:
        raise NumericalError(f"{failed} of {repeats} repeats could not be fitted; the model is too fragile to resample")
    return Bootstrap(names=tuple(names), values=np.array(found), failed=failed)


def _runs(fit: Fit) -> list[Run]:
    if getattr(fit, "kind", None) != "fit":
        raise InputError(f"what servolens.fit returns is needed; got {described(fit)}")
    if not fit.records:
        raise InputError("this fit was read from a file, which holds no records; fit them again")
    runs = runs_of(fit.records, fit.plant, fit.options, fit.noise_model, fit.driven)
    usual = fit.refinement.usual
    return [
        run.less(usual[i]) if usual and isinstance(run, ObservedRun | ClosedRun) else run for i, run in enumerate(runs)
    ]


def _ends(fit: Fit, runs: Sequence[Run]) -> list[tuple[Plant, NDArray[np.float64], int]]:
    """Return plant, initial state and substeps of each run at the fit's end."""
    plants = [fit.refinement.plant_of(run.group) for run in runs]
    pairs = zip(plants, fit.refinement.starts, runs, strict=True)
    return [(plant, start, substeps_for(plant, run.sample_time)) for plant, start, run in pairs]


def _fitted(fit: Fit, name: str) -> int:
    names = list(fit.plant.parameters)
    fixed = (*fit.options.held, *fit.plant.derived, *fit.plant.usual, *fit.options.local)
    if name not in names or name in fixed:
        known = ", ".join(n for n in names if n not in fixed) or "none"
        raise InputError(f"{str(name)[:40]!r} is no parameter that was fitted for all records; those are {known}")
    return names.index(name)


def _followed(fit: Fit, runs: Sequence[Run], name: str, step: float, found: list[tuple[float, float]]) -> float | None:
    """Follow the likelihood to one side, append what is found, and return the end of the interval if there is one.

    Steps grow until the end is passed; then they are halved until it lies between two values that hardly differ in
    likelihood, for beyond an end the likelihood may fall off as steeply as from a step.
    """
    index, spec = _fitted(fit, name), fit.plant.parameters[name]
    unit, least = _variance_unit(fit, index), fit.refinement.misfit
    plant, here, before = fit.plant, *found[0]
    beyond: tuple[float, float] | None = None
    for _ in range(MOST_STEPS):
        value = float(np.clip(here + step, spec.low, spec.high))
        if value == here:
            break
        refined = _with_value(fit, runs, plant, name, value)
        lost = np.inf if refined is None else (refined.misfit - least) / unit
        found.append((value, lost))
        if refined is not None and lost < CHI_SQUARE_95:
            plant, here, before = refined.plant, value, lost
        else:
            beyond = (value, lost)
        if beyond is not None and beyond[1] - before <= CHI_SQUARE_95:
            break
        step *= 1.6 if beyond is None else 0.5
    if beyond is None:
        return None
    share = (CHI_SQUARE_95 - before) / (beyond[1] - before) if np.isfinite(beyond[1]) else 0.5
    return here + share * (beyond[0] - here)


def _variance_unit(fit: Fit, index: int) -> float:
    """Return the misfit that one degree of freedom counts as."""
    refined = fit.refinement
    colour = refined.colour[index]  # NaN where the data do not determine the parameter
    return max(refined.variance * (float(colour) if np.isfinite(colour) else 1.0), 1e-300)


def _with_value(fit: Fit, runs: Sequence[Run], plant: Plant, name: str, value: float) -> Refinement | None:
    options = fit.options.holding(name)
    priors = dict(fit.options.priors)
    known = priors.pop(name, None)
    try:
        found = minimise_likewise(
            plant.with_named({name: value}), runs, replace(options, priors=priors), fit.refinement.weights
        )
    except (InputError, NumericalError):
        return None
    if known is None:
        return found
    away = fit.refinement.weights.noise * (value - known.value) / known.deviation
    return replace(found, misfit=found.misfit + away**2)


def _drawn(left: NDArray[np.float64], samples: int, stream: np.random.Generator) -> NDArray[np.float64]:
    """Return `left` with its first `samples` replaced by blocks drawn from them; the rest is of the initial state."""
    residual = left[:samples]
    centred = residual - residual.mean()
    energy = float(centred @ centred)
    rho = float(centred[1:] @ centred[:-1]) / energy if energy > 0 else 0.0
    memory = (1.0 + rho) / max(1.0 - rho, 1e-3) if rho > 3.0 / np.sqrt(samples) else 1.0
    length = int(np.clip(BLOCK * memory, 1, max(samples // 4, 1)))
    begins = stream.integers(0, samples - length + 1, size=-(-samples // length))
    drawn = np.concatenate([centred[b : b + length] for b in begins])[:samples]
    return np.concatenate([drawn, left[samples:]])
