"""The digital PD loop around a virtual axis, for one run in plain floats or for many in arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.errors import NumericalError
from servolens.lab.motion import Axis, advance_many, advance_one
from servolens.lab.truth import Truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.record import Controller

__all__ = ["Bench", "run_many", "run_one"]

SUBSTEP = 2.5e-4
"""Longest integration step [s]; what it costs in accuracy is in the tests."""
BOUNDS = 1e6
"""A position beyond this [m or rad] is a loop that has run away."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """What surrounds the axis: the loop, the reference at each sample, the sensor, the amplifier's stated limit."""

    controller: Controller
    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    encoder: float
    noise: float
    voltage_limit: float | None
    log_voltage: bool
    name: str


def run_one(
    truth: Truth, bench: Bench, noises: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return measured position and asked voltage, each of shape (n,); `noises` of shape (n,)."""
    axis = Axis(_limited(truth, bench), math)
    each = [0.0] * bench.time.size if noises is None else noises.tolist()
    position, voltage = _close(axis, bench, each, (0.0, 0.0), advance_one, math.floor)
    return np.array(position), np.array(voltage)


def run_many(
    truth: Truth, bench: Bench, noises: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return measured position and asked voltage of all runs, each of shape (runs, n); `noises` of shape (n, runs)."""
    axis = Axis(_limited(truth, bench), np)
    rest = np.zeros(noises.shape[1])
    position, voltage = _close(axis, bench, noises, (rest, rest), advance_many, np.floor)
    return np.stack(position, axis=1), np.stack(voltage, axis=1)


def _close(
    axis: Axis, bench: Bench, noises: Any, state: tuple[Any, ...], advance: Callable[..., Any], floor: Any
) -> tuple[list[Any], list[Any]]:
    """Run the loop through its samples; a sample is a float for one run, an array for many."""
    controller, step = bench.controller, bench.encoder
    time, reference = bench.time.tolist(), bench.reference.tolist()
    h = time[1] - time[0]
    pieces = math.ceil(h / SUBSTEP - 1e-9)
    position: list[Any] = []
    voltage: list[Any] = []
    derivative: Any = 0.0
    for t, r, noise in zip(time, reference, noises, strict=True):
        seen = state[0] + noise
        if step:
            seen = floor(seen / step + 0.5) * step
        slope = (seen - position[-1]) / h if position else 0.0
        derivative = derivative + controller.derivative_filter * (slope - derivative)
        asked = controller.kp * (r - seen) - controller.kd * derivative
        position.append(seen)
        voltage.append(asked)
        applied = axis.command(asked)
        for i in range(pieces):
            state = advance(axis, t + i * h / pieces, state, h / pieces, applied)
        _check_bounds(state[0], t)
    return position, voltage


def _check_bounds(position: Any, t: float) -> None:
    if not np.all(np.abs(position) < BOUNDS):
        raise NumericalError(f"the virtual axis has run away after {t:g} s: with these gains the loop is unstable")


def _limited(truth: Truth, bench: Bench) -> Truth:
    """Return the truth with the amplifier's stated limit, or its own where that is lower."""
    if bench.voltage_limit is None:
        return truth
    own = truth.effects.get("saturation", {"limit": math.inf})["limit"]
    saturation = {"saturation": {"limit": min(own, bench.voltage_limit)}}
    return Truth(gain=truth.gain, damping=truth.damping, effects={**truth.effects, **saturation})
