"""Hypotheses in order: which are extended, which are alike, and what is simpler or united."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import reduce
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import (
    Actuator,
    ActuatorLag,
    Drive,
    DryFriction,
    Sensor,
    SpeedServo,
    TimeShift,
    catalogue,
    effect_class,
)
from servolens.effects._grids import within
from servolens.effects.base import Axis
from servolens.errors import InputError
from servolens.identification.phases import own_phases
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from servolens.effects.base import Effect, Seen
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.noise import NoiseModel
    from servolens.identification.starting import Screen

__all__ = [
    "INDISTINCT",
    "beside_shaking",
    "best_of_each",
    "by_total",
    "by_worst",
    "chosen_for_extension",
    "delays",
    "distinct",
    "families",
    "is_last_resort",
    "kind",
    "late_otherwise",
    "otherwise",
    "parted",
    "simplified",
    "specialised",
    "united",
    "with_lag_for_damping",
    "with_lag_for_servo",
    "with_twins",
    "without",
]

INDISTINCT = 10.0
"""Difference of −2 log-likelihood up to which two hypotheses are rivals: odds of 1 to 150."""


def chosen_for_extension(ranked: Sequence[Hypothesis], places: int) -> list[Hypothesis]:
    """Return the hypotheses that are extended: the best, and as many that know no wave in time.

    A wave explains a part of whatever is left, so it is as close as any and says least.
    """
    best = ranked[:places]
    others = [h for h in ranked if not own_phases(h.plant)][:places]
    return [*best, *(h for h in others if h not in best)]


def families(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the best of each family: hypotheses whose last effects generalise each other are one."""
    kept: dict[frozenset[str], Hypothesis] = {}
    for hypothesis in found:
        family = kind(hypothesis.plant.effects)
        if not any(family & known and len(known) == len(family) for known in kept):
            kept[family] = hypothesis
    return list(kept.values())


def kind(effects: Iterable[Effect | type[Effect]]) -> frozenset[str]:
    """Return the names of what effects generalise, or their own: two that share one are of a kind."""
    return frozenset(name for effect in effects for name in (effect.generalises or (effect.name,)))


def is_last_resort(hypothesis: Hypothesis) -> bool:
    """Tell whether a cause describes nearly anything of its kind.

    What it leaves, an observer follows in any case; and what simpler causes leave says more of a further one.
    """
    return any(effect_class(name).is_last_resort for name in hypothesis.causes)


def specialised(plant: Plant, motion: Screen) -> Iterator[Plant]:
    """Yield `plant` with one effect replaced by one that it generalises, as large as it is over the `motion`."""
    for effect in plant.effects:
        for name in effect.generalises:
            special = effect_class(name)
            names = [spec.name for spec in special.parameters()]
            if isinstance(effect, DryFriction):
                if not all(one.startswith("level") for one in names):
                    continue  # a level tells nothing of a place, a width or a speed
                values = dict.fromkeys(names, _mean_level(effect, motion))
            else:
                values = {name: getattr(effect, name) for name in names}
            others = replace(plant, effects=tuple(e for e in plant.effects if e is not effect))
            with suppress(InputError):
                yield others.with_effect(special(**values))


def without(plant: Plant, name: str) -> Plant:
    """Return `plant` without the effect `name`; what the loop of a drive did at once is gain and damping then."""
    effect, bare = plant.effect(name), plant.without_effect(name)
    return replace(bare, damping=bare.damping + effect.damping) if isinstance(effect, Drive) else bare


def simplified(plant: Plant, seen: Seen) -> Iterator[Plant]:
    """Yield `plant` with one effect in a form that does without something."""
    for effect in plant.effects:
        for simple in effect.simplified(seen):
            if simple.is_rotary and plant.length_unit != "rad":
                continue
            with suppress(InputError):  # where that stands already
                yield replace(plant, effects=tuple(simple if e is effect else e for e in plant.effects))


