"""Simulation of the digital PD loop, of the ideal continuous one (eq. 15), and of the axis driven by its voltage."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import TYPE_CHECKING, TypeVar, Unpack, final

import numpy as np

from servolens.dynamics import ideal_pd
from servolens.effects import Sensor, Transmission
from servolens.errors import InputError, NumericalError
from servolens.inputs import as_plant, as_record
from servolens.simulation.circumstances import plant_in
from servolens.simulation.grids import as_floats, as_grid, sample_time_of, without_gaps
from servolens.simulation.rates import substeps_for
from servolens.simulation.settings import NO_LAW, OPEN_LOOP, known, law_settings, loop_settings

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from servolens.controller import Controller
    from servolens.effects import Effect
    from servolens.inputs import Plants, Records, RecordSettings
    from servolens.plant import Plant

__all__ = [
    "Simulation",
    "simulate",
    "simulate_continuous",
    "simulate_loop",
    "simulate_observed",
    "simulate_trial",
    "simulate_voltage",
]

Part = TypeVar("Part")

PATIENCE, ONE_OF, ANY_NUMBER = 5.0, 4, 0.0
"""Pieces into which a substep of a trial may be split on average, held to be one of a few of its sample at least, for a
fast lag splits each sample; most pieces, where there is no such limit."""
NO_OBSERVER, NONE_CORRECTED = (0.0, 0.0, 0.0), np.zeros(3)
"""What the rule is told where no measurement corrects the axis."""
OBSERVED, SHAKEN = 1.0, 2.0
"""What it is told where one does, or where the axis is shaken or its sensor errs; see :mod:`.digital`."""


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


def simulate(
    plant: Plants,
    record: Records,
    *,
    initial_velocity: float = 0.0,
    voltage_driven: bool | None = None,
    acceleration: NDArray[np.float64] | None = None,
    sensor_error: NDArray[np.float64] | None = None,
    substeps: int | None = None,
    **settings: Unpack[RecordSettings],
) -> Simulation:
    """Simulate `plant` through what was done in `record`, at the record's samples.

    Starts at the first measured position. The digital loop of the record's controller is closed on the simulated
    position (quantised where the record states its encoder); without reference or gains the logged voltage drives.

    Parameters
    ----------
    plant : Plant, model, fit, diagnosis, or path of a model's file
        In the record's units.
    record : Record, path, DataFrame or TimeResponseData
        Gives time, reference, feedforward, controller, encoder, voltage limit, inertia, and when the motor is on.
    initial_velocity : float
        [m/s or rad/s].
    voltage_driven : bool, optional
        True: apply the logged voltage; False: close the loop; None: close it where the record allows.
    acceleration : ndarray, shape (n,), optional
        Of what shakes the axis, from each of the record's samples to the next [m/s² or rad/s²].
    sensor_error : ndarray, shape (n,), optional
        Of each sample, before the encoder rounds it [m or rad]; the controller answers to it.
    substeps : int, optional
        Steps a sample; None chooses them from the plant's fastest rate.
    **settings
        ``kp``, ``kd`` … of a table or file (:class:`servolens.inputs.RecordSettings`).

    Raises
    ------
    InputError
        If the record lacks what is asked for.
    NumericalError
        If the simulation of the axis diverges.
    """
    plant, record = as_plant(plant), as_record(record, settings)
    can_close = record.reference is not None and record.controller is not None
    driven = not can_close if voltage_driven is None else voltage_driven
    if driven and record.voltage is None:
        raise InputError(f"{record.name}: no voltage is logged, so it cannot drive a simulation")
    if not driven and not can_close:
        raise InputError(f"{record.name}: closing the loop needs reference, kp and kd")
    plant = plant_in(plant, record)
    _shaking(acceleration, sensor_error, record.time)
    start = (float(record.position[0]), initial_velocity)
    if driven:
        return simulate_voltage(
            plant,
            record.time,
            _given(record.voltage),
            start=start,
            before=record.voltage_before,
            acceleration=acceleration,
            sensor_error=sensor_error,
            substeps=substeps,
        )
    grid, held, index = without_gaps(record.time)
    result = simulate_loop(
        plant,
        _given(record.controller),
        grid,
        _given(record.reference)[held],
        feedforward=None if record.feedforward is None else record.feedforward[held],
        start=start,
        before=record.voltage_before,
        resolution=record.encoder_resolution or 0.0,
        limit=record.voltage_limit,
        acceleration=None if acceleration is None else acceleration[held],
        sensor_error=None if sensor_error is None else sensor_error[held],
        substeps=substeps,
    )
    if index is None:
        return result
    return Simulation(**{name: getattr(result, name)[index] for name in Simulation.__slots__})


def simulate_loop(  # noqa: PLR0913 - what a loop is, all but the run by keyword
    plant: Plants,
    controller: Controller,
    time: ArrayLike,
    reference: ArrayLike,
    *,
    feedforward: ArrayLike | None = None,
    start: tuple[float, float] = (0.0, 0.0),
    before: float | None = None,
    resolution: float = 0.0,
    limit: float | None = None,
    acceleration: ArrayLike | None = None,
    sensor_error: ArrayLike | None = None,
    substeps: int | None = None,
) -> Simulation:
    """Simulate the digital loop: sampled, zero-order hold, the controller's own derivative and integral.

    Parameters
    ----------
    plant, controller : Plant, Controller
        The axis and its loop.
    time, reference, feedforward : array_like, shape (n,)
        Samples [s], set point [m or rad], voltage added to the controller's [V].
    start : tuple of float
        Initial position [m or rad] and velocity.
    before : float, optional
        Voltage applied before the first sample [V]; None is the first one.
    resolution : float
        Encoder step [m or rad]; 0 is none.
    limit : float, optional
        Of the command, as the controller knows it against windup [V], perhaps infinite; None is that of the plant's
        saturation.
    acceleration : array_like, shape (n,), optional
        Of what shakes the axis, from each sample to the next [m/s² or rad/s²].
    sensor_error : array_like, shape (n,), optional
        Of each sample, before the encoder rounds it [m or rad].
    substeps : int, optional
        Steps a sample.

    Raises
    ------
    InputError
        If the samples do not fit together, or the controller needs a limit and there is none.
    NumericalError
        If the loop is unstable.
    """
    plant = as_plant(plant)
    grid = as_grid(time)
    held = np.zeros(grid.size) if feedforward is None else as_floats(feedforward)
    period = sample_time_of(grid)
    law = law_settings(plant, controller, period, limit)
    corrects, shaken = _shaking(acceleration, sensor_error, grid)
    settings = [1.0, *loop_settings(controller, period), resolution, ANY_NUMBER, *known(before), *corrects, *law]
    count = substeps or substeps_for(plant, period)
    return _run(plant, grid, held, as_floats(reference), settings, start, count, corrections=shaken)


def _shaking(
    acceleration: ArrayLike | None, sensor_error: ArrayLike | None, time: NDArray[np.float64]
) -> tuple[tuple[float, float, float], NDArray[np.float64] | None]:
    """Return the settings of an axis that is shaken or whose sensor errs, or not, and by what, shape (n, 2)."""
    if acceleration is None and sensor_error is None:
        return NO_OBSERVER, None
    disturbed = np.zeros((time.size, 2))
    for column, (what, given) in enumerate((("acceleration", acceleration), ("sensor's error", sensor_error))):
        if given is not None:
            values = as_floats(given)
            if values.shape != time.shape:
                raise InputError(f"time has {time.size} samples, the {what} {values.size}")
            disturbed[:, column] = values
    return (SHAKEN, *NO_OBSERVER[1:]), disturbed


def simulate_trial(  # noqa: PLR0913 - as simulate_loop
    plant: Plant,
    controller: Controller,
    time: NDArray[np.float64],
    reference: NDArray[np.float64],
    *,
    feedforward: NDArray[np.float64] | None,
    start: tuple[float, float],
    before: float | None = None,
    limit: float | None = None,
    substeps: int,
    patience: float = PATIENCE,
) -> Simulation:
    """Simulate the digital loop of a plant that is only tried, without rounding, and give up where it rattles.

    Parameters
    ----------
    plant, controller, time, reference, feedforward, start, before, limit, substeps
        As of :func:`simulate_loop`.
    patience : float
        Pieces into which a substep may be split on average.

    Raises
    ------
    InputError
        If the samples do not fit together.
    NumericalError
        If the loop is unstable, or dry friction and contacts split its steps into more pieces than are granted.
    """
    held = np.zeros(time.size) if feedforward is None else feedforward
    granted = patience * time.size * max(substeps, ONE_OF)
    period = sample_time_of(time)
    law = law_settings(plant, controller, period, limit)
    settings = [1.0, *loop_settings(controller, period), 0.0, granted, *known(before), *NO_OBSERVER, *law]
    return _run(plant, time, held, reference, settings, start, substeps)


def simulate_voltage(
    plant: Plants,
    time: ArrayLike,
    voltage: ArrayLike,
    *,
    start: tuple[float, float] = (0.0, 0.0),
    before: float | None = None,
    acceleration: ArrayLike | None = None,
    sensor_error: ArrayLike | None = None,
    substeps: int | None = None,
) -> Simulation:
    """Simulate the axis under a `voltage` [V] that is held from sample to sample.

    Parameters
    ----------
    plant, time, voltage, start, before, acceleration, sensor_error, substeps
        As of :func:`simulate_loop`.
    """
    plant = as_plant(plant)
    grid = as_grid(time)
    step = float(np.max(np.diff(grid), initial=1e-9))
    held = as_floats(voltage)
    corrects, shaken = _shaking(acceleration, sensor_error, grid)
    return _run(
        plant,
        grid,
        held,
        held,
        [*OPEN_LOOP, ANY_NUMBER, *known(before), *corrects, *NO_LAW],
        start,
        substeps or substeps_for(plant, step),
        corrections=shaken,
    )


def simulate_observed(  # noqa: PLR0913 - what a loop is, all but the run by keyword
    plant: Plant,
    time: NDArray[np.float64],
    voltage: NDArray[np.float64],
    position: NDArray[np.float64],
    *,
    gains: NDArray[np.float64] | None,
    remembered: float = 0.0,
    start: tuple[float, float],
    before: float | None = None,
    substeps: int,
    coarse: float = 0.0,
) -> Simulation:
    """Predict each sample of `position` from those before it: an observer under a `voltage` that is held.

    After each sample the axis is moved towards what was measured, by the `gains` times the difference; and so is an
    acceleration that shakes it until the next. Without gains it is a simulation. Gives up where the axis rattles, as
    :func:`simulate_trial` does.

    Parameters
    ----------
    plant, time, voltage, start, before, substeps
        As of :func:`simulate_voltage`.
    position : ndarray, shape (n,)
        As measured [m or rad].
    gains : ndarray, shape (n, 3), or None
        Of position [1], velocity [1/s] and shaking [1/s²] at each sample; a load and a filtered sensor are moved along.
    remembered : float
        Share of the shaking that is left a sample later.
    coarse : float
        Speed [m/s or rad/s] by which a step may be wrong beyond what other simulations allow.

    Returns
    -------
    Simulation
        With the predictions as `measured`.
    """
    granted = PATIENCE * time.size * max(substeps, ONE_OF)
    if gains is not None and gains.shape != (time.size, 3):
        raise InputError(f"gains must have the shape ({time.size}, 3), got {gains.shape}")
    observer = (0.0 if gains is None else OBSERVED, coarse, remembered)
    settings = [*OPEN_LOOP, granted, *known(before), *observer, *NO_LAW, *_moved(plant.structure)]
    return _run(plant, time, voltage, position, settings, start, substeps, corrections=gains)


@lru_cache(maxsize=1024)
def _moved(structure: tuple[type[Effect], ...]) -> tuple[float, ...]:
    """Return for each state, in the kernel's order, whether an observer moves it: with position 1, with velocity 2."""
    from servolens.simulation.native import native

    kinds = [(cls, state.name) for cls in structure for state in cls.states]
    own = [
        1.0 + ("position", "velocity").index(name) if issubclass(cls, Transmission) else float(issubclass(cls, Sensor))
        for cls, name in kinds
    ]
    placed = [0.0] * len(own)
    for value, place in zip(own, native(structure).order.tolist(), strict=True):
        placed[place] = value
    return tuple(placed)


