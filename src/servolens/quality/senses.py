"""Whether signs and units of the columns can be as they are: a wrong one makes every result worthless."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import controller_voltage, rms
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.settings import SLOWEST_LOOP, UNITS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["exchanged_columns", "sense_findings"]

CLOSE = 0.1
"""Relative difference up to which an axis at rest has gone a ratio of its way, or is at rest."""
STUCK = 0.5
"""Share of its way that an axis goes at least: dry friction and springs hold it off the rest."""
EXPLAINS = 0.5
"""Share of the acceleration that the voltage must explain, beyond what else may, to tell the sign."""
TELLS = 1e-3
"""Share of the voltage that must differ from what a force that depends on the position could be, to tell them apart."""


def follows(record: Record) -> bool:
    """Tell whether the position is nearer to the reference than where it began.

    A loop with the wrong sign somewhere runs away, and an axis in another unit stays far off: who follows has neither.
    """
    if record.reference is None:
        return False
    return rms(record.reference - record.position) < rms(record.reference - record.position[0])


def exchanged_columns(record: Record) -> Iterator[Finding]:
    """Yield a position that does what references do, beside a reference that follows it as an axis does.

    It rests but for jumps of a tenth of its travel and more from one sample to the next, in less than one sample of
    fifty, each away from where the other is then; the other moves in small steps, and comes nearer to it. The counts of
    a coarse encoder come nearer to a reference that moves.
    """
    if record.reference is None or len(record) < 50:
        return
    position, reference = record.position, record.reference
    jumps, moves = np.abs(np.diff(position)), np.abs(np.diff(reference))
    at = np.flatnonzero(jumps)
    jumps, apart = jumps[at], np.abs(position - reference)
    is_away = bool(np.all(apart[at + 1] - apart[at] > 0.5 * jumps))
    is_reference = 0 < at.size <= len(record) / 50 and bool(np.all(jumps > CLOSE * np.ptp(position))) and is_away
    is_axis = np.count_nonzero(moves) > 5 * jumps.size and float(moves.max()) < CLOSE * float(np.ptp(reference))
    if is_reference and is_axis and rms(position - reference) < rms(position - reference[0]):
        message = (
            "position and reference are exchanged: the position jumps from one sample to the next and rests between,"
            " and the reference follows it; exchange the two columns."
        )
        yield Finding(code="columns_exchanged", severity="error", message=message)


def sense_findings(record: Record, seen: Sampling, *, law_holds: bool) -> Iterator[Finding]:
    """Yield wrong signs and units; those that the control law proves right are not doubted.

    Parameters
    ----------
    record : Record
        What was logged.
    seen : Sampling
        Its clock and sensor.
    law_holds : bool
        Whether the logged voltage fits the control law with a positive gain: then position and reference have one sign
        and unit, and if the axis follows its reference too, the voltage has the right sign.
    """
    if record.sample_time >= SLOWEST_LOOP:
        message = (
            f"the time stamps are {record.sample_time:g} s apart, and the record lasts {record.duration / 3600:.2g} h:"
            " no loop of an axis is that slow; state the unit of time, as ms or us."
        )
        yield Finding(code="units_contradict", severity="error", message=message)
    strange = () if law_holds else tuple(_off_reference(record, seen))
    yield from strange
    known = (law_holds or record.voltage is None) and follows(record)
    if not strange and not known and seen.travel > 0.0:
        yield from _against(record, seen)


def _off_reference(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield an axis that goes against its reference, or as many times as far as one unit is of another.

    A step inside the record tells how far the axis goes, whatever weight hangs on it. A step at the first sample does
    not tell a sign: a weight may have drawn the axis there. Where it swings, or still moves, the centre tells.
    """
    steps = _steps(record)
    if steps is None:
        return
    asked, gone, sure, rests = steps
    if not asked.any() or not gone.any():
        return
    ratio = float(asked @ gone) / float(asked @ asked)
    rests = rests and (ratio > 0.0 or rms(gone - ratio * asked) < CLOSE * rms(gone))
    centre = _centre(record, seen, sure=sure)
    if centre is not None:
        ratio, rests = centre, True
    factor = CLOSE if centre is not None else -math.log(STUCK)
    where = f"the axis moves {ratio:.4g} times as far as its reference"
    if rests and math.isclose(ratio, -1.0, rel_tol=CLOSE):
        message = f"{where}; change the sign of one of the two{'' if sure else ', unless a weight has drawn it there'}."
        yield Finding(code="wrong_sign", severity="error" if sure else "warning", message=message)
    elif ratio > 0.0:
        unit = min(UNITS, key=lambda one: abs(math.log(ratio / one)))
        off = abs(math.log(ratio / unit))
        if off < factor if unit > 1.0 else rests and off < CLOSE:
            message = f"{where}: the position is {UNITS[unit]}; state the unit of each column."
            yield Finding(code="units_contradict", severity="error", message=message)


