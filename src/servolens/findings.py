"""Findings about data or results, told beside the result and never changing it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

__all__ = ["Finding", "Severity"]

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
