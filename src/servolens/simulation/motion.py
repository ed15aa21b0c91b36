"""The motion of one axis under a held input: pieces of Taylor series, split at reversals and kinks.

A step is a Taylor series of third order with the tail of a constant damping β = −∂a/∂v: after the snap s each
derivative is −β times the one before, so that v = v₀ + a τ + j τ²/2 + s τ³ φ₃(β τ). That is an exponential integrator
[1]_, which solves a linear damping exactly, however strong it is. A step is halved while what the damping leaves of its
last term is more than half a millionth of the travel (a kick of the voltage may change the damping within a
sample). Each velocity reversal is found as the root of the series and the step is split there, so that the order holds
across it (second order at least), and |v| is smooth within a piece. At rest dry friction is set-valued: the axis leaves
only if the push exceeds the level, and until then its position does not change by one bit. Where a force has a kink (a
contact closes, a limit is met) the step is split as well.

What the effects remember is carried along: a second mass or an integral by its own series; a state that relaxes
(ż = A − B z: a filter, a bristle) exactly for an A/B that changes linearly, however fast it is. Within a piece the
series of the motion sees such a state as the ramp that has the same mean and the same first moment as its exponential.
Where A and B change with the motion, their values at the end of a piece come from a first pass over it.

The layout of the arrays stands in :mod:`servolens.simulation.plant_functions`. Numba turns this module into LLVM's
language together with :mod:`servolens.simulation.stepping`.

References
----------
.. [1] Hochbruck and Ostermann, Exponential integrators, Acta Numerica 19, 2010, doi:10.1017/S0962492910000048.
"""

# ruff: noqa: C901 - compiled loops, and every array is an argument
# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

from numba import njit

from servolens.simulation.elementary import OPTIONS, exponential
from servolens.simulation.plant_functions import (
    MOVING,
    SERIES,
    SHAKING,
    STATES,
    D,
    T,
    U,
    V,
    Y,
    breakaway,
    contacts,
    drifts,
    kinked,
    kinks,
    relaxation,
    relaxing_states,
    smooth_states,
    taylor,
)

__all__ = ["advance"]

HALF, SIXTH, TWENTYFOURTH = 1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0
SMOOTH, SHORTEST, SOON, MOST_PIECES, MOST_PASSES = 5e-6, 1e-3, 1e-7, 4096, 100
SMOOTH_IN_CONTACTS = 1.2e-4  # finer, steps are halved here and there, and the error of a fit gets more local minima
ROUNDING = 2.220446049250313e-16  # share of a position by which a term moves the axis unseen: 2⁻⁵²
CLOSE, EXACT_PIECES = 1e-6, 16  # share of the way to a kink by which it may be missed, in the first pieces of a step
SLIGHT = 1e-10  # an axis that rests on a flank crosses it by its rounding all the time: by less than this, SI


@njit(**OPTIONS)
def averages(x: float) -> tuple[float, float, float, float]:
    """φ₁ = (1 − e⁻ˣ)/x and φₖ₊₁ = (1/k! − φₖ)/x, up to φ₄; where that cancels, from the series of φ₄ downwards."""
    if abs(x) < 0.125:
        fourth = 1.0 / 39916800.0 - x / 479001600.0
        fourth = 1.0 / 40320.0 - x * (1.0 / 362880.0 - x * (1.0 / 3628800.0 - x * fourth))
        fourth = TWENTYFOURTH - x * (1.0 / 120.0 - x * (1.0 / 720.0 - x * (1.0 / 5040.0 - x * fourth)))
        third = SIXTH - x * fourth
        second = HALF - x * third
        return 1.0 - x * second, second, third, fourth
    inverse = 1.0 / x
    first = (1.0 - exponential(-x)) * inverse
    second = (1.0 - first) * inverse
    third = (HALF - second) * inverse
    return first, second, third, (SIXTH - third) * inverse


@njit(**OPTIONS)
def decays(x: float) -> tuple[float, float]:
    """φ₃ and φ₄ of :func:`averages` for x ≥ 0, as exact as the last term of a series of the motion needs them."""
    if x < 0.125:
        fourth = TWENTYFOURTH - x * (1.0 / 120.0 - x * (1.0 / 720.0 - x * (1.0 / 5040.0)))
        return SIXTH - x * fourth, fourth
    _, _, third, fourth = averages(x)
    return third, fourth


