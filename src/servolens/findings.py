"""Findings about data or results, told beside the result and never changing it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["Finding", "Severity", "grouped", "together"]

Severity = Literal["note", "warning", "error"]
ACCELERATION = re.compile(r"(?<=/s)\^2\b")
MOST_NAMES = 4
"""Records that are named; the others are counted."""


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


def grouped(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings as people are told them: each once, of all records of which it is true, accelerations in m/s².

    Parameters
    ----------
    findings : iterable of Finding
        In the order in which they are told.

    Examples
    --------
    >>> found = grouped(Finding(code="gaps", severity="note", message="gaps.", record=name) for name in "abc")
    >>> [finding.record for finding in found]
    ['a, b and c']
    """
    records: dict[Finding, list[str]] = {}
    for finding in dict.fromkeys(findings):
        records.setdefault(replace(finding, record=None), []).extend([finding.record] if finding.record else [])
    return tuple(
        replace(finding, record=_listed(names), message=ACCELERATION.sub("²", finding.message))
        for finding, names in records.items()
    )


def together(*groups: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the findings of all groups; what an earlier group has told of a record, a later one does not repeat."""
    told: list[Finding] = []
    for group in groups:
        known = {(finding.code, finding.record) for finding in told}
        told += [finding for finding in group if (finding.code, finding.record) not in known]
    return tuple(told)


def _listed(names: list[str]) -> str | None:
    if len(names) > MOST_NAMES:
        names = [*names[: MOST_NAMES - 1], f"{len(names) - MOST_NAMES + 1} more"]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names) or None