def simulate_continuous(
    plant: Plants,
    kp: float,
    kd: float,
    time: ArrayLike,
    reference: ArrayLike,
    *,
    start: tuple[float, float] = (0.0, 0.0),
    substeps: int | None = None,
) -> Simulation:
    """Simulate the ideal continuous PD ``V = kp (r − y) − kd ẏ`` (paper eq. 15), the reference held between samples.

    Fed back are the position as the sensor shows it and the true velocity of the load.

    Raises
    ------
    InputError
        If the plant has a delay.
    """
    plant = as_plant(plant)
    grid = as_grid(time)
    step = float(np.max(np.diff(grid), initial=1e-9))
    held = as_floats(reference)
    if plant.delay > 0.0:
        raise InputError("the ideal continuous loop cannot hold a delay; simulate the sampled loop instead")
    loop = np.sqrt(abs(plant.gain * kp)) + abs(plant.gain * kd)
    count = substeps or substeps_for(plant, step, extra=float(loop))
    result = _run(
        plant,
        grid,
        held,
        held,
        [*OPEN_LOOP, ANY_NUMBER, *known(None), *NO_OBSERVER, *NO_LAW],
        start,
        count,
        gains=(kp, kd),
    )
    voltage = ideal_pd(kp, kd, held, result.measured, result.velocity)
    return Simulation(
        time=grid, position=result.position, velocity=result.velocity, voltage=voltage, measured=result.measured
    )


