"""Which effects the model lacks: one pass through the catalogue per added effect, then each is taken out again.

What decides is −2 log-likelihood beside each hypothesis' own noise model, plus the price of its effects; see
:meth:`servolens.diagnosis.trials.Trials.price`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from servolens.diagnosis.explorer import INDISTINCT, SPENT, Explorer
from servolens.diagnosis.ordering import beside_shaking, best_of_each, by_total, is_last_resort
from servolens.errors import NumericalError
from servolens.identification.rounding import dominates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.effort import Effort
    from servolens.diagnosis.trials import Trials
    from servolens.identification.hypothesis import Hypothesis

__all__ = ["Search", "improved_path", "search"]

SIMPLE = 0.75
"""Of the effort, what the search without last resorts may take. Chosen on axes of the laboratory."""
UNSHAKEN, LIKELIER = 0.4, 0.7
"""Of the effort, what a search that takes the axis for one that nothing shakes may take, and what if it has found
something likelier than that the axis is shaken. Chosen likewise."""


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


def search(
    trials: Trials,
    base: Hypothesis,
    effort: Effort,
    tell: Callable[[str, float], None] = lambda _, __: None,
    known: Sequence[Hypothesis] = (),
    is_enough: Callable[[Hypothesis], bool] = lambda _: False,
    begun: Sequence[Hypothesis] = (),
) -> Search:
    """Return the least set of effects that explains the training records, and what else was tried.

    An axis that seems to be shaken is first taken for one that nothing shakes: an observer follows what causes do
    before all are found, and so hides that together they leave nothing. If what is found then is likelier than gain and
    damping on a shaken axis, and leaves white noise that does not depend on the inputs, it is the answer. That search
    ends as soon as, beside the causes found so far and shaking, nothing that is left depends on the inputs, unless a
    last resort in their place is likelier. Where it ends a second one begins, and the likelier of both is returned.

    Parameters
    ----------
    trials : Trials
        The records.
    base : Hypothesis
        Gain and damping alone.
    effort : Effort
        How far to go.
    tell : callable
        Is told what is done and the share of the whole search that is.
    known : sequence of Hypothesis
        Others that were fitted to these records before.
    is_enough : callable
        Tells whether a hypothesis leaves nothing that depends on the inputs; else effects that are a last resort are
        tried as well.
    begun : sequence of Hypothesis
        What an earlier search has found, if any: this one begins there, and none without shaking is made before it.
    """
    if begun:
        return _searched(trials, base, effort, tell, known, is_enough, begun, _Budget(goes_on=True))
    is_one = base.noise.rate == 0.0 or trials.likelihood.simulates
    if is_one or effort.work <= 0.0:  # gain and damping alone would have to be fitted again
        return _searched(trials, base, effort, tell, known, is_enough)
    unshaken, beside, is_coarse = trials.unshaken(), [*known], dominates(trials.likelihood.white)

    def shaken_likewise(found: Hypothesis, work: float) -> Hypothesis | None:
        shaken = trials.shaken().likelihood
        fits = (shaken.judged(found.plant, like, allowance=0.5 * work) for like in beside_shaking([found], base.noise))
        telling = (h for h in fits if h and h.noise.rate > 0.0 and h.total < found.total and is_enough(h))
        other = next(telling, None)
        unshaken.likelihood.count(shaken.work)
        beside.extend([other] if other else [])
        return other

    try:
        told = _part(tell, 0.0, UNSHAKEN)
        # what an encoder's coarse steps do not show moving is rather a cause that is missing
        share = LIKELIER if is_coarse else UNSHAKEN
        budget = _Budget(share, LIKELIER, base.total, shaken_likewise)
        first = _searched(unshaken, unshaken.base(), effort, told, known, is_enough, budget=budget)
    except NumericalError:
        return _searched(trials, base, effort, tell, known, is_enough)
    finally:
        trials.likelihood.count(unshaken.likelihood.work)
    # white noise leaves nothing that an observer could follow; what is left of coarse steps is their rounding
    is_white = first.chosen.noise.order == 0 or is_coarse
    if first.chosen.total < base.total and is_white and is_enough(first.chosen):
        return first
    telling = [h for h in first.judged if h.causes and not is_last_resort(h)]
    further = (*beside[len(known) :], *first.path[1:], *telling[: effort.judged], *first.singles[: effort.judged])
    begun = [h for h in further if not is_last_resort(h)]
    left = replace(effort, work=max(effort.work - unshaken.likelihood.work, 0.0))
    shaken = trials.shaken()
    second = _searched(shaken, base, left, _part(tell, UNSHAKEN, 1.0), beside, is_enough, begun)
    trials.likelihood.count(shaken.likelihood.work)
    second = _without_observer(trials, second, replace(effort, work=SPENT * effort.work), is_enough)
    likelier = min(second, first, key=lambda found: found.chosen.total)
    return replace(likelier, judged=best_of_each((*second.judged, *first.judged)))


def improved_path(
    trials: Trials, found: Search, path: Sequence[Hypothesis], effort: Effort, is_enough: Callable[[Hypothesis], bool]
) -> Search:
    """Return `found` with a `path` that was fitted otherwise, the last of it reduced, exchanged and simplified anew."""
    explorer = Explorer(trials, effort, lambda _, __: None, path, is_enough, 1.0)
    explorer.singles += found.singles
    chosen = explorer.settled(explorer.improved(path[-1]))
    steps = (*(h for h in path if len(h.causes) < len(chosen.causes)), chosen)
    return replace(found, path=steps, judged=best_of_each((*explorer.judged, *found.judged)))


def _without_observer(trials: Trials, found: Search, effort: Effort, is_enough: Callable[[Hypothesis], bool]) -> Search:
    """Return `found` with what it chose fitted as if nothing shook the axis, if that is likelier.

    Then improved anew: an observer follows what a simpler cause leaves while it is not at its optimum.
    """
    chosen = found.chosen
    again = trials.likelihood.judged(chosen.plant, chosen, allowance=effort.work) if chosen.causes else None
    if again is None or again.total >= chosen.total:
        return found
    return improved_path(trials, found, (*found.path[:-1], again), effort, is_enough)


@final
@dataclass(frozen=True, slots=True)
class _Budget:
    """Shares of the effort: what a search may take; and what, if it has found a total less than the `promising` one.

    The search `ends` at once with a hypothesis if what that function makes of it, given the work it may do, is likelier
    than its last resorts. It `goes_on` from where it begins even if that leaves something which depends on the inputs.
    """

    share: float = 1.0
    longer: float = 1.0
    promising: float = -math.inf
    ends: Callable[[Hypothesis, float], Hypothesis | None] = lambda _found, _work: None
    goes_on: bool = False


def _part(tell: Callable[[str, float], None], low: float, high: float) -> Callable[[str, float], None]:
    """Return what is told of a search that is the part from `low` to `high` of the whole."""
    return lambda what, share: tell(what, low + (high - low) * share)


def _searched(
    trials: Trials,
    base: Hypothesis,
    effort: Effort,
    tell: Callable[[str, float], None],
    known: Sequence[Hypothesis],
    is_enough: Callable[[Hypothesis], bool],
    begun: Sequence[Hypothesis] = (),
    budget: _Budget | None = None,
) -> Search:
    """Return what is found beside noise of one kind within a `budget`, by default all of the effort.

    What was found beside another, `begun`, is where it begins.
    """
    budget = budget or _Budget()
    explorer = Explorer(trials, effort, tell, known, is_enough, budget.share, budget.ends)
    reached = explorer.path_to_the_best(base, begun)
    first = reached if budget.goes_on or is_enough(reached[-1]) else [base]
    path, early = explorer.walked(first, SIMPLE * budget.share * effort.work)
    if explorer.has_ended:
        return _as_search(explorer, path)
    if is_enough(path[-1]):
        early = False
    else:
        explorer.with_last_resorts = True
        further, early = explorer.walked([base], budget.share * effort.work)
        if explorer.has_ended:
            return _as_search(explorer, further)
        path = min(path, further, reached, key=lambda steps: steps[-1].total)
        is_promising = path[-1].total < budget.promising and not is_enough(path[-1])
        if early and is_promising and explorer.has_more(budget.longer * effort.work):
            explorer.grant(budget.longer)
            path, early = explorer.walked(path, budget.longer * effort.work)
    chosen = explorer.settled(path[-1])
    return _as_search(explorer, [*(h for h in path if len(h.causes) < len(chosen.causes)), chosen], ended_early=early)


def _as_search(explorer: Explorer, path: Sequence[Hypothesis], *, ended_early: bool = False) -> Search:
    singles = tuple(sorted(explorer.singles, key=by_total))
    return Search(tuple(path), best_of_each(explorer.judged), singles, ended_early=ended_early)
