"""Settling time, overshoot and noise over both gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.command_noise import noise_gain
from servolens.design.cover import SPARE, last_gain
from servolens.design.linear_limits import keeps
from servolens.design.margins import LinearLoops
from servolens.design.settle import FEASIBLE, horizon, measured, settling_time, step_response
from servolens.design.spec import PDSpec
from servolens.errors import InputError, NumericalError, needed
from servolens.inputs import as_models
from servolens.processors import in_parallel, single_threaded_blas
from servolens.record_signals import as_numbers

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from servolens.inputs import Plants
    from servolens.plant import Plant

__all__ = ["LEAST_KP", "MOST_KP", "GainMap", "gain_map", "map_axes"]

WATCHED = 2.0
"""Settling times for which each step is watched at first; what settles in time is watched for the whole horizon."""
LEAST_KP, MOST_KP = 0.2, 2.5
"""Share of the kp of the spec at which a map begins and ends, unless it is told where."""


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
        What the controller makes of white noise of the measured position [V/m]; see
        :func:`servolens.design.command_noise.noise_gain`.
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

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.map/1`` without the file's header; null for what is not a finite number."""
        pair = self.least_noise
        reason = (
            "a pair whose step does not settle in twice the time asked for has none, one that is unstable no overshoot"
        )
        return {
            "spec": self.spec.to_json(),
            "kp": self.kp,
            "kd": self.kd,
            "settling_time": self.settling_time,
            "overshoot": self.overshoot,
            "noise": self.noise,
            "feasible": self.feasible,
            "least_noise": None if pair is None else {"kp": pair[0], "kd": pair[1]},
            **({} if np.isfinite([self.settling_time, self.overshoot]).all() else {"reason": reason}),
        }


@single_threaded_blas
def gain_map(plants: Plants, spec: PDSpec, kp: ArrayLike, kd: ArrayLike) -> GainMap:
    """Simulate the step of `spec` with each pair of gains.

    Parameters
    ----------
    plants : Plant, model, fit, diagnosis, path of a model's file, or a sequence of these
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
    needed(spec, PDSpec)
    models = tuple(model.plant for model in as_models(plants))
    rows, columns = np.atleast_1d(as_numbers(kp, "kp")), np.atleast_1d(as_numbers(kd, "kd"))
    if rows.ndim != 1 or columns.ndim != 1 or not rows.size * columns.size:
        raise InputError("a map needs at least one kp and one kd")
    if not (np.isfinite(columns).all() and (columns >= 0.0).all()):
        raise InputError("kd of a map must be finite and not negative")
    specs = [replace(spec, kp=float(value)) for value in rows]

    def row(one: PDSpec) -> list[tuple[float, float, bool]]:
        found: list[tuple[float, float, bool]] = []
        for value in columns:
            found.append(_pair(models, one, float(value), likely=bool(found) and found[-1][2]))
        return found

    found = np.array(in_parallel(row, specs), dtype=np.float64)
    feasible = found[..., 2] > 0.5
    if spec.limits:
        feasible &= np.array([_kept(models, one, columns) for one in specs])
    return GainMap(
        spec=spec,
        kp=rows,
        kd=columns,
        settling_time=found[..., 0],
        overshoot=found[..., 1],
        noise=np.array([[noise_gain(one, float(value)) for value in columns] for one in specs]),
        feasible=feasible,
    )


def _kept(models: tuple[Plant, ...], spec: PDSpec, kd: NDArray[np.float64]) -> list[bool]:
    """Tell of each kd whether the linearised loop keeps to the limits of the spec."""
    loops = LinearLoops(models, spec)
    return [keeps(loops.margins(float(value)), spec) for value in kd]


def map_axes(
    plants: Plant | Sequence[Plant], spec: PDSpec, *, kp: tuple[float, float] | None = None, count: int = 100
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gains for a map around a spec: `count` of kp and as many of kd.

    kp is that of the spec times 0.2 to 2.5, or what is given. kd begins at 0 and ends where the spec says, or else
    where the loops with the largest kp are too slow.

    Raises
    ------
    InputError
        If the range of kp is empty or not positive, or `count` is less than 2.
    """
    models = tuple(plants) if isinstance(plants, Sequence) else (plants,)
    low, high = kp or (LEAST_KP * spec.kp, MOST_KP * spec.kp)
    if not 0.0 < low < high < np.inf:
        raise InputError(f"kp of a map must run from a positive number to a larger one, got {low:g} to {high:g}")
    if count < 2:
        raise InputError(f"a map needs at least 2 gains of each kind, got {count}")
    last = spec.kd_max or max(last_gain(model, replace(spec, kp=high)) for model in models) / SPARE
    return np.linspace(low, high, count), np.linspace(0.0, last, count)


def _pair(models: tuple[Plant, ...], spec: PDSpec, kd: float, *, likely: bool) -> tuple[float, float, bool]:
    """Return settling time, overshoot, and whether the spec holds; steps that `likely` hold it are watched on."""
    found = [_seen(model, spec, kd, whole=likely) for model in models]
    slowest, overshoot = max(one[0] for one in found), max(one[1] for one in found)
    meets = all(one[2] for one in found)
    if not likely and slowest <= spec.settling_time * (1 + 1e-9):
        meets = all(_seen(model, spec, kd, whole=True)[2] for model in models)
    return (slowest if np.isfinite(slowest) else np.nan), overshoot, meets


def _seen(model: Plant, spec: PDSpec, kd: float, *, whole: bool) -> tuple[float, float, bool]:
    """Return settling time and overshoot in the time that a map shows, and whether the `whole` step meets the spec."""
    shown = WATCHED * spec.settling_time
    try:
        run = step_response(model, spec, kd, horizon(model, spec) if whole else shown)
    except NumericalError:  # perhaps only after what the map shows
        return _seen(model, spec, kd, whole=False) if whole else (np.inf, np.inf, False)
    count = int(np.ceil(shown / spec.sample_time)) + 1
    left = (spec.reference - run.position[:count]) / spec.reference
    settled = settling_time(run.time[:count], left, spec.band + FEASIBLE)
    return (
        np.inf if settled is None else settled,
        max(0.0, -float(left.min())),
        whole and measured(run, spec, kd).meets,
    )
