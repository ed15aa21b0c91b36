"""Single samples of the position that lie far off between their neighbours: the sensor's, not the axis's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.quality.sampling import Sampling
    from servolens.record import Record

__all__ = ["spike_findings"]

STANDS_OUT, STEPS, LEAST = 12.0, 3.0, 1e-4
"""Standard deviations, encoder steps and share of the travel by which a sample must lie off the cubic beside it."""
BENDS = 4.0
"""Times what bends the motion of its four neighbours by which it must do so: a knock or a slip bends them too.

It must exceed the motion between those beside it as well: a sample taken early, late or twice is no spike.
"""
EVEN = 0.5
"""Share of the sample time within which the neighbours' times agree."""


def spike_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield that samples of the position stick out by what no motion does, and the next is where it would be anyway."""
    if len(record) < 5:
        return
    x = record.position
    two_before, before, there, after, two_after = (x[i : len(x) - 4 + i] for i in range(5))
    off = there - (4.0 * (before + after) - two_before - two_after) / 6.0  # the cubic through the four neighbours
    even, odd = two_before + two_after - before - after, two_after - two_before - 2.0 * (after - before)
    least = STANDS_OUT * 1.4826 * float(np.median(np.abs(off))) + STEPS * (seen.step or 0.0) + LEAST * seen.travel
    moves = np.maximum(np.abs(after - before), BENDS * np.maximum(np.abs(even), np.abs(odd)))
    places = np.flatnonzero((np.abs(off) > least + moves) & _evenly_logged(record.time)) + 2
    if not places.size:
        return
    worst = places[int(np.argmax(np.abs(off[places - 2])))]
    several = f" ({places.size} such samples)" if places.size > 1 else ""
    message = (
        f"the position leaps by {abs(off[worst - 2]):.3g} {record.length_unit} at {record.time[worst]:g} s for one"
        f" sample and is back{several}: the sensor is disturbed; put what lies between its neighbours in its place."
    )
    yield Finding(code="position_spikes", severity="warning", message=message)


def _evenly_logged(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of each sample but the outer two whether the intervals beside it are alike."""
    intervals = np.diff(time)
    usual = float(np.median(intervals))
    alike = np.abs(intervals - usual) < EVEN * usual
    good: NDArray[np.bool_] = alike[:-3] & alike[1:-2] & alike[2:-1] & alike[3:]
    return good
