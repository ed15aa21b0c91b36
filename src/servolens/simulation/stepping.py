"""One axis, stepped through its samples: the rule that all compiled simulations share.

Numba turns this module into LLVM's language once, with those that it calls: the motion between the samples
(:mod:`servolens.simulation.motion`), the digital controller (:mod:`servolens.simulation.digital`) and the functions of
the plant, which are declared only (:mod:`servolens.simulation.plant_functions`). :mod:`servolens.simulation.native`
joins the rule with a plant's equation of motion, and LLVM makes one piece of machine code of both.
"""

# ruff: noqa: PLR0913 - every array is an argument of a compiled function
# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import ctypes
import math
import os
from typing import Any

from numba import cfunc, config, float64, int64, njit

from servolens.simulation import elementary
from servolens.simulation.digital import (
    BEYOND_PD,
    CLOSED,
    COARSE,
    CORRECTS,
    HELD,
    INTEGRAL_BEFORE,
    IS_KNOWN_BEFORE,
    IS_PD,
    MOST_PIECES_GRANTED,
    MOVED,
    RATIO,
    RESOLUTION,
    SHAKEN,
    SHAKING_LEFT,
    applied_before,
    asked,
    law_beyond_pd,
)
from servolens.simulation.elementary import OPTIONS
from servolens.simulation.kalman import kalman
from servolens.simulation.motion import advance
from servolens.simulation.plant_functions import (
    FUNCTIONS,
    MOVING,
    NUMBERS,
    POINTER,
    SERIES,
    SHAKING,
    STATES,
    D,
    T,
    U,
    V,
    Y,
    beginning,
    kinks,
    numbers,
    parameters,
    relaxing_states,
    shown,
    smooth_states,
)

__all__ = ["compiled_rule", "run"]

SLIVER = 1e-9  # share of a sample that is taken for none
FARTHEST = 1e6  # where an axis is taken to have run away, SI


@njit(**OPTIONS)
def set_out(x: Any, p: Any, states: Any, known: Any, time: float, command: float, start: Any) -> None:
    """Put the axis at its beginning into `x`: what the effects remember is as if it had been at rest for long.

    `start` holds position and velocity, and how far the motor is ahead of the load. What is `known` of the relaxing
    states is nothing yet.
    """
    count, nz = smooth_states() + relaxing_states(), relaxing_states()
    x[Y], x[V], x[T], x[U], x[D], x[MOVING], x[SHAKING] = start[0], start[1], time, command, 1.0, 1.0, 0.0
    for i in range(count + nz):
        x[STATES + i] = 0.0
    for i in range(nz):
        known[5 * i] = -1.0  # no rate is negative
    beginning(x, p, states)
    for i in range(count):
        x[STATES + i] = states[i]
    x[Y] += start[2]


@njit(**OPTIONS)
def rounded(position: float, resolution: float) -> float:
    """Return the position as an encoder shows it; a resolution of 0 is exact."""
    return math.floor(position / resolution + 0.5) * resolution if resolution > 0.0 else position


@njit(**OPTIONS)
def erring(position: float, loop: Any, gains: Any, k: int) -> float:
    """Return the position with the sensor's error of this sample, if it has one."""
    error: float = gains[2 * k + 1] if loop[CORRECTS] == SHAKEN else 0.0
    return position + error


@njit(**OPTIONS)
def correct(x: Any, loop: Any, gains: Any, k: int, ns: int, nz: int, innovation: float) -> None:
    """Shake the axis, or move an observer's towards what was measured; one at rest keeps its velocity."""
    if loop[CORRECTS] == SHAKEN:
        x[SHAKING] = gains[2 * k]
    else:
        x[Y] += gains[3 * k] * innovation
        rests = gains[3 * k + 1] == HELD
        if rests:
            x[V] = 0.0
        elif x[V] != 0.0:
            x[V] += gains[3 * k + 1] * innovation
        x[SHAKING] = 0.0 if rests else loop[SHAKING_LEFT] * x[SHAKING] + gains[3 * k + 2] * innovation
        for i in range(ns + nz):
            if loop[MOVED + i] > 0.0 and not (rests and loop[MOVED + i] == 2.0):
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
    shaking; of an axis that is shaken, `gains` holds two: the acceleration from each sample on, and the sensor's
    error. Minus one is returned where more pieces than granted would be needed; zero grants any number. Without a
    closed loop the input is `held`; with one, `held` is added to what the controller asks for. The input reaches the
    actuator `delay` seconds late; before the record the first one was applied, if it is not known.
    """
    ns, nz, nk = smooth_states(), relaxing_states(), kinks()
    size, series = STATES + ns + 2 * nz, numbers(SERIES + 3 * ns)
    p, x, states, output, known = numbers(parameters()), numbers(size), numbers(ns + nz), numbers(3), numbers(5 * nz)
    room = (numbers(size), series, numbers(nz), numbers(2 * nz), numbers(2 * nz), known, numbers(nk), numbers(nk))
    for i in range(parameters()):
        p[i] = values[i]  # a copy that nobody else can write, so that LLVM keeps what hangs on it alone
    closed, is_pd, ratio = loop[CLOSED] != 0.0, loop[IS_PD] != 0.0, int(loop[RATIO])
    resolution, granted = loop[RESOLUTION], loop[MOST_PIECES_GRANTED]
    before = applied_before(held[0], reference[0], start[0], loop)
    set_out(x, p, states, known, time[0], before, start)
    derivative, integral = numbers(1), numbers(1)  # apart, for the second is seen by a function that is called
    derivative[0], integral[0], voltage, wait, pieces, arrived = 0.0, loop[INTEGRAL_BEFORE], 0.0, 0, 0, -1
    for k in range(n):
        output[0], output[1], output[2] = x[Y], x[V], x[Y]
        shown(x, p, output)
        seen = rounded(erring(output[0], loop, gains, k), resolution)
        results[k], results[n + k], measured[k] = output[2], output[1], seen
        if closed and wait == 0:
            voltage = asked(k, seen, output[1], time, reference, measured, held, loop, derivative, integral, is_pd)
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
            "run": cfunc(int64(int64, int64, float64, *[POINTER] * 9), **OPTIONS)(run),
            "gains": cfunc(int64(int64, *[POINTER] * 6), **OPTIONS)(kalman),
            "beyond_pd": cfunc(BEYOND_PD, **OPTIONS)(law_beyond_pd),
            "exp": real(elementary.exponential.py_func),
            "sin": real(elementary.sine.py_func),
            "cos": real(elementary.cosine.py_func),
        }
    finally:
        config.LOOP_VECTORIZE = vectorises
