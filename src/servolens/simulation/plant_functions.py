"""What a plant gives the stepping rule: its functions and counts, declared, and the layout of the state they read.

:mod:`servolens.simulation.native` compiles them for each structure and joins them with the rule, which numba turns into
LLVM's language once.

The arrays: `x` is [y, v, t, u, d, moving, shaking, smooth states, relaxing states, their ramps], where `shaking` is an
acceleration that an observer holds from sample to sample; `p` holds the plant's parameters; a series is [acceleration,
jerk, snap, damping, then three derivatives of each smooth state].
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

from numba import float64, int64, types
from numba.extending import intrinsic

__all__ = [
    "FUNCTIONS",
    "NUMBERS",
    "POINTER",
    "beginning",
    "breakaway",
    "contacts",
    "drifts",
    "kinked",
    "kinks",
    "numbers",
    "parameters",
    "relaxation",
    "relaxing_states",
    "shown",
    "smooth_states",
    "taylor",
]

SERIES = 4
"""Where the derivatives of the smooth states begin in a series."""
Y, V, T, U, D, MOVING, SHAKING, STATES = 0, 1, 2, 3, 4, 5, 6, 7
"""Places in `x`; the states of the effects begin at the last."""

POINTER = types.CPointer(float64)
"""The type of all arrays of the rule."""


def _number_of(what: str) -> Any:
    return types.ExternalFunction(f"servolens_{what}", int64())


def _plant(name: str) -> Any:
    return types.ExternalFunction(f"servolens_{name}", types.int64(POINTER, POINTER, POINTER))


NUMBERS = ("parameters", "smooth", "relaxing", "drifts", "kinks", "contacts")
"""Names of the counts, each a function without arguments."""
FUNCTIONS = ("taylor", "breakaway", "relaxation", "kinked", "shown", "beginning")
"""Names of the functions of (x, p, output)."""
parameters, smooth_states, relaxing_states, drifts, kinks, contacts = map(_number_of, NUMBERS)
taylor, breakaway, relaxation, kinked, shown, beginning = map(_plant, FUNCTIONS)


@intrinsic
def numbers(context: Any, size: Any) -> Any:
    """Return room for `size` numbers on the stack."""
    from llvmlite import ir

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.alloca(ir.DoubleType(), size=arguments[0])

    return POINTER(types.int64), code
