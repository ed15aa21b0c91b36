"""Whether records can be of one axis: what each says by itself, as far as it can be believed."""

from __future__ import annotations

from itertools import combinations
from math import floor, log10
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.explained import excerpt_of
from servolens.identification.fitted import fitted
from servolens.identification.likelihood import Likelihood
from servolens.identification.options import FitOptions
from servolens.identification.score import FALSE_ALARM, ScoreTest
from servolens.identification.segments import motion_segments, moving_parts
from servolens.identification.starting import Screen
from servolens.identification.structure import depends_on_inputs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.identification.segments import Segment
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["apart", "contradiction"]

FAR_APART = 0.2
"""Relative difference of gains from which on two records are held to be of different axes."""


def contradiction(records: Sequence[Record]) -> Finding | None:
    """Return a finding if gain and damping explain records each by itself, but not with one gain.

    A record of which they leave anything that depends on the inputs is not asked: an effect then changes the gain by
    more than its error bar. So is none whose axis is shaken or whose noise hides what they miss. Where all records give
    about the same gain, which the integral equation tells at once, nothing more is asked.

    Parameters
    ----------
    records : sequence of Record
        In the same units.
    """
    stated = next((record for record in records if record.inertia is not None), next(iter(records), None))
    begun = [(record.name, *linear) for record in records if (linear := _linear(record))]
    gains = [plant.for_record(stated).gain for _, plant, _ in begun] if stated else []
    if stated is None or not gains or not _far_apart(min(gains), max(gains)):
        return None
    names, plants, errors = [], [], []
    for name, start, segments in begun:
        found = _explained(start, segments)
        if found is not None:
            plant, error = found
            names.append(name)
            plants.append(plant.for_record(stated))
            errors.append(error * plants[-1].gain / plant.gain)
    return apart(plants, names, errors, "" if stated.inertia is None else f" (for the inertia of {stated.name})")


def apart(
    plants: Sequence[Plant], names: Sequence[str], errors: Sequence[float] | None = None, scaled: str = ""
) -> Finding | None:
    """Return a finding if `plants`, one fitted to each record alone, cannot be the same axis.

    Parameters
    ----------
    plants : sequence of Plant
        Each explains its own record.
    names : sequence of str
        Of the records.
    errors : sequence of float, optional
        Standard errors of their gains; where they are not given they are taken to be small.
    scaled : str
        What to add where gains are not those of the records themselves.
    """
    from scipy.stats import norm

    chance = float(norm.isf(FALSE_ALARM / 2.0))
    told = sorted(zip((plant.gain for plant in plants), errors or [0.0] * len(plants), names, strict=True))
    far = [
        (low, high)
        for low, high in combinations(told, 2)
        if _far_apart(low[0], high[0]) and high[0] - low[0] > chance * np.hypot(low[1], high[1])
    ]
    if not far:
        return None
    low, high = max(far, key=lambda pair: pair[1][0] - pair[0][0])
    first, second = (_told(gain, error) for gain, error, _ in (low, high))
    message = (
        f"the records contradict each other: each by itself is explained, with a gain of {first} "
        f"{plants[0].unit('gain')} in {low[2]} and of {second} in {high[2]}{scaled}; are they of the same "
        "axis, load and units?"
    )
    return Finding(code="records_contradict", severity="warning", message=message)


def _told(gain: float, error: float) -> str:
    """Return a gain with the digits that its error leaves."""
    if not error > 0.0:
        return f"{gain:.4g}"
    digits = max(1 - floor(log10(error)), 0)
    return f"{gain:.{digits}f} ± {error:.{digits}f}"


def _far_apart(a: float, b: float) -> bool:
    return a * b <= 0 or abs(b - a) > FAR_APART * max(abs(a), abs(b))


def _linear(record: Record) -> tuple[Plant, tuple[Segment, ...]] | None:
    """Return gain and damping of a record by the integral equation, and its stretches of motion; None if it rests."""
    try:
        segments = motion_segments([record])
        plant, _ = Screen.of(moving_parts(segments)).solve(())
    except (InputError, NumericalError):
        return None
    return plant, segments


def _explained(start: Plant, segments: Sequence[Segment]) -> tuple[Plant, float] | None:
    """Return the plant that explains one record, as a simulation, and its gain's error; None where it does not."""
    try:
        likelihood = Likelihood(excerpt_of(segments)[0], start, FitOptions())
        found = likelihood.judged(start)
        if found is None or found.noise.rate > 0.0 or found.noise.is_model_error:
            return None
        if depends_on_inputs(ScoreTest(likelihood, found)):
            return None
        model = fitted(likelihood, found).model
    except (InputError, NumericalError):
        return None
    error = model.quantities["gain"].stderr
    return None if error is None else (model.plant, error)
