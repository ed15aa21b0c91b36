"""Damping that varies in time, piecewise constant (paper sections II.B and III.A.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError, ServolensError
from servolens.identification.factors import triangular_solution
from servolens.identification.integral import Pieces, segment_factors, stacked
from servolens.identification.later import Later
from servolens.identification.noise import NoiseModel
from servolens.identification.piecewise import CAPACITY
from servolens.identification.smoothing import slope_noise, smooth, smoothing_window
from servolens.identification.uncertainty import LinearEstimate
from servolens.solving import Constraint, constrained_least_squares

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.identification.segments import Segment

__all__ = ["PieceFit", "VaryingDamping", "fit_pieces", "fit_varying", "ordering", "piece_duration", "within"]

FEWEST_IN_PIECE = 8
MOST_PIECES = 24
NODE_POSITIONS = tuple(0.25 + k / 8 for k in range(8))
"""Length of the first piece, of the others' length."""
SETTLED_GAIN = "β independent of the nodes"
UNEXPLAINED = 1e-14
"""Least share of a column that the others must leave unexplained."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VaryingDamping:
    """Damping against time since the step.

    Attributes
    ----------
    gain : float
        β, the median over positions of the nodes.
    edges : ndarray, shape (n + 1,)
        Times [s] between which damping is constant.
    damping : ndarray, shape (n,)
        c of each piece [1/s].
    speed : ndarray, shape (n,)
        Mean |v| of each piece; not the paper's signed mean (eq. 19), which is near zero in a piece with a reversal.
    active : tuple of str
        Constraints that hold with equality.
    spread : Later
        Makes the covariance.
    inertia : float, optional
        Moving inertia [kg m²] or mass [kg] that these are for, where a record states one.
    """

    gain: float
    edges: NDArray[np.float64]
    damping: NDArray[np.float64]
    speed: NDArray[np.float64]
    active: tuple[str, ...]
    spread: Later[NDArray[np.float64]]
    inertia: float | None = None

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of [c₁ … c_n, β], without the constraints on damping, shape (n + 1, n + 1).

        Computed when it is first asked for: the noise that it needs takes a hundred times as long as the fit.
        """
        return self.spread.value


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PieceFit:
    """The estimate for given pieces.

    Attributes
    ----------
    gain : float
        β.
    damping : ndarray, shape (n,)
        c of each piece [1/s].
    starts : ndarray, shape (segments, 2)
        Position and velocity at each segment's first sample.
    active : tuple of str
        Constraints that hold with equality.
    """

    gain: float
    damping: NDArray[np.float64]
    starts: NDArray[np.float64]
    active: tuple[str, ...]


def fit_varying(
    segments: Sequence[Segment],
    *,
    duration: float | None = None,
    constraints: Sequence[Constraint] = (),
    delta: float | None = None,
    bounds: tuple[float, float] | None = None,
    gain: tuple[float, float] = (-np.inf, np.inf),
    noise: Callable[[], NoiseModel] | None = None,
) -> VaryingDamping:
    """Fit piecewise-constant damping with continuous position and velocity.

    Parameters
    ----------
    segments : sequence of Segment
        Steps; damping is a function of the time since the beginning of each, shared by all.
    duration : float, optional
        Length of a piece [s]; by the paper's rule (:func:`piece_duration`) when None.
    constraints : sequence of Constraint
        On the unknowns ``[c₁ … c_n, β]``.
    delta : float, optional
        δ of eq. 18: damping may fall by at most δ [1/s] from piece to piece.
    bounds : tuple of float, optional
        Least and largest damping of a piece [1/s].
    gain : tuple of float
        Least and largest β; both the same where it is fixed.
    noise : callable, optional
        Returns that of the records, when it is needed; white, as third differences show it, when None.

    Raises
    ------
    InputError
        If the constraints contradict each other or a piece would hold too few samples.

    Notes
    -----
    Where damping changes within a piece, what is estimated, and what the covariance is about, is the effective damping
    of the piece: what the same fit gives on noise-free data.
    """
    length = piece_duration(segments) if duration is None else duration
    shares, edges = _pieces(segments, length)
    count = edges.size - 1
    window = smoothing_window(length, _sample_time(segments))
    settled = _settled_gain(segments, 0.5 * length, window, gain)
    wanted = [
        *constraints,
        *(() if settled is None else (settled.constraint(count),)),
        *(ordering(count, delta) if delta is not None else ()),
        *(within(count, *bounds) if bounds is not None else ()),
    ]
    fit = fit_pieces(segments, shares, wanted, window)

    def covariance() -> NDArray[np.float64]:
        estimate = LinearEstimate.of(segments, shares, None if settled is None else settled.rows(segments))
        least = NoiseModel.white(max(s.noise for s in segments)) if noise is None else noise()
        return estimate.covariance(fit.damping, least, window)

    return VaryingDamping(
        gain=fit.gain,
        edges=edges,
        damping=fit.damping,
        speed=_mean_speed(segments, shares, count, window),
        active=tuple(name for name in fit.active if name != SETTLED_GAIN),
        spread=Later(covariance),
        inertia=segments[0].inertia,
    )


