"""How an axis looks to a model of gain and damping alone: the best such model of some runs, and what it misses.

Written for the laboratory, with transfer functions of the sampled loop: it shares nothing with the identification and
the simulation that the campaigns are made to test.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.record import Controller

    Array = NDArray[np.float64]

__all__ = ["LoggedLoop", "linear_error", "linear_response"]


class LoggedLoop(NamedTuple):
    """One run as it is logged: its controller, its sample time [s], position, and what drives the simulation.

    With `closed`, `drive` is the reference, else the voltage.
    """

    controller: Controller
    sample_time: float
    position: Array
    drive: Array
    closed: bool


def linear_error(runs: Sequence[LoggedLoop], gain: float, damping: float) -> tuple[float, float, float]:
    """Return the least r.m.s. position error that gain and damping alone leave in all runs, and those two.

    The search starts from `gain` and `damping`.
    """
    from scipy.optimize import least_squares

    scale = max(abs(damping), 1.0)
    size = float(np.std(np.concatenate([run.position for run in runs]))) or 1.0

    def misses(x: Array) -> Array:
        model = gain * float(x[0]), scale * float(x[1])
        each = [linear_response(run, *model) - run.position for run in runs]
        return np.nan_to_num(np.concatenate(each) / size, nan=1e3, posinf=1e3, neginf=-1e3)

    found = least_squares(misses, [1.0, damping / scale], method="lm", max_nfev=40)
    rms = float(np.sqrt(2.0 * found.cost / sum(run.position.size for run in runs))) * size
    return rms, gain * float(found.x[0]), scale * float(found.x[1])


def linear_response(run: LoggedLoop, gain: float, damping: float) -> Array:
    """Return the position of ``ÿ = gain·V − damping·ẏ`` from rest at the first sample, at each sample.

    The pulse transfer function of the held voltage is ``P = (b₁z⁻¹ + b₂z⁻²)/((1 − z⁻¹)(1 − a z⁻¹))``, the controller's
    derivative ``D = kd f (1 − z⁻¹)/(h (1 − (1 − f) z⁻¹))``, so that ``y = P kp/(1 + P (kp + D)) r``.
    """
    from scipy.signal import lfilter

    numerator, denominator = _pulse(gain, damping, run.sample_time)
    if run.closed:
        loop = run.controller
        slope = loop.kd * loop.derivative_filter / run.sample_time * np.array([1.0, -1.0])
        filtered = np.array([1.0, loop.derivative_filter - 1.0])
        returned = np.convolve(numerator, loop.kp * filtered + slope)
        denominator, numerator = (
            np.convolve(denominator, filtered) + returned,
            np.convolve(loop.kp * numerator, filtered),
        )
    origin = float(run.position[0])
    drive = run.drive - origin if run.closed else run.drive
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(origin + lfilter(numerator, denominator, drive), dtype=np.float64)


def _pulse(gain: float, damping: float, h: float) -> tuple[Array, Array]:
    """Return numerator and denominator of P, in powers of z⁻¹."""
    fade, glide, fall = math.exp(min(-damping * h, 50.0)), *_moments(damping * h)
    place, speed = gain * h * h * fall, gain * h * glide
    numerator = np.array([0.0, place, h * glide * speed - fade * place])
    return numerator, np.convolve([1.0, -1.0], [1.0, -fade])


def _moments(z: float) -> tuple[float, float]:
    """Return ``(1 − e^{−z})/z`` and ``(e^{−z} − 1 + z)/z²``, by their series where those cancel."""
    if abs(z) < 0.1:
        return sum((-z) ** k / math.factorial(k + 1) for k in range(10)), sum(
            (-z) ** k / math.factorial(k + 2) for k in range(10)
        )
    lost = -math.expm1(min(-z, 50.0))
    return lost / z, (z - lost) / (z * z)
