"""From one measured step to a PD gain you can trust."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servolens.bridge import (
        ResponseWarning,
        check_response,
        closed_loop,
        digital_controller,
        held_response,
        to_control,
    )
    from servolens.campaign import read_records
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
    from servolens.effects import (
        ActuatorLag,
        AsymmetricDamping,
        AsymmetricFriction,
        Backlash,
        Cogging,
        ConstantForce,
        CoulombFriction,
        DeadZone,
        Delay,
        EndStop,
        FlexibleCoupling,
        ForceLimit,
        FrictionMap,
        GainDrift,
        HardeningSpring,
        LoadFriction,
        PendulumGravity,
        PeriodicDisturbance,
        PositionFriction,
        Presliding,
        QuadraticDrag,
        ReturnSpring,
        Saturation,
        SensorLag,
        SpeedServo,
        StribeckFriction,
        VelocityDecayDamping,
    )
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
    from servolens.quality import assess, check
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

_HOMES = {
    "bridge": (
        "ResponseWarning",
        "check_response",
        "closed_loop",
        "digital_controller",
        "held_response",
        "to_control",
    ),
    "campaign": ("read_records",),
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
    "effects": (
        "ActuatorLag",
        "AsymmetricDamping",
        "AsymmetricFriction",
        "Backlash",
        "Cogging",
        "ConstantForce",
        "CoulombFriction",
        "DeadZone",
        "Delay",
        "EndStop",
        "FlexibleCoupling",
        "ForceLimit",
        "FrictionMap",
        "GainDrift",
        "HardeningSpring",
        "LoadFriction",
        "PendulumGravity",
        "PeriodicDisturbance",
        "PositionFriction",
        "Presliding",
        "QuadraticDrag",
        "ReturnSpring",
        "Saturation",
        "SensorLag",
        "SpeedServo",
        "StribeckFriction",
        "VelocityDecayDamping",
    ),
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
    "quality": ("assess", "check"),
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
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "ActuatorLag",
    "AsymmetricDamping",
    "AsymmetricFriction",
    "Backlash",
    "Cogging",
    "Comparison",
    "ConstantForce",
    "Controller",
    "CoulombFriction",
    "DeadZone",
    "Delay",
    "Design",
    "Diagnosis",
    "EndStop",
    "Fit",
    "FlexibleCoupling",
    "ForceLimit",
    "FrictionMap",
    "GainDrift",
    "GainMap",
    "GainWishes",
    "HardeningSpring",
    "Identification",
    "InputError",
    "Light",
    "LoadFriction",
    "Model",
    "NumericalError",
    "PDSpec",
    "PendulumGravity",
    "PeriodicDisturbance",
    "Plant",
    "PositionFriction",
    "Prediction",
    "Presliding",
    "Prior",
    "QuadraticDrag",
    "Quantity",
    "Record",
    "ResponseWarning",
    "ReturnSpring",
    "Saturation",
    "SensorLag",
    "ServolensError",
    "Simulation",
    "SpeedServo",
    "StribeckFriction",
    "Study",
    "VelocityDecayDamping",
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
]


def __getattr__(name: str) -> Any:
    """Load what is asked for when it is asked for, so that ``import servolens`` stays quick."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'servolens' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"servolens.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
