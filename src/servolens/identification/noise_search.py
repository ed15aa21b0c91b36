"""The likeliest noise beside given plants: a simulation, instants that move, an axis that is shaken."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.noise import MOST_ORDER, NEGLIGIBLE, NoiseModel, instants
from servolens.identification.rounding import dominates
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.plant import Plant

__all__ = ["NoiseTrials"]

CORNER, CORNERS = 4.0, (0.05, 64.0)
"""Corner of what shakes the axis with which rates are compared first, and its range, in units of the loops' rate."""
MOST_MOVES, FINEST = 16, 0.25
"""Steps from one model of what shakes the axis to a likelier one; share of the longest at which none is refined."""


@final
class NoiseTrials:
    """Noise models beside given plants, and the likeliest so far.

    Parameters
    ----------
    likelihood : Likelihood
        Of the records.
    plants : sequence of Plant
        One for each record.
    starts : sequence of ndarray
        Initial states, fitted beside `like`.
    like : NoiseModel
        Whose shaking the search begins with.
    unpowered : bool
        Whether nothing was applied before records that begin with their step.
    """

    def __init__(
        self,
        likelihood: Likelihood,
        plants: Sequence[Plant],
        starts: Sequence[NDArray[np.float64]],
        like: NoiseModel,
        *,
        unpowered: bool,
    ) -> None:
        self.likelihood, self.plants, self.starts, self.like = likelihood, plants, starts, like
        self.unpowered = unpowered
        self.best: tuple[NoiseModel, float] | None = None
        self._left: list[NDArray[np.float64]] | None = None
        self._seen: dict[tuple[float, ...], float] = {}

    def shaken(self, noise: NoiseModel, rate: float) -> NoiseModel:
        """Return `noise` of an axis that is shaken, at a `rate` in units of the loops' own."""
        return replace(noise, rate=rate * self.likelihood.rate, corner=CORNER * self.likelihood.rate)

    def search(self, noise: NoiseModel, rates: Sequence[float]) -> None:
        """Look at a simulation beside `noise`, at the jitter that its residual shows, and at `rates` of shaking.

        Rate and corner of the shaking that is likeliest are improved in turn, by factors, until neither gets likelier:
        beside white noise of the sensor, for a filter would whiten what an observer that is too slow leaves, and so
        hide the better one. The noise is coloured at the end, where that is likelier.
        Of an axis whose instants move the input may be as late as the reading, or on time.
        Without any `rates` only that of the noise is looked at beside which the starts were fitted.
        """
        likelihood = self.likelihood
        self.look(noise)
        if dominates(likelihood.white):  # nothing tells shaking or jitter from rounding
            return
        if self._left is not None:
            jitter, floor = instants(self._left, [signals.speed for signals in likelihood.signals])
            if jitter > 0.0:
                late = replace(noise, jitter=jitter, floor=min(floor, noise.floor))
                noise = self._likeliest(noise, [late, replace(late, gain=0.0)])
        found = [self.shaken(noise, rate) for rate in rates if rate > 0.0]
        if self.like.rate > 0.0:
            found = [replace(noise, rate=self.like.rate, corner=self.like.corner)]
        best = self._likeliest(noise, found)
        share = FINEST if self.like.rate > 0.0 else 1.0  # where it was the likeliest beside another plant it is close
        for _ in range(MOST_MOVES if best.rate > 0.0 and rates else 0):
            moved = self._likeliest(best, [*_neighbours(best, likelihood.rate, share)])
            if moved is best and share <= FINEST:
                break
            share, best = (0.5 * share if moved is best else min(2.0 * share, 1.0)), moved
        if best.rate > 0.0:
            self.look(best, is_coloured=True)

    def _likeliest(self, noise: NoiseModel, others: Sequence[NoiseModel]) -> NoiseModel:
        return min([noise, *others], key=self.look)

    def look(self, noise: NoiseModel, *, is_coloured: bool = False) -> float:
        """Return −2 log-likelihood beside an observer of this noise, its autoregressive part the likeliest.

        Where the axis is shaken, without one unless `is_coloured`.
        """
        order = MOST_ORDER if is_coloured or noise.rate == 0.0 else 0
        key = (noise.rate, noise.corner, noise.jitter, noise.gain, order)
        if key not in self._seen:
            self._seen[key] = self._look(noise, order)
        return self._seen[key]

    def _look(self, first: NoiseModel, most_order: int) -> float:
        likelihood = self.likelihood
        runs = likelihood.runs(first, unpowered=self.unpowered)
        is_own = first.rate == 0.0 or self.like.rate > 0.0
        begun = self.starts if is_own else [run.start for run in runs]
        try:
            missed = [
                run.missed(plant, start, substeps_for(plant, run.sample_time))
                for run, plant, start in zip(runs, self.plants, begun, strict=True)
            ]
        except (InputError, NumericalError):
            return np.inf
        likelihood.count(
            sum(run.samples * substeps_for(p, run.sample_time) for run, p in zip(runs, self.plants, strict=True))
        )
        whiteners = [run.whiten for run in runs]
        steady = [whiten.steady(error) for whiten, error in zip(whiteners, missed, strict=True)]
        if not first.is_observed:
            self._left = steady
        noise = (
            first.scaled(steady) if likelihood.simulates else first.coloured(missed, whiteners, most_order=most_order)
        )
        if noise.spread > NEGLIGIBLE * likelihood.travel and noise.rate == 0.0 and (noise.wanders or noise.swings):
            noise = replace(first.scaled(steady), is_model_error=True)
        elif noise.swings:
            noise = first.coloured(missed, whiteners, most_order=0)
        if not np.isfinite(noise.innovation) or noise.innovation <= 0.0:
            return np.inf
        parameters = noise.parameters + 2 * (noise.rate > 0.0) + (noise.jitter > 0.0)
        misfit = parameters * float(np.log(likelihood.counted))
        for run, error, start in zip(runs, missed, begun, strict=True):
            whiten, initial = run.whiten.beside(noise), run.signals.initial
            white = whiten(error)
            misfit += whiten.log_determinant + float(white @ white)
            misfit += float(np.sum(((start - initial.mean) / initial.deviation) ** 2)) if run.start.size else 0.0
        if self.best is None or misfit < self.best[1]:
            self.best = noise, misfit
        return misfit


def _neighbours(noise: NoiseModel, unit: float, share: float) -> Iterator[NoiseModel]:
    """Yield noise that shakes the axis twice as fast or half, or with a corner three times as high or a third.

    Or by a `share` of that, on a logarithmic scale. Another corner leaves the spectrum as it was below it, or, as
    rate⁴·corner², above it: one of both is what the records tell best.
    """
    for factor in (2.0**share, 0.5**share):
        yield replace(noise, rate=factor * noise.rate)
    for factor in (3.0**share, 3.0**-share):
        if CORNERS[0] * unit <= factor * noise.corner <= CORNERS[1] * unit:
            yield replace(noise, corner=factor * noise.corner)
            yield replace(noise, corner=factor * noise.corner, rate=noise.rate / factor**0.5)
