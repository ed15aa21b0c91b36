"""Which settings the logged voltage fits where it is not what the stated control law asks for.

Each candidate changes how the columns of the law are made: a column that is shifted, of the other sign or in another
unit, or settings of the loop. The gains are fitted to each; those that need not differ from the stated ones do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain, combinations, product
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np

from servolens.control_arithmetic import samples_a_tick
from servolens.control_law import HOLDS, controller_voltage, felt_rounding, rms
from servolens.encoder import quantisation_step
from servolens.errors import InputError
from servolens.quality.law import (
    GAINS,
    LawFit,
    controller_of,
    parameters_of,
    remembered,
    tick_phase,
    voltage_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from servolens.record import Controller, Record

    Rows = NDArray[np.bool_]

__all__ = ["BETTER", "SLOWEST_LOOP", "UNITS", "Alternative", "explanation", "find_alternative"]

Column = Literal["voltage", "position", "reference"]
COLUMNS: tuple[Column, ...] = ("voltage", "position", "reference")
"""In the order in which they are blamed where several explain a log, as before the first step of a reference."""
UNITS = {
    180.0 / math.pi: "in degrees where radians are meant",
    math.pi / 180.0: "in radians where degrees are meant",
    1e3: "in thousandths of the unit that is meant, as mm for m",
    1e-3: "in thousands of the unit that is meant, as m for mm",
    1e2: "in hundredths of the unit that is meant, as cm for m",
    1e-2: "in hundreds of the unit that is meant, as m for cm",
}
"""Exact ratios of a column to what it should be that units explain."""
POWERS = (1e3, 1e-3, 1e6, 1e-6)
"""Ratios of units of the voltage, as mV for V, and of time, as ms for s."""
SLOWEST_LOOP = 0.5
"""Sample time from which on time stamps cannot be seconds [s]: logs at 2 kHz and slower, in ms, are all above it."""
RESCALED = ("voltage", "time")
"""Columns of which another sign or unit looks like other gains."""
MOST = 20
"""Samples up to which a shift is looked for: 20 ms at 1 kHz, more than buses and buffers delay."""
FILTERS = np.geomspace(0.02, 1.0, 24)
"""Derivative filters that are tried before the best is refined: neighbours differ by 18 %."""
STRIDE, REFINED = 4, 3
"""Every fourth of these is tried with all other settings, and refined with the three that leave least."""
CLAMPED = 2
"""Times that an integral is clamped anew by the fitted gains: the second time they are those of the true samples."""
BETTER = 0.1
"""Share of what is unexplained of the voltage that an explanation may leave if not the rounding: 1 % of variance."""
AS_WELL, EXACT = 1.2, 1e-6
"""Times the least misfit, and share of the voltage, up to which a simpler alternative explains a log as well."""
STRETCH = 3_000
"""Samples that are looked at, around the largest misfit, so that time is bounded."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alternative:
    """What else than was stated explains the logged voltage.

    Attributes
    ----------
    controller : Controller
        Gains and settings that fit.
    changed : tuple of str
        Those of its fields that differ from what is stated.
    kind : {"", "shift", "scale", "unsigned"}
        What is wrong with a column, if one is; of an unsigned one the magnitude was logged.
    column : str
        Which.
    value : float
        Samples by which it is late, or how many times too large it is.
    before, left : float
        Unexplained voltage, r.m.s., as stated and with the alternative [the record's command unit].
    """

    controller: Controller
    changed: tuple[str, ...]
    kind: str
    column: str
    value: float
    before: float
    left: float

    def applied(self, record: Record) -> Record:
        """Return the record as if this had been stated; a shift costs the samples that then lack a value."""
        case = _Case(self.kind, self.column, self.value)
        mended = case.applied(record)
        if self.kind == "shift":
            first, last = max(-self.value, 0), len(record) - 1 - max(self.value, 0)
            mended = mended.slice(float(record.time[int(first)]), float(record.time[int(last)]))
        return mended.with_({"controller": self.controller})


