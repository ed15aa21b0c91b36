"""The plant: gain, damping, and the effects it is made of.

Per unit of moving mass: ``ÿ = gain·a(V) − damping·ẏ − Σ forces − D·sgn(ẏ)``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.effects import (
    Actuator,
    Drive,
    Effect,
    Parameter,
    Sensor,
    TimeShift,
    Transmission,
    check_effect,
    effect_class,
)
from servolens.errors import InputError, described, number_within
from servolens.units import COMMAND_UNITS, LENGTH_UNITS, settled

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from servolens.record import Record

__all__ = ["BASE_PARAMETERS", "ENDLESS", "FREE_DAMPING", "Plant"]

BASE_PARAMETERS = (
    Parameter(
        name="gain",
        symbol=r"\beta",
        unit="{x}/s^2/{u}",
        low=-1e12,
        high=1e12,
        meaning="acceleration per unit of command, from rest",
    ),
    Parameter(
        name="damping", symbol="c", unit="1/s", low=-1e9, high=1e12, meaning="viscous damping, back-EMF included"
    ),
)

ENDLESS = 1e12
"""A limit of this size is none."""
FREE_DAMPING = replace(
    BASE_PARAMETERS[1], name="free_damping", symbol="c_0", meaning="viscous damping while the motor is off"
)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Plant:
    """An axis.

    Parameters
    ----------
    gain : float
        β [m/s²/V]: acceleration per volt from rest, not zero. A drive with a loop of its own sets it.
    damping : float
        c [1/s]: viscous damping per unit of moving mass.
    effects : sequence of Effect, or one
        What else the axis does: each name once, at most one transmission, one drive and one delay.
    length_unit : {"m", "rad"}
        Unit of position.
    command_unit : {"V", "A", "N", "N m", "%", "pwm"}
        Unit of the command.
    inertia : float, optional
        Moving inertia [kg m²] or mass [kg] that the numbers are for, where records differ in it; see `for_record`.
    free_damping : float, optional
        Viscous damping [1/s] while the motor is off, which then has no back-EMF; None is the same damping. Where it is
        given it is a parameter like the others, the last one.

    Attributes
    ----------
    structure : tuple of type
        The classes of the effects: what the plant is made of, without numbers.
    values : tuple of float
        All parameters, SI: gain, damping, then each effect's in order, and the free damping if there is one.
    driven_values : tuple of float
        Those that the axis has while its motor is on: all but the free damping.

    Raises
    ------
    InputError
        If a value is outside its range or effects cannot be there together.
    """

    example: ClassVar[str] = "Plant(gain=1.9, damping=6.0)"

    gain: float
    damping: float
    effects: tuple[Effect, ...] = ()
    length_unit: str = "m"
    command_unit: str = "V"
    inertia: float | None = None
    free_damping: float | None = None
    structure: tuple[type[Effect], ...] = field(init=False, repr=False, compare=False)
    values: tuple[float, ...] = field(init=False, repr=False, compare=False)
    driven_values: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for spec in BASE_PARAMETERS:
            object.__setattr__(self, spec.name, spec.check(getattr(self, spec.name), "plant"))
        for name, units in (("length_unit", LENGTH_UNITS), ("command_unit", COMMAND_UNITS)):
            object.__setattr__(self, name, settled(getattr(self, name), units, f"plant: {name}"))
        object.__setattr__(self, "effects", _several(self.effects))
        object.__setattr__(self, "structure", tuple(type(effect) for effect in self.effects))
        _check_together(self.structure)
        for effect in self.effects:
            if isinstance(effect, Drive):
                object.__setattr__(self, "gain", effect.gain)
        if self.gain == 0:
            raise InputError("plant: gain must not be 0, the command would move nothing")
        if self.inertia is not None:
            object.__setattr__(self, "inertia", number_within(self.inertia, 0.0, inf, "plant: inertia", above=True))
        if self.free_damping is not None:
            object.__setattr__(self, "free_damping", FREE_DAMPING.check(self.free_damping, "plant"))
        given = (v for effect in self.effects for v in effect.values)
        object.__setattr__(self, "driven_values", (self.gain, self.damping, *given))
        free = () if self.free_damping is None else (self.free_damping,)
        object.__setattr__(self, "values", (*self.driven_values, *free))

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters by qualified name (``"gain"``, ``"coulomb_friction.level"``), in the order of `values`."""
        return dict(_named(self.structure, self.free_damping is not None))

    @property
    def named(self) -> dict[str, float]:
        """All parameters, SI, by qualified name."""
        return dict(zip(self.parameters, self.values, strict=True))

    @property
    def derived(self) -> tuple[str, ...]:
        """Names of the parameters that follow from others: the gain, where a drive sets it."""
        return ("gain",) if any(isinstance(effect, Drive) for effect in self.effects) else ()

    @property
    def usual(self) -> tuple[str, ...]:
        """Names of the parameters that have their usual values: they are not fitted."""
        return tuple(f"{effect.name}.{name}" for effect in self.effects for name in effect.usual)

    @property
    def unusual(self) -> int:
        """How many parameters are not at their usual values: these count where models are compared."""
        return 2 + sum(effect.unusual for effect in self.effects) + (self.free_damping is not None)

    @property
    def has_contacts(self) -> bool:
        """Whether contacts open and close within it: simulation errors are then non-smooth in its parameters."""
        return any(isinstance(effect, Transmission) and not effect.linear for effect in self.effects)

    @property
    def play(self) -> float:
        """How far the motor can be from the load without touching it: half of the lost motion [m or rad]."""
        return sum((effect.play for effect in self.effects if isinstance(effect, Transmission)), start=0.0)

    @property
    def remembers_voltage(self) -> bool:
        """Whether the voltage before a record still shows in it: not in an axis at rest, however it transmits."""
        return any(isinstance(e, TimeShift) or (isinstance(e, Actuator) and bool(e.states)) for e in self.effects)

    @property
    def is_late(self) -> bool:
        """Whether an effect makes the measured position follow the command late, by whatever it does."""
        return self.remembers_voltage or any(isinstance(effect, Transmission | Sensor) for effect in self.effects)

    @property
    def delay(self) -> float:
        """By how much the command comes late [s]."""
        return float(sum(effect.physics(effect) for effect in self.effects if isinstance(effect, TimeShift)))

    def unit(self, name: str) -> str:
        """Return the unit of the parameter with the qualified `name`."""
        return self.parameters[name].unit_for(self.length_unit, self.command_unit)

    def with_values(self, values: Sequence[float]) -> Plant:
        """Return the same structure with other numbers, in the order of `values`."""
        gain, damping, *rest = (float(v) for v in values)
        effects = []
        for effect in self.effects:
            names = [spec.name for spec in effect.parameters()]
            effects.append(type(effect)(**dict(zip(names, rest, strict=False))))
            rest = rest[len(names) :]
        free = None if self.free_damping is None else rest[0]
        return replace(self, gain=gain, damping=damping, effects=tuple(effects), free_damping=free)

    def with_named(self, values: Mapping[str, float]) -> Plant:
        """Return the same structure with other numbers for the parameters that `values` names."""
        return self.with_values([values.get(name, value) for name, value in self.named.items()])

    def scaled(self, ratio: float) -> Plant:
        """Return the plant with 1/`ratio` times the moving mass, of the same shares of motor and load.

        Gain, damping, forces and levels of friction, which are per unit of moving mass, become `ratio` times as large.
        A coupling keeps its spring and damper: its frequency and damping ratio go with the root of `ratio`. Actuators,
        sensors, lengths, phases and times stay, and so does what has its usual value. Other contacts keep their spring
        and damper too.

        Parameters
        ----------
        ratio : float
            Positive.

        Raises
        ------
        InputError
            If an effect does not say how its parameters go with the mass.
        """
        if not 0 < ratio < inf:
            raise InputError(f"plant: a ratio of inertias must be positive, got {ratio!r}")
        powers = zip(self.driven_values, _powers(self.structure), strict=True)
        usual = set(self.usual)
        named = zip(self.parameters, self.driven_values, strict=False)
        kept = [abs(value) >= ENDLESS or name in usual for name, value in named]
        values = [v if stays else v * ratio**power for (v, power), stays in zip(powers, kept, strict=True)]
        free = () if self.free_damping is None else (self.free_damping * ratio,)
        inertia = None if self.inertia is None else self.inertia / ratio
        return replace(self.with_values([*values, *free]), inertia=inertia)

    def for_record(self, record: Record) -> Plant:
        """Return the plant with the moving inertia that `record` states, where both state one."""
        if self.inertia is None or record.inertia is None or record.inertia == self.inertia:
            return self
        return replace(self.scaled(self.inertia / record.inertia), inertia=record.inertia)

    def with_effect(self, effect: Effect) -> Plant:
        """Return the plant with `effect` added, in place of one of the same name."""
        others = (e for e in self.effects if e.name != getattr(effect, "name", None))
        return replace(self, effects=(*others, effect))

    def without_effect(self, name: str) -> Plant:
        """Return the plant without the effect called `name`, if it has it."""
        return replace(self, effects=tuple(effect for effect in self.effects if effect.name != name))

    def freed(self) -> Iterator[Plant]:
        """Yield the plant with parameters of one effect off their usual values, for a fit to begin there."""
        for effect in self.effects:
            for other in effect.freed():
                yield replace(self, effects=tuple(other if e is effect else e for e in self.effects))

    def effect(self, name: str) -> Effect | None:
        """Return the effect called `name`, or None."""
        return next((e for e in self.effects if e.name == name), None)

    @staticmethod
    def effect_from(
        name: str, parameters: Mapping[str, Any], known: Mapping[str, type[Effect]] | None = None
    ) -> Effect:
        """Build an effect from its name and numbers: one of `known`, of the catalogue, or of an installed package.

        Raises
        ------
        InputError
            If the name or the set of parameters is not that of an effect.
        """
        cls = (known or {}).get(name) or effect_class(name)
        wanted = [spec.name for spec in cls.parameters()]
        needed = {spec.name for spec in cls.parameters() if spec.usual is None}
        if not needed <= set(parameters) <= set(wanted):
            given, may = ", ".join(parameters)[:40] or "none", [one for one in wanted if one not in needed]
            also = f", and may have {' and '.join(may)}" if may else ""
            must = ", ".join(one for one in wanted if one in needed)
            raise InputError(f"{name} needs the parameters {must}{also}; got {given}")
        return cls(**parameters)


