"""Input conversion: what public functions are given becomes records, models, plants and effects, once."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence, Set, ValuesView
from itertools import groupby
from typing import TYPE_CHECKING, Any, TypedDict

from servolens.campaign import read_records
from servolens.control_law import with_seen_time_step
from servolens.effects import Effect, check_effect, effect_class
from servolens.encoder import with_seen_encoder
from servolens.errors import InputError, described, names_like
from servolens.even_times import with_even_times
from servolens.jump_times import with_timed_jumps
from servolens.model import Model, read_model
from servolens.plant import Plant
from servolens.reading import KEYS, record_from_dataframe, record_from_timeresponse
from servolens.reading.settings import as_settings
from servolens.record import Record

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "ARGUMENTS",
    "Effects",
    "Plants",
    "RecordSettings",
    "Records",
    "as_effects",
    "as_groups",
    "as_it_ran",
    "as_model",
    "as_models",
    "as_plant",
    "as_record",
    "as_records",
    "check_units",
    "is_model",
    "listed",
]

Records = Any
"""Record, path, pandas.DataFrame, control.TimeResponseData, or a sequence of these."""
Plants = Any
"""Plant, Model, path of a model's file, or anything with a `model` or `plant`: fit, identification, diagnosis."""
Effects = Any
"""Effect, its class or its name, or a sequence of these."""

ARGUMENTS = (
    "acceleration",
    "begin",
    "bounds",
    "certify",
    "compared",
    "delta",
    "driven",
    "effort",
    "fixed",
    "force",
    "heldout",
    "initial_place",
    "initial_velocity",
    "local",
    "loss",
    "model",
    "piece",
    "priors",
    "progress",
    "references",
    "sensor_error",
    "spec",
    "substeps",
    "voltage_driven",
    "with_program",
)
"""Keywords of public functions beside the settings of records: one of them may be meant by a misspelt keyword."""


class RecordSettings(TypedDict, total=False):
    """Settings of records that are keywords where records are given: numbers in SI, or texts with a unit."""

    name: str
    kp: float | str
    kd: float | str
    ki: float | str
    kv: float | str
    kiv: float | str
    controller: str
    anti_windup: str
    tracking_time: float | str
    integral_before: float | str
    setpoint_weight: float | str
    feedforward_speed: float | str
    velocity_feedforward: float | str
    derivative: str
    derivative_on: str
    derivative_filter: float | str
    derivative_window: float | str
    control_period: float | str
    time_step: str
    sample_time: float | str
    reference: str
    reference_file: str
    encoder_resolution: float | str
    counts_per_unit: float | str
    counts_per_rev: float | str
    voltage_limit: float | str
    voltage_before: float | str
    current_limit: float | str
    supply_voltage: float | str
    pwm_full_scale: float | str
    inertia: float | str
    mass: float | str


def as_records(
    source: Records, settings: RecordSettings | Mapping[str, Any] | None = None, *, least: int = 1
) -> tuple[Record, ...]:
    """Return the records of one axis that `source` is or holds.

    Parameters
    ----------
    source : Record, path, pandas.DataFrame, control.TimeResponseData, or a sequence of these
        A path is that of a file, a folder, or a campaign TOML.
    settings : mapping, optional
        ``kp``, ``kd`` … (:class:`RecordSettings`) of tables and files; a record has its own.
    least : int
        How many records there must be.

    Returns
    -------
    tuple of Record
        In the order given, all in the same units, at even times where only their stamps are uneven, with the encoder's
        step that they show where none states one, with the integral with which their loop began, and with the times at
        which the reference jumped where the loop ran faster than the log.

    Raises
    ------
    InputError
        If `source` is none of these, is empty, or mixes units; if a setting is unknown or meant for a record.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"time": [0, 0.001, 0.002], "position": [0, 0, 1e-6], "reference": [0.1] * 3})
    >>> [record.controller.kp for record in as_records([table, table], {"kp": 60})]
    [60.0, 60.0]
    """
    given = listed(source)
    known = _settings(settings)
    found: list[Record] = []
    for is_path, some in groupby(given, key=lambda one: isinstance(one, str | os.PathLike)):
        if is_path:
            found += read_records(tuple(some), settings=known)
        else:
            found += [_record(one, known, len(given) > 1, len(found) + i) for i, one in enumerate(some, 1)]
    if len(found) < least:
        raise InputError("no record was given; at least one is needed")
    _check_units(found)
    return with_timed_jumps(with_seen_encoder([*map(as_it_ran, found)]))


def as_it_ran(record: Record) -> Record:
    """Return `record` at even times where only its stamps are uneven, with what its voltage shows of its loop.

    That is whether it divided by times that it measured, and the integral with which it began.
    """
    return with_seen_time_step(with_even_times(record))


def _check_units(records: Sequence[Record]) -> None:
    for unit in ("length_unit", "command_unit"):
        kinds = sorted({getattr(record, unit) for record in records})
        if len(kinds) > 1:
            raise InputError(f"records in {' and '.join(kinds)} cannot be used together; convert one of them")


def as_record(source: Records, settings: RecordSettings | Mapping[str, Any] | None = None) -> Record:
    """Return the one record that `source` is or holds; see :func:`as_records`."""
    if isinstance(source, Record) and not settings:
        return source
    found = as_records(source, settings)
    if len(found) > 1:
        raise InputError(f"one record is needed, got {len(found)}; give them one after the other")
    return found[0]


