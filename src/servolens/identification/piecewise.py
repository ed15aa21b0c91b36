"""Damping that is constant between given times: an instrument of identification, not a member of the catalogue."""

from __future__ import annotations

from dataclasses import field, make_dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.effects import Axis, Effect, Force
from servolens.errors import NumericalError
from servolens.identification.segments import settled_steps
from servolens.plant import Plant
from servolens.prediction import prediction_residual

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.varying import VaryingDamping
    from servolens.record import Record

__all__ = ["CAPACITY", "piecewise_damping", "varying_plant", "varying_residual"]

CAPACITY = 60


def varying_plant(varying: VaryingDamping) -> Plant:
    """Return a plant whose damping follows `varying` from the beginning of a step."""
    return Plant(
        gain=varying.gain,
        damping=0.0,
        effects=(piecewise_damping(varying.edges.tolist(), varying.damping.tolist()),),
        inertia=varying.inertia,
    )


def varying_residual(varying: VaryingDamping, record: Record) -> NDArray[np.float64]:
    """Return simulated minus measured position of `record`, shape (n,) [m or rad]; each step from its own beginning.

    Before the first step the axis rests where it was first measured.

    Raises
    ------
    NumericalError
        If the axis does not rest between its steps, or a step cannot be simulated.
    """
    parts = settled_steps(record)
    if len(parts) == 1 and record.edges().size > 1:
        raise NumericalError("the axis never rests between its steps, so none of them can be simulated by itself")
    plant = replace(varying_plant(varying), length_unit=record.length_unit, command_unit=record.command_unit)
    found = [prediction_residual(plant, step.with_({"time": step.time - step.time[0]})) for step in parts]
    lead = len(record) - sum(part.size for part in found)
    return np.concatenate([record.position[0] - record.position[:lead], *found])


def piecewise_damping(edges: Sequence[float], damping: Sequence[float]) -> Effect:
    """Return the effect with `damping[i]` [1/s] between ``edges[i]`` and ``edges[i + 1]`` [s], the last one for ever.

    Parameters
    ----------
    edges : sequence of float, length n + 1
        Increasing; time of the record.
    damping : sequence of float, length n ≤ 60
        Added to the plant's own damping.
    """
    steps = [damping[0], *(after - before for before, after in pairwise(damping))]
    spare = CAPACITY - len(steps)
    times = [*edges[: len(steps)], *([1e9] * spare)]
    values = {f"step{i}": v for i, v in enumerate([*steps, *([0.0] * spare)])}
    return _effect_class()(**values, **{f"time{i}": t for i, t in enumerate(times)})


@lru_cache(maxsize=1)
def _effect_class() -> type[Effect]:
    """Build the class: a step of damping at each of its times."""

    def physics(axis: Axis, p: Any) -> Any:
        from casadi import if_else

        damping = p.step0
        for i in range(1, CAPACITY):
            damping += if_else(axis.time >= getattr(p, f"time{i}"), getattr(p, f"step{i}"), 0.0)
        return damping * axis.velocity

    steps = [(f"step{i}", float, _field("1/s", "change of damping", per_mass=1.0)) for i in range(CAPACITY)]
    times = [(f"time{i}", float, _field("s", "when it changes", per_mass=0.0)) for i in range(CAPACITY)]
    namespace = {
        "name": "piecewise_damping",
        "sentence": "Damping changes in time, piecewise constant.",
        "latex": r"c(t)\,v",
        "physics": staticmethod(physics),
    }
    made: type[Effect] = make_dataclass(
        "PiecewiseDamping", [*steps, *times], bases=(Force,), namespace=namespace, frozen=True, kw_only=True, slots=True
    )
    return made


def _field(unit: str, meaning: str, per_mass: float) -> Any:
    limits = {"low": -1e12, "high": 1e12}
    return field(metadata={"symbol": "", "unit": unit, "meaning": meaning, "per_mass": per_mass, **limits})
