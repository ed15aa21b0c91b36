"""What the small page of one axis says, from its result file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servolens.model import Quantity
from servolens.reading.files import printable
from servolens.summaries.names import spoken, spoken_parameter
from servolens.summaries.wording import number, value_and_error

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = ["axis_content"]

VERDICTS = {
    "healthy": "Gain and damping explain the data to noise level.",
    "explained": "With its causes the model explains the data to noise level.",
    "partly_explained": "The causes below explain part of what gain and damping miss; something is left.",
    "unexplained": "Gain and damping miss something that no cause explains.",
}


def axis_content(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a result of schema ``servolens.fleet-axis/1``."""
    tuning = result["tuning"] or {}
    diagnosis = tuning.get("diagnosis") or {}
    lights = [(name, _light(tuning[name])) for name in ("data", "model", "gain") if tuning.get(name)]
    return {
        "lead": _lead(result, diagnosis),
        "lights": lights,
        "causes": [_cause(cause) for cause in diagnosis.get("causes", [])],
        "parameters": list(_parameters(diagnosis.get("model"))),
        "gain": list(_gain(result, tuning)),
        "reason": printable(str(tuning.get("reason") or "")),
        "findings": [_finding(finding) for finding in result["findings"]],
        "records": [printable(name) for name in result["records"]],
    }


def _lead(result: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> str:
    if result["status"] != "done":
        return f"This axis could not be studied: {printable(result['sentence'])}"
    return VERDICTS.get(diagnosis.get("verdict", ""), "What the model misses is unknown.")


def _light(light: Mapping[str, Any]) -> dict[str, str]:
    return {"light": str(light["light"]), "sentence": str(light["sentence"])}


def _finding(finding: Mapping[str, Any]) -> dict[str, str]:
    told = {name: str(finding[name]) for name in ("severity", "message")}
    return {**told, "message": printable(told["message"]), "record": printable(str(finding["record"] or ""))}


def _cause(cause: Mapping[str, Any]) -> tuple[str, str]:
    """Return a cause's sentence, and what else it may be."""
    rivals = ", ".join(spoken(rival) for rival in cause["rivals"])
    return str(cause["sentence"]), f"These data cannot tell it from {rivals}." if rivals else ""


def _parameters(model: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    """Yield each parameter's name and value with its standard error."""
    if model is None:
        return
    for name in ("gain", "damping"):
        yield name.capitalize(), _told(model[name])
    for effect in model["effects"]:
        for name, quantity in effect["parameters"].items():
            yield f"{spoken(effect['effect'])}: {spoken_parameter(name)}", _told(quantity)


def _told(quantity: Mapping[str, Any]) -> str:
    if quantity.get("value") is None:
        return "–"
    known = Quantity(value=quantity["value"], unit=quantity.get("unit") or "", stderr=quantity.get("stderr"))
    return value_and_error(known)


def _gain(result: Mapping[str, Any], tuning: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what is known of the gain: name and value."""
    chosen = tuning.get("recommended")
    unit = f"{result['command_unit']} s/{result['length_unit']}"
    if chosen:
        yield "Recommended Kd", f"{number(chosen['kd'])} {unit}"
        if chosen.get("settling_time") is not None:
            yield "Settling time with it", f"{number(chosen['settling_time'])} s"
    if tuning.get("kd") is not None:
        yield "Least Kd", f"{number(tuning['kd'])} {unit}"
    if tuning.get("kp") is not None and (chosen or tuning.get("kd") is not None):
        yield "Kp", number(tuning["kp"])
