"""What the axis does in a record: whether it moves enough, freezes, or runs away."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from servolens.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["motion_findings"]


def motion_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield findings about the motion; without motion there are no others."""
    excitation = _excitation(record, seen)
    if excitation is not None:
        yield excitation
    if excitation is not None and excitation.severity == "error":
        return
    yield from _freezing(record, seen)
    yield from _growing(record, seen)


def _excitation(record: Record, seen: Sampling) -> Finding | None:
    """Compare travel and noise."""
    unit = record.length_unit
    if seen.travel == 0:
        message = f"the position is {record.position[0]:g} {unit} throughout; check the sensor, or log a step."
        return Finding(code="constant_position", severity="error", message=message)
    travel = f"the position moves by {seen.travel:.3g} {unit}"
    if seen.travel < seen.outstanding:
        message = f"{travel}, no more than noise and encoder step make; log a larger step."
        return Finding(code="weak_excitation", severity="error", message=message)
    if record.voltage is not None and not record.voltage.any():
        message = "the logged voltage is 0 throughout while the axis moves; log what the controller asks for."
        return Finding(code="dead_voltage", severity="warning", message=message)
    if record.enabled is not None and not record.enabled.any():
        message = (
            "by its column enabled the motor is off throughout, so that nothing here tells its gain; if it was on,"
            " correct the column (1 is on), or leave it out."
        )
        return Finding(code="motor_off", severity="warning", message=message)
    largest = max(seen.noise, seen.step or 0.0)
    if seen.travel < 50 * largest:
        message = f"{travel}, {seen.travel / largest:.0f} times noise or encoder step; 50 times and more tell the gain."
        return Finding(code="weak_excitation", severity="warning", message=message)
    return None


def _freezing(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield samples that repeat while the axis moves, and stretches at whose end the position jumps.

    The axis moves where it travels, on both sides of a sample and in one direction, by more than three encoder steps
    a sample over four samples. There a clean log has fewer repetitions than movements by one step, whatever its noise.
    """
    y = record.position
    if y.size < 20:
        return
    moves = np.diff(y)
    still = moves == 0.0
    if not still.any():
        return
    yield from _repeated(record, moves, seen)
    yield from _frozen(record, moves, still, seen)


def _repeated(record: Record, moves: NDArray[np.float64], seen: Sampling) -> Iterator[Finding]:
    y, w = record.position, 4
    step = seen.step or 0.0
    before, after = y[w:-w] - y[: -2 * w], y[2 * w :] - y[w:-w]
    moving = (before * after > 0) & (np.minimum(np.abs(before), np.abs(after)) > 3 * w * step + 1e-4 * seen.travel)
    inner = moves[w:-w] if moves.size > 2 * w else moves
    moving = moving[: inner.size]
    repeated = int(np.count_nonzero(moving & (inner == 0.0)))
    single = int(np.count_nonzero(moving & (inner != 0.0) & (np.abs(inner) < 1.5 * step)))
    total = int(np.count_nonzero(moving))
    if repeated >= 10 and repeated > 0.01 * total and repeated > 3 * single:
        message = (
            f"{repeated} of {total} samples in motion repeat the position before them; the log is faster than its"
            " source, log at the rate of the loop or state control_period."
        )
        yield Finding(code="repeated_samples", severity="warning", message=message)


def _frozen(record: Record, moves: NDArray[np.float64], still: NDArray[np.bool_], seen: Sampling) -> Iterator[Finding]:
    """Yield stretches of five and more equal samples that end in a jump; an axis that breaks loose starts slowly."""
    bounds = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    starts, ends = bounds[::2], bounds[1::2]
    inside = (ends - starts >= 5) & (ends + 3 < moves.size)
    starts, ends = starts[inside], ends[inside]
    if starts.size == 0:
        return
    jump = np.abs(moves[ends])
    later = np.max(np.abs(moves[ends[:, None] + np.arange(1, 4)]), axis=1)
    torn = np.flatnonzero(jump > 3 * later + seen.outstanding)
    if torn.size:
        first = int(starts[torn[0]])
        message = (
            f"the position stands still for {int(ends[torn[0]]) - first} samples from {record.time[first]:g} s and then"
            f" jumps by {jump[torn[0]]:.3g} {record.length_unit} ({torn.size} such places); check the sensor's link."
        )
        yield Finding(code="frozen_position", severity="warning", message=message)


def _growing(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield the first constant reference about which the position swings wider and wider, or from which it runs away.

    Four half swings in a row must grow, by 15 % together, and the last must stand out of noise and encoder step. Or the
    position ends twice as far away as the step was large, and was nearer before: a loop without damping swings by it.
    """
    if record.reference is None:
        return
    edges = record.edges()
    small = max(0.5 * seen.outstanding, 2e-3 * seen.travel)
    bounds = [0, *edges.tolist(), len(record)]
    for first, stop in pairwise(bounds):
        if stop - first < 20:
            continue
        swings = _half_swings(record.position[first:stop] - record.reference[first], small)
        last = swings[-4:]
        if last.size == 4 and np.all(np.diff(last) > 0) and last[-1] > max(1.15 * last[0], 5 * small):
            message = (
                f"the oscillation after {record.time[first]:g} s grows from {last[0]:.3g} to {last[-1]:.3g}"
                f" {record.length_unit} in four half swings;"
                " the loop is unstable, log with lower gains; or something shakes the axis."
            )
            yield Finding(code="unstable_log", severity="warning", message=message)
            return
        away, step = np.abs(record.position[first:stop] - record.reference[first]), record.largest_step
        is_held = np.ptp(record.reference[first:stop]) == 0.0 and step > 0.0
        is_on = record.enabled is None or record.enabled[first:stop].all()
        farther = max(2.0 * away[0], 2.0 * step, 5.0 * small, 1.15 * float(away[3 * away.size // 4]))
        if is_held and is_on and away[-1] > farther:
            message = (
                f"after {record.time[first]:g} s the position runs away from its reference, by {away[-1]:.3g}"
                f" {record.length_unit} in the end, where the largest step is {step:.3g} {record.length_unit}; the loop"
                " is unstable there, or a load moves the axis: end the record before, or leave it out."
            )
            yield Finding(code="unstable_log", severity="warning", message=message)
            return


def _half_swings(error: NDArray[np.float64], small: float) -> NDArray[np.float64]:
    """Return the largest |error| between changes of its sign; the last, which may be cut off, is left out."""
    large = error[np.abs(error) > small]
    if large.size == 0:
        return np.empty(0)
    changes = np.concatenate(([0], np.flatnonzero(np.diff(np.sign(large))) + 1))
    return np.asarray(np.maximum.reduceat(np.abs(large), changes)[:-1])
