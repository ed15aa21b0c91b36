"""Whether what simulations in closed loop miss of the records is what noise and shaking would do, or depends on inputs.

The loop answers to the sensor's noise and to what shakes the axis, and an axis that sticks or hunts answers for long.
So what is found is compared with draws of the same loop, of which the model is the axis (parametric bootstrap: Efron
and Tibshirani 1993, chapter 6).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import ServolensError
from servolens.identification.noise import MOST_ORDER
from servolens.identification.repeats import common_share, repeats
from servolens.identification.rounding import DRAWS, FEW_DRAWS, before_rounding, drawn_noise
from servolens.identification.score import FALSE_ALARM
from servolens.identification.shaken import shaking
from servolens.model_evidence import MATERIAL
from servolens.prediction import beginning
from servolens.processors import in_processes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.plant import Plant
    from servolens.prediction import Beginning
    from servolens.record import Record

    Errors = Sequence[NDArray[np.float64]]

__all__ = ["LoopError", "drawn_loop_errors", "loop_error", "share_limit", "shifted"]

REFERENCE_LAGS = (0.5, 1.0, 2.0, 4.0)
"""Lags of the reference in time constants of the loop."""
PARAMETER_STEP = 1e-3
"""Share of a parameter by which it is moved for the sensitivity of the loop."""
INTERVAL = 0.1
"""Time constants of the loop over which errors are averaged before they are whitened: what changes faster is the
sensor's."""
UNSURE = 0.1
"""Probability with which few draws show so little of a variance that the limit is too low."""
VISIBLE, MATTERS = 0.9, 0.5
"""Share of the error that must be seen to depend on the inputs if it does: a structure of nine times the rest; of an
error that is material, one as large as the rest."""


@final
@dataclass(frozen=True, slots=True)
class LoopError:
    """Answer of the test.

    Attributes
    ----------
    depends : bool
        Whether the error depends on the inputs.
    is_seen : bool
        Whether the records would show it if nine tenths of the error did; if half of it did, where it is material.
    is_larger : bool
        Whether the error is larger than noise and shaking make it.
    """

    depends: bool
    is_seen: bool
    is_larger: bool

    @property
    def is_noise(self) -> bool:
        """Whether it is shown that noise and shaking are all there is."""
        return self.is_seen and not self.depends


NO_LOOP = LoopError(depends=True, is_seen=True, is_larger=True)
"""Where the loop cannot be simulated."""


def loop_error(
    plants: Sequence[Plant],
    records: Sequence[Record],
    errors: Errors,
    noise: NoiseModel,
    rate: float,
    ripples: Errors = (),
    unrounded: NDArray[np.float64] | None = None,
) -> LoopError:
    """Compare the errors of simulations in closed loop with what noise and shaking alone would do.

    Shares of the squared error are compared with those of draws: what is explained by what the simulation itself
    does and by the reference at several lags, beside what the parameters could make good; and what arises in the third
    of the samples in which the axis moves most, against the third in which it moves least (Goldfeld and Quandt 1965,
    doi:10.1080/01621459.1965.10480811); and what runs that repeat each other have in common, if there are any. What
    knows nothing of the inputs is as large at rest as in motion, and another in each run. Where nothing shakes the
    axis, the first of these is asked alone: an encoder's rounding differs at rest. An error that is material must be no
    larger than those of the draws, either.
    A loop that is shaken far answers slowly, so that few of its errors count by themselves, and may follow anything.
    Where the records would not show it if the error depended on the inputs, whitened errors are asked as well.

    Parameters
    ----------
    plants : sequence of Plant
        Of each record.
    records : sequence of Record
        With reference and controller.
    errors : sequence of ndarray, shape (n,)
        Simulated minus measured position of each [m or rad].
    noise : NoiseModel
        Of sensor and shaking.
    rate : float
        Of the loops [rad/s].
    ripples : sequence of ndarray, shape (n,)
        Of the mains in each record [m or rad].
    unrounded : ndarray, shape (m,) or (DRAWS, m), optional
        Spectrum of the sensor's noise before the encoder rounds it, or of each draw; by default what rounding leaves of
        `noise`.
    """
    if not all(np.isfinite(error).all() for error in errors):
        return NO_LOOP
    draws = drawn_loop_errors(plants, records, noise, ripples, unrounded)
    if len(draws) < DRAWS // 2:
        return NO_LOOP
    shares = _Shares(plants, records, rate, is_shaken=noise.rate > 0.0)
    asked = slice(None) if noise.rate > 0.0 else slice(1)
    drawn = np.array([shares.of(draw)[asked] for draw in draws])
    limits = np.array([share_limit(column, FALSE_ALARM / drawn.shape[1]) for column in drawn.T])
    found = np.array(shares.of(errors)[asked])
    size = _size(errors)
    is_material = size > MATERIAL * max(float(np.ptp(record.position)) for record in records)
    is_larger = size > _largest([_size(draw) for draw in draws])
    depends = bool(np.any(found > limits)) or (is_material and is_larger)
    part = MATTERS if is_material else VISIBLE
    is_seen = bool(limits[0] < part)
    if not is_seen:
        whitened = share_limit(np.array([shares.whitened(draw) for draw in draws]), FALSE_ALARM)
        depends = depends or shares.whitened(errors) > whitened
        is_seen = whitened < shares.least(part, draws)
    return LoopError(depends, is_seen, is_larger)


