"""What a log does not say of its loop: how often it ran between the samples, and by which time it divided.

Of logs slower than their loop it is asked whether the command went on to change between the samples, and when it jumped
there; of uneven ones without a voltage whether the loop measured its time steps.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import controller_voltage, differs_by_time_steps, rms
from servolens.diagnosis.case import Case
from servolens.diagnosis.decision import Decision, decided
from servolens.diagnosis.knocks import KNOCKED
from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.hypothesis import LIKELIER
from servolens.jump_times import with_timed_jumps
from servolens.prediction import beginning
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from servolens.diagnosis.effort import Effort
    from servolens.identification.options import Prior
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["decided_beside_loop", "likeliest_beside"]

USUAL = 1.5e-3
"""Sample time up to which a log is taken to hold every tick of its loop [s]: position loops seldom run faster than
1 kHz."""
FIRST, OTHERS = (2, 5), (3, 4, 6, 8, 10, 20)
"""Ticks from one sample of the slowest log to the next that are tried, the others if one of the first is likelier; by
more than twenty the held command is no longer seen."""


def decided_beside_loop(
    records: tuple[Record, ...],
    heldout: tuple[Record, ...],
    priors: Mapping[str, Prior],
    candidates: int,
    effort: Effort,
    tell: Callable[[str, float], None],
) -> Decision:
    """Decide on the causes beside the loop that makes the records likeliest, as far as they do not state it.

    Where no causes explain uneven records without a voltage, or something seems to shake their axis, and they are
    likelier if their loop divided by the time from sample to sample, it is decided again beside such a loop.

    Parameters
    ----------
    records, heldout, priors, candidates
        As of :class:`~servolens.diagnosis.case.Case`.
    effort, tell
        As of :func:`~servolens.diagnosis.decision.decided`; a further search takes half of the effort.

    Raises
    ------
    InputError, NumericalError
        As :class:`~servolens.diagnosis.case.Case`.
    """
    found = _beside_loop_rate(records, heldout, priors, candidates, effort, tell)
    if found.contradiction is not None:
        return found
    own = found.case.records, found.case.heldout
    others = [tuple(map(_measuring, group)) for group in own]
    is_known = all(new is old for new, old in zip(others[0], own[0], strict=True))
    is_calm = _explains(found) and found.path[-1].noise.rate == 0.0
    if is_known or is_calm:
        return found
    with suppress(InputError, NumericalError):
        plain = Case(*own, priors, candidates) if found.case.likelihood.simulates else found.case
        case = Case(others[0], others[1], priors, candidates)
        if likeliest_beside(case, found) < likeliest_beside(plain, found) - LIKELIER:
            again = _told_of_time_steps(found, decided(case, replace(effort, work=0.5 * effort.work), tell))
            return min(found, again, key=lambda one: (not _explains(one), _simulated_error(one)))
    return found


def _measuring(record: Record) -> Record:
    """Return the record with a loop that measured its time steps, where it may have and its log does not show it."""
    loop = record.controller
    if loop is None or record.voltage is not None or not record.has_loop or loop.time_step == "measured":
        return record
    if record.ticks > 1 or not differs_by_time_steps(record):
        return record
    return record.with_({"controller": replace(loop, time_step="measured")})


def _beside_loop_rate(
    records: tuple[Record, ...],
    heldout: tuple[Record, ...],
    priors: Mapping[str, Prior],
    candidates: int,
    effort: Effort,
    tell: Callable[[str, float], None],
) -> Decision:
    """Decide on the causes; where a slow log is likelier if its loop ran faster than it, beside such a loop.

    A command that is held until the next sample is late by half a sample on average, and no cause of the catalogue
    makes it earlier: it is asked where no causes explain the records. How often the loop ran is asked again beside the
    causes that were found; so is at which of its ticks the reference jumped, for before there is a plant, friction can
    look like a jump that comes a tick sooner and a delay that is a tick longer.

    Parameters
    ----------
    records, heldout, priors, candidates
        As of :class:`~servolens.diagnosis.case.Case`.
    effort, tell
        As of :func:`~servolens.diagnosis.decision.decided`; each further search takes half of the effort.

    Raises
    ------
    InputError, NumericalError
        As :class:`~servolens.diagnosis.case.Case`.
    """
    held = Case(records, heldout, priors, candidates)
    if _is_known(records):
        return _beside_timed_jumps(decided(held, effort, tell), priors, candidates, effort, tell)
    found = [decided(held, effort, lambda what, share: tell(what, 0.5 * share))]
    if _explains(found[0]):
        return found[0]
    cases = _faster(held, priors, candidates, FIRST)
    if not any(case.base.total < held.base.total - LIKELIER for case in cases):
        return found[0]
    cases += _faster(held, priors, candidates, OTHERS)
    likeliest = min(cases, key=lambda case: (not case.explains(case.base), case.base.total))
    part = replace(effort, work=0.5 * effort.work)
    found.append(decided(likeliest, part, lambda what, share: tell(what, 0.5 + 0.5 * share)))
    if not _explains(found[-1]):
        again = min((held, *cases), key=lambda case: likeliest_beside(case, found[-1]))
        if again is not likeliest and again is not held:
            found.append(decided(again, part, tell))
    found[-1] = _beside_timed_jumps(found[-1], priors, candidates, part, tell)
    chosen = min(found, key=lambda one: (not _explains(one), _simulated_error(one)))
    return chosen if _fastest(chosen.case).ticks == 1 else _told(chosen)


def _beside_timed_jumps(
    found: Decision,
    priors: Mapping[str, Prior],
    candidates: int,
    effort: Effort,
    tell: Callable[[str, float], None],
) -> Decision:
    """Decide again, with half of the effort, where beside the causes the reference jumped at other ticks of the loop.

    All jumps are moved by a tick, which a delay takes up, or each by itself, as long as the causes become likelier.
    """
    if found.contradiction is not None or _explains(found) or _fastest(found.case).ticks == 1:
        return found
    plain = found.case
    if plain.likelihood.simulates:
        plain = Case(plain.records, plain.heldout, priors, candidates)
    begun = plain.likelihood.judged(found.path[-1].plant)
    if begun is None:
        return found
    case, least, plant = plain, begun.total, begun.plant
    for _ in range(_fastest(plain).ticks):
        tried = [_moved(case, priors, candidates, partial(_by_ticks, count)) for count in (-1, 1)]
        tried.append(_moved(case, priors, candidates, partial(_as_simulated, plant)))
        fits = [(one, fit) for one in tried if one is not None and (fit := one.likelihood.judged(plant)) is not None]
        best, fit = min(fits, key=lambda one: one[1].total, default=(case, None))
        if fit is None or not fit.total < least - LIKELIER:
            break
        case, least, plant = best, fit.total, fit.plant
    if case is plain:
        return found
    again = decided(case, replace(effort, work=0.5 * effort.work), tell)
    left_out = (finding for finding in found.findings if finding.code == KNOCKED)
    again = replace(again, findings=(*left_out, *again.findings))
    return min(found, again, key=lambda one: (not _explains(one), _simulated_error(one)))


def _moved(case: Case, priors: Mapping[str, Prior], candidates: int, moved: Callable[[Record], Record]) -> Case | None:
    """Return the case of jumps at other ticks; None where none of them moves, or where it is impossible."""
    with suppress(InputError, NumericalError):
        groups = [tuple(map(moved, group)) for group in (case.records, case.heldout)]
        if any(new is not old for new, old in zip(groups[0], case.records, strict=True)):
            return Case(groups[0], groups[1], priors, candidates)
    return None


def _by_ticks(count: int, record: Record) -> Record:
    """Return the record with its jumps so many ticks sooner, as far as they still come between the same samples."""
    if record.jump_leads is None or record.ticks == 1:
        return record
    tick, jumps = record.sample_time / record.ticks, record.jumps()
    leads = record.jump_leads.copy()
    latest = np.maximum(np.diff(record.time)[jumps - 1] - tick, 0.0)
    leads[jumps] = np.clip(leads[jumps] + count * tick, 0.0, latest)
    return record if np.array_equal(leads, record.jump_leads) else replace(record, jump_leads=leads)


def _as_simulated(plant: Plant, record: Record) -> Record:
    """Return the record with each jump where a simulation of the plant is closest."""
    if record.jump_leads is None or record.ticks == 1:
        return record
    leads = beginning(plant, record).record.jump_leads
    return record if leads is None or np.array_equal(leads, record.jump_leads) else replace(record, jump_leads=leads)


def _is_known(records: tuple[Record, ...]) -> bool:
    """Tell whether the slowest logs hold every tick, or a log says how many there were."""
    if any(r.ticks > 1 or (r.controller is not None and r.controller.control_period) for r in records):
        return True
    slowest = max(r.sample_time for r in records)
    return slowest <= USUAL or any(_shows_each_tick(r) for r in records if round(slowest / r.sample_time) == 1)


def _shows_each_tick(record: Record) -> bool:
    """Tell whether the logged command is made of differences from sample to sample: then the loop ran at these.

    The derivative of a loop twice as fast comes a quarter of a sample sooner, half as much as one over two samples
    comes later. The law computed from the samples would miss the command of such a loop by at least that much, so a
    misfit below half of it shows that the loop ran at the samples. Where the voltage is rounded more coarsely than
    that, the question stays open.
    """
    loop, voltage = record.controller, record.voltage
    if loop is None or loop.kd == 0.0 or loop.derivative != "position" or voltage is None or record.reference is None:
        return False
    over_two = replace(loop, derivative_window=2 * loop.derivative_window)
    later = loop.kd * (record.answer(over_two).derivative - record.answer(loop).derivative)
    missed = voltage - controller_voltage(record)
    limit = math.inf if record.voltage_limit is None else record.voltage_limit
    free = np.abs(voltage) < limit
    free[: len(record) // 10] = False  # what was before a record is not known
    return rms(missed[free]) < 0.5 * (0.5 * rms(later[free]))


def _faster(held: Case, priors: Mapping[str, Prior], candidates: int, counts: tuple[int, ...]) -> list[Case]:
    """Return the cases of loops that ran so often from one sample of the slowest log to the next, as far as they do."""
    slowest, found = max(record.sample_time for record in held.records), []
    for count in counts:
        with suppress(InputError, NumericalError):
            groups = [_with_loop(group, slowest / count) for group in (held.records, held.heldout)]
            found.append(Case(groups[0], groups[1], priors, candidates))
    return found


def _with_loop(records: tuple[Record, ...], period: float) -> tuple[Record, ...]:
    """Return the records of a loop of that period [s], as often as it ran in each of them."""
    return with_timed_jumps([record.with_ticks(max(round(record.sample_time / period), 1)) for record in records])


def _fastest(case: Case) -> Record:
    """Return the record whose loop ran most often between its samples."""
    return max(case.records, key=lambda record: record.ticks)


def _explains(decision: Decision) -> bool:
    return decision.contradiction is None and decision.case.explains(decision.path[-1])


def likeliest_beside(case: Case, found: Decision) -> float:
    """Return −2 log-likelihood of what was found, fitted to the records of another case.

    Of the causes, or of the likeliest alone: beside what is wrong of the records others make up for it.
    """
    alone = sorted(found.found.singles, key=lambda h: h.total)[:1]
    fits = [case.likelihood.judged(h.plant) for h in (found.path[-1], *alone)]
    return min((h.total for h in fits if h is not None), default=math.inf)


def _simulated_error(decision: Decision) -> float:
    return decision.case.gains([decision.path[-1]]).tested(-1)


def _told(decision: Decision) -> Decision:
    record = _fastest(decision.case)
    message = (
        f"the axis answers to commands between the samples: its loop ran faster than the log, about {record.ticks}"
        f" times in {readable(record.sample_time, 's')}, which is assumed here. State control_period, the period of"
        " the loop, so that predictions and designs use it too."
    )
    finding = Finding(code="loop_faster_than_log", severity="warning", message=message)
    return replace(decision, findings=(*decision.findings, finding))


def _told_of_time_steps(before: Decision, decision: Decision) -> Decision:
    message = (
        "no voltage is logged, and the motion is likelier if the controller computed speeds with the time that it"
        " measured between samples, not with a fixed period; that is assumed here. State time_step = measured, so that"
        " predictions do the same."
    )
    finding = Finding(code="time_steps_assumed", severity="warning", message=message)
    left_out = (finding for finding in before.findings if finding.code == KNOCKED)
    return replace(decision, findings=(*left_out, *decision.findings, finding))
