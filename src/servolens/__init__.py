"""From one measured step to a PD gain you can trust."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servolens import bridge, design, effects, lab, simulation
    from servolens.bridge import (
        ResponseWarning,
        check_response,
        closed_loop,
        digital_controller,
        held_response,
        to_control,
    )
    from servolens.campaign import read_records
    from servolens.checking import check
    from servolens.design import (
        Comparison,
        Design,
        GainMap,
        GainWishes,
        Light,
        PDSpec,
        compare,
        feedforward,
        gain_map,
        recommend,
        tune_gains,
    )
    from servolens.design.confidence import trust
    from servolens.diagnosis import Diagnosis, diagnose
    from servolens.effects import *  # noqa: F403 - what the catalogue holds
    from servolens.errors import InputError, NumericalError, ServolensError
    from servolens.identification import (
        Fit,
        Identification,
        Prior,
        bootstrap,
        fit,
        identify,
        profile,
    )
    from servolens.model import Model, Quantity, read_model
    from servolens.plant import Plant
    from servolens.prediction import Prediction, predict
    from servolens.quality import assess
    from servolens.reading import read_record, record_from_dataframe, record_from_timeresponse
    from servolens.record import Controller, Record
    from servolens.report import write_report
    from servolens.simulation import (
        Simulation,
        simulate,
        simulate_continuous,
        simulate_loop,
        simulate_many,
        simulate_voltage,
    )
    from servolens.study import Study, study_records, tune

__version__ = "0.1.0"

_HOMES: dict[str, tuple[str, ...]] = {
    "bridge": (
        "ResponseWarning",
        "check_response",
        "closed_loop",
        "digital_controller",
        "held_response",
        "to_control",
    ),
    "campaign": ("read_records",),
    "checking": ("check",),
    "design": (
        "Comparison",
        "Design",
        "GainMap",
        "GainWishes",
        "Light",
        "PDSpec",
        "compare",
        "feedforward",
        "gain_map",
        "recommend",
        "tune_gains",
    ),
    "design.confidence": ("trust",),
    "diagnosis": ("Diagnosis", "diagnose"),
    "errors": ("InputError", "NumericalError", "ServolensError"),
    "identification": (
        "Fit",
        "Identification",
        "Prior",
        "bootstrap",
        "fit",
        "identify",
        "profile",
    ),
    "model": ("Model", "Quantity", "read_model"),
    "plant": ("Plant",),
    "prediction": ("Prediction", "predict"),
    "quality": ("assess",),
    "reading": ("read_record", "record_from_dataframe", "record_from_timeresponse"),
    "record": ("Controller", "Record"),
    "report": ("write_report",),
    "simulation": (
        "Simulation",
        "simulate",
        "simulate_continuous",
        "simulate_loop",
        "simulate_many",
        "simulate_voltage",
    ),
    "study": ("Study", "study_records", "tune"),
}
_OTHERS = ("base", "kinds")
_HOMES["effects"] = tuple(
    file.stem.title().replace("_", "")
    for file in sorted(Path(__file__).with_name("effects").glob("[!_]*.py"))
    if file.stem not in _OTHERS
)
"""A class for each file of the catalogue."""
_ROOMS = ("bridge", "design", "effects", "lab", "simulation")
"""Subpackages that scripts use by their names."""
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Comparison",
    "Controller",
    "Design",
    "Diagnosis",
    "Fit",
    "GainMap",
    "GainWishes",
    "Identification",
    "InputError",
    "Light",
    "Model",
    "NumericalError",
    "PDSpec",
    "Plant",
    "Prediction",
    "Prior",
    "Quantity",
    "Record",
    "ResponseWarning",
    "ServolensError",
    "Simulation",
    "Study",
    "__version__",
    "assess",
    "bootstrap",
    "check",
    "check_response",
    "closed_loop",
    "compare",
    "diagnose",
    "digital_controller",
    "feedforward",
    "fit",
    "gain_map",
    "held_response",
    "identify",
    "predict",
    "profile",
    "read_model",
    "read_record",
    "read_records",
    "recommend",
    "record_from_dataframe",
    "record_from_timeresponse",
    "simulate",
    "simulate_continuous",
    "simulate_loop",
    "simulate_many",
    "simulate_voltage",
    "study_records",
    "to_control",
    "trust",
    "tune",
    "tune_gains",
    "write_report",
    "bridge",
    "design",
    "effects",
    "lab",
    "simulation",
    *_HOMES["effects"],
]


def __getattr__(name: str) -> Any:
    """Load what is asked for when it is asked for, so that ``import servolens`` stays quick."""
    if name in _ROOMS:
        return importlib.import_module(f"servolens.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'servolens' has no attribute {name!r}{_meant(name)}")
    value = getattr(importlib.import_module(f"servolens.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def _meant(name: str) -> str:
    from servolens.errors import names_like

    offer = "" if name.startswith("_") else names_like(name, __all__, "")
    return f"; {offer}" if offer.endswith("?") else ""


def __dir__() -> list[str]:
    return sorted(__all__)
