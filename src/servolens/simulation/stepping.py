"""One axis, stepped through its samples: the text of the compiled kernel.

This module is not imported: its text is compiled by numba once for all plants, and calls the machine code that
:mod:`servolens.simulation.native` makes of a plant's equation of motion.

A step is a Taylor series: third order where the motion is smooth; it is halved while its last term is more than a
hundred-thousandth of the travel (a kick of the voltage may change the damping within a sample). Each velocity
reversal is found as the root of the series and the step is split there, so that the order holds across it (second
order at least), and |v| is smooth within a piece. At rest dry friction is set-valued: the axis leaves only if the push
exceeds the level, and until then its position does not change by one bit.

What the effects remember is carried along: a second mass or an integral by its own series; a state that relaxes
(ż = A − B z: a filter, a bristle) exactly for an A/B that changes linearly, however fast it is. Within a piece the
series of the motion sees such a state as the ramp that has the same mean and the same first moment as its exponential
(second order).

The arrays: `f` holds the addresses of the machine code; `x` is [y, v, t, u, d, moving, smooth states, relaxing states,
their ramps]; `out` takes results; `keep` holds the relaxing states, A and B at the beginning of a piece.
"""

# ruff: noqa: C901, PLR0913, PLR0915 - one compiled loop; calls are split where numba inlines them
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float64, int64, njit, types
from numba.extending import intrinsic

_IN = types.Array(float64, 1, "C", readonly=True)
_TALL = types.Array(int64, 1, "C", readonly=True)
_OUT = float64[::1]

HALF, SIXTH, TWENTYFOURTH = 1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0
SMOOTH, SHORTEST, MOST_PIECES = 1.2e-4, 1e-3, 4096
Y, V, T, U, D, MOVING, STATES = 0, 1, 2, 3, 4, 5, 6
TAYLOR, BREAKAWAY, RELAXATION, SHOWN, BEGINNING = 0, 1, 2, 3, 4
FARTHEST = 1e6


@intrinsic
def call(context: Any, address: Any, x: Any, p: Any, out: Any) -> Any:
    """Call the machine code at `address` with the data of three arrays."""
    from llvmlite import ir

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        function = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer])
        data = [
            target.make_array(kind)(target, builder, value).data
            for kind, value in zip(signature.args[1:], arguments[1:], strict=True)
        ]
        builder.call(builder.inttoptr(arguments[0], function.as_pointer()), data)
        return target.get_dummy_value()

    return types.void(types.int64, x, p, out), code


@njit(forceinline=True, error_model="numpy")
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


@njit(forceinline=True, error_model="numpy")
def averages(b: float) -> tuple[float, float]:
    """φ₁ = (1 − e⁻ᵇ)/b and φ₂ = (1 − φ₁)/b."""
    if abs(b) < 0.02:
        return (
            1.0 - b * (0.5 - b * (SIXTH - b * (TWENTYFOURTH - b / 120.0))),
            0.5 - b * (SIXTH - b * (TWENTYFOURTH - b * (1.0 / 120.0 - b / 720.0))),
        )
    first = -math.expm1(-b) / b
    return first, (1.0 - first) / b


@njit(forceinline=True, error_model="numpy")
def ramp(x: Any, keep: Any, z: int, nz: int, h: float) -> None:
    """Write the ramps over `h` seconds of the relaxing states, which stand in `x` from `z` on."""
    for i in range(nz):
        start, a, b = keep[3 * i], keep[3 * i + 1], keep[3 * i + 2]
        if b > 0.0:
            first, second = averages(b * h)
            target = a / b
            x[z + i] = target + (start - target) * (6.0 * second - 2.0 * first)
            x[z + nz + i] = (start - target) * (6.0 * first - 12.0 * second) / h
        else:
            x[z + i] = start
            x[z + nz + i] = a - b * start


@njit(forceinline=True, error_model="numpy")
def remember(f: Any, x: Any, p: Any, out: Any, keep: Any, ns: int, nz: int, h: float) -> None:
    """Carry the states over `h` seconds; `out` holds the smooth ones' series, `x` the motion at the end."""
    for i in range(ns):
        k = 3 + 3 * i
        x[STATES + i] += h * (out[k] + h * (HALF * out[k + 1] + h * SIXTH * out[k + 2]))
    if nz == 0:
        return
    z = STATES + ns
    for i in range(nz):
        x[z + i] += h * x[z + nz + i]
    call(f[RELAXATION], x, p, out)
    for i in range(nz):
        start, a0, b0 = keep[3 * i], keep[3 * i + 1], keep[3 * i + 2]
        a1, b1 = out[2 * i], out[2 * i + 1]
        b = 0.5 * (b0 + b1)
        first, second = averages(b * h)
        if b0 > 0.0 and b1 > 0.0:
            early, late = b * a0 / b0, b * a1 / b1
        elif b0 > 0.0:
            early = late = b * a0 / b0
        elif b1 > 0.0:
            early = late = b * a1 / b1
        else:
            early, late = a0, a1
        x[z + i] = start * (1.0 - b * h * first) + h * ((first - second) * early + second * late)


