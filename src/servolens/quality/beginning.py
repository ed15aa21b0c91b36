"""How a record begins: at rest before its first step, already in motion, or in motion before its step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.encoder import white_noise
from servolens.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["beginning_findings", "initial_motion"]

BEGINNING = (24, 12)
"""Samples that tell whether a record begins in motion."""
AGREES, ROUGH = 0.3, 2.0
"""Relative difference up to which two initial velocities are the same; times the noise that a cubic may miss."""
MOVES = 6.0
"""Standard errors from which on an initial velocity is one."""
FAST = 0.05
"""Share of the top speed from which on a beginning in motion is worth a warning."""


def initial_motion(record: Record) -> float:
    """Return the velocity at the first sample [m/s or rad/s]; 0 where it is within its errors, or none can be told.

    Of cubics through the first samples, many and few: of an axis that is pushed off at once they do not agree, or miss
    the samples by more than the noise.
    """
    many, few = (_initial_velocity(record, min(count, len(record))) for count in BEGINNING)
    return few if abs(many - few) <= AGREES * abs(many) else 0.0


def _initial_velocity(record: Record, count: int) -> float:
    duration = float(record.time[count - 1] - record.time[0])
    span = (record.time[:count] - record.time[0]) / duration
    cubic = np.vander(span, min(4, count - 1), increasing=True)
    y = record.position[:count]
    found, *_ = np.linalg.lstsq(cubic, y, rcond=None)
    missed, step = float(np.sqrt(np.mean((y - cubic @ found) ** 2))), record.encoder_resolution or 0.0
    if missed > ROUGH * (white_noise(record.position) + step) + 1e-6 * float(np.ptp(record.position)):
        return 0.0
    scatter = missed + step
    error = scatter * float(np.sqrt(np.linalg.inv(cubic.T @ cubic)[1, 1]))
    return float(found[1]) / duration if abs(found[1]) > MOVES * error + 1e-12 else 0.0


def beginning_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield an onset that the record has missed, and motion before the step that is to cause it."""
    if len(record) <= max(BEGINNING) or seen.travel == 0.0:
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
    if reference is None or edge < max(BEGINNING):
        return
    resting = y[: edge // 2]
    towards = float(np.sign(reference[edge] - reference[edge - 1]))
    gone = (float(y[edge]) - float(np.median(resting))) * towards
    if float(np.ptp(resting)) > seen.outstanding or gone < seen.outstanding:
        return
    begun = int(np.argmax(np.abs(y[:edge] - np.median(resting)) > seen.outstanding))
    message = (
        f"the axis goes towards its target from {record.time[begun]:g} s on, before the reference changes at"
        f" {record.time[edge]:g} s; reference and position are shifted against each other in the log."
    )
    yield Finding(code="reference_shifted", severity="warning", message=message)
