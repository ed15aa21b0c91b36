"""One axis, stepped through its samples: the text of the compiled kernel.

This module is not imported: its text is compiled by numba together with the `taylor` and `breakaway` that
:mod:`servolens.simulation.codegen` derives from the plant's equation of motion, and so is free of calls it could not
inline.

A step is a Taylor series: third order where the motion is smooth; it is halved while its last term is more than a
hundred-thousandth of the travel (a kick of the voltage may change the damping within a sample). Each velocity
reversal is found as the root of the series and the step is split there, so that the order holds across it (second
order at least), and |v| is smooth within a piece. At rest dry friction is set-valued: the axis leaves only if the push
exceeds the level, and until then its position does not change by one bit.
"""

# ruff: noqa: C901, PLR0913 - one compiled loop; calls are split where numba inlines them
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from numba import njit

if TYPE_CHECKING:

    def taylor(y: float, v: float, t: float, u: float, d: float, p: Any) -> tuple[float, float, float]:
        """Acceleration, jerk and snap while moving in direction `d`."""

    def breakaway(y: float, v: float, t: float, u: float, d: float, p: Any) -> tuple[float, float]:
        """Push and friction level."""


# --- kernel ---
HALF, SIXTH, TWENTYFOURTH = 1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0
SMOOTH, SHORTEST, MOST_PIECES = 1.2e-4, 1e-3, 4096


@njit
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


@njit
def advance(y: float, v: float, t: float, h: float, u: float, p: Any) -> tuple[float, float]:
    """Carry position and velocity over `h` seconds under the held input `u`."""
    left = h
    for _ in range(MOST_PIECES):
        if v == 0.0:
            push, level = breakaway(y, 0.0, t, u, 1.0, p)
            d = 1.0
            if push < 0.0:
                d = -1.0
                push, level = breakaway(y, 0.0, t, u, -1.0, p)
            if push * d <= level:
                return y, 0.0
        elif v > 0.0:
            d = 1.0
        else:
            d = -1.0
        a, j, s = taylor(y, v, t, u, d, p)
        part = left
        while abs(s) * part * part > SMOOTH * (abs(a) + 2.0 * abs(v) / part) and part > SHORTEST * h:
            part *= 0.5
        after = v + part * (a + part * (HALF * j + part * SIXTH * s))
        if after * d > 0.0:
            y += part * (v + part * (HALF * a + part * (SIXTH * j + part * TWENTYFOURTH * s)))
            v = after
            if part == left:
                return y, v
            t += part
            left -= part
            continue
        if v == 0.0:
            if a * d <= 0.0:
                return y, 0.0
            tau = reversal_time(a, HALF * j, SIXTH * s, 0.0, part)
        else:
            tau = reversal_time(v, a, HALF * j, SIXTH * s, part)
        y += tau * (v + tau * (HALF * a + tau * (SIXTH * j + tau * TWENTYFOURTH * s)))
        v = 0.0
        t += tau
        left -= tau
        if left <= 0.0:
            return y, 0.0
    return y, v


@njit
def run(
    time: Any,
    held: Any,
    reference: Any,
    loop: Any,
    start: Any,
    p: Any,
    substeps: int,
    position: Any,
    velocity: Any,
    voltage: Any,
    measured: Any,
) -> None:
    """Fill `position`, `velocity`, `voltage` and `measured` at each sample.

    `loop` is (closed, kp, kd, filter, window, on error, own velocity, samples a period, resolution, period [s]).
    Without a closed loop the input is `held`; with one, `held` is added to what the controller asks for.
    """
    closed, kp, kd, share = loop[0] != 0.0, loop[1], loop[2], loop[3]
    window, on_error, own_velocity = int(loop[4]), loop[5] != 0.0, loop[6] != 0.0
    ratio, resolution, period = int(loop[7]), loop[8], loop[9]
    y, v = start[0], start[1]
    derivative = 0.0
    asked = 0.0
    n = time.size
    for k in range(n):
        position[k] = y
        velocity[k] = v
        seen = y
        if resolution > 0.0:
            seen = math.floor(y / resolution + 0.5) * resolution
        measured[k] = seen
        if closed:
            if k % ratio == 0:
                error = reference[k] - seen
                if own_velocity:
                    raw = v
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
        if k + 1 < n:
            h = (time[k + 1] - time[k]) / substeps
            t = time[k]
            for i in range(substeps):
                y, v = advance(y, v, t + i * h, h, u, p)
