"""Before physics is blamed: what the logs themselves have wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Saturation
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.identification.one_axis import apart
from servolens.identification.segments import applied_voltage
from servolens.quality import assess, fatal
from servolens.quality.limits import NEAR

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servolens.diagnosis.result import Cause
    from servolens.record import Record

__all__ = ["BEYOND", "apart", "beyond", "is_blamed", "log_findings", "lower_limit"]

BEYOND = 1.3
"""Times the largest command of the training records from which on a record is an extrapolation."""
BLAMED = (
    "columns_exchanged",
    "units_contradict",
    "wrong_sign",
    "unsigned_voltage",
    "impossible_controller",
    "onset_missed",
    "reference_shifted",
    "position_shifted",
    "voltage_shifted",
    "position_jumps",
    "gains_contradict_log",
    "settings_contradict_log",
    "added_to_law",
    "law_contradicts_log",
    "clipped_voltage",
    "dead_voltage",
    "encoder_contradicts_log",
    "gaps",
    "jitter",
    "voltage_beyond_limit",
)
"""Findings about a log that may look like physics, the gravest first."""


def is_blamed(finding: Finding) -> bool:
    """Tell whether it warns of something about a log that may look like physics."""
    return finding.code in BLAMED and finding.severity != "note"


def log_findings(records: Sequence[Record]) -> list[Finding]:
    """Return what is wrong with the logs, what may look like physics first.

    Among them are those that are :func:`~servolens.quality.fatal`: a model can be found, but not be trusted.

    Raises
    ------
    InputError
        If a record is unfit to be identified from.
    """
    found = []
    for record in records:
        for finding in assess(record).findings:
            if finding.severity == "error" and not fatal([finding]):
                raise InputError(f"{record.name}: {finding.message}")
            found.append(replace(finding, record=record.name))
    return sorted(found, key=lambda f: (not is_blamed(f), BLAMED.index(f.code) if f.code in BLAMED else len(BLAMED)))


def beyond(trained: Sequence[Record], others: Sequence[Record]) -> list[Finding]:
    """Return a finding for each of `others` whose command goes far beyond all that was `trained` on."""
    known = max(float(np.max(np.abs(applied_voltage(record)))) for record in trained)
    found = []
    for record in others:
        most = float(np.max(np.abs(applied_voltage(record))))
        if most > BEYOND * known:
            message = (
                f"an extrapolation: its command reaches {most:.3g} {record.command_unit}, that of the"
                f" training records {known:.3g}; limits and laws that show only beyond are not in the model."
            )
            found.append(Finding(code="extrapolation", severity="warning", message=message, record=record.name))
    return found


def lower_limit(records: Sequence[Record], causes: Sequence[Cause]) -> Iterator[Finding]:
    """Yield a finding if the causes name a limit of the amplifier, and nothing else, below the one that is stated."""
    stated = min((record.voltage_limit for record in records if record.voltage_limit is not None), default=None)
    for cause in causes:
        if stated is None or cause.effect != Saturation.name or cause.rivals:
            continue
        limit, unit = cause.quantities["limit"], records[0].command_unit
        if limit.interval is not None and (1.0 + NEAR) * limit.interval[1] < stated:
            message = (
                f"the records show that the amplifier gives no more than {limit.value:.3g} {unit}; the stated limit is"
                f" {stated:.4g} {unit}. State voltage_limit = {limit.value:.3g} {unit}."
            )
            yield Finding(code="limit_contradicts_log", severity="warning", message=message)
