"""The integral equation, compressed: one pass over the samples, bounded memory.

On a piece that starts at T, with τ = t − T,

    y(τ) = y_T + v_T τ − c ∫(y − y(T)) + β ∬V − Σ θⱼ ∬φⱼ ,

so the piece needs the columns ``[1, τ, ∫(y − y(T)), ∬V, ∬φ₁ …, y]`` and nothing else. They are built, orthogonalised
and reduced to their triangular factor at once; y_T and v_T are written in terms of the segment's initial values and of
everything before (continuity of position and velocity, paper eq. 11), so that no inner unknown is left.

The voltage is held between samples: its integrals are exact. Measured quantities are integrated by the trapezoid with
its end correction −h²/12 (f′ₖ₊₁ − f′ₖ), fourth order on smooth signals.
"""

# ruff: noqa: PLR0913 - compiled loops, which have no objects to pass
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import float64, int64, njit, types, void

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["LONGEST_PIECE", "segment_factor", "triangular_solution"]

LONGEST_PIECE = 4096
"""Samples; longer pieces are cut, which changes nothing in the result and bounds the memory."""
STACKED = 64
"""Rows of pieces' factors that are gathered before they are reduced again."""
_SIGNAL = types.Array(float64, 1, "C", readonly=True)
_TABLE = types.Array(float64, 2, "C", readonly=True)
_COUNTS = types.Array(int64, 1, "C", readonly=True)


