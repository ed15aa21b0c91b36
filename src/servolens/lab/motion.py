"""Motion of virtual axes under a held command: Runge–Kutta steps, split exactly where the velocity reverses.

Within a step the direction of motion is fixed, so that |v| and dry friction are smooth and the fourth order holds; the
reversal is found as the root of the step itself, to rounding. There the axis either sticks, and then does not move by
one bit, or leaves with the push. One run is carried in plain floats, many runs in arrays; the step is the same code.

The state is a tuple ``(position, velocity, …)``; further components are for effects with a memory.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.lab.laws import LAWS, Instant

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.truth import Truth

    State = tuple[Any, ...]

__all__ = ["Axis", "advance_many", "advance_one"]

MOST_ROOT_STEPS = 60
REST = 1e-15
"""A reversal is found when the speed there is below this [m/s or rad/s]."""


@final
class Axis:
    """The equations of a truth, for one run (``m = math``) or many at once (``m = numpy``)."""

    def __init__(self, truth: Truth, m: Any) -> None:
        self._gain, self._damping, self._m = truth.gain, truth.damping, m
        parts = [(LAWS[name], SimpleNamespace(**truth.effects[name])) for name in LAWS if name in truth.effects]
        self._forces, self._frictions, self._commands = (
            [(law.function, p) for law, p in parts if law.kind == kind] for kind in ("force", "friction", "command")
        )

    def command(self, asked: Any) -> Any:
        """Return what the actuator makes of the held command [V]."""
        for function, p in self._commands:
            asked = function(asked, p, self._m)
        return asked

    def push(self, t: float, state: State, u: Any, d: Any) -> tuple[Any, Any]:
        """Return the acceleration without dry friction and the level of dry friction, in direction `d`."""
        position, velocity = state[0], state[1]
        instant = Instant(position, velocity, d * velocity, d, t)
        push = self._gain * u - self._damping * velocity
        for function, p in self._forces:
            push = push - function(instant, p, self._m)
        level = 0.0
        for function, p in self._frictions:
            level = level + function(instant, p, self._m)
        return push, level

    def rates(self, t: float, state: State, u: Any, d: Any) -> State:
        """Return the time derivative of the state while moving in direction `d`."""
        push, level = self.push(t, state, u, d)
        return state[1], push - d * level


def advance_one(axis: Axis, t: float, state: State, h: float, u: float) -> State:
    """Carry one run over `h` seconds."""
    start = state[1]
    d = math.copysign(1.0, start) if start != 0.0 else _departure(axis, t, state, u)
    if d == 0.0:
        return state
    new = _runge_kutta(axis, t, state, h, u, d)
    if new[1] * d > 0.0:
        return new
    if start == 0.0:
        return state
    tau = _reversal(lambda share: d * _runge_kutta(axis, t, state, share, u, d)[1], d * start, d * new[1], h)
    x, _, *rest = _runge_kutta(axis, t, state, tau, u, d)
    turned = (x, 0.0, *rest)
    d = _departure(axis, t + tau, turned, u)
    if d == 0.0:
        return turned
    new = _runge_kutta(axis, t + tau, turned, h - tau, u, d)
    return new if new[1] * d > 0.0 else turned


def advance_many(axis: Axis, t: float, state: State, h: float, u: Any) -> State:
    """Carry many runs, one an element, over `h` seconds; the same steps as :func:`advance_one`."""
    start = state[1]
    d = np.sign(start)
    resting = d == 0.0
    if resting.any():
        d = np.where(resting, _departures(axis, t, state, u), d)
    new = _runge_kutta(axis, t, state, h, u, d)
    moving = new[1] * d > 0.0
    if moving.all():
        return new
    new = tuple(np.where(moving, after, before) for after, before in zip(new, state, strict=True))
    lanes = np.flatnonzero(~moving & ~resting)
    if lanes.size:
        turned = _turn_many(axis, t, tuple(part[lanes] for part in state), h, u[lanes], d[lanes])
        for part, values in zip(new, turned, strict=True):
            part[lanes] = values
    return new


def _turn_many(axis: Axis, t: float, state: State, h: float, u: Any, d: Any) -> State:
    """Carry runs that all reverse within `h` seconds."""

    def ahead(share: Any) -> Any:
        return d * _runge_kutta(axis, t, state, share, u, d)[1]

    tau = _reversals(ahead, d * state[1], ahead(h), h)
    x, v, *rest = _runge_kutta(axis, t, state, tau, u, d)
    turned = (x, np.zeros_like(v), *rest)
    d = _departures(axis, t + tau, turned, u)
    new = _runge_kutta(axis, t + tau, turned, h - tau, u, d)
    leaves = new[1] * d > 0.0
    return tuple(np.where(leaves, after, before) for after, before in zip(new, turned, strict=True))


def _departure(axis: Axis, t: float, state: State, u: float) -> float:
    """Return the direction in which an axis at rest leaves, 0 where dry friction holds it."""
    for d in (1.0, -1.0):
        push, level = axis.push(t, state, u, d)
        if d * push > level:
            return d
    return 0.0


def _departures(axis: Axis, t: Any, state: State, u: Any) -> Any:
    push, level = axis.push(t, state, u, 1.0)
    down, level_down = axis.push(t, state, u, -1.0)
    return np.where(push > level, 1.0, np.where(-down > level_down, -1.0, 0.0))


def _runge_kutta(axis: Axis, t: Any, state: State, h: Any, u: Any, d: Any) -> State:
    """One classical step of fourth order (Hairer, Nørsett, Wanner, Solving ODEs I, table II.1.2)."""
    half = 0.5 * h
    k1 = axis.rates(t, state, u, d)
    k2 = axis.rates(t + half, tuple([s + half * k for s, k in zip(state, k1, strict=True)]), u, d)
    k3 = axis.rates(t + half, tuple([s + half * k for s, k in zip(state, k2, strict=True)]), u, d)
    k4 = axis.rates(t + h, tuple([s + h * k for s, k in zip(state, k3, strict=True)]), u, d)
    sixth = h / 6.0
    return tuple([s + sixth * (a + 2.0 * (b + c) + e) for s, a, b, c, e in zip(state, k1, k2, k3, k4, strict=True)])


def _reversal(speed: Callable[[float], float], first: float, last: float, h: float) -> float:
    """Return the root of `speed` in (0, h], positive at 0: regula falsi, a stale end halved (Illinois)."""
    low, high, side = 0.0, h, 0
    for _ in range(MOST_ROOT_STEPS):
        tau = (low * last - high * first) / (last - first)
        value = speed(tau)
        if abs(value) <= REST or not low < tau < high:
            break
        if value > 0.0:
            low, first, last, side = tau, value, last * (0.5 if side > 0 else 1.0), 1
        else:
            high, last, first, side = tau, value, first * (0.5 if side < 0 else 1.0), -1
    return tau


def _reversals(speed: Callable[[Any], Any], first: Any, last: Any, h: float) -> Any:
    """Return the root of each run; see :func:`_reversal`."""
    low, high, side = np.zeros_like(first), np.full_like(first, h), np.zeros_like(first)
    for _ in range(MOST_ROOT_STEPS):
        tau = (low * last - high * first) / (last - first)
        value = speed(tau)
        going = (np.abs(value) > REST) & (low < tau) & (tau < high)
        if not going.any():
            break
        ahead, behind = going & (value > 0.0), going & (value <= 0.0)
        low, high = np.where(ahead, tau, low), np.where(behind, tau, high)
        first, last = (
            np.where(ahead, value, np.where(behind & (side < 0), 0.5 * first, first)),
            np.where(behind, value, np.where(ahead & (side > 0), 0.5 * last, last)),
        )
        side = np.where(ahead, 1.0, np.where(behind, -1.0, side))
    return tau
