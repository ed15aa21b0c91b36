"""How far records reach: what a model that was found from them has never seen lies beyond."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import controller_voltage, noise_gain
from servolens.identification.segments import noise_level, resting_noise
from servolens.model_evidence import DataRange
from servolens.quality.sampling import SPEED_SPAN, top_speed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.record import Record

__all__ = ["data_range"]


def data_range(records: Sequence[Record]) -> DataRange:
    """Return the largest voltage that was asked for, the largest speed, step and gains of the records.

    Each with the error that the sensor's noise makes in the record that showed it.
    """
    loops = [record.controller for record in records if record.controller is not None]
    voltage, speed, step = (max(known(r) for r in records) for known in (_voltage, _speed, _step))
    return DataRange(
        voltage=voltage[0],
        speed=speed[0],
        step=step[0],
        kp=max((abs(loop.kp) for loop in loops), default=None),
        kd=max((abs(loop.kd) for loop in loops), default=None),
        voltage_error=voltage[1],
        speed_error=speed[1],
        step_error=step[1],
    )


def _voltage(record: Record) -> tuple[float, float]:
    """Return the largest voltage, and what the law makes of the noise in each sample and of what is slower."""
    asked = record.voltage if record.voltage is not None else controller_voltage(record)
    law, error = record.controller, 0.0
    if law is not None:
        fast, slow = noise_gain(law, record.sample_time) * noise_level(record), abs(law.kp) * resting_noise([record])
        error = max(fast, slow)
    return float(np.abs(asked).max()), error


def _speed(record: Record) -> tuple[float, float]:
    span = min(SPEED_SPAN, len(record) - 1) * record.sample_time
    return top_speed(record), float(np.sqrt(2.0)) * noise_level(record) / span


def _step(record: Record) -> tuple[float, float]:
    return record.largest_step, max(noise_level(record), resting_noise([record]))
