"""Simulation of the axis and its loop by a compiled kernel."""

from servolens.simulation.circumstances import plant_in
from servolens.simulation.loop import Simulation, simulate, simulate_continuous, simulate_loop, simulate_voltage
from servolens.simulation.many import simulate_many

__all__ = [
    "Simulation",
    "plant_in",
    "simulate",
    "simulate_continuous",
    "simulate_loop",
    "simulate_many",
    "simulate_voltage",
]