@njit(forceinline=True, error_model="numpy")
def advance(f: Any, x: Any, p: Any, out: Any, keep: Any, ns: int, nz: int, h: float) -> None:
    """Carry the axis in `x` over `h` seconds under the held input."""
    left = h
    z = STATES + ns
    for _ in range(MOST_PIECES):
        y, v = x[Y], x[V]
        x[MOVING] = 1.0
        if v == 0.0:
            x[D] = 1.0
            call(f[BREAKAWAY], x, p, out)
            if out[0] < 0.0:
                x[D] = -1.0
                call(f[BREAKAWAY], x, p, out)
            if out[0] * x[D] <= out[1]:
                if ns + nz == 0:
                    return
                x[MOVING] = 0.0
        elif v > 0.0:
            x[D] = 1.0
        else:
            x[D] = -1.0
        if nz > 0:
            call(f[RELAXATION], x, p, out)
            for i in range(nz):
                keep[3 * i] = x[z + i]
                keep[3 * i + 1] = out[2 * i]
                keep[3 * i + 2] = out[2 * i + 1]
            ramp(x, keep, z, nz, left)
        call(f[TAYLOR], x, p, out)
        part = left
        while abs(out[2]) * part * part * part > SMOOTH * (abs(out[0]) * part + 2.0 * abs(v)) and part > SHORTEST * h:
            part *= 0.5
            if nz > 0:
                ramp(x, keep, z, nz, part)
                call(f[TAYLOR], x, p, out)
        a, j, s = out[0], out[1], out[2]
        d = x[D]
        after = v + part * (a + part * (HALF * j + part * SIXTH * s))
        if x[MOVING] == 0.0:
            tau, after = part, 0.0
        elif after * d > 0.0:
            tau = part
            x[Y] = y + part * (v + part * (HALF * a + part * (SIXTH * j + part * TWENTYFOURTH * s)))
        elif v == 0.0 and a * d <= 0.0:
            if ns + nz == 0:
                return
            tau, after = part, 0.0
        elif after != after:
            x[Y] = math.nan
            return
        else:
            if v == 0.0:
                tau = reversal_time(a, HALF * j, SIXTH * s, 0.0, part)
            else:
                tau = reversal_time(v, a, HALF * j, SIXTH * s, part)
            after = 0.0
            x[Y] = y + tau * (v + tau * (HALF * a + tau * (SIXTH * j + tau * TWENTYFOURTH * s)))
        x[V] = after
        x[T] += tau
        if ns + nz > 0:
            remember(f, x, p, out, keep, ns, nz, tau)
        if tau == left:
            return
        left -= tau


@njit(
    int64(_TALL, int64, int64, _IN, _IN, _IN, _IN, _IN, _IN, float64, int64, _OUT, _OUT, _OUT, _OUT),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def run(
    f: Any,
    ns: int,
    nz: int,
    time: Any,
    held: Any,
    reference: Any,
    loop: Any,
    start: Any,
    p: Any,
    delay: float,
    substeps: int,
    position: Any,
    velocity: Any,
    voltage: Any,
    measured: Any,
) -> int:
    """Fill `position`, `velocity`, `voltage` and `measured` at each sample; return how many were done.

    `loop` is (closed, kp, kd, filter, window, on error, own velocity, samples a period, resolution, period [s]).
    Without a closed loop the input is `held`; with one, `held` is added to what the controller asks for. The input
    reaches the actuator `delay` seconds late; before the record the first one was applied.
    """
    closed, kp, kd, share = loop[0] != 0.0, loop[1], loop[2], loop[3]
    window, on_error, own_velocity = int(loop[4]), loop[5] != 0.0, loop[6] != 0.0
    ratio, resolution, period = int(loop[7]), loop[8], loop[9]
    x, out = np.zeros(STATES + ns + 2 * nz), np.empty(3 + 3 * ns + 2 * nz)
    keep = np.empty(3 * nz)
    x[Y], x[V] = start[0], start[1]
    derivative = 0.0
    asked = 0.0
    n = time.size
    late, due = 0, 0.0
    if delay > 0.0 and n > 1:
        nominal = (time[n - 1] - time[0]) / (n - 1)
        late = int(delay / nominal * (1.0 + 1e-12))
        due = max(delay / nominal - late, 0.0)
    for k in range(n):
        speed = x[V]
        seen = x[Y]
        position[k] = seen
        if k == 0 and ns + nz > 0:
            x[T], x[D] = time[0], 1.0
            x[U] = held[0] + (kp * (reference[0] - seen) if closed else 0.0)
            call(f[BEGINNING], x, p, out)
            for i in range(ns + nz):
                x[STATES + i] = out[i]
        if f[SHOWN] != 0:
            call(f[SHOWN], x, p, out)
            seen, speed, position[k] = out[0], out[1], out[2]
        velocity[k] = speed
        if resolution > 0.0:
            seen = math.floor(seen / resolution + 0.5) * resolution
        measured[k] = seen
        if closed:
            if k % ratio == 0:
                error = reference[k] - seen
                if own_velocity:
                    raw = speed
                else:
                    before = max(k - window * ratio, 0)
                    raw = (seen - measured[before]) / (window * period)
                    if on_error:
                        raw -= (reference[k] - reference[before]) / (window * period)
                derivative += share * (raw - derivative)
                asked = kp * error - kd * derivative
            u = asked + held[k]
        else:
            u = held[k]
        voltage[k] = u
        if not abs(x[Y]) < FARTHEST:
            return int(k)
        if k + 1 == n:
            break
        whole = time[k + 1] - time[k]
        old = voltage[max(k - late - 1, 0)]
        new = voltage[max(k - late, 0)]
        first = due * whole if old != new else 0.0
        if first > 0.0:
            pieces = math.ceil(due * substeps)
            x[U] = old
            for i in range(pieces):
                x[T] = time[k] + i * (first / pieces)
                advance(f, x, p, out, keep, ns, nz, first / pieces)
        pieces = math.ceil((1.0 - first / whole) * substeps - 1e-9)
        h = (whole - first) / pieces
        x[U] = new
        for i in range(pieces):
            x[T] = time[k] + first + i * h
            advance(f, x, p, out, keep, ns, nz, h)
    return int(n)
