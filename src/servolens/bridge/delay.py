"""A delay as states: Padé's approximation as what a polynomial remembers of the command."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

__all__ = ["HIGHEST_ORDER", "delay_line", "settled"]

HIGHEST_ORDER = 10


def delay_line(command: Any, history: Any, delay: Any) -> tuple[Any, Any]:
    """Return the command after `delay`, and the rates of `history`, of expressions.

    The history of the command over the last `delay` seconds is a sum of shifted Legendre polynomials of its age; the
    states are the coefficients of the first n, the last one follows from the command itself (Legendre's tau method for
    the transport equation). From command to delayed command this is Padé's [n/n] approximation of e^(−sτ), that of
    ``control.pade(τ, n)``: its gain is 1 at all frequencies, its phase right up to about n/τ rad/s (to 4° for n = 1,
    better above). At a jump its output jumps too, for odd n the wrong way. A delay of 0 passes the command on.

    Parameters
    ----------
    command, delay : casadi.SX
        Scalars, delay [s].
    history : casadi.SX, shape (n, 1)
        In the command's unit; n may be 0, for no delay.
    """
    order = history.numel()
    if order == 0:
        return command, ca.SX(0, 1)
    signs = (-1.0) ** np.arange(order)
    newest = (-1.0) ** order * (command - ca.dot(ca.DM(signs), history))
    whole = ca.vertcat(history, newest)
    flow = np.zeros((order, order + 1))
    for i in range(order):
        flow[i, i + 1 :: 2] = -2.0 * (2 * i + 1)
    late = ca.if_else(delay > 0, ca.sum1(whole), command)
    return late, ca.if_else(delay > 0, ca.mtimes(ca.DM(flow), whole) / ca.fmax(delay, 1e-300), 0)


def settled(command: Any, order: int) -> Any:
    """Return the history of a command that has been there for ever."""
    return ca.vertcat(command, ca.SX.zeros(order - 1)) if order else ca.SX(0, 1)
