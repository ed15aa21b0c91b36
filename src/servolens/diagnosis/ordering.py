"""Hypotheses in order: which are extended, which are alike, and what is simpler or united."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import catalogue, effect_class
from servolens.errors import InputError
from servolens.identification.phases import own_phases

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servolens.effects.base import Seen
    from servolens.identification.hypothesis import Hypothesis
    from servolens.plant import Plant

__all__ = [
    "by_total",
    "by_worst",
    "chosen_for_extension",
    "distinct",
    "families",
    "simplified",
    "specialised",
    "united",
]


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
        family = frozenset(
            name for effect in hypothesis.plant.effects for name in (effect.generalises or (effect.name,))
        )
        if not any(family & known and len(known) == len(family) for known in kept):
            kept[family] = hypothesis
    return list(kept.values())


def specialised(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with one effect replaced by one that it generalises."""
    for effect in plant.effects:
        for name in effect.generalises:
            special = effect_class(name)
            values = {spec.name: spec.low for spec in special.parameters()}
            common = {key: getattr(effect, key) for key in values if hasattr(effect, key)}
            level = {} if common else dict.fromkeys(values, float(np.mean(effect.values)))
            others = replace(plant, effects=tuple(e for e in plant.effects if e is not effect))
            try:
                yield others.with_effect(special(**{**values, **common, **level}))
            except InputError:
                continue


def simplified(plant: Plant, seen: Seen) -> Iterator[Plant]:
    """Yield `plant` with one effect in a form that does without something."""
    for effect in plant.effects:
        for simple in effect.simplified(seen):
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
