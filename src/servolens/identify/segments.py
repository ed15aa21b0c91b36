"""From records to the stretches of motion that carry information."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.control_law import controller_voltage
from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["Segment", "applied_voltage", "motion_segments", "noise_level"]

FEWEST_SAMPLES = 12
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
        Time since the segment's first sample [s], position, voltage that reached the amplifier's output.
    noise : float
        Standard deviation of the position's noise.
    """

    record: Record
    first: int
    stop: int
    time: NDArray[np.float64]
    position: NDArray[np.float64]
    voltage: NDArray[np.float64]
    noise: float


def motion_segments(records: Iterable[Record]) -> tuple[Segment, ...]:
    """Cut `records` into stretches of motion.

    A record is split where its reference jumps and where samples are lost. Each stretch begins when the axis first
    leaves its initial position and ends a tenth of its length after the axis was last outside 1 % of the step (or
    four standard deviations of the noise, or one and a half encoder steps, whichever is larger).

    Raises
    ------
    InputError
        If the axis moves in none of them.
    """
    found: list[Segment] = []
    names = []
    for record in records:
        names.append(record.name)
        voltage = applied_voltage(record)
        noise = noise_level(record)
        for first, stop in _stretches(record):
            window = _motion(record, first, stop, noise)
            if window is not None:
                a, b = window
                found.append(
                    Segment(
                        record=record,
                        first=a,
                        stop=b,
                        time=record.time[a:b] - record.time[a],
                        position=record.position[a:b],
                        voltage=voltage[a:b],
                        noise=noise,
                    )
                )
    if not found:
        raise InputError(
            f"{', '.join(names) or 'no record'}: the axis does not move more than its noise; "
            "log a step that moves it by many encoder steps"
        )
    return tuple(found)


def applied_voltage(record: Record) -> NDArray[np.float64]:
    """Return the voltage behind the amplifier's limits: as logged, else what the controller's law asks for."""
    asked = record.voltage if record.voltage is not None else controller_voltage(record)
    if record.voltage_limit is None:
        return np.ascontiguousarray(asked)
    return np.clip(asked, -record.voltage_limit, record.voltage_limit)


def noise_level(record: Record) -> float:
    """Return the standard deviation of the position's noise, from third differences of at most 10⁵ samples.

    At least that of the stated encoder, resolution/√12.
    """
    third = np.diff(record.position[:100_000], 3)
    spread = float(np.sqrt(np.mean(third**2) / 20.0)) if third.size else 0.0
    return max(spread, (record.encoder_resolution or 0.0) / np.sqrt(12.0))


def _stretches(record: Record) -> list[tuple[int, int]]:
    edges = record.edges()
    cuts = edges.tolist() if edges.size < 2 or np.min(np.diff(edges)) >= FEWEST_SAMPLES else []
    steps = np.diff(record.time)
    if steps.max() > 1.5 * record.sample_time:
        cuts += (np.flatnonzero(steps > 1.5 * record.sample_time) + 1).tolist()
    bounds = sorted({0, *cuts, len(record)})
    return list(zip(bounds[:-1], bounds[1:], strict=True))


def _motion(record: Record, first: int, stop: int, noise: float) -> tuple[int, int] | None:
    y = record.position[first:stop]
    if y.size < FEWEST_SAMPLES:
        return None
    step = record.step_size
    floor = max(4.0 * noise, 1.5 * (record.encoder_resolution or 0.0))
    rest = max(y.size // 20, 5)
    begin = int(np.argmax(np.abs(y - y[0]) > floor))
    final = float(np.median(y[-rest:]))
    outside = np.flatnonzero(np.abs(y - final) > max(floor, SETTLED * step))
    if begin == 0 or outside.size == 0 or np.ptp(y) < max(2.0 * floor, 5e-3 * step):
        return None
    begin = 0 if begin < 0.05 / record.sample_time else max(begin - 3, 0)
    end = min(int(outside[-1]) + max((int(outside[-1]) - begin) // 10, 5), y.size)
    return (first + begin, first + end) if end - begin >= FEWEST_SAMPLES else None
