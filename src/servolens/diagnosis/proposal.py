"""The next experiment from a file: of a diagnosis, which names rivals, or of a model alone, which names none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from servolens.decoding import read_json
from servolens.diagnosis.logged import Logged
from servolens.diagnosis.next_experiment import next_experiment, proposed
from servolens.diagnosis.result import Diagnosis
from servolens.errors import InputError
from servolens.findings import Finding
from servolens.model import Model, read_model
from servolens.record import Controller

if TYPE_CHECKING:
    from servolens.diagnosis.next_experiment import Experiment
    from servolens.plant import Plant

__all__ = ["Proposal", "assumed_scale", "propose"]

DIAGNOSIS, MODEL = "servolens.diagnosis/1", "servolens.model/1"
LARGEST_STEP, SAMPLE_TIME, NOISE = 0.1, 1e-3, 1e-4
"""Of a model alone, which knows no records: the step [m or rad], the loop [s], noise as a share of the step."""
USUAL_COMMAND = {"V": 10.0, "%": 100.0}
"""What drives take, by the command's unit."""
FULL = 2.0
"""Times a saturation or dead zone of the model that its records have asked for at least."""
FREE_RATE = 10.0
"""Damping [1/s] that an axis without any is taken to have."""
LASTS, FEWEST, MOST = 8.0, 200, 3000
"""Time constants for which a step is logged; samples of a level."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """What to log next, or why nothing.

    Attributes
    ----------
    experiment : Experiment or None
        The proposal.
    reason : str or None
        Why there is none.
    length_unit, command_unit : str
        Of the axis.
    findings : tuple of Finding
        What was assumed.
    """

    experiment: Experiment | None
    reason: str | None = None
    length_unit: str
    command_unit: str
    findings: tuple[Finding, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.next/1`` without the file's header."""
        if self.experiment is None:
            return {"next_experiment": None, "reason": self.reason}
        return {"next_experiment": self.experiment.to_json()}


def propose(path: Path | str, *, kp: float | None = None, reference: float | None = None) -> Proposal:
    """Return the experiment that best tells rivals apart.

    Parameters
    ----------
    path : Path or str
        A ``servolens.diagnosis/1`` or ``servolens.model/1`` file.
    kp : float, optional
        For a model alone, a gain around which to look [V/m or V/rad]; that of its records where its file knows them,
        else see :func:`assumed_scale`.
    reference : float, optional
        For a model alone, the step that the axis may make [m or rad]; likewise.

    Raises
    ------
    InputError
        If the file is neither, or `kp` or `reference` do not fit.
    """
    file = Path(path)
    if _schema(file) == MODEL:
        return _from_model(read_model(file), kp, reference)
    if kp is not None or reference is not None:
        raise InputError("a diagnosis knows gains and steps that were logged; kp and reference are for a model alone")
    return _from_diagnosis(Diagnosis.from_json(_read(file)))


def _read(path: Path) -> dict[str, Any]:
    data = read_json(path, "; give what `servolens diagnose --json` or `--out` wrote")
    return data if isinstance(data, dict) else {}


def _schema(path: Path) -> str:
    data = _read(path)
    schema = data.get("schema", MODEL if "gain" in data else None)  # what a model need not state, a design takes too
    if schema not in (DIAGNOSIS, MODEL):
        raise InputError(f"is neither diagnosis nor model (schema {str(schema)[:40]!r})")
    return str(schema)


def _from_diagnosis(diagnosis: Diagnosis) -> Proposal:
    if not diagnosis.experiments or not math.isfinite(diagnosis.noise_floor):
        raise InputError("not a whole diagnosis: no experiment is logged, or noise_floor is no number")
    plant, rivals = diagnosis.plant, diagnosis.rival_plants
    sure = {cause.effect: cause.confidence for cause in diagnosis.causes}
    experiment = proposed(plant, rivals, sure, diagnosis.experiments, noise=diagnosis.noise_floor)
    return _proposal(plant, experiment, diagnosis.why_nothing_next)


