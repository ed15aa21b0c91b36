"""Hundreds of proposals for one force at once: what each leaves of the integral equation on a few thousand samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.integral import held_twice_integrated
from servolens.identification.regressors import regressor
from servolens.processors import in_processes, shared_array

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.identification.segments import Segment

__all__ = ["Proposals", "Thinned", "by_peaks", "force_rows", "record_numbers"]

SAMPLES = 2500
"""Samples that are kept, more or less."""
ALIKE = 1e-9
"""Share of its square that a force must have beside others to count; rounding leaves a millionth of that."""
TOGETHER = 32
"""Effects whose forces are integrated at once: enough to be quick, and few for what memory that takes in between."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Proposals:
    """Forces of one class and their double integrals, initial states projected out.

    Attributes
    ----------
    effects : tuple of Effect
        One force each.
    rows : ndarray, shape (forces * sizes, n)
        With one phase for all records.
    parts : tuple of slice
        Samples over which the sizes are the same: all, or each record's if the phase is each record's own.
    squares : ndarray, shape (forces, parts * sizes, parts * sizes)
        Inner products of the rows of each force.
    """

    effects: tuple[Effect, ...]
    rows: NDArray[np.float64]
    parts: tuple[slice, ...]
    squares: NDArray[np.float64]

    @classmethod
    def of(cls, effects: Sequence[Effect], rows: NDArray[np.float64], parts: tuple[slice, ...]) -> Proposals:
        """Return forces of one class, each of as many of the `rows`."""
        sizes = rows.shape[0] // max(len(effects), 1)
        squares = np.zeros((len(effects), len(parts) * sizes, len(parts) * sizes))
        for i, part in enumerate(parts):
            own = rows[:, part].reshape(len(effects), sizes, part.stop - part.start)
            place = slice(i * sizes, (i + 1) * sizes)
            squares[:, place, place] = own @ own.transpose(0, 2, 1)
        return cls(tuple(effects), rows, parts, squares)

    def along(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the inner products of each force's rows with the `columns`, shape (forces, parts * sizes, columns)."""
        forces, sizes = len(self.effects), self.rows.shape[0] // max(len(self.effects), 1)
        found = [self.rows[:, part] @ columns[part] for part in self.parts]
        return np.concatenate([one.reshape(forces, sizes, columns.shape[1]) for one in found], axis=1)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thinned:
    """Every few samples of all stretches of motion, one after the other.

    Position and voltage are integrated over all samples; forces, which are compared with little, by trapezoids.

    Attributes
    ----------
    first : ndarray of int, shape (stretches,)
        Sample at which each stretch begins.
    steps : ndarray, shape (n,)
        Time since the sample before [s]; 0 at the beginning of a stretch.
    record : ndarray of int, shape (n,)
        Number of the record.
    line : ndarray, shape (n,)
        Time about its mean in each stretch, scaled to length one there.
    time, position, velocity : ndarray, shape (n,)
        As in the records.
    position_integral, voltage_integral : ndarray, shape (n,)
        Position integrated once over time, voltage twice, in each stretch.
    lightness : ndarray, shape (n,)
        By how much more than the estimate the axis accelerates in the record.
    stride : int
        Every how many samples one is kept.
    """

    first: NDArray[np.intp]
    steps: NDArray[np.float64]
    record: NDArray[np.intp]
    line: NDArray[np.float64]
    time: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    position_integral: NDArray[np.float64]
    voltage_integral: NDArray[np.float64]
    lightness: NDArray[np.float64]
    stride: int

    @classmethod
    def of(cls, segments: Sequence[Segment], velocity: Sequence[NDArray[np.float64]]) -> Thinned:
        """Thin `segments`, whose smoothed velocities are given."""
        stride = max(sum(s.time.size for s in segments) // SAMPLES, 1)
        times = [s.time[::stride] for s in segments]
        centred = [t - t.mean() for t in times]
        return cls(
            first=np.cumsum([0, *(t.size for t in times[:-1])]),
            steps=np.concatenate([np.diff(t, prepend=t[0]) for t in times]),
            record=np.repeat(record_numbers(segments), [t.size for t in times]),
            line=np.concatenate([t / max(float(np.linalg.norm(t)), 1e-300) for t in centred]),
            time=np.concatenate([s.record.time[s.first : s.first + s.time.size : stride] for s in segments]),
            position=np.concatenate([s.position[::stride] for s in segments]),
            velocity=np.concatenate([v[::stride] for v in velocity]),
            position_integral=np.concatenate([_position_integral(s)[::stride] for s in segments]),
            voltage_integral=_voltage_integral(segments, stride),
            lightness=np.concatenate([np.full(s.time[::stride].size, s.lightness) for s in segments]),
            stride=stride,
        )

    def pushed_by(self, segments: Sequence[Segment]) -> Thinned:
        """Return the samples with the voltages of `segments`, which are the same stretches."""
        return replace(self, voltage_integral=_voltage_integral(segments, self.stride))

    def proposals(self, effects: Sequence[Effect]) -> Proposals:
        """Return forces of one class ready to be ranked beside any others."""
        sizes = len(regressor(type(effects[0])).sizes) * len(waves(effects[0])) if effects else 0
        rows = shared_array((sizes * len(effects), self.time.size))

        def fill(first: int) -> None:
            some = effects[first : first + TOGETHER]
            rows[sizes * first : sizes * (first + len(some))] = self._freed(self._integrals(some)[0]) * self.lightness

        in_processes(fill, range(0, len(effects), TOGETHER))
        ends = [0, self.time.size]
        if effects and effects[0].phase_per_record:
            ends = [*np.flatnonzero(np.diff(self.record, prepend=-1)).tolist(), self.time.size]
        return Proposals.of(effects, rows, tuple(slice(*pair) for pair in pairwise(ends)))

    def left(self, others: Sequence[Effect], proposals: Proposals) -> NDArray[np.float64]:
        """Return the square error that each of the proposals leaves beside `others`, in their order.

        All sizes are solved for, of `others` too. What of a force is like the others but for rounding explains nothing.
        """
        known = np.concatenate((self.position_integral[None], self.voltage_integral[None], self._forces(others)))
        basis = np.linalg.qr((self._freed(known) * self.lightness).T)[0]
        target = self._freed(self.position[None])[0]
        target = target - basis @ (basis.T @ target)
        total = float(target @ target)
        if not proposals.rows.size:
            return np.full(len(proposals.effects), total)
        along = proposals.along(np.column_stack([basis, target]))
        beside = proposals.squares - along[..., :-1] @ along[..., :-1].transpose(0, 2, 1)
        sizes, ways = np.linalg.eigh(beside)
        seen = sizes > ALIKE * np.trace(proposals.squares, axis1=1, axis2=2)[:, None]
        explained = np.einsum("kij,ki->kj", ways, along[..., -1]) ** 2 / np.where(seen, sizes, np.inf)
        return np.asarray(total - np.sum(explained, axis=1))

    def _forces(self, effects: Sequence[Effect]) -> NDArray[np.float64]:
        """Return the double integrals of the forces per unit of each size, a row each, up to a line in each stretch."""
        integrals, ends = self._integrals(effects)
        return self._apart(effects, np.split(integrals, ends)[: len(effects)])

    def _integrals(self, effects: Sequence[Effect]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return double integrals with one phase for all records, a row each, and where those of an effect end.

        Up to a straight line in each stretch, which the caller takes off.
        """
        rows = [_rows(effect, self.time, self.position, self.velocity) for effect in effects]
        whole = np.concatenate([np.empty((0, self.time.size)), *rows])
        return self._once(self._once(whole)), np.cumsum([row.shape[0] for row in rows], dtype=np.intp)

    def _apart(self, effects: Sequence[Effect], rows: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the rows, those of a phase that is each record's own once for each: every stretch is of one record."""
        records = int(self.record[-1]) + 1
        apart = (_by_record(*each, self.record, records) for each in zip(effects, rows, strict=True))
        return np.concatenate([np.empty((0, self.time.size)), *apart])

    def _once(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integrate each row over each stretch, from where the one before has ended."""
        summed = np.zeros(rows.shape)
        np.add(rows[:, 1:], rows[:, :-1], out=summed[:, 1:])
        summed *= 0.5 * self.steps
        return np.cumsum(summed, axis=1, out=summed)

    def _freed(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take a straight line off each row in each stretch: its initial position and velocity."""
        counts = np.diff(self.first, append=self.time.size)
        means = np.add.reduceat(rows, self.first, axis=1) / counts
        slopes = np.add.reduceat(rows * self.line, self.first, axis=1)
        return np.asarray(rows - self._spread(means) - self.line * self._spread(slopes))

    def _spread(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Repeat one value a stretch over its samples."""
        return np.repeat(values, np.diff(self.first, append=self.time.size), axis=1)


def by_peaks(left: NDArray[np.float64]) -> list[int]:
    """Return the places of proposals in their order, by what each has `left`: the best of each peak, then the others.

    Ten or so of one peak of a periodogram differ little, and are better than all of the next peak.
    """
    around = np.concatenate([[np.inf], left, [np.inf]])
    is_slope = left > np.minimum(around[:-2], around[2:])
    return [int(place) for place in np.lexsort((left, is_slope))]


def _voltage_integral(segments: Sequence[Segment], stride: int) -> NDArray[np.float64]:
    return np.concatenate([held_twice_integrated(s.time, s.voltage)[::stride] for s in segments])


def _position_integral(segment: Segment) -> NDArray[np.float64]:
    from scipy.integrate import cumulative_simpson

    return np.asarray(cumulative_simpson(segment.position, x=segment.time, initial=0.0))


def record_numbers(segments: Sequence[Segment]) -> NDArray[np.intp]:
    """Return the number of each segment's record, counted from 0 in the order of the segments."""
    known: dict[int, int] = {}
    return np.array([known.setdefault(id(segment.record), len(known)) for segment in segments], dtype=np.intp)


def force_rows(
    effect: Effect,
    time: NDArray[np.float64],
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    record: NDArray[np.intp] | np.intp,
    records: int,
) -> NDArray[np.float64]:
    """Return the force of `effect` per unit of each size, a row each; empty where no size is linear.

    Sine and cosine of a wave are two; of one whose phase is each record's own, two for each of the `records`.
    """
    return _by_record(effect, _rows(effect, time, position, velocity), record, records)


def _rows(
    effect: Effect, time: NDArray[np.float64], position: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the force per unit of each size, a row each, with one phase for all records."""
    law = regressor(type(effect))
    variants = waves(effect) if law.sizes else ()
    shapes = [[getattr(variant, name) for name in law.shapes] for variant in variants]
    rows = [law.columns(time, position, velocity, *values) for values in shapes]
    return np.concatenate([np.empty((0, time.size)), *rows])


def _by_record(
    effect: Effect, rows: NDArray[np.float64], record: NDArray[np.intp] | np.intp, records: int
) -> NDArray[np.float64]:
    """Return the rows, once for each record if the phase is each record's own."""
    if not effect.phase_per_record or records == 1:
        return rows
    return np.concatenate([rows * (record == number) for number in range(records)])


def waves(effect: Effect) -> tuple[Effect, ...]:
    """Return the effect at phases 0 and π/2, if it has a phase: then two sizes give amplitude and phase."""
    if effect.wave is None:
        return (effect,)
    phase = effect.wave[1]
    return (replace(effect, **{phase: 0.0}), replace(effect, **{phase: np.pi / 2}))
