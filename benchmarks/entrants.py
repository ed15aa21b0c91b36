"""Entrants of the challenge: each reads a case's records and answers effects with their parameters.

Beside servolens, two that an engineer could put together in an afternoon: greedy sparse regression, as PySINDy does it,
and plain forward selection by BIC with SciPy's least squares on simulations.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from servolens import diagnose, simulate
from servolens.effects import CATALOGUE, Seen
from servolens.errors import ServolensError
from servolens.identification.regressors import regressor
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.record import Record

    Answer = dict[str, dict[str, float]]

__all__ = ["ENTRANTS"]

WINDOW, ORDER = 41, 3
"""Samples and order of the polynomial that velocity and acceleration are read off."""
PROPOSALS = 6
"""Values of an effect's shape that the sparse regression has columns of."""
THRESHOLDS = (0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3)
"""Shares of the acceleration below which a column is dropped; the held-out records choose."""
CALLS = 20
"""Of the simulation for each least-squares fit at most, differences apart."""
MOST = 2
"""Effects that plain BIC adds at most."""
LITTLE = 0.03
"""Share of the values that an effect proposes from which its fit begins once more."""
LOST = 1e3
"""Travels that a simulation which fails is off by."""


def servolens(records: Sequence[Record], heldout: Sequence[Record]) -> Answer:
    """`diagnose`."""
    found = diagnose(records, heldout=heldout)
    return {cause.effect: {name: q.value for name, q in cause.quantities.items()} for cause in found.causes}


def sparse_regression(records: Sequence[Record], heldout: Sequence[Record]) -> Answer:
    """Regress the acceleration on the columns of forces, dropping small ones in turn (PySINDy's STLSQ).

    It knows the effects that are forces; limits, lags and lost motion give no column.
    """
    from pysindy import STLSQ

    named = _columns(_seen(records))
    train, target = _regression(records, named)
    other, judged = _regression(heldout, named)
    size = np.linalg.norm(train, axis=0)
    kept = size > 0.0
    scale, unit = size[kept], float(np.linalg.norm(target))
    best: tuple[float, NDArray[np.float64]] = (math.inf, np.zeros(kept.sum()))
    for threshold in THRESHOLDS:
        model = STLSQ(threshold=threshold, max_iter=50).fit(train[:, kept] / scale, target[:, None] / unit)
        found = np.ravel(model.coef_)
        error = float(np.mean((other[:, kept] / scale @ found * unit - judged) ** 2))
        if error < best[0]:
            best = error, found
    values = np.zeros(size.size)
    values[kept] = best[1] * unit / scale
    return _as_answer(named, values[2:])


def plain_bic(records: Sequence[Record], heldout: Sequence[Record]) -> Answer:
    """Add the effect that lowers BIC most until none does; the residual counts as white."""
    records = [record.with_({"encoder_resolution": None}) for record in records]  # rounding leaves nothing smooth
    samples = sum(len(record) for record in records)
    train, target = _regression(records, [])
    gain, damping = np.linalg.lstsq(train, target, rcond=None)[0]
    plant, criterion = _fitted(Plant(gain=gain, damping=max(damping, 0.0), **_units(records)), records, samples)
    for _ in range(MOST):
        seen, others = replace(_seen(records), gain=plant.gain, damping=plant.damping), plant.structure
        left = [effect for effect in CATALOGUE.values() if not (effect in others or effect.is_last_resort)]
        begun = [start for effect in left for start in _starts(effect, seen)]
        better, least = min((_tried(plant, start, records, samples) for start in begun), key=lambda trial: trial[1])
        if least >= criterion:
            break
        plant, criterion = better, least
    return {effect.name: {name: getattr(effect, name) for name in _names(type(effect))} for effect in plant.effects}


ENTRANTS = {"servolens": servolens, "sparse regression": sparse_regression, "plain BIC": plain_bic}


def _names(effect: type[Effect]) -> list[str]:
    return [spec.name for spec in effect.parameters() if spec.usual is None]


def _units(records: Sequence[Record]) -> dict[str, Any]:
    return {"length_unit": records[0].length_unit, "command_unit": records[0].command_unit}


