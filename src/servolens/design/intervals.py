"""Interval arithmetic on CasADi's expressions, rounded outwards, for many boxes at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Interval = tuple[Any, Any]

__all__ = ["IntervalFunction"]


@final
class IntervalFunction:
    """A function of CasADi with one input and one dense output, evaluated over boxes.

    Parameters
    ----------
    inputs, output : casadi.SX
        Column of symbols, and what is computed from them.

    Raises
    ------
    InputError
        If it holds an operation that is not smooth, or not known here.
    """

    def __init__(self, inputs: Any, output: Any) -> None:
        import casadi as ca

        function = ca.Function("f", [inputs], [ca.densify(ca.vec(output))])
        self.size = function.numel_out(0)
        self._work = function.sz_w()
        binary = {ca.OP_ADD: _add, ca.OP_SUB: _subtract, ca.OP_MUL: _multiply, ca.OP_DIV: _divide}
        unary = {ca.OP_NEG: _negative, ca.OP_SQ: _square, ca.OP_EXP: _exponential, ca.OP_INV: _inverse}
        unary |= {ca.OP_TWICE: lambda a: (2.0 * a[0], 2.0 * a[1]), ca.OP_ASSIGN: lambda a: a}
        self._steps: list[tuple[str, Any, list[int], int]] = []
        for k in range(function.n_instructions()):
            code, given, kept = (
                function.instruction_id(k),
                function.instruction_input(k),
                function.instruction_output(k),
            )
            if code == ca.OP_CONST:
                self._steps.append(("constant", function.instruction_constant(k), [], kept[0]))
            elif code == ca.OP_INPUT:
                self._steps.append(("input", None, [given[1]], kept[0]))
            elif code == ca.OP_OUTPUT:
                self._steps.append(("output", None, given, kept[1]))
            elif code in binary or code in unary:
                self._steps.append(("call", {**binary, **unary}[code], given, kept[0]))
            else:
                raise InputError("an effect of this plant is not smooth, or not known to the interval arithmetic")

    def __call__(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return lower and upper bounds, shape (outputs, boxes), over boxes of shape (inputs, boxes)."""
        work: list[Any] = [None] * self._work
        below, above = np.zeros((self.size, low.shape[1])), np.zeros((self.size, low.shape[1]))
        for kind, what, given, kept in self._steps:
            if kind == "constant":
                work[kept] = (what, what)
            elif kind == "input":
                work[kept] = (low[given[0]], high[given[0]])
            elif kind == "output":
                below[kept], above[kept] = work[given[0]]
            else:
                work[kept] = what(*(work[i] for i in given))
        return below, above


def _out(low: Any, high: Any) -> Interval:
    return np.nextafter(low, -np.inf), np.nextafter(high, np.inf)


def _add(a: Interval, b: Interval) -> Interval:
    return _out(a[0] + b[0], a[1] + b[1])


def _subtract(a: Interval, b: Interval) -> Interval:
    return _out(a[0] - b[1], a[1] - b[0])


def _negative(a: Interval) -> Interval:
    return -a[1], -a[0]


def _multiply(a: Interval, b: Interval) -> Interval:
    if not isinstance(a[0], np.ndarray):
        a, b = b, a
    if not isinstance(b[0], np.ndarray) and b[0] == b[1]:
        one, other = a[0] * b[0], a[1] * b[0]
        return _out(one, other) if b[0] >= 0 else _out(other, one)
    products = (a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1])
    low = np.minimum(np.minimum(products[0], products[1]), np.minimum(products[2], products[3]))
    high = np.maximum(np.maximum(products[0], products[1]), np.maximum(products[2], products[3]))
    return _out(low, high)


def _inverse(a: Interval) -> Interval:
    with np.errstate(divide="ignore"):
        low, high = _out(1.0 / np.asarray(a[1]), 1.0 / np.asarray(a[0]))
    holds_zero = (np.asarray(a[0]) <= 0.0) & (np.asarray(a[1]) >= 0.0)
    return np.where(holds_zero, -np.inf, low), np.where(holds_zero, np.inf, high)


def _divide(a: Interval, b: Interval) -> Interval:
    return _multiply(a, _inverse(b))


def _square(a: Interval) -> Interval:
    one, other = a[0] * a[0], a[1] * a[1]
    crosses = (np.asarray(a[0]) <= 0.0) & (np.asarray(a[1]) >= 0.0)
    low, high = _out(np.where(crosses, 0.0, np.minimum(one, other)), np.maximum(one, other))
    return np.maximum(low, 0.0), high


def _exponential(a: Interval) -> Interval:
    """Return the bounds; the C library's exponential is taken to be right within four units of the last place."""
    with np.errstate(over="ignore"):
        return np.exp(a[0]) * (1.0 - 1e-15), np.exp(a[1]) * (1.0 + 1e-15)