class _Case(NamedTuple):
    """Something that may be wrong with a record: a column, settings of the controller."""

    kind: str = ""
    column: str = ""
    value: float = 0.0
    settings: tuple[tuple[str, Any], ...] = ()

    def applied(self, record: Record) -> Record:
        """Return the record without it, of the same length."""
        if self.settings:
            record = record.with_({"controller": replace(controller_of(record), **dict(self.settings))})
        if self.kind == "shift":
            return record.with_({self.column: _moved(getattr(record, self.column), int(self.value))})
        if self.kind == "scale":
            return record.with_({self.column: getattr(record, self.column) / self.value})
        return _signed(record) if self.kind == "unsigned" else record

    def with_filter(self, share: float) -> _Case:
        """Return the case with another share of the derivative filter."""
        return self._replace(settings=(*self.settings, ("derivative_filter", float(share))))

    @property
    def cost(self) -> int:
        """Number of things that are wrong."""
        return len(self.settings) + bool(self.kind)


class _Tried(NamedTuple):
    """A case with its fit, and what all gains that fit best leave, as a share of its voltage."""

    case: _Case
    fit: LawFit
    left: float


def find_alternative(record: Record, used: Rows) -> Alternative | None:
    """Return the simplest explanation of the logged voltage; None if the law holds, or none explains it.

    It must leave at most a tenth of what is unexplained, or no more than the rounding of the voltage, and hardly more
    than any other leaves. Where a position that was rounded when it was written explains as much, it must leave no more
    than the rounding of the voltage. The simplest changes least of what is stated. None, too, if only kp and kd are to
    change.

    Parameters
    ----------
    record : Record
        With reference and voltage.
    used : ndarray of bool, shape (n,)
        Samples whose voltage is what the law asks for.

    Raises
    ------
    InputError
        As :func:`~servolens.control_law.controller_voltage`.
    """
    if np.count_nonzero(used) <= 3 * MOST:
        return None
    part, rows, begun = _stretch(record, used)
    fit, free = LawFit.of(part, rows), () if record.controller else GAINS
    stated = fit.missed(fit.fitted(free)) if free else voltage_of(part) - controller_voltage(part)
    size = rms(fit.voltage[rows])
    rounding = AS_WELL * _rounding(part) / size if size > 0.0 else 0.0
    before = rms(stated[rows]) / size if size > 0.0 else 0.0
    if not max(HOLDS, rounding) < before < math.inf:
        return None
    may_be_rounded = record.controller is not None and before * size <= AS_WELL * _felt(part)
    exact = max(rounding, EXACT) if may_be_rounded else math.inf
    others = fit.share_left(gains_fit := fit.fitted(GAINS))
    cases = chain(_rescaled(part), _shifts()) if others <= EXACT else _cases(part, rows)
    both = (stated, fit.missed(gains_fit))
    tried = [one for case in cases if (one := _tried(part, case, rows)) and _explains(one, fit, both, free, rounding)]
    bound = min(AS_WELL * min([others, *(one.left for one in tried)]) + EXACT, exact)
    tried = [one for one in tried if one.left <= bound]
    if others <= bound:
        tried.append(_Tried(_Case(), fit, others))
    best = _simplest(tried, bound, free, begun=begun)
    if best is None or (best.kind == "" and set(best.changed) <= set(GAINS)):
        return None
    return replace(best, before=size * before, left=size * best.left)


def _explains(
    one: _Tried,
    fit: LawFit,
    missed: tuple[NDArray[np.float64], NDArray[np.float64]],
    free: tuple[str, ...],
    rounding: float,
) -> bool:
    """Tell whether a case explains what is `missed` as stated, with the stated gains, or with other gains alone."""
    stated, gains = (_share(values, fit, one) for values in missed)
    trials = ((stated, one.fit.share_left(one.fit.fitted(free))), (min(stated, gains), one.left))
    return any(was > max(HOLDS, rounding) and left <= max(BETTER * was, rounding) for was, left in trials)


def _share(missed: NDArray[np.float64], fit: LawFit, one: _Tried) -> float:
    """Return what is unexplained of the samples that tell of a case, as a share of their voltage."""
    there = np.zeros(missed.size, dtype=bool)
    there[missed.size - one.fit.rows.size :] = one.fit.rows
    size = rms(fit.voltage[there])
    return rms(missed[there]) / size if size > 0.0 else 0.0


def _rounding(record: Record) -> float:
    """Return the r.m.s. rounding of the logged voltage [the record's command unit]."""
    return (quantisation_step(voltage_of(record)) or 0.0) / math.sqrt(12.0)


