"""What the log's clock and the position sensor are like, and what of it is a finding."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.clock import CHANGED, COMMON, clock_of, rounded_ticks
from servolens.encoder import FEWEST_SAMPLES, SPAN, quantisation_step, share_on_grid, small_moves, white_noise
from servolens.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["SPAN", "SPEED_SPAN", "STEPS", "Sampling", "measure", "sampling_findings", "top_speed"]

SPEED_SPAN = 10
"""Samples over which the top speed is taken: one step of the encoder then counts a tenth."""
GRID = 0.01
"""Share of their grid by which rounded time stamps are off it, for a text rounds them too."""
STEPS = 3.0
"""Steps that an encoder rounds and flickers by."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Clock and sensor of a record; see :class:`~servolens.quality.RecordQuality` for the units.

    Attributes
    ----------
    sample_time, jitter, noise, travel, top_speed : float
        Interval, its deviation, the position's noise, its range, its largest speed.
    lost, gaps, first_gap : int
        Samples lost, places where they are, the sample after the first of these.
    cycles : tuple of float
        Shortest and longest cycle of the log: the same but where it changes [s].
    step : float or None
        Seen quantisation step.
    level : float
        Standard deviation of what the sensor adds: noise or quantisation, whichever is larger.
    """

    sample_time: float
    jitter: float
    lost: int
    gaps: int
    first_gap: int
    cycles: tuple[float, float]
    noise: float
    step: float | None
    travel: float
    top_speed: float

    @property
    def level(self) -> float:
        """Standard deviation of what the sensor adds [m or rad]."""
        return max(self.noise, (self.step or 0.0) / math.sqrt(12.0))

    @property
    def outstanding(self) -> float:
        """Difference of two positions that the sensor does not make [m or rad]."""
        return SPAN * self.noise + STEPS * (self.step or 0.0)


def measure(record: Record) -> Sampling:
    """Measure clock and sensor.

    The noise is that of third differences (a cubic motion leaves none), by their median, so that edges do not count.
    """
    intervals = np.diff(record.time)
    h = record.sample_time
    cycles, lost, _ = clock_of(record.time)
    gaps, kept = np.flatnonzero(lost), ~lost
    y = record.position
    step = quantisation_step(y)
    return Sampling(
        sample_time=h,
        jitter=float(np.std((intervals - cycles)[kept])) if kept.any() else 0.0,
        lost=int(np.sum(np.rint(intervals[gaps] / cycles[gaps]) - 1)),
        cycles=(float(cycles.min()), float(cycles.max())),
        gaps=gaps.size,
        first_gap=int(gaps[0]) + 1 if gaps.size else 0,
        noise=white_noise(y, step),
        step=step,
        travel=float(np.ptp(y)),
        top_speed=top_speed(record),
    )


def top_speed(record: Record) -> float:
    """Return the largest speed over ten samples [m/s or rad/s]."""
    span = min(SPEED_SPAN, record.position.size - 1)
    moved, passed = (signal[span:] - signal[:-span] for signal in (record.position, record.time))
    return float(np.max(np.abs(moved) / passed))


def sampling_findings(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield findings about the clock and the sensor."""
    if len(record) < FEWEST_SAMPLES:
        message = f"the record has {len(record)} samples; at least {FEWEST_SAMPLES} are needed, log longer or faster."
        yield Finding(code="too_few_samples", severity="error", message=message)
    yield from _clock(record, seen)
    yield from _encoder(record, seen)


def _told(time: float, sample_time: float) -> str:
    """Return a time to a hundredth of the cycle: more digits are those of the numbers that hold the stamps."""
    return f"{round(time, 2 - math.floor(math.log10(sample_time))):g}"


