"""What an effect is: a sentence, parameters with units and bounds, and its physics, written once.

The physics is a CasADi expression. Kernel, regressor columns, optimisation problems, the python-control bridge and the
report derive from it; nothing restates it. The kinds of effects are in :mod:`servolens.effects.kinds`.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from math import isfinite, isnan
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, final

import numpy as np

from servolens.errors import InputError, as_number, described

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["Axis", "Effect", "Parameter", "Seen", "State", "parameter"]

SX = Any  # casadi.SX; importing servolens must not load CasADi


class Axis(NamedTuple):
    """The axis as an effect sees it: CasADi expressions of one instant.

    Position and velocity are those of the motor, which differ from the load's behind a transmission. ``speed`` is
    |velocity| and ``direction`` its sign; each consumer realises the sign in its own way (exact in the kernel, smoothed
    with a stated width in optimisation). ``state`` holds the effect's own states by name. ``load`` is the force that
    the motor transmits, per unit of moving mass: its own, without viscous damping, plus the sum of the subtracted
    forces that depend on position and time only. Dry friction alone is given it.
    """

    position: SX
    velocity: SX
    speed: SX
    direction: SX
    time: SX
    state: Any = None
    load: SX = None


class State(NamedTuple):
    """A quantity that an effect remembers.

    Attributes
    ----------
    name, unit : str
        ``unit`` with ``{x}`` and ``{u}`` as for parameters.
    relaxes : bool
        Whether it only runs after a target, as a filter does: its rate is linear in itself with a slope that is not
        positive. The kernel then carries it exactly, however fast; at the beginning it is at its target.
    """

    name: str
    unit: str
    relaxes: bool = False


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
    per_mass : float, optional
        Power of 1/(moving mass) that it goes with: 1 for what is stated per unit of moving mass, 0 for what does not
        depend on it. Actuators, time shifts and sensors, which know no mass, need not state it.
    usual : float, optional
        Value where nobody knows better: an effect need not state it, and it is not fitted unless it leaves something,
        as :meth:`Effect.freed` has it. Any other value is fitted.
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    meaning: str
    per_mass: float | None = None
    usual: float | None = None

    def check(self, value: float, owner: str) -> float:
        """Return `value` as float, or raise InputError if it lies outside the range."""
        number = as_number(value)
        if isnan(number) and not isinstance(value, float):
            raise InputError(f"{owner}: {self.name} must be a number, got {described(value)}")
        if not (isfinite(number) and self.low <= number <= self.high):
            raise InputError(f"{owner}: {self.name} must lie in [{self.low:g}, {self.high:g}], got {number:g}")
        return number

    def unit_for(self, length_unit: str, command_unit: str) -> str:
        """Return the unit with the axis's own length and command units filled in."""
        command = command_unit if command_unit.isalnum() or command_unit == "%" else f"({command_unit})"
        return self.unit.format(x=length_unit, u=command)


