"""How logs were read: each column, unit and gain with its evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summaries.wording import listed
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.reading import Guess, Reading

__all__ = ["reading_summary"]


MOST_NAMES = 4


def reading_summary(readings: Sequence[Reading]) -> Summary:
    """Tell how logs were read; what all of them share is told once.

    Parameters
    ----------
    readings : sequence of Reading
        One a log.
    """
    shared = [guess for guess in readings[0].guesses if all(guess in reading.guesses for reading in readings)]
    groups: dict[tuple[Guess, ...], list[str]] = {}
    for reading in readings:
        groups.setdefault(tuple(g for g in reading.guesses if g not in shared), []).append(_name(reading))
    guessed = sum(not guess.is_stated for guess in {*shared, *(guess for own in groups for guess in own)})
    tables = [_table("all of them", shared)] if shared and len(groups) > 1 else []
    for own, names in groups.items():
        rows = own if len(groups) > 1 else tuple(readings[0].guesses)
        if rows:
            tables.append(_table(listed(names) if len(names) <= MOST_NAMES else f"{len(names)} logs", rows))
    return Summary(
        title="Reading",
        sentences=(_counted(len(readings), guessed),),
        tables=tuple(tables),
        findings=tuple(
            remark for reading in readings for remark in reading.record.remarks if remark.code != "columns_guessed"
        ),
    )


def _name(reading: Reading) -> str:
    return reading.record.source.replace("\\", "/").rpartition("/")[2] or reading.record.name


def _table(whose: str, guesses: Sequence[Guess]) -> Table:
    return Table(
        title=f"How {whose} {'was' if ' ' not in whose else 'were'} read",
        columns=("Quantity", "From", "Unit or value", "Evidence"),
        rows=tuple(_row(guess) for guess in guesses),
    )


def _row(guess: Guess) -> tuple[str, str, str, str]:
    return guess.quantity, guess.source, guess.value or "–", guess.evidence or "stated"


def _counted(logs: int, guessed: int) -> str:
    what = "The log was read" if logs == 1 else f"{logs} logs were read"
    if not guessed:
        return f"{what} as stated; nothing was guessed."
    how_many = "one entry below is a guess" if guessed == 1 else f"{guessed} entries below are guesses"
    return f"{what}; {how_many}: check the evidence."
