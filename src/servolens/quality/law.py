"""Which settings the logged voltage fits where it is not what the stated control law asks for.

The family is small and each member explains the log exactly or not at all: a column in another unit, of the other sign
or shifted by samples, one setting of the derivative, the loop's period, a constant or an integral that is added, a
limit. Each is tried with the stated gains first, then with gains of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np

from servolens.control_arithmetic import samples_a_period
from servolens.control_law import law_columns, law_rest
from servolens.quality.beginning import initial_motion
from servolens.quality.limits import NEAR, plateaus
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["UNITS", "Alternative", "find_alternative", "fit_gains", "follows", "remembered", "rms", "tick_phase"]

Column = Literal["voltage", "position", "reference"]
COLUMNS: tuple[Column, ...] = ("voltage", "position", "reference")
"""In the order in which they are blamed where several shifts explain a log, as before the first step of a reference."""
UNITS = {
    180.0 / math.pi: "in degrees where radians are meant",
    math.pi / 180.0: "in radians where degrees are meant",
    1e3: "in thousandths of the unit that is meant, as mm for m",
    1e-3: "in thousands of the unit that is meant, as m for mm",
    1e2: "in hundredths of the unit that is meant, as cm for m",
    1e-2: "in hundreds of the unit that is meant, as m for cm",
}
"""Exact ratios of a column to what it should be that units explain."""
MOST = 20
"""Samples up to which a shift is looked for: 20 ms at 1 kHz, more than buses and buffers delay."""
FILTERS = np.geomspace(0.02, 1.0, 24)
"""Derivative filters that are tried before the best is refined: neighbours differ by 18 %."""
HOLDS = 1e-3
"""Share of the voltage up to which the law holds as it stands: it biases the plant's gain by as much."""
BETTER = 0.1
"""Share of the voltage, or of what is unexplained of it, that an explanation may leave: 1 % of its variance."""
AS_WELL, EXACT = 1.2, 1e-6
"""Times the least misfit, and share of the voltage, up to which a simpler alternative explains a log as well."""
STRETCH = 10_000
"""Samples that are looked at, around the largest misfit, so that time is bounded."""

Gains = tuple[float, float]
Limits = tuple[float, float]
UNLIMITED: Limits = (-math.inf, math.inf)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """Something else than was stated, with which the logged voltage fits the law.

    Attributes
    ----------
    kind : str
        ``"shift"``, ``"unit"``, ``"sign"``, ``"added"``, ``"limit"``, or the setting of the controller.
    value : float or str or tuple of float
        Samples of the shift (positive: logged late), ratio of the unit, constant and integral gain, limits, or the
        value of the setting.
    column : str
        Which column it is about.
    before, left : float
        Unexplained voltage, r.m.s., as stated and with the alternative [the record's command unit].
    """

    kind: str
    value: Any
    column: str = ""
    before: float = math.nan
    left: float = math.nan

    def applied(self, record: Record) -> Record:
        """Return the record as if this had been stated; a shift costs the samples that then lack a value."""
        if self.kind == "shift":
            first, last = max(-self.value, 0), len(record) - 1 - max(self.value, 0)
            moved = _moved_back(record, self.column, self.value)
            return moved.slice(float(record.time[first]), float(record.time[last]))
        if self.kind in ("unit", "sign"):
            return record.with_({"position": record.position / self.value})
        if self.kind == "added":
            constant, integral = _added_columns(record)
            added = self.value[0] * constant + self.value[1] * integral
            known = 0.0 if record.feedforward is None else record.feedforward
            return record.with_({"feedforward": known + added})
        if self.kind == "settings":
            return record.with_({"controller": replace(_controller(record), **dict(self.value))})
        return record


class _Case(NamedTuple):
    """A record as it would be with an alternative, and the samples that tell of the law then."""

    what: Alternative
    record: Record
    rows: NDArray[np.bool_]


