"""One axis, stepped through its samples: the rule that all compiled simulations share.

Numba turns this module into LLVM's language once; :mod:`servolens.simulation.native` joins that with a plant's equation
of motion, and LLVM makes one piece of machine code of both. The functions declared below are the plant's part.

A step is a Taylor series: third order where the motion is smooth; it is halved while its last term is more than a
hundred-thousandth of the travel (a kick of the voltage may change the damping within a sample). Each velocity
reversal is found as the root of the series and the step is split there, so that the order holds across it (second
order at least), and |v| is smooth within a piece. At rest dry friction is set-valued: the axis leaves only if the push
exceeds the level, and until then its position does not change by one bit. Where a force has a kink (a contact closes,
a limit is met) the step is split as well.

What the effects remember is carried along: a second mass or an integral by its own series; a state that relaxes
(ż = A − B z: a filter, a bristle) exactly for an A/B that changes linearly, however fast it is. Within a piece the
series of the motion sees such a state as the ramp that has the same mean and the same first moment as its exponential.
Where A and B change with the motion, their values at the end of a piece come from a first pass over it.

The arrays: `x` is [y, v, t, u, d, moving, shaking, smooth states, relaxing states, their ramps], where `shaking` is an
acceleration that an observer holds from sample to sample; `p` holds the plant's parameters; a series is [acceleration,
jerk, snap, then three derivatives of each smooth state].
"""

# ruff: noqa: C901, PLR0913 - one compiled loop, and every array is an argument
from __future__ import annotations

import ctypes
import math
import os
from typing import Any

from numba import cfunc, config, float64, int64, njit, types
from numba.extending import intrinsic

from servolens.simulation import elementary
from servolens.simulation.digital import (
    BEYOND_PD,
    CLOSED,
    COARSE,
    CORRECTS,
    INTEGRAL_BEFORE,
    IS_KNOWN_BEFORE,
    IS_PD,
    MOST_PIECES_GRANTED,
    MOVED,
    RATIO,
    RESOLUTION,
    SHAKING_LEFT,
    applied_before,
    asked,
    law_beyond_pd,
)
from servolens.simulation.elementary import OPTIONS, exponential
from servolens.simulation.kalman import kalman

HALF, SIXTH, TWENTYFOURTH = 1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0
SLIVER, SMOOTH, SHORTEST, SOON, MOST_PIECES, MOST_PASSES = 1e-9, 1.2e-4, 1e-3, 1e-7, 4096, 100
ROUNDING = 2.0**-52  # of a position: a term that moves the axis by less shows nowhere but in the rounding of others
SLIGHT = 1e-10  # an axis that rests on a flank crosses it by its rounding all the time: by less than this, SI
Y, V, T, U, D, MOVING, SHAKING, STATES = 0, 1, 2, 3, 4, 5, 6, 7
FARTHEST = 1e6

_NUMBERS = types.CPointer(float64)


def _number_of(what: str) -> Any:
    return types.ExternalFunction(f"servolens_{what}", int64())


def _plant(name: str) -> Any:
    return types.ExternalFunction(f"servolens_{name}", types.int64(_NUMBERS, _NUMBERS, _NUMBERS))


NUMBERS = ("parameters", "smooth", "relaxing", "drifts", "kinks")
FUNCTIONS = ("taylor", "breakaway", "relaxation", "kinked", "shown", "beginning")
parameters, smooth_states, relaxing_states, drifts, kinks = map(_number_of, NUMBERS)
taylor, breakaway, relaxation, kinked, shown, beginning = map(_plant, FUNCTIONS)


@intrinsic
def numbers(context: Any, size: Any) -> Any:
    """Return room for `size` numbers on the stack."""
    from llvmlite import ir

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.alloca(ir.DoubleType(), size=arguments[0])

    return _NUMBERS(types.int64), code


