"""What sampling instants that are not those stated do: how late they are, and what a late voltage changes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Actuator, Drive, MotorForce

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.identification.elementwise import Elementwise
    from servolens.identification.noise import NoiseModel
    from servolens.plant import Plant

__all__ = ["about", "instants", "jumps_of"]

SEEN = 5.0
"""Standard errors from which on a jitter is one: overlapping differences are worth about a third as many."""
REWEIGHTED, LEAST = 8, 1e-4
"""Times that the regression of squares is weighed by what it found, and share of their mean that the sensor's is."""
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0)
"""Of the way to what a regression found, of which the likeliest is gone: all of it may go too far."""


def instants(residuals: Sequence[NDArray[np.float64]], speeds: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """Return the standard deviation of the sampling instants [s] that the residuals show, and of the sensor's noise.

    The first is 0 where it may be chance. Third differences, to which what is smooth adds nothing, grow with the speed:
    their squares are regressed on its, each in units of what is expected of it. The difference 1, −3, 3, −1 of four
    samples sees the squares of their speeds by 1, 9, 9 and 1 in 20.
    """
    third = np.concatenate([np.diff(r, 3) ** 2 / 20.0 for r in residuals])
    if not third.any():
        return 0.0, 0.0
    squares = np.concatenate([0.05 * (v[:-3] ** 2 + v[3:] ** 2) + 0.45 * (v[1:-2] ** 2 + v[2:-1] ** 2) for v in speeds])

    def misfit(parts: NDArray[np.float64]) -> float:
        expected = parts[0] + parts[1] * squares
        return float(np.sum(np.log(expected) + third / expected))

    parts, error = np.array([float(third.mean()), 0.0]), np.inf
    for _ in range(REWEIGHTED):
        weight = 1.0 / (parts[0] + parts[1] * squares) ** 2
        centred = squares - float(weight @ squares) / float(weight.sum())
        energy = float(weight @ centred**2)
        if not energy > 0.0:
            break
        slope = max(float((weight * centred) @ third) / energy, 0.0)
        level = max(float(weight @ (third - slope * squares)) / float(weight.sum()), LEAST * float(third.mean()))
        way = np.array([level, slope]) - parts
        parts = min((parts + share * way for share in SHARES), key=misfit)
        error = float(np.sqrt(np.sum((weight * centred * (third - parts[0] - parts[1] * squares)) ** 2))) / energy
    level, slope = parts.tolist()
    return (float(np.sqrt(slope)) if slope > SEEN * error else 0.0), float(np.sqrt(level))


def about(noise: NoiseModel, plant: Plant) -> NoiseModel:
    """Return the `noise` of an axis like `plant`, whose input may be late.

    Of its effects only those are kept by which a voltage pushes it otherwise than in proportion. A lag is not: behind
    it the velocity changes by as much, a little later.
    """
    effects = tuple(
        effect
        for effect in plant.effects
        if isinstance(effect, Drive | MotorForce) or (isinstance(effect, Actuator) and not effect.states)
    )
    pushed = replace(plant, effects=effects) if effects else None
    return replace(noise, gain=plant.gain, damping=max(plant.damping, 0.0), pushed=pushed)


def jumps_of(
    noise: NoiseModel, time: NDArray[np.float64], speed: NDArray[np.float64], voltage: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return by how much the acceleration changes as each voltage follows the one before [m/s² or rad/s²], shape (n,).

    Parameters
    ----------
    noise : NoiseModel
        Gives the axis; nothing changes where its gain is 0, for there the input is on time, nor without a jitter.
    time, speed, voltage : ndarray, shape (n,)
        [s], [m/s or rad/s], and [V], applied from each sample to the next.
    """
    if noise.jitter == 0.0:
        return np.zeros(voltage.size)
    if noise.pushed is None or noise.gain == 0.0:
        return np.asarray(noise.gain * np.diff(voltage, prepend=voltage[0]))
    push, values = _push(noise.pushed.structure), noise.pushed.values
    before = np.concatenate([voltage[:1], voltage[:-1]])
    now, held = (push([command, speed, time], values)[0] for command in (voltage, before))
    return np.asarray(now - held)


@lru_cache(maxsize=64)
def _push(structure: tuple[type[Effect], ...]) -> Elementwise:
    """Return the acceleration by command, velocity and time; what a drive remembers is empty."""
    import casadi as ca

    from servolens.dynamics import dynamics
    from servolens.identification.elementwise import Elementwise

    d = dynamics(structure)
    push = ca.substitute(d.push, ca.vertcat(d.position, d.states), ca.DM.zeros(1 + d.states.numel()))
    arguments = [d.command, d.velocity, d.time, *ca.vertsplit(d.parameters)]
    return Elementwise(ca.Function("push", arguments, [ca.densify(push)]), 3)
