"""Columns of a log that are shifted against each other by whole samples: the control law then holds between others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np

from servolens.control_law import law_columns, samples_a_period
from servolens.quality.beginning import initial_motion
from servolens.record import Controller

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["Shift", "find_shift", "fit_gains", "realigned", "remembered", "rms"]

Gains = tuple[float, float]
Column = Literal["voltage", "position", "reference"]
COLUMNS: tuple[Column, ...] = ("voltage", "position", "reference")
"""In the order in which they are blamed where several shifts explain a log, as before the first step of a reference."""
MOST = 20
"""Samples up to which a shift is looked for."""
BETTER, OWN = 0.1, 0.02
"""Share of the misfit that a shift may leave with the stated gains, and with gains of its own."""
AS_WELL = 1.2
"""Times the least misfit up to which another shift explains a log as well."""
HOLDS, EXACT = 1e-3, 1e-6
"""Share of the voltage up to which the law holds as it stands, with the stated gains and with gains of its own."""
STRETCH, HISTORY = 20_000, 1_000
"""Samples that are looked at, around the largest misfit; of these, those that only fill the derivative's memory."""


@final
@dataclass(frozen=True, slots=True)
class Shift:
    """A column that is logged late.

    Attributes
    ----------
    column : {"voltage", "position", "reference"}
        Which.
    samples : int
        By how many; negative if it is early.
    """

    column: Column
    samples: int


SHIFTS = tuple(Shift(column, sign * size) for column, size, sign in product(COLUMNS, range(1, MOST + 1), (1, -1)))
"""All that are tried, the small ones of each column first."""


class _Law(NamedTuple):
    """Both columns of the law, and what they are to make."""

    error: NDArray[np.float64]
    derivative: NDArray[np.float64]
    target: NDArray[np.float64]

    def missed(self, rows: NDArray[np.bool_], gains: Gains | None) -> NDArray[np.float64]:
        """Return what these gains leave of `rows`, or those that fit them."""
        error, derivative, target = self.error[rows], self.derivative[rows], self.target[rows]
        kp, kd = fit_gains(error, derivative, target) if gains is None else gains
        return np.asarray(target - kp * error + kd * derivative)

    def left(self, rows: NDArray[np.bool_], gains: Gains | None) -> float:
        """Return the same, r.m.s."""
        return rms(self.missed(rows, gains))


class _Tried(NamedTuple):
    """A shift, and what stated and fitted gains leave of the voltage after it; and before, of the same samples."""

    shift: Shift
    stated: float
    stated_before: float
    fitted: float
    fitted_before: float


def find_shift(record: Record, clipped: NDArray[np.bool_]) -> Shift | None:
    """Return the shift of one column after which the voltage fits the law far better; None without one.

    It fits the stated gains then, better than any others without a shift; if none does, gains of its own.

    Parameters
    ----------
    record : Record
        With reference, voltage and controller.
    clipped : ndarray of bool, shape (n,)
        Samples whose voltage is not what the law asks for.

    Raises
    ------
    InputError
        As :func:`~servolens.control_law.law_columns`.
    """
    if np.count_nonzero(~clipped) <= 3 * MOST:
        return None
    part, used = _stretch(record, ~clipped)
    stands, stated = _law(part), _stated(record)
    size, others = rms(stands.target[used]), stands.left(used, None)
    if others <= EXACT * size or stands.left(used, stated) <= HOLDS * size:
        return None
    tried = [_tried(part, stands, used, shift, stated) for shift in SHIFTS]
    as_stated = {one.shift: one.stated for one in tried if one.stated <= min(BETTER * one.stated_before, others)}
    as_fitted = {one.shift: one.fitted for one in tried if one.fitted <= OWN * one.fitted_before}
    left = as_stated or as_fitted
    least = min(left.values(), default=0.0)
    return next((shift for shift in left if left[shift] <= AS_WELL * least + EXACT * size), None)


def realigned(record: Record, shift: Shift) -> Record:
    """Return the record with the shifted column where it belongs, without the samples that then lack a value."""
    first, last = max(-shift.samples, 0), len(record) - 1 - max(shift.samples, 0)
    return _moved_back(record, shift).slice(float(record.time[first]), float(record.time[last]))


def remembered(record: Record) -> int:
    """Return the samples for which the derivative depends on what was before the record."""
    controller = record.controller or Controller(kp=1.0)
    past = controller.derivative_window + math.ceil(5 / controller.derivative_filter)
    return min(past * samples_a_period(controller, record.sample_time), len(record) // 4)


def fit_gains(
    error: NDArray[np.float64], derivative: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[float, float]:
    """Solve two normal equations with columns scaled to one; a column that is nothing gets no gain."""
    sizes = [rms(error) or 1.0, rms(derivative) or 1.0]
    columns = np.stack((error / sizes[0], -derivative / sizes[1]))
    gram = columns @ columns.T
    solution = np.linalg.lstsq(gram, columns @ target, rcond=1e-10)[0]
    return float(solution[0] / sizes[0]), float(solution[1] / sizes[1])


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square, 0 of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _stretch(record: Record, used: NDArray[np.bool_]) -> tuple[Record, NDArray[np.bool_]]:
    """Return the samples around the largest misfit, if there are too many, and which of them tell of the law."""
    first = 0
    if len(record) > STRETCH:
        worst = int(np.flatnonzero(used)[np.argmax(np.abs(_law(record).missed(used, None)))])
        first = min(max(worst - STRETCH // 2, 0), len(record) - STRETCH)
        record = record.slice(float(record.time[first]), float(record.time[first + STRETCH - 1]))
    used = used[first : first + len(record)].copy()
    if first:
        used[:HISTORY] = False
    elif initial_motion(record):
        used[: remembered(record)] = False
    return record, used


def _stated(record: Record) -> Gains:
    return (0.0, 0.0) if record.controller is None else (record.controller.kp, record.controller.kd)


def _tried(record: Record, stands: _Law, used: NDArray[np.bool_], shift: Shift, stated: Gains) -> _Tried:
    law, rows = _law(_moved_back(record, shift)), _rows(record, used, shift)
    before = stands.left(rows, stated), stands.left(rows, None)
    return _Tried(shift, law.left(rows, stated), before[0], law.left(rows, None), before[1])


def _moved_back(record: Record, shift: Shift) -> Record:
    return record.with_({shift.column: _moved(getattr(record, shift.column), shift.samples)})


def _law(record: Record) -> _Law:
    assert record.voltage is not None  # noqa: S101 - find_shift is given records with a voltage
    error, derivative = law_columns(record)
    added = 0.0 if record.feedforward is None else record.feedforward
    return _Law(error, derivative, record.voltage - added)


def _rows(record: Record, used: NDArray[np.bool_], shift: Shift) -> NDArray[np.bool_]:
    """Return the samples in use whose law is made of logged values alone after a shift."""
    there = np.arange(used.size) + shift.samples
    rows = used & (there >= 0) & (there < used.size)
    if shift.column == "voltage":
        rows &= _moved(used, shift.samples)
        return rows
    if shift.samples < 0:
        rows[: remembered(record) - shift.samples] = False
    return rows


def _moved(signal: NDArray[Any], samples: int) -> NDArray[Any]:
    """Return the signal so many samples on, and its first or last value where it has none."""
    return signal[np.clip(np.arange(signal.size) + samples, 0, signal.size - 1)]