def _clock(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield gaps, and jitter where it displaces the moving axis by more than the sensor's own error."""
    if record.stamp_error is not None:
        message = (
            f"the time stamps are off by {1e3 * record.stamp_error:.2g} ms (rms), but the motion shows that the samples"
            f" were taken evenly, every {1e3 * seen.sample_time:.4g} ms: these times are used."
        )
        yield Finding(code="uneven_stamps", severity="note", message=message)
    rounded = _rounded(record.time)
    if rounded is not None:
        grid, true = rounded
        state = f'state that by --setting "sample_time={1e3 * true:.4g} ms"'
        message = (
            f"the time stamps come in steps of {1e3 * grid:.3g} ms, as if rounded; if samples were taken regularly,"
            f" they are {1e3 * true:.4g} ms apart: {'write the stamps with more digits' if seen.gaps else state}."
        )
        yield Finding(code="rounded_stamps", severity="warning", message=message)
    if seen.gaps:
        where = _told(record.time[seen.first_gap], seen.sample_time)
        places = "one place" if seen.gaps == 1 else f"{seen.gaps} places"
        lost = "1 sample is" if seen.lost == 1 else f"{seen.lost} samples are"
        message = f"{lost} lost in {places}, the first before {where} s; log without gaps, or cut there."
        edges = record.jumps()
        unsure = edges[clock_of(record.time).lost[edges - 1]]
        if unsure.size:
            message = (
                f"{message[:-1]}. The reference changes in the gap before"
                f" {_told(record.time[unsure[0]], seen.sample_time)} s, and when is not known: leave out the step that"
                " begins there."
            )
        yield Finding(code="gaps", severity="warning", message=message)
    if rounded is not None:
        return
    short, long = seen.cycles
    if long - short > CHANGED * short:
        message = (
            f"the log's cycle changes between {1e3 * short:.4g} and {1e3 * long:.4g} ms; no samples are lost there, but"
            " the control law is computed with one cycle: log with one."
        )
        yield Finding(code="cycle_changes", severity="note", message=message)
    moved = seen.top_speed * seen.jitter
    felt = seen.jitter > 0.01 * seen.sample_time and moved > max(2 * seen.level, 1e-4 * seen.travel)
    if felt or seen.jitter > 0.2 * seen.sample_time:
        message = (
            f"the sampling interval varies by {1e3 * seen.jitter:.3g} ms (rms) around {1e3 * seen.sample_time:.4g} ms,"
            f" {moved:.2g} {record.length_unit} at top speed; log with the controller's clock."
        )
        yield Finding(code="jitter", severity="warning", message=message)


def _rounded(time: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return to what regular time stamps are rounded, and how far apart they are [s]; None where they are not.

    Rounded, their intervals have two lengths, both common, and they are hardly farther from a regular clock than the
    rounding; lost samples are rare, or lead farther away, unless all is a whole number of ticks.
    """
    ticks, intervals = rounded_ticks(time), np.diff(time)
    if ticks is not None:
        single = intervals[ticks[1] == 1.0]
        return float(np.ptp(single)), ticks[0]
    low, high = float(intervals.min()), float(intervals.max())
    grid, true = high - low, float(time[-1] - time[0]) / intervals.size
    if grid <= CHANGED * low:
        return None
    are_two = np.all(np.minimum(intervals - low, high - intervals) < GRID * grid)
    are_common = COMMON < np.mean(high - intervals < GRID * grid) < 1.0 - COMMON
    is_regular = np.ptp(time - true * np.arange(time.size)) <= 2.0 * grid
    return (grid, true) if are_two and are_common and is_regular else None


def _encoder(record: Record, seen: Sampling) -> Iterator[Finding]:
    """Yield a step that a 1 % band holds fewer than two of, and one that is not the stated encoder's."""
    unit, stated = record.length_unit, record.encoder_resolution
    if seen.step is not None and seen.step > 0.00501 * record.step_size > 0:
        share = f"{100 * seen.step / record.step_size:.2g} %"
        hidden = (
            f"{share} of the step: whether the axis stays within a band of ±{share} or less cannot be seen. For such a"
        )
        if seen.step >= record.step_size:
            hidden = "as large as the step that was commanded: whether it stays within a band cannot be seen. For a"
        message = (
            f"the position moves in steps of {seen.step:.3g} {unit}, {hidden} band use a finer encoder or larger steps."
        )
        yield Finding(code="coarse_quantisation", severity="warning", message=message)
    if stated is not None and _contradicts(record.position, stated, seen.step):
        found = "in finer steps than that" if seen.step is None else f"in steps of {seen.step:.4g} {unit}"
        message = (
            f"encoder_resolution is stated as {stated:g} {unit}, but the position moves {found};"
            " correct it, or leave it out."
        )
        yield Finding(code="encoder_contradicts_log", severity="warning", message=message)


def _contradicts(position: NDArray[np.float64], stated: float, seen: float | None) -> bool:
    """Tell whether small movements are no multiples of the stated step; a log may round finer than a quarter of it."""
    if seen is not None and seen > 1.5 * stated:
        return True
    moves = small_moves(position)
    small = moves[moves < 4.5 * stated]
    rounding = 1.1 * seen / stated if seen is not None and seen < 0.25 * stated else 0.0
    return small.size >= FEWEST_SAMPLES and share_on_grid(small, stated, max(0.15, rounding)) < 0.9
