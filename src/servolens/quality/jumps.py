"""Places where the position jumps as no motion does: samples are lost although the time column hides it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.control_arithmetic import samples_a_tick
from servolens.control_law import controller_voltage
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.spikes import without_spikes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["jump_findings"]

SIDE = 4
"""Movements from sample to sample, on either side, that one is held against."""
OFFSETS = tuple(j for j in range(-SIDE, SIDE + 1) if j)
EVEN = 0.5
"""Share of this excess within which they must agree, and of the largest of them that it must be: a loss doubles it."""
MOVES = 3.0
"""Standard deviations of the sensor's error by which the axis moves on from sample to sample, before and after."""
STEP = 0.05
"""Share of its range from which on a change of the reference is a step, after which a slowly logged axis may jump."""
HOLDS = 0.3
"""Share of a jump in the derivative's voltage up to which the law holds, or its break is as large as the jump."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """Movements that stand out among those beside them.

    Attributes
    ----------
    places : ndarray of int
        The sample before each.
    sizes : ndarray
        By how much they exceed the mean of those beside them [m or rad].
    usual : ndarray
        That mean [m or rad].
    passing : ndarray of bool
        Whether the axis moves on evenly.
    """

    places: NDArray[np.intp]
    sizes: NDArray[np.float64]
    usual: NDArray[np.float64]
    passing: NDArray[np.bool_]

    def among(self, chosen: NDArray[np.bool_]) -> _Jumps:
        return _Jumps(self.places[chosen], self.sizes[chosen], self.usual[chosen], self.passing[chosen])


def jump_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield jumps of the position between two samples where the time column shows no gap, first by whole turns.

    An axis that moves on has none: an impact changes its speed, not its place. One at rest may have slipped; there only
    the control law tells, whose derivative knows of no jump if the controller has seen what the log lacks.
    """
    turns = _turns(record, seen)
    if turns.size:
        message = (
            f"the position jumps by a whole turn at {record.time[turns[0] + 1]:g} s"
            f"{f' ({turns.size} such places)' if turns.size > 1 else ''}: the sensor begins again after each turn;"
            " unwrap the column, so that it counts on."
        )
        yield Finding(code="position_wraps", severity="error", message=message)
        return
    jumps = _jumps(record, seen)
    if not jumps.places.size:
        return
    unseen, felt = _in_law(record, jumps)
    told = np.flatnonzero(jumps.passing | unseen)
    if not told.size:
        return
    at = int(told[np.argmax(np.abs(jumps.sizes[told]))])
    size, when = abs(float(jumps.sizes[at])), record.time[jumps.places[at] + 1]
    places = f" ({told.size} such places)" if told.size > 1 else ""
    where = f"the position jumps by {size:.3g} {record.length_unit} at {when:g} s{places}"
    lost, cut = "samples are lost, whatever the time column says", "log without gaps, or cut there"
    if unseen[at]:
        message = f"{where}, and the logged voltage knows nothing of it: {lost}; {cut}."
    elif felt[at]:
        message = f"{where} in the midst of even motion, and the voltage with it: check the sensor for lost counts."
    else:
        count = round(size / abs(float(jumps.usual[at])))
        message = f"{where}, as far as it goes in {count} samples there: {lost}, or the sensor has slipped; {cut}."
    yield Finding(code="position_jumps", severity="warning", message=message)


