"""The step of a position sensor and the noise before it, as a log shows both."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = [
    "FEWEST_SAMPLES",
    "SPAN",
    "quantisation_step",
    "share_on_grid",
    "small_moves",
    "white_noise",
    "with_seen_encoder",
]

FEWEST_SAMPLES = 20
"""Five samples for each of the four unknowns of the smallest model."""
DITHERED = 0.5
"""Standard deviation of white noise, in steps, from which on rounding is but more white noise (B. Widrow and I. Kollár,
*Quantization Noise*, 2008)."""
MOST_STEPS, OFF_GRID, ON_GRID = 10.5, 0.15, 0.98
"""Movements up to ten steps tell of a step; how far from a whole number of steps one may be; share of them that are
none farther."""


SPAN = 12.0
"""Standard deviations that white noise spans in a million samples."""


def with_seen_encoder(records: Sequence[Record], known: Sequence[Record] = ()) -> tuple[Record, ...]:
    """Return records of one axis, each with the encoder's step: as others state it, or as their positions show it.

    Only where rounding is more than white noise is that looked for, and only where all records move in that step: their
    noise is one. A log that was rounded when it was written looks like a coarse encoder, and is taken for one.

    Parameters
    ----------
    records : sequence of Record
        Of one axis.
    known : sequence of Record
        Others of the same axis, whose step is theirs if they move in it.
    """
    stated = [record.encoder_resolution for record in (*known, *records) if record.encoder_resolution is not None]
    unstated = [record for record in records if record.encoder_resolution is None]
    for seen in (stated, [s for record in unstated if (s := _coarse_step(record.position)) is not None]):
        step = max(seen, default=0.0)
        if step > 0.0 and all(_moves_in(record.position, step) for record in unstated):
            return tuple(replace(r, encoder_resolution=step) if r.encoder_resolution is None else r for r in records)
    return tuple(records)


def _coarse_step(position: NDArray[np.float64]) -> float | None:
    step = quantisation_step(position)
    return None if step is None or white_noise(position, step) > DITHERED * step else step


def _moves_in(position: NDArray[np.float64], step: float) -> bool:
    """Tell whether the small movements are multiples of a `step`; so few that nothing tells may be."""
    moves = small_moves(position)
    small = moves[moves < MOST_STEPS * step]
    return small.size < FEWEST_SAMPLES or share_on_grid(small, step, OFF_GRID) >= ON_GRID


def quantisation_step(position: NDArray[np.float64]) -> float | None:
    """Return the step in which the position moves, or None if its small movements share none.

    The smallest movements are tried as the step: nearly all movements of up to ten steps must be whole multiples of
    it within 0.15, where 0.3 of them would be by chance. At least twenty must be seen. How many steps a movement is
    must change as often: at a constant speed without noise all movements are alike, and none is a step.
    """
    moves = small_moves(position)
    if moves.size < FEWEST_SAMPLES:
        return None
    few = np.partition(moves, FEWEST_SAMPLES - 1)[:FEWEST_SAMPLES]
    for candidate in (float(few[-1]), float(few.min())):
        small = moves[moves < 4.5 * candidate]
        counts = np.rint(small / candidate)
        if not counts.any():
            continue
        step = float(np.sum(counts * small) / np.sum(counts**2))
        changes = np.count_nonzero(np.diff(np.rint(np.diff(position) / step)))
        if changes >= FEWEST_SAMPLES and share_on_grid(moves[moves < MOST_STEPS * step], step, OFF_GRID) >= ON_GRID:
            return step
    return None


def share_on_grid(moves: NDArray[np.float64], step: float, tolerance: float) -> float:
    """Return which share of `moves` are multiples of `step`, within a `tolerance` in steps; 0 of too few."""
    if moves.size < FEWEST_SAMPLES:
        return 0.0
    counts = moves / step
    return float(np.mean(np.abs(counts - np.rint(counts)) <= tolerance))


def small_moves(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sizes of movements from sample to sample, those within rounding left out."""
    moves = np.abs(np.diff(position))
    moves = moves[moves > 16 * np.spacing(np.max(np.abs(position)))]
    return np.asarray(moves)


def white_noise(position: NDArray[np.float64], step: float | None = None) -> float:
    """Return the standard deviation of the white noise in `position`, 0 where there are too few samples [m or rad].

    Of a position that moves in a `step`, the differences are whole steps, and so would be their median: each is spread
    evenly over the half steps beside it before, and the variance of that is taken off after (Sheppard's correction).
    """
    if position.size < FEWEST_SAMPLES:
        return 0.0
    differences = np.abs(np.diff(position, 3))
    if step is None:
        return float(1.4826 * np.median(differences) / np.sqrt(20.0))
    counts = np.sort(np.rint(differences / step))
    middle = counts[counts.size // 2]
    first, end = int(np.searchsorted(counts, middle, "left")), int(np.searchsorted(counts, middle, "right"))
    low, high = max(middle - 0.5, 0.0), middle + 0.5
    median = low + (high - low) * (0.5 * counts.size - first) / (end - first)
    return float(step * np.sqrt(max((1.4826 * median) ** 2 - 1.0 / 12.0, 0.0) / 20.0))
