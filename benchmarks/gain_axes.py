"""Axes of the study of recommended gains: what is hidden in each, and how the gains do on the true axis."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from harness import processor_time

from servolens.design import settling_time
from servolens.errors import ServolensError
from servolens.lab import FOREIGN, WORLDS, HiddenCampaign, hidden_campaign
from servolens.lab.laws import LAWS
from servolens.study import study_records

if TYPE_CHECKING:
    from servolens.design import PDSpec
    from servolens.study import Study

__all__ = ["BASES", "SECTIONS", "Axis", "Outcome", "Run", "hide", "run"]

BASES = {"development": 1_300_000, "final": 1_500_000}
"""First seeds, which no other study has: what is tuned on the one kind is judged on the other."""
SECTIONS = {"catalogue": 0, "foreign": 50_000}
"""What is hidden: one or two effects of the catalogue, or one law that is not in it; and where its seeds begin."""
TRIES = 20
"""Draws of what is hidden, until the laboratory finds an axis that stays sane with it."""
WATCHED = 10.0
"""Settling times for which each of both steps is watched."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of the study; its number fixes its world, its seed and, with that, what is hidden."""

    section: str
    kind: str
    number: int

    @property
    def world(self) -> str:
        """What disturbs its measurement: one world after the other."""
        return tuple(WORLDS)[self.number % len(WORLDS)]

    @property
    def seed(self) -> int:
        """Of its laboratory."""
        return BASES[self.kind] + SECTIONS[self.section] + self.number


@dataclass(frozen=True, slots=True)
class Run:
    """A gain on the true axis.

    Attributes
    ----------
    kd : float
    settles : tuple of float or None
        Settling times of the step up and of the one back [s]; None where it does not settle.
    meets : bool
        Whether both are what the spec asks for.
    """

    kd: float
    settles: tuple[float | None, float | None]
    meets: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an axis.

    Attributes
    ----------
    hidden : tuple of str
    verdict : str
        Of the diagnosis; empty without one.
    lights : dict of str to str
        Of data, model and gain.
    said : str
        Why the gain's light has its colour.
    settling_time : float or None
        That the chain chose to ask for [s]; None where it designed nothing.
    runs : dict of str to Run
        ``"recommended"``, ``"least"`` and ``"linear"``: the least gain of the model of gain and damping alone. Those
        that the chain withholds are run as well.
    """

    axis: Axis
    hidden: tuple[str, ...]
    verdict: str
    lights: dict[str, str]
    said: str
    settling_time: float | None = None
    runs: dict[str, Run] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def withheld(self) -> bool:
        """Whether there is a gain that the chain does not give."""
        return "recommended" in self.runs and self.lights["gain"] == "red"

    @property
    def given(self) -> bool:
        """Whether the chain gives a gain."""
        return "recommended" in self.runs and self.lights["gain"] != "red"

    def meets(self, gain: str) -> bool:
        """Tell whether a gain exists and meets the spec on the true axis."""
        return gain in self.runs and self.runs[gain].meets

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Outcome:
        """Return the outcome of its fields."""
        runs = {name: Run(**{**one, "settles": tuple(one["settles"])}) for name, one in data["runs"].items()}
        return cls(**{**data, "axis": Axis(**data["axis"]), "hidden": tuple(data["hidden"]), "runs": runs})


def run(axis: Axis) -> Outcome:
    """Measure an axis, go the whole chain from its records, and run the gains on the truth."""
    campaign, hidden = hide(axis)
    begun = processor_time()
    try:
        # forced, for what would be withheld is to be tried as well: its light stays red
        found = study_records(campaign.records, heldout=campaign.heldout, force=True)
    except ServolensError as failure:
        red = dict.fromkeys(("data", "model", "gain"), "red")
        return Outcome(axis, hidden, "", red, f"{failure}", seconds=round(processor_time() - begun, 1))
    spent = round(processor_time() - begun, 1)
    design = found.design
    spec = None if design is None else design.spec
    return Outcome(
        axis,
        hidden,
        "" if found.diagnosis is None else found.diagnosis.verdict,
        {name: light.light for name, light in found.lights.items()},
        found.lights["gain"].sentence,
        None if spec is None else spec.settling_time,
        {} if spec is None else {name: _tried(campaign, spec, kd) for name, kd in _gains(found).items()},
        spent,
    )


def hide(axis: Axis) -> tuple[HiddenCampaign, tuple[str, ...]]:
    """Return the campaign of an axis, and the names of what is hidden in it."""
    draw = np.random.default_rng(axis.seed)
    for _ in range(TRIES):
        if axis.section == "foreign":
            law = str(draw.choice(sorted(FOREIGN)))
            asked: dict[str, Any] = {"foreign": law}
            names: tuple[str, ...] = (law,)
        else:
            names = tuple(sorted(map(str, draw.choice(sorted(LAWS), size=draw.integers(1, 3), replace=False))))
            asked = {"effects": names}
        try:
            return hidden_campaign(axis.seed, world=axis.world, **asked), names
        except ServolensError:
            continue
    raise SystemExit(f"{axis}: none of {TRIES} draws gives a sane axis")


def _gains(found: Study) -> dict[str, float]:
    design, comparison = found.design, found.comparison
    gains: dict[str, float] = {}
    if design is not None and design.kd is not None and design.recommended is not None:
        gains = {"recommended": design.recommended.kd, "least": design.kd}
    if comparison is not None and comparison.linear.kd is not None:
        gains["linear"] = comparison.linear.kd
    return gains


def _tried(campaign: HiddenCampaign, spec: PDSpec, kd: float) -> Run:
    """Step up and back on the true axis, which its loop has brought to rest before, without sensor noise."""
    levels = (0.0, spec.reference, 0.0)
    try:
        run = campaign.tried(spec.loop(kd), levels, WATCHED * spec.settling_time, spec.sample_time)
    except ServolensError:
        return Run(kd, (None, None), meets=False)
    parts = np.split(run.position, len(levels))
    time_of = spec.sample_time * np.arange(parts[0].size, dtype=np.float64)
    errors = [(target - part) / abs(spec.reference) for target, part in zip(levels[1:], parts[1:], strict=True)]
    up, back = (settling_time(time_of, error, spec.band) for error in errors)
    meets = all(time is not None and time <= spec.settling_time for time in (up, back))
    return Run(kd, (up, back), meets=meets)
