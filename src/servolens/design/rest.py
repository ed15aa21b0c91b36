"""How an axis rests in its loop before a step: where, and under which voltage."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.design.inverse_dynamics import command_ends, excess_of, inverts, without_swings
from servolens.effects import Force, MotorForce, Saturation, SpeedServo

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.controller import Controller
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["NOT_HELD", "Held", "Rest", "held_by", "rest_of"]

NEARBY = 1e-6
"""Distance over which a difference of voltages is taken, as a share of the position, of 1 m or rad at least."""
REACH, PLACES = 8.0, 257
"""How far a rest is looked for, in the error of position that holds a constant force; and at how many places."""
REFINED = 7
"""How often the place between two of them is looked for likewise: it is then known to rounding."""


class Held(NamedTuple):
    """What holds an axis near a reference, as a straight line.

    Attributes
    ----------
    voltage : float
        At the reference [V]. Without an integral the line touches what holds the axis where its loop lets it rest.
    slope : float
        More for each unit of position [V/m or V/rad], not negative.
    """

    voltage: float
    slope: float


NOT_HELD = Held(0.0, 0.0)
"""What a program is told of an axis that nothing holds."""


class Rest(NamedTuple):
    """An axis at rest in its loop: position [m or rad], what is applied, and the integral of the loop [V]."""

    position: float
    applied: float
    integral: float


def rest_of(plant: Plant, loop: Controller, reference: float, feedforward: float = 0.0) -> Rest:
    """Return how `plant` rests in `loop` at a constant `reference` [m or rad].

    An integral holds it at the reference; without one that takes an error of position, unless dry friction does it.
    `feedforward` [V] is added to what the loop applies. What nothing holds begins at the reference, without a voltage.
    """
    held = held_by(plant, loop, reference, feedforward)
    if held is None:
        return Rest(reference, 0.0, loop.initial_integral)
    ahead = loop.kp * (loop.setpoint_weight - 1.0) * reference + feedforward
    if loop.integrates:
        return Rest(reference, held.voltage, held.voltage - ahead)
    away = (ahead - held.voltage) / (loop.kp + held.slope)
    return Rest(reference + away, ahead - loop.kp * away, loop.initial_integral)


def held_by(plant: Plant, loop: Controller, reference: float, feedforward: float = 0.0) -> Held | None:
    """Return what holds `plant` in `loop` at a constant `reference` [m or rad]; None where nothing does.

    An integral finds, of the voltages under which dry friction keeps the axis still, the one nearest to `feedforward`.
    Without one the axis creeps from the reference to the nearest place where it stays. A force that swings with time is
    left out. Nothing holds where the limits of voltage or force are too low, in a loop without gains, and where a drive
    has an integral of its own: that is empty when a simulation begins.
    """
    if not loop.integrates and loop.kp <= 0.0:
        return None
    ahead = loop.kp * (loop.setpoint_weight - 1.0) * reference + feedforward
    if ahead == 0.0 and not any(isinstance(effect, Force) and not effect.absent for effect in plant.effects):
        return Held(0.0, 0.0)
    if loop.integrates:
        return _held(plant, None, reference, feedforward)
    return _held(plant, loop.kp, reference, ahead)


@lru_cache(maxsize=4096)
def _held(plant: Plant, kp: float | None, reference: float, ahead: float) -> Held | None:
    """Return what holds an axis; `ahead` is applied at the reference. Without `kp` an integral does it there."""
    if any(isinstance(effect, SpeedServo) and effect.integral != 0.0 for effect in plant.effects):
        return None
    still = replace(plant, effects=tuple(effect for effect in without_swings(plant).effects if _holds(effect)))
    (low,), (high,) = _ends(still, np.array([reference]))
    if low <= ahead <= high:
        return Held(ahead, 0.0)
    found, way = (float(low), -1.0) if ahead < low else (float(high), 1.0)
    if kp is None:
        return Held(found, _slope(still, reference, way)) if low <= high and np.isfinite(found) else None
    place = _place(still, kp, reference, ahead, found)
    if place is None:
        return None
    slope = _slope(still, place, way)
    return Held(ahead + (kp + slope) * (reference - place), slope)


def _slope(still: Plant, place: float, way: float) -> float:
    """Return how much more voltage holds an axis that is pulled in direction `way` for each unit of position."""
    near = NEARBY * max(abs(place), 1.0)
    below, above = _ends(still, np.array([place - near, place + near]))[0 if way < 0.0 else 1]
    return max(float(above - below) / (2.0 * near), 0.0)


def _place(still: Plant, kp: float, reference: float, ahead: float, wanted: float) -> float | None:
    """Return the nearest place where a loop holds it that applies `ahead` at the reference, where `wanted` does."""
    way, reach = (-1.0 if ahead < wanted else 1.0), REACH * abs(wanted - ahead) / kp
    near, far = 0.0, reach if np.isfinite(reach) else abs(reference)
    side = way * np.sign(still.gain)
    for _ in range(REFINED):
        away = np.linspace(near, far, PLACES)
        stays = np.flatnonzero(side * _pushed(still, reference + way * away, ahead - kp * way * away, way) <= 0.0)
        if stays.size == 0:
            return None
        near, far = float(away[max(stays[0] - 1, 0)]), float(away[stays[0]])
    return reference + way * far


def _pushed(still: Plant, places: NDArray[np.float64], applied: NDArray[np.float64], way: float) -> NDArray[np.float64]:
    """Return by how much what is applied at each place overcomes friction against a motion in direction `way`."""
    wanted = np.zeros((5, places.size))
    wanted[0], wanted[2] = places, way
    return excess_of(still, wanted)(applied)


def _ends(still: Plant, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest voltage under which the axis stays at each place."""
    wanted = np.zeros((5, 2 * places.size))
    wanted[0], wanted[2] = np.repeat(places, 2), np.tile([-1.0, 1.0], places.size)
    low, high = (ends.reshape(-1, 2) for ends in command_ends(still, wanted))
    return low.min(axis=1), high.max(axis=1)


def _holds(effect: Effect) -> bool:
    """Whether an effect has a part in how an axis is held."""
    return inverts(effect) or (isinstance(effect, MotorForce | Saturation) and not effect.absent)
