"""Simulations of plants that are only tried: without rounding, given up where they rattle, several in one call."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.effects import Sensor, Transmission
from servolens.errors import InputError
from servolens.simulation.grids import sample_time_of
from servolens.simulation.rates import pieces_for
from servolens.simulation.runs import Inputs, run_all, run_one
from servolens.simulation.settings import DISTURBED, NO_LAW, NO_OBSERVER, OPEN_LOOP, known, law_settings, loop_settings

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.controller import Controller
    from servolens.effects import Effect
    from servolens.plant import Plant
    from servolens.simulation.runs import Simulation

__all__ = ["Accuracy", "Trial", "closed_trial", "observed_trial"]

PATIENCE, ONE_OF = 5.0, 4
"""Pieces into which a substep of a trial may be split on average, held to be one of a few of its sample at least, for a
fast lag splits each sample."""
AT_ONCE = 200_000
"""Samples of the simulations of one call, about: their positions, velocities and voltages stay in memory meanwhile."""
OBSERVED = 1.0
"""What the rule is told where a measurement corrects the axis; see :mod:`.digital`."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Samples under which plants are tried, and what the rule is told of each.

    Attributes
    ----------
    inputs : Inputs
        The samples.
    settings : callable
        Of a plant and the number of substeps: what :mod:`servolens.simulation.digital` names.
    """

    inputs: Inputs
    settings: Callable[[Plant, int], Sequence[float]]

    def simulated(self, plant: Plant, start: Sequence[float], substeps: int) -> Simulation:
        """Return what `plant` does from the initial state `start`, see :func:`servolens.simulation.simulate_loop`.

        Raises
        ------
        InputError
            If the samples do not fit together.
        NumericalError
            If it diverges, or dry friction and contacts split its steps into more pieces than are granted.
        """
        return run_one(plant, self.inputs, self.settings(plant, substeps), start, substeps)

    def measured(
        self, plants: Sequence[Plant], starts: Sequence[Sequence[float]], substeps: int
    ) -> NDArray[np.float64]:
        """Return the measured positions of `plants`, shape (k, n); NaN where `simulated` raises a NumericalError."""
        samples = self.inputs.time.size
        found = np.empty((len(plants), samples))
        at_once = max(AT_ONCE // samples, 1)
        for structure in dict.fromkeys(plant.structure for plant in plants):
            alike = [k for k, plant in enumerate(plants) if plant.structure == structure]
            for rows in (alike[first : first + at_once] for first in range(0, len(alike), at_once)):
                settings = [self.settings(plants[k], substeps) for k in rows]
                those, begun = [plants[k] for k in rows], [starts[k] for k in rows]
                results, done = run_all(those, self.inputs, settings, begun, substeps)
                found[rows] = np.where((done == samples)[:, None], results[:, 3], np.nan)
        return found


class Accuracy(NamedTuple):
    """How far a trial is followed.

    Attributes
    ----------
    patience : float
        Pieces into which a substep may be split on average.
    coarse : float
        Speed [m/s or rad/s] by which a step may be wrong beyond what other simulations allow.
    """

    patience: float = PATIENCE
    coarse: float = 0.0


USUAL = Accuracy()


def closed_trial(
    controller: Controller,
    time: NDArray[np.float64],
    reference: NDArray[np.float64],
    *,
    feedforward: NDArray[np.float64] | None = None,
    before: float | None = None,
    limit: float | None = None,
    sensor_error: NDArray[np.float64] | None = None,
    accuracy: Accuracy = USUAL,
) -> Trial:
    """Return the trial of plants in a digital loop.

    Parameters
    ----------
    controller, time, reference, feedforward, before, limit, sensor_error
        As of :func:`servolens.simulation.simulate_loop`.
    accuracy : Accuracy
        How far it is followed.
    """
    period = sample_time_of(time)
    loop = loop_settings(controller, period)
    kind, disturbed = NO_OBSERVER[0], None
    if sensor_error is not None:
        kind, disturbed = DISTURBED, np.column_stack([np.zeros(time.size), sensor_error])

    def settings(plant: Plant, substeps: int) -> list[float]:
        granted = accuracy.patience * time.size * max(pieces_for(plant, period, substeps), ONE_OF)
        law = law_settings(plant, controller, limit)
        return [1.0, *loop, 0.0, granted, *known(before), kind, accuracy.coarse, 0.0, *law]

    added = np.zeros(time.size) if feedforward is None else feedforward
    return Trial(Inputs(time, added, reference, disturbed), settings)


def observed_trial(
    time: NDArray[np.float64],
    voltage: NDArray[np.float64],
    position: NDArray[np.float64],
    *,
    gains: NDArray[np.float64] | None,
    remembered: float = 0.0,
    before: float | None = None,
    coarse: float = 0.0,
) -> Trial:
    """Return the trial of plants that predict each sample of `position` from those before it, under a held `voltage`.

    After each sample the axis is moved towards what was measured, by the `gains` times the difference; and so is an
    acceleration that shakes it until the next. Without gains it is a simulation. What is measured are the predictions.

    Parameters
    ----------
    time, voltage, before
        As of :func:`servolens.simulation.simulate_voltage`.
    position : ndarray, shape (n,)
        As measured [m or rad].
    gains : ndarray, shape (n, 3), or None
        Of position [1], velocity [1/s] and shaking [1/s²] at each sample; a load and a filtered sensor are moved along.
    remembered : float
        Share of the shaking that is left a sample later.
    coarse : float
        Speed [m/s or rad/s] by which a step may be wrong beyond what other simulations allow.

    Raises
    ------
    InputError
        If the gains do not fit the samples.
    """
    if gains is not None and gains.shape != (time.size, 3):
        raise InputError(f"gains must have the shape ({time.size}, 3), got {gains.shape}")
    observer, period = (0.0 if gains is None else OBSERVED, coarse, remembered), sample_time_of(time)

    def settings(plant: Plant, substeps: int) -> list[float]:
        granted = PATIENCE * time.size * max(pieces_for(plant, period, substeps), ONE_OF)
        return [*OPEN_LOOP, granted, *known(before), *observer, *NO_LAW, *_moved(plant.structure)]

    return Trial(Inputs(time, voltage, position, gains), settings)


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
