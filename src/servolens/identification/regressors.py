"""Columns of the integral equation, derived from the effects' physics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, final

import casadi as ca
import numpy as np

from servolens.dynamics import dynamics
from servolens.effects import DryFriction, Force
from servolens.identification.elementwise import Elementwise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.effects import Effect

__all__ = ["Regressor", "regressor"]


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
    _columns: Elementwise | None

    def columns(
        self, time: NDArray[np.float64], position: NDArray[np.float64], velocity: NDArray[np.float64], *shapes: float
    ) -> NDArray[np.float64]:
        """Return φ for each size, shape ``(sizes, n)``: the force per unit of that size at measured signals."""
        if self._columns is None:
            return np.empty((0, time.size))
        return self._columns([position, velocity, time, np.sign(velocity)], shapes)


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
    function = Elementwise(ca.Function("columns", arguments, [ca.densify(columns)]), len(arguments) - len(shapes))
    return Regressor(sizes=tuple(names[i] for i in sizes), shapes=tuple(names[i] for i in shapes), _columns=function)
