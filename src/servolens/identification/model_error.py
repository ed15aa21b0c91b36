"""What records say of a model's error at each frequency, for a gain that is designed on it.

Let the axis answer a command as the model does times 1 + Δ(jω). In a loop that the drive g moves (what its law asks for
while the axis stands still), the model answers with y and the command u, and the records with y + e and u + …: then
e·g = Δ·u_measured·y + noise, at each frequency, for all records of the axis at once. Δ is estimated in narrow bands of
frequency with u·y of the model as instrument, for a measured command carries the noise of its own loop (Ljung, *System
Identification*, 2nd ed., sections 13.5 and 16.5; model error models: Ljung, 1999).

A loop slower than its log sees the axis at its own ticks alone, and so does this: between them a command repeats the
spectrum that it has below half the loop's frequency, which says nothing of what the loop makes of an error there.

Of a record that begins with its step less is seen: its first command counts as applied before, and
so as no change to which the axis could answer otherwise.

A loop with the complementary sensitivity T keeps stable where |T Δ| < 1 at every frequency (the small-gain theorem).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.control_arithmetic import samples_a_tick
from servolens.control_law import controller_voltage
from servolens.errors import ServolensError
from servolens.model_evidence import ModelError
from servolens.simulation import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record

    Spectra = tuple[NDArray[np.complex128], ...]

__all__ = ["model_error"]

RATIO = 1.04
"""Of the ends of a band, as wide as a resonance of damping ratio 0.02; it is wider where it would hold too little."""
FEWEST = 4
"""Values in a band, of all records together: with fewer its noise is hardly known."""
UPPERMOST = 0.8
"""Share of half the sampling frequency up to which an axis that is held from sample to sample is taken as linear."""
CHANCE = 1e-3
"""Probability that noise alone shows an error in any of the bands."""


def model_error(plant: Plant, records: Sequence[Record]) -> ModelError | None:
    """Return the relative error of `plant` at each frequency; None where no record has a loop that can be simulated.

    Parameters
    ----------
    plant : Plant
        The model.
    records : sequence of Record
        Runs of the axis.
    """
    found = [spectra for record in records if (spectra := _spectra(plant, record)) is not None]
    if not found:
        return None
    frequencies, error, answer, instrument = (np.concatenate([one[i] for one in found]) for i in range(4))
    first, last = 0.99 * float(frequencies.real.min()), min(UPPERMOST * float(one[0].real.max()) for one in found)
    if not 0.0 < first < last:
        return None
    edges = np.geomspace(first, last, int(np.ceil(np.log(last / first) / np.log(RATIO))) + 1)
    rows, low = [], first
    for high in edges[1:]:
        inside = (frequencies.real >= low) & (frequencies.real < high)
        if inside.sum() >= FEWEST:
            size = _size(error[inside], answer[inside], instrument[inside], CHANCE / edges.size)
            rows.append((float(np.sqrt(low * high)), size, max(_loop(one, low, high) for one in found)))
            low = float(high)
    if not rows:
        return None
    frequency, sizes, loops = (tuple(column) for column in zip(*rows, strict=True))
    return ModelError(frequency=frequency, size=sizes, loop=loops)


def _spectra(plant: Plant, record: Record) -> Spectra | None:
    """Return of one record frequencies [Hz], e·g, u·y, the same of the model, g and the model's g − u."""
    if record.reference is None or record.controller is None or record.step_size == 0.0:
        return None
    try:
        run = simulate(plant, record, voltage_driven=False)
        still = record.with_({"position": np.full(len(record), record.position[0]), "velocity": _still(record)})
        drive = controller_voltage(still)
        asked = controller_voltage(record) if record.voltage is None else record.voltage
    except ServolensError:
        return None
    shown = run.shown(plant)
    left = record.position - shown
    count = samples_a_tick(record.controller, record.sample_time)
    signals = (shown - shown[0], left - left[0], drive, asked, run.voltage)
    moved, error, pull, answer, given = (_transform(signal[::count]) for signal in signals)
    frequencies = np.fft.rfftfreq(-(-len(record) // count), count * record.sample_time)
    size = np.sqrt(np.mean(np.abs(pull * moved) ** 2))
    if size == 0.0:
        return None  # what the model says does not move has no error relative to that
    weight = 1.0 / size
    found = (error * pull * weight, answer * moved * weight, given * moved * weight, pull, pull - given)
    return tuple(values[1:].astype(np.complex128) for values in (frequencies, *found))


def _still(record: Record) -> NDArray[np.float64] | None:
    return None if record.velocity is None else np.zeros(len(record))


def _transform(signal: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the spectrum of the changes of a signal from rest, which has no end to leak at."""
    return np.fft.rfft(np.diff(signal, prepend=0.0))


def _loop(spectra: Spectra, low: float, high: float) -> float:
    """Return the complementary sensitivity 1 − u/g of a record's loop in a band; 0 where it holds nothing of it."""
    inside = (spectra[0].real >= low) & (spectra[0].real < high)
    drive, fed_back = spectra[4][inside], spectra[5][inside]
    power = float(np.sum(np.abs(drive) ** 2))
    return abs(complex(np.vdot(drive, fed_back))) / power if power > 0.0 else 0.0


def _size(
    error: NDArray[np.complex128], answer: NDArray[np.complex128], instrument: NDArray[np.complex128], chance: float
) -> float:
    """Return the error in a band; where noise hides it, as much as it may hide, but no more than 1."""
    share = complex(np.vdot(instrument, answer))
    if share == 0.0:
        return 1.0
    found = complex(np.vdot(instrument, error)) / share
    if _is_seen(error, instrument, chance) and _is_seen(answer, instrument, chance):
        return abs(found)
    noise = float(np.sum(np.abs(error - found * answer) ** 2)) / (error.size - 1)
    deviation = np.sqrt(noise) * float(np.linalg.norm(instrument)) / abs(share)
    return min(1.0, float(np.hypot(abs(found), 2.0 * deviation)))


def _is_seen(signal: NDArray[np.complex128], instrument: NDArray[np.complex128], chance: float) -> bool:
    """Tell whether a signal goes with the instrument by more than `chance`: the F test of their regression."""
    from scipy.stats import f

    explained = abs(complex(np.vdot(instrument, signal))) ** 2 / float(np.linalg.norm(instrument)) ** 2
    left = max(float(np.linalg.norm(signal)) ** 2 - explained, 1e-300)
    free = signal.size - 1
    return bool(explained * free / left > f.isf(chance, 2, 2 * free))
