"""An effect of your own: friction that grows along the travel, fitted, simulated, linearised, written and read back.

The class below is all there is to it: the physics is written once, as a CasADi expression, and simulation, fit, bridge
to python-control and model file derive from it. A package offers it to the command line too, by an entry point:

    [project.entry-points."servolens.effects"]
    travel_friction = "my_package:TravelFriction"
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

import servolens
from servolens import Controller, Plant, Record, read_model, simulate_loop, to_control
from servolens.effects import Axis, DryFriction, parameter


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class TravelFriction(DryFriction):
    """Dry friction grows along the travel, as a cable drags ever more of itself."""

    name = "travel_friction"
    sentence = "Dry friction grows along the travel."
    latex = r"(F + G\,|y|)\,\operatorname{sgn} v"

    level: float = parameter("F", "{x}/s^2", "friction at position 0, per unit of moving mass")
    growth: float = parameter("G", "1/s^2", "how much it grows per unit of travel")

    @staticmethod
    def physics(axis: Axis, p: Any) -> Any:
        """Return the level [m/s²]."""
        return p.level + p.growth * (axis.position**2 + 1e-8) ** 0.5


def measured(plant: Plant, kp: float, seed: int) -> Record:
    """Log a step of a machine that has the effect; the position shows 10 µm of noise."""
    time = np.arange(1501) * 1e-3
    reference = np.full(time.size, 0.1)
    controller = Controller(kp=kp)
    run = simulate_loop(plant, controller, time, reference)
    position = run.position + 1e-5 * np.random.default_rng(seed).standard_normal(time.size)
    return Record(
        time=time,
        position=position,
        reference=reference,
        voltage=run.voltage,
        controller=controller,
        name=f"kp {kp:g}",
    )


def main() -> None:
    machine = Plant(gain=1.9, damping=6.0, effects=(TravelFriction(level=0.2, growth=3.0),))
    records = [measured(machine, kp, seed) for seed, kp in enumerate((60.0, 80.0, 100.0))]

    fit = servolens.fit([TravelFriction(level=1.0, growth=1.0)], records)
    for name, quantity in fit.quantities.items():
        print(f"{name}: {quantity.value:.4f} ± {quantity.stderr:.4f} {quantity.unit}")
    print(f"residual {1e6 * fit.rms_error:.1f} µm, noise {1e6 * fit.noise:.1f} µm")

    linear = to_control(fit.plant).linearize([0.05, 0.1], 0.0)
    print(f"poles at 0.1 m/s: {np.sort(linear.poles().real).round(2).tolist()} 1/s")

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        path.write_text(json.dumps({"schema": "servolens.model/1", **fit.model.to_json()}), encoding="utf-8")
        again = read_model(path, effects=[TravelFriction])
    print(f"read back: {again.plant.effect('travel_friction')}")


if __name__ == "__main__":
    main()
