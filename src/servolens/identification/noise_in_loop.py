"""What the sensor's noise does in the closed loop, drawn: an axis that sticks or hunts answers to it for long."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.rounding import DRAWS, disturbed, drawn_noise, spectrum_of
from servolens.processors import in_parallel
from servolens.simulation.loop import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["drawn_loop_errors"]


def drawn_loop_errors(
    plant: Plant, records: Sequence[Record], noise: NoiseModel, ripples: Sequence[NDArray[np.float64]]
) -> list[tuple[NDArray[np.float64], ...]]:
    """Return draws of what simulations in closed loop miss of the records if `plant` is the axis.

    The loop answers to the noise; the simulation that is compared with the record knows none. Draws in which the loop
    leaves all bounds are left out.

    Parameters
    ----------
    plant : Plant
        The axis.
    records : sequence of Record
        With reference and controller.
    noise : NoiseModel
        Of the sensor, without shaking.
    ripples : sequence of ndarray, shape (n,)
        Of the mains in each record [m or rad].

    Returns
    -------
    list of tuple of ndarray, shape (n,)
        Of each draw the errors of all records [m or rad].
    """
    stream = np.random.default_rng(2)
    still = [simulate(plant, record).position for record in records]
    drawn = [
        drawn_noise(spectrum_of(noise), len(record), stream) + ripple[:, None]
        for record, ripple in zip(records, ripples, strict=True)
    ]

    def one(k: int) -> tuple[NDArray[np.float64], ...] | None:
        with suppress(NumericalError):
            return tuple(
                simulate(plant, disturbed(record, errors[:, k])).position + errors[:, k] - position
                for record, errors, position in zip(records, drawn, still, strict=True)
            )
        return None

    return [errors for errors in in_parallel(one, range(DRAWS)) if errors is not None]