@final
@dataclass(frozen=True, slots=True, eq=False)
class _SettledGain:
    """β as the mean of that of two ways to place the nodes, the middle ones of several; without these it is given."""

    value: float
    middle: tuple[list[Pieces], list[Pieces]] | None

    def constraint(self, count: int) -> Constraint:
        """Return the constraint that holds β behind `count` dampings."""
        return Constraint(name=SETTLED_GAIN, coefficients={count: 1.0}, lower=self.value, upper=self.value)

    def rows(self, segments: Sequence[Segment]) -> list[NDArray[np.float64]]:
        """Return the weights with which errors of the equation enter β, an array a segment."""
        if self.middle is None:
            return [np.zeros(segment.time.size) for segment in segments]
        one, other = (LinearEstimate.of(segments, pieces).rows for pieces in self.middle)
        return [0.5 * (a[:, -1] + b[:, -1]) for a, b in zip(one, other, strict=True)]


def _settled_gain(
    segments: Sequence[Segment], length: float, window: int, within: tuple[float, float]
) -> _SettledGain | None:
    """Return β as its median over eight positions of the nodes, with pieces of half the length.

    Damping that changes within a piece moves β by a percent or more, one way or the other with where the nodes fall;
    the median over their positions does not hang on that choice. None where fewer than five positions can be fitted.
    """
    if within[0] == within[1]:
        return _SettledGain(within[0], None)
    found: list[tuple[float, list[Pieces]]] = []
    for position in NODE_POSITIONS:
        try:
            shares, _ = _pieces(segments, length, first=position * length)
            found.append((fit_pieces(segments, shares, (), window).gain, shares))
        except ServolensError:
            continue
    if len(found) < 5:
        return None
    found.sort(key=lambda fit: fit[0])
    low, high = found[(len(found) - 1) // 2], found[len(found) // 2]
    value = 0.5 * (low[0] + high[0])
    if not within[0] <= value <= within[1]:
        return _SettledGain(float(np.clip(value, *within)), None)
    return _SettledGain(value, (low[1], high[1]))


def fit_pieces(
    segments: Sequence[Segment], pieces: Sequence[Pieces], constraints: Sequence[Constraint] = (), window: int = 21
) -> PieceFit:
    """Fit damping, gain and initial state for given pieces: the estimate alone, in microseconds.

    Parameters
    ----------
    segments : sequence of Segment
        Steps.
    pieces : sequence of Pieces
        How damping is shared, a segment each.
    constraints : sequence of Constraint
        On the unknowns ``[c₁ … c_n, β]``.
    window : int
        Samples over which the position at a piece's edge is smoothed.

    Raises
    ------
    InputError
        If the constraints contradict each other.
    NumericalError
        If the data do not determine the unknowns.
    """
    factors = segment_factors(segments, pieces, window=window)
    if len(factors) == 1 and not constraints:
        x = np.empty(factors[0].shape[0] - 1)
        if triangular_solution(factors[0], x) > UNEXPLAINED:
            return PieceFit(gain=float(x[-1]), damping=x[2:-1], starts=x[None, :2], active=())
        raise NumericalError("the data do not determine all unknowns of the fit: two of its columns are proportional")
    solution = constrained_least_squares(stacked([factor[2:, 2:] for factor in factors]), constraints)
    starts = [np.linalg.solve(f[:2, :2], f[:2, -1] - f[:2, 2:-1] @ solution.x) for f in factors]
    return PieceFit(
        gain=float(solution.x[-1]), damping=solution.x[:-1], starts=np.array(starts), active=solution.active
    )


def ordering(count: int, delta: float) -> tuple[Constraint, ...]:
    """Return eq. 18: cᵢ − cᵢ₊₁ < δ for `count` pieces."""
    if not np.isfinite(delta):
        return ()
    return tuple(
        Constraint(name=f"c{i + 1} − c{i + 2} < {delta:g}", coefficients={i: 1.0, i + 1: -1.0}, upper=delta)
        for i in range(count - 1)
    )


def within(count: int, low: float, high: float) -> tuple[Constraint, ...]:
    """Return bounds on the damping of `count` pieces."""
    return tuple(
        Constraint(name=_bound_name(i + 1, low, high), coefficients={i: 1.0}, lower=low, upper=high)
        for i in range(count)
    )


def _bound_name(piece: int, low: float, high: float) -> str:
    if np.isinf(high):
        return f"c{piece} ≥ {low:g}"
    return f"c{piece} ≤ {high:g}" if np.isinf(low) else f"{low:g} ≤ c{piece} ≤ {high:g}"


def piece_duration(segments: Sequence[Segment]) -> float:
    """Return half the smallest interval between zero crossings of the velocity [s]: the paper's node rule.

    The first zero is the onset, "the point that the cart velocity first goes non-zero"; a reversal counts if the axis
    was faster than 3 % of its highest speed (four times the velocity's noise at least) before and after it. With no
    reversal: a sixth of the longest segment. At most 24 pieces to the longest segment.
    """
    intervals = [float(np.min(np.diff(zeros))) for s in segments if (zeros := _velocity_zeros(s)).size >= 2]
    longest = max(s.since_step + float(s.time[-1]) for s in segments)
    chosen = 0.5 * min(intervals) if intervals else longest / 6.0
    return max(chosen, longest / MOST_PIECES, 1.01 * FEWEST_IN_PIECE * _sample_time(segments))


def _velocity_zeros(segment: Segment) -> NDArray[np.float64]:
    """Return the times [s] of the onset and of each reversal."""
    time, y = segment.time, segment.position
    window = smoothing_window(float(time[-1]) / 6.0, float(np.median(np.diff(time))))
    velocity = smooth(time, y, window)[1]
    spread = segment.noise / float(np.median(np.diff(time))) * slope_noise(min(window, time.size))
    inner = slice(window // 4, max(time.size - window // 2, window // 4 + 1))  # at the ends the slope is uncertain
    fast = np.flatnonzero(np.abs(velocity[inner]) > max(0.03 * np.abs(velocity).max(), 4.0 * spread)) + inner.start
    if fast.size == 0:
        return np.empty(0)
    flips = np.flatnonzero(np.diff(np.sign(velocity[fast]))) + 1
    reversals = [_zero(time, velocity, int(fast[k - 1]), int(fast[k])) for k in flips]
    floor = max(4.0 * segment.noise, 1.5 * (segment.record.encoder_resolution or 0.0))
    onset = [] if segment.since_step else [float(time[int(np.argmax(np.abs(y - y[0]) > floor))])]
    return np.array([*onset, *reversals])


def _zero(time: NDArray[np.float64], velocity: NDArray[np.float64], first: int, last: int) -> float:
    """Time in (first, last] at which the velocity passes through zero, by linear interpolation."""
    k = first + 1 + int(np.argmax(velocity[first + 1 : last + 1] * velocity[first] <= 0))
    share = velocity[k - 1] / (velocity[k - 1] - velocity[k])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))


