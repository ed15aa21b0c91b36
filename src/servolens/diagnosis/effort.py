"""How far the search of a diagnosis goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar, final

from servolens.processors import in_processes
from servolens.simulation.rates import substeps_for, work_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.identification.likelihood import Likelihood
    from servolens.plant import Plant
    from servolens.processors import Tally

Job = TypeVar("Job")
Result = TypeVar("Result")

__all__ = ["EFFORT", "SPENT", "Budget", "Effort", "shared", "work_for"]

SHARE, SPENT = 0.4, 0.25
"""Of the effort that is left, what one round of fits may take, so that some is left for those that follow; of the
whole, with how little left no further effect is looked for: so much is kept for fits to their optimum, and may be taken
by one that is made after a search."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """How far a search goes.

    Attributes
    ----------
    causes : int
        Effects beside gain and damping, at most.
    fitted : int
        Effects that are fitted in one pass, those with the highest scores.
    judged : int
        Of these, those that are fitted to their optimum.
    beam : int
        Hypotheses that are extended.
    work : float
        Of all simulations: samples, each weighted by the time its substeps take
        (:func:`~servolens.simulation.rates.work_of`).
    """

    causes: int
    fitted: int
    judged: int
    beam: int
    work: float


EFFORT = {
    "quick": Effort(causes=2, fitted=6, judged=2, beam=1, work=5e7),
    "normal": Effort(causes=4, fitted=10, judged=3, beam=1, work=1e8),
    "thorough": Effort(causes=5, fitted=24, judged=5, beam=3, work=2e9),
}
"""A hundred million take ten to twenty seconds of one processor, all that goes with simulating them included. A
search by prediction errors and one by simulations may take so much each, and the former as much again for what it tries
with and without an observer."""


@final
class Budget:
    """What a search may simulate.

    Parameters
    ----------
    tally : Tally
        Of the work that is done.
    work : float
        Of the whole effort.
    share : float
        Of that, what the search may take from now on; it may be changed.
    """

    def __init__(self, tally: Tally, work: float, share: float) -> None:
        self._tally, self._before, self._work, self.share = tally, tally.value, work, share

    @property
    def left(self) -> float:
        """Work that may still be done, of the granted share of the effort."""
        return max(self.share * self._work - self._spent, 0.0)

    @property
    def _spent(self) -> int:
        return self._tally.value - self._before

    def has_more(self, work: float) -> bool:
        """Tell whether of so much `work` enough is left to look for a further effect."""
        return self._spent < (1.0 - SPENT) * work

    def allowance(self, jobs: int, kept: float = 0.0) -> float:
        """Return what each of so many `jobs` may simulate: fixed before, it does not depend on their order.

        As if a share `kept` of the effort were left in any case.
        """
        return SHARE * max(self.left, kept * self.share * self._work) / max(jobs, 1)

    def shared_among(
        self,
        function: Callable[[Job, float], Result],
        jobs: Sequence[Job],
        need: Callable[[Job], float],
        told: Callable[[int], None] = lambda _: None,
    ) -> list[Result]:
        """Return what `function` makes of each of the `jobs` and of what it may simulate for it, by what each needs."""
        needs = [need(job) for job in jobs]
        parts = shared(SHARE * self.left, needs)
        return in_processes(
            lambda i: function(jobs[i], parts[i]), range(len(jobs)), self._tally, lambda i: needs[i], told
        )


def shared(work: float, needs: Sequence[float]) -> list[float]:
    """Return how much of the `work` each job may do: what it needs, or else an equal part of what the others leave.

    A backlash takes some six times the work of a spring. Needs are estimates: where there is more work than that, it is
    shared in proportion.

    Examples
    --------
    >>> shared(10.0, [1.0, 20.0, 3.0]), shared(9.0, [5.0, 5.0, 5.0]), shared(16.0, [2.0, 6.0])
    ([1.0, 6.0, 3.0], [3.0, 3.0, 3.0], [4.0, 12.0])
    """
    if sum(needs) < work:
        return [need * work / sum(needs) for need in needs]
    granted = [0.0] * len(needs)
    for place, i in enumerate(sorted(range(len(needs)), key=lambda i: needs[i])):
        granted[i] = min(needs[i], work / (len(needs) - place))
        work -= granted[i]
    return granted


def work_for(likelihood: Likelihood, plant: Plant, iterations: int) -> float:
    """Return an estimate, rather too large, of the work of so many `iterations` from `plant`.

    Each takes central differences in all parameters and two initial states, with backlash three.
    """
    runs = [(signals.time.size, signals.longest_step) for signals in likelihood.signals]
    once = sum(work_of(plant, samples, step, substeps_for(plant, step)) for samples, step in runs)
    return float(once * (1 + 2 * iterations * (len(plant.values) + 2 + plant.has_contacts)))