def _from_model(model: Model, kp: float | None, reference: float | None) -> Proposal:
    """Return what best tells the model from itself without its least certain effect."""
    plant = model.plant
    if model.evidence is not None:  # of the records from which it was identified
        logged = model.evidence.range
        kp, reference = kp if kp is not None else logged.kp, reference if reference is not None else logged.step
    gain, step = assumed_scale(plant, kp, reference)
    if not plant.effects:
        reason = "the model names no rivals and holds no effect beside gain and damping: there is nothing to tell apart"
        return _proposal(plant, None, reason)
    if not (math.isfinite(step) and step != 0):
        raise InputError(f"the reference must be a step other than 0, got {step!r}")
    doubtful = max((effect.name for effect in plant.effects), key=lambda name: _uncertainty(model, name))
    others = plant.without_effect(doubtful)
    name = f"without {doubtful}" if others.effects else "gain_and_damping"
    experiment = next_experiment(
        {doubtful: plant, name: others}, [_assumed(plant, gain, step)], noise=NOISE * abs(step)
    )
    told = Finding(
        code="no_rivals",
        severity="note",
        message=(
            "a model names no rivals; this experiment tells it from the same model without its least certain effect,"
            f" {doubtful}, with noise of {NOISE:g} of the step."
        ),
    )
    reason = f"no step of {step:g} {plant.length_unit} around these gains stays safe and shows it"
    return _proposal(
        plant, experiment, reason, (told, *([] if None not in (kp, reference) else [_scale(plant, gain, step)]))
    )


def _scale(plant: Plant, gain: float, step: float) -> Finding:
    unit = f"{plant.command_unit}/{plant.length_unit}"
    return Finding(
        code="scale_assumed",
        severity="note",
        message=(
            f"the model's file does not say what was logged: looked at are steps of {step:.3g} {plant.length_unit}"
            f" around kp = {gain:.5g} {unit}, which ask for {abs(gain * step):.3g} {plant.command_unit}; give --kp and"
            " --reference as they were logged, or the diagnosis (servolens diagnose --json), which knows them."
        ),
    )


def assumed_scale(plant: Plant, kp: float | None = None, reference: float | None = None) -> tuple[float, float]:
    """Return gain and step to look around where no record of the axis is known.

    The gain leaves the loop half damped, the step is 0.1 m or rad, or one of them less, so that the step asks for no
    more than drives usually take: 10 V or 100 %, or what shows the model's own saturation and dead zone.

    Parameters
    ----------
    plant : Plant
        The axis.
    kp, reference : float, optional
        Gain [V/m or V/rad] and step [m or rad] that are given; then they are returned as they are.
    """
    values = plant.named
    shown = FULL * max(values.get("saturation.limit", 0.0), values.get("dead_zone.width", 0.0))
    most = max(USUAL_COMMAND.get(plant.command_unit, math.inf), shown)
    gain, step = _rate(plant) ** 2 / plant.gain if kp is None else kp, LARGEST_STEP if reference is None else reference
    excess = abs(gain * step) / most
    if excess > 1.0 and reference is None:
        step = float(f"{step / excess:.2g}")
    elif excess > 1.0 and kp is None:
        gain = float(f"{gain / excess:.2g}")
    return gain, step


def _proposal(plant: Plant, experiment: Experiment | None, reason: str, findings: tuple[Finding, ...] = ()) -> Proposal:
    return Proposal(
        experiment=experiment,
        reason=None if experiment else reason,
        length_unit=plant.length_unit,
        command_unit=plant.command_unit,
        findings=findings,
    )


def _uncertainty(model: Model, effect: str) -> float:
    """Return the largest relative standard error of the effect's parameters; infinite where one is not known."""
    errors = [q for name, q in model.quantities.items() if name.startswith(f"{effect}.")]
    return max((math.inf if q.stderr is None or q.value == 0 else q.stderr / abs(q.value)) for q in errors)


def _assumed(plant: Plant, gain: float, reference: float) -> Logged:
    """Return an experiment around which to look, as no record is known."""
    rate = _rate(plant)
    if not (math.isfinite(gain) and gain * plant.gain > 0):
        raise InputError(f"kp must have the sign of the model's gain and not be 0, got {gain:g}")
    slow = min(0.5 * rate, math.sqrt(gain * plant.gain))
    samples = min(max(round(LASTS / slow / SAMPLE_TIME), FEWEST), MOST)
    volts = abs(gain * reference)
    reach = (-abs(reference), 2.0 * abs(reference))
    return Logged(
        name="assumed",
        controller=Controller(kp=gain),
        start=0.0,
        reference=reference,
        duration=samples * SAMPLE_TIME,
        sample_time=SAMPLE_TIME,
        position_range=reach if reference > 0 else (-reach[1], -reach[0]),
        voltage_range=(-volts, volts),
        voltage_limit=None,
    )


def _rate(plant: Plant) -> float:
    return plant.damping if plant.damping > 0 else FREE_RATE
