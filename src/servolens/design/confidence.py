"""How far a model and the gain designed on it can be trusted, as lights."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.design.extrapolation import BEYOND, extrapolation
from servolens.design.found import Light
from servolens.design.recommended import NINE_OF_TEN
from servolens.inputs import as_models
from servolens.model_evidence import MATERIAL

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.found import Design
    from servolens.inputs import Plants
    from servolens.model import Model
    from servolens.model_evidence import Evidence

__all__ = ["trust"]

MISSED = 0.05
"""R.m.s. of the held-out error over the step from which on the model, or the loop that is stated, is wrong."""
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
    of_model = _worst([_model_light(model.evidence) for model in known])
    if design is None:
        return of_model, Light(light="red", sentence="No gain was sought.")
    return of_model, _gain_light(known, design, of_model)


def _worst(lights: Sequence[Light]) -> Light:
    return max(lights, key=lambda light: ORDER.index(light.light))


def _model_light(evidence: Evidence | None) -> Light:
    if evidence is None:
        return Light(light="amber", sentence="Nothing is known of how well this model describes the axis.")
    if evidence.fatal:
        return Light(light="red", sentence=f"The records speak against the model: {evidence.fatal[0]}")
    missed, left = evidence.heldout_of_step, evidence.remainder
    if missed is not None and missed > MISSED:
        return Light(
            light="red",
            sentence=(
                f"On data that took no part in the fit the simulation misses {100 * missed:.2g} % of the step (r.m.s.),"
                f" more than {100 * MISSED:g} %: the model, or what the records state of their loop, is wrong."
            ),
        )
    if left is None:
        return Light(
            light="amber", sentence="Nobody looked for what this model misses; run `servolens diagnose` on its records."
        )
    share = f"{100 * left.of_travel:.2g} % of the travel"
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
                f"The simulation misses {share} beyond the noise, but on data that took no part in the fit"
                f" {100 * missed:.2g} % of the step: fit these data too."
            ),
        )
    tested = "" if missed is None else f", and on data that took no part in the fit {100 * missed:.2g} % of the step"
    verdict = "" if evidence.verdict is None else f"{evidence.verdict.replace('_', ' ').capitalize()}: "
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
                f" {chosen.scenarios}, with what the model leaves unexplained as a force."
            ),
        )
    beyond = max((extrapolation(model, design.spec, kd) for model in models), key=lambda one: one.ratio)
    if beyond.ratio > BEYOND:
        return Light(light="red" if beyond.is_far else "amber", sentence=beyond.sentence)
    missed = max((m.evidence.heldout_of_step or 0.0 for m in models if m.evidence is not None), default=0.0)
    if missed > design.spec.band:
        return Light(
            light="amber",
            sentence=(
                f"Data that took no part in the fit are missed by {100 * missed:.2g} % of the step (r.m.s.), more than"
                f" the band of {100 * design.spec.band:.2g} %: when the axis settles is not certain."
            ),
        )
    swing = design.hunting.get("least" if chosen is None else "recommended")
    if swing is not None:
        return Light(
            light="amber",
            sentence=(
                f"The axis does not come to rest from all starts: it keeps swinging by ±{swing.amplitude:.3g}"
                f" {models[0].plant.length_unit}."
            ),
        )
    if chosen is None:
        return Light(light="green", sentence=f"{design.spec.free} = {kd:.4g} meets the spec on the model.")
    if chosen.worst.settling_time is None:
        return Light(
            light="amber", sentence=f"The worst of {chosen.scenarios} plants does not settle at all: {chosen.why}."
        )
    if chosen.interval[0] < NINE_OF_TEN:
        return Light(light="amber", sentence=f"It meets the spec in hardly nine of ten plants: {chosen.why}.")
    return Light(light="green", sentence=_sentence(chosen.why))


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:].rstrip('.')}."
