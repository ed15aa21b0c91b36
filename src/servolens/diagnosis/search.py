"""Which effects the model lacks: one pass through the catalogue per added effect, then each is taken out again.

What decides is −2 log-likelihood beside each hypothesis' own noise model, plus the price of its effects; see
:meth:`servolens.diagnosis.trials.Trials.price`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

from servolens.diagnosis.effort import SPENT
from servolens.diagnosis.explorer import Explorer
from servolens.diagnosis.ordering import beside_shaking, best_of_each, by_total, is_last_resort
from servolens.diagnosis.walk import Search, Walk
from servolens.errors import NumericalError
from servolens.identification.rounding import dominates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.effort import Effort
    from servolens.diagnosis.trials import Trials
    from servolens.identification.hypothesis import Hypothesis

    Tell = Callable[[str, float], None]
    Enough = Callable[[Hypothesis], bool]

__all__ = ["Search", "improved_path", "search"]

UNSHAKEN, LIKELIER = 0.4, 0.7
"""Of the effort, what a search that takes the axis for one that nothing shakes may take, and what if it has found
something likelier than that the axis is shaken. Chosen on axes of the laboratory."""


def search(
    trials: Trials,
    base: Hypothesis,
    effort: Effort,
    tell: Tell = lambda _, __: None,
    known: Sequence[Hypothesis] = (),
    is_enough: Enough = lambda _: False,
    begun: Sequence[Hypothesis] = (),
    is_answer: Enough | None = None,
) -> Search:
    """Return the least set of effects that explains the training records, and what else was tried.

    An axis that seems to be shaken is looked at in two ways: as if nothing shook it, where a single cause is not
    blurred, but one that lacks another is far off; and beside an observer, which follows what causes do before all are
    found, and so shows each of them by itself, but may hide that together they leave nothing. Each looks for a first
    cause. If what the search beside an observer has found is likelier, it goes on first, and what it finds is the
    answer if that needs no observer. If there is none yet, the search without one goes on, and then the other with what
    that has found, until it leaves nothing that depends on the inputs. Of what leaves something the likelier is
    returned.

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
    is_answer : callable, optional
        Tells whether a hypothesis leaves nothing but the noise that it claims: of an axis that seems shaken, what is
        taken for one that nothing shakes must not leave bursts. By default `is_enough`.
    """
    is_one = base.noise.rate == 0.0 or trials.likelihood.simulates
    if begun or is_one or effort.work <= 0.0:  # gain and damping alone would have to be fitted again
        return Walk(trials, base, effort, tell, is_enough, known).whole(begun, goes_on=bool(begun))
    is_answer = is_enough if is_answer is None else is_answer
    observing = _observing(trials, base, effort, tell, known, is_enough, is_answer)
    alone = _alone(trials, base, effort, tell, is_enough, observing)
    observed: Search | None = None
    unshaken: Search | None = None
    try:
        unshaken = alone and alone.first((0.0, 0.25))
        if unshaken and _is_unshaken(trials, base, unshaken, is_answer, SPENT * effort.work):
            return _after(trials, base, unshaken)
        observed = observing.first((0.25, 0.5))
        ahead: Search | None = None
        if observed is None and alone and _leads(observing, alone):
            left = 1.0 - (observing.work + alone.work) / effort.work
            ahead = observing.whole(part=(0.5, 0.7), share=max(left, SPENT))
            observed = ahead if ahead.chosen.noise.rate == 0.0 and is_answer(ahead.chosen) else None
        if observed is None and alone:
            unshaken = unshaken or alone.whole(part=(0.7, 0.85), longer=LIKELIER, promising=base.total)
            if _is_unshaken(trials, base, unshaken, is_answer, SPENT * effort.work):
                return _after(trials, base, unshaken)
        if observed is None:
            left = 1.0 - (observing.work + (alone.work if alone else 0)) / effort.work
            begun = _telling(unshaken, effort, is_overtaken=alone.has_ended) if alone and unshaken else ()
            # where the other has spent it all, too
            observed = observing.whole(begun, part=(0.85, 1.0), share=max(left, SPENT))
            observed = min(observed, ahead or observed, key=lambda found: found.chosen.total)
    finally:
        trials.likelihood.tally.add(observing.work + (alone.work if alone else 0))
    is_improved = observed.chosen.noise.rate == 0.0 and not (observing.has_ended or observed.ended_early)
    if not (is_improved or (observing.has_asked(observed.chosen) and is_enough(observed.chosen))):
        observed = _without_observer(trials, observed, effort, is_enough)
    if not unshaken:
        return observed
    likelier = min(observed, _after(trials, base, unshaken), key=lambda found: found.chosen.total)
    return replace(likelier, judged=best_of_each((*observed.judged, *unshaken.judged)))


def _leads(observing: Walk, alone: Walk) -> bool:
    """Tell whether the search that is `observing` has found causes that are likelier than all of the other one."""
    found = observing.likeliest
    return bool(found.causes) and found.total < alone.likeliest.total


def _after(trials: Trials, base: Hypothesis, found: Search) -> Search:
    """Return `found` with `base`, as found beside an observer, as its first step if gain and damping alone ran away."""
    is_base = trials.shows_time_constant(found.path[0].plant) or len(found.path) == 1
    return found if is_base else replace(found, path=(base, *found.path[1:]))


def _telling(found: Search, effort: Effort, *, is_overtaken: bool) -> list[Hypothesis]:
    """Return what was found as if nothing shook the axis, where a search beside an observer begins.

    Where that `is_overtaken`, shaking explains what the last of it leaves: nothing has more causes.
    """
    judged = [h for h in found.judged if h.causes and not is_last_resort(h)]
    further = (*found.path[1:], *judged[: effort.judged], *found.singles[: effort.judged])
    most = len(found.chosen.causes) if is_overtaken else effort.causes
    return [h for h in further if not is_last_resort(h) and len(h.causes) <= most]


def _is_unshaken(trials: Trials, base: Hypothesis, found: Search, is_answer: Enough, work: float) -> bool:
    """Tell whether what was found as if nothing shook the axis is the answer: likelier than that something does.

    Whether it shakes gain and damping alone, or the axis with the same causes or some of them, which may simulate so
    much `work`: a cause may take up what shaking does. White noise leaves nothing that an observer could follow; what
    is left of coarse steps is their rounding.
    """
    chosen = found.chosen
    if not (chosen.total < base.total and is_answer(chosen)):
        return False
    if chosen.noise.order == 0 or dominates(trials.likelihood.white):
        return True
    shaken = trials.shaken().likelihood
    steps = [h for h in reversed(found.path) if h.causes and set(h.causes) <= set(chosen.causes)]
    beside = [like for like in beside_shaking(steps, base.noise) if like.noise.rate > 0.0]
    fits = (shaken.judged(like.plant, like, allowance=work / len(beside)) for like in beside)
    is_likelier = any(h and h.noise.rate > 0.0 and h.total < chosen.total for h in fits)
    trials.likelihood.tally.add(shaken.work)
    return not is_likelier


def _observing(
    trials: Trials,
    base: Hypothesis,
    effort: Effort,
    tell: Tell,
    known: Sequence[Hypothesis],
    is_enough: Enough,
    is_answer: Enough,
) -> Walk:
    """Return the search beside an observer; it ends with what leaves nothing without one, and is likelier so."""
    shaken = trials.shaken()

    def unobserved(found: Hypothesis, work: float) -> Hypothesis | None:
        alone = trials.unshaken().likelihood
        again = alone.judged(found.plant, replace(found, noise=alone.white), allowance=work)
        if again is None or again.total >= found.total or not is_answer(again):
            shaken.likelihood.tally.add(alone.work)
            return None
        # the records may begin elsewhere than where an observer, which soon forgets that, has them begin
        other = alone.judged(again.plant, replace(again, noise=alone.white, starts=()), allowance=work)
        shaken.likelihood.tally.add(alone.work)
        return other if other and other.total < again.total and is_answer(other) else again

    return Walk(shaken, base, effort, tell, is_enough, known, unobserved=unobserved, likely=-math.inf)


def _alone(
    trials: Trials, base: Hypothesis, effort: Effort, tell: Tell, is_enough: Enough, observing: Walk
) -> Walk | None:
    """Return the search that takes the axis for one that nothing shakes; None where gain and damping have no fit.

    It ends as soon as, beside the causes found so far and shaking, nothing that is left depends on the inputs, as the
    search that is `observing` may have found, unless a last resort in their place is likelier.
    """
    unshaken = trials.unshaken()

    def shaken_likewise(found: Hypothesis, work: float) -> Hypothesis | None:
        shaken, observed = trials.shaken().likelihood, observing.explorer.judged
        known = sorted((h for h in observed if set(h.causes) == set(found.causes)), key=by_total)
        fits = (shaken.judged(found.plant, like, allowance=0.5 * work) for like in beside_shaking([found], base.noise))
        telling = (h for h in chain(known, fits) if h and h.noise.rate > 0.0 and h.total < found.total and is_enough(h))
        other = next(telling, None)
        unshaken.likelihood.tally.add(shaken.work)
        return other

    try:
        begun = unshaken.base()
    except NumericalError:
        return None
    # what an encoder's coarse steps do not show moving is rather a cause that is missing
    share = LIKELIER if dominates(trials.likelihood.white) else UNSHAKEN
    begins = unshaken.observed(begun)
    return Walk(unshaken, begun, effort, tell, is_enough, (), share, begins, shaken_likewise, likely=base.total)


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
    chosen, effort = found.chosen, replace(effort, work=SPENT * effort.work)
    if chosen.noise.rate == 0.0:
        return improved_path(trials, found, found.path, effort, is_enough)
    again = trials.likelihood.judged(chosen.plant, chosen, allowance=effort.work) if chosen.causes else None
    if again is None or again.total >= chosen.total:
        return found
    return improved_path(trials, found, (*found.path[:-1], again), effort, is_enough)
