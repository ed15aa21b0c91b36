"""Before physics is blamed: what the logs themselves have wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality import check

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["apart", "log_findings"]

FAR_APART = 0.2
"""Relative difference of gains from which on two records are held to be of different axes."""
BLAMED = {
    "law_contradicts_log",
    "gains_contradict_log",
    "voltage_shifted",
    "clipped_voltage",
    "dead_voltage",
    "encoder_contradicts_log",
    "gaps",
    "impossible_controller",
    "jitter",
    "voltage_beyond_limit",
    "wrong_sign",
}
"""Findings about a log that may look like physics."""


def log_findings(records: Sequence[Record]) -> list[Finding]:
    """Return what is wrong with the logs, what may look like physics first.

    Raises
    ------
    InputError
        If a record is unfit to be identified from.
    """
    found = []
    for record in records:
        for finding in check(record):
            if finding.severity == "error":
                raise InputError(f"{record.name}: {finding.message}")
            found.append(replace(finding, record=record.name))
    return sorted(found, key=lambda f: (f.code not in BLAMED, f.severity != "warning"))


def apart(plants: Sequence[Plant], names: Sequence[str]) -> Finding | None:
    """Return a finding if `plants`, one fitted to each record alone, cannot be the same axis.

    Parameters
    ----------
    plants : sequence of Plant
        Each explains its own record.
    names : sequence of str
        Of the records.
    """
    order = sorted(range(len(plants)), key=lambda i: plants[i].gain)
    low, high = order[0], order[-1]
    a, b = plants[low].gain, plants[high].gain
    if a * b > 0 and abs(b - a) <= FAR_APART * max(abs(a), abs(b)):
        return None
    unit = plants[low].unit("gain")
    return Finding(
        code="records_contradict",
        severity="warning",
        message=(
            f"the records contradict each other: each by itself is explained, with a gain of {a:.4g} {unit} in "
            f"{names[low]} and of {b:.4g} in {names[high]}; are they of the same axis, load and units?"
        ),
    )
