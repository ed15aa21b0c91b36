"""The compiled simulation: what a substep costs, what a thousand parameter sets cost, and what a new structure costs.

The axis of the first figure moves all the time, driven by a slow sine, so that no substep is spent at rest. What a
substep costs is measured with joined code, as it runs where there are many; what a structure costs, with separate code,
which a new one begins with.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from unittest.mock import patch

import numpy as np
from harness import Figure, alternate, median_time

from servolens.effects import Cogging, CoulombFriction, FlexibleCoupling, QuadraticDrag, StribeckFriction
from servolens.plant import Plant
from servolens.record import Controller, Record
from servolens.simulation import simulate_loop, simulate_many, simulate_voltage
from servolens.simulation.native import WORK_THAT_PAYS, native

GRID = np.arange(3001) * 1e-3
SINE = 5.0 * np.sin(2 * np.pi * 1.3 * GRID)
STEP = np.full(GRID.size, 0.1)
LOOP = Controller(kp=60.0, kd=2.0)
ROUGH = (
    StribeckFriction(level=0.2, static_excess=0.1, stribeck_speed=0.05),
    Cogging(amplitude=0.3, pitch=0.02, phase=0.3),
)
PROGRAM = """
import time
from servolens.effects import CoulombFriction
from servolens.plant import Plant
from servolens.simulation.native import native
import servolens.dynamics, llvmlite.binding
start = time.perf_counter()
native((CoulombFriction,))
print(time.perf_counter() - start)
"""


def figures() -> list[Figure]:
    """Measure."""
    plain, rough = (Plant(gain=1.9, damping=6.0, effects=effects) for effects in ((), ROUGH))
    for plant in (plain, rough):
        native(plant.structure, work=WORK_THAT_PAYS)
    few, many, sticking_few, sticking_many, sample = alternate(
        [
            lambda: simulate_voltage(rough, GRID, SINE, substeps=4),
            lambda: simulate_voltage(rough, GRID, SINE, substeps=12),
            lambda: simulate_loop(rough, LOOP, GRID, STEP, substeps=4),
            lambda: simulate_loop(rough, LOOP, GRID, STEP, substeps=12),
            lambda: simulate_loop(plain, LOOP, GRID, STEP, substeps=1),
        ],
        seconds=3.0,
    )
    steps = GRID.size - 1
    first, second = _first_calls()
    name = "kernel, Stribeck and cogging"
    found = [
        (f"{name}: a further substep, in motion", (many - few) / (8 * steps) * 1e9, "ns", 30.0),
        (
            f"{name}: a further substep, a step of 0.1 m",
            (sticking_many - sticking_few) / (8 * steps) * 1e9,
            "ns",
            25.0,
        ),
        (f"{name}: all of it over the substeps, a step of 0.1 m", sticking_few / (4 * steps) * 1e9, "ns", 25.0),
        ("kernel, plain plant: a sample of the loop, Python and all", sample / steps * 1e9, "ns", 30.0),
        ("simulate_many: 1000 parameter sets, 3 s with Coulomb friction at 1 kHz", _many(), "s", 2.0),
        ("kernel: a structure never seen", _new_structure() * 1e3, "ms", 100.0),
        ("kernel: first structure of a process, nothing on disk", first * 1e3, "ms", None),
        ("kernel: first structure of a process, from the disk cache", second * 1e3, "ms", 200.0),
    ]
    return [Figure(name=n, value=value, unit=unit, target=target, better="lower") for n, value, unit, target in found]


def _many() -> float:
    """Return the time for 1000 carts with friction [s]."""
    random = np.random.default_rng(0)
    draws = zip(random.uniform(1.5, 2.5, 1000), random.uniform(4, 8, 1000), random.uniform(0.1, 0.4, 1000), strict=True)
    carts = [Plant(gain=g, damping=c, effects=(CoulombFriction(level=level),)) for g, c, level in draws]
    record = Record(time=GRID, position=np.zeros(GRID.size), reference=STEP, controller=LOOP)
    return median_time(lambda: simulate_many(carts, [record]), seconds=3.0)


def _new_structure() -> float:
    """Return the time to the code of a combination of effects, in a process that has compiled others [s]."""
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, SERVOLENS_CACHE=folder):
        native((QuadraticDrag, FlexibleCoupling))  # nobody joined it on disk, so it loads the rule that is called
        start = time.perf_counter()
        native((StribeckFriction, Cogging, QuadraticDrag, FlexibleCoupling))
        return time.perf_counter() - start


def _first_calls() -> list[float]:
    """Return the time to the first structure in a fresh process [s], with nothing and with all on disk."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "SERVOLENS_CACHE": folder}
        return [
            float(
                subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, check=True).stdout
            )
            for _ in range(2)
        ]
