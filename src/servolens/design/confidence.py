"""How far a model and the gain designed on it can be trusted, as lights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.design.found import Light
from servolens.design.recommended import NINE_OF_TEN
from servolens.design.settle import closed_loop_gain, evaluate
from servolens.effects import Saturation
from servolens.inputs import as_models
from servolens.model_evidence import MATERIAL

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.found import Design
    from servolens.design.response import Response
    from servolens.inputs import Plants
    from servolens.model import Model
    from servolens.model_evidence import Evidence
    from servolens.plant import Plant

__all__ = ["trust"]

MISSED = 0.05
"""R.m.s. of the held-out error over the step from which on a model is not that of the axis."""
BEYOND, FAR = 1.01, 1.5
"""Times the largest value in the records from which on the answer is an extrapolation (a percent is the noise of a
measured step), and from which on it is not to be given."""
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
                f" more than {100 * MISSED:g} %: this model is not that of the axis."
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
                f"The model misses {share} beyond the noise, which nothing explains; the scenarios carry it as a force."
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
        return Light(light="red", sentence=f"A gain would be designed on a wrong model. {of_model.sentence}")
    if chosen is not None and chosen.probability < NINE_OF_TEN:
        return Light(
            light="red",
            sentence=(
                f"No gain meets the spec in nine of ten plants: the best of them in {100 * chosen.probability:.3g} % of"
                f" {chosen.scenarios}, with what the model leaves unexplained as a force."
            ),
        )
    beyond = _worst([_beyond(model, design, kd) for model in models])
    if beyond.light != "green":
        return beyond
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
    if chosen.interval[0] < NINE_OF_TEN:
        return Light(light="amber", sentence=f"It meets the spec in hardly nine of ten plants: {chosen.why}.")
    return Light(light="green", sentence=_sentence(chosen.why))


def _beyond(model: Model, design: Design, kd: float) -> Light:
    """Judge how far the answer lies beyond what the records of a model showed."""
    if model.evidence is None:
        return Light(light="green", sentence="")
    return _worst([_beyond_range(model, model.evidence, design, kd), _beyond_error(model, model.evidence, design, kd)])


def _beyond_range(model: Model, evidence: Evidence, design: Design, kd: float) -> Light:
    """Judge voltage, speed and amplitude of the step by the largest of the records."""
    shown, unit = evidence.range, model.plant.length_unit
    response = evaluate(model.plant, design.spec, kd)
    asked = {
        "voltage": (_applied(model.plant, response), shown.voltage, model.plant.command_unit),
        "speed": (response.peak_speed, shown.speed, f"{unit}/s"),
        "step": (abs(design.spec.reference), shown.step, unit),
    }
    ratios = {name: wanted / max(known, 1e-300) for name, (wanted, known, _) in asked.items()}
    name = max(ratios, key=ratios.__getitem__)
    wanted, known, unit = asked[name]
    if ratios[name] <= BEYOND:
        return Light(light="green", sentence="")
    far = ratios[name] > FAR
    return Light(
        light="red" if far else "amber",
        sentence=(
            f"An extrapolation: the {name} reaches {wanted:.3g} {unit}, that of the records {known:.3g}"
            f"{f' (more than {FAR:g} times)' if far else ''}; log a record with a larger {name}."
        ),
    )


def _beyond_error(model: Model, evidence: Evidence, design: Design, kd: float) -> Light:
    """Judge what the loop makes of the model's error at each frequency by what the loops of the records made of it.

    Either the records bear it out, whose loops were stable; or the small-gain theorem does, with a reserve of `FAR`.
    """
    error, spec = evidence.model_error, design.spec
    if error is None:
        return Light(light="green", sentence="")
    size, loop = np.array(error.size), np.array(error.loop)
    asked = closed_loop_gain(model.plant, spec, kd, np.array(error.frequency)) * size
    ratios = asked / np.maximum(loop * size, 1.0 / FAR)
    worst = int(np.argmax(ratios))
    if ratios[worst] <= BEYOND:
        return Light(light="green", sentence="")
    far, share = ratios[worst] > FAR, float(f"{100 * size[worst]:.2g}")
    known = "" if evidence.range.kd is None else f" (largest so far: {evidence.range.kd:.3g})"
    return Light(
        light="red" if far else "amber",
        sentence=(
            f"An extrapolation: at {error.frequency[worst]:.3g} Hz the model may be wrong by {share:g} %,"
            f" and kd = {kd:.3g} makes {ratios[worst]:.3g} times as much of that as the records prove to be stable"
            f"{f' (more than {FAR:g} times)' if far else ''}; log a record with a kd nearer to it{known}."
        ),
    )


def _applied(plant: Plant, response: Response) -> float:
    """Return the largest voltage behind the amplifier's limit, where the plant has one."""
    limit = plant.effect(Saturation.name)
    return min(response.peak_voltage, limit.limit if isinstance(limit, Saturation) else np.inf)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:].rstrip('.')}."
