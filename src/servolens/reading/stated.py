"""A reference that was not logged, as people state it: ``0.1 m from 0.5 s``, ``0.1@0.5``, ``0.1``."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError
from servolens.reading.files import quote
from servolens.units import Unit, parse_unit, split_number

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.reading.counts import Scales

    Values = NDArray[np.float64]

__all__ = ["stated_reference"]

_FROM = re.compile(r"\s*(?:@|\bfrom\b|\bat\b)\s*")
OFF = 0.05
"""Share of the first step that the axis may be off zero before it, where nothing says what its reference was there."""


def stated_reference(
    text: str, signals: Mapping[str, Values], stated: Mapping[str, tuple[str, Unit]], scales: Scales, length: str
) -> Values:
    """Return the reference that a text states, held from each instant to the next.

    Parameters
    ----------
    text : str
        Levels, each with the instant from which on it holds: ``"0.1 m from 0.5 s, 0 m from 2.5 s"``. One level without
        an instant holds all along; before the first instant the reference is zero.
    signals : mapping
        In SI, with time and position.
    stated : mapping
        Units of the columns.
    scales : Scales
        Of counts.
    length : {"m", "rad"}
        Unit of the record.

    Raises
    ------
    InputError
        If the text states no reference, or leaves open what it was.
    """
    time, position = signals["time"], signals["position"]
    if "reference" in signals:
        raise InputError("a reference is logged and one is stated too; keep one of the two")
    steps = [_step(part, stated, scales, length) for part in text.split(",")]
    instants = [instant for _, instant in steps]
    if len(steps) == 1 and instants[0] is None:
        return np.full(time.shape, steps[0][0])
    known = [instant for instant in instants if instant is not None]
    if len(known) < len(steps) or any(b <= a for a, b in pairwise(known)):
        raise InputError(
            f"reference {quote(text)}: each level needs its instant, later ones behind, e.g. 0.1@0.5, 0@2.5"
        )
    if known[0] > time[-1]:
        raise InputError(f"reference {quote(text)} begins at {known[0]:g} s, behind the record's end at {time[-1]:g} s")
    before = time < known[0]
    level = steps[0][0]
    if before.any() and abs(float(np.median(position[before]))) > OFF * abs(level):
        raise InputError(
            f"the axis stands at {float(np.median(position[before])):.4g} {length} before the stated reference begins;"
            f" state the reference there too, e.g. {position[0]:.3g}@{time[0]:g}, {level:g}@{known[0]:g}"
        )
    levels = np.array([0.0, *(level for level, _ in steps)])
    return levels[np.searchsorted(np.array(known), time, side="right")]


def _step(part: str, stated: Mapping[str, tuple[str, Unit]], scales: Scales, length: str) -> tuple[float, float | None]:
    """Return level [m or rad] and instant [s] of one step."""
    level, *instants = _FROM.split(part.strip())
    try:
        value, unit = split_number(level)
        instant = _seconds(instants[0]) if instants else None
    except InputError as error:
        raise InputError(f"reference {quote(part.strip())} {error}; write e.g. 0.1 m from 0.5 s, or 0.1@0.5") from error
    if len(instants) > 1:
        raise InputError(f"reference {quote(part.strip())} states two instants; separate steps by commas")
    if not unit:
        logged = stated.get("position")
        if logged is not None and logged[1].factor != 1.0:
            raise InputError(
                f"reference {quote(part.strip())} states no unit, and the position is logged in {quote(logged[0])};"
                f" write '{value:g} {logged[0]}' or '{value:g} {length}'"
            )
        return value, instant
    parsed = parse_unit(unit)
    converted = scales.converted(parsed) if parsed else None
    if converted is None or dict(converted.dimension) not in ({length: 1.0}, {"count": 1.0}):
        raise InputError(f"reference {quote(part.strip())} is not in a unit of the position; give it in {length}")
    return value * converted.factor, instant


def _seconds(text: str) -> float:
    value, unit = split_number(text)
    parsed = parse_unit(unit) if unit else None
    if unit and (parsed is None or dict(parsed.dimension) != {"s": 1.0}):
        raise InputError(f"has an instant in {quote(unit)}, which is no time")
    return value * (parsed.factor if parsed else 1.0)
