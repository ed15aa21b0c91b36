"""What a model with causes says of damping, gain and force along a measured quantity, where that is one curve."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Transmission
from servolens.report.curves import curve

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.diagnosis import Diagnosis
    from servolens.diagnosis.evidence import Instrument
    from servolens.plant import Plant
    from servolens.report.curves import Curve

__all__ = ["law_along"]

POINTS_OF_A_LAW = 101
VISITED, STRIDES = 40, 200
"""Places and times of the records over whose forces a law is the mean; samples of each record among which they are."""
LEAST_CHANGE = 0.05
"""Least change of the law, as a share of the pieces' spread, that is worth a line."""
QUANTITIES_OF_LAWS = {
    "damping": ("speed", "velocity"),
    "gain": ("time", "voltage", "voltage_size"),
    "force": ("constant", "direction", "position", "time", "velocity"),
}
"""Along which quantities the state of the axis is known, all else being zero or as in the records."""


def law_along(diagnosis: Diagnosis, instrument: Instrument) -> Curve | None:
    """Return what `diagnosis.plant` says of the instrument's pieces, over their range.

    None where no one curve says it, or where it says nothing: the cause shows elsewhere.
    """
    if instrument.goes_with not in QUANTITIES_OF_LAWS[instrument.varies]:
        return None
    x = np.linspace(min(instrument.abscissa), max(instrument.abscissa), POINTS_OF_A_LAW)
    y = _law(diagnosis, instrument, x)
    constant = instrument.goes_with == "constant"
    said = float(np.abs(y).max() if constant else np.ptp(y))
    seen = float(np.abs(instrument.value).max() if constant else np.std(instrument.value))
    return curve("", x, y, "velocity") if np.isfinite(y).all() and said > LEAST_CHANGE * seen else None


def _law(diagnosis: Diagnosis, instrument: Instrument, x: NDArray[np.float64]) -> NDArray[np.float64]:
    plant, along, nothing = diagnosis.plant, instrument.goes_with, np.zeros(x.size)
    time = x if along == "time" else nothing
    if instrument.varies == "gain":
        command = x if along.startswith("voltage") else np.ones(x.size)
        command = np.where(np.abs(command) < 1e-9, 1e-9, command)
        pushed, free = (_acceleration(plant, nothing, nothing, time, c, nothing) for c in (command, nothing))
        return (pushed - free) / command
    if instrument.varies == "damping":
        moving = np.where(x == 0, 1e-9, x)
        return plant.damping + _force(plant, nothing, moving, nothing) / moving
    if along == "direction":  # the mean of a piece that turns round lies between the two ways
        ways = np.array([-1.0, 1.0])
        typical = float(np.mean(_in_motion(diagnosis)[2]))
        return np.interp(x, ways, _mean_force(diagnosis, "velocity", ways * typical))
    return _mean_force(diagnosis, along, x)


def _mean_force(diagnosis: Diagnosis, along: str, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the force along `x`: the mean over the places and times of the records, where `x` is not one of those."""
    position, time, _ = _in_motion(diagnosis)
    shape = (x.size, position.size)
    given = {"position": position, "velocity": np.zeros(1), "time": time}
    states = [np.broadcast_to(x[:, None] if name == along else a, shape).ravel() for name, a in given.items()]
    return np.asarray(_force(diagnosis.plant, *states).reshape(shape).mean(axis=1))


def _force(
    plant: Plant, position: NDArray[np.float64], velocity: NDArray[np.float64], time: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what opposes a motion without a command, but for the damping."""
    acceleration = _acceleration(plant, position, velocity, time, np.zeros(time.size), np.sign(velocity))
    return -acceleration - plant.damping * velocity


def _acceleration(plant: Plant, *states: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the acceleration at position, velocity, time, command and direction, what effects remember being zero.

    Motor and load move as one: what joins them pushes each of them, and not the axis.
    """
    import casadi as ca

    from servolens.dynamics import dynamics

    plant = replace(plant, effects=tuple(e for e in plant.effects if not isinstance(e, Transmission)))
    d = dynamics(plant.structure)
    function = ca.Function("acceleration", d.inputs, [d.acceleration])
    remembered = np.zeros(len(d.state_names))
    rows = zip(*states, strict=True)
    return np.array([float(function(y, v, t, u, s, plant.driven_values, remembered)) for y, v, t, u, s in rows])


def _in_motion(diagnosis: Diagnosis) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return position, time and speed of some samples of the records at which the axis moves."""
    found = []
    for record in diagnosis.records:
        stride = max(len(record) // STRIDES, 1)
        position, time = record.position[::stride], record.time[::stride]
        speed = np.abs(np.gradient(position, time))
        found.append(np.array([position, time, speed])[:, speed >= 0.1 * speed.max()])
    position, time, speed = np.concatenate(found, axis=1)
    stride = max(position.size // VISITED, 1)
    return position[::stride], time[::stride], speed[::stride]
