"""Single samples of the position that lie far off between their neighbours: the sensor's, not the axis's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.clock import CHANGED
from servolens.control_law import controller_voltage
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.quality.sampling import SPAN, STEPS, measure

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["of_part", "spike_findings", "spikes", "spoilt", "without_spikes"]

LEAST = 1e-4
"""Share of the travel by which a sample must lie off the cubic beside it, however little noise there is."""
BENDS = 4.0
"""Times what bends the motion of its four neighbours by which it must do so: a knock bends them too.

It must exceed the motion between those beside it as well, unless the stated law misses the voltage there: a sample
taken early, late or twice is no spike, nor a plain slip.
"""
SPREADS, EXACT = 4.0, 1e-9
"""Robust standard deviations by which a law misses more than usual, and share of the voltage that is none."""
FURTHER = (-4, -3, 3, 4)
"""Samples that stick out much less: a spike does nothing to them, a vibration is there as well."""


def spike_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield that samples of the position stick out by what no motion does, and the next is where it would be anyway."""
    places, heights = spikes(record, seen)
    if not places.size:
        return
    worst = int(np.argmax(np.abs(heights)))
    several = f" ({places.size} such samples)" if places.size > 1 else ""
    message = (
        f"the position leaps by {abs(heights[worst]):.3g} {record.length_unit} at {record.time[places[worst]]:g} s for"
        f" one sample and is back{several}: the sensor is disturbed. Look after its cable and shielding; fits,"
        " predictions and diagnoses interpolate such samples between their neighbours."
    )
    yield Finding(code="position_spikes", severity="warning", message=message)


def spikes(record: Record, seen: Sampling | None = None) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return which single samples of the position stick out, and by how much [m or rad].

    What is `seen` of the record is measured if it is not given.

    The outer two at either end are not judged, nor three spikes within four samples of each other; and where every
    sixth sample sticks out, none does.
    """
    if len(record) < 5:
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    x = record.position
    two_before, before, _, after, two_after = (x[i : len(x) - 4 + i] for i in range(5))
    off = _off_cubic(x)
    least = SPAN * 1.4826 * float(np.median(np.abs(off))) + LEAST * float(np.ptp(x))
    if not (np.abs(off) > least).any():
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    seen = seen or measure(record)
    bend = two_before + two_after - before - after
    beside = np.pad(np.abs(off), 4)
    further = np.max([beside[4 + j : 4 + j + off.size] for j in FURTHER], axis=0)
    step = max(seen.step or 0.0, record.encoder_resolution or 0.0)
    least += STEPS * step
    moved = np.where(spoilt(record)[2:-2] & _is_single(off), 0.0, np.abs(after - before))
    usual = np.maximum(moved, BENDS * np.maximum(np.abs(bend), further))
    places = np.flatnonzero((np.abs(off) > least + usual) & _evenly_logged(record.time))
    alone, heights = places + 2, off[places]
    rest = x.copy()
    rest[alone] -= heights
    together = [one for one in _pairs(rest, least, _evenly_logged(record.time)) if one[0] not in alone]
    if not together:
        return alone, heights
    found = np.array([*zip(alone, heights, strict=True), *together])
    found = found[np.argsort(found[:, 0])]
    return found[:, 0].astype(np.intp), found[:, 1]


def _off_cubic(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each sample but the outer two is off the cubic through its four neighbours."""
    two_before, before, there, after, two_after = (x[i : len(x) - 4 + i] for i in range(5))
    return there - (4.0 * (before + after) - two_before - two_after) / 6.0


def _is_single(off: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell where samples are `off` their cubics rather as one sample makes them than as a slip does.

    Both follow from the cubic, in units of what the sample itself is off by.
    """
    spike, slip = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0, np.array([0.0, -1.0, 3.0, -3.0, 1.0]) / 3.0
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(off, 2), 5)
    away = [np.sum((beside - off[:, None] * shape) ** 2, axis=1) for shape in (spike, slip, slip[::-1])]
    return np.asarray(np.argmin(away, axis=0) == 0)


def _pairs(x: NDArray[np.float64], least: float, evenly: NDArray[np.bool_]) -> list[tuple[int, float]]:
    """Return the samples that stick out within four of each other, which hides both, and by how much.

    Without the two, a cubic has to fit what is left better by far than them, and they to exceed what the axis moves
    across them.
    """
    beside = max(FURTHER)
    out = {int(k) + 2 for k in np.flatnonzero(np.abs(_off_cubic(x)) > least)}
    found: list[tuple[int, float]] = []
    for first in sorted(out):
        for apart in range(1, beside + 1):
            low, stop = first - beside, first + apart + beside + 1
            if first + apart not in out or low < 2 or stop > x.size - 2 or not evenly[low - 2 : stop - 2].all():
                continue
            two, time = [beside, beside + apart], (np.arange(low, stop) - first) / beside
            powers = np.vander(time, 4)
            others = np.delete(np.arange(time.size), two)
            fitted = powers @ np.linalg.lstsq(powers[others], x[low:stop][others], rcond=None)[0]
            off = x[low:stop] - fitted
            moved = abs(x[first + apart + 1] - x[first - 1])
            if np.min(np.abs(off[two])) > least + max(BENDS * float(np.max(np.abs(off[others]))), moved):
                found += [(first, float(off[two[0]])), (first + apart, float(off[two[1]]))]
    places = [place for place, _ in found]
    return [one for one in found if places.count(one[0]) == 1]  # two pairs that share a sample are no pairs


def without_spikes(record: Record, seen: Sampling | None = None) -> Record:
    """Return `record` with what lies between its neighbours in the place of each sample that sticks out."""
    places, heights = spikes(record, seen)
    if not places.size:
        return record
    position = record.position.copy()
    position[places] -= heights
    return record.with_({"position": position})


def spoilt(record: Record) -> NDArray[np.bool_]:
    """Mark the few samples in a row at which the stated law misses the voltage, as the sensor of a log lets it do.

    Samples that stick out next to each other cannot be told from a motion; but the law misses the voltage there alone.
    Of a law that is stated wrongly it misses whole motions.
    """
    found = np.zeros(len(record), dtype=bool)
    if record.voltage is None or not record.has_loop:
        return found
    try:
        missed = np.abs(record.voltage - controller_voltage(record))
    except InputError:  # of a law that is impossible, which is told by itself
        return found
    usual = max(SPREADS * 1.4826 * float(np.median(missed)), EXACT * float(np.max(np.abs(record.voltage))))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], missed > usual, [0]))))
    longest = max(FURTHER) + (record.controller.derivative_window if record.controller else 1)
    for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        found[first:stop] = stop - first <= longest
    return found


def of_part(marks: NDArray[np.bool_], record: Record, part: Record) -> NDArray[np.bool_]:
    """Return those of the marks of a record's samples that are of a part of it."""
    first = int(np.searchsorted(record.time, part.time[0])) if len(part) < len(record) else 0
    return marks[first : first + len(part)]


def _evenly_logged(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of each sample but the outer two whether the intervals beside it are alike."""
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    alike = np.abs(intervals - usual) < CHANGED * usual
    good: NDArray[np.bool_] = alike[:-3] & alike[1:-2] & alike[2:-1] & alike[3:]
    return good
