"""What shakes an axis, drawn: what its loop makes of that, and what an observer of it then misses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import ServolensError
from servolens.identification.rounding import DRAWS, beginning_of, drawn_noise, spectrum_of
from servolens.identification.segments import applied_voltage
from servolens.processors import in_processes
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.plant import Plant
    from servolens.prediction import Beginning, Disturbed
    from servolens.record import Record

__all__ = ["at_least_white", "shaken", "shaking"]

LEAST_OCTAVE = 8
"""Frequencies of a record's spectrum below which octaves are not told apart: of so many, in as many draws as there are,
the power is known to a tenth."""
RUNS_AWAY = 1e6
"""Standard deviations of an innovation beyond which loop or observer of a draw is unstable, and no draw."""


def shaken(
    runs: Sequence[ObservedRun | SimulatedRun], plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return draws of each run's whitened residual if its plant is the axis, shape (n, draws).

    The loop answers to the sensor's noise and to what shakes the axis, and the observer follows what it then measures.
    Without a reference the voltage is the record's own. A draw in which either diverges is of white noise.

    Parameters
    ----------
    runs : sequence of ObservedRun or SimulatedRun
        Of an axis that is shaken.
    plants, starts : sequence
        The plant of each run and its initial state.
    """
    stream = np.random.default_rng(4)
    return [_of_run(run, plant, start, stream) for run, plant, start in zip(runs, plants, starts, strict=True)]


def _of_run(
    run: ObservedRun | SimulatedRun, plant: Plant, start: NDArray[np.float64], stream: np.random.Generator
) -> NDArray[np.float64]:
    record, noise = run.signals.record, run.noise
    errors = drawn_noise(spectrum_of(noise), len(record), stream)
    shakes = shaking(noise, record, stream)
    substeps = substeps_for(plant, run.sample_time)
    white = stream.standard_normal((run.samples, DRAWS))
    begun = beginning_of(run, start)

    def one(k: int) -> NDArray[np.float64]:
        try:
            position, voltage = _measured(plant, begun, {"sensor_error": errors[:, k], "acceleration": shakes[:, k]})
            drawn = run.measured_as(position, voltage).observed_anew()
            missed = drawn.whiten(drawn.missed(plant, start, substeps))
        except ServolensError:
            return white[:, k]
        return missed if np.abs(missed).max() < RUNS_AWAY else white[:, k]

    return np.column_stack(in_processes(one, range(DRAWS)))


def at_least_white(draws: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return draws of a run, shape (n, draws), in each octave no weaker than white noise of variance 1.

    What the shaking of an axis that nothing holds leaves is white. The observer that finds it is linear: of an axis
    that sticks part of the time it finds less than there is.
    """
    size = draws.shape[0] // 2
    if size == 0:
        return draws
    octaves = np.log2(np.arange(1, size + 1) / size)
    centres = np.arange(min(int(np.log2(LEAST_OCTAVE / size)), 0), 1) - 0.5
    number = np.clip(np.floor(octaves - centres[0] + 0.5).astype(int), 0, centres.size - 1)
    waves = np.fft.rfft(draws, axis=0)
    power = np.bincount(number, np.mean(np.abs(waves[1:]) ** 2, axis=1) / draws.shape[0], centres.size)
    count = np.bincount(number, minlength=centres.size)
    weak = np.where(count > 0, np.minimum(power / np.maximum(count, 1), 1.0), 1.0)
    gain = np.exp(-0.5 * np.interp(octaves, centres, np.log(np.maximum(weak, 1e-300))))
    return np.asarray(np.fft.irfft(waves * np.append(gain[:1], gain)[:, None], draws.shape[0], axis=0))


def _measured(plant: Plant, begun: Beginning, disturbed: Disturbed) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position and applied voltage of a shaken axis as its log would hold them."""
    record = begun.record
    if record.has_loop:
        loop = replace(record, encoder_resolution=None)  # whose rounding is part of the error
        moved = begun.simulated(plant, loop, **disturbed)
        return moved.measured, applied_voltage(replace(record, voltage=moved.voltage))
    voltage = applied_voltage(record)
    return begun.simulated(plant, replace(record, voltage=voltage), **disturbed).measured, voltage


def shaking(noise: NoiseModel, record: Record, stream: np.random.Generator, draws: int = DRAWS) -> NDArray[np.float64]:
    """Return draws of the acceleration that shakes the axis [m/s² or rad/s²], shape (n, draws)."""
    from scipy.signal import lfilter

    kept, power = noise.shaking(record.sample_time)
    white = stream.standard_normal((len(record), draws))
    white[1:] *= np.sqrt(1.0 - kept**2)
    return np.asarray(noise.spread * np.sqrt(power) * lfilter([1.0], [1.0, -kept], white, axis=0))
