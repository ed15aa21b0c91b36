"""When the loop of a record ran: at each of its samples, at lost ones too, or several times between them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.clock import cycle_of, cycles_passed
from servolens.control_arithmetic import LoopSignals

if TYPE_CHECKING:
    from numpy.typing import NDArray


__all__ = ["Ticks"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ticks:
    """The instants at which the loop of a record ran, and what it was given at each of them.

    Lost samples are put back; so are the ticks of a loop that ran faster than it was logged.

    Attributes
    ----------
    time : ndarray, shape (n,)
        [s].
    index : ndarray of int or None
        Where the record's samples stand in it; None if every tick was logged.
    sampled : ndarray, shape (m,)
        Time of the record's samples [s].
    held : ndarray of int, shape (n,)
        The last sample at each tick.
    jumps : ndarray of int, shape (j, 2), or None
        If the loop ran faster than the log: samples that first show a jump of the set point, and the ticks at which it
        came. None if it did not.
    step : float
        Nominal, from one to the next [s].
    """

    time: NDArray[np.float64]
    index: NDArray[np.intp] | None
    sampled: NDArray[np.float64]
    held: NDArray[np.intp]
    jumps: NDArray[np.intp] | None
    step: float

    @classmethod
    def of(
        cls,
        time: NDArray[np.float64],
        count: int = 1,
        jumps: NDArray[np.intp] | None = None,
        leads: NDArray[np.float64] | None = None,
    ) -> Ticks:
        """Return the ticks of a log.

        Parameters
        ----------
        time : ndarray, shape (m,)
            Of its samples [s].
        count : int
            Ticks from one to the next.
        jumps, leads : ndarray, shape (j,)
            Samples that first show a jump of the set point, and how long before them it came [s].
        """
        nominal, passed = cycle_of(time), cycles_passed(time)
        if count == 1 and passed.max(initial=1.0) == 1.0:
            return cls(time=time, index=None, sampled=time, held=np.arange(time.size), jumps=None, step=nominal)
        counts = count * passed.astype(np.intp)
        index = np.concatenate([[0], np.cumsum(counts)])
        grid = np.interp(np.arange(index[-1] + 1), index, time)
        held, came = np.repeat(np.arange(time.size), np.append(counts, 1)), None
        if count > 1:
            seen = np.empty(0, dtype=np.intp) if jumps is None else jumps
            early = np.zeros(seen.size) if leads is None else leads
            came = np.stack((seen, index[seen] - np.rint(early * count / nominal).astype(np.intp)), axis=1)
        return cls(time=grid, index=index, sampled=time, held=held, jumps=came, step=nominal / count)

    def command(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a command at the ticks: held between samples; of a faster loop interpolated between jumps."""
        if self.jumps is None:
            return np.ascontiguousarray(signal[self.held])
        found = self._smooth(signal, self.jumps)
        for seen, came in self.jumps.tolist():
            before, after = int(self._places[seen - 1]), int(self._places[seen])
            rises = (signal[seen - 1] - signal[max(seen - 2, 0)], signal[min(seen + 1, signal.size - 1)] - signal[seen])
            ticks = np.arange(after - before)
            found[before:came] = signal[seen - 1] + ticks[: came - before] * rises[0] / ticks.size
            found[came:after] = signal[seen] + (ticks[came - before :] - ticks.size) * rises[1] / ticks.size
        return found

    def _smooth(self, signal: NDArray[np.float64], jumps: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return a command between its jumps."""
        from scipy.interpolate import PchipInterpolator

        found, index = signal[self.held], self._places
        for first, stop in pairwise([0, *jumps[:, 0].tolist(), signal.size]):
            if stop - first > 1:
                inside = slice(int(index[first]), int(index[stop - 1]) + 1)
                found[inside] = PchipInterpolator(self.sampled[first:stop], signal[first:stop])(self.time[inside])
        return np.ascontiguousarray(found)

    def set_point(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a set point at the ticks: held between samples; of a faster loop interpolated between jumps."""
        if self.jumps is None:
            return np.ascontiguousarray(signal[self.held])
        found, index = np.interp(self.time, self.sampled, signal), self._places
        for seen, came in self.jumps.tolist():
            found[index[seen - 1] : came], found[came : index[seen]] = signal[seen - 1], signal[seen]
        return found

    def motion(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a position or velocity at the ticks, interpolated."""
        if self.index is None:
            return np.ascontiguousarray(signal)
        if self.jumps is None:
            return np.interp(self.time, self.sampled, signal)
        from scipy.interpolate import CubicSpline

        return np.ascontiguousarray(CubicSpline(self.sampled, signal)(self.time))

    def seen(self, samples: LoopSignals) -> LoopSignals:
        """Return what the loop was given at its ticks."""
        return LoopSignals(
            time=self.time,
            reference=self.set_point(samples.reference),
            position=self.motion(samples.position),
            sample_time=self.step,
            velocity=None if samples.velocity is None else self.motion(samples.velocity),
            added=None if samples.added is None else self.command(samples.added),
            limit=samples.limit,
        )

    def logged(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what of a `signal` at the ticks, the last axis, stands at the record's samples."""
        return signal if self.index is None else signal[..., self.index]

    def means(self, signal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean of a `signal` at the ticks from each of the record's samples to the next, and its last."""
        if self.index is None:
            return signal
        return np.append(np.add.reduceat(signal[:-1], self.index[:-1]) / np.diff(self.index), signal[-1])

    @property
    def is_faster(self) -> bool:
        """Whether the loop ran several times from one sample to the next."""
        return self.jumps is not None

    @property
    def _places(self) -> NDArray[np.intp]:
        return np.arange(self.time.size) if self.index is None else self.index
