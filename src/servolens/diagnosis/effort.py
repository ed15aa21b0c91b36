"""How far the search of a diagnosis goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

__all__ = ["EFFORT", "Effort"]


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
    "normal": Effort(causes=4, fitted=10, judged=3, beam=1, work=2e8),
    "thorough": Effort(causes=5, fitted=24, judged=5, beam=3, work=2e9),
}
"""A hundred million take seven to eleven seconds of one processor, all that goes with simulating them included. A
search by prediction errors and one by simulations may take so much each, and the former as much again for what it tries
with and without an observer."""
