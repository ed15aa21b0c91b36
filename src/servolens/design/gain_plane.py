"""Settling time, overshoot and noise over both gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.settle import FEASIBLE, evaluate, settling_time, step_response
from servolens.errors import InputError, NumericalError
from servolens.processors import in_parallel

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["GainMap", "gain_map", "noise_gain"]

WATCHED = 2.0
"""Settling times for which each step is watched at first; what settles in time is watched for the whole horizon."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainMap:
    """What each pair of gains does; where there are several models, the worst of them.

    Attributes
    ----------
    spec : PDSpec
        What was asked; its kp plays no part.
    kp, kd : ndarray, shape (n,), (m,)
        Gains [V/m, V s/m].
    settling_time : ndarray, shape (n, m)
        [s]; not a number where the step does not settle within twice the settling time asked for.
    overshoot : ndarray, shape (n, m)
        Fraction of the step; infinite where the loop is unstable.
    noise : ndarray, shape (n, m)
        What the controller makes of white noise of the measured position [V/m]; see :func:`noise_gain`.
    feasible : ndarray of bool, shape (n, m)
        Whether the spec holds.
    """

    spec: PDSpec
    kp: NDArray[np.float64]
    kd: NDArray[np.float64]
    settling_time: NDArray[np.float64]
    overshoot: NDArray[np.float64]
    noise: NDArray[np.float64]
    feasible: NDArray[np.bool_]

    @property
    def least_noise(self) -> tuple[float, float] | None:
        """The feasible pair (kp, kd) that makes the least noise; None if none is feasible."""
        if not self.feasible.any():
            return None
        i, j = np.unravel_index(np.argmin(np.where(self.feasible, self.noise, np.inf)), self.noise.shape)
        return float(self.kp[i]), float(self.kd[j])


def gain_map(plants: Plant | Sequence[Plant], spec: PDSpec, kp: ArrayLike, kd: ArrayLike) -> GainMap:
    """Simulate the step of `spec` with each pair of gains.

    Parameters
    ----------
    plants : Plant or sequence of Plant
        One model, or several that must all meet the spec.
    spec : PDSpec
        What to reach; each of `kp` takes the place of its own.
    kp, kd : array_like, shape (n,), (m,)
        Gains [V/m, V s/m]: kp positive, kd not negative.

    Raises
    ------
    InputError
        If no plant or no gain is given, or a gain is not admissible.

    Examples
    --------
    >>> from servolens import Plant, PDSpec
    >>> spec = PDSpec(kp=100, settling_time=0.5)
    >>> found = gain_map(Plant(gain=1.8, damping=6.0), spec, [60, 100], [2, 8])
    >>> found.feasible.tolist(), found.least_noise
    ([[False, False], [False, True]], (100.0, 8.0))
    """
    models = tuple(plants) if isinstance(plants, Sequence) else (plants,)
    rows, columns = np.atleast_1d(np.asarray(kp, dtype=np.float64)), np.atleast_1d(np.asarray(kd, dtype=np.float64))
    if not models or rows.ndim != 1 or columns.ndim != 1 or not rows.size * columns.size:
        raise InputError("a map needs at least one model, one kp and one kd")
    if not (np.isfinite(columns).all() and (columns >= 0.0).all()):
        raise InputError("kd of a map must be finite and not negative")
    specs = [replace(spec, kp=float(value)) for value in rows]

    def row(one: PDSpec) -> list[tuple[float, float, bool]]:
        return [_pair(models, one, float(value)) for value in columns]

    found = np.array(in_parallel(row, specs), dtype=np.float64)
    return GainMap(
        spec=spec,
        kp=rows,
        kd=columns,
        settling_time=found[..., 0],
        overshoot=found[..., 1],
        noise=np.array([[noise_gain(one, float(value)) for value in columns] for one in specs]),
        feasible=found[..., 2] > 0.5,
    )


def noise_gain(spec: PDSpec, kd: float) -> float:
    """Return the r.m.s. voltage for white noise of r.m.s. 1 in the measured position [V/m], from the controller alone.

    The response of the digital PD to one sample is kp + a, then a((1−φ)ʲ − (1−φ)ʲ⁻¹), with a = kd φ/h and φ the
    derivative filter: the squares sum to (kp + a)² + a² φ/(2 − φ). Without an integral, which sums up noise slowly.
    """
    share, loop = spec.derivative_filter, spec.loop(kd)
    slope = kd * share / spec.sample_time
    return float(np.sqrt((loop.kp + slope) ** 2 + slope**2 * share / (2.0 - share)))


def _pair(models: tuple[Plant, ...], spec: PDSpec, kd: float) -> tuple[float, float, bool]:
    """Return settling time, overshoot, and whether the spec holds."""
    times, overshoots = [], []
    for model in models:
        try:
            run = step_response(model, spec, kd, WATCHED * spec.settling_time)
        except NumericalError:
            return np.nan, np.inf, False
        error = (spec.reference - run.position) / abs(spec.reference)
        settled = settling_time(run.time, error, spec.band + FEASIBLE)
        times.append(np.nan if settled is None else settled)
        overshoots.append(max(0.0, float(np.max(-error * np.sign(spec.reference)))))
    slowest = float(np.max(times))
    may = slowest <= spec.settling_time * (1 + 1e-9)
    return slowest, max(overshoots), may and all(evaluate(model, spec, kd).meets for model in models)
