"""Scales that are stated beside a log: encoder counts and PWM counts in the units that physics knows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.units import Unit, parse_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from servolens.reading.settings import Settings

__all__ = ["Scales"]

COUNTED = ("position", "reference", "velocity")
_PERCENT = 100.0


@final
@dataclass(frozen=True, slots=True)
class Scales:
    """What one encoder count, one per cent of the command and one PWM count are.

    Parameters
    ----------
    count : Unit or None
        Of the length; without a dimension where neither metres nor radians are stated.
    percent, pwm : Unit or None
        Of the command in volts, with a supply voltage; of one PWM count in per cent without.
    """

    count: Unit | None = None
    percent: Unit | None = None
    pwm: Unit | None = None

    @classmethod
    def of(cls, settings: Settings, stated: dict[str, tuple[str, Unit]], signals: Iterable[str]) -> Scales:
        """Return the scales that settings state; counted columns without a unit get theirs in `stated`.

        Raises
        ------
        InputError
            If counts are logged without a scale, or two scales contradict each other.
        """
        counted = [s for s in COUNTED if s in stated and "count" in dict(stated[s][1].dimension)]
        count = _count(settings)
        if count is None:
            if counted:
                raise InputError(
                    f"column {counted[0]} is in encoder counts; give counts_per_unit, counts per m or rad, or"
                    " counts_per_rev"
                )
        elif "position" in stated and "position" not in counted:
            raise InputError(
                f"position is in {quote(stated['position'][0])} and counts_per_unit is given too; give only one of the"
                " two"
            )
        else:
            plain = Unit(1.0, (("count", 1.0),))
            for signal in ("position", "reference"):
                if signal in signals and signal not in stated:
                    stated[signal] = ("counts", plain)
        stated.pop("counts_per_unit", None)
        return cls(count, *_command(settings, stated))

    @property
    def per_count(self) -> float | None:
        """Metres or radians of one encoder count, None without a scale."""
        return None if self.count is None else self.count.factor

    def converted(self, unit: Unit) -> Unit:
        """Return a unit with counts, per cent and PWM counts replaced by what they are."""
        factor, bases = unit.factor, dict(unit.dimension)
        for name, scale in (("count", self.count), ("pwm", self.pwm), ("%", self.percent)):
            if scale is None or name not in bases:
                continue
            power = bases.pop(name)
            factor *= scale.factor**power
            for base, size in scale.dimension or ((name, 1.0),):
                bases[base] = bases.get(base, 0.0) + power * size
        return Unit(factor, tuple(sorted((base, size) for base, size in bases.items() if size)))


def _count(settings: Settings) -> Unit | None:
    amount, turn = settings.amounts.get("counts_per_unit"), settings.numbers.get("counts_per_rev")
    if amount is not None and turn is not None:
        raise InputError("counts_per_unit and counts_per_rev are given both; give only one of the two")
    if turn is not None:
        return Unit(2 * math.pi / turn, (("rad", 1.0),))
    if amount is None:
        return None
    if amount.unit is None:
        return Unit(1 / amount.value, ())
    bases = dict(amount.unit.dimension)
    bases.pop("count", None)
    if bases not in ({"m": -1.0}, {"rad": -1.0}):
        raise InputError(
            f"counts_per_unit is in {quote(amount.text)}, which is not a unit for it; give it in 1/m or 1/rad"
        )
    return Unit(1 / (amount.value * amount.unit.factor), tuple((base, -power) for base, power in bases.items()))


def _command(settings: Settings, stated: Mapping[str, tuple[str, Unit]]) -> tuple[Unit | None, Unit | None]:
    """Return what one per cent and one PWM count are."""
    supply, full = settings.amounts.get("supply_voltage"), settings.numbers.get("pwm_full_scale")
    in_pwm = [key for key, (_, unit) in stated.items() if "pwm" in dict(unit.dimension)]
    if supply is None:
        return None, Unit(_PERCENT / full, (("%", 1.0),)) if full else None
    volt = parse_unit("V")
    volts = supply.value * (supply.unit.factor if supply.unit else 1.0)
    if in_pwm and full is None:
        raise InputError(
            f"{in_pwm[0]} is in PWM counts and supply_voltage is given; give pwm_full_scale too, the count of full"
            " duty, as 255 or 1000"
        )
    dimension = volt.dimension if volt else ()
    return Unit(volts / _PERCENT, dimension), Unit(volts / full, dimension) if full else None
