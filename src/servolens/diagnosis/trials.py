"""Training records made ready to try many hypotheses, and where the fit of each effect begins."""

from __future__ import annotations

from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.effort import work_for
from servolens.diagnosis.integral_pairs import beside_a_force, best_pairs, needed, shapes, sized
from servolens.diagnosis.ordering import by_total
from servolens.effects import CoulombFriction, Drive, DryFriction, Transmission, catalogue, effect_class
from servolens.errors import InputError, NumericalError
from servolens.identification.hypothesis import NO_BETTER
from servolens.identification.likelihood import FEW, Likelihood
from servolens.identification.options import FitOptions
from servolens.identification.regressors import regressor
from servolens.identification.score import FALSE_ALARM, PERTURBED
from servolens.identification.segments import applied_voltage, motion_segments, moving_parts, parts
from servolens.identification.smoothing import smooth
from servolens.identification.starting import Screen, seen_in
from servolens.processors import in_processes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.effects import Effect, Seen
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.options import Prior
    from servolens.identification.ranking import Proposals
    from servolens.identification.score import ScoreTest
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Start", "Trials", "special_first", "starts_to_fit"]

HELD_SHARE = 0.5
"""Share of the standing command that is a first guess of dry friction where another force acts as well."""
STANDS = 0.01
"""Share of the top speed below which the axis stands."""
STARTS = 3
"""Proposals of an effect, ranked in the integral equation, that are simulated."""
STARTED = 2
"""Starts of an effect with a shape, from which it is fitted, beside what the effect itself proposes first."""
STOPS = 2.0
"""Times the motor's largest acceleration from which on dry friction holds the axis: that moves it, and stops it."""
CONTRADICTS = 4.0
"""Standard deviations of a prior from which on a parameter contradicts it: once in 16 000 of normal ones."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """An effect beside a hypothesis, from where its fit begins, and the score test for it.

    Attributes
    ----------
    plant : Plant
        With the effect.
    gain : float
        By how much −2 log-likelihood falls to first order, all sizes free: the score statistic.
    is_guess : bool
        Whether it is what the effect, or the integral equation, proposes first, or far from all others.
    """

    plant: Plant
    gain: float
    is_guess: bool = False

    @property
    def effect(self) -> str:
        """Name of the effect that was added."""
        return self.plant.effects[-1].name


@final
class Trials:
    """Training records made ready to try many hypotheses.

    Parameters
    ----------
    records : sequence of Record
        Runs of the same axis, each with its voltage or with what it is computed from.
    priors : mapping of str to Prior
        Knowledge from elsewhere, by qualified parameter name.
    candidates : int
        Effects that are tried, for the price of each.
    """

    def __init__(self, records: Sequence[Record], priors: Mapping[str, Prior], candidates: int) -> None:
        self.priors, self.candidates = priors, candidates
        self.screen = Screen.of(moving_parts(motion_segments(records)))
        bare, _ = self.screen.solve(())
        self.bare = replace(bare, damping=max(bare.damping, 0.0))
        self.seen = seen_in(self.screen.segments, self.bare)
        known = priors["gain"].value if "gain" in priors else self.bare.gain
        self.likelihood = Likelihood(
            records,
            replace(self.bare, gain=known),
            FitOptions(priors=priors, bounds={name: _range(prior) for name, prior in priors.items()}),
            # neither refers to the trials: they would hold each other in memory
            price=partial(_entry_prices, candidates),
            is_admissible=partial(_is_admissible, priors, self.seen),
        )
        self.standing = _standing_command(records)
        self._proposals: dict[str, Proposals] = {}
        self._pairs: dict[int, list[Plant]] = {}
        self._observed: Plant | None = None

    def simulating(self) -> Trials:
        """Return the trials by simulations in closed loop, for models that are known not to be the axis."""
        other = copy(self)
        other.likelihood = self.likelihood.simulating()
        return other

    def unshaken(self) -> Trials:
        """Return the trials of an axis that nothing shakes."""
        other = copy(self)
        other.likelihood = self.likelihood.unshaken()
        return other

    def shaken(self) -> Trials:
        """Return the trials of an axis that something shakes, whatever else it lacks."""
        other = copy(self)
        other.likelihood = self.likelihood.shaken()
        return other

    def base(self) -> Hypothesis:
        """Return gain and damping alone.

        Raises
        ------
        NumericalError
            If no start can be simulated.
        """
        bare, judged = self.bare, self.likelihood.judged
        others = [replace(bare, gain=s * bare.gain) for s in (0.5, 2.0)]
        first = replace(bare, gain=self.priors["gain"].value) if "gain" in self.priors else bare
        begun = [first, *beside_a_force(self.screen, bare)[:1]] if first.gain <= 0.0 else [first]
        found = min((h for h in map(judged, begun) if h), key=by_total, default=None)
        found = found or next((h for h in map(judged, [bare, *others]) if h), None)
        if found is None:
            raise NumericalError("gain and damping alone cannot be simulated on these records; check sign and units")
        self._observed = found.plant if found.noise.rate > 0.0 else self._observed
        return found

    def observed(self, base: Hypothesis) -> Hypothesis:
        """Return gain and damping as an observer tells them where those of `base` run away to what no sample shows.

        There no score tells of a cause, and so fast a plant takes long to simulate. Else `base`.
        """
        observed = self._observed
        if observed is None or self.shows_time_constant(base.plant) or not self.shows_time_constant(observed):
            return base
        return self.likelihood.tried(observed, None, 0) or base

    def shows_time_constant(self, plant: Plant) -> bool:
        """Tell whether samples show the time constant of gain and damping: it is at least one sample time."""
        return _is_shown(plant, self.seen)

    def price(self, cls: type[Effect]) -> float:
        """Return by how much −2 log-likelihood must fall for an effect to enter."""
        return _entry_price(needed(cls), self.candidates, self.likelihood.counted)

    def starts_of_each(self, test: ScoreTest, names: Sequence[str]) -> list[list[Start]]:
        """Return where fits of each of the effects begin beside the hypothesis of `test`, the likeliest effect first.

        See :meth:`starts`. Effects of which there are none are left out.
        """
        plant = test.hypothesis.plant
        for cls in map(effect_class, names):
            if regressor(cls).sizes and not plant.effects:
                with suppress(InputError, NumericalError):
                    self._proposals_of(plant, cls)  # made here, all jobs have it
        found = in_processes(
            partial(self.starts, test), names, self.likelihood.tally, lambda name: len(effect_class(name).states)
        )
        return sorted((starts for starts in found if starts), key=lambda starts: -starts[0].gain)

    def starts(self, test: ScoreTest, name: str) -> list[Start]:
        """Return where fits of the effect `name` beside the hypothesis of `test` begin, the likeliest first.

        Of each shape one, such as a pitch, before any has a second one, which differs in size only. None where the two
        do not go together.
        """
        plant, cls = test.hypothesis.plant, effect_class(name)
        if any(name in type(effect).generalises or effect.name == name for effect in plant.effects):
            return []
        if cls.is_rotary and plant.length_unit != "rad":
            return []
        parts = [effect for effect in plant.effects if effect.name in cls.generalises]
        for special in cls.generalises:
            plant = plant.without_effect(special)
        try:
            is_biased = bool(plant.effects) and test.hypothesis.noise.rate > 0.0
            tried, free = self._proposed(plant, cls, is_biased=is_biased), self._free(plant, cls)
        except (InputError, NumericalError):
            return []
        if self._observed is not None and not plant.effects and test.hypothesis.noise.rate == 0.0:
            with suppress(InputError, NumericalError):
                tried += self._proposed(self._observed, cls)
        whole = (p for p in tried if p.effects[-1].is_whole(self.seen) and not self.likelihood.is_too_stiff(p))
        far = [*free, *_swapped(plant, cls, self.likelihood.rate)]
        found = [Start(p, test.gain(p), place == 0) for place, p in enumerate(whole)]
        found += [Start(p, test.gain(p), is_guess=True) for p in far if not self.likelihood.is_too_stiff(p)]
        for general in cls.generalised(parts, self.seen) if parts else ():
            same = plant.with_effect(general)
            found.append(Start(same, test.gain_of_sizes(same, regressor(cls).sizes)))
        return _of_each_shape(sorted(found, key=lambda start: -start.gain))

    def begun(self, starts: Sequence[Start], hypothesis: Hypothesis, allowance: float) -> Hypothesis | None:
        """Return where the best `starts` of one effect beside `hypothesis` lead in a few iterations; None if nowhere.

        The likeliest first, each with what it may need of what is left: a descent that is cut short says nothing.
        """
        led, likelihood, left = [], self.likelihood, allowance
        noise, unpowered = hypothesis.noise, hypothesis.unpowered
        for place, start in enumerate(starts):
            if place and left < work_for(likelihood, start.plant, 1):
                break
            share = min(work_for(likelihood, start.plant, FEW), left)
            led.append(likelihood.tried(start.plant, noise, FEW, like=hypothesis, unpowered=unpowered, allowance=share))
            left -= share
        return min((h for h in led if h), key=lambda h: round(h.total / NO_BETTER), default=None)  # of equals the first

    def _proposed(self, plant: Plant, cls: type[Effect], *, is_biased: bool = False) -> list[Plant]:
        """Return the plants with the effect that the integral equation, or the effect itself, proposes.

        What shakes the axis biases that equation, and what it finds to be none may be something.
        """
        if regressor(cls).sizes:
            return self._solved(plant, cls, is_biased)
        tried = [plant.with_effect(effect) for effect in self.screen.proposals_of(plant, cls)]
        if issubclass(cls, Drive):  # its own loop takes over most of what seemed damping, or so much as it is
            own = [(start, drive) for start in tried if isinstance(drive := start.effects[-1], Drive)]
            tried += [replace(start, damping=0.2 * plant.damping) for start in tried]
            tried += [replace(s, damping=plant.damping - d.damping) for s, d in own if d.damping < plant.damping]
        return tried

    def _free(self, plant: Plant, cls: type[Effect]) -> list[Plant]:
        """Return the plants that the integral equation finds where the axis runs free of what the effect proposes.

        With that, and whole: what hardly acts is no worse a guess for explaining little so far.
        """
        proposals = [] if regressor(cls).sizes else self.screen.proposals_of(plant, cls)
        found = [free.with_effect(effect) for effect in proposals if (free := self._free_of(plant, effect))]
        return [one for one in found if one.effects[-1].is_whole(self.seen)]

    def _free_of(self, plant: Plant, effect: Effect) -> Plant | None:
        """Return `plant` as the integral equation finds it where the axis runs free of `effect`; else None."""
        free = []
        for segment in self.screen.segments:
            is_free = effect.is_free(segment.position, self.seen)
            if is_free is None:
                return None
            free += parts(segment, is_free)
        try:
            return Screen.of(free).solve(plant.effects)[0] if free else None
        except (InputError, NumericalError):
            return None

    def hidden_beside_friction(self, plant: Plant) -> dict[type[Effect], list[Plant]]:
        """Return an axis like `plant` with Coulomb friction and a drive or a transmission, where fits of each begin.

        A drive sets gain and damping by its own loop, and in a transmission a load moves by itself: friction hides it.
        Friction that the integral equation does not show beside them begins at half of what holds the axis at rest:
        from none a fit hardly finds it, for where it holds nothing it has no slope.
        """
        try:
            friction = tuple(self.screen.proposals_of(plant, CoulombFriction)[:1])
            rubbing = sized(self.screen, replace(plant, effects=friction))
        except (InputError, NumericalError):
            return {}
        if rubbing.gain <= 0.0 < plant.gain:  # what holds the axis was taken for what moves it
            rubbing = replace(rubbing, gain=plant.gain, damping=plant.damping)
        if rubbing.effects[-1].absent:
            standing = self._standing(replace(rubbing, effects=()), CoulombFriction, [rubbing])
            if not standing:
                return {}
            rubbing = standing[-1]
        found: dict[type[Effect], list[Plant]] = {}
        for cls in catalogue().values():
            if issubclass(cls, Drive | Transmission):
                with suppress(InputError, NumericalError):
                    starts = self._proposed(rubbing, cls)
                    found[cls] = [start for start in starts if not self.likelihood.is_too_stiff(start)]
        return found

    def pairs(self, most: int) -> list[Plant]:
        """Return the plants with two effects that leave least of the integral equation, the best first; made once."""
        if most not in self._pairs:
            self._pairs[most] = best_pairs(self.screen, self.seen, self.bare, self._proposals_of, most)
        return self._pairs[most]

    def _proposals_of(self, plant: Plant, cls: type[Effect]) -> Proposals:
        """Return the forces of a class that the integral equation may rank; made once."""
        if cls.name not in self._proposals:
            self._proposals[cls.name] = self.screen.thinned.proposals(self.screen.proposals_of(plant, cls))
        return self._proposals[cls.name]

    def _solved(self, plant: Plant, cls: type[Effect], is_biased: bool) -> list[Plant]:
        """Return plants with the likeliest of the proposed forces: beside `plant` as it is, and all solved for.

        One that a biased integral equation does not solve for, or finds to be none, is a slight one beside `plant`.
        """
        proposals, starts = self._proposals_of(plant, cls), []
        solved = self.screen.best(plant.effects, proposals, STARTS)
        for effect in solved or proposals.effects[: int(is_biased)]:
            is_slight = is_biased and (effect.absent or not solved)
            starts.append(plant.with_effect(self.screen.slight(plant, effect, PERTURBED) if is_slight else effect))
            alone = plant.with_effect(effect)
            with suppress(InputError, NumericalError):
                starts.append(sized(self.screen, alone))
        return [*starts, *self._standing(plant, cls, starts)]

    def _standing(self, plant: Plant, cls: type[Effect], starts: Sequence[Plant]) -> list[Plant]:
        """Return plants whose dry friction holds the axis where it stands: its level is read off the standing command.

        An axis that mostly sticks shows little of its friction in motion, and what it shows is biased with the gain;
        one that moves one way only shows none beside a constant force.
        """
        levels = [spec.name for spec in cls.parameters() if spec.name.startswith("level")]
        if not (issubclass(cls, DryFriction) and levels and self.standing > 0.0):
            return []
        shapes = [start.effects[-1] for start in starts] or self.screen.proposals_of(plant, cls)
        if not shapes:
            return []
        effect = shapes[0]
        found = []
        for share in (1.0, HELD_SHARE):
            level = share * abs(plant.gain) * self.standing
            with suppress(InputError):  # a friction that grows with the speed by more than that is less than none
                found.append(plant.with_effect(replace(effect, **dict.fromkeys(levels, level))))
        return found


def starts_to_fit(starts: Sequence[Start]) -> list[Start]:
    """Return those of the `starts` of one effect that are tried: the best, several if it has a shape, and guesses."""
    several = STARTED if len(type(starts[0].plant.effects[-1]).parameters()) > 1 else 1
    return [s for place, s in enumerate(starts) if place < several or s.is_guess]


def special_first(starts: Sequence[list[Start]]) -> list[tuple[int, list[list[Start]]]]:
    """Return the starts of effects in two parts, and how many came before: what generalises others comes second."""
    names = {some[0].effect for some in starts}
    general = [some for some in starts if names & set(effect_class(some[0].effect).generalises)]
    special = [some for some in starts if some not in general]
    return [(0, special), (len(special), general)]


@lru_cache(maxsize=1024)
def _entry_price(parameters: int, candidates: int, samples: float) -> float:
    """Return by how much −2 log-likelihood must fall for an effect to enter.

    The quantile of χ² with as many degrees of freedom as the effect has parameters (Wilks 1938), at the familywise
    error rate shared evenly among the candidates (Bonferroni); for an effect of many parameters the Bayesian
    information criterion asks for more (Schwarz 1978).
    """
    from scipy.stats import chi2

    free = max(parameters, 1)
    entry = float(chi2.isf(FALSE_ALARM / max(candidates, 1), free))
    return max(entry, free * float(np.log(samples)))


def _entry_prices(candidates: int, plant: Plant, samples: float) -> float:
    return sum(_entry_price(effect.unusual, candidates, samples) for effect in plant.effects)


def _is_admissible(priors: Mapping[str, Prior], seen: Seen, plant: Plant) -> bool:
    """Tell whether the records show the effects as a whole, none is nothing, and no prior is contradicted.

    A drive with a loop of its own sets the gain, which no bound of the fit holds then. Dry friction stronger than twice
    all that pushes the axis, once to move it and once to stop it, would hold it; and of a drive nothing is seen where
    gain and damping are fitted with a time constant shorter than a sample.
    """
    values = dict(zip(plant.parameters, plant.values, strict=True))
    fitted = values.keys() - set(plant.usual)
    known = ((values[name], *_range(prior)) for name, prior in priors.items() if name in fitted)
    agrees = all(low <= value <= high for value, low, high in known)
    holds = STOPS * abs(plant.gain) * seen.command
    moves = all(max(_forces(effect), default=0.0) <= holds for effect in plant.effects)
    is_shown = _is_shown(plant, seen) or not any(isinstance(e, Drive) for e in plant.effects)
    return (
        agrees and moves and is_shown and all(effect.is_whole(seen) and not effect.absent for effect in plant.effects)
    )


def _is_shown(plant: Plant, seen: Seen) -> bool:
    """See :meth:`Trials.shows_time_constant`."""
    return plant.damping * seen.sample_time <= 1.0


def _forces(effect: Effect) -> list[float]:
    """Return the levels of a dry friction, or of none."""
    names = [spec.name for spec in effect.parameters() if spec.unit == "{x}/s^2"]
    return [getattr(effect, name) for name in names] if isinstance(effect, DryFriction) else []


def _of_each_shape(starts: Sequence[Start]) -> list[Start]:
    """Return the first of each shape, then the others."""
    first: dict[tuple[float, ...], Start] = {}
    for start in starts:
        effect = start.plant.effects[-1]
        shape = tuple(getattr(effect, name) for name in sorted(shapes(type(effect))))
        first.setdefault(shape, start)
    return [*first.values(), *(start for start in starts if start not in first.values())]


def _range(prior: Prior) -> tuple[float, float]:
    """Return the values that do not contradict a prior; what a model lacks would otherwise outvote a data sheet."""
    reach = CONTRADICTS * prior.deviation
    return prior.value - reach, prior.value + reach


def _standing_command(records: Sequence[Record]) -> float:
    """Return the largest command under which the axis stands: nine tenths of its standing samples have less."""
    commands = []
    for record in records:
        velocity = np.abs(smooth(record.time, record.position, min(41, len(record)))[1])
        commands.append(np.abs(applied_voltage(record))[velocity < STANDS * velocity.max()])
    found = np.concatenate(commands)
    return float(np.quantile(found, 0.9)) if found.size else 0.0


def _swapped(plant: Plant, cls: type[Effect], loop: float) -> list[Plant]:
    """Return plants in which a lag is what seemed to be damping, and the damping is quicker.

    A linear axis is the same with the two exchanged; not so one whose force is limited. The way from here is long.
    Where no damping is left to be seen, the lag is as slow as the `loop` [rad/s].
    """
    if not cls.passes_for_damping or all(effect.linear for effect in plant.effects):
        return []
    found = []
    for rate in (plant.damping,) if plant.damping > 0.1 * loop else (loop, 4.0 * loop):
        lag = cls(**{spec.name: 1.0 / rate for spec in cls.parameters()})
        quicker = ((times * plant.gain, times * rate) for times in (5.0, 50.0))
        found += [replace(plant, gain=gain, damping=damping).with_effect(lag) for gain, damping in quicker]
    return found
