"""A record with the account of how its log was read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from servolens.findings import Finding
from servolens.reading.assembly import assemble
from servolens.reading.gains import guessed_gains
from servolens.reading.guess import Guess, told

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.reading.interpret import Interpretation
    from servolens.record import Record

__all__ = ["Reading", "made"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """A log as it was read.

    Parameters
    ----------
    record : Record
        In SI.
    guesses : tuple of Guess
        How each signal and setting was found.
    columns, units : mapping of str to str
        That read the log in this way, without any guess.
    settings : mapping of str to object
        Likewise.
    """

    record: Record
    guesses: tuple[Guess, ...]
    columns: Mapping[str, str]
    units: Mapping[str, str]
    settings: Mapping[str, object]


def made(
    found: Interpretation,
    *,
    settings: Mapping[str, object] | None = None,
    units: Mapping[str, str] | None = None,
    name: str = "record",
    source: str = "",
) -> Reading:
    """Return the record of an interpretation, with gains from its logged command where none are known.

    Parameters
    ----------
    found : Interpretation
        Signals with their units.
    settings, units : mapping, optional
        From the caller; they win.
    name, source : str
        Of the record.

    Raises
    ------
    InputError
        If signals and settings do not make a record.
    """
    given = {key: value for key, value in (settings or {}).items() if value is not None}
    record = assemble(
        found.signals, found.units, comments=found.comments, settings=given, units=units, name=name, source=source
    )
    guesses = list(found.guesses)
    is_known = any(key in given or key in found.comments for key in ("kp", "kd"))
    gains = None if is_known and not found.found_gains else guessed_gains(record)
    if gains is not None:
        record = replace(record, controller=gains.controller)
        guesses = [guess for guess in guesses if guess.quantity not in ("kp", "kd")] + list(gains.guesses)
    if "reference" in given:
        evidence = "stated by you"
        guesses.append(
            Guess(
                quantity="reference", source="stated", value=str(given["reference"]), evidence=evidence, is_stated=True
            )
        )
    phrase = told(guesses)
    if phrase:
        remark = Finding(
            code="columns_guessed",
            severity="note",
            message=f"read by guess: {phrase}; `servolens convert` shows why.",
            record=record.name,
        )
        record = replace(record, remarks=(*record.remarks, remark))
    return Reading(
        record=record,
        guesses=tuple(guesses),
        columns=found.columns,
        units={signal: text for signal, text in found.units.items() if text},
        settings={**found.comments, **given, **(gains.settings if gains else {})},
    )