def _kept(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile for `signature` and keep the result on disk; only in memory where no folder can be written or read."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(signature, cache=True, error_model="numpy")(function)
        except Exception:
            return njit(signature, error_model="numpy")(function)

    return decorate


@njit(error_model="numpy")
def _slopes(f: Any, time: Any, first: int, last: int, out: Any) -> None:
    """Fill `out` with the derivative of samples `f` at `first` … `last`: parabola through three neighbours."""
    n = f.size
    inner, end = max(first, 1), min(last, n - 2)
    y, t, slope = f[inner - 1 : end + 2], time[inner - 1 : end + 2], out[inner - first :]
    for k in range(end + 1 - inner):
        h0, h1 = t[k + 1] - t[k], t[k + 2] - t[k + 1]
        slope[k] = ((y[k + 1] - y[k]) * (h1 * h1) + (y[k + 2] - y[k + 1]) * (h0 * h0)) / (h0 * h1 * (h0 + h1))
    for k in (0, n - 1):
        if first <= k <= last:
            i = min(max(k, 1), n - 2)
            h0, h1 = time[i] - time[i - 1], time[i + 1] - time[i]
            d0, d1 = (f[i] - f[i - 1]) / h0, (f[i + 1] - f[i]) / h1
            out[k - first] = d0 + (d1 - d0) / (h0 + h1) * (2.0 * time[k] - time[i] - time[i - 1])


@njit(fastmath={"reassoc", "contract"}, error_model="numpy")
def _orthogonalise(columns: Any, n: int, out: Any) -> None:
    """Write the triangular factor of ``columns[:, :n].T`` to `out`; the columns are orthogonalised in place.

    Modified Gram–Schmidt: its factor is as good as Householder's (Björck, BIT 7, 1967, doi:10.1007/BF01934122).
    """
    w = columns.shape[0]
    for i in range(w):
        for j in range(w):
            out[i, j] = 0.0
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
        for j in range(i + 1, w):
            b = columns[j, :n]
            dot = 0.0
            for k in range(n):
                dot += a[k] * b[k]
            dot *= inverse
            out[i, j] = dot
            dot *= inverse
            for k in range(n):
                b[k] -= dot * a[k]


@njit(error_model="numpy")
def _piece(
    time: Any, position: Any, voltage: Any, forces: Any, first: int, last: int, anchor: float, columns: Any, ends: Any
) -> None:
    """Fill the columns [1, τ, P, Q, Φ…, y] of samples `first` … `last`, and [τ, P, Q, ∫V, Φ…, ∫φ…] at the last.

    `columns` has the shape (m + 5, at least last − first + 1), `ends` (2 m + 4,).
    """
    m = forces.shape[0]
    n = last + 1 - first
    t, y, u = time[first : last + 1], position[first : last + 1], voltage[first : last + 1]
    slope = np.empty(n)
    _slopes(position, time, first, last, slope)
    one, tau, area, twice, moved = columns[0], columns[1], columns[2], columns[3], columns[4 + m]
    start, begin = t[0], y[0]
    for k in range(n):
        one[k] = 1.0
        tau[k] = t[k] - start
        moved[k] = y[k] - begin
    p, q, w = 0.0, 0.0, 0.0
    area[0], twice[0] = 0.0, 0.0
    for k in range(n - 1):
        h = t[k + 1] - t[k]
        p += h * (0.5 * (y[k] + y[k + 1]) - anchor - h / 12.0 * (slope[k + 1] - slope[k]))
        q += h * (w + 0.5 * h * u[k])
        w += h * u[k]
        area[k + 1], twice[k + 1] = p, q
    ends[0], ends[1], ends[2], ends[3] = t[n - 1] - start, p, q, w
    for j in range(m):
        _slopes(forces[j], time, first, last, slope)
        f, double = forces[j, first : last + 1], columns[4 + j]
        p, w = 0.0, 0.0
        double[0] = 0.0
        for k in range(n - 1):
            h = t[k + 1] - t[k]
            step = h * (0.5 * (f[k] + f[k + 1]) - h / 12.0 * (slope[k + 1] - slope[k]))
            p += h * (w + 0.5 * step - h / 12.0 * (f[k + 1] - f[k]))
            w += step
            double[k + 1] = p
        ends[4 + j], ends[4 + m + j] = p, w


@njit(error_model="numpy")
def _anchor(position: Any, sample: int, weights: Any) -> float:
    """Return the smoothed position at `sample`; the raw one if the window is too short for a cubic."""
    window = weights.shape[0]
    if window < 5:
        return float(position[sample])
    first = min(max(sample - window // 2, 0), position.size - window)
    total = 0.0
    for k in range(window):
        total += weights[sample - first, k] * position[first + k]
    return total


@njit(error_model="numpy")
def _append(stack: Any, filled: int, reduced: Any, value: Any, slope: Any, group: int, m: int) -> None:
    """Write a piece's factor to `stack` from row `filled` on, over the segment's unknowns.

    `value` and `slope` hold the piece's initial position and velocity in terms of them.
    """
    p, width = value.size, m + 5
    for r in range(width):
        at = filled + r
        for q in range(p):
            stack[q, at] = reduced[r, 0] * value[q] + reduced[r, 1] * slope[q]
        stack[2 + group, at] -= reduced[r, 2]
        stack[p - m - 1, at] += reduced[r, 3]
        for j in range(m):
            stack[p - m + j, at] -= reduced[r, 4 + j]
        stack[p, at] = reduced[r, width - 1]


@njit(error_model="numpy")
def _carry(value: Any, slope: Any, ends: Any, group: int, moved: float, m: int) -> None:
    """Carry `value` and `slope` over one piece whose anchor, seen from the next one's, lies `moved` behind."""
    p = value.size
    for q in range(p):
        value[q] += ends[0] * slope[q]
    value[2 + group] -= ends[1]
    slope[2 + group] -= moved
    value[p - m - 1] += ends[2]
    slope[p - m - 1] += ends[3]
    for j in range(m):
        value[p - m + j] -= ends[4 + j]
        slope[p - m + j] -= ends[4 + m + j]


@_kept(void(_SIGNAL, _SIGNAL, _SIGNAL, _TABLE, _TABLE, _COUNTS, _COUNTS, float64[:, ::1]))
def segment_factor(
    time: Any, position: Any, voltage: Any, forces: Any, weights: Any, edges: Any, groups: Any, out: Any
) -> None:
    """Reduce the integral equation of one segment to a triangular factor.

    Parameters
    ----------
    time, position, voltage : ndarray, shape (n,)
        The segment.
    forces : ndarray, shape (m, n)
        The columns φⱼ.
    weights : ndarray, shape (window, window), window ≤ n
        Gives the smoothed position at each place of a window: row by place. The pieces are anchored to it, since a
        raw sample's noise would act as an offset of all that follows.
    edges : ndarray of int, shape (pieces + 1,)
        First sample of each piece, then n.
    groups : ndarray of int, shape (pieces,)
        Which damping each piece has: 0 … d − 1.
    out : ndarray, shape (d + m + 4, d + m + 4)
        Output: factor over the columns [y₀, v₀, c₁ … c_d, β, θ₁ … θ_m, y].
    """
    n, m, p = time.size, forces.shape[0], out.shape[0] - 1
    pieces, width = edges.size - 1, m + 5
    longest = 0
    for i in range(pieces):
        longest = max(longest, edges[i + 1] - edges[i])
    columns, reduced, ends = np.empty((width, longest + 1)), np.empty((width, width)), np.empty(2 * m + 4)
    value, slope = np.empty(p), np.empty(p)
    for q in range(p):
        value[q], slope[q] = 0.0, 0.0
    value[0], slope[1] = 1.0, 1.0
    rows = max(STACKED, 2 * (p + 1 + width))
    stack = np.empty((p + 1, rows))
    filled = 0
    anchor = position[0]
    for i in range(pieces):
        first, stop = edges[i], edges[i + 1]
        _piece(time, position, voltage, forces, first, min(stop, n - 1), anchor, columns, ends)
        _orthogonalise(columns, stop - first, reduced)
        reduced[0, width - 1] += position[first] * reduced[0, 0]
        if filled + width > rows:
            _orthogonalise(stack, filled, out)
            for r in range(p + 1):
                for q in range(p + 1):
                    stack[q, r] = out[r, q]
            filled = p + 1
        _append(stack, filled, reduced, value, slope, groups[i], m)
        filled += width
        if stop < n:
            before = anchor
            anchor = _anchor(position, stop, weights)
            _carry(value, slope, ends, groups[i], anchor - before, m)
    _orthogonalise(stack, filled, out)


@_kept(float64(_TABLE, float64[::1]))
def triangular_solution(factor: Any, out: Any) -> float:
    """Solve ``R x = z`` of the factor ``[[R, z], [0, ρ]]`` and return how near R is to singular.

    Parameters
    ----------
    factor : ndarray, shape (p + 1, p + 1)
        Upper triangular.
    out : ndarray, shape (p,)
        Output: x.

    Returns
    -------
    float
        Smallest share of a column that the columns before it do not explain.
    """
    p = out.size
    smallest = 1.0
    for i in range(p - 1, -1, -1):
        total = factor[i, p]
        for j in range(i + 1, p):
            total -= factor[i, j] * out[j]
        out[i] = total / factor[i, i]
        square = 0.0
        for j in range(i + 1):
            square += factor[j, i] * factor[j, i]
        smallest = min(smallest, abs(factor[i, i]) / np.sqrt(square) if square > 0.0 else 0.0)
    return smallest