class _Tried(NamedTuple):
    """What a case leaves of the voltage of its samples with stated or own gains, and what these leave without it."""

    what: Alternative
    left: float
    before: float


class _Law(NamedTuple):
    """Both columns of the law, what they are to make, and what is added to it."""

    error: NDArray[np.float64]
    derivative: NDArray[np.float64]
    target: NDArray[np.float64]
    added: NDArray[np.float64]

    def asked(self, gains: Gains) -> NDArray[np.float64]:
        """Return the voltage that the law asks for."""
        return np.asarray(gains[0] * self.error - gains[1] * self.derivative + self.added)

    def fitted(self, rows: NDArray[np.bool_], limits: Limits = UNLIMITED) -> Gains:
        """Return the gains that fit the voltage of `rows` within the limits."""
        voltage = self.target + self.added
        margin = NEAR * float(np.ptp(voltage)) if limits != UNLIMITED else 0.0
        rows = rows & (voltage > limits[0] + margin) & (voltage < limits[1] - margin)
        return fit_gains(self.error[rows], self.derivative[rows], self.target[rows])

    def missed(self, gains: Gains, limits: Limits = UNLIMITED) -> NDArray[np.float64]:
        """Return what these gains leave of the voltage."""
        return np.asarray(self.target + self.added - np.clip(self.asked(gains), *limits))

    def left(self, rows: NDArray[np.bool_], gains: Gains | None, limits: Limits = UNLIMITED) -> float:
        """Return what these gains leave of `rows`, or those that fit them, r.m.s."""
        return rms(self.missed(gains or self.fitted(rows, limits), limits)[rows])


def find_alternative(record: Record, clipped: NDArray[np.bool_], *, gains_stated: bool = True) -> Alternative | None:
    """Return the simplest alternative that explains the logged voltage; None if the law holds, or none explains it.

    It leaves at most a tenth of the unexplained voltage, and hardly more than any other does. One with the stated gains
    is simpler than other gains alone, and these are simpler than an alternative with gains of its own.

    Parameters
    ----------
    record : Record
        With reference, voltage and controller.
    clipped : ndarray of bool, shape (n,)
        Samples whose voltage is not what the law asks for.
    gains_stated : bool
        False if the controller's gains are only there for its settings.

    Raises
    ------
    InputError
        As :func:`~servolens.control_law.law_columns`.
    """
    if np.count_nonzero(~clipped) <= 3 * MOST:
        return None
    part, rows = _stretch(record, ~clipped)
    law, controller = _law(part), _controller(record)
    stated = (controller.kp, controller.kd) if gains_stated else None
    size, before, others = rms(law.target[rows]), law.left(rows, stated), law.left(rows, None)
    if others <= EXACT * size or before <= HOLDS * size:
        return None
    found = [] if stated is None else [t for t in _all_tried(part, law, rows, stated) if t.left <= others]
    found.append(_Tried(Alternative(kind="gains", value=()), others, before))
    found += _all_tried(part, law, rows, None)
    least = min(tried.left for tried in found)
    best = next(tried for tried in found if tried.left <= AS_WELL * least + EXACT * size)
    return None if best.what.kind == "gains" else replace(best.what, before=best.before, left=best.left)


def follows(record: Record) -> bool:
    """Tell whether the position is nearer to the reference than where it began.

    A loop with the wrong sign somewhere runs away, and an axis in another unit stays far off: who follows has neither.
    """
    if record.reference is None:
        return False
    return rms(record.reference - record.position) < rms(record.reference - record.position[0])


def remembered(record: Record) -> int:
    """Return the samples for which the derivative depends on what was before the record."""
    controller = _controller(record)
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


def tick_phase(record: Record) -> int:
    """Return the first sample at which a loop slower than the log runs: there its voltage changes."""
    count = samples_a_period(_controller(record), record.sample_time)
    if count == 1 or record.voltage is None or len(record) < 4 * count:
        return 0
    changes = np.flatnonzero(np.diff(record.voltage)) + 1
    return int(np.argmax(np.bincount(changes % count, minlength=count)))


