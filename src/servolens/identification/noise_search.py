"""The likeliest noise beside given plants: a simulation, instants that move, an axis that is shaken."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.hypothesis import NO_BETTER
from servolens.identification.late_inputs import about, instants
from servolens.identification.noise import MOST_ORDER, NEGLIGIBLE, NoiseModel
from servolens.identification.parabola import Parabola
from servolens.identification.refine import AT_NOISE
from servolens.identification.rounding import dominates
from servolens.simulation.rates import substeps_for, work_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.plant import Plant

__all__ = ["NoiseTrials", "shaken"]

CORNER, CORNERS = 4.0, (0.05, 64.0)
"""Corner of what shakes the axis with which rates are compared first, and its range, in units of the loops' rate."""
MOST_MOVES, FEW_MOVES = 16, 2
"""Steps from one model of what shakes the axis to a likelier one, and where the plant is fitted in turn."""
REACH, FINEST = 4.0, 0.25
"""How far one goes, in widths of what is looked at around it; least width, in octaves."""


def shaken(noise: NoiseModel, loops: float, rate: float = 1.0) -> NoiseModel:
    """Return `noise` of an axis that is shaken, at a `rate` in units of that of the `loops` [rad/s]."""
    return replace(noise, rate=rate * loops, corner=CORNER * loops)


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
        self.unpowered, self.first = unpowered, about(likelihood.white, plants[0])
        self.best: tuple[NoiseModel, float] | None = None
        self._left: list[NDArray[np.float64]] | None = None
        self._seen: dict[tuple[float, ...], float] = {}

    def shaken(self, noise: NoiseModel, rate: float) -> NoiseModel:
        """Return `noise` of an axis that is shaken, at a `rate` in units of the loops' own."""
        return shaken(noise, self.likelihood.rate, rate)

    def search(self, noise: NoiseModel, rates: Sequence[float]) -> None:
        """Look at a simulation beside `noise`, at the jitter that its residual shows, and at `rates` of shaking.

        Rate and corner of the shaking that is likeliest are improved beside white noise of the sensor, for a filter
        would whiten what an observer that is too slow leaves, and so hide the better one. The noise is coloured at the
        end, where that is likelier.
        Of an axis whose instants move the input may be as late as the reading, or on time.
        Without any `rates` only that of the noise is looked at beside which the starts were fitted.
        """
        likelihood = self.likelihood
        self.look(noise)
        is_coarse = dominates(likelihood.white)  # nothing tells jitter from rounding, nor shaking from as little
        if self.best is not None and self._is_rounding(self.best[0]):
            return
        if self._left is not None and not is_coarse:
            jitter, floor = instants(self._left, [signals.speed for signals in likelihood.signals])
            if jitter > 0.0:
                late = replace(noise, jitter=jitter, floor=min(floor, noise.floor))
                noise = self._likeliest(noise, [late, replace(late, gain=0.0)])
        found = [self.shaken(noise, rate) for rate in rates if rate > 0.0]
        if self.like.rate > 0.0:
            found = [replace(noise, rate=self.like.rate, corner=self.like.corner)]
        best = self._likeliest(noise, found)
        if best.rate > 0.0:
            self.look(self._improved(best) if rates else best, is_coloured=True)

    def _is_rounding(self, noise: NoiseModel) -> bool:
        """Tell whether no more is left than rounding can be.

        At most half a step, as of an axis that rests where the encoder shows the next one; and where rounding is most
        of the sensor's noise, a few times that.
        """
        white = self.likelihood.white
        return noise.spread <= 0.5 * white.rounding or (dominates(white) and noise.spread <= AT_NOISE * white.spread)

    def _improved(self, noise: NoiseModel) -> NoiseModel:
        """Return noise of the likeliest rate and corner near these, by Newton's method on their logarithms.

        It ends where a parabola through the neighbours promises no better ones.
        """
        unit, look = self.likelihood.rate, self.look
        noise = replace(noise, corner=min(max(noise.corner, CORNERS[0] * unit), CORNERS[1] * unit))

        def at(place: NDArray[np.float64]) -> NoiseModel:
            return replace(
                noise, rate=noise.rate * 2.0 ** float(place[0]), corner=noise.corner * 2.0 ** float(place[1])
            )

        def misfit(place: NDArray[np.float64]) -> float:
            is_inside = CORNERS[0] * unit <= at(place).corner <= CORNERS[1] * unit
            return look(at(place)) if is_inside else np.inf

        place = np.zeros(2)
        is_close = self.like.rate > 0.0  # it was the likeliest beside another plant, which is fitted in turn
        width = FINEST if is_close else 1.0
        for _ in range(FEW_MOVES if is_close else MOST_MOVES):
            around = Parabola.of(misfit, place, width)
            reach = REACH * width
            if around.falls(reach) < NO_BETTER:
                break
            step = around.step(reach)
            found = min([place, *around.places, place + step], key=misfit)
            if found is place and width <= FINEST:
                break
            wide = 0.5 * width if found is place else 0.5 * float(np.max(np.abs(found - place)))
            place, width = found, min(max(wide, FINEST), 1.0)
        return at(place)

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
        begun = list(self.starts)
        if not is_own:
            begun = [np.append(run.start, start[2:]) for run, start in zip(runs, begun, strict=True)]
        substeps = [substeps_for(plant, run.sample_time) for run, plant in zip(runs, self.plants, strict=True)]
        of_each = list(zip(runs, self.plants, begun, substeps, strict=True))
        try:
            missed = [run.missed(plant, start, steps) for run, plant, start, steps in of_each]
        except (InputError, NumericalError):
            return np.inf
        works = [work_of(plant, run.simulated, run.sample_time, steps) for run, plant, _, steps in of_each]
        likelihood.tally.add(sum(works))
        whiteners = [run.whiten for run in runs]
        steady = [whiten.steady(error) for whiten, error in zip(whiteners, missed, strict=True)]
        if not first.is_observed:
            self._left = steady
        noise = (
            first.scaled(steady) if likelihood.simulates else first.coloured(missed, whiteners, most_order=most_order)
        )
        is_left = noise.rate == 0.0 and noise.spread > NEGLIGIBLE * likelihood.travel and not self._is_rounding(noise)
        if is_left and (noise.wanders or noise.swings):
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
            misfit += float(np.sum(initial.away(start) ** 2)) if run.start.size else 0.0
        if self.best is None or misfit < self.best[1]:
            self.best = noise, misfit
        return misfit
