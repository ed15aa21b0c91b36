"""Where the fit of given effects begins, and which of the places that a few iterations lead to are followed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.fitting import INERTIAS, of_other_inertias
from servolens.identification.likelihood import FEW
from servolens.identification.noise_search import shaken
from servolens.identification.refine import DOWN_TO_NOISE, followed
from servolens.identification.regressors import regressor
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.effects import Effect
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.options import FitOptions
    from servolens.identification.starting import Screen
    from servolens.plant import Plant

__all__ = ["Candidates"]

STARTS, FOLLOWED = 3, 2
"""Values of each effect that are tried by simulation; of all starts together, those that are followed to their end."""


@final
class Candidates:
    """Starts for a plant whose effects are given, and the hypotheses to which they lead.

    Parameters
    ----------
    wanted : Plant
        With gain, damping and effects as given.
    screen : Screen
        The records' motion, for the integral equation.
    likelihood : Likelihood
        Of the records.
    options : FitOptions
        What is held, and priors.
    """

    def __init__(self, wanted: Plant, screen: Screen, likelihood: Likelihood, options: FitOptions) -> None:
        self._given, self._screen, self._likelihood, self._options = wanted, screen, likelihood, options

    def found(self) -> list[Hypothesis]:
        """Return where the starts lead, the likeliest first; no further ones once the noise alone is left.

        Raises
        ------
        NumericalError
            If no start can be simulated.
        """
        found: list[Hypothesis] = []
        stages: list[Callable[[Sequence[Hypothesis]], list[Plant]]] = [
            self._at_once,
            self._one_by_one,
            self._freed,
            self._rescaled,
        ]
        for stage in stages:
            tried = [h for start in stage(found) if (h := self._tried(start)) is not None]
            tried.sort(key=lambda h: h.total)
            ends = [self._likelihood.judged(h.plant, h) for h in tried[:FOLLOWED]]
            found = sorted([*found, *(h for h in ends if h is not None)], key=lambda h: h.total)
            if found and self._is_noise(found[0]):
                break
        if not found:
            raise NumericalError("no start of this model can be simulated on these records; check signs and units")
        return found

    def _is_noise(self, hypothesis: Hypothesis) -> bool:
        noise = hypothesis.noise
        return noise.rate == 0.0 and noise.spread <= DOWN_TO_NOISE * self._likelihood.floor

    def _at_once(self, _: Sequence[Hypothesis]) -> list[Plant]:
        """Return the plant with its effects as given, as the integral equation has them, and as priors have them.

        Contacts give the error many local minima: there gain and damping are first fitted beside the effects as given,
        lest those of the integral equation lead away from them.
        """
        given = self._given
        starts = [given, *_solved(given, self._screen), *self._loosened(given)]
        known = {name: prior.value for name, prior in self._options.priors.items()}
        if known:
            starts += [s.with_named(known) for s in starts]
        return starts

    def _loosened(self, given: Plant) -> list[Plant]:
        """Return `given` with gain and damping fitted beside its contacts, if it has some."""
        likelihood = self._likelihood
        others = [name for name in given.parameters if name not in ("gain", "damping")]
        if not given.has_contacts:
            return []
        try:
            options, white = self._options.of(given.parameters).holding(*others), likelihood.white
            return [followed(given, likelihood.runs(white), options, noise=white.spread, iterations=FEW)[0]]
        except (InputError, NumericalError):
            return []

    def _one_by_one(self, _: Sequence[Hypothesis]) -> list[Plant]:
        """Return the plant if its effects take their best starts one after the other, and each anew beside all."""
        plant = replace(self._given, effects=())
        for effect in self._given.effects:
            plant = self._with(plant, effect)
        again = plant
        for effect in plant.effects if len(plant.effects) > 1 else ():
            again = self._with(again, again.effect(effect.name) or effect)
        return [self._in_order(p) for p in (plant, again)]

    def _freed(self, found: Sequence[Hypothesis]) -> list[Plant]:
        """Return the likeliest plant so far with parameters of one effect off their usual values."""
        return [plant for h in found[:1] for plant in h.plant.freed()]

    def _rescaled(self, found: Sequence[Hypothesis]) -> list[Plant]:
        """Return the likeliest plants so far with other inertias, all forces in proportion, or the motor's alone."""
        starts: list[Plant] = []
        for plant in [self._given, *(h.plant for h in found[:1])]:
            starts += of_other_inertias(plant)
            starts += [replace(plant, gain=share * plant.gain) for share in INERTIAS]
        return starts

    def _in_order(self, plant: Plant) -> Plant:
        order = [effect.name for effect in self._given.effects]
        return replace(plant, effects=tuple(sorted(plant.effects, key=lambda effect: order.index(effect.name))))

    def _with(self, plant: Plant, effect: Effect) -> Plant:
        """Return `plant` with `effect` at the start from which a few iterations lead furthest."""
        if regressor(type(effect)).sizes:
            starts = [plant.with_effect(one) for one in self._screen.best_starts(plant, effect, STARTS)]
            starts += [solved for start in starts for solved in _solved(start, self._screen)]
        else:
            trials = [plant.with_effect(one) for one in self._screen.proposals(plant, effect)]
            trials = [self._held(_contacts_of(effect, trial)) for trial in trials]
            starts = sorted(trials, key=self._misfit)[:STARTS]
        tried = [h for start in starts if (h := self._tried(start)) is not None]
        return min(tried, key=lambda h: h.total).plant if tried else plant.with_effect(effect)

    def _misfit(self, plant: Plant) -> float:
        """Return the squared prediction errors of `plant`, of an observer that follows it loosely."""
        likelihood = self._likelihood
        if likelihood.is_too_stiff(plant):
            return float(np.inf)
        noise = shaken(likelihood.white, likelihood.rate)
        try:
            missed = [
                run.missed(plant, run.start, substeps_for(plant, run.sample_time)) for run in likelihood.runs(noise)
            ]
        except (InputError, NumericalError):
            return float(np.inf)
        return sum(float(m @ m) for m in missed)

    def _tried(self, start: Plant) -> Hypothesis | None:
        """Return where a few iterations from `start` lead, beside the noise that suits it."""
        try:
            return self._likelihood.tried(self._held(start), None, FEW)
        except (InputError, NumericalError):
            return None

    def _held(self, start: Plant) -> Plant:
        """Return `start` with parameters that are held as they are given."""
        return start.with_named({n: v for n, v in self._given.named.items() if n in self._options.held})


def _contacts_of(effect: Effect, trial: Plant) -> Plant:
    """Return `trial` with those parameters of its last effect as given that are not fitted where they are usual."""
    usual = [spec.name for spec in effect.parameters() if spec.usual is not None]
    return trial.with_effect(replace(trial.effects[-1], **{name: getattr(effect, name) for name in usual}))


def _solved(plant: Plant, screen: Screen) -> list[Plant]:
    """Return `plant` with what the integral equation says, if it says something."""
    try:
        solved, _ = screen.solve(plant.effects)
    except (InputError, NumericalError):
        return []
    return [replace(plant, gain=solved.gain, damping=max(solved.damping, 0.0), effects=solved.effects)]
