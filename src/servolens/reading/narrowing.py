"""Which of several columns that may be one signal is meant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.reading.vocabulary import CALCULATED
from servolens.units import parse_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.reading.roles import Choice

__all__ = ["alike", "increasing", "is_clock", "measured", "moving", "near", "paired"]

SOME = 0.01
"""Share of its steps at which a clock may fall back: at midnight, or where a counter begins again."""
SAME = 1e-6
"""Relative difference up to which two columns are one quantity in two units: logs print six digits and more."""


def measured(left: Sequence[Choice]) -> list[Choice]:
    """Leave out what was calculated where something was measured as well."""
    return [c for c in left if not c.meaning.rest & CALCULATED] or list(left)


def near(left: Sequence[Choice], position: Choice) -> list[Choice]:
    """Keep the columns of the position's table and of its axis, by the words that name it, where there are such."""
    same = [c for c in left if c.table == position.table] or list(left)
    shared = [len(c.meaning.rest & position.meaning.rest) for c in same]
    return [c for c, n in zip(same, shared, strict=True) if n == max(shared)]


def paired(left: Sequence[Choice], found: Sequence[Choice]) -> list[Choice]:
    """Of several positions keep the one whose axis a single reference names."""
    references = [c for c in found if c.meaning.roles == ("reference",)]
    if len(left) < 2 or len(references) != 1 or not references[0].meaning.rest:
        return list(left)
    return [c for c in left if c.meaning.rest & references[0].meaning.rest] or list(left)


def moving(left: Sequence[Choice]) -> list[Choice]:
    """Leave out axes that stand still, unless all do."""
    return [c for c in left if c.column.values.size and np.ptp(c.column.values) != 0] or list(left)


def increasing(left: Sequence[Choice]) -> list[Choice]:
    """Leave out times that are no clock, as that of a cycle, where there is one."""
    return [c for c in left if is_clock(c.column.values)] or list(left)


def is_clock(values: NDArray[np.float64]) -> bool:
    """Tell whether values increase all along, but for some instants at which a counter begins again."""
    known = values[np.isfinite(values)] if values.dtype.kind in "iuf" else values[:0]
    return known.size > 1 and bool(known[-1] > known[0] and np.mean(np.diff(known) < 0) < SOME)


def alike(left: Sequence[Choice]) -> list[Choice]:
    """Of columns that are one quantity, in several units or twice, keep the first with a unit."""
    best = next((c for c in left if c.unit), left[0])
    return [best] if all(_same(best, c) for c in left if c is not best) else list(left)


def _same(one: Choice, other: Choice) -> bool:
    """Tell whether two columns hold the same quantity; without a unit, any scale may be meant beside a stated one."""
    a, b = one.column.values, other.column.values
    if a.size != b.size or a.size < 2 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    spread = float(np.ptp(a))
    if spread == 0 or np.ptp(b) == 0:
        return bool(np.array_equal(a, b))
    mine, others = parse_unit(one.unit or ""), parse_unit(other.unit or "")
    scale = spread / float(np.ptp(b))
    if mine is not None and others is not None:
        scale = others.factor / mine.factor
    elif mine is None and others is None:
        scale = 1.0
    if one.meaning.roles == ("time",):  # clocks may count from instants of their own
        a, b = a - a[0], b - b[0]
    return bool(np.max(np.abs(a - scale * b)) < SAME * max(spread, float(np.max(np.abs(a)))))
