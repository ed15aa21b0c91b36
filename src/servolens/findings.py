"""Findings about data or results, told beside the result and never changing it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, final

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Finding", "Severity", "listed", "together"]

Severity = Literal["note", "warning", "error"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One observation about a record or a result.

    Parameters
    ----------
    code : str
        Stable identifier in ``snake_case``, e.g. ``"gains_contradict_log"``.
    severity : {"note", "warning", "error"}
        An ``"error"`` makes a record unfit for identification.
    message : str
        One sentence: what was seen, where, what to do.
    record : str or None
        Name of the record it is about; None for the whole result.
    """

    code: str
    severity: Severity
    message: str
    record: str | None = None

    def to_json(self) -> dict[str, str | None]:
        """Return the finding as the JSON object of the results schema."""
        return {"code": self.code, "severity": self.severity, "message": self.message, "record": self.record}


def together(*groups: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the findings of all groups; what an earlier group has told of a record, a later one does not repeat."""
    told: list[Finding] = []
    for group in groups:
        known = {(finding.code, finding.record) for finding in told}
        told += [finding for finding in group if (finding.code, finding.record) not in known]
    return tuple(told)


def listed(words: Sequence[str], most: int = 4, last: str = "and") -> str:
    """Return `words` as a list in a sentence, at most `most` of them; semicolons part words that hold commas.

    Examples
    --------
    >>> listed(["a", "b", "c"]), listed(list("abcdefg"))
    ('a, b and c', 'a, b, c and 4 more')
    """
    mark = "; " if any("," in word for word in words) else ", "
    if len(words) > most:
        return f"{mark.join(words[: most - 1])} {last} {len(words) - most + 1} more"
    return f" {last} ".join([mark.join(words[:-1]), words[-1]] if len(words) > 1 else words)
