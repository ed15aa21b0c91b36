"""The digital controller inside the compiled simulation; its settings stand in one array of numbers.

Numba turns this module into LLVM's language together with :mod:`servolens.simulation.stepping`.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

from typing import Any

from numba import float64, int64, njit, types

from servolens.simulation.elementary import OPTIONS

__all__ = ["MOVED", "applied_before", "asked", "law_beyond_pd"]

CLOSED, KP, KD, FILTER, WINDOW, ON_ERROR, OWN_VELOCITY, RATIO, PERIOD, MEASURES_TIME, RESOLUTION = range(11)
MOST_PIECES_GRANTED, IS_KNOWN_BEFORE, BEFORE, CORRECTS, COARSE, SHAKING_LEFT = range(11, 17)
KI, INTEGRAL_RATE, WEIGHT, FORWARD, LIMIT, CLAMPS, PULL, INTEGRAL_BEFORE = range(17, 25)
IS_PD, MOVED = 25, 26
"""Whether the law is nothing but kp and kd; where it begins to stand which states an observer moves."""
SHAKEN = 2.0
"""Of what corrects the motion: no observer, but an acceleration that shakes the axis, and an error of the sensor."""
HELD = 1e99
"""In the place of an observer's gain of the velocity: the axis rests."""
_NUMBERS = types.CPointer(float64)
BEYOND_PD = float64(int64, float64, float64, float64, _NUMBERS, _NUMBERS, _NUMBERS, _NUMBERS)
beyond_pd = types.ExternalFunction("servolens_beyond_pd", BEYOND_PD)
"""The law below as a call: written out, it would slow down the loops that do without it."""


@njit(**OPTIONS)
def asked(  # noqa: PLR0913 - every array is an argument
    k: int,
    seen: float,
    speed: float,
    time: Any,
    reference: Any,
    measured: Any,
    held: Any,
    loop: Any,
    derivative: Any,
    integral: Any,
    is_pd: bool,
) -> float:
    """Return what the digital controller asks for at sample `k` beside what is `held`; carry its memories along."""
    window, ratio, step = int(loop[WINDOW]), int(loop[RATIO]), loop[PERIOD]
    span = window * step
    if loop[MEASURES_TIME] != 0.0:
        step = time[k] - time[k - ratio] if k >= ratio else step
        span = time[k] - time[k - window * ratio] if k >= window * ratio else span
    if loop[OWN_VELOCITY] != 0.0:
        raw = speed
    else:
        past = max(k - window * ratio, 0)
        raw = (seen - measured[past]) / span
        if loop[ON_ERROR] != 0.0:
            raw -= (reference[k] - reference[past]) / span
    derivative[0] += loop[FILTER] * (raw - derivative[0])
    command: float = loop[KP] * (reference[k] - seen) - loop[KD] * derivative[0]
    return command if is_pd else beyond_pd(k, step, command, reference[k] - seen, reference, held, loop, integral)


def law_beyond_pd(
    k: int, step: float, command: float, error: float, reference: Any, held: Any, loop: Any, integral: Any
) -> float:
    """Return the command of a law that has more than kp and kd, and keep its integral from running away."""
    command += loop[KP] * (loop[WEIGHT] - 1.0) * reference[k]
    command += loop[FORWARD] * (reference[k] - reference[max(k - int(loop[RATIO]), 0)]) / step
    limit, state = loop[LIMIT], integral[0]
    growth = step * (loop[KI] * error + loop[INTEGRAL_RATE] * command)
    total = command + state + growth + held[k]
    if not (loop[CLAMPS] != 0.0 and abs(total) > limit and growth * total > 0.0):
        state += growth
    total = command + state + held[k]
    integral[0] = state + step * loop[PULL] * (min(max(total, -limit), limit) - total)
    answer: float = command + state
    return answer


@njit(**OPTIONS)
def applied_before(held: float, reference: float, position: float, loop: Any) -> float:
    """Return what was applied before the first sample: what is known of it, or what is asked for first, at rest."""
    if loop[IS_KNOWN_BEFORE] != 0.0:
        return loop[BEFORE]
    if loop[CLOSED] == 0.0:
        return held
    command: float = loop[KP] * (loop[WEIGHT] * reference - position)
    growth = loop[KI] * (reference - position) + loop[INTEGRAL_RATE] * command
    return held + command + loop[INTEGRAL_BEFORE] + loop[PERIOD] * growth
