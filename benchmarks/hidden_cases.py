"""The cases of the study of diagnoses: what is hidden in each, and what a diagnosis made of it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

from servolens.lab import FOREIGN, HiddenCampaign, hidden_campaign
from servolens.lab.laws import LAWS

__all__ = ["BASES", "SECTIONS", "Case", "Outcome", "cases", "hide", "judged", "run"]

BASES = {"development": 1, "final": 2}
"""Seeds begin with this digit; what is tuned on the first is judged on the second."""
EFFECTS = tuple(sorted(LAWS))
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
}  # fmt: skip
PAIRS = tuple((one, other) for one, others in PARTNERS.items() for other in others)
"""Thirty pairs of different kinds."""
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
SINGLE = tuple((name,) for name in EFFECTS)
SECTIONS: dict[str, tuple[int, tuple[tuple[str, ...], ...], dict[str, Any]]] = {
    "singles": (10, SINGLE, {}),
    "pairs": (1, PAIRS, {}),
    "triples": (1, TRIPLES, {}),
    "healthy": (40, ((),), {}),
    "foreign": (1, tuple((name,) for name in sorted(FOREIGN)), {}),
    "small": (2, SINGLE, {}),
    "low_noise": (1, SINGLE, {"noise": "low"}),
    "medium_noise": (1, SINGLE, {"noise": "medium"}),
    "high_noise": (1, SINGLE, {"noise": "high"}),
    "one_record": (1, SINGLE, {"records": 1, "heldout": 0}),
    "no_voltage": (1, SINGLE, {"log_voltage": False}),
    "no_reference": (1, SINGLE, {"log_reference": False}),
    "smooth": (1, SINGLE, {"smooth": True}),
}
"""Of each section: repetitions, what is hidden, and what else is asked of the campaign."""


@dataclass(frozen=True, slots=True)
class Case:
    """One campaign of the study; ``str(case)`` is what ``--case`` takes."""

    section: str
    hidden: tuple[str, ...]
    seed: int

    def __str__(self) -> str:
        return f"{self.section}:{'+'.join(self.hidden) or 'nothing'}:{self.seed}"

    @classmethod
    def parse(cls, text: str) -> Case:
        """Return the case of its text."""
        section, name, seed = text.split(":")
        if section not in SECTIONS:
            raise SystemExit(f"no section {section!r}; there are {', '.join(SECTIONS)}")
        return cls(section, () if name == "nothing" else tuple(name.split("+")), int(seed))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a diagnosis made of a case.

    Attributes
    ----------
    verdict : str
        ``"failed"`` where there is none; then `said` is the error's sentence.
    causes : tuple of str
    rivals : tuple of tuple of str
        Of each cause.
    errors : dict of str to float
        Relative error of each hidden effect's parameters that were found; of a phase in rad.
    held : dict of str to bool
        Whether the 95 % interval held the truth; False where there is none.
    heldout : float
        Held-out error over the true noise floor; nan if nothing was held out.
    visibility, seconds : float
    """

    case: Case
    verdict: str
    causes: tuple[str, ...] = ()
    rivals: tuple[tuple[str, ...], ...] = ()
    errors: dict[str, float] = field(default_factory=dict)
    held: dict[str, bool] = field(default_factory=dict)
    heldout: float = math.nan
    visibility: float = math.nan
    seconds: float = 0.0
    said: str = ""

    @property
    def first(self) -> float:
        """1 if the first cause was hidden, a half if something hidden is among its rivals, else 0."""
        if not self.causes:
            return 0.0
        if self.causes[0] in self.case.hidden:
            return 1.0
        return 0.5 if set(self.rivals[0]) & set(self.case.hidden) else 0.0

    @property
    def all_named(self) -> float:
        """1 if everything hidden is a cause, a half if some of it is a rival only, else 0."""
        beside = {name for rivals in self.rivals for name in rivals}
        if set(self.case.hidden) <= set(self.causes):
            return 1.0
        return 0.5 if set(self.case.hidden) <= set(self.causes) | beside else 0.0

    @property
    def right(self) -> bool:
        """Whether the diagnosis is what one may expect of it."""
        if self.verdict == "failed":
            return False
        match self.case.section:
            case "healthy":
                return self.verdict == "healthy" and not self.causes
            case "foreign":
                return self.verdict != "explained"
            case "small":
                return not self.causes or self.all_named > 0
        return self.all_named == 1.0 and len(self.causes) == len(self.case.hidden)


def cases(sections: list[str], effects: list[str], repeats: int | None, base: int) -> list[Case]:
    """Return the cases of some sections, those that hide one of `effects` only, if any are given."""
    chosen = []
    for number, (section, (usual, table, _)) in enumerate(SECTIONS.items()):
        for i, hidden in enumerate(table):
            if section not in sections or (effects and not set(effects) & set(hidden)):
                continue
            seeds = range(usual if repeats is None else repeats)
            chosen += [Case(section, hidden, ((base * 100 + number) * 100 + i) * 1000 + k) for k in seeds]
    return chosen


def hide(case: Case) -> HiddenCampaign:
    """Return the campaign of a case."""
    asked = dict(SECTIONS[case.section][2])
    if case.section == "small":
        asked["visibility"] = SMALL[case.seed % len(SMALL)]
    if case.section == "foreign":
        return hidden_campaign(case.seed, foreign=case.hidden[0], **asked)
    return hidden_campaign(case.seed, effects=case.hidden, **asked)


def run(case: Case) -> Outcome:
    """Diagnose a case."""
    from servolens import diagnose

    begun = time.perf_counter()
    try:
        campaign = hide(case)
        begun = time.perf_counter()
        found = diagnose(campaign.records, heldout=campaign.heldout)
    except Exception as failure:  # whatever one case does, the study goes on and says which it was
        return Outcome(case, "failed", said=f"{type(failure).__name__}: {failure}", seconds=time.perf_counter() - begun)
    return judged(case, campaign, found, time.perf_counter() - begun)


def judged(case: Case, campaign: HiddenCampaign, found: Any, seconds: float) -> Outcome:
    """Compare a diagnosis with what was hidden."""
    errors, held = _compared(campaign, found)
    rms = found.extended.heldout_rms_error if campaign.heldout else None
    return Outcome(
        case=case,
        verdict=found.verdict,
        causes=tuple(cause.effect for cause in found.causes),
        rivals=tuple(tuple(cause.rivals) for cause in found.causes),
        errors=errors,
        held=held,
        heldout=math.nan if rms is None else rms / campaign.floor,
        visibility=campaign.visibility,
        seconds=seconds,
    )


def _compared(campaign: HiddenCampaign, found: Any) -> tuple[dict[str, float], dict[str, bool]]:
    """Return relative errors, and whether intervals hold the truth, of the parameters of hidden effects found."""
    errors: dict[str, float] = {}
    held: dict[str, bool] = {}
    for cause in found.causes:
        true = campaign.truth.effects.get(cause.effect, {})
        turned = "phase" in true and cause.quantities["amplitude"].value * true["amplitude"] < 0
        for name, value in true.items():
            quantity = cause.quantities[name]
            error, unit = quantity.value - value, abs(value)
            if turned and name == "amplitude":  # −A sin(x + π) is A sin x
                error = -quantity.value - value
            if name == "phase":
                error = (error + math.pi * turned + math.pi) % (2.0 * math.pi) - math.pi
                unit = 1.0
            interval = quantity.interval
            key = f"{cause.effect}.{name}"
            errors[key] = abs(error) / unit
            held[key] = interval is not None and abs(error) <= (interval[1] - interval[0]) / 2.0
    return errors, held
