"""A search beside noise of one kind: one cause at first, then as many as the effort finds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.explorer import Explorer
from servolens.diagnosis.ordering import (
    INDISTINCT,
    beside_shaking,
    best_of_each,
    by_total,
    chosen_for_extension,
    distinct,
    families,
)
from servolens.diagnosis.replacements import last_resorts

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.effort import Effort
    from servolens.diagnosis.trials import Trials
    from servolens.identification.hypothesis import Hypothesis

    MadeOf = Callable[[Hypothesis, float], Hypothesis | None]

__all__ = ["Search", "Walk"]

SIMPLE = 0.75
"""Of the effort, what the search without last resorts may take. Chosen on axes of the laboratory."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What a search went through.

    Attributes
    ----------
    path : tuple of Hypothesis
        The best with no effect, one, two …; the last is the one chosen.
    judged : tuple of Hypothesis
        All that were fitted to their optimum, one of each set of effects, the best first.
    singles : tuple of Hypothesis
        Single effects, not all of them to their optimum, the best first.
    ended_early : bool
        Whether the effort was spent before nothing more could be found, and what is left depends on the inputs.
    """

    path: tuple[Hypothesis, ...]
    judged: tuple[Hypothesis, ...]
    singles: tuple[Hypothesis, ...]
    ended_early: bool

    @property
    def chosen(self) -> Hypothesis:
        """The hypothesis that explains most for its parameters."""
        return self.path[-1]

    def rivals_of(self, cause: str) -> list[Hypothesis]:
        """Return what explains about as much as the chosen one, without `cause` among its effects."""
        limit = self.chosen.total + INDISTINCT
        return [h for h in self.judged if cause not in h.causes and h.total <= limit]


@final
@dataclass(slots=True, eq=False)
class Walk:
    """A search that may be interrupted after its first cause, and then goes on from there.

    Attributes
    ----------
    trials : Trials
        The records, with the noise that is looked at beside a model.
    base : Hypothesis
        Gain and damping alone.
    effort : Effort
        How far to go.
    tell : callable
        Is told what is done and the share of the whole search that is.
    is_enough : callable
        Tells whether a hypothesis leaves nothing that depends on the inputs.
    known : sequence of Hypothesis
        Others that were fitted to these records before.
    share : float
        Of the effort, what it may take.
    begins : Hypothesis, optional
        Beside which the first cause is looked for, if not beside `base`.
    ends : callable
        It ends with a hypothesis at once if what this makes of it, given the work it may do, is likelier than its last
        resorts.
    unobserved : callable
        It ends at once with what this makes of a hypothesis, if anything.
    likely : float
        While the total of the likeliest single cause is larger than this, pairs without it, and last resorts in its
        place, wait: until :meth:`whole` goes on, or, where this is −∞, until all last resorts are tried.
    """

    trials: Trials
    base: Hypothesis
    effort: Effort
    tell: Callable[[str, float], None]
    is_enough: Callable[[Hypothesis], bool]
    known: Sequence[Hypothesis] = ()
    share: float = 1.0
    begins: Hypothesis | None = None
    ends: MadeOf = lambda _found, _work: None
    unobserved: MadeOf = lambda _found, _work: None
    likely: float = math.inf
    explorer: Explorer = field(init=False)
    _looked: tuple[list[Hypothesis], list[Hypothesis]] | None = field(init=False, default=None)
    _asked: set[frozenset[str]] = field(init=False, default_factory=set)
    _has_ended: bool = field(init=False, default=False)
    _part: tuple[float, float] = field(init=False, default=(0.0, 1.0))
    _is_repeated: bool = field(init=False, default=False)
    _goes_on: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        self.explorer = Explorer(self.trials, self.effort, self._told, self.known, self.is_enough, SIMPLE * self.share)

    @property
    def work(self) -> int:
        """Work of all simulations so far."""
        return self.trials.likelihood.work

    @property
    def likeliest(self) -> Hypothesis:
        """The likeliest of all that was fitted so far."""
        return min([self.base, *self.explorer.judged], key=by_total)

    @property
    def has_ended(self) -> bool:
        """Whether it has ended at once, with what `ends` or `unobserved` finds."""
        return self._has_ended

    def has_asked(self, hypothesis: Hypothesis) -> bool:
        """Tell whether what seems shaken with these causes was fitted as if nothing shook it: that was no answer."""
        return hypothesis.noise.rate > 0.0 and frozenset(hypothesis.causes) in self._asked

    def _told(self, what: str, share: float) -> None:
        low, high = self._part
        self.tell(what, low + (high - low) * share)

    def first(self, part: tuple[float, float]) -> Search | None:
        """Look for one cause, or a pair, and return the whole search where that is the end of it.

        That is so if it leaves nothing that depends on the inputs, and nothing shakes the axis. What is beside shaking
        may be an impostor of which an observer follows the rest. The progress that is told begins and ends with `part`.
        """
        self._part = part
        found, pairs = looked = self._next([self.base], self._beam([self.base]))
        self._is_repeated = not pairs and self._others_wait(found)
        self._looked = None if self._is_repeated else looked
        alone = self._without_observer(pairs)
        if alone:
            return self._found([self.base, alone])
        best = min([self.base, *found[:1]], key=by_total)
        return self._whole() if best.noise.rate == 0.0 and self.is_enough(best) else None

    def whole(
        self,
        begun: Sequence[Hypothesis] = (),
        *,
        part: tuple[float, float] = (0.0, 1.0),
        goes_on: bool = False,
        share: float | None = None,
        longer: float = 0.0,
        promising: float = -math.inf,
    ) -> Search:
        """Go on, and return all that was found.

        Parameters
        ----------
        begun : sequence of Hypothesis
            What was found beside other noise.
        part : (float, float)
            Where the progress that is told begins and ends, 0 to 1.
        goes_on : bool
            Whether to begin there even if that leaves something which depends on the inputs.
        share : float, optional
            Of the effort, what it may take from here on, if not as much as before.
        longer, promising : float
            Share of the effort to take if a total less than this has been found.
        """
        self._part, self._has_ended, self._goes_on = part, False, True
        if share is not None:
            self.share = share + self.work / max(self.effort.work, 1.0)
            self.explorer.grant(SIMPLE * self.share)
        return self._whole(begun, goes_on=goes_on, longer=longer, promising=promising)

    def _whole(
        self,
        begun: Sequence[Hypothesis] = (),
        *,
        goes_on: bool = False,
        longer: float = 0.0,
        promising: float = -math.inf,
    ) -> Search:
        explorer, is_enough, work = self.explorer, self.is_enough, self.effort.work
        reached = self._path_to_the_best(begun)
        begins_there = goes_on or is_enough(reached[-1])
        path, early = self._walked(reached if begins_there else [self.base], SIMPLE * self.share * work)
        if self._has_ended:
            return self._found(path)
        if is_enough(path[-1]):
            early = False
        else:
            explorer.with_last_resorts = True
            explorer.grant(self.share)
            further, early = self._walked([self.base], self.share * work)
            if self._has_ended:
                return self._found(further)
            path = min(path, further, reached, key=lambda steps: steps[-1].total)
            is_promising = path[-1].total < promising and not is_enough(path[-1])
            if early and is_promising and explorer.budget.has_more(longer * work):
                explorer.grant(longer)
                path, early = self._walked(path, longer * work)
                if self._has_ended:
                    return self._found(path)
        if is_enough(path[-1]):
            explorer.grant(1.0)  # of the effort: what explains is worth it
        chosen = explorer.settled(path[-1])
        return self._found([*(h for h in path if len(h.causes) < len(chosen.causes)), chosen], early=early)

    def _found(self, path: Sequence[Hypothesis], *, early: bool = False) -> Search:
        singles = tuple(sorted(self.explorer.singles, key=by_total))
        return Search(tuple(path), best_of_each(self.explorer.judged), singles, ended_early=early)

    def _path_to_the_best(self, begun: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the way to the best of those `begun`, if it is likelier than all that was fitted before.

        Or likelier than gain and damping alone and leaves nothing that depends on the inputs.

        Those that were found as if nothing shook an axis that seems shaken are fitted beside the noise of the latter
        too.
        """
        base, explorer, before = self.base, self.explorer, self.likeliest
        explorer.singles += distinct([h for h in begun if len(h.causes) == 1])
        found = explorer.fitted([(h.plant, h) for h in beside_shaking(distinct(begun), base.noise)])
        limit = base.total if found and self.is_enough(found[0]) else before.total
        if not found or found[0].total >= limit:
            return [base]
        best = explorer.improved(found[0])
        return self._steps([base], best) if best.causes else [best]

    def _walked(self, path: list[Hypothesis], work: float) -> tuple[list[Hypothesis], bool]:
        """Return `path` and further steps of one effect each, and whether `work` was spent before the end.

        Then it ends with the likeliest of all that was fitted.
        """
        beam, steps, explorer = self._beam(path), 0, self.explorer
        while len(path[-1].causes) < self.effort.causes:
            if not (explorer.budget.has_more(work) if steps else explorer.budget.left > 0.0):
                return self._to_the_likeliest(path), True
            looked, self._looked = None if path[-1].causes else self._looked, None
            steps += looked is None and not self._is_repeated  # what was looked at before is paid for
            self._is_repeated = False
            found, pairs = looked or self._next(path, beam)
            path[-1] = explorer.beside_noise_of(found[:1], path[-1])
            better = [h for h in found if h.total < path[-1].total]
            alone = self._without_observer(pairs)
            if alone:
                return self._steps(path, alone), False
            if not better or explorer.is_chance(path[-1], better[0]):
                break
            best = explorer.improved(better[0])
            alone = self._without_observer()
            if alone:
                return self._steps(path, alone), False
            if not best.causes:
                return [best], False
            path = self._steps(path, best)
            self._has_ended = self._is_overtaken(best)
            if self._has_ended:
                break
            further = [h for h in better[1:] if len(h.causes) < self.effort.causes]
            beam = chosen_for_extension(families([best, *further]), self.effort.beam)
        return path, False

    def _beam(self, path: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return what is extended first, of a path."""
        return [path[-1] if path[-1].causes or self.begins is None else self.begins]

    def _next(
        self, path: Sequence[Hypothesis], beam: Sequence[Hypothesis]
    ) -> tuple[list[Hypothesis], list[Hypothesis]]:
        """Return what one more cause makes of the `beam`, the best first, and, of the first cause, pairs."""
        found, pairs = self.explorer.extended(beam, len(path[-1].causes)), []
        if found and not path[-1].causes and found[0].total < path[-1].total:
            # what a contact that is too stiff leaves would be taken for a second cause
            found = sorted([self.explorer.freed(found[0]), *found[1:]], key=by_total)
        hidden = self.trials.likelihood.simulates  # where no model is the axis, two effects may hide each other
        if not path[-1].causes and (found or hidden) and not (found and self.is_enough(found[0])):
            pairs = self._beside_likeliest(path[-1], found)
            is_waiting = self._others_wait(found)
            if not (pairs or is_waiting):
                pairs = self.explorer.paired(beam[0], found[0] if found else beam[0])
            # what leaves something is compared with what single effects come to with a second one
            is_answered = any(self.is_enough(h) for h in pairs)
            if not (hidden or is_answered or is_waiting):
                found = sorted([*found, *self._general(found[:1])], key=by_total)
            if hidden or found[0].total >= path[-1].total or is_answered:
                found = sorted([*found, *pairs], key=by_total)
        return found, pairs

    def _others_wait(self, singles: Sequence[Hypothesis]) -> bool:
        """Tell whether other pairs than that of the likeliest cause, and last resorts, are not looked for yet."""
        may_wait = not (self.explorer.with_last_resorts or (self._goes_on and math.isfinite(self.likely)))
        return may_wait and bool(singles) and singles[0].total > self.likely

    def _general(self, singles: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return a last resort in the place of a cause of the likeliest single or pair, if it leaves nothing.

        Three causes or an observer, which would be tried first, take far more work than these two fits. They take of
        the effort that is kept for fits to their optimum.
        """
        pairs = [h for h in best_of_each(self.explorer.judged) if len(h.causes) == 2]
        likeliest = (*singles, *pairs[:1])
        found = self.explorer.fitted([(plant, like) for like in likeliest for plant in last_resorts(self.trials, like)])
        return [h for h in found if self.is_enough(h)][:1]

    def _beside_likeliest(self, base: Hypothesis, singles: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the likeliest single cause with a second one if that leaves nothing: cheaper than all other pairs.

        Not where no model is the axis, which all leave something.
        """
        explorer, is_likelier = self.explorer, bool(singles) and singles[0].total < base.total
        may_explain = is_likelier and self.effort.causes > 1 and not self.trials.likelihood.simulates
        if not may_explain or explorer.budget.left <= 0.0 or not explorer.has_pairs:
            return []
        second = explorer.extended(singles[:1], 1)[:1]
        return [h for h in second if h.total < singles[0].total and self.is_enough(h)]

    def _without_observer(self, pairs: Sequence[Hypothesis] = ()) -> Hypothesis | None:
        """Return what leaves nothing if nothing shakes the axis, and end with it; None if nothing does.

        Asked once are the likeliest hypotheses, those that are likelier than all that need less of an observer, and the
        likeliest of the `pairs`: among what an observer helps the true one need not be the first.
        """
        likeliest = best_of_each([h for h in self.explorer.judged if h.causes])
        least = np.minimum.accumulate([np.inf, *(h.noise.rate for h in likeliest)])
        front = [h for h, before in zip(likeliest, least, strict=False) if h.noise.rate < before]
        asked = distinct([*likeliest[: self.effort.judged], *front[: self.effort.judged], *pairs[:1]])
        observed = [h for h in asked if h.noise.rate > 0.0 and frozenset(h.causes) not in self._asked]
        self._asked |= {frozenset(h.causes) for h in observed}
        alone = (self.unobserved(h, self.explorer.budget.allowance(1 + len(observed))) for h in observed)
        found = next((h for h in alone if h), None)
        self._has_ended = found is not None
        return found

    def _is_overtaken(self, best: Hypothesis) -> bool:
        """Tell whether the search ends with `best`: beside other noise it is likelier than any last resort is here."""
        explorer = self.explorer
        other = None if self.is_enough(best) else self.ends(best, explorer.budget.allowance(1))
        if other is None:
            return False
        resorts = explorer.fitted([(plant, best) for plant in last_resorts(self.trials, best)])
        return not resorts or resorts[0].total >= other.total

    def _to_the_likeliest(self, path: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return `path` as it leads to the likeliest of all that was fitted."""
        explorer = self.explorer
        best = min([path[-1], *explorer.judged], key=by_total)
        if best is path[-1] or explorer.is_chance(path[-1], best):
            return [*path]
        best = explorer.freed(explorer.reduced(best))
        return self._steps(path, best) if best.causes else [best]

    def _steps(self, path: Sequence[Hypothesis], best: Hypothesis) -> list[Hypothesis]:
        """Return `path` as it leads to `best`, with what was found on the way where that adds several causes."""
        before, explorer = [h for h in path if len(h.causes) < len(best.causes)], self.explorer
        known = (*explorer.judged, *explorer.singles)
        steps = [h for h in known if set(before[-1].causes) < set(h.causes) < set(best.causes)]
        return [*before, *sorted(steps, key=by_total)[:1], best]
