"""How a log is read: a guess with its evidence for every column, unit and gain that nobody has stated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["Guess", "told"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """How one quantity of a record was found.

    Parameters
    ----------
    quantity : str
        A signal such as ``"position"``, or a setting such as ``"kp"``.
    source : str
        Name of the column, or what else it was taken from.
    value : str
        The unit of a column; number and unit of a setting.
    evidence : str
        Why it was read so.
    is_stated : bool
        Whether the file or the caller says it in so many words: then nothing was guessed.
    """

    quantity: str
    source: str
    value: str
    evidence: str
    is_stated: bool = False

    def to_json(self) -> dict[str, str | bool]:
        """Return the guess as a JSON object."""
        return {
            "quantity": self.quantity,
            "from": self.source,
            "value": self.value,
            "evidence": self.evidence,
            "stated": self.is_stated,
        }


def told(guesses: Iterable[Guess]) -> str:
    """Return what was guessed as one phrase, empty where nothing was.

    Examples
    --------
    >>> told([Guess(quantity="time", source="t_ms", value="ms", evidence="its name")])
    "time from 't_ms' [ms]"
    """
    return ", ".join(
        f"{guess.quantity} from '{guess.source}'" + (f" [{guess.value}]" if guess.value else "")
        for guess in guesses
        if not guess.is_stated
    )
