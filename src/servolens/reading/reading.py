"""A record with the account of how its log was read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from servolens.findings import Finding
from servolens.reading.assembly import assemble
from servolens.reading.files import printable
from servolens.reading.gains import guessed_gains
from servolens.reading.guess import Guess, told

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.reading.interpret import Interpretation
    from servolens.record import Record

__all__ = ["Reading", "made", "units_of"]


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


GAINS = ("kp", "kd")
LOOP = (*GAINS, "derivative_filter", "derivative_window", "derivative_on", "derivative", "control_period")


def units_of(record: Record) -> dict[str, str]:
    """Return the SI unit of each signal of a record."""
    length, command = record.length_unit, record.command_unit
    return {
        "time": "s",
        "position": length,
        "reference": length,
        "voltage": command,
        "velocity": f"{length}/s",
        "feedforward": command,
    }


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
    origin: dict[str, Any] = {"settings": given, "units": units, "name": name, "source": source}
    record = assemble(found.signals, found.units, comments=found.comments, **origin)
    comments, guesses = dict(found.comments), list(found.guesses)
    gains = None if _states_loop({**comments, **given}, found) else guessed_gains(record)
    is_contradicted = found.found_gains and record.reference is not None and record.voltage is not None
    if gains is not None or is_contradicted:  # what stands beside the columns is weaker than the law of the log
        guesses = [guess for guess in guesses if guess.quantity not in GAINS]
        comments = {key: value for key, value in comments.items() if not (found.found_gains and key in GAINS)}
        record = assemble(found.signals, found.units, comments=comments, **origin)
    if gains is not None:
        record = replace(record, controller=gains.controller)
        guesses += gains.guesses
    if "reference" in given:
        text = str(given["reference"])
        guesses.append(Guess(quantity="reference", source="stated", value=text, evidence="by you", is_stated=True))
    if "reference_file" in given:
        file = printable(Path(str(given["reference_file"])).name)[:40]
        evidence = "a file named by you, each value held until the next"
        guesses.append(Guess(quantity="reference", source=file, value="", evidence=evidence, is_stated=True))
    si = units_of(record)
    guesses = [guess if guess.value else replace(guess, value=si.get(guess.quantity, "")) for guess in guesses]
    return Reading(
        record=_with_remarks(record, guesses, found.remarks),
        guesses=tuple(guesses),
        columns=found.columns,
        units={signal: text for signal, text in found.units.items() if text},
        settings={**comments, **given, **(gains.settings if gains else {})},
    )


def _states_loop(settings: Mapping[str, object], found: Interpretation) -> bool:
    """Tell whether gains, or what else tells one loop from another, are stated rather than found beside the columns."""
    return any(key in settings for key in LOOP if not (found.found_gains and key in GAINS))


def _with_remarks(record: Record, guesses: Sequence[Guess], remarks: Sequence[Finding]) -> Record:
    """Return the record with notes of what was done to its columns, and of what was guessed, if anything was."""
    record = replace(record, remarks=(*record.remarks, *(replace(remark, record=record.name) for remark in remarks)))
    phrase = told(guesses)
    if not phrase:
        return record
    message = f"read by guess: {phrase}; `servolens convert` shows why."
    remark = Finding(code="columns_guessed", severity="note", message=message, record=record.name)
    return replace(record, remarks=(*record.remarks, remark))
