"""How far simulated responses are from measured ones: the paper's Table I for any models and records."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.effects import Sensor
from servolens.quality.beginning import initial_motion
from servolens.simulation import simulate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Prediction", "RecordError", "predict", "prediction_error", "prediction_residual", "record_error"]

WINDOW = 5.0
"""Time constants of the axis that a window of a simulation without a reference lasts."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RecordError:
    """The error of one model on one record.

    Attributes
    ----------
    name : str
        Of the record.
    mean_abs_error, rms_error : float
        [m or rad].
    percent_error : float
        The paper's: 100 · mean |y_model − y| / step size.
    fit_percent : float
        NRMSE fit, 100 (1 − ‖y − ŷ‖/‖y − mean y‖).
    """

    name: str
    mean_abs_error: float
    rms_error: float
    percent_error: float
    fit_percent: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields; ``null`` for a percentage of nothing."""
        return {name: _finite(getattr(self, name)) for name in self.__slots__}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Errors of several models on several records.

    Attributes
    ----------
    models : tuple of str
        Names, in the table's order of columns.
    errors : tuple of tuple of RecordError
        ``errors[i][j]``: record i, model j.
    """

    models: tuple[str, ...]
    errors: tuple[tuple[RecordError, ...], ...]

    @property
    def average_percent(self) -> tuple[float, ...]:
        """Mean percent error of each model over the records: Table I's last row."""
        return tuple(float(np.mean([row[j].percent_error for row in self.errors])) for j in range(len(self.models)))


def prediction_error(plant: Plant, record: Record) -> RecordError:
    """Simulate `record` and compare.

    Raises
    ------
    InputError, NumericalError
        As :func:`servolens.simulation.simulate`.
    """
    return record_error(record, prediction_residual(plant, record))


def record_error(record: Record, error: NDArray[np.float64]) -> RecordError:
    """Return the error of a model whose residual on `record` is `error`, shape (n,) [m or rad]."""
    spread = float(np.linalg.norm(record.position - record.position.mean()))
    mean = float(np.mean(np.abs(error)))
    step = record.step_size
    return RecordError(
        name=record.name,
        mean_abs_error=mean,
        rms_error=float(np.sqrt(np.mean(error**2))),
        percent_error=100.0 * mean / step if step > 0 else float("nan"),
        fit_percent=100.0 * (1.0 - float(np.linalg.norm(error)) / spread) if spread > 0 else float("nan"),
    )


def prediction_residual(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Return simulated minus measured position, shape (n,) [m or rad]: the one error that is reported anywhere.

    The loop is closed from the record's own reference with its stated controller; nothing but the initial state is
    read off the record. Without a reference the logged voltage drives the simulation, in windows of a few time
    constants, each from its own initial state: an error would grow for ever.

    Raises
    ------
    InputError, NumericalError
        As :func:`servolens.simulation.simulate`.
    """
    if record.reference is not None and record.controller is not None:
        return _difference(plant, record)
    lasts = max(WINDOW / max(plant.damping, 1e-9), 50 * record.sample_time)
    count = int(np.clip(np.ceil(record.duration / lasts), 1, max(len(record) // 50, 1)))
    edges = np.linspace(0, len(record), count + 1).astype(int)
    parts = [record.slice(float(record.time[a]), float(record.time[b - 1])) for a, b in pairwise(edges)]
    return np.concatenate([_difference(plant, part) for part in parts])


def _difference(plant: Plant, record: Record) -> NDArray[np.float64]:
    """Return what the simulation misses from the likelier beginning: at rest, or as fast as the first samples tell.

    A lagging axis that is pushed off at once looks as if it had been moving.
    """
    found = [_from(plant, record, velocity) for velocity in dict.fromkeys((0.0, initial_motion(record)))]
    return min(found, key=lambda missed: float(missed @ missed))


def _from(plant: Plant, record: Record, velocity: float) -> NDArray[np.float64]:
    simulation = simulate(plant, record, initial_velocity=velocity)
    shown = simulation.measured if any(isinstance(effect, Sensor) for effect in plant.effects) else simulation.position
    return np.asarray(shown - record.position)


def predict(models: Mapping[str, Plant], records: Sequence[Record]) -> Prediction:
    """Return the errors of every model on every record."""
    return Prediction(
        models=tuple(models),
        errors=tuple(tuple(prediction_error(plant, record) for plant in models.values()) for record in records),
    )


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
