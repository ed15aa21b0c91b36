"""What a controller makes of the sensor's noise: how much its command swings while the axis rests."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scipy.optimize import brentq

from servolens.control_law import noise_gain as law_noise_gain
from servolens.effects import Saturation
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.spec import PDSpec
    from servolens.model import Model
    from servolens.plant import Plant

__all__ = ["command_noise", "fills_drive", "noise_gain", "quiet"]

RESTLESS, FULL = 0.1, 1.0 / 3.0
"""R.m.s. of the command at rest, of the largest that the drive gives or, if no limit is known, the records showed, from
which on noise wears the drive: once in a million samples it reaches half of it; and from which on three standard
deviations are all of it."""


def noise_gain(spec: PDSpec, kd: float) -> float:
    """Return the r.m.s. voltage for white noise of r.m.s. 1 in the measured position, from the controller alone [V/m].

    See :func:`servolens.control_law.noise_gain`.
    """
    return law_noise_gain(spec.loop(kd), spec.sample_time)


def quiet(models: Sequence[Model], spec: PDSpec, intervals: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the parts of the `intervals` of gains with which noise does not wear the drive."""

    def excess(gain: float) -> float:
        return max(_share(model, spec, gain) for model in models) - RESTLESS

    last = max(high for _, high in intervals)
    if excess(last) <= 0.0:
        return [*intervals]
    if excess(0.0) >= 0.0:
        return []
    most = float(brentq(excess, 0.0, last))
    return [(low, min(high, most)) for low, high in intervals if low < most]


def fills_drive(models: Sequence[Model], spec: PDSpec, gain: float) -> bool:
    """Tell whether noise takes the command to the drive's end while the axis rests."""
    return max(_share(model, spec, gain) for model in models) > FULL


def command_noise(models: Sequence[Model], spec: PDSpec, gain: float) -> str:
    """Say how much noise moves the command at rest, where that wears the drive; empty where it does not."""
    noisiest = max(models, key=lambda model: _share(model, spec, gain))
    share = _share(noisiest, spec, gain)
    if share <= RESTLESS or noisiest.evidence is None:
        return ""
    noise, plant = noisiest.evidence.noise or 0.0, noisiest.plant
    size = readable(noise * noise_gain(spec, gain), plant.command_unit)
    known = "the largest of the records" if _limit(noisiest.plant) is None else "what the drive gives"
    helps = (
        "a finer sensor" if _share(noisiest, spec, 0.0) > RESTLESS else "a filter of the derivative or a finer sensor"
    )
    told = (
        f"While the axis rests, noise and rounding of the sensor, {readable(noise, plant.length_unit)}, may move the"
        f" command by {size} (r.m.s.), {100.0 * share:.3g} % of {known}; {helps} helps. {spec.noise_remark}"
    )
    return told.rstrip()


def _share(model: Model, spec: PDSpec, gain: float) -> float:
    """Return the r.m.s. of the command at rest over the largest that there is; 0 where nothing is known of it.

    An ideal continuous PD, too, makes infinitely much of white noise, whatever its gains.
    """
    if spec.control == "continuous" or model.evidence is None or model.evidence.noise is None:
        return 0.0
    most = _limit(model.plant) or model.evidence.range.voltage
    return model.evidence.noise * noise_gain(spec, gain) / max(most, 1e-300)


def _limit(plant: Plant) -> float | None:
    """Return the largest command that the drive gives, where it is known."""
    effect = plant.effect(Saturation.name)
    return effect.limit if isinstance(effect, Saturation) else None
