"""What a fit cannot know: parameters that the data do not determine or cannot tell apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.findings import Finding
from servolens.identification.refine import AT_NOISE
from servolens.identification.segments import runs_free
from servolens.model_evidence import MATERIAL, UNRELIABLE
from servolens.plant import ENDLESS, FREE_DAMPING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.identification.refine import Refinement
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = [
    "FREE_DAMPING_UNKNOWN",
    "HARDLY_APART",
    "LEAST_DAMPING",
    "above_noise",
    "assumed_damping",
    "findings_of",
    "is_beyond",
    "not_determined",
]

PLACES = {"rad": 1.0, "{x}": np.inf}
"""Units of a phase and of a place, of which 0 is a value like any other, with the standard error from which on they are
hardly determined: a radian; of a place there is none, for what is far depends on the machine."""
LEAST_DAMPING = 1.0
"""Damping [1/s] below which a standard error as large as the damping still says something."""
FREE_DAMPING_UNKNOWN = f"the data do not determine {FREE_DAMPING.name}: the axis hardly moves while its motor is off."
HARDLY_APART = 0.98
"""Correlation of two estimates from which on the data hardly tell them apart."""


def findings_of(refined: Refinement) -> tuple[Finding, ...]:
    """Return what the search itself says against its result."""
    return (*_unfinished(refined), *_non_smooth(refined), *_at_bounds(refined), *_vague(refined), *_alike(refined))


def above_noise(error: float, noise: float) -> tuple[Finding, ...]:
    """Say that the simulation's `error` is far above the `noise`, if it is."""
    if error <= AT_NOISE * noise:
        return ()
    times = f"{error / noise:.3g} times the noise" if noise > 0.0 else "not noise"
    message = f"the simulation's error is {times}. {UNRELIABLE} Run servolens diagnose."
    return (Finding(code="above_noise", severity="warning", message=message),)


def assumed_damping(plant: Plant, records: Sequence[Record]) -> tuple[Finding, ...]:
    """Name the `records` in which the axis moves while its motor is off, if `plant` has no damping for that."""
    if plant.free_damping is not None:
        return ()
    message = (
        "the axis moves here while its motor is off; the model has no damping of its own for that, so the record was"
        " simulated with the damping that it has with the motor on. Fit a record in which it moves so."
    )
    moving = [record.name for record in records if runs_free(record)]
    return tuple(Finding(code="free_damping_assumed", severity="note", message=message, record=one) for one in moving)


def is_beyond(refined: Refinement, name: str) -> bool:
    """Tell whether a parameter is a limit, absent where it is far away, of which the data feel nothing."""
    effect, _, own = name.rpartition(".")
    found = refined.plant.effect(effect) if effect else None
    return found is not None and abs(found.absent_at.get(own, 0.0)) >= ENDLESS and name in refined.unfelt


def not_determined(refined: Refinement) -> tuple[str, ...]:
    """Return the parameters of which the data say nothing.

    Beside those that the search found to be so, that is a free damping that may be anything from none to the whole
    damping, which it is a part of: its error is larger than both. An axis that only creeps while its motor is off, or
    a sensor that drifts then, tells no more.
    """
    found, names = refined.undetermined, list(refined.plant.parameters)
    if FREE_DAMPING.name not in names or FREE_DAMPING.name in found:
        return found
    index, plant = names.index(FREE_DAMPING.name), refined.plant
    whole = max(abs(plant.values[index]), abs(plant.damping), LEAST_DAMPING)
    return (*found, FREE_DAMPING.name) if refined.covariance[index, index] > whole**2 else found


def _unfinished(refined: Refinement) -> list[Finding]:
    if refined.converged:
        return []
    return [Finding(code="not_converged", severity="warning", message=f"{refined.status}.")]


def _non_smooth(refined: Refinement) -> list[Finding]:
    if refined.is_smooth:
        return []
    message = (
        "contacts give the error many local minima close together: how far the load swings back decides what comes"
        " next. Errors of these parameters may be several times their error bars."
    )
    return [Finding(code="non_smooth_error", severity="note", message=message)]


def _vague_from(refined: Refinement, name: str, value: float) -> float:
    """Return the standard error from which on a parameter is hardly determined: of a size its value; see `PLACES`."""
    effect, _, own = name.rpartition(".")
    found = refined.plant.effect(effect) if effect else None
    spec = refined.plant.parameters[name]
    if found is None or spec.low >= 0.0 or found.absent_at.get(own) == 0.0 or spec.unit not in PLACES:
        return abs(value)
    return PLACES[spec.unit]


def _at_bounds(refined: Refinement) -> list[Finding]:
    return [
        Finding(
            code="at_bound",
            severity="warning",
            message=f"{name} ended at the end of its range, {_value(refined, name):.4g}; it has no error bar.",
        )
        for name in refined.at_bound
        if abs(_value(refined, name)) < ENDLESS
    ]


def _vague(refined: Refinement) -> list[Finding]:
    """Name the parameters of which the data say nothing, and those that they hardly determine."""
    unknown = not_determined(refined)
    found = [Finding(code="not_determined", severity="note", message=_unknown(refined, name)) for name in unknown]
    for name, value, variance in zip(
        refined.plant.parameters, refined.plant.values, np.diag(refined.covariance), strict=True
    ):
        if (
            name not in unknown
            and np.isfinite(variance)
            and value != 0.0
            and variance > _vague_from(refined, name, value) ** 2
        ):
            message = f"the data hardly determine {name}: {value:.3g} ± {np.sqrt(variance):.2g}."
            found.append(Finding(code="not_determined", severity="note", message=message))
    return found


def _unknown(refined: Refinement, name: str) -> str:
    """Say that the data say nothing of a parameter."""
    if is_beyond(refined, name):
        return f"{name} is not seen by these records, which do not reach it."
    if name == FREE_DAMPING.name:
        return FREE_DAMPING_UNKNOWN
    return f"the data do not determine {name}: others explain them as well as {_value(refined, name):.3g}."


def _alike(refined: Refinement) -> list[Finding]:
    """Name the parameters that the data cannot tell apart: those of one effect, or of two, in one sentence.

    Of two that are known to less than what is material, whatever their correlation, each is told from the other.
    """
    names = list(refined.plant.parameters)
    is_known = np.diag(refined.covariance) <= (MATERIAL * np.array(refined.plant.values)) ** 2
    groups: dict[frozenset[str], list[tuple[int, int]]] = {}
    for i in range(len(names)):
        for k in range(i):
            if abs(refined.correlation[i, k]) > HARDLY_APART and not (is_known[i] and is_known[k]):
                groups.setdefault(frozenset(names[n].rpartition(".")[0] for n in (i, k)), []).append((k, i))
    found = []
    for pairs in groups.values():
        told = [names[n] for n in sorted({n for pair in pairs for n in pair})]
        largest = max((float(refined.correlation[pair]) for pair in pairs), key=abs)
        size = f"{'up to ' if len(pairs) > 1 else ''}{largest:.3f}"
        message = (
            f"{', '.join(told[:-1])} and {told[-1]} are correlated at {size}: these data hardly tell them apart; fix"
            " one, give a prior, or log a run that moves them differently."
        )
        found.append(Finding(code="strongly_correlated", severity="note", message=message))
    return found


def _value(refined: Refinement, name: str) -> float:
    return refined.plant.values[list(refined.plant.parameters).index(name)]
