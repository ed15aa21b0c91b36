"""The integral method (paper sections II.B and II.C): linear least squares in damping, gain and sizes of effects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identify.factors import LONGEST_PIECE, factor_pieces, link
from servolens.identify.smoothing import value_weights
from servolens.solving import ConstrainedLeastSquares, constrained_least_squares

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identify.segments import Segment

__all__ = ["Pieces", "Prior", "assemble", "solve_integral"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Knowledge from elsewhere, e.g. a data sheet: `value` with standard deviation `deviation`, SI."""

    value: float
    deviation: float


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces:
    """How damping is shared over a segment.

    Parameters
    ----------
    edges : ndarray of int, shape (k + 1,)
        First sample of each piece; the last entry is the number of samples.
    groups : ndarray of int, shape (k,)
        Which damping holds in each piece.
    """

    edges: NDArray[np.intp]
    groups: NDArray[np.intp]

    @classmethod
    def whole(cls, samples: int) -> Pieces:
        """One damping for all, cut only so that memory stays bounded."""
        edges = np.append(np.arange(0, max(samples - 8, 1), LONGEST_PIECE), samples)
        return cls(edges=edges, groups=np.zeros(edges.size - 1, dtype=np.intp))


def assemble(
    segments: Sequence[Segment],
    pieces: Sequence[Pieces] | None = None,
    forces: Sequence[NDArray[np.float64]] | None = None,
    window: int = 21,
) -> NDArray[np.float64]:
    """Return the triangular factor of the integral equation of all segments.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion; each has an initial position and velocity of its own, which are eliminated.
    pieces : sequence of Pieces, optional
        How damping is shared, a segment each; one damping for all by default.
    forces : sequence of ndarray, shape (m, n), optional
        Columns φ of further effects, a segment each.
    window : int
        Samples over which the position at a piece's edge is smoothed.

    Returns
    -------
    ndarray, shape (d + 1 + m + 1,) * 2
        Upper triangular over the columns ``[c₁ … c_d, β, θ₁ … θ_m, y]``.
    """
    shares = [Pieces.whole(s.time.size) for s in segments] if pieces is None else pieces
    dampings = 1 + max(int(p.groups.max()) for p in shares)
    blocks = []
    for i, (segment, share) in enumerate(zip(segments, shares, strict=True)):
        columns = np.empty((0, segment.time.size)) if forces is None else forces[i]
        blocks.append(_segment_factor(segment, share, columns, dampings, window)[2:, 2:])
    return blocks[0] if len(blocks) == 1 else np.linalg.qr(np.vstack(blocks), mode="r")


def solve_integral(
    factor: NDArray[np.float64], priors: Mapping[int, Prior] | None = None, noise: float = 0.0
) -> ConstrainedLeastSquares:
    """Solve the assembled equation; `priors` by unknown, weighed against the equation's `noise`."""
    if priors:
        rows = np.zeros((len(priors), factor.shape[1]))
        for row, (index, prior) in zip(rows, priors.items(), strict=True):
            weight = noise / prior.deviation
            row[index], row[-1] = weight, weight * prior.value
        factor = np.linalg.qr(np.vstack([factor, rows]), mode="r")
    return constrained_least_squares(factor)


def _segment_factor(
    segment: Segment, share: Pieces, columns: NDArray[np.float64], dampings: int, window: int
) -> NDArray[np.float64]:
    m = columns.shape[0]
    count = share.groups.size
    factors, ends = np.empty((count, m + 5, m + 5)), np.empty((count, 2 * m + 5))
    anchors = _anchors(segment, share.edges, window)
    factor_pieces(segment.time, segment.position, segment.voltage, columns, anchors, share.edges, factors, ends)
    out = np.empty((dampings + m + 4, dampings + m + 4))
    link(factors, ends, share.groups, dampings, out)
    return out


def _anchors(segment: Segment, edges: NDArray[np.intp], window: int) -> NDArray[np.float64]:
    """Smoothed position at the edges; a raw sample's noise would act as an offset of all that follows."""
    y = segment.position
    anchors = y[np.minimum(edges, y.size - 1)].copy()
    half = window // 2
    for i in range(1, edges.size - 1):
        a, b = max(int(edges[i]) - half, 0), min(int(edges[i]) + half + 1, y.size)
        if b - a >= 5:
            anchors[i] = value_weights(b - a)[int(edges[i]) - a] @ y[a:b]
    return anchors
