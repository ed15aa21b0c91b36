"""How far records reach: what a model that was found from them has never seen lies beyond."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import controller_voltage
from servolens.model_evidence import DataRange
from servolens.quality.sampling import top_speed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.record import Record

__all__ = ["data_range"]


def data_range(records: Sequence[Record]) -> DataRange:
    """Return the largest voltage that was asked for, the largest speed, step and gains of the records."""
    loops = [record.controller for record in records if record.controller is not None]
    asked = [record.voltage if record.voltage is not None else controller_voltage(record) for record in records]
    return DataRange(
        voltage=max(float(np.abs(voltage).max()) for voltage in asked),
        speed=max(top_speed(record) for record in records),
        step=max(record.largest_step for record in records),
        kp=max((abs(loop.kp) for loop in loops), default=None),
        kd=max((abs(loop.kd) for loop in loops), default=None),
    )