@njit(**OPTIONS)
def reversal_time(v: float, series: Any, h: float) -> float:
    """Root in (0, h] of v + a τ + j τ²/2 + s τ³ φ₃(β τ), whose sign changes there: Newton kept inside its bracket.

    Where v is 0, the root at 0 is divided out.
    """
    a, j, s, rate = series[0], HALF * series[1], series[2], series[3]
    c0, c1, c2, s2, s3 = (a, j, 0.0, s, 0.0) if v == 0.0 else (v, a, j, 0.0, s)
    low, high = 0.0, h
    positive = c0 > 0.0 or (c0 == 0.0 and c1 > 0.0)
    tau = 0.5 * h
    for _ in range(60):
        third, _ = decays(rate * tau)
        second = HALF - rate * tau * third
        f = c0 + tau * (c1 + tau * (c2 + third * (s2 + tau * s3)))
        if (f > 0.0) == positive:
            low = tau
        else:
            high = tau
        slope = c1 + tau * (2.0 * c2 + (second - third) * s2 + tau * second * s3)
        new = tau - f / slope if slope != 0.0 else 0.5 * (low + high)
        if not (low < new < high):
            new = 0.5 * (low + high)
        if abs(new - tau) <= 1e-15 * h:
            return new
        tau = new
    return tau


@njit(**OPTIONS)
def relax(x: Any, after: Any, kept: Any, begin: Any, end: Any, known: Any, z: int, h: float) -> None:
    """Write the ramps over `h` seconds of the relaxing states into `x`, their values at the end into `after`.

    `kept` are their values at the beginning, `begin` and `end` hold A and B of each, and `known` what was worked out
    last: B times the step, and φ₁ to φ₄ of that, which mostly stay.
    """
    nz = relaxing_states()
    for i in range(nz):
        a0, b0, a1, b1 = begin[2 * i], begin[2 * i + 1], end[2 * i], end[2 * i + 1]
        b = 0.5 * (b0 + b1)
        early, late, bend = a0, a1, 0.0
        if b0 > 0.0 or b1 > 0.0:
            target = a0 / b0 if b0 > 0.0 else a1 / b1
            early, late = b * target, b * (a1 / b1 if b1 > 0.0 else target)
            bend = 0.5 * h * (b1 - b0) * (kept[i] - target)  # B is not the same all the time
        if known[5 * i] != b * h:
            known[5 * i] = b * h
            known[5 * i + 1], known[5 * i + 2], known[5 * i + 3], known[5 * i + 4] = averages(b * h)
        first, second, third, fourth = known[5 * i + 1], known[5 * i + 2], known[5 * i + 3], known[5 * i + 4]
        early, gain = h * early, h * (late - early)
        mean = kept[i] * first + early * second + gain * third + bend * (second - 2.0 * third)
        moment = kept[i] * second + early * third + gain * fourth + bend * (2.0 * third - 6.0 * fourth)
        x[z + i] = 6.0 * moment - 2.0 * mean
        x[z + nz + i] = (6.0 * mean - 12.0 * moment) / h
        after[z + i] = kept[i] * (1.0 - b * h * first) + early * first + gain * second


@njit(**OPTIONS)
def first_kink(before: Any, after: Any, nk: int) -> float:
    """Return the share of a piece after which the first of the kinks' functions changes its sign; 1 if none does.

    Just after: what begins just before would be a piece of the old side, however hard a contact hits. A piece that
    begins right on a kink belongs to neither side of it: it is left by a short one. Where one of them is crossed so
    slightly that only rounding can tell, the piece is left whole.
    """
    share = 1.0
    for i in range(nk):
        if before[i] == 0.0 and abs(after[i]) > SLIGHT:
            share = min(share, SHORTEST)
        if before[i] * after[i] < 0.0 and abs(after[i]) > max(CLOSE * abs(before[i]), SLIGHT):
            share = min(share, (1.0 + HALF * CLOSE) * before[i] / (before[i] - after[i]))
    return share


