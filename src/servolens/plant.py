"""The plant: gain, damping, and the effects it is made of.

Per unit of moving mass: ``ÿ = gain·a(V) − damping·ẏ − Σ forces − D·sgn(ẏ)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

from servolens.effects import Drive, Effect, Parameter, TimeShift, Transmission, check_effect, effect_class
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["BASE_PARAMETERS", "Plant"]

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
    effects : tuple of Effect
        What else the axis does: each name once, at most one transmission, one drive and one delay.
    length_unit : {"m", "rad"}
        Unit of position.
    command_unit : str
        Unit of the command.

    Raises
    ------
    InputError
        If a value is outside its range or effects cannot be there together.
    """

    gain: float
    damping: float
    effects: tuple[Effect, ...] = ()
    length_unit: str = "m"
    command_unit: str = "V"

    def __post_init__(self) -> None:
        for spec in BASE_PARAMETERS:
            object.__setattr__(self, spec.name, spec.check(getattr(self, spec.name), "plant"))
        if self.length_unit not in ("m", "rad"):
            raise InputError(f"plant: length_unit must be 'm' or 'rad', got {self.length_unit!r}")
        object.__setattr__(self, "effects", tuple(self.effects))
        _check_together(self.structure)
        for effect in self.effects:
            if isinstance(effect, Drive):
                object.__setattr__(self, "gain", effect.gain)
        if self.gain == 0:
            raise InputError("plant: gain must not be 0, the command would move nothing")

    @property
    def structure(self) -> tuple[type[Effect], ...]:
        """The classes of the effects: what the plant is made of, without numbers."""
        return tuple(type(effect) for effect in self.effects)

    @property
    def values(self) -> tuple[float, ...]:
        """All parameters, SI: gain, damping, then each effect's in order."""
        return (self.gain, self.damping, *(v for effect in self.effects for v in effect.values))

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters by qualified name (``"gain"``, ``"coulomb_friction.level"``), in the order of `values`."""
        return dict(_named(self.structure))

    @property
    def derived(self) -> tuple[str, ...]:
        """Names of the parameters that follow from others: the gain, where a drive sets it."""
        return ("gain",) if any(isinstance(effect, Drive) for effect in self.effects) else ()

    @property
    def has_contacts(self) -> bool:
        """Whether contacts open and close within it: simulation errors are crumpled functions of its parameters."""
        return any(isinstance(effect, Transmission) and not effect.linear for effect in self.effects)

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
            count = len(effect.values)
            effects.append(type(effect)(**vars(type(effect).symbols(rest[:count]))))
            rest = rest[count:]
        return replace(self, gain=gain, damping=damping, effects=tuple(effects))

    def with_effect(self, effect: Effect) -> Plant:
        """Return the plant with `effect` added, in place of one of the same name."""
        others = tuple(e for e in self.effects if e.name != effect.name)
        return replace(self, effects=(*others, effect))

    def without_effect(self, name: str) -> Plant:
        """Return the plant without the effect called `name`, if it has it."""
        return replace(self, effects=tuple(effect for effect in self.effects if effect.name != name))

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
        if sorted(parameters) != sorted(wanted):
            raise InputError(f"{name} needs the parameters {', '.join(wanted)}; got {', '.join(parameters) or 'none'}")
        return cls(**parameters)


@lru_cache(maxsize=1024)
def _named(structure: tuple[type[Effect], ...]) -> dict[str, Parameter]:
    named = {spec.name: spec for spec in BASE_PARAMETERS}
    for effect in structure:
        named |= {f"{effect.name}.{spec.name}": spec for spec in effect.parameters()}
    return named


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
