"""What the page's simulator has to know of a loop and of its axes, and the scripts that it is made of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.design.rest import held_by
from servolens.design.settle import FEASIBLE
from servolens.effects import Saturation
from servolens.simulation.javascript import ERF, plant_script
from servolens.simulation.rates import (
    FINE_SUBSTEPS,
    MOST_SUBSTEPS,
    STAMP_ROUNDING,
    STIFF_STEP_TIMES_RATE,
    least_substeps,
    rate_of,
    step_times_rate,
    substeps_for,
)
from servolens.simulation.settings import ANY_NUMBER, NO_LAW, NO_OBSERVER, OPEN_LOOP, known, law_settings, loop_settings
from servolens.simulation.translated import rule_places, rule_script

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design import PDSpec
    from servolens.design.scenarios import Scenario
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["axis_json", "design_json", "plants_script", "simulator_script"]

FOLDER = Path(__file__).parent
SUBSTEPS = {
    "rounding": STAMP_ROUNDING,
    "coarse": STIFF_STEP_TIMES_RATE,
    "few": FINE_SUBSTEPS,
    "most": MOST_SUBSTEPS,
}


def simulator_script() -> str:
    """Return JavaScript that defines ``servolensRule`` and ``servolensSimulator``."""
    return rule_script() + ERF + (FOLDER / "simulator.js").read_text(encoding="utf-8")


def plants_script(plants: Sequence[tuple[str, str]]) -> str:
    """Return JavaScript that defines ``servolensPlants``, by their names."""
    members = ",\n".join(f'"{name}": {text}' for name, text in plants)
    return f"const servolensPlants = {{\n{members}\n}};\n"


def plant_of(spec: PDSpec, structure: tuple[type[Effect], ...]) -> str:
    """Return the JavaScript of plants of a structure in the loop of `spec`."""
    return plant_script(structure, continuous=spec.control == "continuous")


def design_json(spec: PDSpec, plant: Plant) -> dict[str, Any]:
    """Return what ``servolensSimulator`` has to know of a loop; see ``simulator.js``."""
    loop = _settings(spec, plant)
    return {
        "law": spec.controller,
        "continuous": spec.control == "continuous",
        "antiWindup": spec.anti_windup,
        "reference": spec.reference,
        "band": spec.band,
        "settling": spec.settling_time,
        "sample": spec.sample_time,
        "overshoot": spec.overshoot,
        "limit": spec.voltage_limit,
        "feasible": FEASIBLE,
        "substeps": SUBSTEPS,
        "places": rule_places(),
        "loop": [float(value) if np.isfinite(value) else None for value in loop],
    }


def axis_json(name: str, plant: Plant, spec: PDSpec, gain: float, scenario: Scenario | None = None) -> dict[str, Any]:
    """Return what it has to know of an axis whose equations of motion are called `name`.

    A scenario has a plant of its own, and gains that are realised as well as they can be. What holds the axis before
    its step is worked out for the loop of the spec with `gain`; for others it is a straight line through that.
    """
    saturation = plant.effect(Saturation.name)
    realised, back = (1.0, False) if scenario is None else (scenario.realised, scenario.back)
    loop = (spec if scenario is None else scenario.spec).loop(realised * gain)
    return {
        "plant": name,
        "values": list(plant.driven_values),
        "held": held_by(plant, loop, spec.reference if back else 0.0),
        "gain": plant.gain,
        "delay": plant.delay,
        "limit": saturation.limit if isinstance(saturation, Saturation) else None,
        "rate": rate_of(plant) if spec.control == "continuous" else 0.0,
        "fine": step_times_rate(plant.structure),
        "least": least_substeps(plant, spec.sample_time),
        "substeps": substeps_for(plant, spec.sample_time),
        "realised": realised,
        "back": back,
    }


def _settings(spec: PDSpec, plant: Plant) -> list[float]:
    """Return what the rule is told of the loop, its gains and what holds the axis before its step aside."""
    still = [ANY_NUMBER, *known(0.0), *NO_OBSERVER]
    if spec.control == "continuous":
        return [*OPEN_LOOP, *still, *NO_LAW]
    controller = spec.loop(1.0)
    limit = None if plant.effect(Saturation.name) is not None else np.inf
    law = law_settings(plant, controller, limit)
    return [1.0, *loop_settings(controller, spec.sample_time), 0.0, *still, *law]
