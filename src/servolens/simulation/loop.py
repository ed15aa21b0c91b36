"""Simulation of the digital PD loop, of the ideal continuous one (eq. 15), and of the axis driven by its voltage."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, TypedDict, TypeVar, Unpack

import numpy as np

from servolens.control_law import command_at
from servolens.controller import Controller, as_limit
from servolens.dynamics import ideal_pd
from servolens.errors import InputError, needed, number_within, one_of, whole_number
from servolens.inputs import as_plant, as_record
from servolens.simulation.circumstances import plant_in
from servolens.simulation.grids import as_floats, as_grid, sample_time_of
from servolens.simulation.rates import substeps_for
from servolens.simulation.runs import Inputs, Simulation, run_one
from servolens.simulation.settings import (
    ANY_NUMBER,
    COARSE,
    DISTURBED,
    NO_LAW,
    NO_OBSERVER,
    OPEN_LOOP,
    begun,
    known,
    law_settings,
    loop_settings,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from servolens.inputs import Plants, Records, RecordSettings
    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.ticks import Ticks

__all__ = [
    "Simulation",
    "simulate",
    "simulate_continuous",
    "simulate_loop",
    "simulate_voltage",
]

Part = TypeVar("Part")
MOST_ASKED = 1_000_000
"""Steps a sample that may be asked for: a second of a log at 1 kHz then takes half a minute or more."""


def simulate(
    plant: Plants,
    record: Records,
    *,
    initial_velocity: float = 0.0,
    initial_place: float = 0.0,
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
    initial_place : float
        Of the motor within the gap of a backlash: 0 is its middle, -1 and 1 are its ends.
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
    can_close = record.has_loop
    one_of(voltage_driven, (None, True, False), "voltage_driven")
    driven = not can_close if voltage_driven is None else voltage_driven
    if driven and record.voltage is None:
        raise InputError(f"{record.name}: no voltage is logged, so it cannot drive a simulation")
    if not driven and not can_close:
        raise InputError(f"{record.name}: closing the loop needs reference, kp and kd")
    velocity = number_within(initial_velocity, -inf, inf, "initial_velocity")
    place = number_within(initial_place, -1.0, 1.0, "initial_place")
    plant = plant_in(plant, record)
    _shaking(acceleration, sensor_error, record.time)
    ticks = record.loop_ticks()
    run = _driven if driven else _closed
    result = run(
        plant,
        record,
        ticks,
        start=(float(record.position[0]), velocity, place),
        before=record.voltage_before,
        acceleration=None if acceleration is None else as_floats(acceleration, "acceleration")[ticks.held],
        sensor_error=None if sensor_error is None else as_floats(sensor_error, "sensor_error")[ticks.held],
        substeps=substeps,
    )
    if ticks.index is None:
        return result
    return Simulation(**{name: ticks.logged(getattr(result, name)) for name in Simulation.__slots__})


class _Circumstances(TypedDict):
    """What a run begins with and is disturbed by, and its substeps."""

    start: Sequence[float]
    before: float | None
    acceleration: NDArray[np.float64] | None
    sensor_error: NDArray[np.float64] | None
    substeps: int | None


def _driven(plant: Plant, record: Record, ticks: Ticks, **circumstances: Unpack[_Circumstances]) -> Simulation:
    return simulate_voltage(plant, ticks.time, command_at(record, ticks), **circumstances)


def _closed(plant: Plant, record: Record, ticks: Ticks, **circumstances: Unpack[_Circumstances]) -> Simulation:
    return simulate_loop(
        plant,
        _given(record.controller),
        ticks.time,
        ticks.set_point(_given(record.reference)),
        feedforward=None if record.feedforward is None else ticks.command(record.feedforward),
        resolution=record.encoder_resolution or 0.0,
        limit=record.voltage_limit,
        **circumstances,
    )


def simulate_loop(  # noqa: PLR0913 - what a loop is, all but the run by keyword
    plant: Plants,
    controller: Controller,
    time: ArrayLike,
    reference: ArrayLike,
    *,
    feedforward: ArrayLike | None = None,
    start: Sequence[float] = (0.0, 0.0),
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
    start : sequence of float
        Initial position [m or rad] and velocity; and, where there is backlash, the place of the motor within the gap:
        0, its middle, if it is left out, -1 and 1 are its ends.
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
    needed(controller, Controller)
    grid = as_grid(time)
    held = np.zeros(grid.size) if feedforward is None else as_floats(feedforward, "feedforward")
    period = sample_time_of(grid)
    step = number_within(resolution, 0.0, inf, "resolution")
    law = law_settings(plant, controller, None if limit is None else as_limit(limit))
    corrects, shaken = _shaking(acceleration, sensor_error, grid)
    settings = [1.0, *loop_settings(controller, period), step, ANY_NUMBER, *known(before), *corrects, *law]
    count = _substeps(substeps, plant, period)
    return run_one(plant, Inputs(grid, held, as_floats(reference, "reference"), shaken), settings, begun(start), count)


def _substeps(asked: int | None, plant: Plant, step: float, loop: float = 0.0) -> int:
    """Return the steps a sample that are asked for, or those that the plant needs beside its `loop` [rad/s]."""
    return substeps_for(plant, step, extra=loop) if asked is None else whole_number(asked, 1, "substeps", MOST_ASKED)


def _shaking(
    acceleration: ArrayLike | None, sensor_error: ArrayLike | None, time: NDArray[np.float64]
) -> tuple[tuple[float, float, float], NDArray[np.float64] | None]:
    """Return the settings of an axis that is shaken or whose sensor errs, or not, and by what, shape (n, 2).

    Steps are no finer than shows beside what the sensor's error changes by from sample to sample.
    """
    if acceleration is None and sensor_error is None:
        return NO_OBSERVER, None
    disturbed = np.zeros((time.size, 2))
    for column, (what, given) in enumerate((("acceleration", acceleration), ("sensor's error", sensor_error))):
        if given is not None:
            values = as_floats(given, f"the {what}")
            if values.shape != time.shape:
                raise InputError(f"time has {time.size} samples, the {what} {values.size}")
            disturbed[:, column] = values
    hidden = COARSE * float(np.sqrt(0.5 * np.mean(np.diff(disturbed[:, 1]) ** 2))) if time.size > 1 else 0.0
    return (DISTURBED, hidden / float(np.max(np.diff(time), initial=1e-9)), 0.0), disturbed


def simulate_voltage(
    plant: Plants,
    time: ArrayLike,
    voltage: ArrayLike,
    *,
    start: Sequence[float] = (0.0, 0.0),
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
    held = as_floats(voltage, "voltage")
    corrects, shaken = _shaking(acceleration, sensor_error, grid)
    settings = [*OPEN_LOOP, ANY_NUMBER, *known(before), *corrects, *NO_LAW]
    count = _substeps(substeps, plant, step)
    return run_one(plant, Inputs(grid, held, held, shaken), settings, begun(start), count)


def simulate_continuous(
    plant: Plants,
    kp: float,
    kd: float,
    time: ArrayLike,
    reference: ArrayLike,
    *,
    start: Sequence[float] = (0.0, 0.0),
    reference_before: float | None = None,
    substeps: int | None = None,
) -> Simulation:
    """Simulate the ideal continuous PD ``V = kp (r − y) − kd ẏ`` (paper eq. 15), the reference held between samples.

    Fed back are the position as the sensor shows it and the true velocity of the load. Before the first instant the
    reference was `reference_before` [m or rad]; None is the first one.

    Raises
    ------
    InputError
        If the plant has a delay.
    """
    plant = as_plant(plant)
    grid = as_grid(time)
    step = float(np.max(np.diff(grid), initial=1e-9))
    held = as_floats(reference, "reference")
    if plant.delay > 0.0:
        raise InputError("the ideal continuous loop cannot hold a delay; simulate the sampled loop instead")
    kp, kd = number_within(kp, -inf, inf, "kp"), number_within(kd, -inf, inf, "kd")
    count = _substeps(substeps, plant, step, float(np.sqrt(abs(plant.gain * kp)) + abs(plant.gain * kd)))
    settings = [*OPEN_LOOP, ANY_NUMBER, *known(reference_before, "reference_before"), *NO_OBSERVER, *NO_LAW]
    result = run_one(plant, Inputs(grid, held, held), settings, begun(start), count, (kp, kd))
    voltage = ideal_pd(kp, kd, held, result.measured, result.velocity)
    return Simulation(
        time=grid, position=result.position, velocity=result.velocity, voltage=voltage, measured=result.measured
    )


def _given(part: Part | None) -> Part:
    assert part is not None  # noqa: S101 - the caller checked
    return part