def _size(errors: Errors) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def _largest(sizes: Sequence[float]) -> float:
    """Return the size that chance exceeds in one false alarm, of draws whose logarithms are normal."""
    from scipy.stats import t

    logs = np.log(np.maximum(sizes, 1e-300))
    wide = float(t.isf(FALSE_ALARM, logs.size - 1)) * np.sqrt(1.0 + 1.0 / logs.size)
    return float(np.exp(np.mean(logs) + wide * np.std(logs, ddof=1)))


def drawn_loop_errors(
    plants: Sequence[Plant],
    records: Sequence[Record],
    noise: NoiseModel,
    ripples: Errors = (),
    unrounded: NDArray[np.float64] | None = None,
    count: int = DRAWS,
) -> list[tuple[NDArray[np.float64], ...]]:
    """Return draws of what simulations in closed loop miss of the records if `plants` are the axis.

    The loop answers to the noise, and to what shakes the axis; the simulation that is compared with the record knows
    neither. Rounding that is part of the noise is done in the loop, which begins anywhere within a step, all records at
    the same place: those of an axis that always comes home do. Draws in which the loop diverges are left out.

    Returns
    -------
    list of tuple of ndarray, shape (n,)
        Of each draw the errors of all records [m or rad].
    """
    stream = np.random.default_rng(2)
    begun = [beginning(plant, record) for plant, record in zip(plants, records, strict=True)]
    still = _shown(plants, begun)
    step = noise.rounding if noise.rate == 0.0 else 0.0
    spectrum = before_rounding(noise) if unrounded is None else unrounded
    drawn = [drawn_noise(spectrum, len(record), stream, count) for record in records]
    for error, ripple in zip(drawn, ripples, strict=False):
        error += ripple[:, None]
    shakes = [shaking(noise, record, stream, count) for record in records]
    places = step * stream.uniform(-0.5, 0.5, count)

    def one(k: int) -> tuple[NDArray[np.float64], ...] | None:
        moved = []
        with suppress(ServolensError):
            for i, (plant, start) in enumerate(zip(plants, begun, strict=True)):
                there = start.record.position + places[k]
                loop = replace(start.record, position=there, encoder_resolution=step or None)
                run = start.simulated(plant, loop, acceleration=shakes[i][:, k], sensor_error=drawn[i][:, k])
                moved.append(run.measured - still[i])
            return tuple(moved)
        return None

    return [draw for draw in in_processes(one, range(count)) if draw is not None]


