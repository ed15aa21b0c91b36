"""Simulations to be compared with measurements: in closed loop from the reference, or driven by the voltage."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, final

import numpy as np

from servolens.control_law import with_history
from servolens.errors import InputError
from servolens.identification.segments import Segment, applied_before, applied_voltage, motion_segments, noise_level
from servolens.identification.smoothing import smooth
from servolens.quality.beginning import initial_motion
from servolens.record import Controller
from servolens.simulation.loop import simulate_trial, simulate_voltage, without_gaps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.options import FitOptions
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = [
    "ClosedRun",
    "Run",
    "TetheredRun",
    "VoltageRun",
    "closed_runs",
    "tether",
    "voltage_runs",
]

_NO_SHIFTS: tuple[float, ...] = ()
LEAD, AT_ONCE = 40, 3
"""Most samples of rest before a step that a window begins with; up to how many the reference moves at once."""
AWAITED = 0.1
"""Share of the reference's span up to which an axis that waits for it is off its reference."""
VISIBLE = 20
"""Samples over which a velocity that is tried moves the axis by its noise."""
SHIFT = 1e-4
"""Share of the travel by which an initial state is moved for its sensitivity."""


class Run(Protocol):
    """A simulation and what it is compared with.

    Attributes
    ----------
    group : int
        Number of the record it stems from.
    measured : ndarray, shape (n,)
        Position [m or rad], or voltage where that is compared.
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

    samples: int

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """Return what `plant` misses of the run."""


@final
class ClosedRun:
    """A record in closed loop from the reference.

    The sensor's rounding is left out, so that the response is smooth in the parameters.

    Parameters
    ----------
    record : Record
        With reference and controller; with the voltage if that is compared.
    group : int
        Number of the record.
    compared : {"position", "voltage"}
        What is compared.
    in_motion : bool
        Whether the record begins in motion; else at rest at the mean of the samples before its first edge.
    """

    def __init__(self, record: Record, group: int, *, compared: str = "position", in_motion: bool = False) -> None:
        if in_motion:
            record = with_history(record)
        self.group, self._compared = group, compared
        self.measured = _needed(record.voltage) if compared == "voltage" else record.position
        self._time, held, self._index = without_gaps(record.time)
        self._reference = np.ascontiguousarray(_needed(record.reference)[held])
        self._added = None if record.feedforward is None else record.feedforward[held]
        assert record.controller is not None  # noqa: S101 - closed_runs
        self._controller, self._before = record.controller, applied_before(record)
        self.sample_time = float(np.max(np.diff(self._time)))
        self._begin = (float(np.mean(record.position[: rest(record)])), 0.0)
        self.start, self.shifts = np.empty(0), _NO_SHIFTS
        if in_motion:
            self.start, self.shifts = _moving(record.time, record.position)

    @property
    def samples(self) -> int:
        """How many samples are compared."""
        return self.measured.size

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return self.simulated(plant, start, substeps) - self.measured

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        run = simulate_trial(
            plant,
            self._controller,
            self._time,
            self._reference,
            feedforward=self._added,
            start=(float(start[0]), float(start[1])) if start.size else self._begin,
            before=self._before,
            substeps=substeps,
        )
        seen = run.voltage if self._compared == "voltage" else run.measured
        return seen if self._index is None else seen[self._index]


@final
class VoltageRun:
    """A stretch of a record driven by its voltage.

    Its initial position is free, its velocity too if the axis already moves.
    """

    def __init__(self, segment: Segment, group: int, window: int = 21, *, rest: int = 0) -> None:
        self.group, self.measured, self.segment = group, segment.position, segment
        self.sample_time = float(np.max(np.diff(segment.time)))
        self.start, self.shifts = _moving(segment.time, segment.position, window)
        if rest:
            self.start, self.shifts = np.array([np.mean(segment.position[:rest])]), self.shifts[:1]

    @property
    def samples(self) -> int:
        """How many samples are compared."""
        return self.measured.size

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return self.simulated(plant, start, substeps) - self.measured

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        begin = (float(start[0]), float(start[1]) if start.size > 1 else 0.0)
        before = applied_before(self.segment.record) if self.segment.first == 0 else None
        run = simulate_voltage(
            plant, self.segment.time, self.segment.voltage, start=begin, before=before, substeps=substeps
        )
        return run.measured


@final
class TetheredRun:
    """A record driven by its voltage and weakly tied to its measured position.

    The tether is a PD loop on the difference, slow beside what is to be seen, so that errors do not grow over a whole
    record; what it makes of the noise is negligible.
    """

    def __init__(self, record: Record, group: int, tether: Controller) -> None:
        self.group, self.measured = group, record.position
        self._time, held, self._index = without_gaps(record.time)
        self._voltage = np.ascontiguousarray(applied_voltage(record)[held])
        self._position = np.ascontiguousarray(record.position[held])
        self._tether, self._before = tether, applied_before(record)
        self.sample_time = float(np.max(np.diff(self._time)))
        self.start, self.shifts = _moving(record.time, record.position)
        if _begins_at_rest(record):
            still, slow = rest(record), noise_level(record) / (VISIBLE * self.sample_time)
            self.start = np.array([np.mean(self.measured[:still]), 0.0])
            self.shifts = (self.shifts[0], max(self.shifts[1], slow))
            if still > 1:
                self.start, self.shifts = self.start[:1], self.shifts[:1]

    @property
    def samples(self) -> int:
        """How many samples are compared."""
        return self.measured.size

    def residual(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        return self.simulated(plant, start, substeps) - self.measured

    def simulated(self, plant: Plant, start: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
        """See :class:`Run`."""
        run = simulate_trial(
            plant,
            self._tether,
            self._time,
            self._position,
            feedforward=self._voltage,
            start=(float(start[0]), float(start[1]) if start.size > 1 else 0.0),
            before=self._before,
            substeps=substeps,
        )
        return run.measured if self._index is None else run.measured[self._index]


def tether(plant: Plant, rate: float) -> Controller:
    """Return a tether of `rate` [rad/s] for an axis about like `plant`."""
    return Controller(kp=rate * rate / plant.gain)


def closed_runs(records: Sequence[Record], options: FitOptions) -> list[ClosedRun]:
    """Return each record in closed loop.

    Raises
    ------
    InputError
        If the voltage is to be compared and a record has none.
    """
    for record in records:
        if options.compared == "voltage" and record.voltage is None:
            raise InputError(f"{record.name}: no voltage is logged, so it cannot be compared; compare the position")
    in_motion = options.begin == "motion"
    return [
        ClosedRun(record, group, compared=options.compared, in_motion=in_motion) for group, record in enumerate(records)
    ]


def voltage_runs(records: Sequence[Record], *, stretches: bool = False, window: int = 21) -> list[VoltageRun]:
    """Return each record driven by its voltage; or, as of one that begins in motion, in stretches of motion.

    Where the reference moves at once, the record may have been cut out of a motion, and where the loop works before
    its step, the sensor's noise shakes the axis: its initial velocity is free.
    Stretches suit an axis that is unstable by itself, in which a small error grows over a whole record.
    """
    runs: list[VoltageRun] = []
    for group, record in enumerate(records):
        if not stretches and _begins_at_rest(record):
            whole = _segment(record, applied_voltage(record), 0, len(record))
            still = 0 if _may_be_cut(record) or _is_shaken(record) else rest(record)
            runs.append(VoltageRun(whole, group, window, rest=still))
        else:
            runs += [VoltageRun(_absolute(segment), group, window) for segment in motion_segments([record])]
    return runs


def rest(record: Record) -> int:
    """Return how many samples the axis rests at the record's beginning before the reference changes, 1 to 40.

    At rest: the position stays within six standard deviations of its noise and two encoder steps.
    """
    edges = record.edges()
    count = min(int(edges[0]), LEAD) if edges.size else 1
    still = 6.0 * noise_level(record) + 2.0 * (record.encoder_resolution or 0.0)
    return count if float(np.ptp(record.position[:count])) <= still else 1


def _moving(
    time: NDArray[np.float64], position: NDArray[np.float64], window: int = 21
) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    """Return initial position and velocity, and by how much to move them for their sensitivities."""
    value, slope = smooth(time, position, min(window, time.size))
    travel = SHIFT * max(float(np.ptp(position)), 1e-9)
    return np.array([value[0], slope[0]]), (travel, travel / max(float(time[-1] - time[0]), 1e-3))


def _needed(signal: NDArray[np.float64] | None) -> NDArray[np.float64]:
    assert signal is not None  # noqa: S101 - checked where the runs are made
    return signal


def _may_be_cut(record: Record) -> bool:
    """Tell whether the record may have been cut out of a motion: nothing says when its reference sets out."""
    edges = record.edges()
    return record.reference is None or (edges.size > 1 and int(edges[0]) < AT_ONCE and int(edges[1]) < 2 * AT_ONCE)


def _is_shaken(record: Record) -> bool:
    """Tell whether the loop works before its step: what it makes of the sensor's noise may shake the axis.

    How much is not known without the plant. A lead of a few samples tells no velocity from a late start.
    """
    edges, reference = record.edges(), record.reference
    if reference is None or edges.size == 0 or edges[0] <= AT_ONCE:
        return False
    lead = slice(min(int(edges[0]), LEAD))
    away = abs(float(reference[0]) - float(np.mean(record.position[lead])))
    waits = away <= AWAITED * float(np.ptp(reference))
    return waits and float(np.ptp(applied_voltage(record)[lead])) > 0.0


def _begins_at_rest(record: Record) -> bool:
    """Tell whether the record does not begin in motion that can be seen."""
    return initial_motion(record) == 0.0


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
