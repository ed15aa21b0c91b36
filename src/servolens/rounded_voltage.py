"""A voltage that was rounded when it was logged, and what the law of its loop says that it was."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.control_law import controller_voltage
from servolens.encoder import quantisation_step
from servolens.errors import InputError

if TYPE_CHECKING:
    from servolens.record import Record

__all__ = ["with_exact_voltage"]

NO_CLOSER = 0.75
"""Share of values within half a step of a rounded one if they are off by as much as it is: both are uniform then, and
their difference has a triangular density."""


def with_exact_voltage(record: Record) -> Record:
    """Return `record` with its voltage, if the log holds it in steps, as its stated law has it within half a step.

    A log that holds 10 mV drives a simulation by other forces than the axis felt, which look like something that shakes
    it. Where the law of the loop, of the logged positions, is closer to the true voltage than the rounded one, as the
    difference of the two shows, it tells where in its step the voltage was.

    Parameters
    ----------
    record : Record
        Of a loop that ran once a sample; others are returned as they are.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> from servolens import lab
    >>> record = lab.step_record(lab.NLM1, kp=60, noise=1e-5, seed=1)
    >>> rounded = replace(record, voltage=np.round(record.voltage, 2))
    >>> bool(np.max(np.abs(with_exact_voltage(rounded).voltage - record.voltage)) < 1e-9)
    True
    """
    if record.voltage is None or not record.has_loop:
        return record
    step = quantisation_step(record.voltage)
    try:
        if step is None or record.ticks > 1:
            return record
        asked = controller_voltage(record)
    except InputError:  # of a law that the record contradicts, which is told elsewhere
        return record
    low, high = record.voltage - 0.5 * step, record.voltage + 0.5 * step
    asked = np.clip(asked, low.min(), high.max())  # behind a limit that was reached
    changes = np.diff(record.voltage) != 0.0  # while the axis stands, one difference is seen often
    beside = np.append(changes, False) | np.append(False, changes)
    is_within = np.abs(asked - record.voltage) <= (0.5 + 1e-6) * step
    if np.mean(is_within[beside]) <= NO_CLOSER:
        return record
    exact = np.clip(asked, low, high)
    is_known = np.allclose(exact, record.voltage, rtol=0.0, atol=1e-6 * step)  # of a coarse encoder it moves in steps
    return record if is_known else replace(record, voltage=exact)