def _steps(record: Record) -> tuple[NDArray[np.float64], NDArray[np.float64], bool, bool] | None:
    """Return how far the reference and the axis go in each step, whether they begin inside, and whether it rests then.

    None where there are no steps.
    """
    edges, y = record.edges(), record.position
    if record.reference is None or (edges.size > 1 and np.min(np.diff(edges)) < 3):
        return None
    bounds = np.array([0, *edges, len(record)])
    quarters = np.maximum(np.diff(bounds) // 4, 1)
    last = np.array([y[end - q : end].mean() for end, q in zip(bounds[1:], quarters, strict=True)])
    third = np.array(
        [
            y[max(end - 2 * q, 0) : end - q].mean() if end > q else y[0]
            for end, q in zip(bounds[1:], quarters, strict=True)
        ]
    )
    target = record.reference[bounds[:-1]]
    inside = edges.size > 0
    asked, gone = (np.diff(target), last[1:] - y[edges]) if inside else (target, last)
    weight = np.abs(asked)
    rests = float(weight @ np.abs(last - third)[-asked.size :]) <= CLOSE * float(weight @ np.abs(gone))
    return asked, gone, inside, rests


def _centre(record: Record, seen: Sampling, *, sure: bool) -> float | None:
    """Return how many times as far as its reference the centre goes about which the axis swings; None if unclear.

    The law ``ÿ = a·r − b·y − c·v + d`` of a proportional loop is fitted to second differences; the centre goes a/b as
    far. Of a reference that never changes, the constant is taken for a·r. Unclear is a ratio that the record hardly
    determines, as of a loop whose voltage is at its limit, or beside which 1 fits as well.
    """
    w, y, reference = _window(record, seen), record.position, record.reference
    if w is None or reference is None:
        return None
    ones = np.ones(y.size)
    driven = reference if sure else ones
    others = [_bend(_integrated(ones), w), y[2 * w :] - y[: -2 * w]]
    others = others if sure else others[1:]
    push, back, bend = _bend(_integrated(driven), w), _bend(_integrated(y), w), _bend(y, w)
    sizes, error, left = _solved([push, back, *others], bend, 2 * w)
    step = 1.0 if sure else float(reference[0])
    *_, alike = _solved([step * push - back, *others], bend, 2 * w)
    if not sizes[1] < 0.0 or left > CLOSE * rms(bend) or alike <= 2.0 * left:
        return None
    slope = np.array([1.0, sizes[0] / -sizes[1]])
    ratio = float(slope[1]) / step
    deviation = float(np.sqrt(slope @ error[:2, :2] @ slope)) / abs(float(sizes[1]) * step)
    return ratio if deviation < CLOSE * abs(ratio) else None


def _solved(
    columns: list[NDArray[np.float64]], target: NDArray[np.float64], together: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the least-squares sizes of `columns`, their covariance, and the r.m.s. of what they leave.

    So many samples count `together` as one.
    """
    scales = np.array([np.abs(column).max() or 1.0 for column in columns])
    rows = np.stack(columns, axis=1) / scales
    sizes = np.linalg.lstsq(rows, target, rcond=None)[0]
    left = rms(target - rows @ sizes)
    covariance = left**2 * together * np.linalg.pinv(rows.T @ rows)
    return sizes / scales, covariance / np.outer(scales, scales), left


def _against(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield an axis that accelerates against its voltage.

    Second differences of the position over w samples are β times the voltage's, integrated twice, minus damping, a
    constant, and a force that depends on the position, as a weight's; w grows until they stand out of the sensor's
    error. β must be negative and explain half of what the others leave, with and without that force. A voltage that is
    such a force itself, as of a proportional loop, does not tell: then it is a warning.
    """
    voltage = _applied(record)
    if voltage is None or not np.ptp(voltage) > 0:
        return
    y, w = record.position, _window(record, seen)
    if w is None:
        return
    bend, push = _bend(y, w), _bend(_twice_integrated(voltage), w)
    rows = slice(None, None, max(w // 2, bend.size // 100_000, 1))
    angle = y if record.length_unit == "rad" else y / float(np.ptp(y))
    forces = [_bend(_twice_integrated(force), w)[rows] for force in (np.sin(angle), np.cos(angle))]
    damping = (y[2 * w :] - y[: -2 * w])[rows]
    alone, _ = _partial(bend[rows], push[rows], [damping])
    beside, tells = _partial(bend[rows], push[rows], [damping, *forces])
    if alone < -EXPLAINS and (beside < -EXPLAINS or tells < TELLS):
        sure = tells >= TELLS
        message = (
            "the axis accelerates against its voltage; check the signs of voltage, position and kp in the log"
            f"{'' if sure else ', unless a weight or a spring drives it'}."
        )
        yield Finding(code="wrong_sign", severity="error" if sure else "warning", message=message)


def _window(record: Record, seen: Sampling) -> int | None:
    """Return over how many samples second differences of the position stand out of the sensor's error."""
    y = record.position
    sizes = (w for w in (4 * 3**k for k in range(20)) if 8 * w >= y.size or np.std(_bend(y, w)) > 20 * seen.level)
    w = next(sizes, y.size)
    return None if 8 * w >= y.size else w


def _bend(signal: NDArray[np.float64], w: int) -> NDArray[np.float64]:
    """Return the second differences over `w` samples."""
    return signal[2 * w :] - 2 * signal[w:-w] + signal[: -2 * w]


def _twice_integrated(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    return _integrated(signal - signal.mean())


def _integrated(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.cumsum(np.cumsum(signal))


def _applied(record: Record) -> NDArray[np.float64] | None:
    if record.voltage is not None:
        return record.voltage
    try:
        return controller_voltage(record)
    except InputError:
        return None


def _partial(
    target: NDArray[np.float64], column: NDArray[np.float64], others: list[NDArray[np.float64]]
) -> tuple[float, float]:
    """Return the share of `target` that `column` explains beyond `others` and a constant, with its sign, and its own.

    The second is the share of `column` that the others do not explain.
    """
    known = np.stack([np.ones_like(target), *(other / (np.abs(other).max() or 1.0) for other in others)], axis=1)
    both = np.stack((target, column), axis=1)
    left = both - known @ np.linalg.lstsq(known, both, rcond=None)[0]
    squares, own = np.sum(left**2, axis=0), float(np.sum((column - column.mean()) ** 2))
    product = float(left[:, 0] @ left[:, 1])
    scale = float(squares[0] * squares[1])
    return (math.copysign(product**2 / scale, product) if scale > 0 else 0.0), float(squares[1]) / own if own else 0.0
