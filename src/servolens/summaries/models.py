"""What an identification and a prediction say."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import VelocityDecayDamping
from servolens.identification.fit_findings import LEAST_DAMPING
from servolens.model import NORMAL_95, Quantity
from servolens.plant import Plant
from servolens.summaries.wording import (
    capital,
    interval,
    listed,
    number,
    percent,
    plus_minus,
    scale,
    undetermined,
    unit,
)
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification import Identification
    from servolens.identification.varying import VaryingDamping
    from servolens.model import Model
    from servolens.plant import Plant
    from servolens.prediction import Prediction, RecordError

__all__ = ["MODEL_WORDS", "determined", "identification_summary", "model_table", "prediction_summary"]

MODEL_WORDS = {
    "velocity": "damping that depends on speed",
    "constant": "constant damping",
    "varying": "damping that varies in time",
}
"""In the order in which people are told."""
DATA = {True: "held out", False: "used", None: "–"}
"""Whether a record is held out; None where it is not known what the models were identified from."""


def identification_summary(identification: Identification) -> Summary:
    """Tell how well each model simulates its own records, then its parameters."""
    models = {"constant": identification.constant, "velocity": identification.velocity}
    sentences = [_accuracy(identification), *_damping_law(identification.velocity)]
    for kind, model in models.items():
        sentences += [] if model is None else _doubtful(kind, model)
    tables = [
        replace(model_table(model, capital(MODEL_WORDS[kind])), note=_unknown(model))
        for kind, model in models.items()
        if model is not None
    ]
    if identification.varying is not None:
        place = 1 if identification.constant else 0
        tables[place:place] = _varying_table(identification.varying, identification.gain_unit)
    if identification.errors:
        tables.append(_errors_table(identification))
    return Summary(
        title=f"Identified from {listed(identification.names)}",
        sentences=tuple(sentences),
        tables=tuple(tables),
        findings=identification.findings,
    )


def model_table(model: Model, title: str) -> Table:
    """Return the parameters of `model` with their errors and intervals."""
    rows = []
    for name, quantity in model.quantities.items():
        rows.append((name.rpartition(".")[2], plus_minus(quantity), interval(quantity), unit(quantity.unit)))
    effects = [effect.name for effect in model.plant.effects]
    unknown = _unknown(model)
    return Table(
        title=title,
        columns=("Parameter", "Value ± standard error", "95 % interval", "Unit"),
        rows=tuple(rows),
        note=" ".join(part for part in (f"Effects: {listed(effects)}." if effects else "", unknown) if part),
    )


def _unknown(model: Model) -> str:
    return undetermined({name.rpartition(".")[2]: quantity for name, quantity in model.quantities.items()})


def prediction_summary(
    prediction: Prediction,
    *,
    voltage_driven: Sequence[str] = (),
    length_unit: str = "m",
) -> Summary:
    """Tell how far the models are from the records.

    Parameters
    ----------
    prediction : Prediction
        The errors.
    voltage_driven : sequence of str
        Names of the records that were simulated from their voltage, not in closed loop.
    length_unit : str
        Of the records.
    """
    names = [row[0].name for row in prediction.errors]
    held = [name for name in names if prediction.is_held_out(name)]
    sentences = [
        f"{_subject(model)} is {percent(average)} of the step off on average over {_records(len(names))}."
        for model, average in zip(prediction.models, prediction.average_percent, strict=True)
    ]
    if prediction.identified_from:
        sentences.append(_data(names, held))
    driven = [name for name in names if name in voltage_driven]
    if driven:
        sentences.append(f"Simulated from the logged voltage, not in closed loop: {listed(driven)}.")
    single = len(prediction.models) == 1
    table = _single(prediction, length_unit) if single else _many(prediction)
    return Summary(title="Prediction", sentences=tuple(sentences), tables=(table,))


def _subject(name: str) -> str:
    """Return a model's name as it begins a sentence: one that the user gave stays as it is.

    Examples
    --------
    >>> _subject("the model"), _subject("model 2"), _subject("arm, cold")
    ('The model', 'Model 2', 'The model "arm, cold"')
    """
    is_own = name == "the model" or (name.startswith("model ") and name[len("model ") :].isdecimal())
    return capital(name) if is_own else f'The model "{name}"'


def _accuracy(identification: Identification) -> str:
    """Compare the models' errors in one sentence."""
    parts = []
    for kind, words in MODEL_WORDS.items():
        if kind in identification.errors:
            errors = [error.percent_error for error in identification.errors[kind]]
            parts.append((words, percent(float(np.mean(errors)))))
    if not parts:
        return "No model of these records can be simulated in closed loop without diverging."
    (first, error), *others = parts
    text = f"With {first} the simulated step is {error} of the step off on average"
    text += "".join(f"; with {words} {value}" for words, value in others)
    return f"{text} (on the records it was identified from)."


def _damping_law(model: Model | None) -> list[str]:
    law = None if model is None else model.plant.effect(VelocityDecayDamping.name)
    if model is None or not isinstance(law, VelocityDecayDamping) or law.alpha2 <= 0:
        return []
    if not all(_is_told(model.quantities[f"{law.name}.{name}"]) for name in ("alpha1", "alpha2")):
        return []
    verb = "falls" if law.alpha1 > 0 else "rises"
    still, fast = model.plant.damping + law.alpha1, model.plant.damping
    half = math.log(2.0) / law.alpha2
    factor, length = scale([half], model.plant.length_unit)
    return [
        f"Damping {verb} from {number(still, 3)} 1/s at standstill to {number(fast, 3)} 1/s at high speed;"
        f" the midpoint is at {number(factor * half, 2)} {length}/s."
    ]