def _seen(records: Sequence[Record]) -> Seen:
    """Return what the records show, for effects to propose where to start."""
    position = np.concatenate([record.position for record in records])
    low, high = np.quantile(position, (0.05, 0.95))
    rough = np.concatenate([np.diff(record.position, 2) for record in records])
    return Seen(
        low=float(position.min()),
        high=float(position.max()),
        usual=(float(low), float(high)),
        speed=max(float(np.abs(_smooth(record, 1)).max()) for record in records),
        command=max(float(np.abs(record.voltage).max()) for record in records),
        gain=1.0,
        damping=1.0,
        sample_time=records[0].sample_time,
        duration=max(record.duration for record in records),
        noise=float(np.median(np.abs(rough)) / 0.6745 / math.sqrt(6.0)),
    )


def _smooth(record: Record, derivative: int) -> NDArray[np.float64]:
    return savgol_filter(record.position, WINDOW, ORDER, deriv=derivative, delta=record.sample_time)


def _columns(seen: Seen) -> list[Effect]:
    """Return the forces of the catalogue, each at a few values of its shape; none that others make up exactly."""
    found = []
    for effect in CATALOGUE.values():
        if regressor(effect).sizes and not (effect.unites or effect.is_last_resort):
            found += list(islice(effect.starts(seen), PROPOSALS if regressor(effect).shapes else 1))
    return found


def _regression(
    records: Sequence[Record], effects: Sequence[Effect]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return columns (command, −velocity, − each force per unit of its sizes) and the acceleration of all records."""
    blocks, targets = [], []
    for record in records:
        position, velocity, acceleration = (_smooth(record, k) for k in range(3))
        forces = []
        for effect in effects:
            own = regressor(type(effect))
            shapes = [getattr(effect, name) for name in own.shapes]
            forces += list(-own.columns(record.time, position, velocity, *shapes))
        command = savgol_filter(record.voltage, WINDOW, ORDER)
        blocks.append(np.column_stack([command, -velocity, *forces]))
        targets.append(acceleration)
    return np.concatenate(blocks), np.concatenate(targets)


def _as_answer(effects: Sequence[Effect], values: NDArray[np.float64]) -> Answer:
    """Return the effects with a column that was kept; of several shapes, that with the largest coefficients."""
    answer: Answer = {}
    largest: dict[str, float] = {}
    left = iter(values.tolist())
    for effect in effects:
        own = regressor(type(effect))
        sizes = dict(zip(own.sizes, islice(left, len(own.sizes)), strict=True))
        size = max(map(abs, sizes.values()))
        if size > largest.get(effect.name, 0.0):
            largest[effect.name] = size
            answer[effect.name] = {**{name: getattr(effect, name) for name in own.shapes}, **sizes}
    return answer


def _starts(effect: type[Effect], seen: Seen) -> list[Effect]:
    """Return the first values that an effect proposes, and hardly any of it."""
    first = next(iter(effect.starts(seen)))
    little = {name: LITTLE * getattr(first, name) for name, value in effect.absent_at.items() if value == 0.0}
    return [first, replace(first, **little)] if little else [first]


def _tried(plant: Plant, effect: Effect, records: Sequence[Record], samples: int) -> tuple[Plant, float]:
    """Return the plant with one more effect, fitted, and its BIC."""
    try:
        return _fitted(replace(plant, effects=(*plant.effects, effect)), records, samples)
    except ServolensError:
        return plant, math.inf


def _fitted(plant: Plant, records: Sequence[Record], samples: int) -> tuple[Plant, float]:
    """Return the plant whose simulations miss the records least, and its BIC."""
    specs = {name: spec for name, spec in plant.parameters.items() if name not in plant.usual}
    low, high = np.array([[spec.low, spec.high] for spec in specs.values()]).T
    start = np.clip([plant.named[name] for name in specs], low + 1e-12, high)
    travel = max(float(np.ptp(record.position)) for record in records)

    def valued(values: NDArray[np.float64]) -> Plant:
        return plant.with_named(dict(zip(specs, values.tolist(), strict=True)))

    def missed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            trial = valued(values)
            return np.concatenate([simulate(trial, record).position - record.position for record in records])
        except ServolensError:
            return np.full(samples, LOST * travel)

    found = least_squares(missed, start, bounds=(low, high), x_scale="jac", diff_step=1e-4, max_nfev=CALLS)
    squares = max(2.0 * float(found.cost), 1e-300)
    criterion = samples * math.log(squares / samples) + start.size * math.log(samples)
    return valued(found.x), criterion
