"""The integral equation, compressed: one pass over the samples, bounded memory.

On a piece that starts at T, with τ = t − T,

    y(τ) = y_T + v_T τ − c ∫(y − y(T)) + β ∬V − Σ θⱼ ∬φⱼ ,

so the piece needs the columns ``[1, τ, ∫(y − y(T)), ∬V, ∬φ₁ …, y]`` and nothing else. They are built, orthogonalised and
reduced to their triangular factor at once; :func:`link` then writes y_T and v_T in terms of the segment's initial
values and of everything before (continuity of position and velocity, paper eq. 11), so that no inner unknown is left.

The voltage is held between samples: its integrals are exact. Measured quantities are integrated by the trapezoid with
its end correction −h²/12 (f′ₖ₊₁ − f′ₖ), fourth order on smooth signals.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

__all__ = ["LONGEST_PIECE", "factor_pieces", "link", "triangular_factor", "whiten"]

LONGEST_PIECE = 4096
"""Samples; longer pieces are cut, which changes nothing in the result and bounds the memory."""


@njit(cache=True)
def _slope(f: Any, time: Any, k: int) -> float:
    """Derivative of samples `f` at `k`: parabola through three neighbours."""
    n = f.size
    if n < 3:
        return (f[n - 1] - f[0]) / (time[n - 1] - time[0])
    i = min(max(k, 1), n - 2)
    h0, h1 = time[i] - time[i - 1], time[i + 1] - time[i]
    d0, d1 = (f[i] - f[i - 1]) / h0, (f[i + 1] - f[i]) / h1
    curvature = (d1 - d0) / (h0 + h1)
    return d0 + curvature * (2.0 * time[k] - time[i] - time[i - 1])


@njit(cache=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def triangular_factor(columns: Any, n: int, out: Any) -> None:
    """Write the triangular factor of ``columns[:, :n].T`` to `out`; the columns are orthogonalised in place.

    Modified Gram–Schmidt: its factor is as good as Householder's (Björck, BIT 7, 1967, doi:10.1007/BF01934122).
    """
    w = columns.shape[0]
    out[:, :] = 0.0
    for i in range(w):
        a = columns[i, :n]
        norm = 0.0
        for k in range(n):
            norm += a[k] * a[k]
        norm = np.sqrt(norm)
        out[i, i] = norm
        if norm == 0.0:
            continue
        inverse = 1.0 / norm
        for k in range(n):
            a[k] *= inverse
        for j in range(i + 1, w):
            b = columns[j, :n]
            dot = 0.0
            for k in range(n):
                dot += a[k] * b[k]
            out[i, j] = dot
            for k in range(n):
                b[k] -= dot * a[k]


@njit(cache=True, error_model="numpy")
def factor_pieces(
    time: Any, position: Any, voltage: Any, forces: Any, anchors: Any, edges: Any, factors: Any, ends: Any
) -> None:
    """Fill the triangular factor and the end values of each piece.

    Parameters
    ----------
    time, position, voltage : ndarray, shape (n,)
        One segment.
    forces : ndarray, shape (m, n)
        The columns φⱼ.
    anchors : ndarray, shape (pieces + 1,)
        Smoothed position at the edges.
    edges : ndarray of int, shape (pieces + 1,)
        First sample of each piece, then the last sample of the segment plus one.
    factors : ndarray, shape (pieces, m + 5, m + 5)
        Output: factor of the columns [1, τ, P, Q, Φ…, y].
    ends : ndarray, shape (pieces, 2 m + 5)
        Output at the next piece's start: τ, P, y − y(T), Q, ∫V, Φ…, ∫φ….
    """
    m = forces.shape[0]
    pieces = edges.size - 1
    longest = 0
    for i in range(pieces):
        longest = max(longest, edges[i + 1] - edges[i])
    columns = np.empty((m + 5, longest))
    singles = np.empty(m)
    doubles = np.empty(m)
    for i in range(pieces):
        first, stop = edges[i], edges[i + 1]
        last = stop if i + 1 < pieces else stop - 1
        start, anchor = time[first], anchors[i]
        area, w, q = 0.0, 0.0, 0.0
        singles[:] = 0.0
        doubles[:] = 0.0
        slope_y = _slope(position, time, first)
        for k in range(first, last + 1):
            tau = time[k] - start
            if k < stop:
                r = k - first
                columns[0, r] = 1.0
                columns[1, r] = tau
                columns[2, r] = area
                columns[3, r] = q
                columns[4 + m, r] = position[k] - position[first]
                for j in range(m):
                    columns[4 + j, r] = doubles[j]
            if k == last:
                break
            h = time[k + 1] - time[k]
            slope_next = _slope(position, time, k + 1)
            area += 0.5 * h * (position[k] + position[k + 1] - 2.0 * anchor) - h * h / 12.0 * (slope_next - slope_y)
            slope_y = slope_next
            q += h * (w + 0.5 * h * voltage[k])
            w += h * voltage[k]
            for j in range(m):
                f = forces[j]
                s0, s1 = _slope(f, time, k), _slope(f, time, k + 1)
                step = 0.5 * h * (f[k] + f[k + 1]) - h * h / 12.0 * (s1 - s0)
                doubles[j] += h * (singles[j] + 0.5 * step) - h * h / 12.0 * (f[k + 1] - f[k])
                singles[j] += step
        e = ends[i]
        e[0], e[1], e[2], e[3], e[4] = time[last] - start, area, anchors[i + 1] - anchor, q, w
        for j in range(m):
            e[5 + j], e[5 + m + j] = doubles[j], singles[j]
        triangular_factor(columns, stop - first, factors[i])
        factors[i, 0, 4 + m] += position[first] * factors[i, 0, 0]


@njit(cache=True, error_model="numpy")
def link(factors: Any, ends: Any, groups: Any, unknowns: int, out: Any) -> None:
    """Stack the pieces of one segment into one triangular factor.

    Parameters
    ----------
    factors, ends
        From :func:`factor_pieces`.
    groups : ndarray of int, shape (pieces,)
        Which damping each piece has: 0 … d − 1.
    unknowns : int
        Number of dampings d.
    out : ndarray, shape (d + m + 4, d + m + 4)
        Output: factor over the columns [y₀, v₀, c₁ … c_d, β, θ₁ … θ_m, y].
    """
    pieces, width = factors.shape[0], factors.shape[1]
    m = width - 5
    p = unknowns + m + 3
    value = np.zeros(p + 1)
    slope = np.zeros(p + 1)
    value[0], slope[1] = 1.0, 1.0
    beta = 2 + unknowns
    local = np.zeros((4 + m, p + 1))
    stack = np.zeros((p + 1, p + 1 + width))
    scratch = np.zeros((p + 1, p + 1))
    filled = 0
    for i in range(pieces):
        c = 2 + groups[i]
        local[:, :] = 0.0
        local[0], local[1] = value, slope
        local[2, c] = -1.0
        local[3, beta] = 1.0
        for j in range(m):
            local[4 + j, beta + 1 + j] = -1.0
        for row in range(width):
            at = filled + row
            for q in range(p):
                total = 0.0
                for col in range(row, 4 + m):
                    total += factors[i, row, col] * local[col, q]
                stack[q, at] = total
            stack[p, at] = factors[i, row, width - 1]
        filled += width
        if filled > p + 1:
            triangular_factor(stack, filled, scratch)
            for a in range(p + 1):
                for b in range(p + 1):
                    stack[b, a] = scratch[a, b]
            filled = p + 1
        e = ends[i]
        for q in range(p + 1):
            value[q] += e[0] * slope[q]
        value[c] -= e[1]
        value[beta] += e[3]
        slope[c] -= e[2]
        slope[beta] += e[4]
        for j in range(m):
            value[beta + 1 + j] -= e[5 + j]
            slope[beta + 1 + j] -= e[5 + m + j]
    out[:, :] = 0.0
    for a in range(filled):
        for b in range(p + 1):
            out[a, b] = stack[b, a]


@njit(cache=True, error_model="numpy")
def whiten(residual: Any, damping: Any, time: Any) -> Any:
    """Undo what the integral equation does to measurement noise: solve n + ∫c n dt = residual for n.

    White noise n on the position enters the equation once directly and once through ∫c y.
    """
    n = residual.size
    noise = np.empty(n)
    noise[0] = residual[0]
    total = 0.0
    for k in range(1, n):
        half = 0.5 * (time[k] - time[k - 1])
        known = total + half * damping[k - 1] * noise[k - 1]
        noise[k] = (residual[k] - known) / (1.0 + half * damping[k])
        total = known + half * damping[k] * noise[k]
    return noise