def _pieces(
    segments: Sequence[Segment], length: float, first: float | None = None
) -> tuple[list[Pieces], NDArray[np.float64]]:
    longest = max(s.since_step + float(s.time[-1]) for s in segments)
    if not 0 < length <= longest:
        raise InputError(f"a piece must last between 0 and {longest:g} s (the longest step), got {length:g} s")
    count = max(round(longest / length), 1)
    if count > CAPACITY:
        raise InputError(
            f"pieces of {length:g} s would be {count} over {longest:g} s, {CAPACITY} are possible; choose longer ones"
        )
    inner = np.append(0.0, (length if first is None else first) + length * np.arange(count))
    inner = inner[inner <= longest - 0.5 * length] if longest > 0.5 * length else inner[:1]
    moves = np.any([_moves(segment, inner, length) for segment in segments], axis=0)
    inner = inner[moves | (inner == inner[0])]
    shares = []
    for segment in segments:
        earlier = int(np.searchsorted(inner, segment.since_step + 1e-9, side="right")) - 1
        starts = np.searchsorted(segment.time + segment.since_step, inner[earlier + 1 :] - 1e-9)
        starts = np.append(0, starts[starts <= segment.time.size - FEWEST_IN_PIECE])
        if np.any(np.diff(starts[1:]) < FEWEST_IN_PIECE):
            raise InputError(
                f"{segment.record.name}: pieces of {length:g} s hold fewer than {FEWEST_IN_PIECE} samples; "
                "choose longer ones"
            )
        groups = earlier + np.arange(starts.size, dtype=np.intp)
        shares.append(Pieces(edges=np.append(starts, segment.time.size), groups=groups))
    count = 1 + max(int(share.groups.max()) for share in shares)
    return shares, np.append(inner[:count], longest)


def _moves(segment: Segment, starts: NDArray[np.float64], length: float) -> NDArray[np.bool_]:
    """Tell of each piece whether the axis moves; at rest it says nothing about damping and joins the last."""
    bounds = np.searchsorted(segment.time + segment.since_step, np.column_stack([starts, starts + length]).ravel())
    position = np.append(segment.position, segment.position[-1])  # a piece may begin after the last sample
    travel = np.maximum.reduceat(position, bounds)[::2] - np.minimum.reduceat(position, bounds)[::2]
    moving: NDArray[np.bool_] = travel > max(6.0 * segment.noise, 2.0 * (segment.record.encoder_resolution or 0.0))
    return moving


def _mean_speed(segments: Sequence[Segment], shares: Sequence[Pieces], count: int, window: int) -> NDArray[np.float64]:
    total, samples = np.zeros(count), np.zeros(count)
    for segment, share in zip(segments, shares, strict=True):
        speed = np.abs(smooth(segment.time, segment.position, window)[1])
        for group, first, stop in zip(share.groups, share.edges[:-1], share.edges[1:], strict=True):
            total[group] += speed[first:stop].sum()
            samples[group] += stop - first
    return total / samples


def _sample_time(segments: Sequence[Segment]) -> float:
    return min(s.record.sample_time for s in segments)
