"""The digital controller inside the compiled simulation; its settings stand in one array of numbers.

Numba turns this module into LLVM's language together with :mod:`servolens.simulation.stepping`.
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

from typing import Any

from numba import njit

from servolens.simulation.elementary import OPTIONS

__all__ = ["MEMORY", "MOVED", "asked"]

CLOSED, KP, KD, FILTER, WINDOW, ON_ERROR, OWN_VELOCITY, RATIO, PERIOD, RESOLUTION = range(10)
MOST_PIECES_GRANTED, IS_KNOWN_BEFORE, BEFORE, CORRECTS, COARSE, SHAKING_LEFT = range(10, 16)
KI, INTEGRAL_RATE, WEIGHT, FORWARD, LIMIT, CLAMPS, PULL, INTEGRAL_BEFORE = range(16, 24)
MOVED = 24
"""Where in the settings it begins to stand which states an observer moves."""
DERIVATIVE, INTEGRAL = 0, 1
MEMORY = 2
"""Numbers that a controller remembers."""


@njit(**OPTIONS)
def asked(k: int, seen: float, speed: float, reference: Any, measured: Any, held: Any, loop: Any, memory: Any) -> float:
    """Return what the digital controller asks for at sample `k` beside what is `held`; carry its memory along."""
    window, ratio, period = int(loop[WINDOW]), int(loop[RATIO]), loop[PERIOD]
    if loop[OWN_VELOCITY] != 0.0:
        raw = speed
    else:
        past = max(k - window * ratio, 0)
        raw = (seen - measured[past]) / (window * period)
        if loop[ON_ERROR] != 0.0:
            raw -= (reference[k] - reference[past]) / (window * period)
    memory[DERIVATIVE] += loop[FILTER] * (raw - memory[DERIVATIVE])
    command: float = loop[KP] * (loop[WEIGHT] * reference[k] - seen) - loop[KD] * memory[DERIVATIVE]
    if loop[FORWARD] != 0.0:
        command += loop[FORWARD] * (reference[k] - reference[max(k - ratio, 0)]) / period
    if loop[KI] != 0.0 or loop[INTEGRAL_RATE] != 0.0 or memory[INTEGRAL] != 0.0:
        growth = period * (loop[KI] * (reference[k] - seen) + loop[INTEGRAL_RATE] * command)
        total = command + memory[INTEGRAL] + growth + held[k]
        if not (loop[CLAMPS] != 0.0 and abs(total) > loop[LIMIT] and growth * total > 0.0):
            memory[INTEGRAL] += growth
        total = command + memory[INTEGRAL]
        excess = min(max(total + held[k], -loop[LIMIT]), loop[LIMIT]) - (total + held[k])
        memory[INTEGRAL] += loop[PULL] * excess
        return total
    return command
