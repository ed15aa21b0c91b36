"""What the inputs would leave in a whitened residual if a model lacked something: instruments of a general kind.

None is made of what was measured in a closed loop, for feedback carries the noise into it (Ljung 1999, section 16.6;
Söderström and Stoica 1989, chapter 11).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import NumericalError, ServolensError
from servolens.identification.loop_errors import shifted
from servolens.identification.segments import applied_voltage
from servolens.prediction import from_beginning

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.identification.score import ScoreTest
    from servolens.plant import Plant

    Motion = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

__all__ = ["forces_along", "instruments", "noise_free", "noise_free_run"]

SMALL = 1e-3
"""Share of the largest voltage with which the axis is pushed to see what a force would do."""
SPEEDS = np.array([-1.0, -0.3, -0.1, -0.03, 0.0, 0.03, 0.1, 0.3, 1.0])
"""Knots of a force over velocity or voltage, in units of the largest: dense where friction and dead zones act."""
PLACES = np.linspace(0.0, 1.0, 7)
"""Knots of a force over the travel and over time."""
STILL = 0.01
"""Share of the top speed below which dry friction changes its sign gradually."""
RINGING_DAMPING = 0.1
RINGING = np.geomspace(0.25, 32.0, 24)
"""Damping ratio and frequencies of modes that the inputs may set ringing, in units of the loops' rate: a quarter apart,
about the width of such a mode, so that none falls between two."""
LAGS = 2
"""Ratio of one lag of an instrument to the one before."""


def instruments(test: ScoreTest) -> Iterator[NDArray[np.float64]]:
    """Yield what each kind of instrument would do to the whitened residual, shape (n, k).

    The reference at several lags; modes that it sets ringing; forces over velocity, position, voltage and time; and
    friction, damping and gain that change in time, otherwise in each record. What needs no simulation comes first: most
    of what depends on the inputs shows there.

    Raises
    ------
    NumericalError
        If the axis cannot be simulated with any force beside it.
    """
    yield _of_reference(test)
    yield _ringing(test)
    motions = [noise_free(test, i) for i in range(len(test.runs))]
    records = [run.signals.record for run in test.runs]
    closed = all(record.has_loop for record in records)
    # without a reference the motion is a measured one, and so are its products with the noise
    forces = _pushed(test, forces_along(motions, with_products=closed))
    if not forces.shape[1]:
        raise NumericalError("the axis cannot be simulated with any force beside it")
    yield forces
    if closed:
        yield from (_of_each_record(test, _pushed(test, laws)) for laws in _changing(motions))


def _pushed(test: ScoreTest, laws: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return what each force would do to the whitened residual, shape (n, k), of those along each record, (k, m).

    Without those under which an axis that sticks would chatter so fast that it cannot be simulated.
    """
    size = SMALL * max(float(np.abs(run.signals.voltage).max()) for run in test.runs)
    columns = []
    for k in range(laws[0].shape[0]):
        with suppress(NumericalError):
            columns.append(test.pushed([law[k] for law in laws], size))
    return np.column_stack(columns) if columns else np.empty((test.residual.size, 0))