@njit(**OPTIONS)
def reversal_time(c0: float, c1: float, c2: float, c3: float, h: float) -> float:
    """Root in (0, h] of c0 + c1 τ + c2 τ² + c3 τ³, which changes sign there: Newton kept inside its bracket."""
    low, high = 0.0, h
    positive = c0 > 0.0 or (c0 == 0.0 and c1 > 0.0)
    tau = 0.5 * h
    for _ in range(60):
        f = c0 + tau * (c1 + tau * (c2 + tau * c3))
        if (f > 0.0) == positive:
            low = tau
        else:
            high = tau
        slope = c1 + tau * (2.0 * c2 + tau * 3.0 * c3)
        new = tau - f / slope if slope != 0.0 else 0.5 * (low + high)
        if not (low < new < high):
            new = 0.5 * (low + high)
        if abs(new - tau) <= 1e-15 * h:
            return new
        tau = new
    return tau


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
def relax(x: Any, after: Any, kept: Any, begin: Any, end: Any, z: int, nz: int, h: float) -> None:
    """Write the ramps over `h` seconds of the relaxing states into `x`, their values at the end into `after`.

    `kept` are their values at the beginning, `begin` and `end` hold A and B of each.
    """
    for i in range(nz):
        a0, b0, a1, b1 = begin[2 * i], begin[2 * i + 1], end[2 * i], end[2 * i + 1]
        b = 0.5 * (b0 + b1)
        early, late, bend = a0, a1, 0.0
        if b0 > 0.0 or b1 > 0.0:
            target = a0 / b0 if b0 > 0.0 else a1 / b1
            early, late = b * target, b * (a1 / b1 if b1 > 0.0 else target)
            bend = 0.5 * h * (b1 - b0) * (kept[i] - target)  # B is not the same all the time
        first, second, third, fourth = averages(b * h)
        early, gain = h * early, h * (late - early)
        mean = kept[i] * first + early * second + gain * third + bend * (second - 2.0 * third)
        moment = kept[i] * second + early * third + gain * fourth + bend * (2.0 * third - 6.0 * fourth)
        x[z + i] = 6.0 * moment - 2.0 * mean
        x[z + nz + i] = (6.0 * mean - 12.0 * moment) / h
        after[z + i] = kept[i] * (1.0 - b * h * first) + early * first + gain * second


