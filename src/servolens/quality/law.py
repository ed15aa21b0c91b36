"""The family of control laws that a logged voltage may follow, fitted by least squares.

Every law of :class:`~servolens.controller.Controller` is a sum of columns made of the logged signals (error,
derivative, reference, its velocity, their integrals, a constant). What weighs them are the gains, so a few sums of
squares tell how well any choice of gains explains the voltage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.control_arithmetic import samples_a_tick, steps_of
from servolens.control_law import rms
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from servolens.record import Record

    Array = NDArray[np.float64]

__all__ = [
    "GAINS",
    "PARAMETERS",
    "LawFit",
    "controller_of",
    "parameters_of",
    "remembered",
    "tick_phase",
    "voltage_of",
]

GAINS = ("kp", "kd")
PARAMETERS = (*GAINS, "setpoint_weight", "ki", "integral_before", "velocity_feedforward", "integral_rate")
"""What weighs the columns, as the controller's fields are called; the commonest first."""
OF_PID, OF_CASCADE = {"setpoint_weight", "ki"}, {"integral_rate"}
"""Those of them that the other law does not have."""
ROUNDS, CONVERGED = 8, 1e-9
"""Gauss-Newton steps at most, and relative change that ends them; without set-point weight and rate one is enough."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class LawFit:
    """The columns of the law of a record, and what they have in common with its voltage.

    Attributes
    ----------
    controller : Controller
        Stated gains, and the settings with which the columns were made.
    columns : ndarray, shape (9, n)
        Error, −derivative, reference, its velocity, the integrals of these four, 1.
    voltage : ndarray, shape (n,)
        Without feedforward and what back-calculation takes back.
    rows : ndarray of bool, shape (n,)
        Samples in use.
    gram : ndarray, shape (9, 9)
        Of the columns, over the samples in use.
    shared : ndarray, shape (9,)
        Products with the voltage, over the same.
    """

    controller: Controller
    columns: Array
    voltage: Array
    rows: NDArray[np.bool_]
    gram: Array
    shared: Array

    @classmethod
    def of(cls, record: Record, rows: NDArray[np.bool_], *, gains_known: bool = True) -> LawFit:
        """Return the fit of a record with reference and voltage over the samples `rows`.

        Which samples of a clamped integral do not grow, the gains tell if they are known, else the logged voltage.

        Raises
        ------
        InputError
            As :func:`~servolens.control_law.controller_voltage`.
        """
        columns = _columns(record, gains_known=gains_known)
        voltage = voltage_of(record) - _known(record)
        stated = controller_of(record)
        if stated.anti_windup == "back_calculation":  # its default would follow the gains
            stated = replace(stated, tracking_time=stated.tracking)
        return cls.over_rows(stated, columns, voltage, rows)

    @classmethod
    def over_rows(cls, controller: Controller, columns: Array, voltage: Array, rows: NDArray[np.bool_]) -> LawFit:
        """Return the fit over the samples `rows`."""
        used = columns[:, rows]
        return cls(controller, columns, voltage, rows, used @ used.T, used @ voltage[rows])

    def clamped(self, record: Record, controller: Controller) -> LawFit:
        """Return the fit whose integral stands still where the voltage grows, with these gains, as if it did.

        A voltage beyond the limit says so by itself; just below it only its growth does.
        """
        parts, voltage = self.columns[:4], voltage_of(record)
        weights, _ = _weights(_values(controller))
        grown = _growth(record, controller) * (weights[4:8] @ parts)
        grows = np.diff(self.voltage - weights[:4] @ parts, prepend=math.nan)
        stands = (np.abs(grows) < np.abs(grows - grown)) | (np.abs(voltage) > _limit(record))
        near = (np.abs(voltage) + np.abs(grown) > _limit(record)) & (voltage * grown > 0.0)
        columns = _with_integrals(parts, np.where(near & stands, 0.0, _growth(record, controller)))
        return LawFit.over_rows(self.controller, columns, self.voltage, self.rows)

    def over(self, rows: NDArray[np.bool_]) -> LawFit:
        """Return the fit over other samples."""
        return LawFit.over_rows(self.controller, self.columns, self.voltage, rows)

    def fitted(self, free: Collection[str]) -> Controller:
        """Return the controller whose `free` parameters fit the voltage best; the others are as stated."""
        at = [PARAMETERS.index(name) for name in free]
        values = _values(self.controller)
        sizes = _positive(np.sqrt(np.diag(self.gram)))
        gram, shared = self.gram / np.outer(sizes, sizes), self.shared / sizes
        for _ in range(ROUNDS if at else 0):
            weights, slopes = _weights(values)
            slopes = slopes[:, at] * sizes[:, None]
            scale = _positive(np.linalg.norm(slopes, axis=0))
            slopes = slopes / scale
            left = slopes.T @ (shared - gram @ (weights * sizes))
            step = np.linalg.lstsq(slopes.T @ gram @ slopes, left, rcond=1e-11)[0] / scale
            if not np.isfinite(step).all():
                break
            values[at] += step
            if np.all(np.abs(step) <= CONVERGED * np.abs(values[at])):
                break
        values[-1] = max(values[-1], 0.0)
        found = dict(zip(PARAMETERS, values.tolist(), strict=True))
        return replace(self.controller, **{name: found[name] for name in free})

    def asked(self, controller: Controller) -> Array:
        """Return what the law asks for with these gains, shape (n,)."""
        values = _values(controller)
        return np.asarray(_weights(values)[0] @ self.columns)

    def missed(self, controller: Controller) -> Array:
        """Return what these gains leave of the voltage, shape (n,)."""
        return np.asarray(self.voltage - self.asked(controller))

    def left(self, controller: Controller) -> float:
        """Return the same over the samples in use, r.m.s."""
        return rms(self.missed(controller)[self.rows])

    def share_left(self, controller: Controller) -> float:
        """Return the same as a share of the voltage; infinite where that is nothing."""
        size = rms(self.voltage[self.rows])
        return self.left(controller) / size if size > 0.0 else math.inf


def _positive(sizes: Array) -> Array:
    return np.where(sizes > 0.0, sizes, 1.0)


def voltage_of(record: Record) -> Array:
    """Return the logged voltage; records without are judged elsewhere."""
    if record.voltage is None:
        raise TypeError("a law is fitted to a logged voltage")
    return record.voltage


def controller_of(record: Record) -> Controller:
    """Return the stated controller, or one of which only the settings count."""
    return record.controller or Controller(kp=1.0)


def parameters_of(controller: Controller) -> tuple[str, ...]:
    """Return the parameters that a law of this kind has."""
    others = OF_PID if controller.is_cascade else OF_CASCADE
    return tuple(name for name in PARAMETERS if name not in others)


def remembered(controller: Controller, record: Record) -> int:
    """Return the samples for which the derivative depends on what was before the record."""
    past = controller.derivative_window + math.ceil(5 / controller.derivative_filter)
    return min(past * samples_a_tick(controller, record.sample_time), len(record) // 4)


def _values(controller: Controller) -> Array:
    """Return the numbers of the `PARAMETERS`, 0 of what is not stated."""
    return np.array([getattr(controller, name) or 0.0 for name in PARAMETERS])


def tick_phase(record: Record) -> int:
    """Return the first sample at which a loop slower than the log runs: there its voltage changes."""
    count = samples_a_tick(controller_of(record), record.sample_time)
    if count == 1 or record.voltage is None or len(record) < 4 * count:
        return 0
    changes = np.flatnonzero(np.diff(record.voltage)) + 1
    return int(np.argmax(np.bincount(changes % count, minlength=count)))


def _columns(record: Record, *, gains_known: bool) -> Array:
    """Return error, −derivative, reference, its velocity, the integrals of these four, and 1."""
    stated = controller_of(record)
    plain = replace(
        stated, kp=1.0, kd=0.0, ki=0.0, setpoint_weight=2.0, velocity_feedforward=0.0, integral_rate=0.0,
        integral_before=0.0, anti_windup="none", tracking_time=None,
    )  # fmt: skip
    found = record.answer(plain)  # what leads is then the reference, as the loop saw it
    slope = record.answer(replace(plain, setpoint_weight=1.0, velocity_feedforward=1.0)).ahead
    parts = np.stack((found.error, -found.derivative, found.ahead, slope))
    growth = _growth(record, stated)
    if stated.anti_windup == "clamping":
        growth[_clamped(record, stated if gains_known else None, found.error)] = 0.0
    return _with_integrals(parts, growth)


def _with_integrals(parts: Array, growth: Array) -> Array:
    return np.concatenate((parts, np.cumsum(growth * parts, axis=1), np.ones((1, growth.size))))


def _growth(record: Record, controller: Controller) -> Array:
    """Return by how much the integral of 1 grows at each sample, while nothing clamps it [s]."""
    growth, ticks = np.zeros(len(record)), np.flatnonzero(_ticks(record, controller))
    period = samples_a_tick(controller, record.sample_time) * record.sample_time
    growth[ticks] = steps_of(controller, record.time[ticks], period)
    return growth


def _clamped(record: Record, stated: Controller | None, error: Array) -> NDArray[np.bool_]:
    """Mark the samples at which the integral does not grow: its own, or while the voltage is beyond the limit."""
    if stated is not None and stated.integrates:
        return np.asarray(np.diff(record.answer(stated).integral, prepend=stated.initial_integral) == 0.0)
    voltage = voltage_of(record)
    return np.asarray((np.abs(voltage) > _limit(record)) & (voltage * error > 0.0))


def _known(record: Record) -> Array:
    """Return what is in the voltage beside the columns: feedforward, and what back-calculation takes back."""
    added = np.zeros(len(record)) if record.feedforward is None else record.feedforward
    stated, voltage = controller_of(record), record.voltage
    if stated.anti_windup != "back_calculation" or not stated.integrates or voltage is None:
        return added
    count = samples_a_tick(stated, record.sample_time)
    beyond = np.clip(voltage, -_limit(record), _limit(record)) - voltage
    pulled = np.cumsum(_growth(record, stated) * beyond) / stated.tracking
    return np.asarray(added + np.concatenate((np.zeros(count), pulled))[: pulled.size])


def _limit(record: Record) -> float:
    return math.inf if record.voltage_limit is None else record.voltage_limit


def _ticks(record: Record, controller: Controller) -> NDArray[np.bool_]:
    """Mark the samples at which the loop runs."""
    count = samples_a_tick(controller, record.sample_time)
    period = np.rint((record.time - record.time[0]) / record.sample_time).astype(np.int64) // count
    return np.asarray(np.diff(period, prepend=-1) != 0)


def _weights(values: Array) -> tuple[Array, Array]:
    """Return the columns' weights for these parameters, and their derivatives, shape (9, 7)."""
    kp, kd, share, ki, before, forward, rate = values.tolist()
    ahead = (share - 1.0) * kp
    direct = np.array([kp, kd, ahead, forward])
    weights = np.concatenate((direct, rate * direct, [before]))
    weights[4] += ki
    slopes = np.zeros((9, len(PARAMETERS)))
    own = np.zeros((4, len(PARAMETERS)))
    own[0, 0] = own[1, 1] = own[3, 5] = 1.0
    own[2, 0], own[2, 2] = share - 1.0, kp
    slopes[:4], slopes[4:8] = own, rate * own
    slopes[4:8, 6] = direct
    slopes[4, 3] = slopes[8, 4] = 1.0
    return weights, slopes