def united(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with effects replaced by the one that they are together."""
    own = {effect.name: effect for effect in plant.effects}
    for cls in catalogue().values():
        if cls.unites and own.keys() >= set(cls.unites):
            one = cls.united(*(own[name] for name in cls.unites))
            if one is not None:
                others = tuple(effect for effect in plant.effects if effect.name not in cls.unites)
                yield replace(plant, effects=others).with_effect(one)


def parted(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with one effect replaced by those that it unites, which may be more together than it can be.

    One of these that stands already in a more general form is added to that: of friction that differs by direction
    beside Stribeck friction, only the constant force is new. Then without another effect each: it may have made up for
    what the one could not be.
    """
    for effect in plant.effects:
        with suppress(InputError):  # where one of them stands already, or is larger than it can be
            parts = effect.parts()
            if parts:
                others = replace(plant, effects=tuple(e for e in plant.effects if e is not effect))
                whole = reduce(_with_part, parts, others)
                yield whole
                yield from (whole.without_effect(other.name) for other in others.effects)


def _with_part(plant: Plant, part: Effect) -> Plant:
    """Return `plant` with a `part`; a friction that generalises it takes its level instead."""
    for effect in plant.effects:
        values = {spec.name: value for spec, value in zip(effect.parameters(), effect.values, strict=True)}
        if part.name in effect.generalises and part.values and "level" in values:
            fuller = Plant.effect_from(effect.name, {**values, "level": values["level"] + part.values[0]})
            return replace(plant, effects=tuple(fuller if e is effect else e for e in plant.effects))
    return plant.with_effect(part)


def with_twins(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with an effect replaced by what does the same elsewhere in the loop if all between is linear."""
    for effect in plant.effects:
        if effect.twin and plant.effect(effect.twin) is None:
            values = {spec.name: getattr(effect, spec.name) for spec in effect.parameters()}
            with suppress(InputError):
                yield plant.without_effect(effect.name).with_effect(Plant.effect_from(effect.twin, values))


def otherwise(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with an effect replaced by one that does the same, or nearly, to what is slow."""
    yield from with_twins(plant)
    yield from with_lag_for_servo(plant)
    yield from late_otherwise(plant)


def with_lag_for_damping(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with damping as large as its actuator's lag is quick, and a lag as slow as its damping is small.

    Without other effects, or with linear ones of the sensor or in time alone, the same: g / (s (s + d) (T s + 1)) is
    g' / (s (s + 1/T) (s/d + 1)) with g' = g / (d T); there the lag is held to be the quicker. What acts between the
    two, a limit of force or dry friction, tells one from the other, but no small step of a fit leads from one to the
    other.
    """
    lag = plant.effect(ActuatorLag.name)
    others = [effect for effect in plant.effects if effect is not lag]
    is_told = any(not (isinstance(effect, Sensor | TimeShift) and effect.linear) for effect in others)
    is_free = is_told and not any(isinstance(effect, Drive) for effect in plant.effects)
    if isinstance(lag, ActuatorLag) and is_free and min(plant.damping, lag.time_constant) > 0.0:
        quick = 1.0 / lag.time_constant
        with suppress(InputError):  # slower than any lag, or too quick
            other = plant.without_effect(lag.name).with_effect(ActuatorLag(time_constant=1.0 / plant.damping))
            yield replace(other, gain=plant.gain * quick / plant.damping, damping=quick)


def with_lag_for_servo(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with a lag of its actuator for a drive's speed loop that has hardly a proportional part.

    i s V / (s (s² + (d + p) s + i)) is that of a lag and a damping, whose rates are the roots of the last factor: with
    the zero that p makes, the loop is one of a family that has the lag as its limit.
    """
    servo = plant.effect(SpeedServo.name)
    if not isinstance(servo, SpeedServo):
        return
    half = 0.5 * (plant.damping + servo.proportional)
    if half * half > servo.integral > 0.0:
        quick = half + sqrt(half * half - servo.integral)
        slow = servo.integral / quick
        with suppress(InputError):  # where a lag stands already, or that is too quick
            other = plant.without_effect(servo.name).with_effect(ActuatorLag(time_constant=1.0 / quick))
            yield replace(other, gain=slow * servo.speed_per_volt, damping=slow)


def delays(time: float) -> Iterator[Effect]:
    """Yield the effects because of which a command acts later, by a `time` [s] that is their only parameter."""
    for cls in catalogue().values():
        if _is_late(cls) and not issubclass(cls, Sensor):
            yield within(cls, **{spec.name: time for spec in cls.parameters()})


def late_otherwise(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with what makes its loop late replaced by each other effect that does so by as long."""
    for effect in plant.effects:
        if _is_late(type(effect)):
            for cls in catalogue().values():
                if _is_late(cls) and plant.effect(cls.name) is None:
                    late = within(cls, **{spec.name: effect.values[0] for spec in cls.parameters()})
                    with suppress(InputError):  # two that do not go together
                        yield plant.without_effect(effect.name).with_effect(late)


def _is_late(cls: type[Effect]) -> bool:
    """Tell whether effects of a class make a loop late: a time is their only parameter."""
    return issubclass(cls, (Actuator, Sensor, TimeShift)) and [spec.unit for spec in cls.parameters()] == ["s"]


def beside_shaking(found: Iterable[Hypothesis], noise: NoiseModel) -> Iterator[Hypothesis]:
    """Yield each hypothesis, and where it was found as if nothing shook the axis, the same beside shaking `noise`."""
    for hypothesis in found:
        yield hypothesis
        if hypothesis.noise.rate == 0.0 < noise.rate:
            yield replace(hypothesis, noise=noise)


def _mean_level(friction: DryFriction, motion: Screen) -> float:
    """Return the level of a dry `friction`, the mean over the `motion`."""
    places, velocities = motion.thinned.position.tolist(), motion.thinned.velocity.tolist()
    levels = [
        float(type(friction).physics(Axis(place, speed, abs(speed), np.sign(speed), 0.0), friction))
        for place, speed in zip(places, velocities, strict=True)
    ]
    return float(np.mean(levels))


def distinct(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the first of each set of effects."""
    first: dict[frozenset[str], Hypothesis] = {}
    for hypothesis in found:
        first.setdefault(frozenset(hypothesis.causes), hypothesis)
    return list(first.values())


def by_total(hypothesis: Hypothesis) -> float:
    """Return the key that puts the likeliest first, prices paid."""
    return hypothesis.total


def by_worst(hypothesis: Hypothesis) -> float:
    """Return the key that puts it last."""
    return -hypothesis.total


def best_of_each(found: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Return the likeliest of each set of effects, the likeliest of all first."""
    return tuple(sorted({frozenset(h.causes): h for h in sorted(found, key=by_worst)}.values(), key=by_total))
