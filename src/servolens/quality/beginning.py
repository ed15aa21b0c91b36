"""How a record begins: at rest before its first step, already in motion, or in motion before its step."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servolens.encoder import white_noise
from servolens.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["beginning_findings", "initial_motion", "possible_motion"]

FEW, MOST = 12, 20_000
"""Fewest samples that tell of motion, together with twice as many; most that are looked at."""
AGREES, ROUGH, EXACT = 0.3, 2.0, 1.2
"""Relative difference up to which two initial velocities are the same; times the noise that a cubic may miss of few
samples, and of more: what it misses of 48 is within a tenth of the noise."""
MOVES = 6.0
"""Standard errors from which on an initial velocity is one."""
LATE = 3.0
"""Samples by which an axis that rests may answer early or late when it is pushed off."""
WANDERS = 4.0
"""Times its range in the first half of a rest by which a position may go off by the end of it. Slow noise, simulated as
a random walk, goes farther once in 500 rests of 24 samples and once in 10 000 of 400; steady creep goes 1.5 times that
range."""
FAST = 0.05
"""Share of the top speed from which on a beginning in motion is worth a warning."""


def initial_motion(record: Record) -> float:
    """Return the velocity at the first sample [m/s or rad/s]; 0 where it is within its errors, or none can be told.

    Of a cubic through as many of the first samples, at least 24, as it misses by no more than the noise, which that
    through half as many bears out; of an axis that is pushed off at once those through fewer do not agree.
    """
    step = record.encoder_resolution or 0.0
    found = [(velocity, spread * (missed + step)) for velocity, spread, missed in _cubics(record)]
    if len(found) < 2:
        return 0.0
    speed = found[-1][0]
    is_seen = all(abs(one) > MOVES * error + 1e-12 for one, error in found[-2:])
    agree = all(abs(speed - one) <= AGREES * abs(speed) + error for one, error in found)
    return speed if is_seen and agree else 0.0


def possible_motion(record: Record) -> tuple[float, float]:
    """Return what the first samples say of the velocity at the first, and by how much that may be off [m/s or rad/s].

    Loud noise may hide a motion that the rest of the record shows. The error is that of half as many samples: slow
    noise makes the cubic through all of them look better than it is. Both are 0 where the first samples say nothing, or
    contradict each other beyond their noise, and where an axis that is pushed off at once, and answers a few samples
    early or late, looks the same.
    """
    rounding = (record.encoder_resolution or 0.0) / math.sqrt(12.0)
    cubics = _cubics(record)
    found = [(velocity, spread * math.hypot(missed, rounding)) for velocity, spread, missed in cubics]
    speed = found[-1][0] if found else 0.0
    if not found or any(abs(speed - one) > AGREES * abs(speed) + MOVES * error for one, error in found):
        return 0.0, 0.0
    off = max(AGREES * abs(speed), MOVES * found[max(len(found) - 2, 0)][1])
    pushed = abs(_acceleration(record, FEW * 2 ** (len(cubics) - 1)))
    return (0.0, 0.0) if abs(speed) + off < LATE * pushed * record.sample_time else (speed, off)


def _cubics(record: Record) -> list[tuple[float, float, float]]:
    """Return what :func:`_velocity` tells of cubics through more and more samples.

    As long as they miss no more than the noise.
    """
    noise, least, step = _noise(record), 1e-6 * float(np.ptp(record.position)), record.encoder_resolution or 0.0
    found, count = [], FEW
    while count <= min(len(record), MOST):
        velocity, spread, missed = _velocity(record, count)
        if missed > (ROUGH if count <= 2 * FEW else EXACT) * (noise + step) + least:
            break
        found.append((velocity, spread, missed))
        count *= 2
    return found


def _velocity(record: Record, count: int) -> tuple[float, float, float]:
    """Return the slope of a cubic through the first samples, its error for noise of size one, and what it misses."""
    duration = float(record.time[count - 1] - record.time[0])
    powers = np.vander((record.time[:count] - record.time[0]) / duration, 4, increasing=True)
    basis, upper = np.linalg.qr(powers)
    along, slope = basis.T @ record.position[:count], np.linalg.inv(upper)[1] / duration
    missed = float(np.sqrt(np.mean((record.position[:count] - basis @ along) ** 2)))
    return float(slope @ along), float(np.linalg.norm(slope)), missed


def _acceleration(record: Record, count: int) -> float:
    """Return the acceleration at the first sample, of a parabola through the first `count` [m/s² or rad/s²]."""
    time = record.time[:count] - record.time[0]
    return 2.0 * float(np.polynomial.polynomial.polyfit(time, record.position[:count], 2)[2])


def _noise(record: Record) -> float:
    """Return white noise, or what cubics miss of a quarter of short stretches if more: noise may change slowly."""
    position, count = record.position[:MOST], min(2 * FEW, len(record))
    basis = np.linalg.qr(np.vander(np.linspace(0.0, 1.0, count), min(4, count)))[0]
    stretches = position[: position.size // count * count].reshape(-1, count)
    missed = np.sqrt(np.mean((stretches - (stretches @ basis) @ basis.T) ** 2, axis=1))
    return max(white_noise(position), float(np.quantile(missed, 0.25)))


def beginning_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield an onset that the record has missed, and motion before the step that is to cause it."""
    if len(record) <= 2 * FEW or seen.travel == 0.0:
        return
    edges, unit = record.edges(), record.length_unit
    if edges.size > 1 and np.min(np.diff(edges)) < 3:
        return  # a trajectory
    speed = initial_motion(record)
    if abs(speed) > FAST * seen.top_speed:
        message = (
            f"the axis already moves at the first sample, at {speed:.3g} {unit}/s: the onset of the step is missed;"
            " log from before the step."
        )
        yield Finding(code="onset_missed", severity="warning", message=message)
    elif edges.size:
        yield from _early(record, seen, int(edges[0]))


def _early(record: Record, seen: Sampling, edge: int) -> Iterator[Finding]:
    """Yield motion towards the first target before the reference goes there, after a rest."""
    reference, y = record.reference, record.position
    if reference is None or edge < 2 * FEW:
        return
    resting = y[: edge // 2]
    towards = float(np.sign(reference[edge] - reference[edge - 1]))
    before = edge - 1 if record.ticks > 1 else edge  # the reference may have jumped between two samples
    gone = (float(y[before]) - float(np.median(resting))) * towards
    wander = float(np.ptp(resting))
    if wander > seen.outstanding or gone <= max(seen.outstanding, WANDERS * wander):
        return
    begun = int(np.argmax(np.abs(y[:edge] - np.median(resting)) > seen.outstanding))
    message = (
        f"the axis goes towards its target from {record.time[begun]:g} s on, before the reference changes at"
        f" {record.time[edge]:g} s; reference and position are shifted against each other in the log."
    )
    yield Finding(code="reference_shifted", severity="warning", message=message)