def _felt(record: Record) -> float:
    """Return the voltage that the stated law makes of the position's rounding, if the log shows one."""
    return felt_rounding(controller_of(record), quantisation_step(record.position) or 0.0, record.sample_time)


def explanation(record: Record) -> tuple[str, ...]:
    """Return the parameters that a fit may free: those by which the stated law is told."""
    return parameters_of(controller_of(record))


def _tried(record: Record, case: _Case, rows: Rows) -> _Tried | None:
    """Return the fit of a case, from a tick of the loop on; None where it is impossible."""
    try:
        other = case.applied(record)
        first = tick_phase(other)
        rows = _rows(record, rows, case)[first:]
        other = other.slice(float(other.time[first]), float(other.time[-1])) if first else other
        fit, names = LawFit.of(other, rows, gains_known=False), explanation(record)
        left = fit.share_left(fit.fitted(names))
        for _ in range(CLAMPED if fit.controller.anti_windup == "clamping" and left < BETTER else 0):
            fit = fit.clamped(other, fit.fitted(names))
            left = fit.share_left(fit.fitted(names))
        return _Tried(case, fit, left)
    except InputError:
        return None


def _simplest(tried: list[_Tried], bound: float, free: tuple[str, ...], *, begun: bool) -> Alternative | None:
    """Return the alternative that changes least and leaves no more than `bound`.

    How the integral began is free where it cannot be stated, in the midst of a record.
    """
    found: list[tuple[int, Alternative]] = []
    for case, fit, _ in tried:
        unseen = ("integral_before",) if begun and fit.controller.integrates else ()
        names = [name for name in parameters_of(fit.controller) if name not in (*free, *unseen)]
        if case.kind == "scale" and case.column in RESCALED:  # with other gains it would be another law
            names = [name for name in names if name not in GAINS]
        most = min((cost for cost, _ in found), default=len(names) + case.cost + 1) - case.cost
        for chosen in chain.from_iterable(combinations(names, count) for count in range(min(most, len(names) + 1))):
            controller = fit.fitted((*free, *unseen, *chosen))
            if (left := fit.share_left(controller)) <= bound:
                changed = (*(name for name, _ in case.settings), *chosen)
                what = Alternative(controller=controller, changed=changed, kind=case.kind, column=case.column,
                                   value=case.value, before=math.nan, left=left)  # fmt: skip
                found.append((case.cost + len(chosen), what))
                break
    return min(found, key=lambda one: one[0])[1] if found else None


def _cases(record: Record, rows: Rows) -> Iterator[_Case]:
    """Yield what may be wrong, the likeliest first."""
    yield from _rescaled(record)
    voltage = voltage_of(record)
    if voltage.min() >= 0.0 or voltage.max() <= 0.0:
        yield _Case("unsigned", "voltage")
    for column, value in product(("position", "reference"), (-1.0, *UNITS)):
        yield _Case("scale", column, value)
    yield from _shifts()
    coarse = []
    for case in _derivatives(record):
        if case.cost:
            yield case
        coarse.append((_filter_left(record, rows, case, FILTERS[::STRIDE]).min(), case))
    for _, case in sorted(coarse, key=lambda one: one[0])[:REFINED]:
        yield _filtered(record, rows, case)
    yield _Case()


def _rescaled(record: Record) -> Iterator[_Case]:
    """Yield voltage and time of another sign or unit: they look like other gains; no loop is that slow."""
    yield _Case("scale", "voltage", -1.0)
    for column, value in product(RESCALED, POWERS):
        if column != "time" or record.sample_time / value < SLOWEST_LOOP:
            yield _Case("scale", column, value)


def _signed(record: Record) -> Record:
    """Return the record with a voltage that has the sign of what the law asks for whose magnitude fits it best.

    Signs and gains are fitted in turn as long as less is left: each of them leaves no more than the other did.
    """
    fit = LawFit.of(record, np.ones(len(record), dtype=bool))
    logged = voltage_of(record)
    added, asked, before = logged - fit.voltage, fit.columns[0], math.inf
    while True:
        voltage = np.copysign(logged, asked + added)
        fit = LawFit.over_rows(fit.controller, fit.columns, voltage - added, fit.rows)
        found = fit.fitted(GAINS)
        left, asked = fit.left(found), fit.asked(found)
        if not left < before:
            return record.with_({"voltage": voltage})
        before = left


