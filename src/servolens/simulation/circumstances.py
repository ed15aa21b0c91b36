"""A plant as it was in a record: with its moving inertia, its amplifier's limit, and its motor off where it was off."""

from __future__ import annotations

from dataclasses import make_dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.effects import MotorForce, Saturation, parameter
from servolens.errors import InputError

if TYPE_CHECKING:
    from servolens.effects import Axis, Effect
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["plant_in"]

MOST_STRETCHES = 50
"""How often the motor may be off in one record: each time is an expression of its own in the compiled simulation."""


def plant_in(plant: Plant, record: Record) -> Plant:
    """Return `plant` as it was in `record`, to be simulated and for nothing else.

    Its numbers are those for the record's moving inertia (:meth:`~servolens.plant.Plant.for_record`); the smaller limit
    counts where both the record and the plant have one; and while the record's `enabled` is 0 the motor gives no force,
    only the plant's `free_damping` is left. What the controller asks for goes on, and so does what follows it (a lag).

    Parameters
    ----------
    plant : Plant
        As it was identified, in the record's units.
    record : Record
        Gives inertia, voltage limit and enabled.

    Raises
    ------
    InputError
        If the plant does not go with the record's inertia, or the motor goes off more than 50 times.
    """
    own, free = plant.for_record(record), None
    if own.free_damping is not None:
        own, free = replace(own, free_damping=None), own.free_damping
    return _switched(_limited(own, record.voltage_limit), record, own.damping if free is None else free)


def _limited(plant: Plant, limit: float | None) -> Plant:
    own = plant.effect(Saturation.name)
    if limit is None or (isinstance(own, Saturation) and own.limit <= limit):
        return plant
    return plant.with_effect(Saturation(limit=limit))


def _switched(plant: Plant, record: Record, damping: float) -> Plant:
    """Return `plant` with the motor off where it was off; the axis has this `damping` then."""
    if record.enabled is None or record.enabled.all():
        return plant
    changes = np.flatnonzero(np.diff(record.enabled)) + 1
    begins = [int(k) for k in (0, *changes) if record.enabled[k] == 0]
    if len(begins) > MOST_STRETCHES:
        raise InputError(
            f"{record.name}: the motor goes off {len(begins)} times; "
            f"a simulation allows {MOST_STRETCHES}, cut the record"
        )
    later = float(record.time[-1]) + record.sample_time
    times = {"damping": damping}
    for i, first in enumerate(begins):
        following = changes[changes > first]
        times[f"begin_{i}"] = float(record.time[first])
        times[f"end_{i}"] = float(record.time[following[0]]) if following.size else later
    return plant.with_effect(_motor_off(len(begins))(**times))


@lru_cache(maxsize=MOST_STRETCHES)
def _motor_off(count: int) -> type[Effect]:
    """Return the class of an effect that switches the motor off for as many stretches of time."""

    def physics(push: Any, axis: Axis, p: Any) -> Any:
        from casadi import if_else, logic_and

        left = push
        for i in range(count):
            is_off = logic_and(axis.time >= getattr(p, f"begin_{i}"), axis.time < getattr(p, f"end_{i}"))
            left = if_else(is_off, -p.damping * axis.velocity, left)
        return left

    times = [
        (f"{end}_{i}", float, parameter("t", "s", end, low=-1e12)) for i in range(count) for end in ("begin", "end")
    ]
    namespace = {
        "name": "motor_off",
        "sentence": "The motor is switched off for a while.",
        "latex": r"\beta\,a - c\,v\ \mathrm{or}\ {-c_0\,v}",
        "physics": staticmethod(physics),
    }
    damping = ("damping", float, parameter("c_0", "1/s", "damping while it is off", low=-1e9, per_mass=1))
    made: type[Effect] = make_dataclass(
        "MotorOff",
        [damping, *times],
        bases=(MotorForce,),
        namespace=namespace,
        frozen=True,
        kw_only=True,
        slots=True,
    )
    return made
