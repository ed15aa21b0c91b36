"""The equation of motion of a structure, as CasADi expressions: the one form that everything else derives from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, final

import casadi as ca

from servolens.effects import (
    Actuator,
    Axis,
    Drive,
    DryFriction,
    Effect,
    Force,
    MotorForce,
    Sensor,
    TimeShift,
    Transmission,
)

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Dynamics", "dynamics", "ideal_pd"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dynamics:
    """Symbols and expressions of ``ẍ = push − level·direction`` and of what the effects remember.

    Attributes
    ----------
    position, velocity, direction, time, command : casadi.SX
        Scalars. Position and velocity are the motor's; `direction` is the sign of the velocity, at rest that of the
        push; `command` is what has passed the delay.
    parameters : casadi.SX, shape (k, 1)
        In the order of ``Plant.values``.
    states : casadi.SX, shape (s, 1)
        What the effects remember; see `state_names`, ``"presliding.force"`` and so on, and `relaxing`.
    push, level : casadi.SX
        Acceleration without dry friction, and level of dry friction [x/s²]; the constant 0 where there is none.
    rates : casadi.SX, shape (s, 1)
        Time derivatives of `states`.
    beginning : casadi.SX, shape (s, 1)
        The states of an axis at rest at `position` under `command`: those that relax are at their targets.
    delay : casadi.SX
        By how much the command comes late [s].
    output, output_velocity, shown : casadi.SX
        Position and velocity of the load, and the position that the sensor shows.
    """

    position: Any
    velocity: Any
    direction: Any
    time: Any
    command: Any
    parameters: Any
    states: Any
    state_names: tuple[str, ...]
    relaxing: tuple[bool, ...]
    push: Any
    level: Any
    rates: Any
    beginning: Any
    delay: Any
    output: Any
    output_velocity: Any
    shown: Any

    @property
    def acceleration(self) -> Any:
        """ẍ while the axis moves in `direction` [x/s²]."""
        return self.push - self.level * self.direction

    @property
    def inputs(self) -> list[Any]:
        """The symbols in the order that every derived function takes them."""
        return [self.position, self.velocity, self.time, self.command, self.direction, self.parameters, self.states]


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
    own = _Symbols(structure, axis)
    motor, load = _motor(own, own.symbols[0], own.symbols[1], command, velocity)
    forces, external = _forces(own)
    motor -= forces
    loaded = axis._replace(load=load + external)
    level = sum((own.value(cls, axis=loaded) for cls in own.of(DryFriction)), start=ca.SX(0))
    output, output_velocity, share = position, velocity, ca.SX(0)
    for cls in own.of(Transmission):
        share = cls.share(own.parameters[cls])  # type: ignore[attr-defined]  # by its kind
        motor -= own.value(cls)
        own.remember(cls)
        own.beginning[cls] = (position, velocity)
        output, output_velocity = own.state(cls, "position"), own.state(cls, "velocity")
    shown, seen = output, axis._replace(position=output, velocity=output_velocity)
    for cls in own.of(Sensor):
        own.remember(cls, shown, axis=seen)
        shown = own.value(cls, shown, axis=seen)
        seen = seen._replace(velocity=own.slope(shown, output, output_velocity))
    rates = own.all_rates()
    return Dynamics(
        position=position,
        velocity=velocity,
        direction=direction,
        time=time,
        command=command,
        parameters=own.symbols,
        states=own.states,
        state_names=own.state_names,
        relaxing=own.relaxing,
        push=motor / (1 - share),
        level=level / (1 - share),
        rates=rates,
        beginning=_at_rest(own, rates),
        delay=sum((cls.physics(own.parameters[cls]) for cls in own.of(TimeShift)), start=ca.SX(0)),  # type: ignore[attr-defined]  # by its kind
        output=output,
        output_velocity=output_velocity,
        shown=shown,
    )


def _motor(own: _Symbols, gain: Any, damping: Any, command: Any, velocity: Any) -> tuple[Any, Any]:
    """Return the acceleration by the motor, β·a(V) − c·v or what takes its place, and the same without damping."""
    effective = command
    for cls in sorted(own.of(Actuator), key=lambda part: part.stage):  # type: ignore[attr-defined]  # by its kind
        own.remember(cls, effective)
        effective = own.value(cls, effective)
    force = gain * effective
    for cls in own.of(Drive):
        own.remember(cls, effective)
        force = own.value(cls, effective)
    limits = own.of(MotorForce)
    motor = force - damping * velocity
    for cls in limits:
        motor = own.value(cls, motor)
    return motor, motor + damping * velocity if limits else force


def _forces(own: _Symbols) -> tuple[Any, Any]:
    """Return the sum of the forces that are subtracted, and that of those which position and time alone decide."""
    inner = ca.vertcat(own.axis.velocity, own.axis.direction, own.states)
    total, external = ca.SX(0), ca.SX(0)
    for cls in own.of(Force):
        force = ca.SX(own.value(cls))
        own.remember(cls)
        total += force
        external += 0 if ca.depends_on(force, inner) else force
    return total, external


def _at_rest(own: _Symbols, rates: Any) -> Any:
    """Return the states of an axis at rest."""
    found = own.all_beginnings()
    axis = own.axis
    targets = []
    for i, relaxes in enumerate(own.relaxing):
        slope = -ca.gradient(rates[i], own.states[i])
        target = ca.if_else(slope > 0, (rates[i] + slope * own.states[i]) / slope, 0.0)
        targets.append(target if relaxes else found[i])
    at_rest = ca.vertcat(*targets)
    for _ in targets:  # a target may hang on another state
        at_rest = ca.substitute(at_rest, own.states, found)
        found, at_rest = at_rest, ca.vertcat(*targets)
    return ca.substitute(found, ca.vertcat(axis.velocity, axis.direction), ca.DM([0.0, 1.0]))


@final
class _Symbols:
    """Parameters and states of each effect, by their names, and what its physics says with them."""

    def __init__(self, structure: tuple[type[Effect], ...], axis: Axis) -> None:
        self.structure, self.axis = structure, axis
        counts = [len(cls.parameters()) for cls in structure]
        self.symbols = ca.SX.sym("parameters", 2 + sum(counts))
        firsts = [2 + sum(counts[:i]) for i in range(len(counts))]
        self.parameters = {
            cls: cls.symbols(self.symbols[a : a + n]) for cls, a, n in zip(structure, firsts, counts, strict=True)
        }
        kept = [(cls, state) for cls in structure for state in cls.states]
        self.state_names = tuple(f"{cls.name}.{state.name}" for cls, state in kept)
        self.relaxing = tuple(state.relaxes for _, state in kept)
        self.states = ca.SX.sym("states", len(kept))
        self._named = {(cls, state.name): self.states[i] for i, (cls, state) in enumerate(kept)}
        self.rates: dict[type[Effect], tuple[Any, ...]] = {}
        self.beginning: dict[type[Effect], tuple[Any, ...]] = {}

    def of(self, kind: type[Effect]) -> list[type[Effect]]:
        return [cls for cls in self.structure if issubclass(cls, kind)]

    def state(self, cls: type[Effect], name: str) -> Any:
        return self._named[cls, name]

    def value(self, cls: type[Effect], *taken: Any, axis: Axis | None = None) -> Any:
        """Return the physics of `cls`; `axis` is whose motion it acts on, if that is not the motor's."""
        return self._call(cls, "physics", axis or self.axis, *taken)

    def remember(self, cls: type[Effect], *taken: Any, axis: Axis | None = None) -> None:
        """Note the rates of the states of `cls`, if it has any."""
        if cls.states:
            self.rates[cls] = tuple(self._call(cls, "rates", axis or self.axis, *taken))

    def slope(self, value: Any, position: Any, velocity: Any) -> Any:
        """Return the time derivative of `value`, a function of `position` and of states whose rates are noted."""
        named = [(self._named[cls, state.name], cls, i) for cls in self.rates for i, state in enumerate(cls.states)]
        moved = sum((ca.gradient(value, symbol) * self.rates[cls][i] for symbol, cls, i in named), start=ca.SX(0))
        return ca.gradient(value, position) * velocity + moved

    def all_rates(self) -> Any:
        return ca.vertcat(*(ca.SX(rate) for cls in self.structure for rate in self.rates.get(cls, ())))

    def all_beginnings(self) -> Any:
        at_rest = [self.beginning.get(cls, (0.0,) * len(cls.states)) for cls in self.structure]
        return ca.vertcat(*(ca.SX(value) for values in at_rest for value in values))

    def _call(self, cls: type[Effect], what: str, axis: Axis, *taken: Any) -> Any:
        names = [state.name for state in cls.states]
        axis = axis._replace(state=SimpleNamespace(**{name: self._named[cls, name] for name in names}))
        function: Callable[..., Any] = getattr(cls, what)
        return function(*taken, axis, self.parameters[cls])