def as_groups(
    records: Records, heldout: Records, settings: RecordSettings | Mapping[str, Any] | None = None
) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    """Return the records to be fitted, and those held out, of which there may be none; see :func:`as_records`."""
    train, tests = as_records(records, settings), as_records(heldout, settings, least=0)
    _check_units((*train, *tests))  # of one axis, too
    return train, with_seen_encoder(tests, train)


def as_model(source: Plants) -> Model:
    """Return the model that `source` is, holds, or is the file of; a bare plant becomes one without covariance.

    Parameters
    ----------
    source : Plant, Model, fit, identification, diagnosis, or path
        A path is that of a file that ``servolens identify --out`` or ``diagnose --out`` wrote.

    Raises
    ------
    InputError
        If it is none of these, or a file cannot be read.
    """
    if isinstance(source, Model):
        return source
    if isinstance(source, Plant):
        return Model(plant=source)
    if isinstance(source, str | os.PathLike):
        return read_model(source)
    if _holds_model(source):
        return as_model(source.model if isinstance(getattr(source, "model", None), Model) else source.plant)
    raise InputError(f"a Plant, a model, a fit, a diagnosis, or a model file's path is needed; got {described(source)}")


def as_plant(source: Plants) -> Plant:
    """Return the plant of what :func:`as_model` takes."""
    return source if isinstance(source, Plant) else as_model(source).plant


def as_models(source: Plants) -> tuple[Model, ...]:
    """Return the models of one axis, or several; see :func:`as_model`."""
    models = tuple(as_model(one) for one in listed(source))
    if not models:
        raise InputError("no model was given; at least one is needed")
    return models


def is_model(source: object) -> bool:
    """Tell whether :func:`as_model` takes `source`; a path that ends in ``.json`` is a model's, others are records'."""
    if isinstance(source, str | os.PathLike):
        return os.fspath(source).lower().endswith(".json")
    return isinstance(source, Model | Plant) or _holds_model(source)


def check_units(plant: Plant, record: Record) -> None:
    """Refuse a record in other units than the plant's.

    Raises
    ------
    InputError
        With both units.
    """
    for kind, what in (("length_unit", "positions"), ("command_unit", "commands")):
        ours, theirs = getattr(plant, kind), getattr(record, kind)
        if ours != theirs:
            whose = record.source or record.name
            raise InputError(f"{whose} has {what} in {theirs}, the model in {ours}; use records in the model's units")


def as_effects(source: Effects) -> tuple[Effect | type[Effect], ...]:
    """Return effects as they were given, names as the classes that they stand for.

    Parameters
    ----------
    source : Effect, its class or its name, or a sequence of these
        E.g. ``"coulomb_friction"``, ``CoulombFriction``, ``[CoulombFriction(level=1.0), "delay"]``.

    Raises
    ------
    InputError
        If one is no effect, or a name is unknown.
    """
    return tuple(_effect(one) for one in listed(source))


def listed(source: Any) -> tuple[Any, ...]:
    """Return what `source` holds if it is a list, tuple, set, iterator or a mapping's values; else `source` alone."""
    if isinstance(source, Sequence | Iterator | Set | ValuesView) and not isinstance(source, str | bytes):
        return tuple(source)
    return (source,)


def _holds_model(source: object) -> bool:
    """Tell whether a result of ours is given; a table may have columns of these names."""
    if isinstance(source, type) or hasattr(source, "columns"):
        return False
    return any(isinstance(getattr(source, name, None), Model | Plant) for name in ("model", "plant"))


def _settings(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the settings with NumPy's numbers as Python's, without those that are None."""
    settings = as_settings(given)
    for key in settings:
        if key not in KEYS:
            offer = names_like(key, (*KEYS, *(name for name in ARGUMENTS if name != key)), "")
            offer = offer if offer.endswith("?") else f"settings are {', '.join(KEYS)}"
            raise InputError(f"{key[:40]!r} is no argument and no setting of a record; {offer}")
    return {key: value for key, value in settings.items() if value is not None}


def _record(source: Any, settings: dict[str, Any], is_one_of_several: bool, number: int) -> Record:
    if isinstance(source, Record):
        if settings:
            key = next(iter(settings))
            raise InputError(
                f"{key} is for tables and files; {source.name} is a Record: set it with "
                "record.with_({'controller': Controller(kp=…, kd=…)}) or record.with_({…})"
            )
        return source
    if hasattr(source, "columns") and hasattr(source, "index"):
        made = record_from_dataframe(source, settings=settings)
    elif all(hasattr(source, part) for part in ("time", "outputs", "inputs")):
        made = record_from_timeresponse(source, settings=settings)
    else:
        raise InputError(
            "a Record, a file's path, a DataFrame, a TimeResponseData, or a list of these is needed; "
            f"got {described(source)}"
        )
    is_unnamed = is_one_of_several and "name" not in settings
    return made.with_({"name": f"{made.name} {number}"}) if is_unnamed else made


def _effect(source: Any) -> Effect | type[Effect]:
    found: Any = effect_class(source) if isinstance(source, str) else source
    cls = found if isinstance(found, type) else type(found)
    if not issubclass(cls, Effect):
        raise InputError(
            f"an effect, its class or its name is needed, such as 'coulomb_friction'; got {described(source)}"
        )
    check_effect(cls)
    effect: Effect | type[Effect] = found
    return effect
