"""Many plants through many records, on all processors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.errors import ServolensError, one_of, whole_number
from servolens.inputs import as_plant, as_record, listed
from servolens.processors import in_parallel
from servolens.simulation.loop import MOST_ASKED, simulate

if TYPE_CHECKING:
    from servolens.inputs import Plants, Records
    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.simulation.loop import Simulation

__all__ = ["simulate_many"]


def simulate_many(
    plants: Plants,
    records: Records,
    *,
    voltage_driven: bool | None = None,
    substeps: int | None = None,
    workers: int | None = None,
) -> tuple[tuple[Simulation | ServolensError, ...], ...]:
    """Simulate each of `plants` through what was done in each of `records`, as :func:`simulate` does.

    The compiled simulation leaves Python free, so threads share the work. Each answer is bit for bit that of
    :func:`simulate`, whatever the number of threads.

    Parameters
    ----------
    plants : Plant, model, fit, diagnosis, path of a model's file, or an iterable of these
        Thousands of parameter sets, as a Monte Carlo study has them; new combinations of effects are compiled first.
    records : Record, or an iterable of these
        Give time, reference, feedforward, controller, encoder and voltage limit.
    voltage_driven, substeps
        See :func:`simulate`.
    workers : int, optional
        Threads; None takes one for each processor.

    Returns
    -------
    tuple of tuple of Simulation or ServolensError
        One tuple a plant, in order, with one answer a record. Where a simulation fails, as of a loop that is unstable,
        its error stands there instead of being raised.

    Examples
    --------
    >>> import numpy as np
    >>> from servolens import Controller, Plant, Record
    >>> time = np.arange(100) * 1e-3
    >>> step = Record(time=time, position=0 * time, reference=0 * time + 0.1, controller=Controller(kp=60.0))
    >>> runs = simulate_many([Plant(gain=g, damping=6.0) for g in (1.8, 2.0)], [step])
    >>> [len(run.position) for (run,) in runs]
    [100, 100]
    """
    one_of(voltage_driven, (None, True, False), "voltage_driven")
    substeps = None if substeps is None else whole_number(substeps, 1, "substeps", MOST_ASKED)
    threads = None if workers is None else whole_number(workers, 1, "workers")
    given = tuple(as_record(record) for record in listed(records))

    def runs(plant: Plant) -> tuple[Simulation | ServolensError, ...]:
        return tuple(_run(plant, record, voltage_driven, substeps) for record in given)

    return tuple(in_parallel(runs, [as_plant(plant) for plant in listed(plants)], threads))


def _run(
    plant: Plant, record: Record, voltage_driven: bool | None, substeps: int | None
) -> Simulation | ServolensError:
    try:
        return simulate(plant, record, voltage_driven=voltage_driven, substeps=substeps)
    except ServolensError as error:
        return error
