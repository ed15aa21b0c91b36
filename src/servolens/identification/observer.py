"""The observer of a record: how far each sample moves the simulated axis, as the noise model asks for."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.late_inputs import jumps_of
from servolens.simulation.kalman import NEVER

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel

__all__ = ["Observer", "observer_of"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """Gains of an observer, and how much it misses.

    Attributes
    ----------
    gains : ndarray, shape (n, 3)
        Of position [1], velocity [1/s] and shaking [1/s²]; where the axis rests that of the velocity is
        :data:`~servolens.simulation.digital.HELD`.
    remembered : float
        Share of the shaking that is left a sample later.
    weight : ndarray, shape (n,)
        Standard deviation of the sensor's noise over that of the innovation.
    """

    gains: NDArray[np.float64]
    remembered: float
    weight: NDArray[np.float64]


def observer_of(
    noise: NoiseModel,
    time: NDArray[np.float64],
    speed: NDArray[np.float64],
    voltage: NDArray[np.float64],
    corrects: NDArray[np.bool_] | None = None,
    mistimed: NDArray[np.float64] | None = None,
    rests: NDArray[np.bool_] | None = None,
) -> Observer | None:
    """Return the observer of a record; None where the axis is simulated, for nothing shakes it and its clock is true.

    Parameters
    ----------
    noise : NoiseModel
        Of the record.
    time, speed, voltage : ndarray, shape (n,)
        [s], [m/s or rad/s], and [V], applied from each sample to the next.
    corrects : ndarray of bool, shape (n,), optional
        Which of the instants move the axis; all if None.
    mistimed : ndarray, shape (n,), optional
        Standard deviation of what is not known of the velocity at each instant, for its voltage came at another
        [m/s or rad/s].
    rests : ndarray of bool, shape (n,), optional
        Instants at which something holds the axis: nothing shakes it there, and it has no velocity.

    Notes
    -----
    See :mod:`servolens.simulation.kalman`.
    """
    if not noise.is_observed and mistimed is None:
        return None
    from servolens.simulation.native import native

    h = float(np.median(np.diff(time[:64])))
    left = float(np.exp(-noise.damping * h))
    given = (1.0 - left) / noise.damping if noise.damping * h > 1e-9 else h
    kept, power = noise.shaking(h)
    model = np.array([left, given, kept, 0.5 * given * h, given, power])
    size = noise.jitter / max(noise.floor, 1e-300)
    late, kick = size * speed, size * jumps_of(noise, time, speed, voltage)
    if mistimed is not None:
        kick = np.where(mistimed > 0.0, mistimed / max(noise.floor, 1e-300), kick)
    if corrects is not None:
        late = np.where(corrects, late, 2.0 * NEVER)
    gains, variance = np.empty((time.size, 3)), np.empty(time.size)
    held = np.zeros(time.size) if rests is None else rests.astype(np.float64)
    addresses = [array.ctypes.data for array in (model, late, kick, held, gains, variance)]
    native(()).gains(ctypes.byref(ctypes.c_int64()), None, time.size, *addresses)
    return Observer(gains, kept, 1.0 / np.sqrt(variance))