def _doubtful(kind: str, model: Model) -> list[str]:
    """Name the parameters that stand at a bound or are not determined."""
    told = []
    for qualified, quantity in model.quantities.items():
        name = f"{capital(MODEL_WORDS[kind])}: {qualified.rpartition('.')[2]}"
        if bound := _bound(model.plant, qualified, quantity.value):
            told.append(f"{name} stands at its bound {bound}.")
        elif quantity.stderr is None:
            told.append(f"{name} has no standard error: {quantity.reason or 'it is not known'}.")
        elif quantity.value and not _is_told(quantity):
            told.append(f"{name} is not significantly different from zero (95 % interval {interval(quantity)}).")
    return told


def _is_told(quantity: Quantity) -> bool:
    """Whether a value has an error and differs significantly from zero."""
    return quantity.stderr is not None and abs(quantity.value) >= NORMAL_95 * quantity.stderr


def _bound(plant: Plant, name: str, value: float) -> str:
    spec = plant.parameters[name]
    at = next((b for b in (spec.low, spec.high) if math.isclose(value, b, rel_tol=1e-9, abs_tol=1e-12)), None)
    return "" if at is None else f"{number(at)} {unit(plant.unit(name))}"


def _varying_table(varying: VaryingDamping, gain_unit: str) -> list[Table]:
    """Return the pieces that the data determine; no table where there are none."""
    length_unit = gain_unit.partition("/")[0]
    errors = np.sqrt(np.maximum(np.diag(varying.covariance), 0.0))
    rows = [
        (
            f"{number(start, 3)} to {number(end, 3)}",
            plus_minus(Quantity(value=float(c), stderr=float(error), unit="1/s")),
            number(float(speed), 3),
        )
        for start, end, c, error, speed, is_known in zip(
            varying.edges[:-1],
            varying.edges[1:],
            varying.damping,
            errors,
            varying.speed,
            determined(varying),
            strict=False,
        )
        if is_known
    ]
    if not rows:
        return []
    lost = varying.damping.size - len(rows)
    left_out = f" The data hardly determine the other {lost} of {varying.damping.size} pieces." if lost else ""
    gain = plus_minus(Quantity(value=varying.gain, stderr=float(errors[-1]), unit=gain_unit))
    active = f" Constraints that hold with equality: {listed(varying.active)}." if varying.active else ""
    table = Table(
        title=capital(MODEL_WORDS["varying"]),
        columns=("Time since the step [s]", "Damping ± standard error [1/s]", f"Mean |speed| [{length_unit}/s]"),
        rows=tuple(rows),
        note=f"Gain {gain} {unit(gain_unit)}.{active}{left_out}",
    )
    return [table]


def determined(varying: VaryingDamping) -> NDArray[np.bool_]:
    """Return which pieces of time the data say something of: their error is smaller than their damping."""
    errors = np.sqrt(np.maximum(np.diag(varying.covariance), 0.0))[: varying.damping.size]
    return np.asarray(errors < np.maximum(varying.damping, LEAST_DAMPING))


def _errors_table(identification: Identification) -> Table:
    kinds = [kind for kind in ("constant", "varying", "velocity") if kind in identification.errors]
    rows = [
        (name, *(number(identification.errors[kind][i].percent_error, 3) for kind in kinds))
        for i, name in enumerate(identification.names)
    ]
    return Table(
        title="Mean error of the simulated step [% of the step]",
        columns=("Record", *(capital(MODEL_WORDS[kind]) for kind in kinds)),
        rows=tuple(rows),
        note="On the records it was identified from; other records tell more.",
    )


def _data(names: Sequence[str], held: Sequence[str]) -> str:
    if not held:
        return "It was identified from these very records; other records tell more."
    if len(held) == len(names):
        return "The data are held out: the model was not identified from them."
    return f"Held out: {listed(held)}; the model was identified from the others."


def _records(count: int) -> str:
    return "1 record" if count == 1 else f"{count} records"


def _single(prediction: Prediction, length_unit: str) -> Table:
    errors: list[RecordError] = [row[0] for row in prediction.errors]
    factor, length = scale([e.mean_abs_error for e in errors], length_unit)
    rows = [
        (
            e.name,
            number(factor * e.mean_abs_error, 3),
            number(e.percent_error, 3),
            number(e.fit_percent),
            DATA[prediction.is_held_out(e.name)],
        )
        for e in errors
    ]
    return Table(
        title=f"Errors of {prediction.models[0]}",
        columns=("Record", f"Mean |error| [{length}]", "Error [%]", "Fit [%]", "Data"),
        rows=tuple(rows),
        note="Error: mean |error| in percent of the step. Fit: 100 % is perfect, 0 % no better than the mean position.",
    )


def _many(prediction: Prediction) -> Table:
    rows = [
        (row[0].name, *(number(e.percent_error, 3) for e in row), DATA[prediction.is_held_out(row[0].name)])
        for row in prediction.errors
    ]
    rows.append(("average", *(number(average, 3) for average in prediction.average_percent), ""))
    return Table(title="Mean error [% of the step]", columns=("Record", *prediction.models, "Data"), rows=tuple(rows))