@njit(**OPTIONS)
def first_kink(before: Any, after: Any, nk: int) -> float:
    """Return the share of a piece after which the first of the kinks' functions changes its sign; 1 if none does.

    A piece that begins right on a kink belongs to neither side of it: it is left by a short one. Where one of them is
    crossed so slightly that only rounding can tell, the piece is left whole.
    """
    share = 1.0
    for i in range(nk):
        if before[i] == 0.0 and abs(after[i]) > SLIGHT:
            share = min(share, SHORTEST)
        if before[i] * after[i] < 0.0 and abs(after[i]) > max(SHORTEST * abs(before[i]), SLIGHT):
            share = min(share, before[i] / (before[i] - after[i]))
    return share


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
def lacking(x: Any, p: Any, direction: float, out: Any) -> float:
    """Return how much push an axis at rest lacks to set out in a direction."""
    chosen = x[D]
    x[D] = direction
    breakaway(x, p, out)
    x[D] = chosen
    least: float = max(out[1] - out[0] * direction, 0.0)
    return least


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

    It is more than a share, than a speed of `coarse`, and than what the rounding of the position hides: an axis that
    has settled swings by its rounding for ever.
    """
    last, share = abs(series[2]) * h * h * h, SMOOTH * (abs(series[0]) * h + 2.0 * abs(v))
    matters: bool = last > share + coarse and last * h > ROUNDING * abs(y)
    return matters


@njit(**OPTIONS)
def move(x: Any, series: Any, ns: int, h: float, e: Any) -> float:
    """Write into `e` where the axis is after `h` seconds or at its reversal; return the time that this takes."""
    y, v, d = x[Y], x[V], x[D]
    a, j, s = series[0], series[1], series[2]
    tau, speed = h, (v + h * a) + h * h * (HALF * j + h * SIXTH * s)
    if x[MOVING] == 0.0 or (v == 0.0 and a * d <= 0.0):
        speed = 0.0
        e[Y] = y
    else:
        if not speed * d > 0.0 and speed == speed:
            at_rest = v == 0.0  # then the root at 0 is divided out
            c0, c1 = (a, HALF * j) if at_rest else (v, a)
            c2, c3 = (SIXTH * s, 0.0) if at_rest else (HALF * j, SIXTH * s)
            tau = reversal_time(c0, c1, c2, c3, h)
            speed = 0.0
        e[Y] = (y + tau * v) + tau * tau * (HALF * a + tau * (SIXTH * j + tau * TWENTYFOURTH * s))
        if v == 0.0 and speed == 0.0 and e[Y] == y:  # set out and back without moving by one bit: it rests
            tau = h
    e[V], e[T], e[U], e[D], e[MOVING], e[SHAKING] = speed, x[T] + tau, x[U], d, x[MOVING], x[SHAKING]
    for i in range(ns):
        k = 3 + 3 * i
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
def advance(x: Any, p: Any, room: Any, h: float, coarse: float) -> int:
    """Carry the axis in `x` over `h` seconds under the held input; return in how many pieces."""
    ns, nz, nk = smooth_states(), relaxing_states(), kinks()
    z, left = STATES + ns, h
    e, series, kept, begin, end, before, after = room
    for piece in range(1, MOST_PIECES + 1):
        choose_direction(x, p, series)
        if ns + nz == 0 and x[MOVING] == 0.0:
            return piece
        forward, backward, weight = 0.0, 0.0, 1.0
        if x[MOVING] == 0.0:
            forward, backward = lacking(x, p, 1.0, series), lacking(x, p, -1.0, series)
        kinked(x, p, before)
        remember(x, p, kept, begin, end, z, nz)
        part, tau, again = left, left, nz > 0
        for _ in range(MOST_PASSES):
            relax(x, e, kept, begin, end, z, nz, part)
            taylor(x, p, series)
            if is_rough(series, x[Y], x[V], part, coarse) and part > SHORTEST * h:
                part *= 0.5
                shorten(begin, end, nz, 0.5)
                continue
            tau = move(x, series, ns, part, e)
            if nz > 0 and tau < part:
                shorten(begin, end, nz, tau / part)
                relax(x, e, kept, begin, end, z, nz, tau)
            if again and (drifts() != 0 or tau < part):
                part, again = tau, False
                relaxation(e, p, end)
                continue
            kinked(e, p, after)
            share, shortest = first_kink(before, after, nk), SHORTEST * h
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
        for i in range(z + nz):
            x[i] = e[i]
        if tau == left:
            return piece
        left -= tau
    return MOST_PIECES


@njit(**OPTIONS)
def set_out(x: Any, p: Any, states: Any, time: float, command: float, start: Any) -> None:
    """Put the axis at its beginning into `x`: what the effects remember is as if it had been at rest for long."""
    count, nz = smooth_states() + relaxing_states(), relaxing_states()
    x[Y], x[V], x[T], x[U], x[D], x[MOVING], x[SHAKING] = start[0], start[1], time, command, 1.0, 1.0, 0.0
    for i in range(count + nz):
        x[STATES + i] = 0.0
    beginning(x, p, states)
    for i in range(count):
        x[STATES + i] = states[i]


@njit(**OPTIONS)
def rounded(position: float, resolution: float) -> float:
    """Return the position as an encoder shows it; a resolution of 0 is exact."""
    return math.floor(position / resolution + 0.5) * resolution if resolution > 0.0 else position


@njit(**OPTIONS)
def correct(x: Any, loop: Any, gains: Any, k: int, ns: int, nz: int, innovation: float) -> None:
    """Move an observer's axis towards what was measured; one at rest keeps its velocity, for friction would."""
    x[Y] += gains[3 * k] * innovation
    if x[V] != 0.0:
        x[V] += gains[3 * k + 1] * innovation
    x[SHAKING] = loop[SHAKING_LEFT] * x[SHAKING] + gains[3 * k + 2] * innovation
    for i in range(ns + nz):
        if loop[MOVED + i] > 0.0:
            x[STATES + i] += gains[3 * k + int(loop[MOVED + i]) - 1] * innovation


@njit(**OPTIONS)
def sent(results: Any, n: int, k: int, before: float) -> float:
    """Return the voltage of sample `k`, `before` where that is earlier than the first."""
    voltage: float = results[2 * n + k] if k >= 0 else before
    return voltage


@njit(**OPTIONS)
def hold(x: Any, p: Any, room: Any, begin: float, length: float, span: float, substeps: int, coarse: float) -> int:
    """Carry the axis over `length` seconds of a sample of `span` seconds under one input; return in how many pieces."""
    pieces = 0
    steps = substeps if length == span else math.ceil(length / span * substeps - 1e-9)
    h = length / steps
    for i in range(steps):
        x[T] = begin + i * h
        pieces += advance(x, p, room, h, coarse)
    return pieces


@njit(**OPTIONS)
def carry(
    x: Any,
    p: Any,
    room: Any,
    time: Any,
    results: Any,
    n: int,
    k: int,
    arrived: int,
    delay: float,
    before: float,
    substeps: int,
    coarse: float,
) -> tuple[int, int]:
    """Carry the axis from sample `k` to the next; return in how many pieces, and the last sample whose input arrived.

    An input arrives `delay` seconds after the instant of its sample, wherever in a later sample that is.
    """
    pieces, begin, end = 0, time[k], time[k + 1]
    span = end - begin
    while arrived < k and time[arrived + 1] + delay < end - SLIVER * span:
        due = time[arrived + 1] + delay
        new = sent(results, n, arrived + 1, before)
        if due > begin + SLIVER * span and new != x[U]:
            pieces += hold(x, p, room, begin, due - begin, span, substeps, coarse)
            begin = due
        x[U] = new
        arrived += 1
    return pieces + hold(x, p, room, begin, end - begin, span, substeps, coarse), arrived


