"""What a plant leaves of the records: the noise beside it, and whether that is all that is left."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.closed_loop import fit_loop
from servolens.identification.fitted import fitted
from servolens.identification.likelihood import Likelihood
from servolens.identification.noise import NEGLIGIBLE
from servolens.identification.options import FitOptions
from servolens.identification.restricted import counting_followed
from servolens.identification.score import ScoreTest
from servolens.identification.structure import depends_on_inputs, is_shaking

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.noise import NoiseModel
    from servolens.identification.refine import Refinement
    from servolens.identification.segments import Segment
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Explained", "excerpt_of", "explained"]

MOST_JUDGED = 4_000
"""Samples of an excerpt from which the noise is estimated: its spread is then known to about 1 %."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """A plant fitted to an excerpt of the records beside its own noise.

    Attributes
    ----------
    likelihood : Likelihood
        Of the excerpt.
    hypothesis : Hypothesis or None
        The plant and its noise; None where it cannot be simulated.
    is_enough : bool
        Whether what it leaves is noise: it does not depend on the inputs, or is negligible.
    loop : Refinement or None
        The fit in closed loop, where that leaves noise, and the one driven by the voltage leaves more or sees the axis
        shaken.
    is_shaken : bool
        Whether both leave noise.
    """

    likelihood: Likelihood
    hypothesis: Hypothesis | None
    is_enough: bool
    loop: Refinement | None = None
    is_shaken: bool = False

    def optimum(self, records: Sequence[Record]) -> Refinement:
        """Return the optimum on `records` with its error bars, beside the noise of the excerpt.

        Of a shaken axis that driven by the voltage; shaking that is slower than an observer's model of it answers
        differently to both ways to simulate, so that their difference counts as an error.

        Raises
        ------
        NumericalError
            If the plant cannot be simulated.
        """
        if self.loop is not None and not self.is_shaken:
            return self.loop
        if self.hypothesis is None:
            raise NumericalError("this law cannot be simulated on these records; identify 'constant' instead")
        samples = sum(map(len, records))
        is_all = samples == sum(map(len, self.likelihood.records))
        likelihood = self.likelihood if is_all else self.likelihood.on(records)
        refined = fitted(likelihood, self.hypothesis).refinement
        unknowns = len(refined.plant.values) + 2 * len(records)
        covariance = refined.covariance * self.noise.inflation(samples, unknowns)
        if self.loop is not None:
            difference = np.array(refined.plant.values) - np.array(self.loop.plant.values)
            covariance = covariance + np.outer(difference, difference)
        return replace(refined, covariance=covariance)

    @property
    def noise(self) -> NoiseModel:
        """The noise beside the plant; white where that cannot be simulated."""
        return self.likelihood.white if self.hypothesis is None else self.hypothesis.noise


def explained(
    plant: Plant,
    excerpt: Sequence[Record],
    options: FitOptions | None = None,
    *,
    like: Explained | None = None,
) -> Explained:
    """Fit `plant` and the noise in turn, and judge what is left.

    Parameters
    ----------
    plant : Plant
        Start and structure.
    excerpt : sequence of Record
        See :func:`excerpt_of`.
    options : FitOptions, optional
        What is held or bounded, and priors.
    like : Explained, optional
        Whose noise to begin with.
    """
    options = options or FitOptions()
    likelihood = Likelihood(excerpt, plant, options)
    try:
        found = likelihood.judged(plant, None if like is None else like.hypothesis)
    except (InputError, NumericalError):
        found = None
    is_enough = found is not None and _is_enough(likelihood, found)
    if found is not None and is_enough:
        found = counting_followed(likelihood, found)
        is_enough = not _outlasts(likelihood, found)
        if is_enough and found.noise.rate > 0.0:
            is_enough = is_shaking(likelihood, found)
        if is_enough and found.noise.rate == 0.0:
            return Explained(likelihood, found, is_enough)
    begin = plant if found is None else found.plant
    loop = fit_loop(begin, excerpt, options, likelihood.white, likelihood.most_substeps)
    if loop is None or not loop.is_enough:
        return Explained(likelihood, found, is_enough)
    return Explained(likelihood, found, True, loop.refined, is_shaken=is_enough)


def excerpt_of(segments: Sequence[Segment]) -> tuple[tuple[Record, ...], bool]:
    """Return up to 4000 samples of the records of `segments`, and whether that is all of them.

    Records one after the other, as a whole, or from their first motion on.
    """
    records = {id(s.record): s.record for s in segments}
    if sum(len(record) for record in records.values()) <= MOST_JUDGED:
        return tuple(records.values()), True
    first: dict[int, int] = {}
    for segment in segments:
        first.setdefault(id(segment.record), segment.first)
    share = max(MOST_JUDGED // len(records), MOST_JUDGED // 4)
    kept: list[Record] = []
    for key, record in records.items():
        count = min(len(record), share, MOST_JUDGED - sum(len(r) for r in kept))
        begin = min(first[key], len(record) - count)
        kept.append(record.slice(float(record.time[begin]), float(record.time[begin + count - 1])))
        if sum(len(r) for r in kept) > MOST_JUDGED - share // 2:
            break
    return tuple(kept), False


def _outlasts(likelihood: Likelihood, hypothesis: Hypothesis) -> bool:
    """Tell whether what an observer misses remembers longer than the observer does: then it is no mere shaking."""
    step = float(np.median([np.median(np.diff(signals.time)) for signals in likelihood.signals]))
    return hypothesis.noise.memory() * hypothesis.noise.rate * step > 1.0


def _is_enough(likelihood: Likelihood, hypothesis: Hypothesis) -> bool:
    if hypothesis.noise.rate == 0.0 and hypothesis.noise.spread <= NEGLIGIBLE * likelihood.travel:
        return True
    try:
        return not depends_on_inputs(ScoreTest(likelihood, hypothesis))
    except (InputError, NumericalError):
        return False
