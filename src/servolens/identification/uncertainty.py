"""Standard errors that allow for what the noise really does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.integral import Pieces, held_twice_integrated
from servolens.identification.noise import NoiseModel, Whitener
from servolens.identification.observer import Observer, observer_of
from servolens.identification.smoothing import speed_of, value_weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.segments import Segment

__all__ = ["MOST_SAMPLES", "LinearEstimate", "apparent_noise", "correlation_factor", "robust_covariance"]

MOST_SAMPLES, FEWEST_SEGMENTS = 50_000, 20
"""Of longer data the first samples of every k-th segment are looked at; the rest is taken to be like them."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class LinearEstimate:
    """An estimate that is linear in what was measured, and how it answers to the noise.

    Attributes
    ----------
    segments, pieces : tuple
        Those that are looked at.
    rows : tuple of ndarray, shape (n, p)
        Of each segment: weights with which an error of the integral equation enters the estimates.
    share : float
        Of all samples that are looked at.
    """

    segments: tuple[Segment, ...]
    pieces: tuple[Pieces, ...]
    rows: tuple[NDArray[np.float64], ...]
    share: float

    @classmethod
    def of(
        cls,
        segments: Sequence[Segment],
        pieces: Sequence[Pieces],
        gain: Sequence[NDArray[np.float64]] | None = None,
        free: NDArray[np.bool_] | None = None,
    ) -> LinearEstimate:
        """Return least squares of damping and gain [c₁ … c_d, β], or of damping beside a gain with rows of its own.

        Of these only the `free` ones, if that is given; the others are fixed, and their rows 0.
        """
        used, shares, share = _looked_at(segments, pieces)
        size = 2 + max(int(one.groups.max()) for one in shares)
        columns = [_columns(segment, one, size) for segment, one in zip(used, shares, strict=True)]
        if gain is None:
            kept = np.ones(size, dtype=bool) if free is None else free
            inverse = np.zeros((size, size))
            inverse[np.ix_(kept, kept)] = _inverse([x[:, kept] for x in columns])
            return cls(used, shares, tuple(x @ inverse for x in columns), share)
        inverse = _inverse([x[:, :-1] for x in columns])
        damping = [x[:, :-1] @ inverse for x in columns]
        moved = sum(x[:, -1] @ rows for x, rows in zip(columns, damping, strict=True))
        rows = [np.column_stack([c - np.outer(g, moved), g]) for c, g in zip(damping, gain, strict=True)]
        return cls(used, shares, tuple(rows), share)

    def covariance(self, damping: NDArray[np.float64], noise: NoiseModel, window: int = 21) -> NDArray[np.float64]:
        """Return the covariance of the estimates, shape (p, p).

        Position noise n enters the integral equation as n + ∫c n dt, and with the position at the edges of the pieces;
        what shakes the axis enters as the observer's corrections do, integrated twice. The estimates sum all that with
        their rows; the sum's adjoint gives the weight of each sample of the innovations, whose covariance is known.

        Parameters
        ----------
        damping : ndarray, shape (d,)
            c₁ … c_d [1/s].
        noise : NoiseModel
            Of the records.
        window : int
            Samples over which the position at a piece's edge is smoothed.
        """
        size = self.rows[0].shape[1]
        found = np.zeros((size, size))
        for segment, share, rows in zip(self.segments, self.pieces, self.rows, strict=True):
            speed = speed_of(segment.time, segment.position)
            observer = observer_of(noise, segment.time, speed, segment.voltage)
            weights = _of_innovations(segment, share, rows, damping, noise.corner, observer, window)
            weight = None if observer is None else observer.weight
            deviations = Whitener(segment.position, speed, noise, weight).deviations(weights)
            found += deviations.T @ deviations
        samples = sum(s.time.size for s in self.segments)
        return np.asarray(found * self.share * noise.inflation(samples, size + 2 * len(self.segments)))


def _looked_at(
    segments: Sequence[Segment], pieces: Sequence[Pieces]
) -> tuple[tuple[Segment, ...], tuple[Pieces, ...], float]:
    """Return segments and pieces that are looked at, and their share of all samples."""
    total = sum(s.time.size for s in segments)
    every = slice(None, None, max(1, min(total // MOST_SAMPLES, len(segments) // FEWEST_SEGMENTS)))
    used, shares = [], []
    for segment, share in zip(segments[every], pieces[every], strict=True):
        count = min(segment.time.size, MOST_SAMPLES)
        kept = share.edges[:-1] < count
        signals = {name: getattr(segment, name)[:count] for name in ("time", "position", "voltage")}
        used.append(replace(segment, **signals))
        shares.append(Pieces(edges=np.append(share.edges[:-1][kept], count), groups=share.groups[kept]))
    return tuple(used), tuple(shares), sum(s.time.size for s in used) / total


def _inverse(columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the inverse of XᵀX of all `columns`, scaled on the way."""
    information = sum(x.T @ x for x in columns)
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _columns(segment: Segment, share: Pieces, size: int) -> NDArray[np.float64]:
    """Return the regressors [c₁ … c_d, β], shape (n, size), at right angles to initial position and velocity."""
    time, y = segment.time, segment.position
    x = np.zeros((time.size, size))
    x[:, -1] = held_twice_integrated(time, segment.voltage)
    for first, stop, group in zip(share.edges[:-1], share.edges[1:], share.groups, strict=True):
        last = min(int(stop), time.size - 1)
        travelled = np.zeros(time.size)
        travelled[first : last + 1] = y[first : last + 1] - y[first]
        travelled[last:] = y[last] - y[first]
        steps = 0.5 * np.diff(time) * (travelled[1:] + travelled[:-1])
        x[1:, group] -= np.cumsum(steps)
    line, _ = np.linalg.qr(np.column_stack([np.ones(time.size), time]))
    return np.asarray(segment.lightness * (x - line @ (line.T @ x)))


def _of_innovations(
    segment: Segment,
    share: Pieces,
    rows: NDArray[np.float64],
    damping: NDArray[np.float64],
    corner: float,
    observer: Observer | None,
    window: int,
) -> NDArray[np.float64]:
    """Return the weights of the innovations where those of the equation's error are `rows`."""
    from scipy.signal import lfilter

    time = segment.time
    steps = np.diff(time, append=2.0 * time[-1] - time[-2])[:, None]
    rate = np.repeat(damping[share.groups], np.diff(share.edges))[:, None]
    found = rows + rate * _later(rows * steps)
    smoothing = value_weights(min(window, time.size))
    for edge, before, after in zip(share.edges[1:-1], share.groups[:-1], share.groups[1:], strict=True):
        first = min(max(int(edge) - smoothing.shape[0] // 2, 0), time.size - smoothing.shape[0])
        lever = (time[edge:] - time[edge]) @ rows[edge:] * (damping[before] - damping[after])
        found[first : first + smoothing.shape[0]] += np.outer(smoothing[int(edge) - first], lever)
    if observer is None:
        return np.asarray(found)
    position, velocity, shaking = (observer.gains[:, k : k + 1] for k in range(3))
    lever = _later(rows * time[:, None]) - time[:, None] * _later(rows)
    found = found + position * (_later(found) - found) + velocity * lever
    if corner == 0.0 or not shaking.any():
        return np.asarray(found)
    fading = np.asarray(lfilter([1.0], [1.0, -observer.remembered], rows[::-1], axis=0))[::-1]
    return np.asarray(found + shaking * (lever - (_later(rows) - fading) / corner) / corner)


def _later(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums from each sample to the last."""
    return np.cumsum(rows[::-1], axis=0)[::-1]


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
