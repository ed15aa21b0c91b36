"""From records to the stretches of motion that carry information."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens import encoder
from servolens.clock import cycles_passed
from servolens.control_law import command_at, controller_voltage
from servolens.errors import InputError
from servolens.identification.smoothing import smooth, smoothing_window
from servolens.plant import Plant
from servolens.quality.beginning import initial_motion

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = [
    "Segment",
    "applied_at",
    "applied_before",
    "applied_voltage",
    "begins_with_its_step",
    "loop_rate",
    "motion_segments",
    "moving_parts",
    "noise_level",
    "parts",
    "resting_noise",
    "rests_between",
    "runs_free",
    "settled_steps",
    "white_noise",
]

FEWEST_SAMPLES = 12
FEWEST_STROKES = 12
"""Reversals from which on a record without steps is a trajectory."""
SLOW, SHORTEST_PART, STANDING = 0.02, 30, 0.6
"""Share of the top speed below which an axis stands; fewest samples of a part; share of the time in motion up to which
standing still matters."""
RESTING, NO_REST = 0.1, 10.0
"""Last share of a step in which a settled axis shows its noise; drift over it, in units of the noise, from which on the
axis has not settled."""
SETTLED = 1e-2
"""Share of the step within which a stretch counts as settled."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segment:
    """A stretch of one record in which the axis moves.

    Attributes
    ----------
    record : Record
        Where it comes from.
    first, stop : int
        Samples ``first … stop − 1`` of the record.
    time, position, voltage : ndarray, shape (n,)
        Time since the segment's first sample [s], position, voltage that reached the amplifier's output on average
        until the next sample.
    noise : float
        Standard deviation of the position's noise.
    since_step : float
        Time from the step's onset to the first sample [s]; not 0 where samples were lost on the way.
    inertia : float, optional
        Moving inertia [kg m²] or mass [kg] that an estimate is for: the first one that a record states.
    runs_free : bool
        Whether the axis moves in any of the records while its motor is off, which shows the damping that is left then.
    """

    record: Record
    first: int
    stop: int
    time: NDArray[np.float64]
    position: NDArray[np.float64]
    voltage: NDArray[np.float64]
    noise: float
    since_step: float = 0.0
    inertia: float | None = None
    runs_free: bool = False

    def plant(self, gain: float, damping: float, effects: Sequence[Effect] = ()) -> Plant:
        """Return an axis in the units of the records, and as they say which of its parameters they can tell."""
        return Plant(
            gain=gain,
            damping=damping,
            effects=tuple(effects),
            length_unit=self.record.length_unit,
            command_unit=self.record.command_unit,
            inertia=self.inertia,
            free_damping=damping if self.runs_free else None,
        )

    @property
    def lightness(self) -> float:
        """By how much more than the estimate the axis accelerates in this record, where it states its inertia."""
        own = self.record.inertia
        return 1.0 if self.inertia is None or own is None else self.inertia / own


def motion_segments(records: Iterable[Record]) -> tuple[Segment, ...]:
    """Cut `records` into stretches of motion.

    A record is split where its reference jumps, or, when it follows a trajectory or states no reference, where the axis
    turns round; where samples are lost; and where its motor is off, which is left out. Each stretch begins when the
    axis first leaves its initial position and ends a tenth of its length after the axis was last outside 1 % of the
    step (or four standard deviations of the noise, or one and a half encoder steps, whichever is larger).

    Raises
    ------
    InputError
        If the axis moves in none of them.
    """
    found: list[Segment] = []
    records = tuple(records)
    inertia = next((record.inertia for record in records if record.inertia is not None), None)
    is_free = any(map(runs_free, records))
    for record in records:
        voltage = _means(record)
        noise = noise_level(record)
        step, sample_time = record.step_size, _sample_time(record)
        floor = max(4.0 * noise, 1.5 * (record.encoder_resolution or 0.0))
        origin = float(record.time[0])
        for first, stop, goes_on in _stretches(record, sample_time, floor):
            window = _motion(record.position[first:stop], step, floor, sample_time, goes_on=goes_on)
            if window is not None:
                a, b = first + window[0], first + window[1]
                origin = origin if goes_on else float(record.time[a])
                found.append(
                    Segment(
                        record=record,
                        first=a,
                        stop=b,
                        time=record.time[a:b] - record.time[a],
                        position=record.position[a:b],
                        voltage=voltage[a:b],
                        noise=noise,
                        since_step=float(record.time[a]) - origin,
                        inertia=inertia,
                        runs_free=is_free,
                    )
                )
    if not found:
        raise InputError(f"{', '.join(r.name for r in records) or 'no record'}: {_too_little(records)}")
    return tuple(found)


def runs_free(record: Record) -> bool:
    """Tell whether the axis moves while its motor is off: by more than its noise and two steps of its encoder."""
    if record.enabled is None or record.enabled.all():
        return False
    still = NO_REST * noise_level(record) + 2.0 * (record.encoder_resolution or 0.0)
    changes = np.flatnonzero(np.diff(record.enabled)) + 1
    parts = pairwise([0, *changes.tolist(), len(record)])
    return any(float(np.ptp(record.position[a:b])) > still for a, b in parts if record.enabled[a] == 0.0)