def parameter(
    symbol: str,
    unit: str,
    meaning: str,
    *,
    low: float = 0.0,
    high: float = 1e12,
    per_mass: float | None = None,
    usual: float | None = None,
) -> Any:
    """Declare a field of an effect as its parameter; see :class:`Parameter`."""
    told = {"symbol": symbol, "unit": unit, "meaning": meaning, "low": low, "high": high, "per_mass": per_mass}
    return field(default=MISSING if usual is None else usual, metadata={**told, "usual": usual})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What the records show, for effects to guess where a fit may start.

    Attributes
    ----------
    low, high : float
        Range of the position [m or rad].
    usual : tuple of float
        Range of the position for nine tenths of the time [m or rad].
    speed, command : float
        Largest |velocity| and |command|.
    gain, damping : float
        Of the model without the effect.
    sample_time, duration : float
        [s]; duration of the longest record.
    noise : float
        Standard deviation of the position's noise [m or rad].
    """

    low: float
    high: float
    usual: tuple[float, float]
    speed: float
    command: float
    gain: float
    damping: float
    sample_time: float
    duration: float
    noise: float

    @property
    def travel(self) -> float:
        """Range of the position [m or rad], positive."""
        return max(self.high - self.low, 1e-9)

    @property
    def push(self) -> float:
        """Largest acceleration that the command gives [m/s² or rad/s²], positive."""
        return max(abs(self.gain) * self.command, 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect(ABC):
    """Base of all effects; use one of the kinds.

    A kind says where in the axis the effect acts, a final class says how. Values live in the instance, physics in
    static methods of symbols.

    Attributes
    ----------
    name, sentence, latex : str
        For code and JSON, for people, for the equation.
    spoken : str
        What people call it, in the middle of a sentence; the name with spaces where it is empty.
    typical : dict of str to float
        Values on an axis of the laboratory's size (gain 1.9, damping 6, steps of 0.1 m): what tests and examples take.
    absent_at : dict of str to float
        Parameter values at which the effect changes nothing; empty if it always changes something.
    wave : tuple of str, optional
        Names of amplitude and phase of a force ``amplitude·sin(… + phase)``: both can be solved for.
    phase_per_record : bool
        Whether the phase of its wave is each record's own: what it goes by does not know when a record begins.
    generalises : tuple of str
        Names of effects that this one is at some of its values: beside it they are not wanted.
    linear : bool
        Whether an axis of gain and damping stays linear and time-invariant with it.
    twin : str
        Name of an effect with which a linear axis gives the same records; may be empty.
    same_structure : tuple of str
        Names of effects, in or outside the catalogue, with which any axis gives the same records at suitable values.
    unites : tuple of str
        Names of effects that together are this one; see `united` and `parts`.
    found_last : tuple of str
        Names of parameters that a fit holds at the values it starts from until it has found the others.
    is_last_resort : bool
        Whether it describes nearly anything, so that a diagnosis tries it only where nothing simpler is enough.
    is_rotary : bool
        Whether it makes sense for angles only.
    passes_for_damping : bool
        Whether it is a lag whose time constant a linear axis may have shown as the inverse of its damping.
    contact_rate : float
        Rate [1/s] of the usual contact that it closes; 0 if it closes none.
    looks_like, remedy, for_the_gain : str
        In plain words: how it shows on the machine, what to do about it, what it means for the PD gain.
    """

    name: ClassVar[str]
    sentence: ClassVar[str]
    latex: ClassVar[str]
    spoken: ClassVar[str] = ""
    typical: ClassVar[dict[str, float]] = {}
    absent_at: ClassVar[dict[str, float]] = {}
    states: ClassVar[tuple[State, ...]] = ()
    wave: ClassVar[tuple[str, str] | None] = None
    phase_per_record: ClassVar[bool] = False
    generalises: ClassVar[tuple[str, ...]] = ()
    linear: ClassVar[bool] = False
    twin: ClassVar[str] = ""
    same_structure: ClassVar[tuple[str, ...]] = ()
    unites: ClassVar[tuple[str, ...]] = ()
    found_last: ClassVar[tuple[str, ...]] = ()
    is_last_resort: ClassVar[bool] = False
    is_rotary: ClassVar[bool] = False
    passes_for_damping: ClassVar[bool] = False
    contact_rate: ClassVar[float] = 0.0
    looks_like: ClassVar[str] = ""
    remedy: ClassVar[str] = ""
    for_the_gain: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for spec in self.parameters():
            object.__setattr__(self, spec.name, spec.check(getattr(self, spec.name), self.name))

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return the parameters in the order of declaration."""
        return _parameters(cls)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[Self]:
        """Yield values from which a fit is worth starting, the likeliest first.

        Parameters in which a force is linear are solved for in any case; their values here only need the right order.
        """
        needed = [spec for spec in cls.parameters() if spec.usual is None]
        middle = {spec.name: float(np.clip(1.0, spec.low, spec.high)) for spec in needed}
        yield cls(**middle)

    def freed(self) -> Iterator[Self]:
        """Yield the effect with parameters off their usual values, from which a fit of these is worth starting."""
        yield from ()

    @property
    def usual(self) -> tuple[str, ...]:
        """Names of the parameters that have their usual values: they are not fitted."""
        return tuple(spec.name for spec in _parameters(type(self)) if getattr(self, spec.name) == spec.usual)

    @property
    def unusual(self) -> int:
        """How many parameters are not at their usual values."""
        return len(self.values) - len(self.usual)

    def simplified(self, seen: Seen) -> Iterator[Effect]:
        """Yield forms of it that do without something which the records may not show."""
        yield from ()

    def is_whole(self, seen: Seen) -> bool:
        """Tell whether records show enough of it: of a part, as of a wave's, something simpler would do as well."""
        return True

    @classmethod
    def united(cls, *parts: Effect) -> Self | None:
        """Return what `parts`, effects of the names in ``unites``, are together; None where they are more than that."""
        return None

    def parts(self) -> tuple[Effect, ...]:
        """Return effects that together do about what it does, those it ``unites`` if any; none where none do."""
        return ()

    @classmethod
    def generalised(cls, parts: Sequence[Effect], seen: Seen) -> Iterator[Self]:
        """Yield this effect doing what `parts`, of the names in ``generalises``, do: a fit begins where theirs ended.

        Nothing where what :meth:`starts` yields is as good.
        """
        yield from ()

    def is_free(self, position: NDArray[np.float64], seen: Seen) -> NDArray[np.bool_] | None:
        """Tell for each `position` [m or rad] whether the axis surely runs without the effect there, shape (n,).

        Gain and damping are found there, before a fit that knows nothing of the effect has bent them. None where the
        place says nothing of it.
        """
        return None

    def shifted(self, by: float) -> Self:
        """Return the effect with the positions of its contacts larger by `by` [m or rad]; itself if it has none."""
        return self

    @property
    def values(self) -> tuple[float, ...]:
        """The parameters' values, SI, in the order of declaration."""
        return tuple(getattr(self, spec.name) for spec in _parameters(type(self)))

    @property
    def absent(self) -> bool:
        """Whether the effect changes nothing with these values."""
        return bool(self.absent_at) and all(getattr(self, name) == value for name, value in self.absent_at.items())

    @classmethod
    def symbols(cls, values: Any) -> SimpleNamespace:
        """Give `values` (symbols or numbers, in the order of declaration) their parameters' names."""
        return SimpleNamespace(**{f.name: values[i] for i, f in enumerate(fields(cls))})


@cache
def _parameters(cls: type[Effect]) -> tuple[Parameter, ...]:
    return tuple(Parameter(name=f.name, **f.metadata) for f in fields(cls))
