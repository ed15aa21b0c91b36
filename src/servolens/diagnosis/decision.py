"""Which causes are named: a search by prediction errors, what confirms it, and a second one by simulations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from servolens.diagnosis.effort import SPENT
from servolens.diagnosis.errors import pooled
from servolens.diagnosis.knocks import without_knock
from servolens.diagnosis.ordering import INDISTINCT, by_total, is_last_resort, late_otherwise
from servolens.diagnosis.remainder import held_errors, remainder_of
from servolens.diagnosis.search import Search, improved_path, search
from servolens.errors import NumericalError
from servolens.findings import Finding
from servolens.identification.phases import own_phases
from servolens.model_evidence import MATERIAL

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.effort import Effort
    from servolens.identification.hypothesis import Hypothesis

__all__ = ["Decision", "decided", "objection"]

MOST = 0.9
"""Share of the squared error that causes must take of a remainder that is immaterial, to be named."""
AS_WELL = 6.0
"""Difference of −2 log-likelihood, prices paid, up to which fewer parameters count more: odds of 1 to 20. Chosen on
axes of the laboratory."""
CONTENDERS = 6
"""Hypotheses, the likeliest, that are compared on records to which they were not fitted."""
SECOND, FIRST = 0.3, 2.0 / 3.0
"""Of the effort, what a search after a ripple of the mains was learnt, or a knock cut off, may take in any case, and
fits of what one by simulations has found. The share of the progress that is the searches' by prediction errors."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What was chosen, of which search on which case: by prediction errors, or by simulations.

    Attributes
    ----------
    case : Case
        The records as they were judged.
    found : Search
        All that was tried.
    path : tuple of Hypothesis
        Gain and damping alone, then with one cause, two …, as far as other records confirm them.
    findings : tuple of Finding
        Causes that these do not confirm.
    contradiction : Finding or None
        That the records are of several axes.
    """

    case: Case
    found: Search
    path: tuple[Hypothesis, ...]
    findings: tuple[Finding, ...]
    contradiction: Finding | None = None


def decided(case: Case, effort: Effort, tell: Callable[[str, float], None]) -> Decision:
    """Search by prediction errors and, where these show that no model is the axis, by simulations.

    Records of several axes are explained by none: asked where the causes of one axis are no simpler than a gain and
    damping for each record.
    """

    def first(what: str, share: float) -> None:
        tell(what, FIRST * share)

    before = case.likelihood.work
    found = search(case.trials, case.base, effort, first, is_enough=case.is_enough, is_answer=case.explains)
    if found.chosen.causes and case.learn_ripple(found.chosen):  # that the causes had hidden
        left = max(effort.work - (case.likelihood.work - before), SECOND * effort.work)
        again = replace(effort, work=left)
        found = search(case.trials, case.base, again, first, is_enough=case.is_enough, begun=found.path[1:])
    found = _simplest(case, found)
    confirmed = _confirmed(case, found)
    explaining = confirmed if _explains(case, confirmed.path[-1]) else None
    is_open = explaining is None or case.burst(confirmed.path[-1]) is not None
    quiet = without_knock(confirmed, effort.judged) if is_open else None
    if quiet is not None:
        left = max(effort.work - (case.likelihood.work - before), SECOND * effort.work)
        calm = decided(quiet[0], replace(effort, work=left), tell)
        chosen = calm.path[-1]
        if calm.contradiction is None and _explains(calm.case, chosen) and calm.case.burst(chosen) is None:
            return replace(calm, findings=(quiet[1], *calm.findings))
    several = case.base.plant.unusual * len(case.records)
    if explaining is None or explaining.path[-1].plant.unusual > several:
        contradiction = case.contradiction()
        if contradiction is not None:
            alone = Search((case.base,), (case.base,), (), ended_early=False)
            return Decision(case, alone, (case.base,), (), contradiction)
    if explaining is not None:
        return explaining
    return _simulated(case, confirmed, effort, lambda what, share: tell(what, FIRST + (1.0 - FIRST) * share))


def _explains(case: Case, hypothesis: Hypothesis) -> bool:
    """Tell whether a `hypothesis` leaves nothing that depends on the inputs, and does not only help an observer.

    A last resort describes nearly anything of its kind, and an observer follows what it leaves: that must not matter.
    """
    if not case.is_enough_everywhere(hypothesis) or _is_stand_in(case, hypothesis):
        return False
    is_followed = hypothesis.noise.rate > 0.0 and is_last_resort(hypothesis)
    return not (is_followed and case.is_material(case.gains([hypothesis]).trained[-1], case.likelihood.white.spread))


def _simplest(case: Case, found: Search) -> Search:
    """Return `found` with what leaves nothing that depends on the inputs, of those that are about as likely.

    Of several the one with the fewest parameters; as it is where there is none. The records held out are asked as well.
    """
    chosen = found.chosen
    is_enough = case.is_enough_everywhere(chosen)
    rivals = [h for h in found.judged if h.total <= chosen.total + AS_WELL and h is not chosen]
    for rival in sorted(rivals, key=lambda h: h.plant.unusual):
        is_simpler = rival.plant.unusual < chosen.plant.unusual
        if (is_simpler or not is_enough) and case.is_enough_everywhere(rival):
            before = [h for h in found.path if set(h.causes) < set(rival.causes)]
            return replace(found, path=(*before, rival))
    return found


def _confirmed(case: Case, found: Search) -> Decision:
    """Take the last causes off the path that records to which they were not fitted do not confirm."""
    path, findings = list(found.path), []
    while len(path) > 1 and (said := objection(case, path)):
        lost = ", ".join(name for name in path[-1].causes if name not in path[-2].causes)
        message = f"{lost} {said}; it is left out."
        findings.append(Finding(code="not_confirmed", severity="note", message=message))
        path.pop()
    return Decision(case, found, tuple(path), tuple(findings))


def objection(case: Case, path: Sequence[Hypothesis]) -> str:
    """Return what records to which they were not fitted say against the last of `path`; empty if nothing.

    They must be likelier beside it than beside the one before; at the end of a record, beside the same noise. Where
    they would not tell the two apart, as of a limit that they do not reach, those fitted decide. Where something is
    left that nothing explains, what is likelier from sample to sample has to be closer in simulations as well. An
    observer that follows a shaken axis may follow what a wrong cause does, and a filter of slow noise whiten it:
    there the simulation of all records, to which neither was fitted, must not miss more than that of any simpler
    model, either, of those with the same waves: whose phases no simulation foretells. Where it misses a material
    part of the travel, it must miss less than the simplest of these, of the records that were fitted and of the
    others: causes that do not show in what matters explain nothing.
    """
    simpler, richer = path[-2:]
    only_training, not_simulated = (
        "explains the training records only, not those held out",
        "predicts records from sample to sample only, and simulations of them miss more with it",
    )
    if _differ(case, richer, simpler):
        # at the end of a record, where an axis rests, noise that whitens what a simpler model lacks predicts best
        is_end = not case.heldout and any(case.cuts) and richer.noise.rate == simpler.noise.rate
        beside = replace(simpler, noise=richer.noise) if is_end else simpler
        if case.misfit(richer) >= case.misfit(beside):
            return only_training
        if not case.explains(richer) and _misses_more(case, simpler, richer):
            return not_simulated
    if richer.noise.rate == 0.0 and richer.noise.order == 0:
        return ""
    alike = [h for h in path if own_phases(h.plant) == own_phases(richer.plant)]
    if len(alike) == 1:
        return ""
    gains = case.gains(alike)
    is_worse = any(gains.is_worse(-1, i, case.likelihood.rate, with_training=True) for i in range(len(alike) - 1))
    if is_worse:
        return not_simulated
    is_material = case.is_material(gains.trained[-1], case.likelihood.white.spread)
    if is_material and not gains.misses_less(-1, 0):
        return "brings simulations, which miss a material part of the travel, no closer than a simpler model does"
    return ""


def _differ(case: Case, one: Hypothesis, other: Hypothesis) -> bool:
    """Tell whether records that were not fitted can tell two hypotheses apart, or one of them cannot simulate these."""
    try:
        return case.difference(one, other) > INDISTINCT
    except NumericalError:
        return True


def _misses_more(case: Case, simpler: Hypothesis, richer: Hypothesis) -> bool:
    """Tell whether simulations of records that were not fitted miss more with the `richer` hypothesis."""
    missed = [pooled(held_errors(case, h, case.gains([h]))) for h in (simpler, richer)]
    return missed[1] > missed[0]


def _simulated(case: Case, confirmed: Decision, effort: Effort, tell: Callable[[str, float], None]) -> Decision:
    """Return what a search by simulations finds instead, where that predicts records better that were not fitted.

    A model that is not the axis predicts the next sample best by one set of parameters, and a whole step by another;
    who tunes wants the step. What the first search has found is where the second one begins: in closed loop effects
    hide each other, such as friction that damps and a delay that does the contrary.
    """
    found = confirmed.found
    chosen = found.chosen
    try:
        simulating = case.simulating()
        base = simulating.base
        if _is_immaterial(simulating, base) and not _takes_most(case, chosen, simulating):
            before = case.base.total - base.total  # singles gain as much as they did by prediction errors
            singles = tuple(replace(h, total=h.total - before) for h in found.singles)
            alone = Search((base,), (base,), singles, ended_early=found.ended_early)
            return Decision(simulating, alone, (base,), ())
        begun = {h.causes: h.plant for h in (*found.path, *found.judged[:CONTENDERS]) if h.causes}
        known = simulating.fitted_to_simulations(list(begun.values()), SPENT * effort.work)
        other = search(simulating.trials, base, replace(effort, work=(1.0 - SPENT) * effort.work), tell, known)
    except NumericalError:
        return confirmed
    other = _cross_validated(simulating, other)
    work = SECOND * effort.work
    again = _refitted(case, other.path, SPENT * work)
    if again and again[-1].total < chosen.total and _explains(case, again[-1]):
        refitted = improved_path(case.trials, found, again, replace(effort, work=SPENT * work), case.is_enough)
        if _explains(case, refitted.chosen):
            return Decision(case, refitted, refitted.path, ())
        return Decision(case, replace(found, path=again), again, ())
    if case.gains([chosen]).tested(-1) <= simulating.gains(other.path[-1:]).tested(-1):
        return confirmed
    return Decision(simulating, other, other.path, ())


def _refitted(case: Case, path: Sequence[Hypothesis], work: float) -> tuple[Hypothesis, ...]:
    """Return `path` fitted to prediction errors, as far as its causes pay for themselves; empty where a fit fails.

    What makes its last loop late may be another effect: simulations hardly tell a delay from a lag.
    """
    *before, last = (step.plant for step in path)
    ways = [last, *late_otherwise(last)]
    ends = [h for way in ways if (h := case.likelihood.judged(way, allowance=work / len(ways)))]
    refits = [
        *(case.likelihood.judged(plant, allowance=work) for plant in before),
        min(ends, key=by_total, default=None),
    ]
    again = tuple(h for h in refits if h is not None)
    if len(again) < len(path):
        return ()
    least = min(range(len(again)), key=lambda k: again[k].total)
    return again[: least + 1]


def _is_stand_in(case: Case, hypothesis: Hypothesis) -> bool:
    """Tell whether gain and damping alone, fitted to simulations, are closer to records that were not fitted.

    Then the causes only help an observer to follow what they do not explain. A wave says nothing there: no simulation
    foretells its phase.
    """
    if not hypothesis.causes or hypothesis.noise.rate == 0.0 or own_phases(hypothesis.plant):
        return False
    try:
        simulating = case.simulating()
    except NumericalError:
        return False
    gains, simulated = case.gains([hypothesis]), simulating.gains([simulating.base])
    return gains.with_others(simulated).is_worse(0, -1, case.likelihood.rate)


def _is_immaterial(case: Case, hypothesis: Hypothesis) -> bool:
    """Tell whether what a hypothesis leaves is too little to name causes that would take most of it.

    Of the travel, and of what the motor gives: a stiff loop hides in its position what its voltage shows.
    """
    left = remainder_of(case, hypothesis, case.gains([hypothesis]))
    return not left.material and left.of_motor <= MATERIAL


def _takes_most(case: Case, chosen: Hypothesis, simulating: Case) -> bool:
    """Tell whether causes take most of what gain and damping alone, fitted to simulations, leave of other records."""
    if not chosen.causes:
        return False
    alone = simulating.gains([simulating.base]).tested(0)
    return case.gains([chosen]).tested(0) ** 2 <= (1.0 - MOST) * alone**2


def _cross_validated(case: Case, found: Search) -> Search:
    """Return `found` with those that were likeliest weighed by records to which they were not fitted.

    Of models that are all wrong, the likelihood of what was fitted favours the most flexible. What a fit to the other
    records predicts of each does not (Yao et al. 2018, doi:10.1214/17-BA1091): of all records, training ones too, for a
    few held out may favour a model by chance. Weighed are those beside which all records are likeliest, the ones held
    out as they are predicted. Of those that these cannot tell apart, the one with the fewest causes, then parameters;
    none that misses the records held out more than gain and damping alone.
    """
    tried = {h.causes: h for h in (*found.path, *(h for h in found.judged if h.causes))}
    held = {causes: case.misfit(h) if case.heldout else 0.0 for causes, h in tried.items()}
    admitted = [h for causes, h in tried.items() if causes and held[causes] <= held[()]]
    likeliest = sorted(admitted, key=lambda h: h.total + held[h.causes])[:CONTENDERS]
    predicted = ((h, held[h.causes] + case.left_out_misfit(h)) for h in (tried[()], *likeliest))
    weighed = sorted((replace(h, total=total) for h, total in predicted), key=by_total)
    base = next(h for h in weighed if not h.causes)
    alike = [h for h in weighed if h.total <= weighed[0].total + INDISTINCT]
    best = min(alike, key=lambda h: (len(h.causes), h.plant.unusual))
    between = [h for h in weighed if h.causes and set(h.causes) < set(best.causes)][:1]
    path = [base, *between, best] if best.causes else [base]
    return replace(found, path=tuple(path), judged=tuple(weighed))
