"""Simulations to be compared with measurements: in closed loop from the reference, or driven by the voltage."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, final

import numpy as np

from servolens.identification.segments import Segment, applied_voltage, motion_segments
from servolens.identification.smoothing import smooth
from servolens.simulation.loop import simulate_loop, simulate_voltage, without_gaps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["ClosedRun", "Run", "VoltageRun", "closed_runs", "voltage_runs"]

LEAD = 40
"""Most samples of rest before a step that a window begins with."""
MOVES = 6.0
"""Standard errors from which on an initial velocity is one."""
SHIFT = 1e-4
"""Share of the travel by which an initial state is moved for its sensitivity."""


class Run(Protocol):
    """A simulation and what it is compared with.

    Attributes
    ----------
    group : int
        Number of the record it stems from.
    measured : ndarray, shape (n,)
        Position [m or rad].
    sample_time : float
        Longest interval between samples [s].
    start : ndarray, shape (s,)
        Guess of the initial position and velocity that are free; of size 0 where they are known.
    shifts : tuple of float, length s
        Their steps for finite differences.
    """

    group: int
    measured: NDArray[np.float64]
    sample_time: float
    start: NDArray[np.float64]
    shifts: tuple[float, ...]

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return what `plant` makes of the run, to be compared with `measured`."""


@final
class ClosedRun:
    """A stretch of a record in closed loop, from rest at its measured position.

    The sensor's rounding is left out, so that the response is smooth in the parameters.
    """

    def __init__(self, record: Record, first: int, stop: int, group: int, *, rest: int = 1) -> None:
        time = record.time[first:stop]
        self.group, self.measured = group, record.position[first:stop]
        self._time, self._index = without_gaps(time)
        held = np.searchsorted(time, self._time + 0.5 * record.sample_time, side="right") - 1
        assert record.reference is not None and record.controller is not None  # noqa: S101, PT018 - closed_runs
        self._reference = np.ascontiguousarray(record.reference[first:stop][held])
        self._added = None if record.feedforward is None else record.feedforward[first:stop][held]
        self._controller = record.controller
        self._begin = (float(np.mean(self.measured[: max(rest, 1)])), 0.0)
        self.sample_time = float(np.max(np.diff(self._time)))
        self.start = np.empty(0)
        self.shifts: tuple[float, ...] = ()

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        run = simulate_loop(
            plant,
            self._controller,
            self._time,
            self._reference,
            feedforward=self._added,
            start=self._begin,
            substeps=substeps,
        )
        return run.measured if self._index is None else run.measured[self._index]


@final
class VoltageRun:
    """A stretch of a record driven by its voltage.

    Its initial position is free, its velocity too if the axis already moves.
    """

    def __init__(self, segment: Segment, group: int, window: int = 21, *, rest: int = 0) -> None:
        self.group, self.measured, self.segment = group, segment.position, segment
        self.sample_time = float(np.max(np.diff(segment.time)))
        value, slope = smooth(segment.time, segment.position, min(window, segment.time.size))
        travel = SHIFT * max(float(np.ptp(segment.position)), 1e-9)
        duration = max(float(segment.time[-1] - segment.time[0]), 1e-3)
        if rest:
            self.start = np.array([np.mean(segment.position[:rest])])
            self.shifts: tuple[float, ...] = (travel,)
        else:
            self.start = np.array([value[0], slope[0]])
            self.shifts = (travel, travel / duration)

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        begin = (float(start[0]), float(start[1]) if start.size > 1 else 0.0)
        return simulate_voltage(plant, self.segment.time, self.segment.voltage, start=begin, substeps=substeps).measured


def closed_runs(records: Sequence[Record]) -> list[ClosedRun]:
    """Return each record in closed loop, from rest."""
    return [ClosedRun(record, 0, len(record), group, rest=rest(record)) for group, record in enumerate(records)]


def voltage_runs(records: Sequence[Record], *, stretches: bool = False, window: int = 21) -> list[VoltageRun]:
    """Return each record driven by its voltage from rest; or, as of a trajectory, in stretches of motion.

    Stretches suit an axis that is unstable by itself, in which a small error grows over a whole record.
    """
    runs: list[VoltageRun] = []
    for group, record in enumerate(records):
        if not stretches and _begins_at_rest(record):
            whole = _segment(record, applied_voltage(record), 0, len(record))
            runs.append(VoltageRun(whole, group, window, rest=max(rest(record), 1)))
        else:
            runs += [VoltageRun(_absolute(segment), group, window) for segment in motion_segments([record])]
    return runs


def rest(record: Record) -> int:
    """Return the number of samples before the first edge of the reference, at most 40: there the axis rests."""
    edges = record.edges()
    return min(int(edges[0]), LEAD) if edges.size else 0


def _begins_at_rest(record: Record) -> bool:
    """Tell whether the record can be taken to begin at rest: as a step's log does."""
    if record.reference is None:
        return _initial_speed_is_nothing(record)
    moving = record.reference[1:] != record.reference[:-1]
    return float(np.mean(moving)) < 0.01


def _initial_speed_is_nothing(record: Record) -> bool:
    count = min(max(len(record) // 50, 5), 40)
    y, t = record.position[:count], record.time[:count]
    slope, offset = np.polyfit(t - t[0], y, 1)
    scatter = float(np.std(y - offset - slope * (t - t[0]))) + (record.encoder_resolution or 0.0)
    return bool(abs(slope) * (t[-1] - t[0]) < MOVES * scatter + 1e-12)


def _segment(record: Record, voltage: NDArray[np.float64], first: int, stop: int) -> Segment:
    return Segment(
        record=record,
        first=first,
        stop=stop,
        time=record.time[first:stop],
        position=record.position[first:stop],
        voltage=voltage[first:stop],
        noise=0.0,
    )


def _absolute(segment: Segment) -> Segment:
    """Return the segment with the record's own time, which drifts and disturbances go by."""
    from dataclasses import replace

    return replace(segment, time=segment.record.time[segment.first : segment.stop])
