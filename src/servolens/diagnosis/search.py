"""Which effects the model lacks: forward, one effect at a time from several hypotheses, and backward again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.threads import in_parallel
from servolens.diagnosis.trials import LAST, SECOND
from servolens.effects import CATALOGUE, CoulombFriction, DryFriction, effect_class

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from servolens.diagnosis.trials import Hypothesis, Trials
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["Search", "search"]

MOST_CAUSES, MOST_ROUNDS = 4, 4
"""Effects that are added; times that what was found is reconsidered."""
BEAM, FAR, CLOSE = 2, 2.0, 1.25
"""Families whose best is extended further, up to this many times the least error; what comes close: that many times."""
WORTH = 12.0
"""By how much the score must fall for another effect: e⁶ times likelier, parameters paid for."""
LESS, HARDLY = (0.8, 0.7, 0.5, 0.2), 0.95
"""Share of the squared error beyond the noise that the first, the second … effect may leave; the share that one may
leave that comes into its own beside others only."""
HOPELESS = (np.inf, np.inf, 100.0, 20.0)
"""Times the noise from which on no first, second … effect is looked for: too much would be left."""
REFITTED, HOPEFUL, POLISHED, ALIKE = 12, 30.0, 1.3, 1.1
"""How many hypotheses are fitted further; times the least error up to which they are, to their end, and judged."""
ROUNDING, ROUGH = 1.0, 0.2
"""Of a score, within which two forms of one plant are alike; of the noise, the smooth error that any plant has."""
NEAR = 10.0
"""Times the noise from which on hypotheses are judged without a tether."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What a search went through.

    Attributes
    ----------
    path : tuple of Hypothesis
        The best with no effect, one, two …; the last is the one chosen.
    tried : tuple of Hypothesis
        All that were fitted, in the order of trial.
    rivals : tuple of tuple of Hypothesis
        For each cause of the one chosen, what stands with another effect in its place, the best first.
    """

    path: tuple[Hypothesis, ...]
    tried: tuple[Hypothesis, ...]
    rivals: tuple[tuple[Hypothesis, ...], ...]

    def rivals_of(self, cause: str) -> tuple[Hypothesis, ...]:
        """Return what stands with another effect in the place of `cause`, the best first."""
        place = dict(zip(self.chosen.causes, self.rivals, strict=False))
        return place.get(cause, ())

    @property
    def singles(self) -> tuple[Hypothesis, ...]:
        """Hypotheses with one effect, the best first."""
        found = {h.causes: h for h in sorted(self.tried, key=_error, reverse=True) if len(h.causes) == 1}
        return tuple(sorted(found.values(), key=_error))

    @property
    def chosen(self) -> Hypothesis:
        """The hypothesis that explains most for its parameters."""
        return self.path[-1]


def search(
    trials: Trials,
    base: Hypothesis,
    enough: Callable[[Hypothesis], bool],
    tell: Callable[[str, float], None] = lambda _, __: None,
    give_up: Callable[[Hypothesis], bool] = lambda _: False,
) -> Search:
    """Return the least set of effects that explains the training records, and what else was tried.

    Parameters
    ----------
    trials : Trials
        The records.
    base : Hypothesis
        Gain and damping alone.
    enough : callable
        Tells whether a hypothesis leaves nothing to be explained.
    tell : callable
        Is told what is done and the share of it that is.
    give_up : callable
        Tells of the best with another effect whether to search no further: the records are to be understood otherwise.
    """
    explorer = _Explorer(trials, enough, tell)
    path, beam, sure = [base], [base], 0
    while (count := len(path[-1].causes)) < MOST_CAUSES and not enough(path[-1]):
        if path[-1].error > HOPELESS[count] * trials.noise:
            break
        if count == MOST_CAUSES - 1 and sure < len(path) - 1:
            break  # the last takes longest, and has not yet helped where the one before it did not
        jobs = _distinct([(hypothesis, name) for hypothesis in beam for name in CATALOGUE])
        found = explorer.explore(jobs, f"effect {count + 1}")
        if not found or not _worth_it(found[0], path[-1], trials, HARDLY):
            break
        path.append(found[0])
        if _worth_it(found[0], path[sure], trials, LESS[len(path[sure].causes)]):
            sure = len(path) - 1
        if not enough(found[0]) and give_up(found[0]):
            return Search(tuple(path), tuple(explorer.known), ())
        beam = _beam(found)
    if not enough(path[-1]):
        path = path[: sure + 1]
    for _ in range(MOST_ROUNDS):
        path, rivals, settled = _reconsidered(path, explorer)
        if settled:
            break
    return Search(tuple(path), tuple(explorer.known), rivals)


@final
class _Explorer:
    """Fits hypotheses and remembers them."""

    def __init__(
        self, trials: Trials, enough: Callable[[Hypothesis], bool], tell: Callable[[str, float], None]
    ) -> None:
        self.trials, self.enough, self.tell = trials, enough, tell
        self.known: list[Hypothesis] = []

    def explore(self, jobs: Sequence[tuple[Hypothesis, str]], what: str) -> list[Hypothesis]:
        """Return each job's hypothesis extended by its effect, the best first; the most promising fitted further."""
        done = 0

        def one(job: tuple[Hypothesis, str]) -> Hypothesis | None:
            nonlocal done
            found = self.trials.extended(*job)
            done += 1
            self.tell(what, done / len(jobs))
            return found

        found = sorted((h for h in in_parallel(one, jobs) if h), key=_error)
        for share, iterations in ((HOPEFUL, SECOND), (POLISHED, LAST)):
            promising = [h for h in found[:REFITTED] if h.error <= share * found[0].error]
            again = in_parallel(partial(self._further, iterations), promising)
            found = sorted([*again, *found[len(promising) :]], key=_error)
        found = self.judged(found)
        self.known += found
        return found

    def judged(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """Return `found` by score, the best judged without a tether where the noise is near.

        Contacts fold the error: where the best has some and leaves something, a deeper fold may be all that is lacking.
        """
        if not found or found[0].error > NEAR * self.trials.noise:
            return found
        close = [h for h in found if h.error <= ALIKE * found[0].error]
        for _ in range(2):  # one that explains the records untied binds those that were judged before it
            close = in_parallel(self.trials.judged, close)
        best, *others = sorted([*close, *found[len(close) :]], key=self.trials.score)
        if best.plant.has_contacts and best.residuals and not self.enough(best):
            best = self.trials.deepened(best)
        return [best, *others]

    def best(self, plants: Sequence[Plant]) -> Hypothesis | None:
        """Return the best of `plants`, fitted; None if there is none."""
        found = self.judged(sorted(self._fitted(plants, LAST), key=_error))
        return found[0] if found else None

    def instead(self, chosen: Hypothesis, cause: str) -> list[Hypothesis]:
        """Return what stands with another effect in the place of `cause`, the best first."""
        others = frozenset(chosen.causes) - {cause}
        names = [name for name in CATALOGUE if name not in chosen.causes]
        wanted = {frozenset((*others, name)) for name in names}
        known = {frozenset(h.causes): h for h in self.known if frozenset(h.causes) in wanted}
        if len(known) < len(names) // 2:
            without = self._fitted([chosen.plant.without_effect(cause)], 0)  # refitted, the others would take its part
            self.explore([(h, name) for h in without for name in names], f"instead of {cause}")
            known = {frozenset(h.causes): h for h in self.known if frozenset(h.causes) in wanted}
        return sorted(known.values(), key=self.trials.score)

    def _further(self, iterations: int, hypothesis: Hypothesis) -> Hypothesis:
        return self.trials.fitted(hypothesis.plant, iterations) or hypothesis

    def _fitted(self, plants: Sequence[Plant], iterations: int) -> list[Hypothesis]:
        return [h for h in in_parallel(lambda plant: self.trials.fitted(plant, iterations), plants) if h]


def _reconsidered(
    path: list[Hypothesis], explorer: _Explorer
) -> tuple[list[Hypothesis], tuple[tuple[Hypothesis, ...], ...], bool]:
    """Take each cause out again, or swap it for another; return path, rivals, and whether nothing changed."""
    score, chosen, noise, enough = explorer.trials.score, path[-1], explorer.trials.noise, explorer.enough
    if not chosen.causes:
        return path, (), True
    simpler = explorer.best([chosen.plant.without_effect(name) for name in chosen.causes])
    if len(chosen.causes) > 1 and simpler is not None and score(simpler) < score(chosen) + WORTH:
        return [*(h for h in path if len(h.causes) < len(simpler.causes)), simpler], (), False
    special = explorer.best([*_specialised(chosen.plant)])
    united = explorer.best([*_united(chosen.plant)])
    for other, will_do in ((special, _will_do(special, chosen, noise, enough)), (united, False)):
        if other is not None and (will_do or score(other) <= score(chosen) + ROUNDING):
            return [*(h for h in path[:-1] if len(h.causes) < len(other.causes)), other], (), False
    if not enough(chosen) and (len(chosen.causes) < 2 or chosen.error > HOPELESS[-1] * noise):
        return path, (), True
    rivals = tuple(tuple(explorer.instead(chosen, cause)) for cause in chosen.causes)
    swaps = [h for found in rivals for h in found if not (_contains(h, chosen) and _will_do(chosen, h, noise, enough))]
    better = min(swaps, key=score, default=chosen)
    if score(better) < score(chosen) - 1e-6:
        return [*path[:-1], better], (), False
    return path, rivals if enough(chosen) else (), True


def _will_do(
    special: Hypothesis | None, general: Hypothesis, noise: float, enough: Callable[[Hypothesis], bool]
) -> bool:
    """Tell whether a special form leaves nothing, and so little more than the general one that no axis is as exact."""
    return special is not None and enough(special) and special.error**2 - general.error**2 <= (ROUGH * noise) ** 2


def _contains(general: Hypothesis, special: Hypothesis) -> bool:
    """Tell whether an effect of the one generalises an effect of the other."""
    return any(name in effect.generalises for effect in general.plant.effects for name in special.causes)


def _specialised(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with one effect replaced by one that it generalises."""
    for effect in plant.effects:
        for name in effect.generalises:
            special = effect_class(name)
            values = {spec.name: spec.low for spec in special.parameters()}
            common = {key: getattr(effect, key) for key in values if hasattr(effect, key)}
            level = {} if common else dict.fromkeys(values, float(np.mean(effect.values)))
            yield replace(plant, effects=tuple(e for e in plant.effects if e is not effect)).with_effect(
                special(**{**values, **common, **level})
            )


def _united(plant: Plant) -> Iterator[Plant]:
    """Yield `plant` with effects replaced by the one that they are together."""
    own = {effect.name: effect for effect in plant.effects}
    for cls in CATALOGUE.values():
        if cls.unites and own.keys() >= set(cls.unites):
            one = cls.united(*(own[name] for name in cls.unites))
            if one is not None:
                others = tuple(effect for effect in plant.effects if effect.name not in cls.unites)
                yield replace(plant, effects=others).with_effect(one)


def _worth_it(longer: Hypothesis, shorter: Hypothesis, trials: Trials, most: float) -> bool:
    """Tell whether another effect pays: by the noise, and by what it does to an error that is no noise."""
    excess = [max(h.error**2 - trials.noise**2, 0.0) for h in (longer, shorter)]
    return trials.score(longer) < trials.score(shorter) - WORTH and excess[0] <= most * excess[1]


def _beam(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the best of different families, each by its simplest member, and the simplest of all that come close."""
    families: dict[frozenset[str], list[Hypothesis]] = {}
    for hypothesis in found:
        if hypothesis.error <= FAR * found[0].error:
            families.setdefault(frozenset(_family(effect) for effect in hypothesis.plant.effects), []).append(
                hypothesis
            )
    chosen = []
    for members in families.values():
        least = min(h.error for h in members)
        chosen.append(min((h for h in members if h.error <= CLOSE * least), key=lambda h: (h.free, h.error)))
    simplest = min((h for h in chosen if h.error <= CLOSE * found[0].error), key=lambda h: (h.free, h.error))
    return [*chosen[:BEAM], *(h for h in [simplest] if h not in chosen[:BEAM])]


def _family(effect: Effect) -> str:
    """Return what the effect is a kind of, where several are alike."""
    return next(iter(effect.generalises), CoulombFriction.name if isinstance(effect, DryFriction) else effect.name)


def _error(hypothesis: Hypothesis) -> float:
    return hypothesis.error


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