def _turns(record: Record, seen: Sampling) -> NDArray[np.intp]:
    """Return the samples before movements of about a whole turn among others of less than a quarter.

    Disturbed samples are no turn, at the ends of a record and where it is taken back within four samples; but a sensor
    on the border of its turn goes back and forth. Across a gap in time the axis may really have turned.
    """
    if record.length_unit != "rad" or len(record) <= 2 * SIDE:
        return np.empty(0, dtype=np.intp)
    moves, quarter = np.diff(without_spikes(record, seen).position), 0.5 * np.pi
    is_turn = (np.abs(np.abs(moves) - 2.0 * np.pi) < quarter) & (np.diff(record.time) < 1.5 * record.sample_time)
    is_fast = np.pad((np.abs(moves) >= quarter) & ~is_turn, SIDE)
    is_turn[:2] = is_turn[-2:] = False
    ways = np.pad(np.where(is_turn, np.sign(moves), 0.0), SIDE)
    beside = [slice(SIDE + j, SIDE + j + moves.size) for j in OFFSETS]
    is_among_fast = np.any([is_fast[one] for one in beside], axis=0)
    undone = np.any([ways[one] * np.sign(moves) < 0.0 for one in beside], axis=0) & is_turn
    few = np.count_nonzero(undone) <= SIDE
    return np.flatnonzero(is_turn & ~is_among_fast & ~(undone & few))


def _jumps(record: Record, seen: Sampling) -> _Jumps:
    """Return movements that exceed four on either side, which are alike, and every change elsewhere."""
    moves = np.diff(record.position)
    least = seen.outstanding
    places = _candidates(record, moves, least)
    one = moves[places]
    beside = moves[places + np.array(OFFSETS)[:, None]] * np.sign(one)
    longest = beside.max(axis=0)
    excess = np.abs(one) - longest
    slowest = np.minimum(beside[:SIDE].mean(axis=0), beside[SIDE:].mean(axis=0))
    usual = beside.mean(axis=0) * np.sign(one)
    passing = (excess > EVEN * longest) & (slowest > MOVES * seen.level)
    found = _Jumps(places, one - usual, usual, passing)
    large = (excess > least) & (longest - beside.min(axis=0) < EVEN * excess)
    large[large] = excess[large] > _elsewhere(moves, places[large])
    return found.among(large)


def _candidates(record: Record, moves: NDArray[np.float64], least: float) -> NDArray[np.intp]:
    """Return movements that differ from the one before and the one after, but for known gaps and answers to steps."""
    changes = np.abs(np.diff(moves))
    places = np.flatnonzero(np.minimum(changes[:-1], changes[1:]) > least) + 1
    places = places[(places >= SIDE) & (places < moves.size - SIDE)]
    known = record.time[places + 1] - record.time[places] > 1.5 * record.sample_time
    signal = record.voltage if record.reference is None else record.reference
    if signal is None:
        return places[~known]
    steps = np.concatenate(([0], np.cumsum(np.abs(np.diff(signal)) > STEP * np.ptp(signal))))
    stepped = steps[places] > steps[np.maximum(places - SIDE - 1, 0)]
    return places[~known & ~stepped]


def _elsewhere(moves: NDArray[np.float64], places: NDArray[np.intp]) -> float:
    """Return the largest change from one movement to the next that is not at one of the places."""
    changes = np.abs(np.diff(moves))
    changes[places - 1] = changes[places] = 0.0
    return float(changes.max(initial=0.0))


def _in_law(record: Record, jumps: _Jumps) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which jumps the derivative's voltage lacks, and which it holds; neither where it does not tell."""
    nothing = np.zeros(jumps.places.size, dtype=bool)
    loop, voltage = record.controller, record.voltage
    if loop is None or voltage is None or loop.derivative == "velocity":
        return nothing, nothing
    try:
        missed = voltage - controller_voltage(record)
        slow = samples_a_tick(loop, record.sample_time) > 1 or record.ticks > 1
    except InputError:
        return nothing, nothing
    jump = loop.kd * loop.derivative_filter * jumps.sizes / (loop.derivative_window * record.sample_time)
    after = missed[jumps.places + 1]
    before = np.abs(missed[jumps.places - np.arange(SIDE)[:, None]]).max(axis=0)
    tells = (before < HOLDS * np.abs(jump)) & (not slow)
    return tells & (np.abs(after - jump) < HOLDS * np.abs(jump)), tells & (np.abs(after) < HOLDS * np.abs(jump))
