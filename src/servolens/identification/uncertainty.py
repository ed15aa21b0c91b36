"""Standard errors that allow for what the noise really does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.identification.factors import whiten
from servolens.identification.integral import held_twice_integrated

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.integral import Pieces
    from servolens.identification.segments import Segment

__all__ = ["apparent_noise", "correlation_factor", "integral_covariance", "robust_covariance"]

MOST_SAMPLES = 200_000
FEWEST_SEGMENTS = 20
"""Of longer data every k-th segment is looked at, then every k-th sample; the rest is taken to be like them."""


def integral_covariance(
    segments: Sequence[Segment], pieces: Sequence[Pieces], estimate: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the covariance of an integral fit's damping and gain, and the noise of the equation.

    Position noise n enters the equation as n + ∫c n dt, so its residuals are coloured although n is white. With the
    regressors X, nuisances projected out, the least-squares estimate has the covariance
    ``σ² (XᵀX)⁻¹ WᵀW (XᵀX)⁻¹`` with ``W = X + c·∫ₜ X`` (the adjoint of the colouring). σ² is measured on the whitened
    residual and grows by its remaining correlation.

    Parameters
    ----------
    segments, pieces
        As given to :func:`servolens.identification.integral.assemble`, without further effects.
    estimate : ndarray, shape (d + 1,)
        [c₁ … c_d, β].

    Returns
    -------
    covariance : ndarray, shape (d + 1, d + 1)
    noise : float
        Root mean square of the whitened residual [m or rad].
    """
    p = estimate.size
    total = sum(s.time.size for s in segments)
    used = slice(None, None, max(1, min(total // MOST_SAMPLES, len(segments) // FEWEST_SEGMENTS)))
    seen = sum(s.time.size for s in segments[used])
    stride = max(1, seen // MOST_SAMPLES)
    bread, meat, squares, samples, factor = np.zeros((p, p)), np.zeros((p, p)), 0.0, 0, 1.0
    for segment, share in zip(segments[used], pieces[used], strict=True):
        x, y, damping, time = _columns(segment, share, estimate, stride)
        if time.size < 4:
            continue
        q, _ = np.linalg.qr(np.column_stack([np.ones(time.size), time]))
        x, y = x - q @ (q.T @ x), y - q @ (q.T @ y)
        noise = whiten(y - x @ estimate, damping, time)
        steps = np.diff(time, append=2 * time[-1] - time[-2])[:, None]
        later = np.cumsum((x * steps)[::-1], axis=0)[::-1]
        w = x + damping[:, None] * later
        factor = correlation_factor(noise)
        bread += x.T @ x
        meat += factor * (noise @ noise) / max(time.size - 2 - p / len(segments), 1.0) * (w.T @ w)
        squares += float(noise @ noise)
        samples += time.size
    scale = 1.0 / np.sqrt(np.diag(bread))
    inverse = np.linalg.inv(bread * np.outer(scale, scale)) * np.outer(scale, scale)
    return inverse @ meat @ inverse * (seen / total / stride), float(np.sqrt(squares / max(samples - p, 1)))


def correlation_factor(residual: NDArray[np.float64]) -> float:
    """Return by how much the variance of a mean of `residual` exceeds that of white noise, at least 1.

    From the lag-one correlation ρ, (1 + ρ)/(1 − ρ), where ρ is significant (3/√n), at most n/4.
    """
    n = residual.size
    energy = float(residual @ residual)
    if n < 8 or energy == 0.0:
        return 1.0
    rho = float(residual[1:] @ residual[:-1]) / energy
    if rho < 3.0 / np.sqrt(n):
        return 1.0
    return float(min((1.0 + rho) / max(1.0 - rho, 1e-12), n / 4.0))


def apparent_noise(residuals: Sequence[NDArray[np.float64]]) -> float:
    """Return the standard deviation of white noise whose mean would scatter as that of the residuals does."""
    energy = sum(correlation_factor(residual) * float(residual @ residual) for residual in residuals)
    return float(np.sqrt(energy / sum(residual.size for residual in residuals)))


def robust_covariance(
    scores: Sequence[NDArray[np.float64]], information: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sandwich covariance of a least-squares fit with coloured residuals.

    Parameters
    ----------
    scores : sequence of ndarray, shape (n, p)
        Jacobian rows times residual, one array a segment.
    information : ndarray, shape (p, p)
        JᵀJ, priors included.
    prior : ndarray, shape (p, p)
        The priors' own part of the scores' covariance.

    Notes
    -----
    Bartlett weights over lags (Newey and West 1987, doi:10.2307/1913610); bandwidth by Andrews' rule for a first-order
    process (1991, doi:10.2307/2938229), from the scores' own correlation.
    """
    meat = prior.copy()
    for score in scores:
        meat += score.T @ score
        bandwidth = _bandwidth(score)
        for lag in range(1, bandwidth + 1):
            weight = 1.0 - lag / (bandwidth + 1.0)
            cross = score[lag:].T @ score[:-lag]
            meat += weight * (cross + cross.T)
    inverse = np.linalg.inv(information)
    return inverse @ meat @ inverse


def _bandwidth(score: NDArray[np.float64]) -> int:
    n = score.shape[0]
    energy = np.sum(score**2, axis=0)
    rho = np.sum(score[1:] * score[:-1], axis=0) / np.maximum(energy, 1e-300)
    strongest = float(np.clip(np.max(rho, initial=0.0), 0.0, 0.99))
    if strongest < 3.0 / np.sqrt(n):
        return 0
    alpha = 4.0 * strongest**2 / ((1.0 - strongest) ** 2 * (1.0 + strongest) ** 2)
    return int(min(1.1447 * (alpha * n) ** (1.0 / 3.0), n // 3))


def _columns(
    segment: Segment, share: Pieces, estimate: NDArray[np.float64], stride: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return regressors (n, d + 1), position, damping and time at every `stride`-th sample."""
    time, y, voltage = segment.time, segment.position, segment.voltage
    steps = np.diff(time)
    x = np.zeros((time.size, estimate.size))
    x[:, -1] = held_twice_integrated(time, voltage)
    damping = np.empty(time.size)
    for first, stop, group in zip(share.edges[:-1], share.edges[1:], share.groups, strict=True):
        damping[first:stop] = estimate[group]
        last = min(int(stop), time.size - 1)
        travelled = np.zeros(time.size)
        travelled[first : last + 1] = y[first : last + 1] - y[first]
        travelled[last:] = y[last] - y[first]
        area = np.concatenate([[0.0], np.cumsum(0.5 * steps * (travelled[1:] + travelled[:-1]))])
        x[:, group] -= area
    return x[::stride], y[::stride], damping[::stride], time[::stride]
