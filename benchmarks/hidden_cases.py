"""The cases of the study of diagnoses: what is hidden in each, and what a diagnosis made of it.

Of a diagnosis only what users rely on is read: its verdict, and of each cause its effect, confidence, rivals and
quantities.
"""

from __future__ import annotations

import math
import signal
import time
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from harness import processor_time
from judging import judged_parameters

from servolens.effects import CATALOGUE
from servolens.lab import FOREIGN, WORLDS, HiddenCampaign, hidden_campaign
from servolens.lab.laws import LAWS

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["BASES", "MAIN", "SECTIONS", "Case", "Found", "Outcome", "Section", "cases", "hide", "judged", "run"]

BASES = {"development": 700_000, "final": 900_000}
"""First seeds: what is tuned on the one kind is judged on the other."""
EACH_SECTION, EACH_ROW = 10_000, 100
"""Seeds that a section has, and one row of its table, before the next ones are `EACH_ROUND` further."""
EACH_ROUND = 1_000_000
SINGLES = tuple((name,) for name in sorted(LAWS))
PARTNERS = {
    "asymmetric_damping": ("return_spring",),
    "asymmetric_friction": ("actuator_lag", "hardening_spring", "delay"),
    "backlash": ("constant_force",),
    "cogging": ("actuator_lag",),
    "coulomb_friction": (
        "delay", "constant_force", "saturation", "cogging", "backlash", "flexible_coupling", "return_spring",
        "sensor_lag", "gain_drift", "quadratic_drag", "force_limit", "speed_servo",
    ),
    "dead_zone": ("return_spring", "flexible_coupling", "periodic_disturbance"),
    "pendulum_gravity": ("quadratic_drag",),
    "position_friction": ("delay",),
    "presliding": ("gain_drift",),
    "stribeck_friction": ("delay", "return_spring", "pendulum_gravity"),
    "velocity_decay_damping": ("delay", "constant_force", "saturation"),
    "load_friction": ("pendulum_gravity", "delay"),
    "end_stop": ("coulomb_friction",),
    "friction_map": ("actuator_lag",),
}  # fmt: skip
PAIRS = tuple((one, other) for one, others in PARTNERS.items() for other in others)
"""Pairs of different kinds."""
TRIPLES = (
    ("coulomb_friction", "delay", "constant_force"),
    ("coulomb_friction", "cogging", "actuator_lag"),
    ("stribeck_friction", "saturation", "delay"),
    ("asymmetric_friction", "return_spring", "delay"),
    ("velocity_decay_damping", "delay", "constant_force"),
    ("coulomb_friction", "flexible_coupling", "gain_drift"),
    ("dead_zone", "quadratic_drag", "periodic_disturbance"),
    ("coulomb_friction", "backlash", "return_spring"),
)
SMALL = (1.5, 2.0, 3.0, 4.0)
"""Visibilities of the small effects, one a repetition in turn."""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the study: how often each row of its table is done, what is hidden, what else is asked of campaigns."""

    seeds: int
    table: tuple[tuple[str, ...], ...]
    asked: dict[str, Any] = field(default_factory=dict)
    only_white: bool = True


SECTIONS = {
    "singles": Section(4, SINGLES, only_white=False),
    "pairs": Section(2, PAIRS, only_white=False),
    "triples": Section(4, TRIPLES),
    "healthy": Section(100, ((),), only_white=False),
    "foreign": Section(2, tuple((name,) for name in sorted(FOREIGN)), only_white=False),
    "small": Section(2, SINGLES),
    "low_noise": Section(1, SINGLES, {"noise": "low"}),
    "medium_noise": Section(1, SINGLES, {"noise": "medium"}),
    "high_noise": Section(1, SINGLES, {"noise": "high"}),
    "one_record": Section(1, SINGLES, {"records": 1, "heldout": 0}),
    "no_voltage": Section(1, SINGLES, {"log_voltage": False}),
    "no_reference": Section(1, SINGLES, {"log_reference": False}),
    "smooth": Section(1, SINGLES, {"smooth": True}),
}
MAIN = ("singles", "pairs", "triples", "healthy", "foreign")
"""Sections that are run unless others are asked for."""


@dataclass(frozen=True, slots=True)
class Case:
    """One campaign of the study; ``str(case)`` names it on the command line and in the file of results."""

    world: str
    section: str
    hidden: tuple[str, ...]
    seed: int

    def __str__(self) -> str:
        return f"{self.world}:{self.section}:{'+'.join(self.hidden) or 'nothing'}:{self.seed}"

    @classmethod
    def parse(cls, text: str) -> Case:
        """Return the case of its name."""
        parts = text.split(":")
        if len(parts) != 4 or parts[0] not in WORLDS or parts[1] not in SECTIONS:
            raise SystemExit(f"{text!r} names no case; an example is white:singles:delay:700900")
        world, section, name, seed = parts
        return cls(world, section, () if name == "nothing" else tuple(name.split("+")), int(seed))

    @property
    def kind(self) -> str:
        """Whether the seed is one for development or a final one."""
        first = min(BASES.values())
        place = first + (self.seed - first) % EACH_ROUND
        return max((base, name) for name, base in BASES.items() if place >= base)[1]


@dataclass(frozen=True, slots=True)
class Found:
    """A cause that was named.

    Attributes
    ----------
    effect : str
    confidence : float
    rivals : tuple of str
    errors : dict of str to float
        Relative error of each parameter, where the effect was hidden; of a phase in rad.
    held : dict of str to bool or None
        Whether its 95 % interval holds the truth; None where there is no interval.
    """

    effect: str
    confidence: float
    rivals: tuple[str, ...] = ()
    errors: dict[str, float] = field(default_factory=dict)
    held: dict[str, bool | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a diagnosis made of a case.

    Attributes
    ----------
    verdict : str
        ``"failed"`` or ``"out of time"`` where there is none; then `said` is the reason.
    causes : tuple of Found
    visibility : float
    seconds, cpu : float
        Of the diagnosis: on the clock, and of the process.
    """

    case: Case
    verdict: str
    causes: tuple[Found, ...] = ()
    visibility: float = math.nan
    seconds: float = 0.0
    cpu: float = 0.0
    said: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields, the case as its name."""
        visibility = None if math.isnan(self.visibility) else self.visibility
        return {**asdict(self), "case": str(self.case), "visibility": visibility}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Outcome:
        """Return the outcome of its fields."""
        causes = tuple(Found(**{**cause, "rivals": tuple(cause["rivals"])}) for cause in data["causes"])
        visibility = math.nan if data["visibility"] is None else data["visibility"]
        return cls(**{**data, "case": Case.parse(data["case"]), "causes": causes, "visibility": visibility})

    @property
    def names(self) -> tuple[str, ...]:
        """The effects that were named."""
        return tuple(cause.effect for cause in self.causes)

    @property
    def first(self) -> float:
        """1 if the first cause was hidden, a half if something hidden is among its rivals, else 0."""
        if not self.causes:
            return 0.0
        if self.causes[0].effect in self.case.hidden:
            return 1.0
        return 0.5 if set(self.causes[0].rivals) & set(self.case.hidden) else 0.0

    @property
    def all_named(self) -> float:
        """1 if everything hidden is a cause, a half if some of it is a rival only, else 0."""
        hidden = set(self.case.hidden)
        if hidden <= set(self.names):
            return 1.0
        rivals = {name for cause in self.causes for rival in cause.rivals for name in rival.split(" + ")}
        return 0.5 if hidden <= set(self.names) | rivals else 0.0

    @property
    def kin(self) -> tuple[str, ...]:
        """Effects of the catalogue that have the structure of the foreign law that was hidden."""
        return FOREIGN[self.case.hidden[0]].same_as if self.case.section == "foreign" else ()

    def is_right(self, cause: Found) -> bool:
        """Tell whether a cause was hidden, or has the structure of what was."""
        return cause.effect in self.case.hidden or cause.effect in self.kin

    @property
    def right(self) -> bool:
        """Whether the diagnosis is what one may expect of it."""
        if self.verdict in ("failed", "out of time"):
            return False
        match self.case.section:
            case "healthy":
                return self.verdict == "healthy" and not self.causes
            case "foreign":
                return self.verdict != "explained" or all(self.is_right(cause) for cause in self.causes)
            case "small":
                return not self.causes or self.all_named > 0
        return self.all_named == 1.0 and len(self.causes) == len(self.case.hidden)


def cases(
    worlds: Sequence[str], sections: Sequence[str], effects: Sequence[str], seeds: int | None, first: int, kind: str
) -> list[Case]:
    """Return the cases of some sections in some worlds, those that hide one of `effects` only, if any are given.

    Each row of a section is done with `seeds` seeds, the first of which has the number `first`. The same seeds are
    used in every world: the axes are the same.
    """
    chosen = []
    for world in worlds:
        for number, (name, section) in enumerate(SECTIONS.items()):
            if name not in sections or (section.only_white and world != "white"):
                continue
            count = section.seeds if seeds is None else seeds
            room = EACH_SECTION if len(section.table) == 1 else EACH_ROW
            for i, hidden in enumerate(section.table):
                known = all(part in CATALOGUE or part in FOREIGN for part in hidden)
                if known and (not effects or set(effects) & set(hidden)):
                    base = BASES[kind] + number * EACH_SECTION + i * EACH_ROW
                    numbers = [EACH_ROUND * (k // room) + k % room for k in range(first, first + count)]
                    chosen += [Case(world, name, hidden, base + k) for k in numbers]
    return chosen


def hide(case: Case) -> HiddenCampaign:
    """Return the campaign of a case."""
    asked = {**SECTIONS[case.section].asked, "world": case.world}
    if case.section == "small":
        asked["visibility"] = SMALL[case.seed % len(SMALL)]
    if case.section == "foreign":
        return hidden_campaign(case.seed, foreign=case.hidden[0], **asked)
    return hidden_campaign(case.seed, effects=case.hidden, **asked)


def run(case: Case, limit: float = math.inf) -> Outcome:
    """Diagnose a case, for `limit` seconds at most."""
    from servolens import diagnose

    wall, cpu = time.perf_counter(), processor_time()

    def spent() -> dict[str, float]:
        return {"seconds": round(time.perf_counter() - wall, 3), "cpu": round(processor_time() - cpu, 3)}

    try:
        campaign = hide(case)
        wall, cpu = time.perf_counter(), processor_time()
        with _Alarm(limit):
            found = diagnose(campaign.records, heldout=campaign.heldout)
    except _OutOfTimeError:
        return Outcome(case, "out of time", said=f"stopped after {limit:g} s", **spent())
    except Exception as failure:  # whatever one case does, the study goes on and says which it was
        return Outcome(case, "failed", said=f"{type(failure).__name__}: {failure}", **spent())
    return judged(case, campaign, found, **spent())


def judged(case: Case, campaign: HiddenCampaign, found: Any, seconds: float, cpu: float) -> Outcome:
    """Compare a diagnosis with what was hidden."""
    causes = tuple(_judged_cause(campaign, cause) for cause in found.causes)
    return Outcome(case, found.verdict, causes, campaign.visibility, seconds, cpu)


def _judged_cause(campaign: HiddenCampaign, cause: Any) -> Found:
    truth = campaign.truth.effects.get(cause.effect, {})
    errors, held = judged_parameters(cause.effect, truth, cause.quantities)
    confidence = math.nan if cause.confidence is None else float(cause.confidence)
    return Found(cause.effect, round(confidence, 6), tuple(str(rival) for rival in cause.rivals), errors, held)


class _OutOfTimeError(BaseException):
    """Not an Exception: whoever catches those must not catch this."""


class _Alarm:
    """Stop what is done within after so many seconds."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds if math.isfinite(seconds) else 0.0

    def __enter__(self) -> None:
        if self._seconds:
            self._before = signal.signal(signal.SIGALRM, self._stop)
            signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def __exit__(self, *_: object) -> None:
        if self._seconds:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._before)

    @staticmethod
    def _stop(*_: object) -> None:
        raise _OutOfTimeError
