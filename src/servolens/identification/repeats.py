"""Runs that repeat each other: what they have in common is the axis and its inputs, in what they differ is noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.record import Record

__all__ = ["common_share", "repeats", "spread_of"]


def repeats(records: Sequence[Record]) -> list[tuple[int, ...]]:
    """Return the groups of records, by their numbers, that have the same reference, loop and length."""
    groups: list[list[int]] = []
    for i, record in enumerate(records):
        if record.reference is None:
            continue
        alike = next((group for group in groups if _is_repeat(records[group[0]], record)), None)
        if alike is None:
            groups.append([i])
        else:
            alike.append(i)
    return [tuple(group) for group in groups if len(group) > 1]


def _is_repeat(one: Record, other: Record) -> bool:
    same = ("controller", "voltage_limit", "inertia", "voltage_before")
    if len(one) != len(other) or any(getattr(one, name) != getattr(other, name) for name in same):
        return False
    grids = [record.time - record.time[0] for record in (one, other)]
    pairs = [grids, *([getattr(r, name) for r in (one, other)] for name in ("reference", "feedforward", "enabled"))]
    return all(_are_equal(a, b) for a, b in pairs)


def _are_equal(one: NDArray[np.float64] | None, other: NDArray[np.float64] | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.allclose(one, other, rtol=0.0, atol=1e-9 * max(float(np.ptp(one)), 1e-9)))


def spread_of(records: Sequence[Record], groups: Sequence[tuple[int, ...]]) -> float:
    """Return the standard deviation of the positions of repeated runs about their mean [m or rad]."""
    squares, freedom = 0.0, 0
    for group in groups:
        positions = np.array([records[i].position for i in group])
        squares += float(np.sum((positions - positions.mean(axis=0)) ** 2))
        freedom += (len(group) - 1) * positions.shape[1]
    return float(np.sqrt(squares / max(freedom, 1)))


def common_share(errors: Sequence[NDArray[np.float64]], groups: Sequence[tuple[int, ...]]) -> float:
    """Return the share of the squared errors that repeated runs have in common: the lack of fit.

    Of errors that know nothing of the inputs it is about one in the number of repeats, of what the model lacks it is
    all (the test against pure error: Draper and Smith, *Applied Regression Analysis*, 1998, section 2.1).
    """
    whole = sum(float(errors[i] @ errors[i]) for group in groups for i in group)
    common = [np.sum([errors[i] for i in group], axis=0) for group in groups]
    alike = sum(float(c @ c) / len(group) for c, group in zip(common, groups, strict=True))
    return alike / max(whole, 1e-300)
