"""The voltage that a wanted motion takes: the equation of motion solved for it."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.effects import Actuator, Drive, DryFriction, Force, Saturation, TimeShift

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["command_for", "inverts"]

HALVINGS = 60
"""Of the interval that holds a voltage: its width is then below rounding."""
ROUNDING = 1e-14
"""Share of the accelerations that a voltage found at once may miss."""


def inverts(effect: Effect) -> bool:
    """Whether an effect has a part in what is solved for the voltage."""
    if isinstance(effect, Saturation | TimeShift) or effect.absent:
        return False
    if isinstance(effect, Actuator):
        return not effect.states
    return isinstance(effect, Force | DryFriction | Drive)


def command_for(plant: Plant, wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the voltage for each column of [position, velocity, direction, acceleration, time], by halving."""
    lacking = _lacking(plant.structure)
    count = wanted.shape[1]
    values = np.repeat(np.array(plant.values)[:, None], count, axis=1)

    def left(u: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sign(plant.gain) * np.asarray(lacking(u[None, :], wanted, values)).ravel())

    none, one = (left(np.full(count, float(u))) for u in (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = none / (none - one)
    if np.all(np.abs(left(found)) <= ROUNDING * np.maximum(np.abs(none), np.abs(one))):  # proportional to the voltage
        return found
    reach = np.ones(count)
    for _ in range(HALVINGS):
        short = (left(reach) < 0.0) | (left(-reach) > 0.0)
        if not short.any():
            break
        reach[short] *= 2.0
    low, high = -reach, reach
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        enough = left(middle) > 0.0
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    return 0.5 * (low + high)


@lru_cache(maxsize=64)
def _lacking(structure: tuple[type[Effect], ...]) -> Any:
    """Return a CasADi function: how much more acceleration a voltage gives than is wanted.

    What the effects remember has settled at the velocity, a bristle at its full deflection; an integral is empty.
    """
    import casadi as ca

    from servolens.dynamics import dynamics

    d = dynamics(structure)
    settled = []
    for i, relaxes in enumerate(d.relaxing):
        begun, slope = ca.substitute(d.rates[i], d.states[i], 0.0), -ca.gradient(d.rates[i], d.states[i])
        settled.append(ca.if_else(slope > 0, begun / slope, 0.0) if relaxes else ca.SX(0))
    wanted = ca.SX.sym("wanted")
    more = d.push - d.level * d.direction - wanted
    more = ca.substitute(more, d.states, ca.vertcat(*settled)) if settled else more
    columns = ca.vertcat(d.position, d.velocity, d.direction, wanted, d.time)
    return ca.Function("lacking", [d.command, columns, d.parameters], [more])