def run(
    n: int,
    substeps: int,
    delay: float,
    time: Any,
    held: Any,
    reference: Any,
    loop: Any,
    start: Any,
    values: Any,
    gains: Any,
    results: Any,
    measured: Any,
) -> int:
    """Fill `results`, n positions, velocities and voltages in turn, and `measured`; return how many were done.

    `loop` holds the settings that :mod:`servolens.simulation.digital` names: of the controller, of the time before, of
    an observer, the speed that a step may be wrong by, then for each state whether an observer moves it with the
    position (1), the velocity (2) or not (0). An observer has the measured position as `reference`, gives its
    prediction from the samples before as `measured`, and `gains` holds three a sample: of position, velocity and
    shaking. Minus one is returned where more pieces than granted would be needed; zero grants any number. Without a
    closed loop the input is `held`; with one, `held` is added to what the controller asks for. The input reaches the
    actuator `delay` seconds late; before the record the first one was applied, if it is not known.
    """
    ns, nz, nk = smooth_states(), relaxing_states(), kinks()
    size = STATES + ns + 2 * nz
    p, x, states, output = numbers(parameters()), numbers(size), numbers(ns + nz), numbers(3)
    room = (numbers(size), numbers(3 + 3 * ns), numbers(nz), numbers(2 * nz), numbers(2 * nz), numbers(nk), numbers(nk))
    for i in range(parameters()):
        p[i] = values[i]  # a copy that nobody else can write, so that LLVM keeps what hangs on it alone
    closed, is_pd, ratio = loop[CLOSED] != 0.0, loop[IS_PD] != 0.0, int(loop[RATIO])
    resolution, granted = loop[RESOLUTION], loop[MOST_PIECES_GRANTED]
    before = applied_before(held[0], reference[0], start[0], loop)
    set_out(x, p, states, time[0], before, start)
    derivative, integral = numbers(1), numbers(1)  # apart, for the second is seen by a function that is called
    derivative[0], integral[0], voltage, wait, pieces, arrived = 0.0, loop[INTEGRAL_BEFORE], 0.0, 0, 0, -1
    for k in range(n):
        output[0], output[1], output[2] = x[Y], x[V], x[Y]
        shown(x, p, output)
        seen = rounded(output[0], resolution)
        results[k], results[n + k], measured[k] = output[2], output[1], seen
        if closed and wait == 0:
            voltage = asked(k, seen, output[1], reference, measured, held, loop, derivative, integral, is_pd)
            wait = ratio
        wait -= 1
        results[2 * n + k] = voltage + held[k]
        if loop[CORRECTS] != 0.0:
            correct(x, loop, gains, k, ns, nz, reference[k] - seen)
        if k == 0 and loop[IS_KNOWN_BEFORE] == 0.0:
            before = results[2 * n]
            x[U] = before
        if not abs(x[Y]) < FARTHEST:
            return k
        if k + 1 == n:
            break
        more, arrived = carry(x, p, room, time, results, n, k, arrived, delay, before, substeps, loop[COARSE])
        pieces += more
        if pieces > granted > 0.0:
            return -1
    return n


def compiled_rule() -> dict[str, Any]:
    """Return numba's forms of what is here by name; they are there to be read and cannot run without a plant's part."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    place = ctypes.cast(ctypes.CDLL("ucrtbase" if os.name == "nt" else None).exp, ctypes.c_void_p).value
    for name in (*NUMBERS, *FUNCTIONS, "beyond_pd"):
        llvm.add_symbol(f"servolens_{name}", place)  # numba wants an address
    vectorises, config.LOOP_VECTORIZE = config.LOOP_VECTORIZE, 0  # loops over the states end up as straight code
    try:
        real = cfunc(float64(float64), **OPTIONS)
        return {
            "run": cfunc(int64(int64, int64, float64, *[_NUMBERS] * 9), **OPTIONS)(run),
            "gains": cfunc(int64(int64, *[_NUMBERS] * 5), **OPTIONS)(kalman),
            "beyond_pd": cfunc(BEYOND_PD, **OPTIONS)(law_beyond_pd),
            "exp": real(elementary.exponential.py_func),
            "sin": real(elementary.sine.py_func),
            "cos": real(elementary.cosine.py_func),
        }
    finally:
        config.LOOP_VECTORIZE = vectorises
