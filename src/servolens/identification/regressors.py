"""Columns of the integral equation, derived from the effects' physics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import casadi as ca
import numpy as np

from servolens.dynamics import dynamics
from servolens.effects import DryFriction, Force

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect

__all__ = ["Regressor", "regressor"]

CHUNK = 1024


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regressor:
    """How an effect enters the integral equation.

    Attributes
    ----------
    sizes : tuple of str
        Parameters in which the effect's force is linear: each gives a column.
    shapes : tuple of str
        The others: they bend the columns and are searched for.
    """

    sizes: tuple[str, ...]
    shapes: tuple[str, ...]
    _columns: Any

    def columns(
        self, time: NDArray[np.float64], position: NDArray[np.float64], velocity: NDArray[np.float64], *shapes: float
    ) -> NDArray[np.float64]:
        """Return φ for each size, shape ``(sizes, n)``: the force per unit of that size at measured signals."""
        return _evaluate(self._columns, [position, velocity, time, np.sign(velocity)], shapes, len(self.sizes))


def _evaluate(
    chunked: Any, signals: list[NDArray[np.float64]], shapes: Sequence[float], rows: int
) -> NDArray[np.float64]:
    """Run a function of :func:`_elementwise` along the signals, without copies through CasADi's own matrices."""
    n = signals[0].size
    result = np.empty((rows, n))
    buffer, run = chunked.buffer()
    part, out, values = np.zeros((len(signals), CHUNK)), np.empty((rows, CHUNK)), np.array(shapes, dtype=float)
    for i, row in enumerate((*part, *values.reshape(-1, 1))):
        buffer.set_arg(i, row.data)
    buffer.set_res(0, out.data)
    for first in range(0, n, CHUNK):
        count = min(CHUNK, n - first)
        for row, signal in zip(part, signals, strict=True):
            row[:count] = signal[first : first + count]
        run()
        result[:, first : first + count] = out[:, :count]
    return result


def _elementwise(program: Any, signals: int) -> Any:
    """Return the CasADi function of scalars as one of vectors: its first `signals` inputs, and each output's column.

    One operation then runs along a whole vector, a tenth of the time of one sample after the other.
    """
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
    return ca.Function(program.name(), inputs, [ca.horzcat(*columns)])


@lru_cache(maxsize=64)
def regressor(effect: type[Effect]) -> Regressor:
    """Return the regressor of an `effect`: of a force or of dry friction; without columns of any other.

    Friction that depends on the command has none either: its force hangs on the gain too, which is not known yet.

    Which parameters are sizes is found from the expression itself: those in which it is jointly linear.
    """
    d = dynamics((effect,))
    command_free = ca.substitute(d.acceleration, d.command, ca.SX(0))
    base = ca.substitute(command_free, d.parameters[:2], ca.SX.zeros(2))
    force = -base
    names = [spec.name for spec in effect.parameters()]
    if not issubclass(effect, Force | DryFriction) or effect.states or ca.depends_on(d.level, d.command):
        return Regressor(sizes=(), shapes=tuple(names), _columns=None)
    symbols = [d.parameters[2 + i] for i in range(len(names))]
    sizes: list[int] = []
    for i in (i for i, spec in enumerate(effect.parameters()) if spec.usual is None):
        together = ca.vertcat(*(symbols[k] for k in [*sizes, i]))
        if bool(ca.is_linear(force, together)):
            sizes.append(i)
    if not sizes:
        return Regressor(sizes=(), shapes=tuple(names), _columns=None)
    shapes = [i for i in range(len(names)) if i not in sizes]
    columns = ca.vertcat(*(ca.gradient(force, symbols[i]) for i in sizes))
    placeholders = [ca.SX.sym(names[i]) for i in shapes]
    if shapes:
        columns = ca.substitute(columns, ca.vertcat(*(symbols[i] for i in shapes)), ca.vertcat(*placeholders))
    arguments = [d.position, d.velocity, d.time, d.direction, *placeholders]
    function = _elementwise(ca.Function("columns", arguments, [ca.densify(columns)]), len(arguments) - len(shapes))
    return Regressor(sizes=tuple(names[i] for i in sizes), shapes=tuple(names[i] for i in shapes), _columns=function)