@njit(**OPTIONS)
def is_beyond(x: Any, p: Any, before: Any, there: Any) -> bool:
    """Whether ramps begin beyond a kink that the states themselves have not reached, or have left behind them."""
    if relaxing_states() == 0 or kinks() == 0:
        return False
    kinked(x, p, there)
    beyond = False
    for i in range(kinks()):
        beyond = beyond or (before[i] * there[i] < 0.0 and abs(there[i]) > SLIGHT)
    return beyond


@njit(**OPTIONS)
def shorten(begin: Any, end: Any, nz: int, share: float) -> None:
    """Set A and B at the end of a piece to those after a `share` of it."""
    for i in range(2 * nz):
        end[i] = begin[i] + share * (end[i] - begin[i])


@njit(**OPTIONS)
def choose_direction(x: Any, p: Any, out: Any) -> None:
    """Set the direction in which the axis moves, at rest that of the push, and whether it moves at all."""
    x[MOVING] = 1.0
    x[D] = 1.0 if x[V] >= 0.0 else -1.0
    if x[V] == 0.0:
        breakaway(x, p, out)
        if out[0] < 0.0:
            x[D] = -1.0
            breakaway(x, p, out)
        if out[0] * x[D] <= out[1]:
            x[MOVING] = 0.0


@njit(**OPTIONS)
def lacking(x: Any, p: Any, out: Any) -> tuple[float, float]:
    """Return how much push an axis at rest lacks to set out forward, and backward."""
    chosen = x[D]
    x[D] = 1.0
    breakaway(x, p, out)
    forward = max(out[1] - out[0], 0.0)
    x[D] = -1.0
    breakaway(x, p, out)
    x[D] = chosen
    return forward, max(out[1] + out[0], 0.0)


@njit(**OPTIONS)
def breaking_loose(e: Any, p: Any, out: Any, forward: float, backward: float) -> float:
    """Return the share of a piece after which an axis at rest, that lacked so much push, is pushed loose; 1 if never.

    Its states go on at rest: ``e`` is the end of the piece, and is told in which direction it then sets out.
    """
    choose_direction(e, p, out)
    if e[MOVING] == 0.0:
        return 1.0
    e[MOVING] = 0.0
    least = forward if e[D] > 0.0 else backward
    share: float = least / (least + out[0] * e[D] - out[1])
    return share


@njit(**OPTIONS)
def is_rough(series: Any, y: float, v: float, h: float, coarse: float) -> bool:
    """Whether `h` is so long that the last term of the series matters.

    What the damping explains of it does not, unless a state relaxes after the motion: that is no ramp. It is more than
    a share, than a speed of `coarse`, and than what the rounding of the position hides: an axis that has settled swings
    by its rounding for ever.
    """
    explained = series[3] * series[1] if drifts() == 0 else 0.0
    fine = SMOOTH if contacts() == 0 else SMOOTH_IN_CONTACTS
    last, share = abs(series[2] + explained) * h * h * h, fine * (abs(series[0]) * h + 2.0 * abs(v))
    matters: bool = last > share + coarse and last * h > ROUNDING * abs(y)
    return matters


@njit(**OPTIONS)
def smooth_part(
    x: Any, series: Any, begin: Any, end: Any, nz: int, part: float, shortest: float, coarse: float
) -> float:
    """Return half of a piece, or as much less as it takes for the last term of its series not to matter.

    A and B at the end are set to those after it.
    """
    shorter = 0.5 * part
    while shorter > shortest and is_rough(series, x[Y], x[V], shorter, coarse):
        shorter *= 0.5
    shorten(begin, end, nz, shorter / part)
    return shorter


