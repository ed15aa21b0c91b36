"""What an effect is: a sentence, parameters with units and bounds, and its physics, written once.

The physics is a CasADi expression. Kernel, regressor columns, optimisation problems, the python-control bridge and the
report derive from it; nothing restates it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, final

import numpy as np

from servolens.errors import InputError

__all__ = ["Actuator", "Axis", "DryFriction", "Effect", "Force", "Parameter", "parameter"]

SX = Any  # casadi.SX; importing servolens must not load CasADi


class Axis(NamedTuple):
    """The axis as an effect sees it: CasADi expressions of one instant.

    ``speed`` is |velocity| and ``direction`` its sign; each consumer realises the sign in its own way (exact in the
    kernel, smoothed with a stated width in optimisation).
    """

    position: SX
    velocity: SX
    speed: SX
    direction: SX
    time: SX


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A number that an effect needs.

    Parameters
    ----------
    name, symbol : str
        Name in code and JSON; symbol in LaTeX.
    unit : str
        With ``{x}`` for the axis's length unit and ``{u}`` for the command's, e.g. ``"{x}/s^2"``.
    low, high : float
        Admissible range, both ends included.
    meaning : str
        What it says about the machine.
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    meaning: str

    def check(self, value: float, owner: str) -> float:
        """Return `value` as float, or raise InputError if it lies outside the range."""
        number = float(value)
        if not (np.isfinite(number) and self.low <= number <= self.high):
            raise InputError(f"{owner}: {self.name} must lie in [{self.low:g}, {self.high:g}], got {number:g}")
        return number

    def unit_for(self, length_unit: str, command_unit: str) -> str:
        """Return the unit with the axis's own length and command units filled in."""
        command = command_unit if command_unit.isalnum() or command_unit == "%" else f"({command_unit})"
        return self.unit.format(x=length_unit, u=command)


def parameter(symbol: str, unit: str, meaning: str, *, low: float = 0.0, high: float = 1e12) -> Any:
    """Declare a field of an effect as its parameter; see :class:`Parameter`."""
    return field(metadata={"symbol": symbol, "unit": unit, "meaning": meaning, "low": low, "high": high})


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect(ABC):
    """Base of all effects; use one of the kinds below.

    A kind says where in the axis the effect acts, a final class says how. Values live in the instance, physics in
    static methods of symbols.
    """

    name: ClassVar[str]
    sentence: ClassVar[str]
    latex: ClassVar[str]

    def __post_init__(self) -> None:
        for spec in self.parameters():
            object.__setattr__(self, spec.name, spec.check(getattr(self, spec.name), self.name))

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return the parameters in the order of declaration."""
        return tuple(Parameter(name=f.name, **f.metadata) for f in fields(cls))

    @property
    def values(self) -> tuple[float, ...]:
        """The parameters' values, SI, in the order of declaration."""
        return tuple(getattr(self, f.name) for f in fields(self))

    @classmethod
    def symbols(cls, values: Any) -> SimpleNamespace:
        """Give `values` (symbols or numbers, in the order of declaration) their parameters' names."""
        return SimpleNamespace(**{f.name: values[i] for i, f in enumerate(fields(cls))})


class Force(Effect):
    """A force per unit of moving mass that is smooth while the direction of motion stays the same."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(axis: Axis, p: Any) -> SX:
        """Return the acceleration that is *subtracted* [x/s²]."""


class DryFriction(Effect):
    """Set-valued friction: opposes motion with its level, holds the axis at rest up to it."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(axis: Axis, p: Any) -> SX:
        """Return the level, not negative [x/s²]; at rest `axis.direction` is that of the push."""


class Actuator(Effect):
    """What becomes of the command before it pushes the axis."""

    __slots__ = ()
    stage: ClassVar[int]
    """Order in the chain; smaller acts first."""

    @staticmethod
    @abstractmethod
    def physics(command: SX, axis: Axis, p: Any) -> SX:
        """Return the effective command, in the command's unit."""
