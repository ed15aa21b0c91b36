"""What a study of records found: data, models, causes, gains, and how far each of them can be trusted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

from servolens.result import late

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.design import Comparison, Design, Light
    from servolens.diagnosis import Diagnosis
    from servolens.findings import Finding
    from servolens.identification import Identification
    from servolens.model import Model
    from servolens.quality import RecordQuality
    from servolens.record import Record

__all__ = ["Study"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Study:
    """All that was found from the records of one axis.

    Attributes
    ----------
    records, heldout : tuple of Record
        As they were given; the models come from those of `records` that are fit for it.
    check : tuple of RecordQuality
        Of each record, those held out last.
    fit : Identification or None
        Constant and speed-dependent damping; None where no record is fit for it.
    diagnosis : Diagnosis or None
        What gain and damping lack; None where it could not be found.
    why_undiagnosed : str
        Why there is no diagnosis.
    model : Model or None
        The one that the data support best: that of the diagnosis.
    comparison : Comparison or None
        Designs on the linear, the speed-dependent and the diagnosed model; None where nothing was designed.
    design : Design or None
        On `model`, with the recommended gain; its gains are withheld where the gain's light is red.
    why_none : str
        Why nothing was designed.
    lights : mapping of str to Light
        How far ``"data"``, ``"model"`` and ``"gain"`` can be trusted.
    forced : bool
        Whether a gain is given that would have been withheld.
    suggested : bool
        Whether the spec was chosen here.
    findings : tuple of Finding
        Errors, warnings and notes, worst first.
    """

    records: tuple[Record, ...]
    heldout: tuple[Record, ...]
    check: tuple[RecordQuality, ...]
    fit: Identification | None
    diagnosis: Diagnosis | None
    why_undiagnosed: str
    model: Model | None
    comparison: Comparison | None
    design: Design | None
    why_none: str
    lights: Mapping[str, Light]
    forced: bool
    suggested: bool
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        """Return one line: the lights and the gain."""
        lights = ", ".join(f"{name} {light.light}" for name, light in self.lights.items())
        said = late("summaries.tuning", "gain_sentences")(self)
        return f"<Study: {' '.join((*([f'{lights}.'] if lights else []), *said[:1]))}>"

    def noting(self, sentence: str) -> Study:
        """Return the study with a sentence on its spec after that of a red gain, where only the spec is to blame."""
        light, design = self.lights["gain"], self.design
        is_of_the_spec = light.light == "red" and "red" not in (self.lights["data"].light, self.lights["model"].light)
        if not sentence or design is None or not is_of_the_spec:
            return self
        lights = {**self.lights, "gain": replace(light, sentence=f"{light.sentence} {sentence}")}
        told = replace(design, lights=lights)
        comparison = self.comparison
        if comparison is not None and comparison.diagnosed is not None:
            comparison = replace(comparison, diagnosed=told)
        return replace(self, lights=lights, design=told, comparison=comparison)

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.tuning/1`` without the file's header."""
        design = None if self.design is None else self.design.to_json()
        result = {
            **{name: light.to_json() for name, light in self.lights.items()},
            "check": {"records": [quality.to_json() for quality in self.check]},
            "identification": None if self.fit is None else self.fit.to_json(),
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_json(),
            "comparison": None if self.comparison is None else self.comparison.to_json(),
            "spec": None if design is None else design["spec"],
            "kp": None if design is None else design["kp"],
            "kd": None if design is None else design["kd"],
            "recommended": None if design is None else design["recommended"],
            "forced": self.forced,
        }
        why_no_gain = self.why_none or ("" if self.design is None else self.design.reason or "")
        reasons = (self.why_undiagnosed, why_no_gain)
        told = " ".join(f"{reason.rstrip('.')}." for reason in reasons if reason)
        return {**result, "reason": told} if told else result
