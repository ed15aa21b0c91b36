"""Which two effects together explain most: of two large causes neither may explain much alone."""

from __future__ import annotations

from contextlib import suppress
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.ordering import kind
from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.trials import Start
    from servolens.identification.score import ScoreTest
    from servolens.plant import Plant

__all__ = ["likeliest_pairs"]


def likeliest_pairs(
    test: ScoreTest, scored: Sequence[Sequence[Start]], most: int, price: Callable[[Plant], float]
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
        Pairs to return, and starts of each effect that are paired: those of other shapes come first.
    price : callable
        Of a plant: by how much −2 log-likelihood must fall for its effects.
    """
    plants = [start.plant for starts in scored for start in starts[:most]]
    parts = [test.free_columns(plant) for plant in plants]
    ends = np.cumsum([0, *(part.shape[1] for part in parts)])
    columns = np.column_stack([np.empty((test.left.size, 0)), *parts])
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    rounded = columns.shape[0] * np.finfo(float).eps  # error of a product: below it two directions are one
    products, along = columns.T @ columns, columns.T @ test.left
    pairs = []
    for i, j in combinations(range(len(plants)), 2):
        if kind(plants[i].effects) & kind(plants[j].effects):  # one generalises the other
            continue
        with suppress(InputError, NumericalError):  # two that do not go together
            plant = plants[i].with_effect(plants[j].effects[-1])
            own = np.r_[ends[i] : ends[i + 1], ends[j] : ends[j + 1]]
            sizes = np.linalg.lstsq(products[np.ix_(own, own)], along[own], rcond=rounded)[0]
            pairs.append((float(along[own] @ sizes) - price(plant), kind(plant.effects), plant))
    found: dict[frozenset[str], Plant] = {}
    for _, own_kind, plant in sorted(pairs, key=lambda pair: -pair[0]):
        found.setdefault(own_kind, plant)
    return list(found.values())[:most]
