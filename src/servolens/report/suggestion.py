"""A spec that suits records whose owner asked for none."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.design import PDSpec, evaluate
from servolens.errors import InputError

if TYPE_CHECKING:
    from servolens.identification import Identification
    from servolens.plant import Plant

__all__ = ["suggested_spec"]

GAINS = 41
SLACK = 1.25
"""The settling time asked for is the shortest that any gain reaches, times this, rounded up to two digits."""


def suggested_spec(fit: Identification) -> PDSpec | None:
    """Return a spec with the largest Kp of the records and a settling time that the nonlinear model can reach.

    The band is 1 % of the step, or three encoder steps where that is more. None where no loop is known, or none
    settles.
    """
    loops = [r for r in fit.records if r.controller is not None and r.controller.kp > 0]
    model = fit.velocity or fit.constant
    if not loops or model is None or model.plant.gain <= 0:
        return None
    record = max(loops, key=lambda r: r.controller.kp if r.controller is not None else 0.0)
    assert record.controller is not None  # noqa: S101 - chosen so
    plant, kp, step = model.plant, record.controller.kp, record.step_size
    band = max(0.01, _round_up(3.0 * (record.encoder_resolution or 0.0) / step))
    if not (step > 0 and band < 1):
        return None
    natural = math.sqrt(plant.gain * kp)
    sample_time = record.controller.control_period or record.sample_time
    spec = _possible(
        kp=kp,
        settling_time=max(12.0 / natural, 4 * sample_time),
        band=band,
        reference=step,
        sample_time=sample_time,
        derivative_filter=record.controller.derivative_filter,
    )
    shortest = None if spec is None else _shortest(plant, spec)
    if spec is None or shortest is None:
        return None
    return _possible(**{**spec.to_json(), "settling_time": max(_round_up(SLACK * shortest), 4 * sample_time)})


def _possible(**fields: Any) -> PDSpec | None:
    """Return the spec, or None where the axis is so slow or fast that it would be none."""
    try:
        return PDSpec(**fields)
    except InputError:
        return None


def _shortest(plant: Plant, spec: PDSpec) -> float | None:
    """Return the shortest settling time of any gain [s]."""
    times = []
    natural = math.sqrt(plant.gain * spec.kp)
    last = max(6.0 * natural - plant.damping, natural) / plant.gain
    for kd in np.linspace(0.0, last, GAINS):
        found = evaluate(plant, spec, float(kd)).settling_time
        if found is not None and found > 0:
            times.append(found)
    return min(times, default=None)


def _round_up(value: float) -> float:
    """Round up to two significant digits."""
    if value <= 0:
        return 0.0
    power = math.floor(math.log10(value)) - 1
    return float(f"{math.ceil(value / 10.0**power - 1e-9) * 10.0**power:.6g}")
