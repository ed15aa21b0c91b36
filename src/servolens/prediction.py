"""How far simulated responses are from measured ones: the paper's Table I for any models and records."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict, Unpack, final

import numpy as np

from servolens.decoding import read_fields
from servolens.errors import InputError, NumericalError
from servolens.inputs import as_model, as_records, check_units, listed
from servolens.quality.beginning import initial_motion, possible_motion
from servolens.quality.spikes import without_spikes
from servolens.result import Result, late
from servolens.simulation import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from numpy.typing import NDArray

    from servolens.inputs import Plants, Records, RecordSettings
    from servolens.model import Model
    from servolens.plant import Plant
    from servolens.record import Record
    from servolens.simulation.loop import Simulation

__all__ = [
    "Prediction",
    "RecordError",
    "beginning",
    "from_beginning",
    "predict",
    "prediction_error",
    "prediction_residual",
    "record_error",
]

WINDOW_TIME_CONSTANTS = 5.0
"""Time constants of the axis that a window of a simulation without a reference lasts."""
FIRST_CHANGE, MOST_SECANTS = 0.1, 3
"""Share by which an initial velocity is changed at first to see what that does, and how often it is."""
HIDDEN = 0.5
"""Share of the squared error of a simulation from rest that one from a motion may leave which the first samples do not
show by themselves."""


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

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> RecordError:
        """Build the errors from what :meth:`to_json` returned; a number that is null was not finite."""
        return read_fields(cls, data)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Prediction(Result):
    """What several models make of several records, and how far they are off.

    Attributes
    ----------
    models : tuple of str
        Names, in the table's order of columns.
    errors : tuple of tuple of RecordError
        ``errors[i][j]``: record i, model j.
    records : tuple of Record
        What was simulated, without single samples of the position that stick out; none where the errors were read from
        a file.
    plants : tuple of Plant
        Of the models.
    positions : tuple of tuple of ndarray, shape (n,)
        ``positions[i][j]``: simulated at the samples of record i by model j [m or rad].
    identified_from : tuple of str
        Names of the records that the models were identified from; all others are held out. Empty where that is not
        known, as of a bare plant.
    """

    kind: ClassVar[str] = "prediction"

    models: tuple[str, ...]
    errors: tuple[tuple[RecordError, ...], ...]
    records: tuple[Record, ...] = ()
    plants: tuple[Plant, ...] = ()
    positions: tuple[tuple[NDArray[np.float64], ...], ...] = ()
    identified_from: tuple[str, ...] = ()

    @property
    def plant(self) -> Plant:
        """The plant of the first model."""
        if not self.plants:
            raise InputError("this prediction was read from a file, which holds no plants; predict again")
        return self.plants[0]

    def is_held_out(self, record: str) -> bool | None:
        """Tell whether no model was identified from the `record` of this name; None where that is not known."""
        return record not in self.identified_from if self.identified_from else None

    @property
    def average_percent(self) -> tuple[float, ...]:
        """Mean percent error of each model over the records: Table I's last row."""
        return tuple(float(np.mean([row[j].percent_error for row in self.errors])) for j in range(len(self.models)))

    def residuals(self, records: Records = None, **settings: Unpack[RecordSettings]) -> tuple[NDArray[np.float64], ...]:
        """Return simulated minus measured position of the first model [m or rad], an array for each of the records."""
        if records is not None:
            return predict(self, records, **settings).residuals()
        if not self.records:
            raise InputError("this prediction was read from a file, which holds no records; pass them")
        return tuple(row[0] - record.position for record, row in zip(self.records, self.positions, strict=True))

    def trajectories(self) -> pd.DataFrame:
        """Return measured and simulated positions; see :func:`servolens.summaries.frames.trajectories`."""
        frame: pd.DataFrame = late("summaries.frames", "trajectories")(self)
        return frame

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.prediction/1``: the first model's errors, then all by name."""
        rows = [
            {
                **row[0].to_json(),
                "held_out": self.is_held_out(row[0].name),
                "by_model": {m: e.to_json() for m, e in zip(self.models, row, strict=True)},
            }
            for row in self.errors
        ]
        return {"models": list(self.models), "records": rows, "identified_from": list(self.identified_from)}

    @classmethod
    def _read(cls, data: Mapping[str, Any]) -> Prediction:
        models = tuple(data.get("models") or ("the model",))
        rows = [row.get("by_model") or {models[0]: row} for row in data.get("records", ())]
        return cls(
            models=models,
            errors=tuple(tuple(RecordError.from_json(row[m]) for m in models) for row in rows),
            identified_from=tuple(str(name) for name in data.get("identified_from", ())),
        )


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
    if record.has_loop:
        return _difference(plant, record)
    from scipy.signal import savgol_filter

    lasts = max(WINDOW_TIME_CONSTANTS / max(plant.damping, 1e-9), 50 * record.sample_time)
    count = int(np.clip(np.ceil(record.duration / lasts), 1, max(len(record) // 50, 1)))
    edges = np.linspace(0, len(record), count + 1).astype(int)
    if count == 1:
        return _difference(plant, record)
    parts = [record.slice(float(record.time[a]), float(record.time[b - 1])) for a, b in pairwise(edges)]
    quarter = 0.25 * lasts / WINDOW_TIME_CONSTANTS  # of the axis's time constant, on both sides
    window = int(np.clip(2.0 * quarter / record.sample_time, 5, len(record) - 1)) // 2 * 2 + 1
    slope = savgol_filter(record.position, window, 3, deriv=1, delta=record.sample_time)
    speeds = [None, *slope[edges[1:-1]].tolist()]
    return np.concatenate([_difference(plant, part, speed) for part, speed in zip(parts, speeds, strict=True)])


class Disturbed(TypedDict, total=False):
    """Of :func:`servolens.simulation.simulate`: what shakes the axis, errors of the sensor, and what drives."""

    acceleration: NDArray[np.float64]
    sensor_error: NDArray[np.float64]
    voltage_driven: bool


@final
@dataclass(frozen=True, slots=True, eq=False)
class Beginning:
    """How the simulation of a record begins.

    Attributes
    ----------
    record : Record
        With what was applied before it.
    velocity : float
        At the first sample [m/s or rad/s].
    place : float
        Of the motor within the gap of a backlash, from -1 to 1, its ends.
    """

    record: Record
    velocity: float = 0.0
    place: float = 0.0

    def simulated(self, plant: Plant, record: Record | None = None, **disturbed: Unpack[Disturbed]) -> Simulation:
        """Return what `plant` does from it, in another `record` if one is given, and `disturbed` if by anything.

        Raises
        ------
        InputError, NumericalError
            As :func:`servolens.simulation.simulate`.
        """
        given = self.record if record is None else record
        return simulate(plant, given, initial_velocity=self.velocity, initial_place=self.place, **disturbed)

    def missed(self, plant: Plant) -> NDArray[np.float64]:
        """Return simulated minus measured position, shape (n,)."""
        return np.asarray(self.simulated(plant).shown(plant) - self.record.position)


def beginning(plant: Plant, record: Record) -> Beginning:
    """Return how a simulation of `record` begins.

    The likeliest of few: at rest, or, where the first samples show motion, as fast as explains the record best. A
    lagging axis that is pushed off at once looks as if it had been moving. Where a record does not say what was applied
    before it, that was its first voltage, or nothing. The motor of an axis with backlash is where in the gap it
    explains the record best.

    Raises
    ------
    InputError, NumericalError
        As :func:`servolens.simulation.simulate`.
    """
    return _begun(plant, record)[1]


def from_beginning(plant: Plant, record: Record) -> Simulation:
    """Simulate `record` from its likelier :func:`beginning`."""
    return beginning(plant, record).simulated(plant)


def _difference(plant: Plant, record: Record, speed: float | None = None) -> NDArray[np.float64]:
    """Return what the simulation misses; it may begin at a `speed` that the samples before tell as well."""
    return _begun(plant, record, speed)[0]


def _begun(plant: Plant, record: Record, speed: float | None = None) -> tuple[NDArray[np.float64], Beginning]:
    """Return what the simulation misses of a record, and how it begins."""
    is_open = record.voltage_before is None and plant.remembers_voltage
    alike = [record, replace(record, voltage_before=0.0)] if is_open else [record]
    told, (likely, off) = initial_motion(record), possible_motion(record)
    found = []
    for same in alike:
        still = _placed(plant, Beginning(same))
        found.append(still)
        if speed is not None:
            found.append(_placed(plant, Beginning(same, speed)))
        elif told:
            moving = _moving(plant, still[1], told, off)
            found.append(_placed(plant, moving[1]) if plant.play else moving)
        elif off and _may_move(plant, *still, off):
            found.append(_moving(plant, still[1], likely, off))
    missed, begun = min(found, key=_size)
    return _timed(plant, begun, missed)


def _placed(plant: Plant, begun: Beginning) -> tuple[NDArray[np.float64], Beginning]:
    """Return what the simulation misses that begins like this, its motor where in a gap it misses least, and how."""
    if not plant.play:
        return begun.missed(plant), begun
    places = [replace(begun, place=place) for place in (0.0, -1.0, 1.0)]
    return _refined(plant, *min(((one.missed(plant), one) for one in places), key=_size), "place", 1.0)


def _size(found: tuple[NDArray[np.float64], Beginning]) -> float:
    return float(found[0] @ found[0])


def _may_move(plant: Plant, missed: NDArray[np.float64], still: Beginning, change: float) -> bool:
    """Tell whether another initial velocity would leave far less of what is `missed` from rest."""
    slope = replace(still, velocity=change).missed(plant) - missed
    return float(slope @ missed) ** 2 > (1.0 - HIDDEN) * float(slope @ slope) * float(missed @ missed)


def _timed(plant: Plant, begun: Beginning, missed: NDArray[np.float64]) -> tuple[NDArray[np.float64], Beginning]:
    """Return what the simulation misses of a log slower than its loop, and its beginning, its jumps timed to the tick.

    They are known to about a tick before there is a plant.
    """
    record = begun.record
    for sample in record.jumps().tolist() if record.ticks > 1 else ():
        tick = record.sample_time / record.ticks
        for change in (tick, -tick):
            leads = np.zeros(len(record)) if record.jump_leads is None else record.jump_leads.copy()
            leads[sample] += change
            if not -0.5 * tick < leads[sample] < record.sample_time - 0.5 * tick:
                continue
            other = replace(begun, record=replace(record, jump_leads=leads))
            again = other.missed(plant)
            if again @ again < missed @ missed:
                missed, begun, record = again, other, other.record
    return missed, begun


def _moving(plant: Plant, still: Beginning, told: float, off: float) -> tuple[NDArray[np.float64], Beginning]:
    """Return what the simulation misses that begins about as fast as the first samples have `told`, and how."""
    begun = replace(still, velocity=told)
    return _refined(plant, begun.missed(plant), begun, "velocity", off)


def _refined(
    plant: Plant, missed: NDArray[np.float64], begun: Beginning, what: str, off: float
) -> tuple[NDArray[np.float64], Beginning]:
    """Return what the simulation misses that begins about as `begun`, from which so much is `missed`, and how it does.

    Its velocity, or the place within the gap, is found in least squares over the record, by secants: a velocity no
    further `off` than the first samples allow, for what the plant gets wrong is no reason to begin otherwise; a place
    within the gap.
    """
    told = getattr(begun, what)
    low, high = (told - off, told + off) if what == "velocity" else (-off, off)
    change = FIRST_CHANGE * max(abs(told), off)
    with suppress(NumericalError):
        for _ in range(MOST_SECANTS):
            here = getattr(begun, what)
            if what == "place":  # towards the middle, and so within the gap
                change = float(-np.copysign(min(abs(change), 1.0), here))
            slope = (replace(begun, **{what: here + change}).missed(plant) - missed) / change
            best = here - float(slope @ missed) / max(float(slope @ slope), 1e-300)
            other = replace(begun, **{what: min(max(best, low), high)})
            again = other.missed(plant)
            if not float(again @ again) < float(missed @ missed):
                break
            missed, begun, change = again, other, 0.5 * (getattr(other, what) - here)
    return missed, begun


def predict(
    models: Plants | Mapping[str, Plants] | Sequence[Plants], records: Records, **settings: Unpack[RecordSettings]
) -> Prediction:
    """Simulate every record with every model: trajectories and errors.

    Parameters
    ----------
    models : Plant, model, fit, diagnosis, path of a model's file, a sequence of these, or a mapping by name
        What predicts.
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Each record's reference is simulated with its own gains; one without them from its logged voltage. Fitted to it
        are the velocity at which it begins, if not at rest, and of a log slower than its loop the tick of each jump.
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

    Raises
    ------
    InputError
        If there is no model or record, or their units differ.
    NumericalError
        If a simulated axis leaves all bounds.

    Examples
    --------
    >>> from servolens import Plant, lab
    >>> found = predict(Plant(gain=1.8545, damping=6.152), lab.step_record(lab.LM1, kp=60))
    >>> found.errors[0][0].percent_error < 0.1, found.residuals()[0].shape == found.positions[0][0].shape
    (True, True)
    """
    known = _named(models)
    plants = {name: model.plant for name, model in known.items()}
    runs = tuple(map(without_spikes, as_records(records, settings)))
    for plant, record in product(plants.values(), runs):
        check_units(plant, record)
    missed = [[prediction_residual(plant, record) for plant in plants.values()] for record in runs]
    return Prediction(
        models=tuple(plants),
        errors=tuple(tuple(record_error(run, one) for one in row) for run, row in zip(runs, missed, strict=True)),
        records=runs,
        plants=tuple(plants.values()),
        positions=tuple(tuple(run.position + one for one in row) for run, row in zip(runs, missed, strict=True)),
        identified_from=tuple(dict.fromkeys(name for model in known.values() for name in model.identified_from)),
    )


def _named(models: Any) -> dict[str, Model]:
    """Return models by name."""
    if isinstance(models, Mapping):
        named = {str(name): as_model(model) for name, model in models.items()}
    else:
        given = listed(models)
        names = ["the model"] if len(given) == 1 else [f"model {i}" for i in range(1, len(given) + 1)]
        named = {name: as_model(model) for name, model in zip(names, given, strict=True)}
    if not named:
        raise InputError("no model was given; at least one is needed")
    return named


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
