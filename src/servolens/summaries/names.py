"""What people call effects, causes and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.effects import catalogue
from servolens.summaries.wording import value_and_error

if TYPE_CHECKING:
    from servolens.diagnosis.result import Cause

__all__ = ["cause_phrase", "spoken", "spoken_parameter"]

ALONE = {"gain_and_damping": "gain and damping alone"}
"""What stands for no effect."""
SIDES = {"level_positive": "level forward", "level_negative": "level backward"}
"""Of parameters whose name is no phrase."""


def spoken(name: str) -> str:
    """Return an effect's name, or those of effects joined by a plus, as people say it.

    Examples
    --------
    >>> spoken("coulomb_friction"), spoken("backlash"), spoken("without delay"), spoken("delay + coulomb_friction")
    ('Coulomb friction', 'backlash', 'without delay', 'a delay together with Coulomb friction')
    """
    known = catalogue()
    told = [known[part].spoken if part in known else ALONE.get(part, "") for part in name.split(" + ")]
    return " together with ".join(
        words or part.replace("_", " ") for words, part in zip(told, name.split(" + "), strict=True)
    )


def spoken_parameter(name: str) -> str:
    """Return a parameter's name as people say it.

    Examples
    --------
    >>> spoken_parameter("level_positive"), spoken_parameter("load_share")
    ('level forward', 'load share')
    """
    return SIDES.get(name, name.replace("_", " "))


def cause_phrase(cause: Cause) -> str:
    """Return a cause with its parameters but for a phase: name and value ± error, each with its unit."""
    phase = cause.kind.wave[1] if cause.kind.wave else ""
    told = {name: value_and_error(quantity) for name, quantity in cause.quantities.items() if name != phase}
    if len(told) == 1:
        return f"{spoken(cause.effect)}, {next(iter(told.values()))}"
    named = [f"{spoken_parameter(name)} {value}" for name, value in told.items()]
    return f"{spoken(cause.effect)} ({', '.join(named)})"
