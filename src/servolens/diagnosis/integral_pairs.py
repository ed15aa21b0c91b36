"""Two effects of which neither shows alone: what they leave of the integral equation together."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.ordering import kind
from servolens.effects import Actuator, TimeShift, catalogue
from servolens.errors import InputError, NumericalError
from servolens.identification.regressors import regressor
from servolens.processors import in_processes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from servolens.effects import Effect, Seen
    from servolens.identification.ranking import Proposals
    from servolens.identification.starting import Screen
    from servolens.plant import Plant

    Proposed = Callable[[Plant, type[Effect]], Proposals]

__all__ = ["beside_a_force", "best_pairs", "needed", "shapes", "sized"]


def best_pairs(screen: Screen, seen: Seen, plant: Plant, proposed: Proposed, most: int) -> list[Plant]:
    """Return `plant` with two effects that leave least of the integral equation, one pair of each kind, the best first.

    Two forces, at least one without a shape parameter, as dry friction or a spring: while it is missing, the shape of
    the other, such as a pitch, does not show. Or a force together with what changes the command on its way, such as a
    dead zone, which does not show while the force that the command holds is missing. In order of the Bayesian
    information criterion, what is left taken for white.

    Parameters
    ----------
    screen : Screen
        Of the records.
    seen : Seen
        What they show.
    plant : Plant
        Gain and damping alone.
    proposed : callable
        Gives the proposals of a force.
    most : int
        How many pairs of forces, and half as many with an actuator for each of both kinds of forces: a wave takes up a
        part of whatever is left, and would take the place of others.
    """
    forces, plain = _forces(plant), _plain(plant)
    shaped = [cls for cls in forces if cls not in plain]
    actuators: list[type[Effect]] = [cls for cls in catalogue().values() if issubclass(cls, Actuator | TimeShift)]
    best: list[Plant] = []
    kinds = (plain, forces, most), (actuators, plain, most // 2), (actuators, shaped, most // 2)
    jobs = [(i, first) for i, (firsts, _, _) in enumerate(kinds) for first in firsts]
    found = in_processes(lambda job: [*_scored(screen, seen, plant, proposed, job[1], kinds[job[0]][:2])], jobs)
    for i, (_, _, count) in enumerate(kinds):
        scored = [each for job, several in zip(jobs, found, strict=True) if job[0] == i for each in several]
        scored.sort(key=lambda each: each[0])
        best += _first_of_each_kind(screen, seen, [both for _, both in scored], count)
    return best


def beside_a_force(screen: Screen, plant: Plant) -> list[Plant]:
    """Return gain and damping as they are beside one force each in the integral equation, the best first.

    Otherwise the voltage that holds the axis against a force, such as a spring, looks as if it pushed the axis the
    other way, and the gain comes out negative.
    """
    found = []
    for cls in _plain(plant):
        with suppress(InputError, NumericalError):
            for effect in screen.proposals_of(plant, cls)[:1]:
                solved, left = screen.solve((effect,))
                if solved.gain > 0.0 and solved.damping >= 0.0:
                    found.append((left, replace(plant, gain=solved.gain, damping=solved.damping)))
    return [one for _, one in sorted(found, key=lambda each: each[0])]


def sized(screen: Screen, plant: Plant) -> Plant:
    """Return `plant` with gain, damping and sizes that solve the integral equation.

    Raises
    ------
    InputError, NumericalError
        If they make no plant, or the records do not determine them.
    """
    solved, _ = screen.solve(plant.effects)
    return replace(plant, gain=solved.gain, damping=max(solved.damping, 0.0), effects=solved.effects)


def shapes(cls: type[Effect]) -> set[str]:
    """Return the parameters in which a force is not linear, which are searched for; the phase of a wave is none."""
    return set(regressor(cls).shapes) - set(cls.wave or ())


def needed(cls: type[Effect]) -> int:
    """Return how many parameters of an effect have no usual value."""
    return sum(spec.usual is None for spec in cls.parameters())


def _forces(plant: Plant) -> list[type[Effect]]:
    """Return the forces whose sizes the integral equation solves for, without last resorts."""
    forces = [cls for cls in catalogue().values() if regressor(cls).sizes and not cls.is_last_resort]
    return [cls for cls in forces if plant.length_unit == "rad" or not cls.is_rotary]


def _plain(plant: Plant) -> list[type[Effect]]:
    """Return those of them that have no shape to be searched for."""
    return [cls for cls in _forces(plant) if not shapes(cls)]


def _first_of_each_kind(screen: Screen, seen: Seen, pairs: Sequence[Plant], most: int) -> list[Plant]:
    """Return the first of each kind of pair, solved for, of those that the records may show."""
    best: dict[frozenset[str], Plant] = {}
    for both in pairs:
        if len(best) < most and kind(both.effects) not in best:
            with suppress(InputError, NumericalError):
                solved = sized(screen, both)
                if all(effect.is_whole(seen) and not effect.absent for effect in solved.effects):
                    best[kind(both.effects)] = solved
    return list(best.values())


def _scored(
    screen: Screen,
    seen: Seen,
    plant: Plant,
    proposed: Proposed,
    first: type[Effect],
    kinds: tuple[list[type[Effect]], list[type[Effect]]],
) -> Iterator[tuple[float, Plant]]:
    """Yield the criterion and `plant` with each pair of `first`, of the first kinds, and a force of the second ones."""
    samples = screen.thinned.time.size
    is_force = bool(regressor(first).sizes)
    starts = screen.proposals_of(plant, first)
    starts = starts[:1] if is_force else [start for start in starts if start.is_whole(seen)]
    for one, second in product(starts, kinds[1]):
        if kind([first]) & kind([second]) or (second in kinds[0] and first.name > second.name):
            continue
        with suppress(InputError, NumericalError):  # two that do not go together
            proposals = proposed(plant, second)
            lefts = zip(screen.left((one,), proposals).tolist(), proposals.effects, strict=True)
            whole = [(left, other) for left, other in lefts if other.is_whole(seen)]
            for left, other in sorted(whole, key=lambda each: each[0])[:1]:
                paid = np.log(samples) * (_sizes(screen, first) + _sizes(screen, second))
                yield samples * np.log(max(left, 1e-300)) + paid, plant.with_effect(one).with_effect(other)


def _sizes(screen: Screen, cls: type[Effect]) -> int:
    """Return the parameters that have no usual value, a wave of each record's own counted for each."""
    return needed(cls) + (2 * (screen.records - 1) if cls.phase_per_record else 0)
