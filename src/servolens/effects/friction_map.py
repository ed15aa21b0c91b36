"""Friction map: dry friction differs along the travel and by direction."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nextafter
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np

from servolens.effects._grids import within
from servolens.effects.base import Axis, parameter
from servolens.effects.coulomb_friction import CoulombFriction
from servolens.effects.kinds import DryFriction
from servolens.effects.position_friction import PositionFriction
from servolens.effects.return_spring import ReturnSpring
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servolens.effects.base import Effect, Seen

__all__ = ["FrictionMap"]

KNOTS = 5
POSITIVE = tuple(f"positive_{i}" for i in range(KNOTS))
NEGATIVE = tuple(f"negative_{i}" for i in range(KNOTS))


def _level(sign: str, knot: int) -> Any:
    way = "grows" if sign == "+" else "falls"
    meaning = f"friction at knot {knot} while the position {way}, per unit of moving mass"
    return parameter(f"F_{{{sign}{knot}}}", "{x}/s^2", meaning, per_mass=1)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class FrictionMap(DryFriction):
    """Dry friction differs from place to place along the travel, and by direction.

    Its level is linear between five knots that lie evenly from `low` to `high`, and constant outside.
    """

    name = "friction_map"
    spoken = "friction that differs over the travel"
    sentence = "Dry friction differs from place to place along the travel, and by direction."
    latex = r"F_\pm(y)\,\operatorname{sgn} v"
    absent_at: ClassVar[dict[str, float]] = dict.fromkeys((*POSITIVE, *NEGATIVE), 0.0)
    generalises = ("coulomb_friction", "asymmetric_friction", "position_friction")
    is_last_resort = True
    found_last = ("low", "high")
    typical: ClassVar[dict[str, float]] = {
        **{f"{way}_{i}": 0.3 + 0.05 * i for way in ("positive", "negative") for i in range(5)},
        "low": -0.05,
        "high": 0.1,
    }
    looks_like = (
        "How far from its target the axis stops depends on the place and on the direction of approach; "
        "moves over the same stretch repeat well."
    )
    remedy = (
        "Inspect where the level is high: alignment of the rails, preload, cables, seals. "
        "Friction compensation that uses this map, by position and direction, removes most of the error."
    )
    for_the_gain = (
        "Choose kp by the largest level that a target can meet: the error at rest there is up to level / (gain kp). "
        "Check kd at both ends of the travel."
    )

    positive_0: float = _level("+", 0)
    positive_1: float = _level("+", 1)
    positive_2: float = _level("+", 2)
    positive_3: float = _level("+", 3)
    positive_4: float = _level("+", 4)
    negative_0: float = _level("-", 0)
    negative_1: float = _level("-", 1)
    negative_2: float = _level("-", 2)
    negative_3: float = _level("-", 3)
    negative_4: float = _level("-", 4)
    low: float = parameter(r"y_\mathrm{min}", "{x}", "position of knot 0", low=-1e12, per_mass=0)
    high: float = parameter(r"y_\mathrm{max}", "{x}", "position of knot 4", low=-1e12, per_mass=0)

    def __post_init__(self) -> None:
        DryFriction.__post_init__(self)
        if not self.low < self.high:
            raise InputError(f"{self.name}: low must be less than high, got low {self.low:g} and high {self.high:g}")

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """See :meth:`servolens.effects.kinds.DryFriction.physics`."""
        from casadi import fmax, fmin, if_else

        forward, backward = (1 + axis.direction) / 2, (1 - axis.direction) / 2
        pairs = ((getattr(p, up), getattr(p, down)) for up, down in zip(POSITIVE, NEGATIVE, strict=True))
        levels = [forward * up + backward * down for up, down in pairs]
        place = fmin(fmax((axis.position - p.low) / (p.high - p.low), 0), 1) * (KNOTS - 1)
        level = (KNOTS - 1 - place) * levels[-2] + (place - (KNOTS - 2)) * levels[-1]
        for i in range(KNOTS - 3, -1, -1):  # weights that are never negative, so that no level is
            level = if_else(place < i + 1, (i + 1 - place) * levels[i] + (place - i) * levels[i + 1], level)
        return level

    def parts(self) -> tuple[CoulombFriction, ReturnSpring] | tuple[()]:
        """See :meth:`servolens.effects.base.Effect.parts`.

        The mean of both directions is friction; half their difference is a force, whose slope over the travel is that
        of a spring.
        """
        up, down = (np.array([getattr(self, name) for name in names]) for names in (POSITIVE, NEGATIVE))
        places = np.arange(KNOTS) - 0.5 * (KNOTS - 1)
        slope = float(places @ (0.5 * (up - down)) / (places @ places))
        stiffness = slope * (KNOTS - 1) / (self.high - self.low)
        level = float(np.mean(0.5 * (up + down)))
        return (CoulombFriction(level=level), ReturnSpring(stiffness=stiffness)) if stiffness > 0.0 else ()

    def simplified(self, seen: Seen) -> Iterator[PositionFriction]:
        """See :meth:`servolens.effects.base.Effect.simplified`: a tight spot at the knot of the highest level.

        It is about as wide as the triangle there.
        """
        up, down = (np.array([getattr(self, name) for name in names]) for names in (POSITIVE, NEGATIVE))
        level, places = 0.5 * (up + down), np.linspace(self.low, self.high, KNOTS)
        highest = int(np.argmax(level))
        width = 0.6 * (self.high - self.low) / (KNOTS - 1)
        yield within(PositionFriction, level=float(level[highest]), centre=float(places[highest]), width=width)

    @classmethod
    def generalised(cls, parts: Sequence[Effect], seen: Seen) -> Iterator[FrictionMap]:
        """See :meth:`servolens.effects.base.Effect.generalised`: at each knot the sum of their levels."""
        for like in cls.starts(seen):
            places = np.linspace(like.low, like.high, KNOTS)
            levels = {
                name: sum(_level_at(float(place), direction, part) for part in parts if isinstance(part, DryFriction))
                for names, direction in ((POSITIVE, 1.0), (NEGATIVE, -1.0))
                for name, place in zip(names, places, strict=True)
            }
            yield within(cls, **levels, low=like.low, high=like.high)

    @classmethod
    def starts(cls, seen: Seen) -> Iterator[FrictionMap]:
        """See :meth:`servolens.effects.base.Effect.starts`."""
        levels = dict.fromkeys((*POSITIVE, *NEGATIVE), 0.1 * seen.push)
        for low, high in (seen.usual, (seen.low, seen.high)):
            yield within(cls, **levels, low=low, high=max(high, nextafter(low, inf)))


def _level_at(place: float, direction: float, friction: DryFriction) -> float:
    """Return the level of a dry `friction` that depends on place and direction alone."""
    here = Axis(position=place, velocity=direction, speed=1.0, direction=direction, time=0.0)
    return float(type(friction).physics(here, friction))
