"""Which effects the model lacks: forward, one effect at a time from several hypotheses, and backward again."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from servolens.effects import CATALOGUE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.trials import Hypothesis, Trials

__all__ = ["Search", "search"]

MOST_CAUSES = 4
BEAM = 3
"""Hypotheses that are extended further."""
WORTH = 12.0
"""By how much the score must fall for another effect: e⁶ times likelier, parameters paid for."""
POLISHED, ALIKE = 1.3, 1.1
"""Times the least error up to which a hypothesis is fitted to the end, and judged without a tether."""
NEAR = 3.0
"""Times the noise from which on hypotheses are judged so."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What a search went through.

    Attributes
    ----------
    path : tuple of Hypothesis
        The best with no effect, one, two …, up to the one chosen.
    tried : tuple of tuple of Hypothesis
        All of each size that were fitted, the best first.
    """

    path: tuple[Hypothesis, ...]
    tried: tuple[tuple[Hypothesis, ...], ...]

    @property
    def chosen(self) -> Hypothesis:
        """The hypothesis that explains most for its parameters."""
        return self.path[-1]


def search(
    trials: Trials,
    base: Hypothesis,
    enough: Callable[[Hypothesis], bool],
    tell: Callable[[str, float], None] = lambda _, __: None,
) -> Search:
    """Return the least set of effects that explains the training records, and what else was tried."""
    path, beam = [base], [base]
    tried: list[tuple[Hypothesis, ...]] = [(base,)]
    while len(path) <= MOST_CAUSES and not enough(path[-1]):
        found = _extensions(trials, beam, lambda share: tell(f"{len(path)}", share))
        tried.append(tuple(found))
        if not found or trials.score(found[0]) > trials.score(path[-1]) - WORTH:
            break
        path.append(found[0])
        beam = found[:BEAM]
    return Search(tuple(path), tuple(tried))


def _extensions(trials: Trials, beam: Sequence[Hypothesis], tell: Callable[[float], None]) -> list[Hypothesis]:
    """Return every hypothesis of the beam with every effect, the best first and those fitted to the end."""
    jobs = _distinct([(hypothesis, name) for hypothesis in beam for name in CATALOGUE])
    done = 0

    def one(job: tuple[Hypothesis, str]) -> Hypothesis | None:
        nonlocal done
        found = trials.extended(*job)
        done += 1
        tell(done / len(jobs))
        return found

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        found = [h for h in pool.map(one, jobs) if h is not None]
        found.sort(key=lambda h: h.error)
        close = [h for h in found if h.error <= POLISHED * found[0].error]
        polished = sorted((h for h in pool.map(lambda h: trials.fitted(h.plant), close) if h), key=lambda h: h.error)
        if polished and polished[0].error <= NEAR * trials.noise:
            near = [h for h in polished if h.error <= ALIKE * polished[0].error]
            polished = [*pool.map(trials.judged, near), *polished[len(near) :]]
    return sorted([*polished, *found[len(close) :]], key=trials.score)


def _distinct(jobs: list[tuple[Hypothesis, str]]) -> list[tuple[Hypothesis, str]]:
    """Leave out jobs that come to the same set of effects as one before."""
    seen: set[frozenset[str]] = set()
    kept = []
    for hypothesis, name in jobs:
        names = frozenset((*hypothesis.causes, name))
        if names not in seen:
            seen.add(names)
            kept.append((hypothesis, name))
    return kept
