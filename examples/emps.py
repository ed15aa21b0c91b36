"""EMPS, the ball-screw benchmark: identify on the training file, predict the one with voltage pulses.

Janot, Gautier and Brunot, 2019. The published model is 95.1 kg and 35.15 N/V: a gain of 0.3696 m/s²/V.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from _data import folder, show_plant

from servolens import CoulombFriction, Plant, Record, check, fit_effects, identify, read_record, simulate

if TYPE_CHECKING:
    from pathlib import Path

KP, KV = 160.18, 243.45
COLUMNS = {"time": "t", "position": "qm", "reference": "qg", "voltage": "vir"}


def record(path: Path, name: str, **columns: str) -> Record:
    """Read one file; the loop is kv (kp e − dq), its derivative taken over two samples."""
    settings = {"kp": KP * KV, "kd": KV, "derivative_window": 2, "name": name}
    return read_record(path, settings=settings, columns={**COLUMNS, **columns})


def voltage_error(plant: Plant, run: Record) -> float:
    """Return the closed-loop voltage error in percent: 100 ‖V − V̂‖/‖V‖."""
    error = simulate(plant, run).voltage - run.voltage
    return 100.0 * float(np.linalg.norm(error) / np.linalg.norm(run.voltage))


def main() -> None:
    data = folder("emps")
    training = record(data / "DATA_EMPS.mat", "training")
    test = record(data / "DATA_EMPS_PULSES.mat", "pulses (held out)", feedforward="pulses_N")
    for run in (training, test):
        for finding in check(run):
            print(f"{run.name}: {finding.severity}: {finding.message}")
    fit = identify(training)
    coulomb = fit_effects(training, [CoulombFriction(level=0.2)])
    for name, model in (("constant", fit.constant), ("velocity", fit.velocity), ("Coulomb", coulomb)):
        show_plant(name, model.plant)
        for run in (training, test):
            error = simulate(model.plant, run).position - run.position
            rms = 1e6 * float(np.sqrt(np.mean(error**2)))
            print(f"  {run.name}: position r.m.s. {rms:.2f} µm, voltage {voltage_error(model.plant, run):.2f} %")
    mass = 35.15065 / coulomb.plant.gain
    print(f"Moving mass with Coulomb friction: {mass:.1f} kg (published 95.1 kg).")
    print("Where it fails: the loop is so stiff that position says little; judge the voltage. What is left after dry")
    print("friction is of one sign: an offset and friction that differs by direction, which these models lack.")


if __name__ == "__main__":
    main()