def _means(record: Record) -> NDArray[np.float64]:
    """Return the mean voltage from each sample to the next."""
    ticks = record.loop_ticks()
    return ticks.means(applied_at(record, ticks)) if ticks.is_faster else applied_voltage(record)


def _too_little(records: Sequence[Record]) -> str:
    """Say why no motion can be fitted."""
    most = max((len(record) for record in records), default=0)
    if 0 < most < encoder.FEWEST_SAMPLES:
        count = f"the record has {most}" if len(records) == 1 else f"none of the records has more than {most}"
        return f"{count} samples; at least {encoder.FEWEST_SAMPLES} are needed, log longer or faster"
    if any(record.enabled is not None and not record.enabled.all() for record in records):
        return (
            f"while the motor is on the axis does not move by more than its noise for {FEWEST_SAMPLES} samples; log a"
            " longer run with the motor on"
        )
    if any(float(np.ptp(record.position)) > NO_REST * noise_level(record) for record in records):
        return (
            f"each motion is over, or interrupted by lost samples, after fewer than {FEWEST_SAMPLES} samples; log"
            " faster, or longer moves"
        )
    return "the axis does not move more than its noise; log a step that moves it by many encoder steps"


def moving_parts(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    """Return the parts of `segments` in which the axis really moves, if it stands for much of their time.

    A standing axis says nothing of gain and damping: dry friction holds it against any voltage.
    """
    moving = [part for segment in segments for part in _moving(segment)]
    moved, whole = (sum(s.time.size for s in some) for some in (moving, segments))
    return tuple(moving) if moving and moved < STANDING * whole else tuple(segments)


def _moving(segment: Segment) -> list[Segment]:
    _, velocity = smooth(segment.time, segment.position, min(21, segment.time.size))
    return parts(segment, np.abs(velocity) > SLOW * np.max(np.abs(velocity)))


def parts(segment: Segment, is_part: NDArray[np.bool_]) -> list[Segment]:
    """Return the stretches of `segment`, none of them very short, all of whose samples `is_part`, shape (n,), takes."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_part, [False]])))
    return [
        replace(
            segment,
            first=segment.first + int(a),
            stop=segment.first + int(b),
            time=segment.time[a:b] - segment.time[a],
            position=segment.position[a:b],
            voltage=segment.voltage[a:b],
            since_step=segment.since_step + float(segment.time[a] - segment.time[0]),
        )
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a >= SHORTEST_PART
    ]


def settled_steps(record: Record) -> tuple[Record, ...]:
    """Return the record's steps if the axis rests at each edge, so that a simulation may begin there; else it whole."""
    return record.steps() if rests_between(record) else (record,)


def rests_between(record: Record) -> bool:
    """Tell whether the axis rests at each edge of the reference.

    At rest: over the last twenty samples before the edge the position stays within six standard deviations of its
    noise, two encoder steps, or 0.2 % of the step.
    """
    floor = max(6.0 * noise_level(record), 2.0 * (record.encoder_resolution or 0.0), 2e-3 * record.step_size)
    return all(float(np.ptp(step.position[-20:])) <= floor for step in record.steps()[:-1])


def applied_voltage(record: Record) -> NDArray[np.float64]:
    """Return the voltage behind the amplifier's limits: as logged, else what the controller's law asks for."""
    asked = record.voltage if record.voltage is not None else controller_voltage(record)
    if record.voltage_limit is None:
        return np.ascontiguousarray(asked)
    return np.clip(asked, -record.voltage_limit, record.voltage_limit)


def applied_at(record: Record, ticks: Ticks) -> NDArray[np.float64]:
    """Return the voltage behind the amplifier's limits at the `ticks` of the record's loop."""
    if not ticks.is_faster:
        return ticks.command(applied_voltage(record))
    asked, limit = command_at(record, ticks), record.voltage_limit
    return asked if limit is None else np.clip(asked, -limit, limit)


def applied_before(record: Record) -> float | None:
    """Return the same before the first sample; None where the record does not say it."""
    before, limit = record.voltage_before, record.voltage_limit
    return before if before is None or limit is None else min(max(before, -limit), limit)


def noise_level(record: Record) -> float:
    """Return the standard deviation of the position's noise, from third differences of at most 10⁵ samples.

    At least that of the stated encoder, resolution/√12.
    """
    noise = white_noise(record.position, record.time)
    return max(noise, (record.encoder_resolution or 0.0) / float(np.sqrt(12.0)))


def begins_with_its_step(record: Record) -> bool:
    """Tell whether `record` begins at full voltage, and does not say what was applied before."""
    if record.voltage_before is not None or initial_motion(record) != 0.0:
        return False
    voltage = np.abs(applied_voltage(record))
    return bool(voltage[0] > 0.1 * voltage.max())


def loop_rate(plant: Plant, records: Sequence[Record]) -> float:
    """Return about how fast the loops are [rad/s]; of records without a loop, how fast they are logged to be.

    A law without a proportional part counts as none: nothing draws the axis at once to where it is asked to be.
    """
    gains = [record.controller.kp for record in records if record.controller is not None]
    rates = [abs(plant.gain * kp) ** 0.5 for kp in gains if kp != 0.0]
    return float(np.median(rates)) if rates else 10.0 / float(np.median([r.duration for r in records]))


def resting_noise(records: Sequence[Record]) -> float:
    """Return the standard deviation that a settled axis shows at the ends of its steps, the median of all steps.

    About a straight line each; 0 where no step is long enough or none settles.
    """
    found = [spread for record in records for step in record.steps() if (spread := _at_rest(step)) > 0.0]
    return float(np.median(found)) if found else 0.0


def _at_rest(step: Record) -> float:
    count = int(RESTING * len(step))
    if count < FEWEST_SAMPLES:
        return 0.0
    time, end = step.time[-count:] - step.time[-1], step.position[-count:]
    if abs(float(end[-1] - end[0])) > NO_REST * noise_level(step):
        return 0.0
    return float(np.std(end - np.polyval(np.polyfit(time, end, 1), time)))


def white_noise(signal: NDArray[np.float64], time: NDArray[np.float64] | None = None) -> float:
    """Return the standard deviation of white noise on a smooth `signal`, from third differences of 10⁵ samples.

    Where the `time` is given [s], of samples between which none is lost.
    """
    third = np.diff(signal[:100_000], 3)
    if time is not None and third.size:
        intervals = np.diff(time[:100_000])
        longest = np.max(np.lib.stride_tricks.sliding_window_view(intervals, 3), axis=1)
        whole = third[np.rint(longest / np.median(intervals)) <= 1]
        third = whole if whole.size >= FEWEST_SAMPLES else third
    return float(np.sqrt(np.mean(third**2) / 20.0)) if third.size else 0.0


def _sample_time(record: Record) -> float:
    """Return the median sampling interval [s] of at most 10⁵ samples."""
    return float(np.median(np.diff(record.time[:100_001])))


def _stretches(record: Record, sample_time: float, floor: float) -> list[tuple[int, int, bool]]:
    """Return first sample, the one after the last, and whether the stretch goes on with a motion begun before.

    Of an axis whose motor is off the command says nothing: these samples are left out.
    """
    edges = record.edges()
    is_steps = record.reference is not None and (edges.size < 2 or np.min(np.diff(edges)) >= FEWEST_SAMPLES)
    cuts = {0, *(edges.tolist() if is_steps else _reversals(record, sample_time, floor))}
    gaps = (np.flatnonzero(cycles_passed(record.time) > 1.0) + 1).tolist()
    is_on = np.ones(len(record)) if record.enabled is None else record.enabled
    switched = (np.flatnonzero(np.diff(is_on)) + 1).tolist()
    every = pairwise(sorted({*cuts, *gaps, *switched, len(record)}))
    return [(first, stop, first not in cuts) for first, stop in every if is_on[first]]


def _reversals(record: Record, sample_time: float, floor: float) -> list[int]:
    """Return the samples at which an axis that follows a trajectory turns round, to move back by twice the `floor`.

    What the equation lacks (friction above all) is integrated twice; over a whole trajectory it would bury the rest,
    over one stroke it is nearly constant.
    """
    window = smoothing_window(0.1, sample_time)
    velocity = smooth(record.time, record.position, window)[1]
    fast = np.flatnonzero(np.abs(velocity) > 0.05 * np.abs(velocity).max())
    turns = np.flatnonzero(np.diff(np.sign(velocity[fast]))) + 1
    if record.reference is None and turns.size < FEWEST_STROKES:  # a step that rings, not a trajectory
        return []
    y, found, way, farthest = record.position, [], 0.0, 0
    for k in (*((fast[turns - 1] + fast[turns]) // 2).tolist(), len(record) - 1):
        moved = float(y[k] - y[farthest])
        is_seen = abs(moved) > 2.0 * floor
        if is_seen and way * moved < 0.0:
            found.append(farthest)
        if is_seen or way * moved > 0.0:
            way, farthest = float(np.sign(moved)), k
    return found


def _motion(
    y: NDArray[np.float64], step: float, floor: float, sample_time: float, *, goes_on: bool
) -> tuple[int, int] | None:
    """Return the first sample of the motion and the one after its last, of a stretch's position."""
    if y.size < FEWEST_SAMPLES:
        return None
    rest = np.sort(y[-max(y.size // 20, 5) :])
    final = 0.5 * float(rest[(rest.size - 1) // 2] + rest[rest.size // 2])
    begin = int(np.argmax(np.abs(y - y[0]) > floor))
    outside = np.abs(y - final) > max(floor, SETTLED * step)
    last = y.size - 1 - int(np.argmax(outside[::-1]))
    if begin == 0 or not outside[last] or y.max() - y.min() < max(2.0 * floor, 5e-3 * step):
        return None
    begin = 0 if goes_on or begin < 0.05 / sample_time else max(begin - 3, 0)
    end = min(last + max((last - begin) // 10, 5), y.size)
    return (begin, end) if end - begin >= FEWEST_SAMPLES else None
