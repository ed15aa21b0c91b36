"""How far plants are from records: in closed loop, as a person sees it, and on records held out."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.logs import beyond
from servolens.diagnosis.trials import LOOSE, loop_rate
from servolens.errors import NumericalError
from servolens.identification.phases import synchronised
from servolens.identification.refine import square_error
from servolens.identification.runs import ClosedRun, TetheredRun, tether, voltage_runs
from servolens.identification.segments import noise_level
from servolens.quality.beginning import initial_motion
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.identification.runs import Run
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["pooled", "residual", "rotated"]

SETTLED, SURE, SMOOTHED = 3, 3.0, 12.0
"""Steps in which an initial state is found, and its standard errors within which; samples that a velocity is as of."""
KEPT = 0.6
"""Part of a record that is parted which is fitted; the rest is held out."""


def residual(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Return simulated minus measured position, of the closest of several simulations.

    In closed loop from the reference, as other gains are predicted, from rest and, if it seems to move at first, in
    motion: a late start seems to be one backward. And driven by the logged voltage, which knows what the controller
    made of the noise: an axis that sticks is shaken loose by it. Where none is possible, without reference and away
    from rest, the run is loosely tied to the measured position. Infinite where a simulation leaves all bounds.
    """
    runs: list[Run] = [*voltage_runs([record])]
    if len(runs) != 1 or runs[0].measured.size != len(record):
        runs = []
    moves = initial_motion(record) != 0.0
    if record.reference is not None and record.controller is not None:
        runs += [ClosedRun(record, 0), *([ClosedRun(record, 0, in_motion=True)] if moves else [])]
    noise = noise_level(record)
    closest = min((_difference(plant, run, noise, moves=moves) for run in runs), key=_size, default=np.array([np.inf]))
    if np.isfinite(closest).all():
        return closest
    tied = TetheredRun(record, 0, tether(plant, LOOSE * loop_rate(plant, [record])))
    return _difference(plant, tied, noise, moves=moves)


def _difference(plant: Plant, run: Run, noise: float, *, moves: bool) -> NDArray[np.float64]:
    """Return simulated minus measured position.

    What only the record can know is fitted: phases, and the initial state within its own errors. That of a record which
    does not begin in motion may be rest at the first sample as well: smoothed, a start at full voltage is motion.
    """
    substeps, start = substeps_for(plant, run.sample_time), run.start
    plant = synchronised(plant, partial(square_error, run, substeps))
    reach = SURE * noise * np.array([1.0, 1.0 / (SMOOTHED * run.sample_time)])[: start.size]
    low, high = start - reach, start + reach
    if start.size and not moves:
        rest = np.array([run.measured[0], 0.0])[: start.size]
        low, high = np.minimum(low, rest - reach), np.maximum(high, rest + reach)

    def at(start: NDArray[np.float64]) -> NDArray[np.float64]:
        return run.simulated(plant, start, substeps) - run.measured

    try:
        found = at(start)
        for _ in range(SETTLED if start.size else 0):
            shifts = np.diag(run.shifts)
            slopes = np.column_stack([(at(start + m) - at(start - m)) / (2.0 * m.sum()) for m in shifts])
            further = start - np.linalg.lstsq(slopes, found, rcond=None)[0]
            further = np.clip(further, low, high)
            better = at(further)
            if _size(better) >= _size(found):
                break
            start, found = further, better
    except NumericalError:
        return np.full(run.measured.size, np.inf)
    return found


def _size(residual: NDArray[np.float64]) -> float:
    return float(residual @ residual)


def pooled(residuals: Sequence[NDArray[np.float64]]) -> float:
    """Return the root mean square of all residuals together."""
    if not all(np.isfinite(r).all() for r in residuals):
        return float("inf")
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


def rotated(records: Sequence[Record], fit: Callable[[Sequence[Record]], Plant]) -> list[NDArray[np.float64]]:
    """Return each record's residual by the plant that `fit` finds without it.

    A record that goes far beyond all others, as a single one does, is parted: its beginning is fitted too, the residual
    is that of its end. Without it nothing could be known of what shows in it alone.
    """
    found = []
    for i, record in enumerate(records):
        others, cut = [other for k, other in enumerate(records) if k != i], 0
        if not others or beyond(others, [record]):
            cut = max(int(KEPT * len(record)), 2)
            others.append(record.slice(float(record.time[0]), float(record.time[cut - 1])))
        found.append(residual(fit(others), record)[cut:])
    return found
