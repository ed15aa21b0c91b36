"""Hide an effect, name it: measured axes for any tool to diagnose, and the scorer, both made from a seed.

The records tell nothing of the truth, not even the seed. An answer names, for each case, the effects that the axis has
beside gain and damping; whoever has the seed can score it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from statistics import median
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.decoding import json_of
from servolens.errors import InputError, NumericalError
from servolens.lab.hidden import hidden_campaign
from servolens.lab.laws import LAWS
from servolens.lab.sizes import SIZES
from servolens.lab.worlds import checked_world
from servolens.results import to_text, write_atomically

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from servolens.lab.hidden import HiddenCampaign

__all__ = ["CaseScore", "Score", "challenge_case", "score_answers", "write_challenge"]

HEALTHY, SINGLE = 0.15, 0.7
"""Shares of healthy axes, and of those with one effect at most; the others have two, of different kinds."""
KINDS = (
    (
        "coulomb_friction",
        "asymmetric_friction",
        "stribeck_friction",
        "position_friction",
        "presliding",
        "load_friction",
        "friction_map",
    ),
    ("velocity_decay_damping", "asymmetric_damping", "quadratic_drag"),
    ("return_spring", "hardening_spring", "constant_force", "pendulum_gravity", "cogging", "end_stop"),
    ("periodic_disturbance", "gain_drift"),
    ("dead_zone", "saturation", "force_limit"),
    ("delay", "actuator_lag", "sensor_lag", "speed_servo", "backlash", "flexible_coupling"),
)
SAME = (
    (frozenset({"sensor_lag"}), frozenset({"actuator_lag"})),
    (frozenset({"coulomb_friction", "constant_force"}), frozenset({"asymmetric_friction"})),
)
"""Effects on the left leave the same records as those on the right: of an axis that is linear otherwise; of any."""
MOST_CASES = 10_000
CHANCE = 555
"""Beside the seed, so that what is hidden and the axis it is hidden in are drawn apart."""


def challenge_case(seed: int, number: int, world: str = "white") -> HiddenCampaign:
    """Return a case with its truth.

    Parameters
    ----------
    seed : int
        Of the challenge, at least 0.
    number : int
        Of the case, from 1 on.
    world : str
        What disturbs the measurements, a name of :data:`servolens.lab.WORLDS`.

    Examples
    --------
    >>> from servolens.lab.challenge import challenge_case
    >>> sorted(challenge_case(31, 2).truth.effects)
    ['periodic_disturbance']
    """
    return _case(seed + number - 1, world)


@lru_cache(maxsize=32)
def _case(own: int, world: str) -> HiddenCampaign:
    """Return the case of a seed of its own."""
    dice = np.random.default_rng([CHANCE, own])
    while True:
        try:
            return hidden_campaign(own, effects=_drawn(dice), world=world)
        except NumericalError:
            continue  # no axis of this seed stays sane with these: others are hidden


def _drawn(dice: np.random.Generator) -> list[str]:
    """Return what is hidden."""
    share = dice.random()
    kinds = dice.permutation(len(KINDS))[: 0 if share < HEALTHY else 1 if share < SINGLE else 2]
    names = [str(dice.choice(KINDS[kind])) for kind in kinds]
    return names if len(_told(names)) == len(names) else _drawn(dice)


def write_challenge(folder: Path, seed: int, cases: int, world: str = "white") -> None:
    """Write the records of a challenge: a folder for each case, and what may be answered into ``challenge.json``.

    Parameters
    ----------
    folder : Path
        Created where it is missing; must be empty.
    seed : int
        At least 0; stays with the scorer.
    cases : int
        How many, 1 to 10 000.
    world : str
        A name of :data:`servolens.lab.WORLDS`.

    Raises
    ------
    InputError
        If a number or the world is not admissible, or the folder is not empty or cannot be written.
    """
    _check(seed, cases, world)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = any(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({(error.strerror or 'unknown error').lower()})") from None
    if taken:
        raise InputError(f"{folder}: is not empty; give a new folder")
    names = [_name(number) for number in range(1, cases + 1)]
    for number, name in enumerate(names, 1):
        campaign = challenge_case(seed, number, world)
        own = folder / name
        own.mkdir()
        for kind, records in (("run", campaign.records), ("heldout", campaign.heldout)):
            for i, record in enumerate(records, 1):
                record.with_({"name": f"{kind}-{i}"}).to_csv(own / f"{kind}-{i}.csv")
    known = {effect: sorted(LAWS[effect].parameters.keys() - LAWS[effect].usual.keys()) for effect in sorted(SIZES)}
    told = {"schema": "servolens.challenge/1", "world": world, "cases": names, "effects": known}
    write_atomically(folder / "challenge.json", to_text(told).encode("ascii"))


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class CaseScore:
    """What was hidden in a case and what was named.

    Attributes
    ----------
    hidden, named : tuple of str
        Sorted.
    size_errors : tuple of float
        Relative errors of the parameters that were answered of effects that were hidden; phases are left out.
    """

    hidden: tuple[str, ...]
    named: tuple[str, ...]
    size_errors: tuple[float, ...] = ()

    @property
    def is_right(self) -> bool:
        """Whether everything hidden was named and nothing else, or what leaves the same records."""
        return _told(self.hidden) == _told(self.named)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """What answers are worth.

    Attributes
    ----------
    cases : mapping of str to CaseScore
        By the name of the case.
    """

    cases: Mapping[str, CaseScore] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return counts and cases: JSON of schema ``servolens.challenge-score/1``.

        ``right`` are cases answered exactly; ``found`` hidden effects that were named; ``false`` effects that
        were named and not hidden; ``alarms`` healthy axes of which something was named.
        """
        scores = list(self.cases.values())
        told = [(_told(score.hidden), _told(score.named)) for score in scores]
        errors = [error for score in scores for error in score.size_errors]
        return {
            "schema": "servolens.challenge-score/1",
            "cases": len(scores),
            "right": sum(score.is_right for score in scores),
            "hidden": sum(len(hidden) for hidden, _ in told),
            "found": sum(len(hidden & named) for hidden, named in told),
            "false": sum(len(named - hidden) for hidden, named in told),
            "healthy": sum(not hidden for hidden, _ in told),
            "alarms": sum(bool(named) and not hidden for hidden, named in told),
            "size_error": median(errors) if errors else None,
            "each": {
                name: {"hidden": list(score.hidden), "named": list(score.named), "right": score.is_right}
                for name, score in self.cases.items()
            },
        }


