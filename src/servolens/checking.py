"""What can be said against records before anything is made of them: each by itself, and all of them together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from servolens.identification.one_axis import contradiction
from servolens.inputs import as_records
from servolens.quality import assess

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.findings import Finding
    from servolens.inputs import Records, RecordSettings
    from servolens.quality import RecordQuality
    from servolens.record import Record

__all__ = ["check", "contradictions"]


def check(records: Records, **settings: Unpack[RecordSettings]) -> tuple[Finding, ...]:
    """Return the findings of :func:`servolens.assess` on each of the records, and of all of them together.

    Of the latter there is one, ``records_contradict``: gain and damping explain records by themselves, but not with one
    gain, as of two axes.

    Examples
    --------
    >>> from servolens import lab
    >>> here, there = (lab.step_record(lab.Truth(gain=gain, damping=6.0), 40, noise=1e-5, seed=1) for gain in (2, 10))
    >>> [finding.code for finding in check([here, there])]
    ['records_contradict']
    """
    runs = as_records(records, settings)
    qualities = [assess(record) for record in runs]
    return (*(finding for quality in qualities for finding in quality.findings), *contradictions(runs, qualities))


def contradictions(records: Sequence[Record], qualities: Sequence[RecordQuality]) -> tuple[Finding, ...]:
    """Return what is found of all records together: of those that have no error of their own."""
    apart = contradiction([record for record, quality in zip(records, qualities, strict=True) if quality.usable])
    return (apart,) if apart else ()
