"""Which classes are effects: what their physics takes and gives, looked at once before anything is derived from it."""

from __future__ import annotations

import inspect
from dataclasses import fields, is_dataclass
from functools import lru_cache
from itertools import product
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from servolens.effects.base import Axis, Effect
from servolens.effects.kinds import (
    Actuator,
    Drive,
    DryFriction,
    Force,
    MotorForce,
    Sensor,
    TimeShift,
    Transmission,
)
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["check_admissible"]

TAKES: dict[type[Effect], tuple[str, ...]] = {
    Actuator: ("command", "axis", "p"),
    Drive: ("command", "axis", "p"),
    DryFriction: ("axis", "p"),
    Force: ("axis", "p"),
    MotorForce: ("push", "axis", "p"),
    Sensor: ("position", "axis", "p"),
    TimeShift: ("p",),
    Transmission: ("axis", "p"),
}
"""What the physics of each kind takes."""
REMEMBERING = (Actuator, Drive, Force, Sensor, Transmission)
IN_WORDS = {
    TimeShift: "a time shift",
    DryFriction: "dry friction",
    MotorForce: "a motor force",
    Actuator: "an actuator",
}
PLACES, SPEEDS, WAYS, LOADS = (-1.0, 0.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0, 1.0)
"""Where the level of dry friction is looked at, SI."""


@lru_cache(maxsize=1024)
def check_admissible(cls: type[Effect]) -> None:
    """Refuse a class that is no effect: its physics is not what its kind takes and gives.

    Raises
    ------
    InputError
        With one sentence: what the class does, what is admissible.
    """
    kinds = [kind for kind in TAKES if issubclass(cls, kind)]
    if len(kinds) != 1:
        _refuse(cls, f"it must be of one kind, one of {', '.join(kind.__name__ for kind in TAKES)}")
    if not is_dataclass(cls) or inspect.isabstract(cls):
        _refuse(cls, "its physics is missing, or that of a state; declare what its kind asks for")
    bare = [f.name for f in fields(cls) if "unit" not in f.metadata]
    if bare:
        _refuse(cls, f"{bare[0]} is no parameter; declare it with parameter(symbol, unit, meaning)")
    kind, symbols = kinds[0], _Symbols(cls)
    if kind is Actuator and not isinstance(getattr(cls, "stage", None), int):
        _refuse(cls, "an actuator needs a stage, a whole number that says when it acts")
    value = _called(cls, kind, "physics", symbols)
    [expression] = _expressions(cls, kind, "physics", [value], symbols)
    if kind is DryFriction:
        _check_level(cls, expression, symbols)
    _check_states(cls, kind, symbols)
    if kind is Transmission:
        _check_transmission(cls, symbols)


class _Symbols:
    """The symbols that a class is given."""

    def __init__(self, cls: type[Effect]) -> None:
        import casadi as ca

        names = ("position", "velocity", "direction", "time", "load")
        self.position, self.velocity, self.direction, self.time, self.load = (ca.SX.sym(name) for name in names)
        self.first = ca.SX.sym("first")
        self.parameters = ca.SX.sym("parameters", len(fields(cls)))
        self.states = ca.SX.sym("states", len(cls.states))
        own = {state.name: self.states[i] for i, state in enumerate(cls.states)}
        self.axis = Axis(
            position=self.position,
            velocity=self.velocity,
            speed=self.direction * self.velocity,
            direction=self.direction,
            time=self.time,
            state=SimpleNamespace(**own),
            load=self.load,
        )
        self.p = cls.symbols(self.parameters)
        moving = (self.position, self.velocity, self.direction, self.time, self.states)
        self.known = ca.vertcat(*moving, self.load, self.first, self.parameters)


def _called(cls: type[Effect], kind: type[Effect], what: str, symbols: _Symbols) -> Any:
    """Return what `physics` or `rates` gives for symbols."""
    function, takes = getattr(cls, what), TAKES[kind]
    given = {"axis": symbols.axis, "p": symbols.p}
    arguments = [given.get(name, symbols.first) for name in takes]
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        found = ", ".join(inspect.signature(function).parameters)
        _refuse(cls, f"{what} takes ({found}), that of {_in_words(kind)} takes ({', '.join(takes)}), a static method")
    try:
        return function(*arguments)
    except AttributeError as error:
        if isinstance(error.obj, Axis):
            _refuse(
                cls, f"{what} asks for axis.{error.name}, which no effect is told; there are {', '.join(Axis._fields)}"
            )
        if error.obj is symbols.p:
            _refuse(cls, f"{what} asks for p.{error.name}, which is no parameter of a dataclass {cls.__name__}")
        _refuse(cls, f"{what} fails with CasADi symbols: {_short(error)}")
    except Exception as error:
        _refuse(cls, f"{what} fails with CasADi symbols: {_short(error)}")


