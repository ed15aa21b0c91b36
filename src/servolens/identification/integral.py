"""The integral method (paper sections II.B and II.C): linear least squares in damping, gain and sizes of effects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError
from servolens.identification.factors import LONGEST_PIECE, segment_factor
from servolens.identification.smoothing import value_weights
from servolens.solving import ConstrainedLeastSquares, Constraint, constrained_least_squares

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import FitOptions, Prior
    from servolens.identification.segments import Segment

__all__ = [
    "Pieces",
    "assemble",
    "constraints_on",
    "held_twice_integrated",
    "segment_factors",
    "solve_integral",
    "stacked",
]

_NO_FORCES: NDArray[np.float64] = np.empty((0, 0))


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
    return stacked([block[2:, 2:] for block in segment_factors(segments, shares, forces, window)])


def stacked(factors: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the triangular factor of all `factors`' rows."""
    return factors[0] if len(factors) == 1 else np.asarray(np.linalg.qr(np.vstack(factors), mode="r"))


def segment_factors(
    segments: Sequence[Segment],
    pieces: Sequence[Pieces],
    forces: Sequence[NDArray[np.float64]] | None = None,
    window: int = 21,
) -> list[NDArray[np.float64]]:
    """Return each segment's triangular factor over ``[y₀, v₀, c₁ … c_d, β, θ₁ … θ_m, y]``; see :func:`assemble`."""
    dampings = 1 + max(int(share.groups.max()) for share in pieces)
    columns = [_NO_FORCES] * len(segments) if forces is None else forces
    size = dampings + columns[0].shape[0] + 4
    factors = []
    for segment, share, force in zip(segments, pieces, columns, strict=True):
        if share.edges[-1] != segment.time.size:
            raise InputError(f"the pieces cover {share.edges[-1]} samples, the segment has {segment.time.size}")
        factor, weights = np.empty((size, size)), value_weights(min(window, segment.time.size))
        segment_factor(
            segment.time, segment.position, segment.voltage, force, weights, share.edges, share.groups, factor
        )
        factor[:, 2:-1] *= segment.lightness
        factors.append(factor)
    return factors


def held_twice_integrated(time: NDArray[np.float64], voltage: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the double integral over `time` of a voltage that is held from sample to sample, 0 at the first."""
    steps = np.diff(time)
    single = np.concatenate([[0.0], np.cumsum(steps * voltage[:-1])])
    return np.concatenate([[0.0], np.cumsum(steps * (single[:-1] + 0.5 * steps * voltage[:-1]))])


def solve_integral(
    factor: NDArray[np.float64],
    priors: Mapping[int, Prior] | None = None,
    noise: float = 0.0,
    constraints: Sequence[Constraint] = (),
) -> ConstrainedLeastSquares:
    """Solve the assembled equation; `priors` by unknown, weighed against the equation's `noise`."""
    if priors:
        rows = np.zeros((len(priors), factor.shape[1]))
        for row, (index, prior) in zip(rows, priors.items(), strict=True):
            weight = noise / prior.deviation
            row[index], row[-1] = weight, weight * prior.value
        factor = stacked([factor, rows])
    return constrained_least_squares(factor, constraints)


def constraints_on(
    unknowns: Sequence[str], options: FitOptions, lowest: Mapping[str, float] | None = None
) -> tuple[Constraint, ...]:
    """Return what holds the `unknowns` at their fixed values and within their bounds, by their index.

    Parameters
    ----------
    unknowns : sequence of str
        Qualified names, in the order of the unknowns.
    options : FitOptions
        With fixed values and bounds.
    lowest : mapping of str to float, optional
        What an unknown must not fall below in any case.
    """
    found = []
    for index, name in enumerate(unknowns):
        low, high = options.range_of(name, (lowest or {}).get(name, -np.inf))
        if np.isfinite(low) or np.isfinite(high):
            words = (
                f"{name} = {low:g}"
                if low == high
                else " and ".join(
                    f"{name} {sign} {end:g}" for sign, end in (("≥", low), ("≤", high)) if np.isfinite(end)
                )
            )
            found.append(Constraint(name=words, coefficients={index: 1.0}, lower=low, upper=high))
    return tuple(found)
