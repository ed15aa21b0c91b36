"""One flat row for each axis: what a table of a fleet holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["FIRST_COLUMNS", "Row", "columns_of", "parameters_of", "row_of"]

Row: TypeAlias = "dict[str, str | float | bool | None]"
FIRST_COLUMNS = (
    "axis", "measured", "status", "sentence", "verdict", "causes", "data_light", "model_light", "gain_light", "kp",
    "kd", "recommended_kd", "settling_time", "probability", "remainder", "material", "heldout_error", "length_unit",
    "command_unit",
)  # fmt: skip
"""Columns that every table has; parameters, their standard errors and units follow."""
ERROR, UNIT = ":stderr", ":unit"


def row_of(result: Mapping[str, Any]) -> Row:
    """Return the row of a result of schema ``servolens.fleet-axis/1``.

    Parameters of the model are named ``gain``, ``damping``, ``coulomb_friction.level`` …; the columns of their standard
    errors and units end in ``:stderr`` and ``:unit``.
    """
    tuning = result["tuning"] or {}
    diagnosis = tuning.get("diagnosis") or {}
    recommended, remainder = tuning.get("recommended") or {}, diagnosis.get("remainder") or {}
    row: Row = {
        "axis": result["axis"],
        "measured": result["measured"],
        "status": result["status"],
        "sentence": result["sentence"] or tuning.get("reason"),
        "verdict": diagnosis.get("verdict"),
        "causes": "; ".join(cause["effect"] for cause in diagnosis.get("causes", [])) if diagnosis else None,
        **{f"{name}_light": (tuning.get(name) or {}).get("light") for name in ("data", "model", "gain")},
        "kp": tuning.get("kp"),
        "kd": tuning.get("kd"),
        "recommended_kd": recommended.get("kd"),
        "settling_time": recommended.get("settling_time"),
        "probability": (recommended.get("probability") or {}).get("value"),
        "remainder": remainder.get("of_travel"),
        "material": remainder.get("material"),
        "heldout_error": (diagnosis.get("extended") or {}).get("heldout_rms_error"),
        "length_unit": result["length_unit"],
        "command_unit": result["command_unit"],
    }
    for name, quantity in _quantities(diagnosis.get("model")).items():
        row |= {name: quantity["value"], name + ERROR: quantity.get("stderr"), name + UNIT: quantity.get("unit")}
    return row


def columns_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the columns of a table of these rows: the first ones, then the parameters that any of them has."""
    parameters = {
        name for row in rows for name in row if name not in FIRST_COLUMNS and not name.endswith((ERROR, UNIT))
    }
    order = ["gain", "damping", *sorted(parameters - {"gain", "damping"})]
    return (*FIRST_COLUMNS, *(name + tail for name in order for tail in ("", ERROR, UNIT)))


def parameters_of(rows: Sequence[Row]) -> dict[tuple[str, str], list[tuple[Row, float, float | None]]]:
    """Return by parameter and unit the rows that have it, with value and standard error."""
    found: dict[tuple[str, str], list[tuple[Row, float, float | None]]] = {}
    for name in columns_of(rows)[len(FIRST_COLUMNS) :]:
        if name.endswith((ERROR, UNIT)):
            continue
        for row in rows:
            value, error = row.get(name), row.get(name + ERROR)
            if isinstance(value, float | int):
                known = float(error) if isinstance(error, float | int) else None
                found.setdefault((name, str(row.get(name + UNIT) or "")), []).append((row, float(value), known))
    return found


def _quantities(model: Mapping[str, Any] | None) -> dict[str, Mapping[str, Any]]:
    """Return value, error and unit of each parameter of a model."""
    if model is None:
        return {}
    own = {name: model[name] for name in ("gain", "damping")}
    parts = {f"{e['effect']}.{name}": q for e in model["effects"] for name, q in e["parameters"].items()}
    return {name: quantity for name, quantity in {**own, **parts}.items() if quantity.get("value") is not None}
