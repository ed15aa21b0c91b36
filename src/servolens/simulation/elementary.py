"""exp, sin and cos for the compiled simulation: as exact as the C library's within a unit or two of the last place.

Written out, LLVM merges them into the equation of motion: no call, and sin and cos of one angle share their work. Numba
turns this module into LLVM's language together with :mod:`servolens.simulation.stepping`.

References
----------
.. [1] Cody and Waite, Software Manual for the Elementary Functions, 1980: the reductions in parts of π/2 and ln 2.
.. [2] FDLIBM 5.3, Sun Microsystems, ``k_sin.c`` and ``k_cos.c``: the polynomials on [−π/4, π/4].
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math
from typing import Any

from numba import float64, njit, types
from numba.extending import intrinsic

__all__ = ["cosine", "exponential", "sine"]

OPTIONS = {"forceinline": True, "error_model": "numpy", "fastmath": {"contract"}}
ROUND = (
    6755399441055744.0  # 1.5·2⁵², added and subtracted: rounds to a whole number, which then stands in the last bits
)
LOWEST, HIGHEST = -708.0, 709.0  # where eˣ stays a normal number
FARTHEST = 1e5  # [rad], farther out the C library is asked


# the C library's, in a form that LLVM leaves in its branch
far_sine, far_cosine = (types.ExternalFunction(name, float64(float64)) for name in ("sin", "cos"))


@intrinsic
def bits(context: Any, value: Any) -> Any:
    """Return the bits of a float64 as an int64."""

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], target.get_value_type(types.int64))

    return types.int64(types.float64), code


@intrinsic
def number(context: Any, value: Any) -> Any:
    """Return the float64 that has these bits."""

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], target.get_value_type(types.float64))

    return types.float64(types.int64), code


@njit(**OPTIONS)
def exponential(x: float) -> float:
    """eˣ = 2ᵏ eʳ, |r| ≤ ln 2 / 2."""
    shifted = x * 1.4426950408889634 + ROUND
    k = shifted - ROUND
    r = (x - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + r2 * (1.0 / 2.0 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    last = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0)
    power = number((bits(shifted) + 1023) << 52)
    value = power * ((low + r4 * middle) + (r4 * r4) * (high + r4 * last))
    if x < LOWEST:
        return 0.0
    return value if x <= HIGHEST else x * math.inf  # NaN stays NaN


@njit(**OPTIONS)
def _quarter(x: float) -> tuple[int, float, float]:
    """Return how many quarter turns x is, modulo 4 in the last two bits, and sine and cosine of the rest."""
    shifted = x * 6.36619772367581382433e-01 + ROUND
    k = shifted - ROUND
    r = (x - k * 1.57079632673412561417) - k * 6.07710050630396597660e-11
    z = r * r
    w = z * z
    s = (-1.66666666666666324348e-01 + z * 8.33333333332248946124e-03) + w * (
        (-1.98412698298579493134e-04 + z * 2.75573137070700676789e-06)
        + w * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
    )
    c = (4.16666666666666019037e-02 + z * -1.38888888888741095749e-03) + w * (
        (2.48015872894767294178e-05 + z * -2.75573143513906633035e-07)
        + w * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
    )
    return bits(shifted), r + r * z * s, (1.0 - 0.5 * z) + w * c


@njit(**OPTIONS)
def sine(x: float) -> float:
    """Sin x."""
    if not abs(x) < FARTHEST:
        return far_sine(x)
    turns, s, c = _quarter(x)
    return number(bits(c if turns & 1 else s) ^ ((turns & 2) << 62))


@njit(**OPTIONS)
def cosine(x: float) -> float:
    """Cos x."""
    if not abs(x) < FARTHEST:
        return far_cosine(x)
    turns, s, c = _quarter(x)
    return number(bits(s if turns & 1 else c) ^ (((turns + 1) & 2) << 62))