def _shifts() -> Iterator[_Case]:
    """Yield each column late and early, by few samples first."""
    for column, size, sign in product(COLUMNS, range(1, MOST + 1), (1, -1)):
        yield _Case("shift", column, sign * size)


def _derivatives(record: Record) -> Iterator[_Case]:
    """Yield other discrete settings of the loop, first none; then those with the other kind of time steps."""
    yield from (_Case(settings=settings) for settings in _settings(record))
    stated = controller_of(record)
    is_uneven = np.ptp(np.diff(record.time)) > EXACT * record.sample_time
    if is_uneven and samples_a_tick(stated, record.sample_time) == 1:
        other = ("time_step", "measured" if stated.time_step == "cycle" else "cycle")
        yield from (_Case(settings=(*one, other)) for one in _settings(record) if "control_period" not in dict(one))


def _settings(record: Record) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Yield other discrete settings of the loop, first none."""
    stated = controller_of(record)
    choices: dict[str, list[Any]] = {
        "control_period": [_period(record)],
        "anti_windup": ["none", "clamping"] if record.voltage_limit is not None else [],
        "derivative": ["position", *(["velocity"] if record.velocity is not None else [])],
        "derivative_window": [1, 2, 3, 4],
        "derivative_on": [] if stated.is_cascade else ["measurement", "error"],
    }
    kept: tuple[tuple[str, Any], ...] = ()
    options = [
        (kept, *(((name, value),) for value in values if value != getattr(stated, name)))
        for name, values in choices.items()
    ]
    for chosen in product(*options):
        yield tuple(chain(*chosen))


def _filter_left(record: Record, rows: Rows, case: _Case, shares: Iterable[float]) -> NDArray[np.float64]:
    """Return what each share of the derivative filter leaves."""
    tried = [_tried(record, case.with_filter(share), rows) for share in shares]
    return np.array([math.inf if one is None else one.left for one in tried])


def _filtered(record: Record, rows: Rows, case: _Case) -> _Case:
    """Return the case with the derivative filter that leaves least."""
    from scipy.optimize import minimize_scalar

    def left(share: float) -> float:
        return float(_filter_left(record, rows, case, (share,))[0])

    at = int(np.argmin(_filter_left(record, rows, case, FILTERS)))
    bounds = (float(FILTERS[max(at - 1, 0)]), float(FILTERS[min(at + 1, FILTERS.size - 1)]))
    found = float(minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-7}).x)
    return case.with_filter(min((found, float(FILTERS[at])), key=left))


def _period(record: Record) -> float | None:
    """Return the period in which the voltage changes; None if at any sample [s]."""
    changes = np.diff(np.flatnonzero(np.diff(voltage_of(record))))
    count = int(np.gcd.reduce(changes)) if changes.size else 1
    return count * record.sample_time if count > 1 else None


def _stretch(record: Record, used: Rows) -> tuple[Record, Rows, bool]:
    """Return the samples around the largest misfit, which of them tell, and whether they begin in the midst."""
    first = 0
    if len(record) > STRETCH:
        fit = LawFit.of(record, used)
        missed = np.abs(fit.missed(fit.fitted(GAINS)))
        worst = int(np.flatnonzero(used)[np.argmax(missed[used])])
        first = min(max(worst - STRETCH // 2, 0), len(record) - STRETCH)
        record = record.slice(float(record.time[first]), float(record.time[first + STRETCH - 1]))
        used = used[first : first + len(record)].copy()
        used[: remembered(controller_of(record), record) if first else 0] = False
    return record, used, first > 0


def _rows(record: Record, used: Rows, case: _Case) -> Rows:
    """Return the samples in use whose law is made of logged values alone."""
    rows, shift = used.copy(), int(case.value) if case.kind == "shift" else 0
    there = np.arange(used.size) + shift
    rows &= (there >= 0) & (there < used.size)
    if case.column == "voltage":
        rows &= _moved(used, shift)
    if shift < 0 or case.column == "voltage":
        rows[: remembered(controller_of(record), record) + max(-shift, 0)] = False
    return rows


def _moved(signal: NDArray[Any], samples: int) -> NDArray[Any]:
    """Return the signal so many samples on, and its first or last value where it has none."""
    return np.asarray(signal[np.clip(np.arange(signal.size) + samples, 0, signal.size - 1)])
