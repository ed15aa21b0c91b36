"""What a design found: gains, how far they can be trusted, and simulated steps."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np

from servolens.decoding import decoded, fields_of, read_fields
from servolens.design.response import Response
from servolens.errors import InputError
from servolens.model import Model
from servolens.result import Result
from servolens.results import with_reasons

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design.limit_cycle import Hunting
    from servolens.design.plant_inverse import Tracking
    from servolens.design.spec import PDSpec
    from servolens.diagnosis import Diagnosis
    from servolens.plant import Plant
    from servolens.quality import RecordQuality
    from servolens.record import Record
    from servolens.simulation import Simulation

__all__ = ["Certificate", "Design", "Light", "Recommended", "Relaxed"]

STORED = (
    "spec", "kd", "intervals", "certificate", "candidates", "disagreement", "conflict", "nearest", "reason",
    "recommended", "hunting", "tracking", "lights",
)  # fmt: skip
"""Fields of a design that its file holds by their own names."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """What the search for the least gain shows.

    Attributes
    ----------
    searched : tuple of float
        Range of gains [V s/m].
    gap : float
        The least gain is known within this much, and what is overlooked, a feasible interval or a hole in one, is
        narrower [V s/m].
    kind : {"enclosure", "sensitivity"}
        ``"enclosure"``: a theorem up to rounding, for the plant and the loop as they are modelled and for the horizon.
        ``"sensitivity"``: between simulated gains, signals depart from straight lines by no more than twice what was
        measured there: a measured modulus of continuity.
    horizon : float
        How long each step was watched [s].
    end_from_plant : bool
        Whether the end of the search was not stated but follows from the plant.
    """

    searched: tuple[float, float]
    gap: float
    kind: Literal["enclosure", "sensitivity"]
    horizon: float
    end_from_plant: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {**{f.name: getattr(self, f.name) for f in fields(self)}, "searched": list(self.searched)}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Relaxed:
    """The feasible spec nearest to an infeasible one.

    Attributes
    ----------
    changes : tuple of (str, float)
        Fields of the spec that give way, and to what.
    kd : float
        A gain that then meets the spec [V s/m].
    """

    changes: tuple[tuple[str, float], ...]
    kd: float

    def to_json(self) -> dict[str, Any]:
        """Return the changed fields, and the gain."""
        return {**dict(self.changes), "kd": self.kd}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Relaxed:
        """Build it from what :meth:`to_json` returned."""
        values = {str(name): decoded(float, value, str(name)) for name, value in data.items()}
        kd = values.pop("kd", None)
        if kd is None:
            raise InputError("kd of a nearest spec is missing")
        return cls(changes=tuple(values.items()), kd=kd)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Recommended:
    """The gain to use: from the widest feasible place, over what is not known of the axis.

    Attributes
    ----------
    kp, kd : float
        Gains [V/m, V s/m].
    settling_time : float or None
        On the models as they are, the slowest of them [s]; None where one does not settle.
    overshoot : float
        On the models as they are, the largest, as a fraction of the step.
    worst : Response
        The slowest of all scenarios, with its own realised gain.
    probability : float
        Share of the scenarios that meet the spec.
    interval : tuple of float
        Its 95 % confidence interval (Clopper and Pearson).
    scenarios : int
        How many; none of them took part in the choice of the gain.
    why : str
        One sentence: what speaks for this gain.
    risk : str
        One sentence: what the least gain risks.
    hardest : str
        Which steps meet the spec most seldom, and how often, as "2.5 % of the steps back", where others of their kind
        meet it in nine of ten scenarios; else empty.
    fails : str
        What most of the scenarios do that do not meet the spec, and what helps; empty where they do not do the same.
    """

    kp: float
    kd: float
    settling_time: float | None
    overshoot: float
    worst: Response
    probability: float
    interval: tuple[float, float]
    scenarios: int
    why: str
    risk: str
    hardest: str = ""
    fails: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``recommended`` in ``servolens.design/1``."""
        return {
            **{f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("interval", "probability")},
            "worst": self.worst.to_json(),
            "probability": {"value": self.probability, "interval": list(self.interval)},
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Recommended:
        """Build it from what :meth:`to_json` returned."""
        share = data.get("probability") or {}
        return read_fields(cls, {**data, "probability": share.get("value"), "interval": share.get("interval")})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """How far something can be trusted.

    Attributes
    ----------
    light : {"green", "amber", "red"}
        As of a traffic light.
    sentence : str
        Why.
    """

    light: Literal["green", "amber", "red"]
    sentence: str

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {"light": self.light, "sentence": self.sentence}


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Design(Result):
    """The least derivative gain that meets a spec.

    Attributes
    ----------
    plants : tuple of Plant
        What it was made for: all of them have to meet the spec.
    spec : PDSpec
        What was asked, with the end of the search.
    kd : float or None
        The least gain; None if none meets the spec, or where it is withheld.
    intervals : tuple of (float, float)
        All feasible gains in the searched range, for all models at once.
    certificate : Certificate
        What was searched, and how far that can be trusted.
    candidates : tuple of float or None
        On request: the local optimum of CasADi's nonlinear program in each interval. None where it found none, or one
        that fails when it is simulated. The program smooths dry friction; the ends of `intervals` are the exact loop's.
    disagreement : str or None
        Where the nonlinear program, or a proof, contradicts the search by more than the gap.
    verified : tuple of Response
        Exact simulation at `kd`, a model each.
    conflict : tuple of str
        Fields of the spec that no gain can meet together; empty if the spec can be met.
    nearest : tuple of Relaxed
        Specs that can be met, with as few fields changed as possible.
    reason : str or None
        Why there is no gain; None where there is one.
    recommended : Recommended or None
        The gain to use, beside the least one; None until :func:`servolens.design.recommend` looked for it.
    hunting : mapping of str to Hunting or None
        What swing around the reference the ``"least"`` and the ``"recommended"`` gain keep up; None where all starts
        come to rest.
    tracking : Tracking or None
        What feedforward from the model is worth with the recommended gain, on a smooth move.
    lights : mapping of str to Light
        How far ``"model"`` and ``"gain"`` can be trusted, from records also ``"data"``; empty where nobody judged.
    check : tuple of RecordQuality
        Of the records, where it was made from these.
    diagnosis : Diagnosis or None
        What was found from the records, where it was made from these; files of designs keep neither it nor `check`.
    """

    kind: ClassVar[str] = "design"
    example: ClassVar[str] = "what servolens.design.tune returns"

    plants: tuple[Plant, ...]
    spec: PDSpec
    kd: float | None
    intervals: tuple[tuple[float, float], ...]
    certificate: Certificate
    candidates: tuple[float | None, ...] = ()
    disagreement: str | None = None
    verified: tuple[Response, ...] = ()
    conflict: tuple[str, ...] = ()
    nearest: tuple[Relaxed, ...] = ()
    reason: str | None = None
    recommended: Recommended | None = None
    hunting: Mapping[str, Hunting | None] = field(default_factory=dict)
    tracking: Tracking | None = None
    lights: Mapping[str, Light] = field(default_factory=dict)
    check: tuple[RecordQuality, ...] = ()
    diagnosis: Diagnosis | None = None

    @property
    def plant(self) -> Plant:
        """The first of `plants`."""
        return self.plants[0]

    @property
    def records(self) -> tuple[Record, ...]:
        """The records that it was made from."""
        return () if self.diagnosis is None else self.diagnosis.records

    @property
    def gain(self) -> float | None:
        """The gain to use: the recommended one, else the least [V s/m]."""
        return self.kd if self.recommended is None else self.recommended.kd

    @property
    def feasible(self) -> bool:
        """Whether any gain meets the spec on the models."""
        return bool(self.intervals)

    @property
    def withheld(self) -> bool:
        """Whether no gain is given although some meet the spec on the models."""
        return self.feasible and self.kd is None

    @property
    def margin(self) -> float | None:
        """How far the gain may rise before the spec breaks [V s/m]."""
        return None if self.kd is None else self.intervals[0][1] - self.kd

    def step(self, kd: float | None = None, *, duration: float | None = None) -> Simulation:
        """Simulate the step of the spec on `plant`.

        Parameters
        ----------
        kd : float, optional
            Gain [V s/m]; the one to use when None.
        duration : float, optional
            How long [s]; three times the settling time asked for when None.

        Raises
        ------
        InputError
            If no gain is given, neither here nor by the design.
        """
        from servolens.design.settle import step_response

        gain = self.gain if kd is None else kd
        if gain is None:
            raise InputError(f"this design gives no gain ({self.reason}); pass kd")
        return step_response(self.plant, self.spec, gain, duration or 3.0 * self.spec.settling_time)

    def withhold(self, reason: str) -> Design:
        """Return the design without its gains, for a `reason` that is told; the intervals stay."""
        return replace(self, kd=None, recommended=None, verified=(), hunting={}, tracking=None, reason=reason)

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.design/1`` without the file's header."""
        worst = max(self.verified, key=lambda r: np.inf if r.settling_time is None else r.settling_time, default=None)
        result: dict[str, Any] = {
            "feasible": self.feasible,
            "withheld": self.withheld,
            "kd": self.kd,
            "kp": self.spec.kp,
            "settling_time": None if worst is None else worst.settling_time,
            "intervals": [list(interval) for interval in self.intervals],
            "free": self.spec.free,
            "gains": self.spec.gains(self.kd),
            "certificate": self.certificate.to_json(),
            "candidates": list(self.candidates),
            "margin": self.margin,
            "verified": None if worst is None else worst.to_json(),
            "models": [response.to_json() for response in self.verified],
            "spec": self.spec.to_json(),
            "recommended": None if self.recommended is None else self.recommended.to_json(),
            "tracking": None if self.tracking is None else self.tracking.to_json(),
            "hunting": {which: None if one is None else one.to_json() for which, one in self.hunting.items()},
            "lights": {name: light.to_json() for name, light in self.lights.items()},
            "plants": [Model(plant=plant).to_json() for plant in self.plants],
        }
        if self.reason is not None:
            result["reason"] = self.reason
            result["conflict"] = list(self.conflict)
            result["nearest"] = [relaxed.to_json() for relaxed in self.nearest]
        if self.disagreement is not None:
            result["disagreement"] = self.disagreement
        return with_reasons(result, self._why_missing())

    def _why_missing(self) -> dict[str, str]:
        """Return why fields of a design that gives a gain are null; where it gives none, `reason` says why."""
        if self.kd is None:
            return {}
        if self.recommended is None:
            return dict.fromkeys(("recommended", "tracking"), "only the least gain was sought")
        if self.spec.control == "continuous":
            return {"tracking": "feedforward is simulated in loops that are sampled only"}
        return {"tracking": "on the smooth move the axis, or a plant of the scenarios, runs away"}

    @classmethod
    def _read(cls, data: Mapping[str, Any]) -> Design:
        from servolens.design.limit_cycle import Hunting
        from servolens.design.plant_inverse import Tracking
        from servolens.design.spec import PDSpec

        known = {"Hunting": Hunting, "PDSpec": PDSpec, "Tracking": Tracking}
        if data.get("kd") is not None:  # the reason is that of other fields
            data = {**data, "reason": None}
        return cls(
            plants=tuple(Model.from_json(one).plant for one in data.get("plants", ())),
            verified=tuple(Response.from_json(one) for one in data.get("models", ())),
            **fields_of(cls, data, STORED, known),
        )
