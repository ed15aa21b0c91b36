"""Motion of virtual axes under a command: Runge–Kutta steps, split exactly at every edge of the physics.

Within a step the mode is fixed (direction of motion, force limit, contact), so that all is smooth and the fourth order
holds. An edge is found as the root of the step itself, to rounding: a reversal, where the axis either sticks, and then
does not move by one bit, or leaves with the push; the instant at which a growing push breaks an axis at rest away; the
end of a force limit; the touch of a flank. One run is carried in plain floats, many in arrays, each run with steps of
its own; both take the same steps.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.lab.axis import Body, Mode

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.axis import Axis
    from servolens.lab.command import Signal

    State = tuple[Any, ...]

__all__ = ["advance_many", "advance_one", "lag_weights"]

MOST_ROOT_STEPS = 60
MOST_EDGES = 12
"""An axis that meets more edges than this within one step only grazes them, and is let pass."""
SMALLEST = 1e-15
"""A root is found when the guard there is below this [SI]."""


def advance_one(axis: Axis, t: float, length: float, body: Body, u: Signal) -> Body:
    """Carry one run over `length` seconds."""
    body = axis.enter(t, body, u)
    left, edges = length, 0
    while left > 0.0:
        if body.mode.direction == 0.0 and not axis.evolves_at_rest:
            return body
        h = left / math.ceil(left / axis.longest(t, body, u) - 1e-9)
        body, used, edges = _step_one(axis, t, h, body, u, edges)
        t, left = t + used, 0.0 if used == left else left - used
    return body


def _step_one(axis: Axis, t: float, h: float, body: Body, u: Signal, edges: int) -> tuple[Body, float, int]:
    """Return the axis after a step, or after the part of it before its first edge, with the time and edges passed."""
    new = _runge_kutta(axis, t, h, body, u)
    guards = axis.guards(t + h, new, body, u)
    if min(guards) >= 0.0:
        return _accepted(axis, body, new, h), h, 0
    if edges >= MOST_EDGES:
        body = _let_pass(axis, body)
        return _accepted(axis, body, _runge_kutta(axis, t, h, body, u), h), h, 0
    broken = [i for i, guard in enumerate(guards) if guard < 0.0]

    def margin(share: float) -> float:
        ahead = axis.guards(t + share, _runge_kutta(axis, t, share, body, u), body, u)
        return float(min([ahead[i] for i in broken]))

    now = axis.guards(t, body.state, body, u)
    first = min([now[i] for i in broken])
    tau = _root(margin, first, min([guards[i] for i in broken]), h) if first > 0.0 else 0.0
    if tau > 0.0:
        body = _accepted(axis, body, _runge_kutta(axis, t, tau, body, u), tau)
        now = axis.guards(t + tau, body.state, body, u)
    fired = min(broken, key=lambda i: now[i])
    return axis.cross(t + tau, body, u, fired), tau, edges + 1


def advance_many(axis: Axis, t: float, length: float, body: Body, u: Signal) -> Body:
    """Carry many runs, one an element, over `length` seconds; the same steps as :func:`advance_one`."""
    body = axis.enter(t, body, u)
    n = u.level.size
    clock, left, edges = np.full(n, t), np.full(n, length), np.zeros(n, dtype=np.int64)
    while True:
        lanes = np.flatnonzero(left > 0.0)
        if lanes.size == 0:
            return body
        whole = lanes.size == n
        part, signal = (body, u) if whole else (_take(body, lanes), u.take(lanes))
        h = left[lanes] / np.ceil(left[lanes] / axis.longest(clock[lanes], part, signal) - 1e-9)
        part, used, passed = _step_many(axis, clock[lanes], h, part, signal, edges[lanes])
        body = part if whole else _put(body, lanes, part)
        edges[lanes] = passed
        clock[lanes] += used
        left[lanes] = np.where(used == left[lanes], 0.0, left[lanes] - used)


def _step_many(axis: Axis, t: Any, h: Any, body: Body, u: Signal, edges: Any) -> tuple[Body, Any, Any]:
    """As :func:`_step_one`, each run by itself."""
    new = _runge_kutta(axis, t, h, body, u)
    guards = np.stack(np.broadcast_arrays(*axis.guards(t + h, new, body, u)))
    stopped = ~(guards.min(axis=0) >= 0.0)
    accepted = _accepted(axis, body, new, h)
    if not stopped.any():
        return accepted, h, np.zeros_like(edges)
    used, passed = h.copy(), np.zeros_like(edges)
    lanes = np.flatnonzero(stopped & (edges >= MOST_EDGES))
    if lanes.size:
        part, signal = _let_pass(axis, _take(body, lanes)), u.take(lanes)
        moved = _runge_kutta(axis, t[lanes], h[lanes], part, signal)
        accepted = _put(accepted, lanes, _accepted(axis, part, moved, h[lanes]))
    lanes = np.flatnonzero(stopped & (edges < MOST_EDGES))
    if lanes.size:
        part, tau = _edge_many(axis, t[lanes], h[lanes], _take(body, lanes), u.take(lanes), guards[:, lanes])
        accepted = _put(accepted, lanes, part)
        used[lanes], passed[lanes] = tau, edges[lanes] + 1
    return accepted, used, passed


def _edge_many(axis: Axis, t: Any, h: Any, body: Body, u: Signal, guards: Any) -> tuple[Body, Any]:
    """Return runs that all meet an edge within `h` seconds, beyond their first one, and the time until then."""
    broken = ~(guards >= 0.0)

    def least(found: State) -> Any:
        return np.where(broken, np.stack(np.broadcast_arrays(*found)), np.inf).min(axis=0)

    def margin(share: Any) -> Any:
        return least(axis.guards(t + share, _runge_kutta(axis, t, share, body, u), body, u))

    first = least(axis.guards(t, body.state, body, u))
    before = first > 0.0
    tau = np.where(before, _roots(margin, np.where(before, first, 1.0), least(tuple(guards)), h), 0.0)
    moved = _accepted(axis, body, _runge_kutta(axis, t, tau, body, u), tau)
    body = _choose(before & (tau > 0.0), moved, body)
    now = np.stack(np.broadcast_arrays(*axis.guards(t + tau, body.state, body, u)))
    fired = np.where(broken, now, np.inf).argmin(axis=0)
    return axis.cross(t + tau, body, u, fired), tau


def _runge_kutta(axis: Axis, t: Any, h: Any, body: Body, u: Signal) -> State:
    """One classical step of fourth order (Hairer, Nørsett, Wanner, Solving ODEs I, table II.1.2)."""
    state, half = body.state, 0.5 * h
    k1 = axis.rates(t, state, body, u)
    k2 = axis.rates(t + half, tuple([s + half * k for s, k in zip(state, k1, strict=True)]), body, u)
    k3 = axis.rates(t + half, tuple([s + half * k for s, k in zip(state, k2, strict=True)]), body, u)
    k4 = axis.rates(t + h, tuple([s + h * k for s, k in zip(state, k3, strict=True)]), body, u)
    sixth = h / 6.0
    return tuple([s + sixth * (a + 2.0 * (b + c) + e) for s, a, b, c, e in zip(state, k1, k2, k3, k4, strict=True)])


def _accepted(axis: Axis, body: Body, new: State, h: Any) -> Body:
    """Return the axis after a step to the state `new`, its sensor carried along."""
    before, after = axis.output(body.state), axis.output(new)
    if not axis.lag:
        return Body(new, body.mode, body.anchor, after[0])
    weights = lag_weights(h / axis.lag)
    rise = after[0] - before[0]
    first, last = h * before[1], h * after[1]
    cubic = (before[0] - body.shown, first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise)
    shown = body.shown + sum(weight * part for weight, part in zip(weights, cubic, strict=True))
    return Body(new, body.mode, body.anchor, shown)


def _let_pass(axis: Axis, body: Body) -> Body:
    """Return the axis with the direction that it has, at rest where it has just stopped."""
    return body._replace(mode=body.mode._replace(direction=axis.m.sign(body.state[1])))


def lag_weights(z: Any) -> tuple[Any, ...]:
    """Return what a first-order lag makes of 1, s, s², s³ over a step of z of its time constants, s from 0 to 1.

    It ends at ``w_j = ∫₀¹ z e^{−z(1−s)} s^j ds`` if it starts at 0: by recurrence, ``w_j = 1 − (j/z) w_{j−1}``, or for
    small z, where that cancels, by the series ``w_j = z Σ_i (−z)^i j!/(j+i+1)!``.
    """
    if isinstance(z, float):
        return _scalar_weights(z)
    values, place = np.unique(z, return_inverse=True)
    each = np.array([_scalar_weights(value) for value in values.tolist()])
    return tuple(each[place].T)


@lru_cache(maxsize=64)
def _scalar_weights(z: float) -> tuple[float, ...]:
    if z > 1.0:
        weights = [-math.expm1(-z)]
        for j in (1, 2, 3):
            weights.append(1.0 - j / z * weights[-1])
        return tuple(weights)
    weights = []
    for j in range(4):
        term = total = z / (j + 1)
        for i in range(1, 18):
            term *= -z / (j + i + 1)
            total += term
        weights.append(total)
    return tuple(weights)


def _root(margin: Callable[[float], float], first: float, last: float, h: float) -> float:
    """Return the root of `margin` in (0, h], positive at 0: regula falsi, a stale end halved (Illinois)."""
    low, high, side = 0.0, h, 0
    for _ in range(MOST_ROOT_STEPS):
        tau = (low * last - high * first) / (last - first)
        value = margin(tau)
        if abs(value) <= SMALLEST or not low < tau < high:
            break
        if value > 0.0:
            low, first, last, side = tau, value, last * (0.5 if side > 0 else 1.0), 1
        else:
            high, last, first, side = tau, value, first * (0.5 if side < 0 else 1.0), -1
    return tau


def _roots(margin: Callable[[Any], Any], first: Any, last: Any, h: Any) -> Any:
    """Return the root of each run; see :func:`_root`."""
    low, high, side = np.zeros_like(first), h.copy(), np.zeros_like(first)
    tau = low
    going = np.ones_like(first, dtype=bool)
    for _ in range(MOST_ROOT_STEPS):
        tau = np.where(going, (low * last - high * first) / (last - first), tau)
        value = margin(tau)
        going &= (np.abs(value) > SMALLEST) & (low < tau) & (tau < high)
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


def _take(body: Body, lanes: Any) -> Body:
    state, mode, anchor, shown = body
    return Body(
        tuple(part[lanes] for part in state),
        Mode(*(part[lanes] for part in mode)),
        tuple(part[lanes] for part in anchor),
        shown[lanes],
    )


def _put(body: Body, lanes: Any, part: Body) -> Body:
    def put(old: Any, new: Any) -> Any:
        changed = old.copy()
        changed[lanes] = new
        return changed

    return _merge(put, body, part)


def _choose(condition: Any, yes: Body, no: Body) -> Body:
    return _merge(lambda a, b: np.where(condition, a, b), yes, no)


def _merge(function: Callable[[Any, Any], Any], one: Body, other: Body) -> Body:
    """Return `function` of each number of the two."""
    return Body(
        tuple(function(a, b) for a, b in zip(one.state, other.state, strict=True)),
        Mode(*(function(a, b) for a, b in zip(one.mode, other.mode, strict=True))),
        tuple(function(a, b) for a, b in zip(one.anchor, other.anchor, strict=True)),
        function(one.shown, other.shown),
    )