def score_answers(
    answers: Mapping[str, Any] | str | os.PathLike[str], seed: int, *, cases: int | None = None, world: str = "white"
) -> Score:
    """Compare answers with what was hidden.

    Parameters
    ----------
    answers : mapping, or path of a JSON file
        Name of each case → names of effects, or → mapping of effect to its parameters, SI, where sizes were found.
    seed : int
        That the challenge was made from.
    cases : int, optional
        How many it has: those without an answer count as answered with nothing. By default those answered.
    world : str
        That it was made for.

    Raises
    ------
    InputError
        If the answers are not of that form, or name a case or an effect that there is not.
    """
    given = json_of(answers)
    numbers = {name: _number(name) for name in given}
    _check(seed, cases or max(numbers.values(), default=1), world)
    if cases is not None:
        numbers = {**{_name(number): number for number in range(1, cases + 1)}, **numbers}
    if cases is not None and len(numbers) > cases:
        raise InputError(f"{max(numbers, key=numbers.__getitem__)}: the challenge has {cases} cases only")
    ordered = sorted(numbers.items(), key=lambda one: one[1])
    return Score(cases={name: _scored(name, given.get(name, ()), seed, number, world) for name, number in ordered})


def _scored(name: str, answer: Any, seed: int, number: int, world: str) -> CaseScore:
    named = answer if isinstance(answer, dict) else {effect: {} for effect in _listed(name, answer)}
    for effect, sizes in named.items():
        if effect not in SIZES:
            raise InputError(f"{name}: no effect {str(effect)[:40]!r}; there are {', '.join(sorted(SIZES))}")
        if not isinstance(sizes, dict) or not all(type(size) in (int, float) for size in sizes.values()):
            raise InputError(f"{name}: {effect} needs an object of parameters and numbers")
    truth = challenge_case(seed, number, world).truth.effects
    errors = [
        abs(abs(float(sizes[parameter])) - abs(true)) / abs(true)
        for effect, sizes in named.items()
        for parameter, true in truth.get(effect, {}).items()
        if parameter in sizes and parameter != "phase" and true
    ]
    return CaseScore(hidden=tuple(sorted(truth)), named=tuple(sorted(named)), size_errors=tuple(errors))


def _listed(name: str, answer: Any) -> Iterable[str]:
    if not isinstance(answer, list | tuple) or not all(isinstance(effect, str) for effect in answer):
        raise InputError(f"{name}: the answer must be a list of effects, or an object of effects and parameters")
    return answer


def _told(names: Sequence[str] | Iterable[str]) -> frozenset[str]:
    """Return the names, those that leave the same records by one name."""
    told = frozenset(names)
    for alike, name in SAME:
        if alike <= told:
            told = (told - alike) | name
    return told


def _name(number: int) -> str:
    return f"case-{number:03d}"


def _number(name: str) -> int:
    found = re.fullmatch(r"case-(\d{3,5})", name)
    if found is None or _name(int(found[1])) != name or int(found[1]) == 0:
        raise InputError(f"{name[:40]!r} names no case; they are case-001, case-002 …")
    return int(found[1])


def _check(seed: int, cases: int, world: str) -> None:
    checked_world(world)
    if seed < 0:
        raise InputError(f"the seed must be at least 0, got {seed}")
    if not 1 <= cases <= MOST_CASES:
        raise InputError(f"a challenge has 1 to {MOST_CASES} cases, got {cases}")