@njit(**OPTIONS)
def move(x: Any, series: Any, ns: int, h: float, e: Any) -> float:
    """Write into `e` where the axis is after `h` seconds or at its reversal; return the time that this takes."""
    y, v, d = x[Y], x[V], x[D]
    a, j, s, rate = series[0], series[1], series[2], series[3]
    third, fourth = decays(rate * h)
    tau, speed = h, (v + h * a) + h * h * (HALF * j + h * third * s)
    if x[MOVING] == 0.0 or (v == 0.0 and a * d <= 0.0 and speed * d <= 0.0):  # a balance is left by a jerk
        speed = 0.0
        e[Y] = y
    else:
        if not speed * d > 0.0 and speed == speed:
            tau, speed = reversal_time(v, series, h), 0.0
            _, fourth = decays(rate * tau)
        e[Y] = (y + tau * v) + tau * tau * (HALF * a + tau * (SIXTH * j + tau * fourth * s))
        if v == 0.0 and speed == 0.0 and e[Y] == y:  # set out and back without moving by one bit: it rests
            tau = h
    e[V], e[T], e[U], e[D], e[MOVING], e[SHAKING] = speed, x[T] + tau, x[U], d, x[MOVING], x[SHAKING]
    for i in range(ns):
        k = SERIES + 3 * i
        change = series[k] + tau * (HALF * series[k + 1] + tau * SIXTH * series[k + 2])
        e[STATES + i] = x[STATES + i] + tau * change
    return tau


@njit(**OPTIONS)
def remember(x: Any, p: Any, kept: Any, begin: Any, end: Any, z: int, nz: int) -> None:
    """Keep the relaxing states of a piece's beginning; A and B are those there until its end is known."""
    relaxation(x, p, begin)
    for i in range(nz):
        kept[i] = x[z + i]
    for i in range(2 * nz):
        end[i] = begin[i]


@njit(**OPTIONS)
def arrive(x: Any, e: Any, size: int) -> None:
    """Put the axis where the piece ends."""
    for i in range(size):
        x[i] = e[i]


@njit(**OPTIONS)
def advance(x: Any, p: Any, room: Any, h: float, coarse: float) -> int:
    """Carry the axis in `x` over `h` seconds under the held input; return in how many pieces."""
    ns, nz, nk = smooth_states(), relaxing_states(), kinks()
    z, left, tau = STATES + ns, h, h
    e, series, kept, begin, end, known, before, after = room
    for piece in range(1, MOST_PIECES + 1):
        choose_direction(x, p, series)
        if ns + nz == 0 and x[MOVING] == 0.0:
            return piece
        forward, backward = lacking(x, p, series) if x[V] == 0.0 else (0.0, 0.0)
        kinked(x, p, before)
        remember(x, p, kept, begin, end, z, nz)
        part, again, sets_out, weight = left, nz > 0, x[V] == 0.0 and x[MOVING] == 1.0, 1.0
        for _ in range(MOST_PASSES):
            relax(x, e, kept, begin, end, known, z, part)
            taylor(x, p, series)
            if part > SHORTEST * h and (is_rough(series, x[Y], x[V], part, coarse) or is_beyond(x, p, before, after)):
                part = smooth_part(x, series, begin, end, nz, part, SHORTEST * h, coarse)
                if nz > 0:  # else the series is the same for a shorter piece
                    continue
            tau = move(x, series, ns, part, e)
            if sets_out and e[V] == 0.0 and e[Y] == x[Y]:  # not in this direction: it rests until it is pushed loose
                sets_out, x[MOVING] = False, 0.0
                continue
            if nz > 0 and tau < part:
                tau = max(tau, SHORTEST * h) if again and part > SHORTEST * h else tau  # it comes later than that
                shorten(begin, end, nz, tau / part)
                relax(x, e, kept, begin, end, known, z, tau)
            if again and (drifts() != 0 or tau < part):
                part, again = tau, False
                relaxation(e, p, end)
                continue
            kinked(e, p, after)
            share, shortest = first_kink(before, after, nk), (CLOSE if piece <= EXACT_PIECES else SHORTEST) * h
            if x[MOVING] == 0.0:
                loose = breaking_loose(e, p, series, forward, backward)
                if loose * tau <= SOON * h:
                    x[MOVING], x[D] = 1.0, e[D]
                    continue
                if loose < share:  # Illinois: the root is not crept up on
                    share = weight * loose / (weight * loose + 1.0 - loose)
                    weight, shortest = HALF * weight, SOON * h
            if share == 1.0 or tau <= shortest:
                break
            part = max(share * tau, shortest)
            shorten(begin, end, nz, part / tau)
        arrive(x, e, z + nz)
        if tau == left:
            return piece
        left -= tau
    return MOST_PIECES
