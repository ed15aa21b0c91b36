"""Where a fit of effects begins: sizes from the integral equation, shapes from each effect's own proposals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects import Actuator, Seen, TimeShift
from servolens.errors import InputError, NumericalError
from servolens.identification.integral import assemble, solve_integral
from servolens.identification.ranking import Thinned, by_peaks, force_rows, record_numbers
from servolens.identification.regressors import regressor
from servolens.identification.segments import applied_at, applied_before, applied_voltage
from servolens.identification.smoothing import smooth, smoothing_window
from servolens.identification.varying import piece_duration
from servolens.plant import Plant
from servolens.simulation.loop import simulate_voltage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.identification.ranking import Proposals
    from servolens.identification.segments import Segment
    from servolens.record import Record

__all__ = ["Screen", "seen_in"]

MOST_STARTS, MOST_ACTED = 1600, 200
"""Proposals of an effect that are ranked; sets of actuators behind which the stretches are kept."""


def seen_in(segments: Sequence[Segment], plant: Plant) -> Seen:
    """Return what the stretches of motion show, and their records: where these rest counts as reached."""
    sample_time = min(s.record.sample_time for s in segments)
    positions = np.concatenate([record.position for record in {id(s.record): s.record for s in segments}.values()])
    usual = np.quantile(positions, (0.05, 0.95))
    fastest = [float(np.abs(np.gradient(s.position, s.time)).max()) for s in segments if s.time.size > 2]
    return Seen(
        low=float(positions.min()),
        high=float(positions.max()),
        usual=(float(usual[0]), float(usual[1])),
        speed=max(*fastest, 1e-9),
        command=max(float(np.abs(s.voltage).max()) for s in segments),
        gain=plant.gain,
        damping=plant.damping,
        sample_time=sample_time,
        duration=max(s.record.duration for s in segments),
        noise=max(s.noise for s in segments),
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Screen:
    """Stretches of motion made ready for the integral equation, in which effects can be tried at once.

    Attributes
    ----------
    segments : tuple of Segment
        The stretches.
    velocity : tuple of ndarray
        Theirs, smoothed.
    numbers : ndarray of int, shape (segments,)
        Of each stretch's record.
    thinned : Thinned
        A few thousand samples of them, on which many proposals are compared.
    acted : dict
        Stretches and samples as they are behind actuators that were asked for.
    """

    segments: tuple[Segment, ...]
    velocity: tuple[NDArray[np.float64], ...]
    numbers: NDArray[np.intp]
    thinned: Thinned
    acted: dict[tuple[Effect, ...], tuple[tuple[Segment, ...], Thinned]]

    @classmethod
    def of(cls, segments: Sequence[Segment]) -> Screen:
        """Differentiate the positions of `segments`."""
        window = smoothing_window(piece_duration(segments), segments[0].record.sample_time)
        velocity = [smooth(s.time, s.position, min(window, s.time.size))[1] for s in segments]
        thinned = Thinned.of(segments, velocity)
        return cls(
            segments=tuple(segments),
            velocity=tuple(velocity),
            numbers=record_numbers(segments),
            thinned=thinned,
            acted={(): (tuple(segments), thinned)},
        )

    @property
    def records(self) -> int:
        """How many records the stretches are of."""
        return int(self.numbers[-1]) + 1

    def solve(self, effects: Sequence[Effect]) -> tuple[Plant, float]:
        """Return the plant whose sizes solve the integral equation, and the root mean square of its residual.

        Parameters in which no force is linear keep the values of `effects`. Sizes are clipped into their bounds.

        Raises
        ------
        NumericalError
            If the data do not determine the sizes.
        """
        columns = [self._columns(i, effects) for i in range(len(self.segments))]
        factor = assemble(self._behind(effects)[0], forces=columns)
        damping, gain, *sizes = (float(v) for v in solve_integral(factor).x)
        samples = sum(s.time.size for s in self.segments)
        found = [_sized(effect, sizes, self.records) for effect in effects]
        return self.segments[0].plant(gain, damping, found), float(abs(factor[-1, -1]) / np.sqrt(samples))

    def best_starts(self, plant: Plant, effect: Effect, count: int) -> list[Effect]:
        """Return the values of the force `effect`, its own and those it proposes, that suit the data best.

        Its sizes and those of the plant's other forces are solved for with each proposal.
        """
        proposed = self.proposals(plant, effect)
        others = tuple(e for e in plant.effects if e.name != effect.name)
        return self.best(others, self.thinned.proposals(proposed), count, also=effect) or proposed[:1]

    def best(
        self, others: Sequence[Effect], proposals: Proposals, count: int, *, also: Effect | None = None
    ) -> list[Effect]:
        """Return the best of the `proposals` for one force beside `others`, and `also`, with sizes solved for.

        Of proposals that are in order, as pitches are, the best of each peak at first.
        """
        found: list[tuple[float, Effect]] = []
        places = by_peaks(self.left(others, proposals))
        for proposal in (*(proposals.effects[i] for i in places), *([] if also is None else [also])):
            if len(found) >= count and proposal is not also:
                continue
            try:
                solved, error = self.solve((*others, proposal))
            except (InputError, NumericalError):
                continue  # sizes that are no plant: the next proposal takes its place
            if all(solved.effects[-1] != other for _, other in found):
                found.append((error, solved.effects[-1]))
        found.sort(key=lambda pair: pair[0])
        return [effect for _, effect in found[:count]]

    def left(self, others: Sequence[Effect], proposals: Proposals) -> NDArray[np.float64]:
        """Return the square error that each of the `proposals` leaves beside `others` of a few thousand samples."""
        return self._behind(others)[1].left(others, proposals)

    def slight(self, plant: Plant, effect: Effect, share: float) -> Effect:
        """Return the force `effect` with sizes that are each a `share` of what the motor of `plant` can do.

        Where the integral equation has it at its bound, as large as nothing, its bias may have the wrong sign; and
        nothing has no direction in which it could be told how much the effect explains.
        """
        seen = self.thinned
        rows = force_rows(effect, seen.time, seen.position, seen.velocity, seen.record, 1)
        largest, push = np.abs(rows).max(axis=1), abs(plant.gain) * seen_in(self.segments, plant).command
        sizes = np.divide(share * push, largest, out=np.zeros(largest.size), where=largest > 0.0)
        return _sized(effect, sizes.tolist(), 1)

    def proposals(self, plant: Plant, effect: Effect) -> list[Effect]:
        """Return `effect` and what it proposes itself beside `plant`."""
        return [effect, *self.proposals_of(plant, type(effect))]

    def proposals_of(self, plant: Plant, cls: type[Effect]) -> list[Effect]:
        """Return what the effect `cls` proposes itself beside `plant`."""
        return [*islice(cls.starts(seen_in(self.segments, plant)), MOST_STARTS)]

    def _behind(self, effects: Sequence[Effect]) -> tuple[tuple[Segment, ...], Thinned]:
        """Return the stretches as they are behind the actuators among `effects`, in full and thinned."""
        actuators = tuple(effect for effect in effects if isinstance(effect, Actuator | TimeShift))
        found = self.acted.get(actuators)
        if found is None:
            records = {id(s.record): s.record for s in self.segments}
            pushes = {key: _pushes(record, actuators) for key, record in records.items()}
            segments = tuple(
                replace(s, voltage=np.ascontiguousarray(pushes[id(s.record)][s.first : s.first + s.time.size]))
                for s in self.segments
            )
            found = segments, self.thinned.pushed_by(segments)
            if len(self.acted) < MOST_ACTED:
                self.acted[actuators] = found
        return found

    def _columns(self, i: int, effects: Sequence[Effect]) -> NDArray[np.float64]:
        segment = self.segments[i]
        time = segment.record.time[segment.first : segment.first + segment.time.size]
        seen = (time, segment.position, self.velocity[i], self.numbers[i], self.records)
        return np.concatenate([np.empty((0, time.size)), *(force_rows(effect, *seen) for effect in effects)])


def _pushes(record: Record, actuators: tuple[Effect, ...]) -> NDArray[np.float64]:
    """Return what reaches the motor, its mean over each sample.

    By it an axis without damping accelerates; its gain is so small that it does not go far.
    """
    ticks = record.loop_ticks()
    voltage, before = applied_voltage(record), applied_before(record)
    most = max(float(np.abs(voltage).max()), abs(before or 0.0), 1e-300)
    small = 1.0 / (most * record.duration**2)
    plant = Plant(gain=small, damping=0.0, effects=actuators)
    run = simulate_voltage(plant, ticks.time, applied_at(record, ticks), before=before)
    push = np.diff(ticks.logged(run.velocity)) / np.diff(record.time) / small
    return np.append(push, push[-1])


def _sized(effect: Effect, sizes: list[float], records: int) -> Effect:
    """Return `effect` with its sizes, which are taken off the front of `sizes`; its phase is the first record's."""
    names = regressor(type(effect)).sizes
    if not names:
        return effect
    if effect.wave is not None:
        amplitude, phase = effect.wave
        pairs = [(sizes.pop(0), sizes.pop(0)) for _ in range(records if effect.phase_per_record else 1)]
        size = float(np.sqrt(np.mean([sine**2 + cosine**2 for sine, cosine in pairs])))
        return replace(effect, **{amplitude: size, phase: float(np.arctan2(pairs[0][1], pairs[0][0]))})
    specs = {spec.name: spec for spec in effect.parameters()}
    values = {name: float(np.clip(sizes.pop(0), specs[name].low, specs[name].high)) for name in names}
    return replace(effect, **values)
