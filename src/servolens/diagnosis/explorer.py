"""How a search goes on: one pass through the catalogue for each added effect, then each is taken out again."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.effort import SPENT, Budget, work_for
from servolens.diagnosis.ordering import (
    INDISTINCT,
    best_of_each,
    by_total,
    delays,
    distinct,
    families,
    is_last_resort,
    otherwise,
    parted,
    simplified,
    specialised,
    united,
    with_lag_for_damping,
    without,
)
from servolens.diagnosis.pairs import likeliest_pairs
from servolens.diagnosis.replacements import as_good_alone, kin, last_resorts, promising
from servolens.diagnosis.trials import special_first, starts_to_fit
from servolens.effects import Drive, DryFriction, Transmission, catalogue, effect_class
from servolens.errors import InputError
from servolens.identification.hypothesis import NO_BETTER
from servolens.identification.likelihood import FEW, FULL, SOME
from servolens.identification.lowest import lowest
from servolens.identification.phases import own_phases
from servolens.identification.refine import AT_NOISE
from servolens.identification.rounding import dominates, is_rounded
from servolens.identification.score import ScoreTest
from servolens.processors import in_processes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.effort import Effort
    from servolens.diagnosis.trials import Start, Trials
    from servolens.effects import Effect
    from servolens.identification.hypothesis import Hypothesis
    from servolens.plant import Plant

__all__ = ["Explorer"]

ORDINALS = ("first", "second", "third", "fourth", "fifth")
PROMISING = 0.5
"""Share of an effect's price that its score must reach for a fit: sizes and shapes are not at their best yet. Beside
causes that leave nothing that depends on the inputs, all of it."""
FAR_BEHIND = 0.05
"""Share of the highest score below which an effect is not fitted."""
FEW_PARAMETERS, LATE = 2, (0.25, 1.0)
"""Most parameters of an effect that is tried beside a delay; delays from which the fit starts, in radians at the loop's
rate: up to what a well-damped loop has in hand."""


@final
class Explorer:
    """Fits hypotheses and remembers them."""

    def __init__(
        self,
        trials: Trials,
        effort: Effort,
        tell: Callable[[str, float], None],
        known: Sequence[Hypothesis],
        is_enough: Callable[[Hypothesis], bool],
        share: float,
    ) -> None:
        self.trials, self.effort, self.tell, self.is_enough = trials, effort, tell, is_enough
        self.likelihood = trials.likelihood
        self.budget = Budget(self.likelihood.tally, effort.work, share)
        self.judged: list[Hypothesis] = [*known]
        self.singles: list[Hypothesis] = []
        self.with_last_resorts = False
        self._scored: tuple[ScoreTest, list[list[Start]]] | None = None
        self._seen: set[tuple[frozenset[str], bool]] = set()
        self._freed_in_vain: set[tuple[frozenset[str], float, int, float]] = set()
        self._lowered: set[frozenset[str]] = set()
        self._exchanged: set[tuple[frozenset[str], frozenset[str]]] = set()
        self._simpler: dict[tuple[frozenset[str], float, int], tuple[float, Hypothesis]] = {}

    def grant(self, share: float) -> None:
        """Let the search take this share of the effort."""
        self.budget.share = share
        self._freed_in_vain.clear()  # with more effort it may be worth while
        self._exchanged.clear()

    @property
    def has_pairs(self) -> bool:
        """Whether pairs may still be looked for."""
        return self._scored is not None

    def extended(self, beam: Sequence[Hypothesis], number: int) -> list[Hypothesis]:
        """Return the best extensions of the hypotheses in `beam` by one effect, the best first."""
        noise = beam[0].noise
        if noise.rate == 0.0 and not noise.is_model_error and not self.likelihood.simulates:
            # what leaves no more than sensor noise is no impostor, unless what has no more parameters reaches as far
            best, *others = beam
            is_answer = self.is_enough(best) and not is_last_resort(best)
            beam = [best, *(h for h in others if h.plant.unusual + 1 <= best.plant.unusual and not is_answer)]
        members = sorted(beam, key=lambda h: (is_last_resort(h), noise.is_model_error and bool(own_phases(h.plant))))
        found: list[Hypothesis] = []
        first: list[Hypothesis] = []
        for place, hypothesis in enumerate(members):
            extensions = self._fitted(hypothesis, (number + place / len(members)) / self.effort.causes)
            first += sorted(extensions, key=by_total)[:1]
            found += extensions
            leaves_less = noise.is_model_error and any(not h.noise.is_model_error for h in first)
            if leaves_less and self._leaves_nothing(first, beam[0]):
                break
        found.sort(key=by_total)
        if number == 0:
            self.singles += distinct(found)
        may_be_general = self.with_last_resorts
        known = [h for h in self.judged if len(h.causes) == number + 1 and (may_be_general or not is_last_resort(h))]
        jobs = distinct([*found[: self.effort.judged], *first])
        fitted = self.fitted([(h.plant, h) for h in jobs])
        reached = {frozenset(h.causes) for h in fitted}
        kept = [h for h in jobs if frozenset(h.causes) not in reached]  # where no effort was left to go on
        self.judged += kept
        return sorted([*known, *fitted, *kept], key=by_total)

    def paired(self, base: Hypothesis, best: Hypothesis) -> list[Hypothesis]:
        """Return the likeliest pairs of effects, fitted, that are likelier than `best` after a few iterations.

        Pairs that the integral equation proposes, and what friction hides, are kept only if noise explains what they
        then leave, those whose scores are highest together always. Where no model is the axis, a search by simulations,
        all of the former are kept, and effects are paired with a delay. Only once in a search.
        """
        (test, scored), self._scored = self._scored or (None, []), None
        if test is None:
            return []
        begun = self._followed(self.trials.pairs(self.effort.fitted), base, 0)[: self.effort.fitted]
        followed, scores = self._followed([h.plant for h in begun], base, FEW), []
        if not self.likelihood.simulates:
            followed += self._hidden(base, (Drive, Transmission))
            scores = likeliest_pairs(test, scored, self.effort.judged, self.likelihood.price)
        proposed = [h for h in followed if not h.noise.is_model_error]
        likelier = best_of_each([h for h in (*proposed, *self._followed(scores, base, FEW)) if h.total < best.total])
        found = self.fitted([(h.plant, h) for h in likelier[: self.effort.judged]])
        return sorted([*found, *self._delayed()], key=by_total) if self.likelihood.simulates else found

    def _hidden(self, base: Hypothesis, kinds: tuple[type[Effect], ...]) -> list[Hypothesis]:
        """Return Coulomb friction with each effect of these `kinds`, a few iterations from the integral equation."""
        found: list[Hypothesis] = []
        for cls, starts in self.trials.hidden_beside_friction(base.plant).items():
            if issubclass(cls, kinds):
                # a transmission takes long; of a drive, the start says little about the end
                most = self.effort.judged if issubclass(cls, Transmission) else self.effort.fitted
                begun = self._followed(starts, base, 0)[:most]
                found += self._followed([h.plant for h in begun], base, FEW)
        return found

    def _together(self, hypothesis: Hypothesis) -> list[Plant]:
        """Return where friction and what it hides lead from the integral equation, if pairs were not looked for.

        Found one after the other they may be at a lower minimum elsewhere.
        """
        effects = hypothesis.plant.effects
        hidden = tuple(type(effect) for effect in effects if isinstance(effect, Drive | Transmission))
        rubs = any(isinstance(effect, DryFriction) for effect in effects)
        if self._scored is None or len(effects) != 2 or not (rubs and hidden):
            return []
        found = self._hidden(self._scored[0].hypothesis, hidden)
        return [h.plant for h in sorted(found, key=by_total)[:1]]

    def _followed(self, plants: Sequence[Plant], base: Hypothesis, iterations: int) -> list[Hypothesis]:
        """Return where a few iterations beside the noise of `base` lead, the best first."""
        found = self.budget.shared_among(
            lambda plant, share: self.likelihood.tried(plant, base.noise, iterations, like=base, allowance=share),
            plants,
            lambda plant: work_for(self.likelihood, plant, iterations),
        )
        return sorted((h for h in found if h), key=by_total)

    def _delayed(self) -> list[Hypothesis]:
        """Return the best single effects, each beside a delay and beside a lag, fitted, where that is likelier.

        In a loop one hides the other: friction damps and a delay does the contrary, so that neither is large by itself,
        and the score of one says nothing of how large it is beside the other. Not so effects with many parameters,
        which take up what a delay does, and transmissions and sensors, which delay by themselves.
        """
        alone = best_of_each([h for h in (*self.singles, *self.judged) if len(h.causes) == 1])
        few = [h for h in alone if h.plant.unusual - 2 <= FEW_PARAMETERS and not h.plant.is_late]
        singles = families(few)[: self.effort.judged]
        jobs = []
        for like, late in product(singles, LATE):
            for effect in delays(late / self.likelihood.rate):
                with suppress(InputError):  # two that do not go together
                    plant = like.plant.with_effect(effect)
                    jobs += [(plant, like)] if len(plant.effects) > len(like.plant.effects) else []
        share = self.budget.allowance(len(jobs))
        begun = in_processes(
            lambda job: self.likelihood.tried(
                job[0], job[1].noise, FEW, like=job[1], unpowered=job[1].unpowered, allowance=share
            ),
            jobs,
            self.likelihood.tally,
        )
        found = self.fitted([(h.plant, h) for h in best_of_each([h for h in begun if h])])
        found += self.fitted([(plant, h) for h in found for plant in with_lag_for_damping(h.plant)])
        likelier = (h for h in found if h.total < min(s.total for s in singles if s.causes[0] in h.causes))
        return sorted(likelier, key=by_total)

    def beside_noise_of(self, others: Sequence[Hypothesis], hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` beside the noise of another, if that is likelier: no effect is found for its noise."""
        own = [h for h in others if h.noise.rate > 0.0 and h.total < hypothesis.total]
        return min([hypothesis, *self.fitted([(hypothesis.plant, h) for h in own])], key=by_total)

    def _leaves_nothing(self, found: Sequence[Hypothesis], before: Hypothesis) -> bool:
        """Tell whether the best of `found` is likelier than the hypothesis `before`, and leaves nothing but noise."""
        best = self.fitted([(h.plant, h) for h in found])[:1]
        return any(h.total < before.total and h.noise.rate == 0.0 and self.is_enough(h) for h in best)

    def _plain(self, found: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return those of `found`, at their optimum, that leave white noise alone: what is likelier is so by chance."""
        likely = [h for h in found if h.noise.rate == 0.0 and not (h.noise.is_model_error or is_last_resort(h))]
        return [h for h in self.fitted([(h.plant, h) for h in likely]) if self._is_plain(h)]

    def is_chance(self, simpler: Hypothesis, richer: Hypothesis) -> bool:
        """Tell whether rounding alone may make the `richer` hypothesis as much likelier.

        Beside the noise of the richer: that of the simpler one holds what it lacks. Rounding is no matter where the
        simpler one misses more than noise and rounding can.
        """
        is_close = simpler.noise.spread <= AT_NOISE * self.likelihood.white.spread
        is_white = not dominates(richer.noise) and not is_rounded(richer.noise)
        if not is_close or is_white or self.likelihood.simulates:
            return False
        paid = (richer.total - richer.misfit) - (simpler.total - simpler.misfit)
        return ScoreTest(self.likelihood, replace(simpler, noise=richer.noise)).may_be_chance(richer.plant, paid)

    def _fitted(self, hypothesis: Hypothesis, done: float) -> list[Hypothesis]:
        """Return `hypothesis` with each effect that its score test finds promising."""
        trials, cause = self.trials, f"a {ORDINALS[len(hypothesis.causes)]} cause"
        test = ScoreTest(self.likelihood, hypothesis)
        self.tell(f"Looking for {cause}", done)
        is_observed = hypothesis.noise.rate > 0.0
        is_enough = bool(hypothesis.causes) and self.is_enough(hypothesis)
        kin = set() if is_observed else set(hypothesis.causes)
        asked = [
            name
            for name, cls in catalogue().items()
            if self.with_last_resorts or not cls.is_last_resort or kin & set(cls.generalises)
        ]
        names = [n for n in asked if (frozenset((*hypothesis.causes, n)), is_observed) not in self._seen]
        self._seen |= {(frozenset((*hypothesis.causes, name)), is_observed) for name in names}
        scored = trials.starts_of_each(test, names)
        if names and not hypothesis.causes and not self.with_last_resorts:
            self._scored = test, scored
        share = 1.0 if is_enough else PROMISING
        scored = [s for s in scored if s[0].gain > share * trials.price(effect_class(s[0].effect))]
        if scored:
            scored = [s for s in scored if s[0].gain > FAR_BEHIND * scored[0][0].gain]
        chosen = scored[: self.effort.fitted]
        chosen += [starts for starts in scored[len(chosen) :] if issubclass(effect_class(starts[0].effect), Drive)]
        share = 0.45 / self.effort.causes / self.effort.beam / max(len(chosen), 1)

        def told(count: int, before: int = 0) -> None:
            count += before
            what = f"Trying {cause}: {count} of {len(chosen)} effects"
            self.tell(what if count <= len(chosen) else f"Choosing {cause} among the best", done + count * share)

        found, is_answered = self._begun(chosen, hypothesis, told)
        if is_answered or is_observed:
            return found
        drives = [h for h in found[self.effort.judged + 2 :] if isinstance(h.plant.effects[-1], Drive)]
        close = [*found[: self.effort.judged + 2], *drives]
        further = self.budget.shared_among(
            self._simulated,
            close,
            lambda h: work_for(self.likelihood, h.plant, SOME * h.plant.effects[-1].unusual),
            lambda done: told(len(chosen) + done),
        )
        further = [h if h and self.likelihood.is_admissible(h.plant) else None for h in further]
        better = [a if b is None or a.total <= b.total else b for a, b in zip(close, further, strict=True)]
        return [*better, *(h for h in found if h not in close)]

    def _begun(
        self, chosen: Sequence[list[Start]], hypothesis: Hypothesis, told: Callable[..., None]
    ) -> tuple[list[Hypothesis], bool]:
        """Return effects beside `hypothesis` after a few iterations, and whether one leaves white noise alone."""
        found: list[Hypothesis] = []
        for before, some in special_first(chosen):
            begun = self.budget.shared_among(
                lambda starts, share: self.trials.begun(starts, hypothesis, share),
                [starts_to_fit(starts) for starts in some],
                lambda starts: sum(work_for(self.likelihood, start.plant, FEW) for start in starts),
                partial(told, before=before),
            )
            known, admitted = found[:1], (h for h in begun if h and self.likelihood.is_admissible(h.plant))
            found = sorted([*found, *admitted], key=by_total)
            if answer := self._plain([h for h in found[:1] if h not in known]):
                return [*answer, *found[1:]], True
        return found, False

    def _simulated(self, hypothesis: Hypothesis, allowance: float) -> Hypothesis | None:
        """Return where `hypothesis` leads beside white noise: coloured noise hides what is slow."""
        return self.likelihood.tried(
            hypothesis.plant,
            self.likelihood.white,
            SOME * hypothesis.plant.effects[-1].unusual,
            like=hypothesis,
            unpowered=hypothesis.unpowered,
            allowance=allowance,
        )

    def improved(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` reduced, exchanged and freed, until none finds more."""
        while True:
            best = self.freed(self.exchanged(self.reduced(hypothesis)))
            if best.total >= hypothesis.total - NO_BETTER:
                return min(best, hypothesis, key=by_total)
            hypothesis = best

    def reduced(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` without the effects that do not pay for themselves.

        Beside its own noise: what was likelier for that alone names no cause.
        """
        while hypothesis.causes:
            simpler = self._without_one(hypothesis)
            if not simpler or simpler[0].total >= hypothesis.total:
                return hypothesis
            hypothesis = simpler[0]
        return hypothesis

    def _without_one(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """Return `hypothesis` without each of its effects in turn, the best first.

        What was fitted beside a noise like this, beginning from something as likely, is not fitted again.
        """
        noise = hypothesis.noise
        plants = [without(hypothesis.plant, name) for name in hypothesis.causes]
        keys = [(frozenset(e.name for e in plant.effects), noise.rate, noise.order) for plant in plants]
        least = hypothesis.total + NO_BETTER
        new = [p for key, p in zip(keys, plants, strict=True) if self._simpler.get(key, (np.inf,))[0] > least]
        for found in self.fitted([(plant, hypothesis) for plant in new]):
            self._simpler[frozenset(found.causes), noise.rate, noise.order] = hypothesis.total, found
        return sorted((self._simpler[key][1] for key in keys if key in self._simpler), key=by_total)

    def exchanged(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` or the best with a cause replaced: by one that did as well alone, by kin, twin or parts.

        What cannot be told apart while another cause is missing often can beside it. So can a lag and damping, which
        are the same exchanged for each other where nothing nonlinear stands between them. What ended less likely from
        elsewhere is begun once more from here.
        """
        own = frozenset(hypothesis.causes)
        reached = {frozenset(h.causes): h.total for h in sorted(self.judged, key=by_total, reverse=True)}
        plants = [*parted(hypothesis.plant)] if len(hypothesis.causes) < self.effort.causes else []
        plants += otherwise(hypothesis.plant)
        if len(hypothesis.causes) > 1:
            plants += as_good_alone(self.likelihood, hypothesis, self.singles)
            plants += kin(self.trials, hypothesis)
        others = {
            causes: plant
            for plant in plants
            if reached.get(causes := frozenset(effect.name for effect in plant.effects), np.inf) > hypothesis.total
            and (own, causes) not in self._exchanged
        }
        self._exchanged |= {(own, causes) for causes in others}
        jobs = [*others.values(), *with_lag_for_damping(hypothesis.plant)]
        return min([hypothesis, *self.fitted([(plant, hypothesis) for plant in jobs])], key=by_total)

    def freed(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` or, beside other than white noise, the best with parameters off their usual values.

        Tried are those of a promising score: what a contact of the usual stiffness leaves is followed by an observer or
        taken up by slow noise. What gets likelier goes on; what did not is not tried again.
        """
        hypothesis = hypothesis if self._is_plain(hypothesis) else self._lowest(hypothesis)
        plants, noise = [*hypothesis.plant.freed()], hypothesis.noise
        if not plants or self._is_plain(hypothesis):
            return hypothesis
        key = frozenset(hypothesis.causes), noise.rate, noise.order, hypothesis.total
        if key in self._freed_in_vain:
            return hypothesis
        further = self.fitted([(p, hypothesis) for p in promising(self.likelihood, hypothesis, plants, PROMISING)])
        if not further or further[0].total >= hypothesis.total - NO_BETTER:
            self._freed_in_vain.add(key)
        while further and further[0].total < hypothesis.total - NO_BETTER:
            hypothesis = further[0]
            further = self.fitted([(hypothesis.plant, hypothesis)]) if self.budget.left > 0.0 else []
        return hypothesis

    def _lowest(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` or what lies lower beside an observer, where contacts part minima; asked once of each."""
        causes, has_play = frozenset(hypothesis.causes), hypothesis.plant.has_contacts
        if not has_play or self.likelihood.simulates or causes in self._lowered or self.budget.left <= 0.0:
            return hypothesis
        self._lowered.add(causes)
        found = [h for h in [lowest(self.likelihood, hypothesis, self.budget.allowance(1))] if h]
        self.judged += found
        return min([hypothesis, *found], key=by_total)

    def _is_plain(self, hypothesis: Hypothesis) -> bool:
        """Tell whether nothing but white noise is left, which no observer follows."""
        return hypothesis.noise.rate == 0.0 and hypothesis.noise.order == 0 and self.is_enough(hypothesis)

    def generalised(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` or what comes of a last resort in the place of causes that it generalises.

        Coloured noise takes up what causes of nearly the right form leave, so that it does not depend on the inputs:
        a search may end with them, before it has tried any last resort.
        """
        if hypothesis.noise.rate > 0.0 or not self.is_enough(hypothesis):
            return hypothesis
        found = self.fitted([(plant, hypothesis) for plant in last_resorts(self.trials, hypothesis)])
        return self.improved(found[0]) if found and found[0].total < hypothesis.total else hypothesis

    def settled(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return `hypothesis` or what explains as much more simply: special forms, and effects that unite two."""
        if not hypothesis.causes:
            return hypothesis
        hypothesis = self.generalised(hypothesis)
        known = [h for h in self.judged if len(h.causes) <= len(hypothesis.causes)]
        hypothesis = min([hypothesis, *known], key=by_total)
        others = *specialised(hypothesis.plant, self.trials.screen), *united(hypothesis.plant)
        forms = self.fitted([(plant, hypothesis) for plant in (*others, *self._together(hypothesis))])
        best = min([hypothesis, *forms], key=by_total)
        simpler = sorted((h for h in forms if h is not best), key=lambda h: h.plant.unusual)
        best = next((h for h in simpler if self.is_chance(h, best)), best)
        plain = self.fitted([(plant, best) for plant in simplified(best.plant, self.trials.seen)])
        return next((h for h in plain if h.total <= best.total + INDISTINCT), best)

    def fitted(self, jobs: Sequence[tuple[Plant, Hypothesis]]) -> list[Hypothesis]:
        """Return plants at their optimum, each begun with the noise of another hypothesis, the best first."""
        share = self.budget.allowance(len(jobs), SPENT)
        fits = in_processes(
            lambda job: self.likelihood.judged(*job, FULL, allowance=share),
            jobs,
            self.likelihood.tally,
            lambda job: work_for(self.likelihood, job[0], FULL),
        )
        found = [h for h in fits if h]
        self.judged += found
        return sorted(found, key=by_total)