def _several(effects: Any) -> tuple[Effect, ...]:
    """Return the effects of a plant, each with its numbers; one alone will do."""
    given = tuple(effects) if isinstance(effects, Iterable) and not isinstance(effects, str | type) else (effects,)
    for one in given:
        if not isinstance(one, Effect):
            raise InputError(
                "plant: effects with their numbers are needed, such as CoulombFriction(level=0.3); "
                f"got {described(one)}"
            )
    return given


@lru_cache(maxsize=1024)
def _named(structure: tuple[type[Effect], ...], runs_free: bool) -> dict[str, Parameter]:
    named = {spec.name: spec for spec in BASE_PARAMETERS}
    for effect in structure:
        named |= {f"{effect.name}.{spec.name}": spec for spec in effect.parameters()}
    return named | ({FREE_DAMPING.name: FREE_DAMPING} if runs_free else {})


@lru_cache(maxsize=1024)
def _powers(structure: tuple[type[Effect], ...]) -> tuple[float, ...]:
    """Return for each of the plant's values the power of 1/(moving mass) that it goes with."""
    powers = [1.0, 1.0]
    for effect in structure:
        for spec in effect.parameters():
            if spec.per_mass is None and not issubclass(effect, Actuator | TimeShift | Sensor):
                raise InputError(
                    f"{effect.name} does not say how {spec.name} goes with the moving mass, so records of different "
                    "inertia cannot share it; declare the parameter with per_mass=1 (per unit of mass) or 0"
                )
            powers.append(spec.per_mass or 0.0)
    return tuple(powers)


@lru_cache(maxsize=1024)
def _check_together(structure: tuple[type[Effect], ...]) -> None:
    """Refuse what is no effect, and effects that no axis can have together."""
    for effect in structure:
        check_effect(effect)
    names = [effect.name for effect in structure]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"plant: {twice[0]} appears twice; an effect can be there once")
    for kind, why in (
        (Transmission, "each splits the axis into motor and load"),
        (Drive, "each takes the place of the motor's own force"),
        (TimeShift, "their times only add up"),
    ):
        alike = [effect.name for effect in structure if issubclass(effect, kind)]
        if len(alike) > 1:
            raise InputError(f"plant: {' and '.join(alike)} cannot be there together: {why}; keep one")
