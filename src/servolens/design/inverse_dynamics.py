"""The voltage that a wanted motion takes: the equation of motion solved for it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.effects import Actuator, Drive, DryFriction, Force, MotorForce, Saturation, TimeShift

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["command_ends", "command_for", "excess_of", "inverts", "without_swings"]

HALVINGS = 60
"""Of the interval that holds a voltage: its width is then below rounding."""
DOUBLINGS = 40
"""Of one volt: what needs more is not reached by any voltage."""
ROUNDING = 1e-14
"""Share of an acceleration that counts as none."""


def inverts(effect: Effect) -> bool:
    """Whether an effect has a part in what is solved for the voltage."""
    if isinstance(effect, Saturation | TimeShift) or effect.absent:
        return False
    if isinstance(effect, Actuator):
        return not effect.states
    return isinstance(effect, Force | DryFriction | Drive)


def without_swings(plant: Plant) -> Plant:
    """Return the plant without the forces that swing with time, which nothing holds still."""
    return replace(plant, effects=tuple(effect for effect in plant.effects if not _swings(type(effect))))


def command_for(plant: Plant, wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the voltage for each column of [position, velocity, direction, acceleration, time].

    Of several, the one nearest to zero; 0 where no voltage does it.
    """
    low, high = command_ends(plant, wanted)
    found = np.clip(0.0, low, high)
    return np.where((low <= high) & np.isfinite(found), found, 0.0)


def command_ends(plant: Plant, wanted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest voltage for each column of :func:`command_for`, infinite where there is none.

    They differ where the voltage does not matter, as within a dead zone. Where the least would have to exceed what any
    voltage does it is inf, and where the largest would have to lie below that it is -inf.
    """
    left, count = excess_of(plant, wanted), wanted.shape[1]
    none, one = left(np.zeros(count)), left(np.ones(count))
    if not any(isinstance(effect, Actuator | Drive | MotorForce) for effect in plant.effects):  # it is proportional
        found = none / (none - one)
        return found, found
    least = ROUNDING * np.maximum(np.abs(none), np.abs(one))
    return _edge(lambda u: left(u) >= -least, count), _edge(lambda u: left(u) > least, count)


def excess_of(plant: Plant, wanted: NDArray[np.float64]) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the function of voltages, one a column, that tells by how much they push more than is wanted.

    In the direction in which more voltage pushes.
    """
    from casadi import DM

    lacking, columns = _lacking(plant.structure), DM(wanted)
    values = DM(np.repeat(np.array(plant.driven_values)[:, None], wanted.shape[1], axis=1))

    def excess(command: NDArray[np.float64]) -> NDArray[np.float64]:
        more = lacking(DM(command[None, :]), columns, values).full()
        return np.asarray(np.sign(plant.gain) * more.ravel(), dtype=np.float64)

    return excess


def _edge(is_beyond: Callable[[NDArray[np.float64]], NDArray[np.bool_]], count: int) -> NDArray[np.float64]:
    """Return the voltages from which on `is_beyond`; infinite where it is so for none or for all."""
    high, low = np.ones(count), -np.ones(count)
    for _ in range(DOUBLINGS):
        short, over = ~is_beyond(high), is_beyond(low)
        if not (short.any() or over.any()):
            break
        high[short] *= 2.0
        low[over] *= 2.0
    never, always = ~is_beyond(high), is_beyond(low)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        beyond = is_beyond(middle)
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.where(never, np.inf, np.where(always, -np.inf, 0.5 * (low + high)))


@lru_cache(maxsize=256)
def _swings(kind: type[Effect]) -> bool:
    """Whether it is a force that hangs on time."""
    import casadi as ca

    from servolens.dynamics import dynamics

    alone = dynamics((kind,))
    return issubclass(kind, Force) and bool(ca.depends_on(alone.push, alone.time))


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
