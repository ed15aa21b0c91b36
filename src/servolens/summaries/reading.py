"""How logs were read: each column, unit and gain with its evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.reading import Guess, Reading

__all__ = ["reading_summary"]


def reading_summary(readings: Sequence[Reading]) -> Summary:
    """Tell how logs were read; what all of them share is told once.

    Parameters
    ----------
    readings : sequence of Reading
        One a log.
    """
    shared = [guess for guess in readings[0].guesses if all(guess in reading.guesses for reading in readings)]
    own = [(reading, guess) for reading in readings for guess in reading.guesses if guess not in shared]
    guessed = sum(not guess.is_stated for guess in {guess: None for reading in readings for guess in reading.guesses})
    tables = []
    if shared:
        whose = readings[0].record.name if len(readings) == 1 else f"all {len(readings)} logs"
        tables.append(
            Table(
                title=f"How {whose} {'was' if len(readings) == 1 else 'were'} read",
                columns=("Quantity", "From", "Unit or value", "Evidence"),
                rows=tuple(_row(guess) for guess in shared),
            )
        )
    if own:
        tables.append(
            Table(
                title="What differs",
                columns=("Record", "Quantity", "From", "Unit or value", "Evidence"),
                rows=tuple((reading.record.name, *_row(guess)) for reading, guess in own),
            )
        )
    return Summary(
        title="Reading",
        sentences=(_counted(len(readings), guessed),),
        tables=tuple(tables),
        findings=tuple(
            remark for reading in readings for remark in reading.record.remarks if remark.code != "columns_guessed"
        ),
    )


def _row(guess: Guess) -> tuple[str, str, str, str]:
    return guess.quantity, guess.source, guess.value or "SI", guess.evidence or "stated"


def _counted(logs: int, guessed: int) -> str:
    what = "The log was read" if logs == 1 else f"{logs} logs were read"
    if not guessed:
        return f"{what} as stated; nothing was guessed."
    how_many = "one entry below is a guess" if guessed == 1 else f"{guessed} entries below are guesses"
    return f"{what}; {how_many}: check the evidence."