class _Shares:
    """Which shares of a squared error follow the inputs.

    Parameters
    ----------
    plants, measured : sequence of Plant, of Record
    rate : float
        Of the loops [rad/s].
    is_shaken : bool
        Whether something shakes the axis.
    """

    def __init__(self, plants: Sequence[Plant], measured: Sequence[Record], rate: float, *, is_shaken: bool) -> None:
        # in an encoder's steps no small change of a parameter is seen
        records = [replace(record, encoder_resolution=None) for record in measured]
        begun = [beginning(plant, record) for plant, record in zip(plants, records, strict=True)]
        runs = [start.simulated(plant) for plant, start in zip(plants, begun, strict=True)]
        shown = [run.shown(plant) for run, plant in zip(runs, plants, strict=True)]
        self._own = _spanned(_sensitivities(plants, begun, shown, is_shaken=is_shaken))
        columns, activity = [], []
        for run, record in zip(runs, records, strict=True):
            reference = np.asarray(record.reference)
            lags = [int(lag / rate / record.sample_time) for lag in REFERENCE_LAGS]
            step = reference - reference[0]
            moved = [shifted(step, lag) - shifted(step, 2 * lag) for lag in lags]
            own = [run.velocity, np.sign(run.velocity), run.velocity * np.abs(run.velocity), run.position - reference]
            columns.append(np.column_stack([np.ones(len(record)), *own, run.voltage, *moved]))
            activity.append(_faded(run.velocity**2, rate * record.sample_time))
        rows = np.concatenate(columns)
        rows -= self._own @ (self._own.T @ rows)
        self._ends = np.cumsum([len(record) for record in records])[:-1]
        self._every = [max(int(INTERVAL / rate / record.sample_time), 1) for record in records]
        self._inputs = _spanned(rows)
        self._slow_own, self._slow_inputs = (self._slow(np.split(one, self._ends)) for one in (self._own, self._inputs))
        order = np.argsort(np.concatenate(activity), kind="stable")
        third = order.size // 3
        self._repeats = repeats(records)
        self._least, self._most = order[:third], order[-third:]

    def of(self, errors: Errors) -> list[float]:
        """Return what the inputs explain, what arises where the axis moves most, and what repeated runs have in common.

        The last only where runs repeat each other.
        """
        error = self._free(errors)
        along = float(np.sum((self._inputs.T @ error) ** 2))
        low, high = (float(np.sum(error[part] ** 2)) for part in (self._least, self._most))
        shares = [along / max(float(error @ error), 1e-300), high / max(low + high, 1e-300)]
        return [*shares, common_share(errors, self._repeats)] if self._repeats else shares

    def whitened(self, errors: Errors) -> float:
        """Return the share that follows the inputs of errors as an autoregression of their own whitens them."""
        return self._along(self._free(errors))

    def least(self, part: float, draws: Sequence[Errors]) -> float:
        """Return what the whitened share is at least if the inputs make such a `part` of the squared error.

        Of the direction of the inputs that whitening leaves least of, beside a few of the draws.
        """
        if not self._inputs.shape[1]:
            return 0.0
        free = [self._free(draw) for draw in draws[:FEW_DRAWS]]
        white, _ = self._whitened(_whitening([slow for one in free for slow in self._slow(np.split(one, self._ends))]))
        least = self._inputs @ np.linalg.svd(white, full_matrices=False)[2][-1]
        mixed = (np.sqrt(1.0 - part) * one + np.sqrt(part) * np.linalg.norm(one) * least for one in free)
        return min(map(self._along, mixed))

    def _free(self, errors: Errors) -> NDArray[np.float64]:
        """Return errors without what the parameters could make good."""
        error = np.concatenate(errors)
        return np.asarray(error - self._own @ (self._own.T @ error))

    def _along(self, error: NDArray[np.float64]) -> float:
        """Return the whitened share of an error that the parameters could not make good."""
        slow = self._slow(np.split(error, self._ends))
        coefficients = _whitening(slow)
        white, own = self._whitened(coefficients)
        basis, left = _spanned(white), _filtered(slow, coefficients)
        left = left - own @ (own.T @ left)
        return float(np.sum((basis.T @ left) ** 2)) / max(float(left @ left), 1e-300)

    def _whitened(self, coefficients: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inputs' columns, filtered and free of what the parameters could make good, and a basis of that."""
        own = _spanned(_filtered(self._slow_own, coefficients))
        white = _filtered(self._slow_inputs, coefficients)
        return white - own @ (own.T @ white), own

    def _slow(self, errors: Errors) -> list[NDArray[np.float64]]:
        """Return the means of each record's error over intervals, the last of which may be shorter."""
        found = []
        for error, every in zip(errors, self._every, strict=True):
            begins = np.arange(0, len(error), every)
            counts = np.diff(begins, append=len(error)).reshape(-1, *[1] * (error.ndim - 1))
            found.append(np.add.reduceat(error, begins, axis=0) / counts)
        return found


def _shown(plants: Sequence[Plant], begun: Sequence[Beginning]) -> list[NDArray[np.float64]]:
    """Return what the sensors of `plants` show of records that begin like this."""
    return [start.simulated(plant).shown(plant) for plant, start in zip(plants, begun, strict=True)]


def _sensitivities(
    plants: Sequence[Plant], begun: Sequence[Beginning], shown: Errors, *, is_shaken: bool
) -> NDArray[np.float64]:
    """Return how the loops answer to a change of each parameter and of how they begin, shape (n, k).

    A simulation begins at the first sample, which the sensor's noise has moved: where dry friction holds the axis it
    stays there. A draw begins at the same place, so that it does not tell of that. (What shakes an axis moves it
    farther.) The columns of velocities exist for records that begin in motion alone, those of places for axes with
    backlash.
    """
    values = plants[0].named
    columns = []
    for name, value in values.items():
        step = PARAMETER_STEP * value
        if step == 0.0:
            continue
        with suppress(ServolensError):
            others = [plant.with_named({name: plant.named[name] + step}) for plant in plants]
            moved = [one - position for one, position in zip(_shown(others, begun), shown, strict=True)]
            columns.append(np.concatenate(moved))
    for i, (plant, start) in enumerate(zip(plants, begun, strict=True)):
        inwards = -float(np.copysign(PARAMETER_STEP, start.place))
        changes = {"velocity": PARAMETER_STEP * start.velocity, "place": inwards if plant.play else 0.0}
        begins = [replace(start, **{k: getattr(start, k) + change}) for k, change in changes.items() if change != 0.0]
        if not is_shaken:
            position = start.record.position
            higher = position + PARAMETER_STEP * np.ptp(position)
            begins.append(replace(start, record=replace(start.record, position=higher)))
        for other in begins:
            moved = [np.zeros(one.size) for one in shown]
            with suppress(ServolensError):
                moved[i] = _shown([plant], [other])[0] - shown[i]
                columns.append(np.concatenate(moved))
    return np.column_stack([np.empty((sum(map(len, shown)), 0)), *columns])


def share_limit(draws: NDArray[np.float64], level: float) -> float:
    """Return what a share, of which there are `draws`, exceeds with probability `level`.

    Of the beta distribution with their mean and variance: of shares of squares of normal values it is exact, with the
    numbers of independent values as parameters. The variance is that which such draws show less of in one of ten cases.
    """
    from scipy.stats import beta, chi2

    freedom = draws.size - 1
    mean, variance = float(np.mean(draws)), float(np.var(draws)) * freedom / float(chi2.isf(1.0 - UNSURE, freedom))
    if not 0.0 < mean < 1.0 or variance == 0.0:
        return mean
    count = max(mean * (1.0 - mean) / variance - 1.0, 1e-3)
    return float(beta.isf(level, mean * count, (1.0 - mean) * count))


def _filtered(parts: Errors, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return columns of each record, filtered, one below the other."""
    from scipy.signal import lfilter

    return np.concatenate([lfilter(coefficients, [1.0], part, axis=0) if part.size else part for part in parts])


def _whitening(errors: Errors) -> NDArray[np.float64]:
    """Return the coefficients of an autoregressive filter that whitens processes like `errors` (Yule and Walker).

    Those of records that are no longer than its memory tell nothing of it.
    """
    from scipy.linalg import solve_toeplitz

    longer = [error for error in errors if error.size > MOST_ORDER]
    lags = np.array([sum(float(e[k:] @ e[: e.size - k]) for e in longer) for k in range(MOST_ORDER + 1)])
    if lags[0] <= 0.0:
        return np.ones(1)
    lags[0] *= 1.0 + 1e-9  # what is as smooth as a sum of few waves leaves nothing
    return np.concatenate(([1.0], -solve_toeplitz(lags[:-1], lags[1:])))


def _faded(signal: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -np.exp(-decay)], signal))


def shifted(signal: NDArray[np.float64], lag: int) -> NDArray[np.float64]:
    """Return `signal` as many samples later as `lag` says, after zeros."""
    return np.concatenate([np.zeros(min(lag, signal.size)), signal[: max(signal.size - lag, 0)]])


def _spanned(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of what the columns of `rows` span."""
    sizes = np.linalg.norm(rows, axis=0)
    rows = rows[:, sizes > 0.0] / sizes[sizes > 0.0]
    if rows.shape[1] == 0:  # of a loop that answers to nothing
        return rows
    left, singular, _ = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(left[:, singular > 1e-9 * singular[0]])
