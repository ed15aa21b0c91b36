"""Products fused into sums: rounded once where the processor can, and the same way whatever stands around them."""

from __future__ import annotations

import ctypes
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import pytest

from servolens.simulation.contraction import fused
from servolens.simulation.machine import loaded, object_code

if TYPE_CHECKING:
    from collections.abc import Callable

SUMS = {
    "a b + c": ("fadd", "%m, %c", lambda a, b, c: a * b + c),
    "c + a b": ("fadd", "%c, %m", lambda a, b, c: a * b + c),
    "a b - c": ("fsub", "%m, %c", lambda a, b, c: a * b - c),
    "c - a b": ("fsub", "%c, %m", lambda a, b, c: c - a * b),
}


def function_of(body: str) -> Callable[[float, float, float], float]:
    """Compile a function of the doubles a, b and c."""
    text = f"define double @tried(double %a, double %b, double %c) {{\n{body}}}\n"
    engine = loaded(object_code([fused(text)], {"tried"}))
    call = ctypes.CFUNCTYPE(ctypes.c_double, *[ctypes.c_double] * 3)(engine.get_function_address("tried"))
    call.owner = engine  # type: ignore[attr-defined]  # it owns the machine code
    return call


@pytest.mark.parametrize("name", SUMS)
def test_a_product_and_its_sum_are_rounded_once_or_twice_everywhere(name: str) -> None:
    operation, given, formula = SUMS[name]
    once = function_of(
        f"  %m = fmul contract double %a, %b\n  %s = {operation} contract double {given}\n  ret double %s\n"
    )
    random = np.random.default_rng(0)
    for a, b in random.normal(size=(200, 2)).tolist():
        c = a * b * (1.0 if name.endswith("- c") or name.startswith("c -") else -1.0)  # leaves the product's rounding
        exact = float(formula(Fraction(a), Fraction(b), Fraction(c)))
        assert once(a, b, c) in (exact, formula(a, b, c))
        assert abs(once(a, b, c)) == abs(once(b, a, c))


def test_a_product_that_is_used_twice_is_rounded_by_itself() -> None:
    body = """  %m = fmul contract double %a, %b
  %s = fadd contract double %m, %c
  %t = fsub contract double %m, %s
  ret double %t
"""
    found = function_of(body)
    for a, b, c in np.random.default_rng(0).normal(size=(200, 3)).tolist():
        assert found(a, b, c) == a * b - (a * b + c)


def test_nothing_is_left_for_the_compiler_to_fuse() -> None:
    text = "define double @f(double %a) {\n  %m = fmul contract double %a, %a\n  ret double %m\n}\n"
    assert "contract" not in fused(text)
