"""What a log that holds the voltage in steps does not say: whether it was rounded for the log, or for the motor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.case import Case
from servolens.diagnosis.loop_rate import decided_beside_loop, likeliest_beside
from servolens.encoder import quantisation_step
from servolens.findings import Finding
from servolens.identification.hypothesis import LIKELIER
from servolens.rounded_voltage import with_exact_voltage
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servolens.diagnosis.decision import Decision
    from servolens.diagnosis.effort import Effort
    from servolens.identification.options import Prior
    from servolens.record import Record

__all__ = ["decided_beside_voltage"]


def decided_beside_voltage(
    records: tuple[Record, ...],
    heldout: tuple[Record, ...],
    priors: Mapping[str, Prior],
    candidates: int,
    effort: Effort,
    tell: Callable[[str, float], None],
) -> Decision:
    """Decide on the causes beside the voltage, rounded or not, that makes the records likeliest.

    A log of whole PWM counts holds what the motor got; one of two decimals does not, and the law of the loop knows it
    better. So the search begins, unless gain and damping alone tell; where beside its causes the records are likelier
    with the other one, it is decided again with that.

    Parameters
    ----------
    records, heldout, priors, candidates
        As of :class:`~servolens.diagnosis.case.Case`, the voltage as logged.
    effort, tell
        As of :func:`~servolens.diagnosis.decision.decided`; a further search takes half of the effort.

    Raises
    ------
    InputError, NumericalError
        As :class:`~servolens.diagnosis.case.Case`.
    """
    logged = records, heldout
    exact = tuple(map(with_exact_voltage, records)), tuple(map(with_exact_voltage, heldout))
    if all(new is old for new, old in zip(exact[0], records, strict=True)):
        return decided_beside_loop(*exact, priors, candidates, effort, tell)
    first, other = Case(*exact, priors, candidates), Case(*logged, priors, candidates)
    likelier = first.base.total - other.base.total
    if likelier > LIKELIER or (likelier > -LIKELIER and not all(map(_is_of_text, records))):
        first, other = other, first
    given = priors, candidates
    found = decided_beside_loop(first.records, first.heldout, *given, effort, lambda what, share: tell(what, share / 2))
    likelier = likeliest_beside(first, found) - likeliest_beside(other, found)
    if likelier > LIKELIER:
        first, part = other, replace(effort, work=0.5 * effort.work)
        found = decided_beside_loop(
            first.records, first.heldout, *given, part, lambda what, share: tell(what, (1.0 + share) / 2)
        )
    if first.records is not records or abs(likelier) <= LIKELIER:
        return found
    return _told(found, [new for new, old in zip(records, exact[0], strict=True) if new is not old])


def _is_of_text(record: Record) -> bool:
    """Tell whether the steps of a record's voltage are those of decimals; whole numbers are rather counts of a PWM."""
    step = None if record.voltage is None else quantisation_step(record.voltage)
    return step is None or bool(step < 1.0 and np.isclose(step, 10.0 ** round(math.log10(step)), rtol=1e-6))


def _told(decision: Decision, records: Sequence[Record]) -> Decision:
    """Say that the motor got the steps in which these records hold the command."""
    steps = [quantisation_step(record.voltage) for record in records if record.voltage is not None]
    largest = readable(max(step for step in steps if step is not None), records[0].command_unit)
    message = (
        f"the log holds the command in steps of {largest}, and the motion shows that the motor got these steps: it was"
        " not rounded for the log only. The logged command is taken as it is; a simulated loop is without the steps."
    )
    finding = Finding(code="command_in_steps", severity="note", message=message)
    return replace(decision, findings=(*decision.findings, finding))
