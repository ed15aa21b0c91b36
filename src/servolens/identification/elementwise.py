"""A CasADi function of scalars along whole signals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["Elementwise"]

CHUNK = 1024
"""Samples on which one operation runs at once."""


@final
class Elementwise:
    """A function of scalars, each operation of which runs along a whole vector.

    That takes a tenth of the time of one sample after the other; and nothing is copied through CasADi's own matrices.

    Parameters
    ----------
    program : casadi.Function
        Of scalars, expanded to SX; one dense column is its output.
    signals : int
        How many of its inputs, the first ones, change from sample to sample; the others are parameters.
    """

    def __init__(self, program: Any, signals: int) -> None:
        inputs = [ca.MX.sym(program.name_in(i), CHUNK if i < signals else 1) for i in range(program.n_in())]
        held: dict[int, Any] = {}
        columns = [ca.MX.zeros(CHUNK) for _ in range(program.numel_out(0))]
        for k in range(program.n_instructions()):
            operation, target = program.instruction_id(k), program.instruction_output(k)
            source = program.instruction_input(k)
            if operation == ca.OP_INPUT:
                held[target[0]] = inputs[source[0]]
            elif operation == ca.OP_CONST:
                held[target[0]] = ca.MX(program.instruction_constant(k))
            elif operation == ca.OP_OUTPUT:
                columns[target[1]] += held[source[0]]
            elif len(source) == 1:
                held[target[0]] = ca.MX.unary(operation, held[source[0]])
            else:
                held[target[0]] = ca.MX.binary(operation, *(held[i] for i in source))
        self._function, self._rows = ca.Function(program.name(), inputs, [ca.horzcat(*columns)]), len(columns)

    def __call__(self, signals: Sequence[NDArray[np.float64]], values: Sequence[float]) -> NDArray[np.float64]:
        """Return the outputs, shape (rows, n), for `signals` of shape (n,) each and the `values` of the parameters."""
        n = signals[0].size
        result = np.empty((self._rows, n))
        buffer, run = self._function.buffer()
        part, out, fixed = np.zeros((len(signals), CHUNK)), np.empty((self._rows, CHUNK)), np.array(values, dtype=float)
        for i, row in enumerate((*part, *fixed.reshape(-1, 1))):
            buffer.set_arg(i, row.data)
        buffer.set_res(0, out.data)
        for first in range(0, n, CHUNK):
            count = min(CHUNK, n - first)
            for row, signal in zip(part, signals, strict=True):
                row[:count] = signal[first : first + count]
            run()
            result[:, first : first + count] = out[:, :count]
        return result
