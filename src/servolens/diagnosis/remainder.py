"""What the chosen model misses beyond the noise, and how much that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.diagnosis.json_values import finite
from servolens.identification.segments import applied_voltage
from servolens.identification.structure import MATERIAL

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.errors import Gains
    from servolens.identification.likelihood import Hypothesis
    from servolens.record import Record

__all__ = ["MATERIAL", "Remainder", "remainder_of", "unexplained_acceleration"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """What the chosen model misses beyond the noise.

    Attributes
    ----------
    rms : float
        R.m.s. of the simulation's error beyond the noise, in quadrature [m or rad].
    times_noise : float or None
        The simulation's error over the noise floor; None without noise.
    of_travel : float
        `rms` over the range of the position.
    acceleration_rms : float
        R.m.s. of the acceleration that nothing explains [m/s² or rad/s²].
    of_motor : float
        The same over the largest acceleration that the motor gives.
    depends_on_inputs : bool
        Whether it depends on reference, feedforward or a column of the catalogue; else it is noise or shaking.
    material : bool
        Whether `of_travel` exceeds half a percent.
    """

    rms: float
    times_noise: float | None
    of_travel: float
    acceleration_rms: float
    of_motor: float
    depends_on_inputs: bool
    material: bool

    def to_json(self) -> dict[str, Any]:
        """Return the fields; null with a reason for what is not finite."""
        return finite({name: getattr(self, name) for name in self.__slots__})


def remainder_of(case: Case, chosen: Hypothesis, gains: Gains) -> Remainder:
    """Return what `chosen`, the last of `gains`, misses of the training records."""
    error, noise = gains.train(-1), gains.noise
    travel = case.travel
    push = max(float(np.abs(applied_voltage(record)).max()) for record in case.records) * abs(chosen.plant.gain)
    missed = unexplained_acceleration(case.records, gains.trained[-1], case.likelihood.rate, noise)
    missed = missed if np.isfinite(error) else error
    rms = float(np.sqrt(max(error**2 - noise**2, 0.0))) if np.isfinite(error) else error
    return Remainder(
        rms=rms,
        times_noise=error / noise if noise > 0.0 else None,
        of_travel=rms / max(travel, 1e-300),
        acceleration_rms=missed,
        of_motor=missed / max(push, 1e-300),
        depends_on_inputs=not case.is_enough(chosen),
        material=rms > MATERIAL * travel,
    )


def unexplained_acceleration(
    records: Sequence[Record], residuals: Sequence[NDArray[np.float64]], rate: float, noise: float
) -> float:
    """Return the r.m.s. acceleration that the residuals of simulations stand for [m/s² or rad/s²].

    Second derivatives of local cubics over the time in which the loop acts, 2/`rate`; the share that sensor noise alone
    would have is taken off.

    Parameters
    ----------
    records : sequence of Record
        The measurements.
    residuals : sequence of ndarray, shape (n,)
        Simulated minus measured position of each [m or rad].
    rate : float
        Of the loops [rad/s].
    noise : float
        Standard deviation of the sensor's noise [m or rad].
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    squares, samples = 0.0, 0
    for record, residual in zip(records, residuals, strict=True):
        window = int(min(max(2.0 / rate / record.sample_time, 7), len(record) // 2)) // 2 * 2 + 1
        if window < 5 or residual.size <= window or not np.isfinite(residual).all():
            continue
        curve = savgol_filter(residual, window, 3, deriv=2, delta=record.sample_time)
        weights = savgol_coeffs(window, 3, deriv=2, delta=record.sample_time)
        squares += max(float(curve @ curve) - curve.size * noise**2 * float(weights @ weights), 0.0)
        samples += curve.size
    return float(np.sqrt(squares / samples)) if samples else 0.0
