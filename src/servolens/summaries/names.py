"""What people call effects, causes and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.effects import catalogue
from servolens.model import NOT_REACHED, UNDETERMINED
from servolens.summaries.wording import listed, value_and_error

if TYPE_CHECKING:
    from servolens.diagnosis.result import Cause

__all__ = ["cause_phrase", "spoken", "spoken_parameter"]

NO_EFFECTS = {
    "gain_and_damping": "gain and damping alone",
    "second_order_actuator": "an actuator of second order",
}
"""Names that are no effects of the catalogue."""
SIDES = {"level_positive": "level forward", "level_negative": "level backward"}
"""Of parameters whose name is no phrase."""
MANY = 5
"""Parameters from which on a sentence leaves them to a table."""


def spoken(name: str) -> str:
    """Return an effect's name, or those of effects joined by a plus, as people say it.

    Examples
    --------
    >>> spoken("coulomb_friction"), spoken("backlash"), spoken("without delay"), spoken("delay + coulomb_friction")
    ('Coulomb friction', 'backlash', 'without delay', 'a delay together with Coulomb friction')
    """
    known = catalogue()
    told = [known[part].spoken if part in known else NO_EFFECTS.get(part, "") for part in name.split(" + ")]
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
    """Return a cause with its parameters but for a phase: name and value ± error, each with its unit.

    Without the values that the data do not determine, or with which a part of it is absent; of many parameters none.
    """
    phase = cause.kind.wave[1] if cause.kind.wave else ""
    all_known = {name: quantity for name, quantity in cause.quantities.items() if name != phase}
    known = {name: q for name, q in all_known.items() if q.value != cause.kind.absent_at.get(name)} or all_known
    if len(known) >= MANY:
        return f"{spoken(cause.effect)} ({len(known)} parameters, in the table of the model)"
    reached = {name: q for name, q in known.items() if q.reason != NOT_REACHED} or known
    shown = {name: q for name, q in reached.items() if q.reason != UNDETERMINED} or reached
    told = {name: value_and_error(q, beside=shown.values()) for name, q in shown.items()}
    if len(all_known) == 1 and told:
        return f"{spoken(cause.effect)} ({next(iter(told.values()))})"
    named = ", ".join(f"{spoken_parameter(name)} {value}" for name, value in told.items())
    for reason, words in ((UNDETERMINED, "not determined"), (NOT_REACHED, "not seen by these records")):
        unknown = [spoken_parameter(name) for name, q in known.items() if name not in told and q.reason == reason]
        named += f"; {listed(unknown)} {words}" if unknown else ""
    return f"{spoken(cause.effect)} ({named})"
