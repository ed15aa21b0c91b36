"""The digital controller inside the compiled simulation; its settings stand in one array of numbers.

Numba turns this module into LLVM's language together with :mod:`servolens.simulation.stepping`.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

from typing import Any

from numba import float64, int64, njit, types

from servolens.simulation.elementary import OPTIONS

__all__ = ["MOVED", "applied_before", "asked", "law_beyond_pd"]

CLOSED, KP, KD, FILTER, WINDOW, ON_ERROR, OWN_VELOCITY, RATIO, PERIOD, RESOLUTION = range(10)
MOST_PIECES_GRANTED, IS_KNOWN_BEFORE, BEFORE, CORRECTS, COARSE, SHAKING_LEFT = range(10, 16)
KI, INTEGRAL_RATE, WEIGHT, FORWARD, LIMIT, CLAMPS, PULL, INTEGRAL_BEFORE = range(16, 24)
IS_PD, MOVED = 24, 25
"""Whether the law is nothing but kp and kd; where it begins to stand which states an observer moves."""
SHAKEN = 2.0
"""Of what corrects the motion: no observer, but an acceleration that shakes the axis, and an error of the sensor."""
_NUMBERS = types.CPointer(float64)
BEYOND_PD = float64(int64, float64, float64, _NUMBERS, _NUMBERS, _NUMBERS, _NUMBERS)
beyond_pd = types.ExternalFunction("servolens_beyond_pd", BEYOND_PD)
"""The law below as a call: written out, it would slow down the loops that do without it."""


@njit(**OPTIONS)
def asked(  # noqa: PLR0913 - every array is an argument
    k: int,
    seen: float,
    speed: float,
    reference: Any,
    measured: Any,
    held: Any,
    loop: Any,
    derivative: Any,
    integral: Any,
    is_pd: bool,
) -> float:
    """Return what the digital controller asks for at sample `k` beside what is `held`; carry its memories along."""
    window, ratio, period = int(loop[WINDOW]), int(loop[RATIO]), loop[PERIOD]
    if loop[OWN_VELOCITY] != 0.0:
        raw = speed
    else:
        past = max(k - window * ratio, 0)
        raw = (seen - measured[past]) / (window * period)
        if loop[ON_ERROR] != 0.0:
            raw -= (reference[k] - reference[past]) / (window * period)
    derivative[0] += loop[FILTER] * (raw - derivative[0])
    command: float = loop[KP] * (reference[k] - seen) - loop[KD] * derivative[0]
    return command if is_pd else beyond_pd(k, command, reference[k] - seen, reference, held, loop, integral)


def law_beyond_pd(k: int, command: float, error: float, reference: Any, held: Any, loop: Any, integral: Any) -> float:
    """Return the command of a law that has more than kp and kd, and keep its integral from running away."""
    command += loop[KP] * (loop[WEIGHT] - 1.0) * reference[k]
    command += loop[FORWARD] * (reference[k] - reference[max(k - int(loop[RATIO]), 0)]) / loop[PERIOD]
    limit, state = loop[LIMIT], integral[0]
    growth = loop[PERIOD] * (loop[KI] * error + loop[INTEGRAL_RATE] * command)
    total = command + state + growth + held[k]
    if not (loop[CLAMPS] != 0.0 and abs(total) > limit and growth * total > 0.0):
        state += growth
    total = command + state + held[k]
    integral[0] = state + loop[PULL] * (min(max(total, -limit), limit) - total)
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
