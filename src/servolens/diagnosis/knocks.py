"""Records in which something knocked the axis, once: what follows there is left out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.case import Case
from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.bursts import knock_of
from servolens.identification.score import ScoreTest
from servolens.identification.structure import BLOCKS
from servolens.quality import assess
from servolens.units import readable

if TYPE_CHECKING:
    from servolens.diagnosis.decision import Decision
    from servolens.identification.bursts import Burst
    from servolens.record import Record

__all__ = ["KNOCKED", "without_knock"]

KNOCKED = "knocked_axis"
"""Code of the finding that a record ends before a knock, or is left out."""


def without_knock(found: Decision, singles: int) -> tuple[Case, Finding] | None:
    """Return the case of the records before a knock, and what to say of it; None where there is none that hid a cause.

    Beside one knock the noise model takes the axis for one that is always shaken, which hides causes. Without what
    follows it, one of the hypotheses that were likely explains the records.

    Parameters
    ----------
    found : Decision
        Whose causes do not explain the records.
    singles : int
        How many single effects are fitted to the records without a knock, the likeliest beside it.
    """
    case = found.case
    try:
        knock = knock_of(ScoreTest(case.likelihood, case.likelihood.whitened_well(found.path[-1])))
        if knock is None:
            return None
        quiet = Case(_before(case, knock), case.heldout, case.trials.priors, case.trials.candidates)
    except (InputError, NumericalError):
        return None
    is_explained = _is_explained(quiet, found, singles)
    case.likelihood.tally.add(quiet.likelihood.work)
    is_part = len(quiet.records) == len(case.records)
    return (quiet, _told(case.records[knock.record], knock, is_part=is_part)) if is_explained else None


def _before(case: Case, knock: Burst) -> tuple[Record, ...]:
    """Return the records, the one with the knock up to it; without that one where the axis has not moved before.

    The cut is a long block of samples before the block in which the knock is strongest.

    Raises
    ------
    InputError
        If no more than half of all samples is left.
    """
    struck, parts = case.records[knock.record], list(case.records)
    end = float(struck.time[0]) + knock.time - BLOCKS[-1] * case.likelihood.every * struck.sample_time
    before = np.count_nonzero(struck.time <= end)
    part = struck.slice(float(struck.time[0]), end) if before > 1 else None
    parts[knock.record : knock.record + 1] = [part] if part is not None and assess(part).usable else []
    if 2 * sum(map(len, parts)) <= sum(map(len, case.records)):
        raise InputError(f"{struck.name}: too little is left before something knocks the axis; log it again")
    return tuple(parts)


def _is_explained(case: Case, found: Decision, count: int) -> bool:
    """Tell whether one of the hypotheses that were likely beside a knock explains the records without it."""
    singles = sorted(found.found.singles, key=lambda one: one.total)[:count]
    plants = [case.base.plant, *(one.plant for one in (*found.path[1:], *singles))]
    return any(fit is not None and case.explains(fit) for fit in map(case.likelihood.judged, plants))


def _told(struck: Record, knock: Burst, *, is_part: bool) -> Finding:
    when = readable(knock.time, "s")
    what = "what follows" if is_part else "this record"
    message = (
        f"something moved the axis once, {when} into the record: a knock, a hand, or counts that the encoder lost."
        f" The causes are sought without {what}; log it again."
    )
    return Finding(code=KNOCKED, severity="warning", message=message, record=struck.name)
