"""How an axis rests before a step: the voltage that holds it, and the position where its loop gives that voltage."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.design.inverse_dynamics import command_for, inverts
from servolens.dynamics import dynamics
from servolens.effects import Force, Saturation

if TYPE_CHECKING:
    from servolens.controller import Controller
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["Held", "Rest", "held_at", "rest_of"]

NEARBY = 1e-6
"""Distance over which a difference of holding voltages is taken [m or rad], at least this share of the position."""


class Held(NamedTuple):
    """What holds an axis at a position: voltage [V], and how much more for each unit of position [V/m or V/rad]."""

    voltage: float
    slope: float


class Rest(NamedTuple):
    """An axis at rest in its loop: position [m or rad], what is applied, and the integral of the loop [V]."""

    position: float
    applied: float
    integral: float


def held_at(plant: Plant, position: float, applied: float = 0.0) -> Held:
    """Return what holds `plant` still at `position` [m or rad].

    Of the voltages under which dry friction keeps it still, the one nearest to `applied` [V]. A force that swings with
    time is left out: no voltage holds it. Where the voltage limit is too low nothing holds it, 0 V; a force that grows
    in the direction in which it pushes counts as constant.
    """
    if applied == 0.0 and not any(isinstance(effect, Force) and not effect.absent for effect in plant.effects):
        return Held(0.0, 0.0)
    return _held(plant, position, applied)


@lru_cache(maxsize=4096)
def _held(plant: Plant, position: float, applied: float) -> Held:
    still = tuple(effect for effect in plant.effects if inverts(effect) and not _swings(type(effect)))
    near = NEARBY * max(abs(position), 1.0)
    places = np.repeat([position, position - near, position + near], 2)
    wanted = np.zeros((5, places.size))
    wanted[0], wanted[2] = places, np.tile([-1.0, 1.0], 3)
    ends = np.sort(command_for(replace(plant, effects=still), wanted).reshape(3, 2), axis=1)
    voltage, below, above = np.clip(applied, ends[:, 0], ends[:, 1])
    limit = plant.effect(Saturation.name)
    if isinstance(limit, Saturation) and abs(voltage) > limit.limit:
        return Held(0.0, 0.0)
    return Held(float(voltage), max(float(above - below) / (2.0 * near), 0.0))


def rest_of(plant: Plant, loop: Controller, reference: float, feedforward: float = 0.0) -> Rest:
    """Return how `plant` rests in `loop` at a constant `reference` [m or rad].

    An integral holds it at the reference; a loop without one needs an error of position for that (see `held_at`).
    `feedforward` [V] is added to what the loop applies.
    """
    voltage, slope = held_at(plant, reference, feedforward)
    if voltage == 0.0 and feedforward == 0.0:
        return Rest(reference, 0.0, loop.integral_before)
    ahead = loop.kp * (loop.setpoint_weight - 1.0) * reference + feedforward
    if loop.integrates:
        return Rest(reference, voltage, voltage - ahead)
    stiffness = loop.kp + slope
    away = (ahead - voltage) / stiffness if stiffness > 0.0 else 0.0
    return Rest(reference + away, ahead - loop.kp * away, loop.integral_before)


@lru_cache(maxsize=256)
def _swings(kind: type[Effect]) -> bool:
    """Whether a force hangs on time."""
    import casadi as ca

    alone = dynamics((kind,))
    return issubclass(kind, Force) and bool(ca.depends_on(alone.push, alone.time))
