"""What a diagnosis says: verdict, causes, errors before and after, where the error is, and findings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, final

from servolens.decoding import decoded, fields_of, findings_in, listed, part, read_fields
from servolens.diagnosis.evidence import Instrument, Share
from servolens.diagnosis.json_values import finite
from servolens.diagnosis.logged import Logged
from servolens.effects import effect_class
from servolens.model import Model, Quantity
from servolens.model_evidence import Verdict
from servolens.result import Result
from servolens.results import with_reasons

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from servolens.diagnosis.next_experiment import Experiment
    from servolens.effects import Effect
    from servolens.findings import Finding
    from servolens.model_evidence import Remainder
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Candidate", "Cause", "Diagnosis", "Errors", "RecordGain", "Verdict"]

SIMPLE = (
    "verdict", "baseline", "extended", "noise_floor", "remainder", "instruments", "next_experiment",
)  # fmt: skip
"""Fields of a diagnosis that its file holds by their own names."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Root mean square of simulated minus measured position [m or rad].

    Attributes
    ----------
    rms_error : float
        Over the training records.
    heldout_rms_error : float or None
        Over records, or parts of records, that took no part in the fit.
    """

    rms_error: float
    heldout_rms_error: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields; null with a reason for what is not finite."""
        return finite({"rms_error": self.rms_error, "heldout_rms_error": self.heldout_rms_error})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RecordGain:
    """One record's r.m.s. error with gain and damping alone, and with the causes [m or rad].

    Attributes
    ----------
    name : str
        Of the record.
    heldout : bool
        Whether the record took no part in fit and choice.
    before, after : float
        Error.
    noise : float
        Standard deviation of the record's noise.
    """

    name: str
    heldout: bool
    before: float
    after: float
    noise: float


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """An effect that was tried beside gain and damping alone.

    Attributes
    ----------
    effects : tuple of str
        Names; the last is the one that was added.
    error : float
        What is left in the training records driven by their voltage [m or rad].
    likelihood : float
        By how much it lowers −2 log-likelihood, its price paid; negative where it does not pay.
    shaken : bool
        Whether it is likeliest beside something that shakes the axis; then `error` is that of a simulation as
        `predict` has it, shaking included.
    """

    effects: tuple[str, ...]
    error: float
    likelihood: float = 0.0
    shaken: bool = False

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Candidate:
        """Build the candidate from an entry of ``candidates``."""
        return read_fields(cls, {**data, "error": data["rms_error"]})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """An effect that the model lacked.

    Attributes
    ----------
    effect : str
        Its name.
    quantities : dict of str to Quantity
        Its parameters.
    confidence : float
        Between 0 and 1: how likely it is among what was tried, given what is left unexplained.
    rivals : tuple of str
        Effects that these data cannot tell from it.
    train, heldout : tuple of float or None
        R.m.s. error without and with it, those found before it included [m or rad].
    """

    effect: str
    quantities: dict[str, Quantity]
    confidence: float
    rivals: tuple[str, ...]
    train: tuple[float, float]
    heldout: tuple[float, float] | None

    @property
    def kind(self) -> type[Effect]:
        """The effect's class, which tells what it looks like and what to do about it."""
        return effect_class(self.effect)

    def to_json(self, unit: str) -> dict[str, Any]:
        """Return the fields of a cause in ``servolens.diagnosis/1``."""
        return {
            "effect": self.effect,
            "parameters": {name: quantity.to_json() for name, quantity in self.quantities.items()},
            "confidence": self.confidence,
            "rivals": list(self.rivals),
            "gain": finite(
                {
                    "train": list(self.train),
                    "heldout": None if self.heldout is None else list(self.heldout),
                    "unit": unit,
                }
            ),
            "sentence": self.kind.sentence,
            "looks_like": self.kind.looks_like,
            "remedy": self.kind.remedy,
            "for_the_gain": self.kind.for_the_gain,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Cause:
        """Build the cause from what :meth:`to_json` returned."""
        gain = part(data, "gain", dict)
        quantities = decoded(dict[str, Quantity], data["parameters"], "parameters")
        errors = fields_of(cls, gain, ["train", "heldout"])
        return cls(**fields_of(cls, data, ["effect", "confidence", "rivals"]), quantities=quantities, **errors)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Diagnosis(Result):
    """What the simulation gets wrong, why, and what the extended model gains.

    Attributes
    ----------
    verdict : {"healthy", "explained", "partly_explained", "unexplained"}
        Whether gain and damping suffice; else whether the causes explain the records down to their noise, in part, or
        not at all.
    causes : tuple of Cause
        In the order in which they were found.
    baseline, extended : Errors
        Of gain and damping alone, and with the causes.
    noise_floor : float
        R.m.s. of the position's noise [m or rad].
    remainder : Remainder
        What the simulation misses beyond the noise, with the causes.
    where : tuple of Share
        Where the error of gain and damping alone lives.
    instruments : tuple of Instrument
        What damping, gain and a free force would have to do in time, and with what that goes.
    gains : tuple of RecordGain
        Record by record.
    missed : tuple of (ndarray, ndarray)
        Of each record that was held out, or else of each training record, by models fitted without it: simulated minus
        measured position [m or rad], of gain and damping alone and with the causes. Of a record that was parted, its
        last samples; infinite where a simulation leaves all bounds.
    candidates : tuple of Candidate
        Single effects by what they leave, the best first.
    linear, model : Model
        Gain and damping alone; with the causes.
    rival_plants : dict of str to tuple of Plant
        For each cause the plants with a rival in its place.
    next_experiment : Experiment or None
        What would tell the rivals apart; None where there are none.
    findings : tuple of Finding
        Warnings and notes: about the logs first.
    records, heldout : tuple of Record
        The measurements; none where the diagnosis was read from a file.
    remembered : tuple of (tuple of Logged)
        What a file holds of both.
    """

    kind: ClassVar[str] = "diagnosis"

    verdict: Verdict
    causes: tuple[Cause, ...]
    baseline: Errors
    extended: Errors
    noise_floor: float
    remainder: Remainder
    where: tuple[Share, ...]
    instruments: tuple[Instrument, ...]
    gains: tuple[RecordGain, ...]
    missed: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]
    candidates: tuple[Candidate, ...]
    linear: Model
    model: Model
    rival_plants: dict[str, tuple[Plant, ...]]
    next_experiment: Experiment | None
    findings: tuple[Finding, ...]
    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    remembered: tuple[tuple[Logged, ...], tuple[Logged, ...]] = ((), ())

    @property
    def experiments(self) -> tuple[Logged, ...]:
        """What was done in the records."""
        return tuple(Logged.of(record) for record in self.records) or self.remembered[0]

    @property
    def tests(self) -> tuple[Logged, ...]:
        """What was done in the records held out."""
        return tuple(Logged.of(record) for record in self.heldout) or self.remembered[1]

    @property
    def plant(self) -> Plant:
        """The plant with the causes."""
        return self.model.plant

    @property
    def why_nothing_next(self) -> str:
        """Why no experiment is proposed, where none is."""
        if any(self.rival_plants.values()):
            return "no safe step like those logged would tell the rivals apart"
        if any(cause.rivals for cause in self.causes):
            return "the rivals that the diagnosis names give the same records whatever is done, or were not fitted"
        return "the diagnosis names no rivals, so there is nothing to tell apart"

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.diagnosis/1`` without the file's header."""
        unit = self.plant.length_unit
        result = {
            "verdict": self.verdict,
            "causes": [cause.to_json(unit) for cause in self.causes],
            "baseline": self.baseline.to_json(),
            "extended": self.extended.to_json(),
            "noise_floor": self.noise_floor,
            "remainder": finite(self.remainder.to_json()),
            "unit": unit,
            "where": [share.to_json() for share in self.where],
            "instruments": [instrument.to_json() for instrument in self.instruments],
            "records": [
                finite({"name": g.name, "heldout": g.heldout, "before": g.before, "after": g.after, "noise": g.noise})
                for g in self.gains
            ],
            "candidates": [
                {"effects": list(c.effects), "rms_error": c.error, "likelihood": c.likelihood, "shaken": c.shaken}
                for c in self.candidates
            ],
            "linear_model": self.linear.to_json(),
            "model": self.model.to_json(),
            "rival_models": {
                name: [_model_json(plant) for plant in plants] for name, plants in self.rival_plants.items()
            },
            "next_experiment": None if self.next_experiment is None else self.next_experiment.to_json(),
            "experiments": [logged.to_json() for logged in self.experiments],
            "heldout_experiments": [logged.to_json() for logged in self.tests],
        }
        return with_reasons(result, {"next_experiment": self.why_nothing_next})

    @classmethod
    def _read(cls, data: Mapping[str, Any]) -> Diagnosis:
        """Return the result; of `instruments` and `missed` files keep no picture."""
        from servolens.diagnosis.next_experiment import Experiment
        from servolens.model_evidence import Remainder

        known = {"Experiment": Experiment, "Remainder": Remainder}
        return cls(
            causes=listed(data, "causes", Cause.from_json),
            where=listed(data, "where", Share.from_json),
            gains=listed(data, "records", lambda one: read_fields(RecordGain, one)),
            candidates=listed(data, "candidates", Candidate.from_json),
            linear=part(data, "linear_model", Model.from_json),
            model=part(data, "model", Model.from_json),
            rival_plants=part(data, "rival_models", _plants),
            findings=findings_in(data),
            missed=(),
            records=(),
            heldout=(),
            remembered=(
                listed(data, "experiments", Logged.from_json),
                listed({"heldout_experiments": [], **data}, "heldout_experiments", Logged.from_json),
            ),
            **fields_of(cls, data, SIMPLE, known),
        )


def _plants(rivals: Mapping[str, Any]) -> dict[str, tuple[Plant, ...]]:
    return {name: listed(rivals, name, lambda one: Model.from_json(one).plant) for name in rivals}


def _model_json(plant: Plant) -> dict[str, Any]:
    from servolens.model import Model

    return Model(plant=plant).to_json()