def _all_tried(record: Record, law: _Law, rows: NDArray[np.bool_], gains: Gains | None) -> list[_Tried]:
    """Return the alternatives that leave a tenth or less with these gains, or with gains of their own."""
    cases = chain(
        _scalings(record, rows),
        _shifts(record, rows),
        _settings(record, rows, gains),
        _added(record, law, rows, gains),
        _limits(record, law, rows, gains),
    )
    tried = []
    for what, other, there in cases:
        skipped = len(record) - len(other)
        before = law.left(np.concatenate((np.zeros(skipped, dtype=bool), there)), gains)
        left = _law(other).left(there, gains, what.value if what.kind == "limit" else UNLIMITED)
        if left <= BETTER * before:
            tried.append(_Tried(what, left, before))
    return tried


def _scalings(record: Record, rows: NDArray[np.bool_]) -> Iterator[_Case]:
    """Yield positions of the other sign and in other units."""
    for factor in (-1.0, *UNITS):
        what = Alternative(kind="sign" if factor < 0 else "unit", value=factor, column="position")
        yield _Case(what, what.applied(record), rows)


def _shifts(record: Record, rows: NDArray[np.bool_]) -> Iterator[_Case]:
    """Yield each column late and early, by few samples first."""
    for column, size, sign in product(COLUMNS, range(1, MOST + 1), (1, -1)):
        what = Alternative(kind="shift", value=sign * size, column=column)
        yield _Case(what, _moved_back(record, column, what.value), _rows(record, rows, what))


def _settings(record: Record, rows: NDArray[np.bool_], gains: Gains | None) -> Iterator[_Case]:
    """Yield other settings of the derivative and of the period; two at once only with gains of their own."""
    stated = _controller(record)
    if gains is None or gains[1]:
        for change in _changed_settings(record, stated):
            yield from _case_of(record, rows, change)
        bases = [{}] if gains else [{}, *_changed_settings(record, stated)]
        for base in bases:
            other = record.with_({"controller": replace(stated, **base)})
            share = _best_filter(other, rows, gains)
            if abs(share - stated.derivative_filter) > 0.01 * share:
                yield from _case_of(record, rows, {**base, "derivative_filter": share})
    if record.voltage is not None:
        yield from _case_of(record, rows, {"control_period": _period(record.voltage, record.sample_time)})


def _changed_settings(record: Record, stated: Controller) -> Iterator[dict[str, Any]]:
    """Yield each other discrete setting of the derivative."""
    if record.velocity is not None or stated.derivative == "velocity":
        yield {"derivative": "position" if stated.derivative == "velocity" else "velocity"}
    yield from ({"derivative_window": window} for window in range(1, 5) if window != stated.derivative_window)
    yield {"derivative_on": "measurement" if stated.derivative_on == "error" else "error"}


def _case_of(record: Record, rows: NDArray[np.bool_], changes: dict[str, Any]) -> Iterator[_Case]:
    """Yield the case of these settings, from a tick of the loop on."""
    stated = _controller(record)
    if all(getattr(stated, name) == value for name, value in changes.items()):
        return
    what = Alternative(kind="settings", value=tuple(changes.items()))
    other = what.applied(record)
    first = tick_phase(other)
    other = other.slice(float(other.time[first]), float(other.time[-1]))
    yield _Case(what, other, rows[first:])


def _best_filter(record: Record, rows: NDArray[np.bool_], gains: Gains | None) -> float:
    """Return the derivative filter that leaves least."""
    from scipy.optimize import minimize_scalar

    stated = _controller(record)

    def left(share: float) -> float:
        return _law(record.with_({"controller": replace(stated, derivative_filter=share)})).left(rows, gains)

    at = int(np.argmin([left(float(share)) for share in FILTERS]))
    bounds = (float(FILTERS[max(at - 1, 0)]), float(FILTERS[min(at + 1, FILTERS.size - 1)]))
    found = float(minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)
    return min((found, float(FILTERS[at])), key=left)


