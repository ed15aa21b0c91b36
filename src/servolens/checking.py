"""What can be said against records before anything is made of them: each by itself, and all of them together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from servolens.identification.one_axis import contradiction
from servolens.inputs import as_records
from servolens.quality import assess

if TYPE_CHECKING:
    from servolens.findings import Finding
    from servolens.inputs import Records, RecordSettings

__all__ = ["check"]


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
    apart = contradiction([record for record, quality in zip(runs, qualities, strict=True) if quality.usable])
    return (*(finding for quality in qualities for finding in quality.findings), *((apart,) if apart else ()))
