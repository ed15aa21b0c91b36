"""Results as tables of pandas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    import pandas as pd

    from servolens.design import Design
    from servolens.diagnosis import Diagnosis
    from servolens.identification import Fit, Identification
    from servolens.model import Model, Quantity
    from servolens.prediction import Prediction
    from servolens.result import Result

    Row = dict[str, Any]

__all__ = ["frame_of", "trajectories"]


def frame_of(result: Result) -> pd.DataFrame:
    """Return the table of a result.

    Parameters
    ----------
    result : Result
        What was found.

    Returns
    -------
    pandas.DataFrame
        Of a fit or a diagnosis a row for each parameter: ``value``, ``stderr``, ``low`` and ``high`` (95 % interval),
        ``unit``; of a diagnosis also the cause's ``confidence``. Of an identification the same for each of its
        models. Of a prediction a row for each ``record`` and ``model`` with its errors. Of a design a row for the
        ``least`` and the ``recommended`` gain with their simulated steps.

    Raises
    ------
    InputError
        If pandas is not installed.
    """
    index, rows = ROWS[result.kind](result)
    return _frame(rows, index)


def trajectories(prediction: Prediction) -> pd.DataFrame:
    """Return measured and simulated positions: ``record``, ``time``, ``measured``, and a column for each model.

    Raises
    ------
    InputError
        If pandas is not installed, or the prediction was read from a file, which holds no trajectories.
    """
    if not prediction.records:
        raise InputError("this prediction was read from a file, which holds no trajectories; predict again")
    rows: list[Row] = []
    for record, found in zip(prediction.records, prediction.positions, strict=True):
        models = dict(zip(prediction.models, found, strict=True))
        for i, (time, measured) in enumerate(zip(record.time.tolist(), record.position.tolist(), strict=True)):
            simulated = {name: float(position[i]) for name, position in models.items()}
            rows.append({"record": record.name, "time": time, "measured": measured, **simulated})
    return _frame(rows, None)


def _fit(fit: Fit) -> tuple[str, list[Row]]:
    return "parameter", _parameters(fit.quantities)


def _identification(found: Identification) -> tuple[list[str], list[Row]]:
    models: list[tuple[str, Model]] = [
        (name, model) for name, model in (("constant", found.constant), ("velocity", found.velocity)) if model
    ]
    rows = [{"model": name, **row} for name, model in models for row in _parameters(model.quantities)]
    return ["model", "parameter"], rows


def _diagnosis(diagnosis: Diagnosis) -> tuple[str, list[Row]]:
    sure = {cause.effect: cause.confidence for cause in diagnosis.causes}
    rows = _parameters(diagnosis.model.quantities)
    return "parameter", [{**row, "confidence": sure.get(row["parameter"].partition(".")[0])} for row in rows]


def _design(design: Design) -> tuple[str, list[Row]]:
    least = max(design.verified, key=lambda response: response.settling_time or float("inf"), default=None)
    rows: list[Row] = []
    if least is not None:
        rows.append(_gain("least", least.kd, least.settling_time, least.overshoot, meets=least.meets))
    chosen = design.recommended
    if chosen is not None:
        row = _gain("recommended", chosen.kd, chosen.settling_time, chosen.overshoot, meets=True)
        rows.append({**row, "probability": chosen.probability})
    return "gain", rows


def _gain(name: str, kd: float, settling_time: float | None, overshoot: float, *, meets: bool) -> Row:
    return {"gain": name, "kd": kd, "settling_time": settling_time, "overshoot": overshoot, "meets": meets}


def _prediction(prediction: Prediction) -> tuple[list[str], list[Row]]:
    rows = [
        {"record": error.name, "model": model, **{k: v for k, v in error.to_json().items() if k != "name"}}
        for found in prediction.errors
        for model, error in zip(prediction.models, found, strict=True)
    ]
    return ["record", "model"], rows


def _parameters(quantities: Mapping[str, Quantity]) -> list[Row]:
    rows: list[Row] = []
    for name, quantity in quantities.items():
        low, high = quantity.interval or (None, None)
        value = {"parameter": name, "value": quantity.value, "stderr": quantity.stderr, "low": low, "high": high}
        rows.append({**value, "unit": quantity.unit})
    return rows


def _frame(rows: Iterable[Row], index: str | list[str] | None) -> pd.DataFrame:
    try:
        import pandas as pd
    except ImportError:
        raise InputError("a table needs pandas; install it, e.g. pip install 'servolens[dataframe]'") from None
    frame = pd.DataFrame(list(rows))
    return frame if index is None or frame.empty else frame.set_index(index)


ROWS: dict[str, Callable[[Any], tuple[Any, list[Row]]]] = {
    "fit": _fit,
    "identification": _identification,
    "diagnosis": _diagnosis,
    "design": _design,
    "prediction": _prediction,
}