def _expressions(
    cls: type[Effect], kind: type[Effect], what: str, values: Sequence[Any], symbols: _Symbols
) -> list[Any]:
    """Return `values` as CasADi scalars of the given symbols."""
    import casadi as ca

    found = []
    for value in values:
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number and not (isinstance(value, ca.SX) and value.shape == (1, 1)):
            kinds = f"{type(value).__name__}{list(value.shape) if isinstance(value, ca.SX) else ''}"
            _refuse(cls, f"{what} gives {kinds}; {_in_words(kind)} gives one CasADi expression (SX) or a number")
        expression = ca.SX(value)
        strange = [str(s) for s in ca.symvar(expression) if not ca.depends_on(symbols.known, s)]
        if strange:
            _refuse(cls, f"{what} depends on {', '.join(strange)}, which is none of its arguments")
        if kind is not DryFriction and ca.depends_on(expression, symbols.load):
            _refuse(cls, f"{what} depends on axis.load, which dry friction alone is given")
        if expression.is_constant() and not np.isfinite(float(expression)):
            _refuse(cls, f"{what} gives {float(expression)}, which is no finite number")
        found.append(expression)
    return found


def _check_level(cls: type[Effect], level: Any, symbols: _Symbols) -> None:
    """Refuse a level that is negative at values of ordinary size."""
    import casadi as ca

    middle = {spec.name: float(np.clip(1.0, spec.low, spec.high)) for spec in cls.parameters()}
    try:
        values = list(cls(**middle).values)
    except InputError:  # not every class admits them together
        return
    order = [symbols.position, symbols.velocity, symbols.direction, symbols.load, symbols.time, symbols.parameters]
    function = ca.Function("level", order, [level])
    for place, speed, way, load in product(PLACES, SPEEDS, WAYS, LOADS):
        found = float(function(place, way * speed, way, load, 0.0, values))
        if found < 0:
            at = f" at position {place:g}" if not level.is_constant() else ""
            _refuse(cls, f"the level of dry friction is {found:g}{at}; it must never be negative, friction would drive")


def _check_states(cls: type[Effect], kind: type[Effect], symbols: _Symbols) -> None:
    """Refuse states without rates, and rates without states."""
    import casadi as ca

    if kind not in REMEMBERING:
        if cls.states:
            _refuse(cls, f"{_in_words(kind)} has no states; a force with states can remember")
        return
    rates = _called(cls, kind, "rates", symbols)
    if not isinstance(rates, tuple | list):
        _refuse(cls, f"rates gives {type(rates).__name__}; give a tuple with one rate for each state")
    if len(rates) != len(cls.states):
        _refuse(cls, f"rates gives {len(rates)} for {len(cls.states)} states; give a tuple with one for each")
    expressions = _expressions(cls, kind, "rates", rates, symbols)
    for i, (state, rate) in enumerate(zip(cls.states, expressions, strict=True)):
        slope = ca.gradient(rate, symbols.states[i])
        if state.relaxes and ca.depends_on(slope, symbols.states[i]):
            _refuse(cls, f"the state {state.name} is said to relax, but its rate is not linear in it")


def _check_transmission(cls: type[Effect], symbols: _Symbols) -> None:
    """Refuse a transmission whose states are not those of the load, or that lacks the load's share."""
    names = [state.name for state in cls.states]
    if sorted(names) != ["position", "velocity"]:
        _refuse(cls, f"a transmission has the states position and velocity, the load's; it has {names or 'none'}")
    try:
        share = cls.share(symbols.p)  # type: ignore[attr-defined]  # by its kind
    except Exception as error:
        _refuse(cls, f"share fails with CasADi symbols: {_short(error)}")
    _expressions(cls, Transmission, "share", [share], symbols)


def _in_words(kind: type[Effect]) -> str:
    return IN_WORDS.get(kind, f"a {kind.__name__.lower()}")


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:100]}{'…' if len(text) > 100 else ''}"


def _refuse(cls: type[Effect], why: str) -> NoReturn:
    name = getattr(cls, "name", None)
    called = f"{name[:40]!r}" if isinstance(name, str) else f"of class {cls.__name__[:40]}"
    raise InputError(f"the effect {called} cannot be used: {why}") from None