def _run(  # noqa: PLR0913 - as it is compiled
    plant: Plant,
    time: NDArray[np.float64],
    held: NDArray[np.float64],
    reference: NDArray[np.float64],
    settings: list[float],
    start: tuple[float, float],
    substeps: int,
    gains: tuple[float, ...] = (),
    corrections: NDArray[np.float64] | None = None,
) -> Simulation:
    from servolens.simulation.native import native

    if not (held.size == reference.size == time.size):
        raise InputError(f"time has {time.size} samples, the input {held.size}, the reference {reference.size}")
    code = native(plant.structure, continuous=bool(gains), work=time.size * substeps)
    results = np.empty((4, time.size))
    corrected = NONE_CORRECTED if corrections is None else corrections.ravel()
    inputs = (time, held, reference, settings, start, (*plant.values, *gains), corrected)
    given = np.concatenate(inputs, dtype=np.float64)  # one array: to ask each for its address takes as long as a step
    places = accumulate((8 * len(part) for part in inputs[:-1]), initial=given.ctypes.data)
    first = results.ctypes.data
    done = ctypes.c_int64()
    code.run(ctypes.byref(done), None, time.size, substeps, plant.delay, *places, first, first + results[:3].nbytes)
    if done.value < 0:
        raise NumericalError(
            "the simulated axis sticks and slips, or hits its contacts, too often: "
            "a step would need more parts than allowed"
        )
    if done.value < time.size:
        raise NumericalError(
            f"the simulation of the axis diverges (gain {plant.gain:g}, damping {plant.damping:g}); "
            "the loop is unstable with these gains"
        )
    position, velocity, voltage, measured = results
    return Simulation(time=time, position=position, velocity=velocity, voltage=voltage, measured=measured)


def _given(part: Part | None) -> Part:
    assert part is not None  # noqa: S101 - the caller checked
    return part
