"""When the reference jumped between two samples of a log slower than its loop: the motion shows it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.clock import cycles_passed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.record import Record

    Signal = NDArray[np.float64]

__all__ = ["with_timed_jumps"]

BEFORE, AFTER, FEWEST = 6, 12, 9
"""Samples before and after a jump that tell when it came; fewest of them, for they have six unknowns."""
FINEST = 20
"""Times between two samples that are told apart at most."""
LATEST = 2
"""Samples by which the axis answers late at most: its delay, or what looks like one."""
ROUNDS = 10
"""Of gain and damping, and of the times beside them; two or three are enough."""
SHOWN = 12.0
"""By how much the squared error, in units of its variance, falls with a delay that is one: chance does that once in two
thousand cases."""


def with_timed_jumps(records: Sequence[Record]) -> tuple[Record, ...]:
    """Return records of one axis, each with the times at which its reference jumped, where their loops ran faster.

    Around a jump the axis obeys ``y = y₀ + v₀ t + ½ a₀ t² − c∫y + β∬V``, V being late by a delay. Delay, gain β and
    damping c are shared; the tick at which V jumps is the one that leaves least.

    Parameters
    ----------
    records : sequence of Record
        Those without a logged voltage, and those whose times are known, stay as they are.
    """
    found = list(records)
    voltages = {i: r.voltage for i, r in enumerate(records) if r.voltage is not None}
    chosen = [i for i in voltages if records[i].jump_leads is None and records[i].ticks > 1]
    for alike in _logged_alike(records, chosen):
        windows = {i: _windows(records[i], voltages[i]) for i in alike}
        flat = [window for some in windows.values() for window in some]
        leads = iter(_leads(flat) if flat else ())
        for i, some in windows.items():
            signal = np.zeros(len(records[i]))
            for window in some:
                signal[window.sample] = next(leads)
            found[i] = replace(records[i], jump_leads=signal)
    return tuple(found)


def _logged_alike(records: Sequence[Record], chosen: Sequence[int]) -> list[list[int]]:
    """Return the `chosen` records by their sample time and ticks: only delays in like steps can be compared."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i in chosen:
        groups.setdefault((float(f"{records[i].sample_time:.3g}"), records[i].ticks), []).append(i)
    return list(groups.values())


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """Samples around one jump, what is linear in them without initial state and constant force.

    Attributes
    ----------
    sample : int
        That first shows the jump.
    leads : ndarray, shape (k,)
        Times before it that are tried [s].
    position, drag : ndarray, shape (n,)
        y, and −∫y.
    pushes : ndarray, shape (d, k, n)
        ∬V for each delay, rising, and each of the times.
    """

    sample: int
    leads: Signal
    position: Signal
    drag: Signal
    pushes: Signal

    def left(self, delay: int, gain: float, damping: float) -> Signal:
        """Return what these leave of the position for each of the times, squared, shape (k,)."""
        missed = self.position - damping * self.drag - gain * self.pushes[delay]
        return np.asarray(np.sum(missed**2, axis=1))

    def best_alone(self, delay: int) -> int:
        """Return the time that leaves least beside a gain and damping of this window's own."""
        left = [np.linalg.lstsq(np.stack((self.drag, one), axis=1), self.position)[1] for one in self.pushes[delay]]
        return int(np.argmin([float(one[0]) if one.size else np.inf for one in left]))


def _windows(record: Record, voltage: Signal) -> list[_Window]:
    bounds, lost = np.concatenate(([0], record.edges(), [len(record)])), cycles_passed(record.time) > 1.0
    found = []
    for k in record.jumps().tolist():
        at = int(np.searchsorted(bounds, k))
        first, stop = max(k - BEFORE, int(bounds[at - 1])), min(k + AFTER, int(bounds[at + 1]))
        is_whole = not lost[first : stop - 1].any()
        if k - first > 1 and stop - k > 1 and stop - first >= FEWEST and is_whole:
            found.append(_window(record, voltage, k, first, stop))
    return found


def _window(record: Record, applied: Signal, k: int, first: int, stop: int) -> _Window:
    """Return the samples from `first` to `stop` around the jump that sample `k` shows."""
    from scipy.interpolate import CubicSpline

    count = min(record.ticks, FINEST)
    time, position = record.time[first:stop] - record.time[k], record.position[first:stop] - record.position[first]
    voltage, at = applied[first:stop], k - first
    ticks = np.interp(np.arange((time.size - 1) * count + 1), count * np.arange(time.size), time)
    leads, delays = np.arange(count), np.arange(LATEST * count)
    after, before = CubicSpline(time[at:], voltage[at:]), CubicSpline(time[:at], voltage[:at])
    right = np.where(ticks < 0.0, voltage[at] + after(0.0, 1) * ticks, after(ticks))
    left = np.where(ticks > time[at - 1], voltage[at - 1], before(ticks))
    places = np.arange(ticks.size)
    jumped = np.where(places >= at * count - leads[:, None], right, left)
    late = jumped[:, np.maximum(places - delays[:, None], 0)].transpose(1, 0, 2)
    motion, steps = CubicSpline(time, position), np.diff(ticks)
    drag = motion.antiderivative()(time[0]) - motion.antiderivative()(time)
    speed = _summed(late[..., :-1] * steps)
    pushes = _summed(0.5 * (speed[..., 1:] + speed[..., :-1]) * steps)[..., ::count]
    free = np.linalg.qr(np.vander(time / record.sample_time, 3))[0]
    position, drag, pushes = (one - (one @ free) @ free.T for one in (position, drag, pushes))
    early = np.asarray(leads * (record.sample_time / count), dtype=np.float64)
    return _Window(sample=k, leads=early, position=position, drag=drag, pushes=pushes)


def _summed(rows: Signal) -> Signal:
    return np.concatenate((np.zeros((*rows.shape[:-1], 1)), np.cumsum(rows, axis=-1)), axis=-1)


def _leads(windows: Sequence[_Window]) -> Signal:
    """Return the time before its sample at which each jump came [s], beside the delay that leaves least."""
    tried = [_beside(windows, delay) for delay in range(windows[0].pushes.shape[0])]
    left = np.array([one for one, _ in tried])
    samples = sum(window.position.size for window in windows)
    freedom = max(samples - 4 * len(windows) - 3, 1)
    chosen = int(np.argmin(left))
    if left[0] - left[chosen] <= SHOWN * left[chosen] / freedom:
        chosen = 0
    return np.array([window.leads[i] for window, i in zip(windows, tried[chosen][1], strict=True)])


def _beside(windows: Sequence[_Window], delay: int) -> tuple[float, list[int]]:
    """Return what the best times beside a `delay` leave, squared, and these."""
    best = [window.best_alone(delay) for window in windows]
    target = np.concatenate([window.position for window in windows])
    drags, left = np.concatenate([window.drag for window in windows]), np.inf
    for _ in range(ROUNDS):
        pushes = np.concatenate([window.pushes[delay, i] for window, i in zip(windows, best, strict=True)])
        damping, gain = np.linalg.lstsq(np.stack((drags, pushes), axis=1), target)[0].tolist()
        each = [window.left(delay, gain, damping) for window in windows]
        better = [int(np.argmin(one)) for one in each]
        left = float(sum(one.min() for one in each))
        if better == best:
            break
        best = better
    return left, best
