"""The equation of motion of a structure, as CasADi expressions: the one form that everything else derives from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import casadi as ca

from servolens.effects import Actuator, Axis, DryFriction, Effect, Force

__all__ = ["Dynamics", "dynamics", "ideal_pd"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dynamics:
    """Symbols and expressions of ``ÿ = push − level·direction``.

    Attributes
    ----------
    position, velocity, direction, time, command : casadi.SX
        Scalars; `direction` is the sign of the velocity, at rest that of the push.
    parameters : casadi.SX, shape (k, 1)
        In the order of ``Plant.values``.
    push : casadi.SX
        β·a(V) − c·v − Σ forces [x/s²].
    level : casadi.SX
        Level of dry friction [x/s²]; the constant 0 where there is none.
    """

    position: Any
    velocity: Any
    direction: Any
    time: Any
    command: Any
    parameters: Any
    push: Any
    level: Any

    @property
    def acceleration(self) -> Any:
        """ÿ while the axis moves in `direction` [x/s²]."""
        return self.push - self.level * self.direction

    @property
    def inputs(self) -> list[Any]:
        """The symbols in the order that every derived function takes them."""
        return [self.position, self.velocity, self.time, self.command, self.direction, self.parameters]

    def total_derivative(self, expression: Any, acceleration: Any) -> Any:
        """Return d/dt of `expression` along the motion, for a command that is held."""
        return (
            ca.gradient(expression, self.position) * self.velocity
            + ca.gradient(expression, self.velocity) * acceleration
            + ca.gradient(expression, self.time)
        )


def ideal_pd(kp: Any, kd: Any, reference: Any, position: Any, velocity: Any) -> Any:
    """Return what the ideal continuous PD asks for (paper eq. 15), of numbers, arrays or symbols."""
    return kp * (reference - position) - kd * velocity


@lru_cache(maxsize=256)
def dynamics(structure: tuple[type[Effect], ...]) -> Dynamics:
    """Compose the effects of `structure` into one equation of motion."""
    position, velocity, direction, time, command = (
        ca.SX.sym(name) for name in ("position", "velocity", "direction", "time", "command")
    )
    axis = Axis(position=position, velocity=velocity, speed=direction * velocity, direction=direction, time=time)
    counts = [len(cls.parameters()) for cls in structure]
    parameters = ca.SX.sym("parameters", 2 + sum(counts))
    firsts = [2 + sum(counts[:i]) for i in range(len(counts))]
    parts = [(cls, cls.symbols(parameters[a : a + n])) for cls, a, n in zip(structure, firsts, counts, strict=True)]
    effective = command
    chain = [(cls, p) for cls, p in parts if issubclass(cls, Actuator)]
    for actuator, p in sorted(chain, key=lambda part: part[0].stage):
        effective = actuator.physics(effective, axis, p)
    push = parameters[0] * effective - parameters[1] * velocity
    for cls, p in parts:
        if issubclass(cls, Force):
            push -= cls.physics(axis, p)
    level = ca.SX(0)
    for cls, p in parts:
        if issubclass(cls, DryFriction):
            level += cls.physics(axis, p)
    return Dynamics(
        position=position,
        velocity=velocity,
        direction=direction,
        time=time,
        command=command,
        parameters=parameters,
        push=push,
        level=level,
    )
