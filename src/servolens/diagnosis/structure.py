"""Whether what a model leaves depends on the inputs, and how much it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.diagnosis.trials import FALSE_ALARM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.diagnosis.score import ScoreTest
    from servolens.identification.observed import ObservedRun
    from servolens.record import Record

__all__ = ["MATERIAL", "Remainder", "depends_on_inputs", "unexplained_acceleration"]

MATERIAL = 0.005
"""Share of the travel from which on a remainder matters to whoever tunes: half the usual band of 1 %."""
TOLERATED = 0.1
"""Size of a structure, in standard deviations of the innovation, that no simulation is exact enough to judge."""
LAGS = 2
"""Ratio of one lag of an instrument to the one before."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """What the chosen model misses beyond the noise.

    Attributes
    ----------
    rms : float
        R.m.s. of the simulation's error beyond the noise, in quadrature [m or rad].
    times_noise : float or None
        The simulation's error over the noise floor; None without noise.
    of_travel : float
        `rms` over the range of the position.
    acceleration_rms : float
        R.m.s. of the acceleration that nothing explains [m/s² or rad/s²].
    of_motor : float
        The same over the largest acceleration that the motor gives.
    depends_on_inputs : bool
        Whether it depends on reference, feedforward or a column of the catalogue; else it is noise or shaking.
    material : bool
        Whether `of_travel` exceeds half a percent.
    """

    rms: float
    times_noise: float | None
    of_travel: float
    acceleration_rms: float
    of_motor: float
    depends_on_inputs: bool
    material: bool

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: getattr(self, name) for name in self.__slots__}


def depends_on_inputs(test: ScoreTest) -> bool:
    """Tell whether the residual of a hypothesis depends on the inputs.

    The whitened residual is regressed on instruments: differences of the reference and of the way that it has gone,
    over lags from one sample to the whole record, whitened likewise and at right angles to what the hypothesis itself
    explains. The explained sum of squares is χ², beyond what the tolerated size of a structure adds to it. Measured
    position and voltage are no instruments, for feedback carries the noise into them; only without a reference the
    voltage of past samples takes its place (Ljung 1999, section 16.6; Söderström and Stoica 1989, chapter 11).
    """
    from scipy.stats import ncx2

    columns = _instruments(test)
    if columns.shape[1] == 0:
        return False
    free = test.free_of_own(columns)
    sizes = np.linalg.norm(free, axis=0)
    free = free[:, sizes > 1e-6 * np.linalg.norm(columns, axis=0)]
    free = free / np.linalg.norm(free, axis=0)
    left, singular, _ = np.linalg.svd(free, full_matrices=False)
    basis = left[:, singular > 1e-6 * singular[0]]
    along = basis.T @ test.left
    limit = float(ncx2.isf(FALSE_ALARM, basis.shape[1], TOLERATED**2 * test.left.size))
    return float(along @ along) > limit


def _instruments(test: ScoreTest) -> NDArray[np.float64]:
    """Return the instruments of all records, whitened, shape (n, k): those of each record are 0 in the others."""
    blocks = [run.whiten(_of_run(run)) for run in test.runs]
    columns = np.zeros((test.residual.size, sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        columns[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return columns


def _of_run(run: ObservedRun) -> NDArray[np.float64]:
    signals = _driving(run)
    found = []
    for signal in signals:
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(signal)))])
        for one in (signal, way) if np.any(np.diff(signal) < 0.0) and np.any(np.diff(signal) > 0.0) else (signal,):
            found += _lagged(one)
    return np.column_stack(found) if found else np.empty((run.samples, 0))


def _driving(run: ObservedRun) -> list[NDArray[np.float64]]:
    """Return what drives the record and knows nothing of the noise, on the samples that are simulated."""
    record, signals = run.signals.record, run.signals
    at = np.searchsorted(record.time, signals.time[slice(None) if signals.index is None else signals.index] + 1e-12)
    at = np.clip(at - 1, 0, len(record) - 1)
    if record.reference is None:
        voltage = signals.voltage if signals.index is None else signals.voltage[signals.index]
        return [np.concatenate([voltage[:1], voltage[:-1]])]
    return [record.reference[at], *([] if record.feedforward is None else [record.feedforward[at]])]


def _lagged(signal: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return by how much `signal` changed between lags that grow geometrically."""
    found, early = [], 0
    padded = signal - signal[0]
    while early < signal.size // LAGS:
        late = max(LAGS * early, early + 4)
        column = _shifted(padded, early) - _shifted(padded, late)
        if np.any(column != 0.0):
            found.append(column)
        early = late
    return found


def _shifted(signal: NDArray[np.float64], lag: int) -> NDArray[np.float64]:
    return np.concatenate([np.zeros(min(lag, signal.size)), signal[: max(signal.size - lag, 0)]])


def unexplained_acceleration(
    records: Sequence[Record], residuals: Sequence[NDArray[np.float64]], rate: float, noise: float
) -> float:
    """Return the r.m.s. acceleration that the residuals of simulations stand for [m/s² or rad/s²].

    Second derivatives of local cubics over the time in which the loop acts, 2/`rate`; the share that sensor noise alone
    would have is taken off.

    Parameters
    ----------
    records : sequence of Record
        The measurements.
    residuals : sequence of ndarray, shape (n,)
        Simulated minus measured position of each [m or rad].
    rate : float
        Of the loops [rad/s].
    noise : float
        Standard deviation of the sensor's noise [m or rad].
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    squares, samples = 0.0, 0
    for record, residual in zip(records, residuals, strict=True):
        window = int(min(max(2.0 / rate / record.sample_time, 7), len(record) // 2)) // 2 * 2 + 1
        if window < 5 or residual.size <= window or not np.isfinite(residual).all():
            continue
        curve = savgol_filter(residual, window, 3, deriv=2, delta=record.sample_time)
        weights = savgol_coeffs(window, 3, deriv=2, delta=record.sample_time)
        squares += max(float(curve @ curve) - curve.size * noise**2 * float(weights @ weights), 0.0)
        samples += curve.size
    return float(np.sqrt(squares / samples)) if samples else 0.0