def _period(voltage: NDArray[np.float64], sample_time: float) -> float | None:
    """Return the period in which the voltage changes; None if at any sample [s]."""
    changes = np.diff(np.flatnonzero(np.diff(voltage)))
    count = int(np.gcd.reduce(changes)) if changes.size else 1
    return count * sample_time if count > 1 else None


def _added(record: Record, law: _Law, rows: NDArray[np.bool_], gains: Gains | None) -> Iterator[_Case]:
    """Yield a constant that is added to the voltage, and an integral of the error with it."""
    constant, integral = _added_columns(record)
    for count in (1, 2):
        columns = [constant, integral][:count] + ([] if gains else [law.error, law.derivative])
        target = law.missed(gains) if gains else law.target
        matrix = np.stack(columns, axis=1)[rows]
        sizes = np.maximum(np.abs(matrix).max(axis=0), np.finfo(float).tiny)
        found = np.linalg.lstsq(matrix / sizes, target[rows], rcond=None)[0] / sizes
        value = (float(found[0]), float(found[1]) if count == 2 else 0.0)
        what = Alternative(kind="added", value=value)
        yield _Case(what, what.applied(record), rows)


def _added_columns(record: Record) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a constant and the integral of the error [m s or rad s]."""
    assert record.reference is not None  # noqa: S101 - find_alternative is given records with a reference
    error = record.reference - record.position
    return np.ones(len(record)), np.cumsum(error) * record.sample_time


def _limits(record: Record, law: _Law, rows: NDArray[np.bool_], gains: Gains | None) -> Iterator[_Case]:
    """Yield the limits at which the voltage stays while the law asks for more."""
    limits = UNLIMITED
    for _ in range(1 if gains else 4):  # gains of its own are those of what is within the limits
        asked = law.asked(gains or law.fitted(rows, limits))
        limits = plateaus((law.target + law.added)[rows], asked[rows])
    if limits != UNLIMITED:
        yield _Case(Alternative(kind="limit", value=limits), record, rows)


def _stretch(record: Record, used: NDArray[np.bool_]) -> tuple[Record, NDArray[np.bool_]]:
    """Return the samples around the largest misfit, if there are too many, and which of them tell of the law."""
    first = 0
    if len(record) > STRETCH:
        law = _law(record)
        worst = int(np.flatnonzero(used)[np.argmax(np.abs(law.missed(law.fitted(used))[used]))])
        first = min(max(worst - STRETCH // 2, 0), len(record) - STRETCH)
        record = record.slice(float(record.time[first]), float(record.time[first + STRETCH - 1]))
    used = used[first : first + len(record)].copy()
    if first or initial_motion(record):
        used[: remembered(record)] = False
    return record, used


def _controller(record: Record) -> Controller:
    return record.controller or Controller(kp=1.0)


def _law(record: Record) -> _Law:
    assert record.voltage is not None  # noqa: S101 - find_alternative is given records with a voltage
    error, derivative = law_columns(record)
    added = law_rest(record)
    return _Law(error, derivative, record.voltage - added, added)


def _rows(record: Record, used: NDArray[np.bool_], shift: Alternative) -> NDArray[np.bool_]:
    """Return the samples in use whose law is made of logged values alone after a shift."""
    there = np.arange(used.size) + shift.value
    rows = used & (there >= 0) & (there < used.size)
    if shift.column == "voltage":
        rows &= _moved(used, shift.value)
    elif shift.value < 0:
        rows[: remembered(record) - shift.value] = False
    return np.asarray(rows)


def _moved_back(record: Record, column: str, samples: int) -> Record:
    return record.with_({column: _moved(getattr(record, column), samples)})


def _moved(signal: NDArray[Any], samples: int) -> NDArray[Any]:
    """Return the signal so many samples on, and its first or last value where it has none."""
    return np.asarray(signal[np.clip(np.arange(signal.size) + samples, 0, signal.size - 1)])
