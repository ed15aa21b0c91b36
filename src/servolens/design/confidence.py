"""How far a model and the gain designed on it can be trusted, as lights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.design.command_noise import command_noise
from servolens.design.extrapolation import BEYOND, extrapolation
from servolens.design.found import Design, Light
from servolens.design.recommended import NINE_OF_TEN
from servolens.design.scenarios import is_pushed, missed_share
from servolens.design.settle import BETWEEN, evaluate
from servolens.errors import needed
from servolens.inputs import as_models
from servolens.model_evidence import MATERIAL
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.limit_cycle import Hunting
    from servolens.design.spec import PDSpec
    from servolens.inputs import Plants
    from servolens.model import Model
    from servolens.model_evidence import Evidence

__all__ = ["trust"]

MISSED = 0.05
"""R.m.s. of the held-out error over the step from which on the model, or the loop that is stated, is wrong."""
WHO = {
    "held_out": "record {record}, which took no part in the fit",
    "left_out": "record {record}, as predicted by a fit to the other records",
    "end": "the end of {record}, as predicted by a fit without it",
}
"""What of a record was not fitted, and what predicted it."""
ORDER = ("green", "amber", "red")


def trust(models: Plants, design: Design | None) -> tuple[Light, Light]:
    """Judge the models by their evidence, and the gain of a design by its models, its scenarios and the data's range.

    The verdict of a diagnosis alone decides nothing. A red gain is to be withheld.

    Parameters
    ----------
    models : Plant, model, fit, diagnosis, path of a model's file, or a sequence of these
        What the design was made for.
    design : Design or None
        With its recommended gain, where it was looked for; None where nothing was designed.

    Returns
    -------
    model, gain : Light

    Examples
    --------
    >>> from servolens import PDSpec, Plant, tune
    >>> axis = Plant(gain=1.8, damping=6.0)
    >>> [light.light for light in trust(axis, tune(axis, PDSpec(kp=100, settling_time=0.5)))]
    ['amber', 'green']
    """
    known = as_models(models)
    of_model = _worst([_model_light(model) for model in known])
    if design is None:
        return of_model, Light(light="red", sentence="No gain was sought.")
    needed(design, Design)
    return of_model, _gain_light(known, design, of_model)


def _worst(lights: Sequence[Light]) -> Light:
    return max(lights, key=lambda light: ORDER.index(light.light))


def _model_light(model: Model) -> Light:
    evidence = model.evidence
    if evidence is None:
        return Light(light="amber", sentence="Nothing is known of how well this model describes the axis.")
    if evidence.fatal:
        return Light(light="red", sentence=f"The records speak against the model: {evidence.fatal[0]}")
    missed, left, unit = evidence.heldout_of_step, evidence.remainder, model.plant.length_unit
    if missed is not None and missed > MISSED:
        return Light(
            light="red",
            sentence=(
                f"The simulation misses {_untaught(evidence, unit)},"
                f" more than {100 * MISSED:g} %: the model, or what the records state of their loop, is wrong."
            ),
        )
    if left is None:
        return Light(
            light="amber", sentence="Nobody looked for what this model misses; run `servolens diagnose` on its records."
        )
    share = f"{100 * left.of_travel:.2g} % of the travel" if left.of_travel > 0.0 else "nothing"
    if left.material:
        return Light(
            light="amber",
            sentence=(
                f"The model misses {share} beyond the noise; the scenarios carry what is unexplained of it as a force."
            ),
        )
    if missed is not None and missed > MATERIAL:
        return Light(
            light="amber",
            sentence=(
                f"The simulation misses {share} beyond the noise, but {_untaught(evidence, unit)}: of"
                " another run it may miss as much."
            ),
        )
    tested = "" if missed is None else f", and {_untaught(evidence, unit)}"
    verdict = "" if evidence.verdict is None else f"{evidence.verdict.replace('_', ' ').capitalize()}"
    verdict += {"": "", "Healthy": ": ", "Explained": ": "}.get(verdict, ", but what is left is immaterial: ")
    return Light(light="green", sentence=f"{verdict}the simulation misses {share} beyond the noise{tested}.")


def _gain_light(models: Sequence[Model], design: Design, of_model: Light) -> Light:
    chosen = design.recommended
    kd = design.kd if chosen is None else chosen.kd
    if kd is None:
        return Light(light="red", sentence=_sentence(design.reason or "no gain meets the spec"))
    if of_model.light == "red":
        return Light(light="red", sentence=f"No gain is recommended: the model is not reliable. {of_model.sentence}")
    if chosen is not None and chosen.probability < NINE_OF_TEN:
        return Light(
            light="red",
            sentence=(
                f"No gain meets the spec in nine of ten plants: the best of them in {100 * chosen.probability:.3g} % of"
                f" {chosen.scenarios}{_with(models, design.spec)}{chosen.hardest and ', and in '}{chosen.hardest}"
                f"{chosen.fails and '; '}{chosen.fails}."
            ),
        )
    swing = _swing(design)
    if swing is not None and np.isinf(swing.amplitude):
        off = readable(abs(swing.start), models[0].plant.length_unit)
        begun = f"{off} off the reference" if swing.start else "with a full integral"
        return Light(
            light="red",
            sentence=(
                f"With {design.spec.free} = {kd:.4g} the axis runs away if it begins {begun}; a smaller gain may hold."
            ),
        )
    beyond = max((extrapolation(model, design.spec, kd) for model in models), key=lambda one: one.ratio)
    if beyond.ratio > BEYOND:
        return Light(light="red" if beyond.is_far else "amber", sentence=beyond.sentence)
    warning = _warning(models, design)
    if warning:
        return Light(light="amber", sentence=warning)
    why = f"{design.spec.free} = {kd:.4g} meets the spec on the model" if chosen is None else chosen.why
    return Light(light="green", sentence=f"{_sentence(why)} {design.spec.noise_remark}".rstrip())


def _swing(design: Design) -> Hunting | None:
    """Return the swing that does not end with the gain that the design gives."""
    return design.hunting.get("least" if design.recommended is None else "recommended")


def _with(models: Sequence[Model], spec: PDSpec) -> str:
    """Say what the scenarios carry of that which the models leave unexplained; empty if nothing."""
    missed = max(map(missed_share, models))
    told = (
        f", as simulations may miss up to {_share(missed)} of the step in a band of {_share(spec.band)}"
        if missed
        else ""
    )
    return told + (", with what the model leaves unexplained as a force" if any(map(is_pushed, models)) else "")


def _warning(models: Sequence[Model], design: Design) -> str:
    """Return what speaks against a gain that the records bear out and most of the scenarios stand; empty if nothing."""
    known = ((model.evidence, model.plant.length_unit) for model in models)
    missed = (_beyond_band(evidence, unit, design.spec) for evidence, unit in known if evidence is not None)
    told = next((sentence for sentence in missed if sentence), "")
    if told:
        return told
    chosen = design.recommended
    apart = "" if chosen is None else _between_samples(models, design.spec, chosen.kd)
    if apart:
        return apart
    swing = _swing(design)
    if swing is not None:
        return (
            f"The axis does not come to rest from all starts: it keeps swinging by ±{swing.amplitude:.3g}"
            f" {models[0].plant.length_unit}."
        )
    if chosen is not None and chosen.worst.settling_time is None:
        return f"The worst of {chosen.scenarios} plants does not settle at all: {chosen.why}."
    if chosen is not None and chosen.interval[0] < NINE_OF_TEN:
        return f"It is not certain that nine of ten plants meet the spec: {chosen.why}."
    restless = "" if chosen is None else command_noise(models, design.spec, chosen.kd)
    return restless or _left(models)


def _between_samples(models: Sequence[Model], spec: PDSpec, kd: float) -> str:
    """Say what an axis does between the samples of its loop, where it keeps the spec at these alone; else empty."""
    found = [evaluate(model.plant, spec, kd, parts=BETWEEN) for model in models]
    missed = [response for response in found if not response.meets]
    if not missed:
        return ""
    worst = max(missed, key=lambda one: np.inf if one.settling_time is None else one.settling_time)
    settles = "does not settle" if worst.settling_time is None else f"settles in {worst.settling_time:.3g} s"
    return (
        f"Between the samples of its loop, {1e3 * spec.sample_time:.3g} ms apart, the axis does not keep the spec: it"
        f" {settles} and overshoots by {100 * worst.overshoot:.3g} %; sample faster, or confirm the gain on the axis."
    )


def _left(models: Sequence[Model]) -> str:
    """Say what no scenario tries, where the models miss a material part of the travel; empty if they do not.

    Beside a model that explains the records it is steady and does not depend on the inputs: a random force, as which
    the scenarios try it; but not where records are missed that were held out.
    """
    known = [(model.evidence, model.evidence.remainder) for model in models if model.evidence is not None]
    largest = 0.0
    for evidence, left in known:
        if left is not None and left.material:
            is_tried = evidence.verdict in ("explained", "healthy") and not (left.depends_on_inputs or left.heldout)
            largest = largest if is_tried else max(largest, left.of_travel)
    if not largest:
        return ""
    return (
        f"The model misses {_share(largest)} of the travel, which can be tried as a random force only; on the axis it"
        " may act otherwise: confirm the gain there."
    )


def _untaught(evidence: Evidence, unit: str) -> str:
    """Return what the simulation misses of the record, of those it was not fitted to, of which it misses most."""
    if not evidence.missed:
        return f"{_share(evidence.heldout_of_step or 0.0)} of the step (r.m.s.) on data that took no part in the fit"
    worst = max(evidence.missed, key=lambda missed: missed.of_step)
    who = WHO[worst.how].format(record=worst.record)
    return f"{_share(worst.of_step)} of the step of {readable(worst.step, unit)} of {who}"


def _beyond_band(evidence: Evidence, unit: str, spec: PDSpec) -> str:
    """Say which record is missed by more than the band where it was not fitted; empty if none.

    Of a move that is smaller than the step of the spec the error is held against that step: it is friction's or a
    play's, which stays. Of a larger one against the move itself: it grows with it.
    """
    uncertain = f"more than the band of {_share(spec.band)}: when the axis settles is not certain."
    if not evidence.missed:
        missed = evidence.heldout_of_step or 0.0
        told = f"Data that took no part in the fit are missed by {_share(missed)} of the step (r.m.s.)"
        return f"{told}, {uncertain}" if missed > spec.band else ""
    asked = abs(spec.reference)
    worst = max(evidence.missed, key=lambda missed: missed.rms / max(missed.step, asked))
    share = worst.rms / max(worst.step, asked)
    of_what = "the step asked for" if worst.step < asked else f"its step of {readable(worst.step, unit)}"
    who = _sentence(WHO[worst.how].format(record=worst.record)).rstrip(".")
    told = f"{who}, is missed by {readable(worst.rms, unit)} (r.m.s.), {_share(share)} of {of_what}"
    return f"{told}, {uncertain}" if share > spec.band else ""


def _share(share: float) -> str:
    return f"{100 * share:.2g} %"


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:].rstrip('.')}."