def _of_each_record(test: ScoreTest, columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the columns of each record by themselves, shape (n, records · k)."""
    ends = np.cumsum([run.samples for run in test.runs])[:-1]
    return _apart(np.split(columns, ends))


def _apart(blocks: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the columns of all records side by side, each 0 in the others."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks))


def _changing(motions: Sequence[Motion]) -> Iterator[list[NDArray[np.float64]]]:
    """Yield dry friction, damping and gain that act for a part of the time alone, along each record, shape (k, m)."""
    fastest = max(float(np.abs(v).max()) for _, v, _ in motions)
    slow = max(STILL * fastest, 1e-300)
    terms = (
        [np.clip(v / slow, -1.0, 1.0) for _, v, _ in motions],
        [v for _, v, _ in motions],
        [u for *_, u in motions],
    )
    for term in terms:
        most = max(max(float(np.abs(force).max()) for force in term), 1e-300)
        yield [np.array(_hats(np.linspace(0.0, 1.0, force.size), PLACES)) * force / most for force in term]


def forces_along(
    found: Sequence[Motion],
    *,
    with_products: bool = False,
) -> list[NDArray[np.float64]]:
    """Return forces of all kinds along position, velocity and voltage of each record, shape (k, n)."""
    fastest = max(float(np.abs(v).max()) for _, v, _ in found)
    low, high = min(float(y.min()) for y, _, _ in found), max(float(y.max()) for y, _, _ in found)
    most = max(float(np.abs(u).max()) for _, _, u in found)
    laws = []
    for y, v, u in found:
        rows = [*_hats(v / max(fastest, 1e-300), SPEEDS), *_hats((y - low) / max(high - low, 1e-300), PLACES)]
        rows += [*_hats(u / max(most, 1e-300), SPEEDS), *_hats(np.linspace(0.0, 1.0, y.size), PLACES)]
        rows += [np.diff(v, prepend=v[0]), np.diff(u, prepend=u[0]), v * (y - low), np.sign(v) * (y - low)]
        rows += _products(y - low, v, u) if with_products else ()
        laws.append(np.array([row / max(float(np.abs(row).max()), 1e-300) for row in rows]))
    return laws


def _products(y: NDArray[np.float64], v: NDArray[np.float64], u: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield forces of second order: place, speed, its sign and voltage, each changing over another, time or path."""
    time, path = np.linspace(0.0, 1.0, y.size), np.cumsum(np.abs(v))
    for along in (time, path):
        for force in (v, np.sign(v), u):
            yield force * (along - np.mean(along))
    for force in (y * u, v * u, np.sign(v) * u, y * time, y * path):
        yield force - np.mean(force)


def noise_free(test: ScoreTest, i: int) -> Motion:
    """Return position, velocity and voltage that know nothing of the noise, on the grid that is simulated."""
    signals, record = test.runs[i].signals, test.runs[i].signals.record
    run = None
    if record.has_loop:
        with suppress(ServolensError):
            run = from_beginning(test.hypothesis.plant_of(i), record)
    if run is None:
        from servolens.identification.smoothing import smooth

        value, slope = smooth(signals.time, signals.position, min(41, signals.time.size))
        return value, slope, np.concatenate([signals.voltage[:1], signals.voltage[:-1]])
    at = [np.interp(signals.time, record.time, signal) for signal in (run.position, run.velocity, run.voltage)]
    return at[0], at[1], at[2]


def noise_free_run(run: ObservedRun | SimulatedRun, plant: Plant) -> ObservedRun | SimulatedRun:
    """Return a record as it would be if `plant` were the axis and nothing disturbed it; as it is without a loop."""
    record = run.signals.record
    if record.has_loop:
        with suppress(ServolensError):
            moved = from_beginning(plant, record)
            return run.measured_as(moved.measured, applied_voltage(replace(record, voltage=moved.voltage)))
    return run


def _hats(values: NDArray[np.float64], knots: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the piecewise linear functions that are 1 at one of the `knots` and 0 at the others."""
    return [np.interp(values, knots, row) for row in np.eye(knots.size)]


def _of_reference(test: ScoreTest) -> NDArray[np.float64]:
    """Return changes of the reference over several lags, whitened, shape (n, k): those of each record by themselves."""
    found = [(run, _of_run(run)) for run in test.runs]
    return _apart([run.whiten(columns) if columns.shape[1] else columns for run, columns in found])


def _of_run(run: ObservedRun | SimulatedRun) -> NDArray[np.float64]:
    signals = _driving(run)
    found = []
    for signal in signals:
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(signal)))])
        for one in (signal, way) if np.any(np.diff(signal) < 0.0) and np.any(np.diff(signal) > 0.0) else (signal,):
            found += _lagged(one)
    return np.column_stack(found) if found else np.empty((run.samples, 0))


def _driving(run: ObservedRun | SimulatedRun) -> list[NDArray[np.float64]]:
    """Return what drives the record and knows nothing of the noise, on the samples that are simulated."""
    record, signals = run.signals.record, run.signals
    at = np.searchsorted(record.time, signals.time[slice(None) if signals.index is None else signals.index] + 1e-12)
    at = np.clip(at - 1, 0, len(record) - 1)
    if record.reference is None:
        voltage = signals.voltage if signals.index is None else signals.voltage[signals.index]
        return [np.concatenate([voltage[:1], voltage[:-1]])]
    return [record.reference[at], *([] if record.feedforward is None else [record.feedforward[at]])]


def _ringing(test: ScoreTest) -> NDArray[np.float64]:
    """Return what lightly damped modes that the inputs set ringing would add to the residual, shape (n, k)."""
    from scipy.signal import lfilter

    parts = []
    for run in test.runs:
        step = float(np.median(np.diff(run.instants)))
        kicks = [np.diff(signal, prepend=signal[0]) for signal in _driving(run)]
        poles = np.exp(test.rate * RINGING * (1j - RINGING_DAMPING) * step)
        rung = [lfilter([1.0], [1.0, -pole], np.asarray(kick, dtype=complex)) for kick in kicks for pole in poles]
        parts.append(run.whiten(np.column_stack([part for one in rung for part in (one.real, one.imag)])))
    most = max(part.shape[1] for part in parts)  # a record without a feedforward has that of no change
    return np.concatenate([np.pad(part, ((0, 0), (0, most - part.shape[1]))) for part in parts])


def _lagged(signal: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return by how much `signal` changed between lags that grow geometrically."""
    found, early = [], 0
    padded = signal - signal[0]
    while early < signal.size // LAGS:
        late = max(LAGS * early, early + 4)
        column = shifted(padded, early) - shifted(padded, late)
        if np.any(column != 0.0):
            found.append(column)
        early = late
    return found
