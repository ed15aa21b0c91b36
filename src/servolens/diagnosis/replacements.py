"""Plants with a cause in another form, as a score test has it: one of the same family, or with more parameters."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

from servolens.diagnosis.ordering import INDISTINCT, by_worst, specialised
from servolens.effects import catalogue
from servolens.errors import InputError
from servolens.identification.score import ScoreTest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from servolens.diagnosis.trials import Trials
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.plant import Plant

__all__ = ["as_good_alone", "kin", "last_resorts", "promising"]


def as_good_alone(likelihood: Likelihood, hypothesis: Hypothesis, singles: Sequence[Hypothesis]) -> Iterator[Plant]:
    """Yield the plant with a cause replaced by one that explained as much while it was alone, or nearly.

    What a model gets wrong is no noise: a loop remembers it, and as long it counts once.
    """
    alone = {h.causes[0]: h for h in sorted(singles, key=by_worst) if len(h.causes) == 1}
    for name in hypothesis.causes:
        own = alone.get(name)
        counts = likelihood.remembered if own is not None and own.noise.is_model_error else 1.0
        limit = -inf if own is None else own.total + INDISTINCT * counts
        for other, single in alone.items():
            if single.total <= limit and other not in hypothesis.causes:
                with suppress(InputError):  # two that do not go together
                    yield hypothesis.plant.without_effect(name).with_effect(single.plant.effects[0])


def kin(trials: Trials, hypothesis: Hypothesis) -> Iterator[Plant]:
    """Yield the plant with a cause replaced by another one that generalises the same."""
    for special in specialised(hypothesis.plant, trials.screen):
        name = special.effects[-1].name
        others = {n: c for n, c in catalogue().items() if name in c.generalises and n not in hypothesis.causes}
        test = ScoreTest(trials.likelihood, replace(hypothesis, plant=special))
        for other, cls in others.items():
            starts = [] if cls.is_last_resort else trials.starts(test, other)
            yield from (start.plant for start in starts[:1])


def last_resorts(trials: Trials, hypothesis: Hypothesis) -> Iterator[Plant]:
    """Yield the plant with a last resort in the place of causes that it generalises, or of their kin."""
    for plant in (hypothesis.plant, *specialised(hypothesis.plant, trials.screen)):
        test = ScoreTest(trials.likelihood, replace(hypothesis, plant=plant))
        for name, cls in catalogue().items():
            if cls.is_last_resort and set(cls.generalises) & {effect.name for effect in plant.effects}:
                starts = trials.starts(test, name)[:1]
                yield from (start.plant for start in starts if start.gain > trials.price(cls))


def promising(likelihood: Likelihood, hypothesis: Hypothesis, plants: Sequence[Plant], share: float) -> list[Plant]:
    """Return those of `plants`, more parameters of the same effects, whose score is this `share` of what these cost."""
    test, price = ScoreTest(likelihood, hypothesis), likelihood.price
    return [plant for plant in plants if test.gain(plant) > share * (price(plant) - price(hypothesis.plant))]
