"""Simulations of plants of one structure under the same inputs, in one call of the compiled rule."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.effects import Sensor
from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["Inputs", "Simulation", "run_all", "run_one"]

NONE_CORRECTED = np.zeros(3)
"""What the rule is given where nothing corrects or shakes the axis."""
BYTES = 8
"""Of a number."""
START = 3
"""Numbers of an initial state: position, velocity, and how far the motor is ahead of the load."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation:
    """What the axis does, at the samples.

    Attributes
    ----------
    time, position, velocity, voltage, measured : ndarray, shape (n,)
        [s], true position [m or rad] and velocity, what the controller asks for [V], position as the encoder shows it.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    voltage: NDArray[np.float64]
    measured: NDArray[np.float64]

    def shown(self, plant: Plant) -> NDArray[np.float64]:
        """Return what a sensor effect of `plant` shows, rounded as the record's encoder does, else the position."""
        return self.measured if any(isinstance(effect, Sensor) for effect in plant.effects) else self.position


class Inputs(NamedTuple):
    """Samples under which plants are simulated.

    Attributes
    ----------
    time, held, reference : ndarray, shape (n,)
        [s]; voltage, or what is added to that of the controller [V]; set point, or measured position [m or rad].
    corrections : ndarray, optional
        Gains of an observer, shape (n, 3), or what shakes the axis and its sensor, shape (n, 2).
    """

    time: NDArray[np.float64]
    held: NDArray[np.float64]
    reference: NDArray[np.float64]
    corrections: NDArray[np.float64] | None = None


def run_all(
    plants: Sequence[Plant],
    inputs: Inputs,
    settings: Sequence[Sequence[float]],
    starts: Sequence[Sequence[float]],
    substeps: int,
    gains: tuple[float, ...] = (),
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return what each of the `plants` does, and how many samples of it were simulated.

    Python is left free meanwhile, for other threads.

    Parameters
    ----------
    plants : sequence of Plant
        Of one structure.
    inputs : Inputs
        The same for all.
    settings : sequence of sequence of float
        For each plant, what :mod:`servolens.simulation.digital` names.
    starts : sequence of sequence of float
        For each plant, its initial position [m or rad] and velocity, and the place of its motor within a gap; see
        :func:`servolens.simulation.simulate_loop`.
    substeps : int
        Steps a sample.
    gains : tuple of float
        kp and kd of an ideal PD within the step, if there is one.

    Returns
    -------
    ndarray, shape (k, 4, n)
        Positions, velocities, voltages, and positions as measured; undefined where fewer samples were simulated.
    ndarray of int64, shape (k,)
        Samples simulated; minus one where steps were split into more pieces than granted.

    Raises
    ------
    InputError
        If the samples do not fit together.
    """
    from servolens.simulation.native import native

    time, held, reference, corrections = inputs
    n, count = time.size, len(plants)
    if not (held.size == reference.size == n):
        raise InputError(f"time has {n} samples, the input {held.size}, the reference {reference.size}")
    code = native(plants[0].structure, continuous=bool(gains), work=n * substeps * count)
    common = (time, held, reference, NONE_CORRECTED if corrections is None else corrections.ravel())
    shared = np.concatenate(common, dtype=np.float64)  # one array: to ask each for its address takes as long as a step
    each = zip(plants, settings, starts, strict=True)
    own = np.array([(*law, *_begun(plant, *start), *plant.driven_values, *gains) for plant, law, start in each])
    results, done = np.empty((count, 4, n)), np.empty(count, dtype=np.int64)
    delays = np.array([plant.delay for plant in plants])
    first, out = own.ctypes.data, results.ctypes.data
    law, width = BYTES * len(settings[0]), BYTES * own.shape[1]
    time_at, held_at, reference_at, corrections_at = (shared.ctypes.data + BYTES * n * k for k in range(4))
    rows: list[int] = []
    for k in range(count):
        at, to = first + k * width, out + 4 * BYTES * n * k
        rows += [time_at, held_at, reference_at, at, at + law, at + law + START * BYTES, corrections_at]
        rows += [to, to + 3 * BYTES * n]
    places = (ctypes.c_int64 * len(rows))(*rows)
    code.runs(count, n, substeps, delays.ctypes.data, ctypes.addressof(places), done.ctypes.data)
    return results, done


def _begun(plant: Plant, position: float, velocity: float, place: float = 0.0) -> tuple[float, float, float]:
    """Return position, velocity, and how far the motor is ahead of the load [m or rad]."""
    return position, velocity, place * plant.play


def run_one(
    plant: Plant,
    inputs: Inputs,
    settings: Sequence[float],
    start: Sequence[float],
    substeps: int,
    gains: tuple[float, ...] = (),
) -> Simulation:
    """Return what one plant does; see :func:`run_all`.

    Raises
    ------
    InputError
        If the samples do not fit together, or one is not finite.
    NumericalError
        If it diverges, or more pieces than granted would be needed.
    """
    (results,), (done,) = run_all([plant], inputs, [settings], [start], substeps, gains)
    if done < 0:
        raise NumericalError(
            "the simulated axis sticks and slips, or hits its contacts, too often: "
            "a step would need more parts than allowed"
        )
    if done < inputs.time.size:
        if not all(np.isfinite(signal).all() for signal in inputs if signal is not None):
            raise InputError("a sample of the voltage, the reference or what disturbs the simulation is not finite")
        raise NumericalError(
            f"the simulation of the axis diverges (gain {plant.gain:g}, damping {plant.damping:g}); "
            "the loop is unstable with these gains"
        )
    position, velocity, voltage, measured = results
    return Simulation(time=inputs.time, position=position, velocity=velocity, voltage=voltage, measured=measured)
