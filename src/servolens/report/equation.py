"""The equation of motion of a plant as a formula, put together from what each effect says of itself."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from servolens.effects import Actuator, Drive, DryFriction, Force, MotorForce, Sensor, TimeShift, Transmission

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["in_order", "motion_latex"]

DELAYED = 30
"""Where a delay stands among the stages of actuators."""
ASIDE = r",\ "
"""Parts the term of an effect from the equation of what is in it."""
SEPARATOR = r",\quad "


def motion_latex(plant: Plant) -> str:
    """Return the equation of motion, and beside it those of what comes before and after it."""
    effects = in_order(plant)
    chain = [e for e in effects if isinstance(e, Actuator | TimeShift)]
    limited = [e for e in effects if isinstance(e, MotorForce)]
    drive = [e.latex for e in effects if isinstance(e, Drive)]
    push = _renamed(drive[0], V="a" if chain else "V") if drive else rf"\beta\,{'a' if chain else 'V'}"
    motor = limited[0].latex if limited else rf"{push} - c\,v"
    forces = [e.latex.partition(ASIDE) for e in effects if isinstance(e, Force | DryFriction)]
    joint = [e.latex for e in effects if isinstance(e, Transmission)]
    left = r"(1-\mu)\,\dot v" if joint else r"\dot v"
    terms = [force for force, *_ in forces] + [r"F_\mathrm{load}" for _ in joint]
    beside = [rf"v = \dot {'x' if joint else 'y'}"]
    beside += _chained(e.latex if "=" in e.latex else f"a = {e.latex}" for e in chain) or [r"a = V" for _ in limited]
    beside += [rest for *_, rest in forces if rest]
    beside += [rf"\mu\,\ddot y = F_\mathrm{{load}} = {latex}" for latex in joint]
    beside += [e.latex for e in effects if isinstance(e, Sensor)]
    return SEPARATOR.join([f"{left} = {motor}{''.join(f' - {term}' for term in terms)}", *beside])


def _chained(laws: Iterable[str]) -> list[str]:
    """Return the laws of actuators one after the other: what leaves the first is what the next one gets."""
    given = [*laws]
    names = ["V", *(f"a_{i}" for i in range(1, len(given))), "a"]
    return [_renamed(law, V=names[i], a=names[i + 1]) for i, law in enumerate(given)]


def _renamed(law: str, **names: str) -> str:
    """Return the formula with symbols of one letter called otherwise."""
    for_each = "|".join(names)
    return re.sub(rf"(?<![A-Za-z\\])({for_each})(?![A-Za-z])", lambda found: names[found[1]], law)


def in_order(plant: Plant) -> list[Effect]:
    """Return the effects as they act: on the command, on the motion, on what is measured."""
    return sorted(plant.effects, key=_place)


def _place(effect: Effect) -> float:
    if isinstance(effect, Actuator):
        return effect.stage
    if isinstance(effect, TimeShift):
        return DELAYED
    kinds = (Drive, MotorForce, Force | DryFriction, Transmission, Sensor)
    return 100.0 + next(i for i, kind in enumerate(kinds) if isinstance(effect, kind))
