"""Which two effects together explain most: of two large causes neither may explain much alone."""

from __future__ import annotations

from contextlib import suppress
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from servolens.diagnosis.trials import Start
    from servolens.effects.base import Effect
    from servolens.identification.score import ScoreTest
    from servolens.plant import Plant

__all__ = ["likeliest_pairs"]

SHAPES = 3
"""Starts of each effect that are paired: those of other shapes come first."""


def likeliest_pairs(
    test: ScoreTest, scored: Sequence[Sequence[Start]], most: int, price: Callable[[type[Effect]], float]
) -> list[Plant]:
    """Return plants with two effects whose score, prices paid, is highest together; one of each kind, the best first.

    The score of both at once takes one linear regression for each pair (Rao's test with two directions): a greedy
    search would first add what resembles both.

    Parameters
    ----------
    test : ScoreTest
        Of the hypothesis without effects.
    scored : sequence of sequence of Start
        Starts of each effect, the likeliest first.
    most : int
        Pairs to return.
    price : callable
        Of a kind of effect: by how much −2 log-likelihood must fall for it.
    """
    parts = [(start.plant, test.free_columns(start.plant)) for starts in scored for start in starts[:SHAPES]]
    scores = [
        (test.explained(np.column_stack([left, right])) - _paid(price, one, other), one, other)
        for (one, left), (other, right) in combinations(parts, 2)
        if one.effects[-1].name != other.effects[-1].name
    ]
    found: dict[frozenset[str], Plant] = {}
    for _, one, other in sorted(scores, key=lambda pair: -pair[0]):
        kind = frozenset([*_kind(one.effects[-1]), *_kind(other.effects[-1])])
        if kind not in found:
            with suppress(InputError, NumericalError):  # two that do not go together
                found[kind] = one.with_effect(other.effects[-1])
        if len(found) == most:
            break
    return list(found.values())


def _paid(price: Callable[[type[Effect]], float], *plants: Plant) -> float:
    return sum(price(type(plant.effects[-1])) for plant in plants)


def _kind(effect: Effect) -> Iterator[str]:
    yield from effect.generalises or (effect.name,)
