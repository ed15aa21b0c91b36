"""Hunting: a loop that never comes to rest at its reference, predicted by simulation from many starts.

Integral action beside stiction, backlash, a limited command: each can keep an axis swinging for ever, and often only
from some starts, so that one step does not tell.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.parts import parts_where
from servolens.design.settle import horizon
from servolens.effects import DryFriction, Saturation
from servolens.errors import NumericalError
from servolens.processors import in_parallel
from servolens.simulation import simulate_loop

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from servolens.controller import Controller
    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

    Span = tuple[float, float]

__all__ = ["Hunting", "hunting", "without_hunting"]

STARTS = (0.01, 0.1, 0.5, 1.0, 2.0)
"""Distances from the reference at which an axis sets out from rest, in steps of the spec, to both sides."""
FLOOR = 0.01
"""Share of the band below which a swing does not matter: the spec asks for a hundred times less."""
KEPT = 0.9
"""Share of the swing of a quarter of the time that is left in the next, from which on it stays. A linear loop loses it
exponentially. Beside Coulomb friction alone an integral brings the axis closer as 1/t, which leaves 2/3."""
ACCELERATION, JUMPS = "{x}/s^2", 8.0
"""The unit of a level of friction; how often an integral may break the axis loose during a run: two swings a half."""
MOST_SAMPLES = 200_000
"""The longest simulation: while an axis sticks, a sample costs some ten nanoseconds."""
TRIED = 9
"""Gains at which each interval is tried, at least."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Hunting:
    """A swing around the reference that does not end: the largest that was found.

    Attributes
    ----------
    amplitude : float
        Half of the way from end to end [m or rad]; infinite where the axis runs away.
    period : float or None
        Mean time from one swing to the next [s]; None where the axis runs away.
    start : float
        From where it was reached: distance from the reference, at rest [m or rad].
    share : float
        Of the starts, those from which the axis hunts.
    """

    amplitude: float
    period: float | None
    start: float
    share: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields; what is not known, or grows without bound, is null with a reason."""
        result = {f.name: getattr(self, f.name) for f in fields(self)}
        if not np.isfinite(self.amplitude):
            result |= {"amplitude": None, "reason": "the axis runs away from this start"}
        return result


def hunting(plants: Plant | Sequence[Plant], spec: PDSpec, gain: float) -> Hunting | None:
    """Return the largest swing around the reference that does not end; None if from all starts the axis comes to rest.

    It sets out at rest, on both sides of the reference, with an empty integral, and at the reference with a full one.
    Each run lasts until an integral could have broken the axis loose several times at the smallest error that matters,
    or for as long as a swing grows, but no longer than 200 000 samples. It hunts where the last half of the run has two
    swings at least, larger than a hundredth of the band, and the last quarter has at least nine tenths of the swing of
    the quarter before.

    Parameters
    ----------
    plants : Plant or sequence of Plant
        One model, or several of which the worst counts.
    spec : PDSpec
        The loop, its step and its band.
    gain : float
        That the spec leaves open: kd, or kv of a cascade.

    Examples
    --------
    >>> from servolens import PDSpec, Plant, StribeckFriction
    >>> friction = StribeckFriction(level=0.2, static_excess=0.3, stribeck_speed=0.01)
    >>> axis, spec = Plant(gain=1.9, damping=6.0, effects=(friction,)), PDSpec(kp=100, settling_time=0.5, ki=400)
    >>> hunting(axis, spec, 2.0) is None, hunting(Plant(gain=1.9, damping=6.0), spec, 2.0) is None
    (False, True)
    """
    models = (plants,) if not isinstance(plants, list | tuple) else plants
    found = [one for model in models if (one := _of(model, spec, gain)) is not None]
    return max(found, key=lambda one: one.amplitude, default=None)


def without_hunting(models: tuple[Plant, ...], spec: PDSpec, spans: Iterable[Span], gap: float) -> tuple[Span, ...]:
    """Return what is left of intervals of gains without those that hunt.

    Each interval is tried at nine gains or more; where neighbours differ, the border is located within `gap`.
    """
    return parts_where(lambda gain: hunting(models, spec, gain) is None, spans, gap, TRIED)


def _of(plant: Plant, spec: PDSpec, gain: float) -> Hunting | None:
    """Return the largest swing of one plant."""
    loop, step = spec.loop(gain), abs(spec.reference)
    floor = FLOOR * spec.band * step
    time = np.asarray(spec.sample_time * np.arange(_samples(plant, spec, loop, floor)), dtype=np.float64)
    charge = abs(loop.kp) * step
    starts = [(side * size * step, 0.0) for size in STARTS for side in (1.0, -1.0)]
    if loop.integrates:
        starts += [(0.0, charge), (0.0, -charge)]

    def swing(start: tuple[float, float]) -> Hunting | None:
        return _swing(plant, replace(loop, integral_before=start[1]), spec, time, start[0])

    found = [one for one in in_parallel(swing, starts) if one is not None and one.amplitude > floor]
    if not found:
        return None
    return replace(max(found, key=lambda one: one.amplitude), share=len(found) / len(starts))


def _samples(plant: Plant, spec: PDSpec, loop: Controller, floor: float) -> int:
    """Return how many samples a run has: twice as many as a step is watched, more where an integral must wind up."""
    lasts = 2.0 * horizon(plant, spec)
    winding = abs(plant.gain) * abs(loop.ki + loop.integral_rate * loop.kp)
    levels = (
        abs(value)
        for effect in plant.effects
        if isinstance(effect, DryFriction)
        for spec_of, value in zip(effect.parameters(), effect.values, strict=True)
        if spec_of.unit == ACCELERATION
    )
    if winding > 0.0:
        lasts += JUMPS * 2.0 * sum(levels) / (winding * floor)
    return int(min(np.ceil(lasts / spec.sample_time), MOST_SAMPLES))


def _swing(plant: Plant, loop: Controller, spec: PDSpec, time: NDArray[np.float64], away: float) -> Hunting | None:
    """Return the swing that an axis keeps which sets out so far `away` from the reference; None if it keeps none.

    The voltage before the run does not matter: only its end is examined.
    """
    start = (spec.reference + away, 0.0)
    limit = None if plant.effect(Saturation.name) is not None else np.inf
    try:
        run = simulate_loop(plant, loop, time, np.full(time.size, spec.reference), start=start, limit=limit)
    except NumericalError:
        return Hunting(amplitude=np.inf, period=None, start=away, share=0.0)
    before, last = np.array_split(run.position - spec.reference, 4)[2:]
    if np.ptp(last) * KEPT > np.ptp(before) and 2 * time.size <= MOST_SAMPLES:  # it grows
        longer = np.asarray(spec.sample_time * np.arange(2 * time.size), dtype=np.float64)
        return _swing(plant, loop, spec, longer, away)
    if np.ptp(last) < KEPT * np.ptp(before):
        return None
    period = _period(np.concatenate([before, last]), spec.sample_time)
    return (
        None if period is None else Hunting(amplitude=0.5 * float(np.ptp(last)), period=period, start=away, share=0.0)
    )


def _period(swing: NDArray[np.float64], sample_time: float) -> float | None:
    """Return the mean time between upward crossings of the middle; they count after a quarter of the way down."""
    low, high = float(swing.min()), float(swing.max())
    upper, lower = swing > low + 0.625 * (high - low), swing < low + 0.375 * (high - low)
    sides = np.where(upper, 1, np.where(lower, -1, 0))
    told = np.flatnonzero(sides)
    rising = told[1:][np.diff(sides[told]) > 0]
    return None if rising.size < 2 else float(rising[-1] - rising[0]) / (rising.size - 1) * sample_time
