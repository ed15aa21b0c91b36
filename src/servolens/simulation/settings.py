"""What the compiled rule is told of a controller, in the order of :mod:`servolens.simulation.digital`."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_arithmetic import samples_a_period
from servolens.effects import Saturation
from servolens.errors import InputError, described, number_within
from servolens.record_signals import as_finite

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.controller import Controller
    from servolens.plant import Plant

__all__ = [
    "ANY_NUMBER",
    "COARSE",
    "DISTURBED",
    "NO_LAW",
    "NO_OBSERVER",
    "OPEN_LOOP",
    "begun",
    "known",
    "law_settings",
    "loop_settings",
]

ANY_NUMBER = 0.0
"""Most pieces into which substeps may be split, where there is no such limit."""
COARSE = 1e-4
"""Share of the sensor's noise by which a simulated sample may be wrong."""
OPEN_LOOP = [0.0] * 7 + [1.0, 1.0, 0.0, 0.0]
"""What the rule is told of a loop where there is none, but for the pieces granted and what was applied before."""
NO_OBSERVER = (0.0, 0.0, 0.0)
"""What it is told where no measurement corrects the axis."""
DISTURBED = 2.0
"""What it is told first where the axis is shaken or its sensor errs."""
NO_LAW = [0.0, 0.0, 1.0, 0.0, np.inf, 0.0, 0.0, 0.0, 1.0]
"""What it is told of the rest of a law where there is none."""


def loop_settings(controller: Controller, period: float) -> list[float]:
    """Return what the rule is told of proportional part, derivative and ticks; see :mod:`.digital`."""
    ratio = samples_a_period(controller, period)
    return [
        controller.kp,
        controller.kd,
        controller.derivative_filter,
        controller.derivative_window,
        controller.derivative_on == "error",
        controller.derivative == "velocity",
        ratio,
        ratio * period,
        controller.time_step == "measured",
    ]


def law_settings(plant: Plant, controller: Controller, limit: float | None) -> list[float]:
    """Return what the rule is told of the rest of the law."""
    if controller.is_pd:
        return NO_LAW
    if limit is None:
        saturation = plant.effect(Saturation.name)
        limit = saturation.limit if isinstance(saturation, Saturation) else None
    if controller.is_limited and limit is None:
        raise InputError(f"anti_windup = {controller.anti_windup} needs the limit of the command; give it")
    pulls = controller.is_limited and controller.anti_windup == "back_calculation"
    return [
        controller.ki,
        controller.integral_rate,
        controller.setpoint_weight,
        controller.velocity_feedforward,
        np.inf if limit is None else limit,
        controller.anti_windup == "clamping",
        1.0 / controller.tracking if pulls else 0.0,
        controller.initial_integral,
        0.0,
    ]


def known(before: float | None, what: str = "before") -> tuple[float, float]:
    """Return what the rule is told of the time before the first sample; a refusal says `what` it was given."""
    return (0.0, 0.0) if before is None else (1.0, number_within(before, -np.inf, np.inf, what))


def begun(start: Sequence[float]) -> list[float]:
    """Return an initial position, velocity, and perhaps place within a gap, as a list.

    Raises
    ------
    InputError
        If they are not two or three finite numbers, the third from -1 to 1.
    """
    if isinstance(start, tuple) and len(start) == 2 and all(type(one) is float and isfinite(one) for one in start):
        return [*start]  # most are
    numbers = as_finite(start, "start")
    if numbers.shape not in ((2,), (3,)) or np.any(abs(numbers[2:]) > 1.0):
        raise InputError(
            "start must be position and velocity, and perhaps the place within a gap, from -1 to 1;"
            f" got {described(start)}"
        )
    found: list[float] = numbers.tolist()
    return found
