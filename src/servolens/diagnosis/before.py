"""What was applied before the records began: their first voltage, as is taken for granted, or none."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.case import Case
from servolens.diagnosis.search import WORTH
from servolens.effects import ActuatorLag, Backlash, Delay, FlexibleCoupling, SensorLag
from servolens.findings import Finding
from servolens.identification.segments import applied_voltage
from servolens.quality.beginning import initial_motion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.diagnosis.trials import Hypothesis, Trials
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["understood", "unpowered_finding"]

REMEMBER = (Delay.name, ActuatorLag.name)
"""Effects by which the voltage before a record still shows in it."""
PASS_FOR_THEM = (*REMEMBER, SensorLag.name, FlexibleCoupling.name, Backlash.name)
NAMED = 4
"""Records that are named in a sentence."""
CONSIDERABLE = 0.1
"""Share of a record's largest voltage from which on its first one is the onset of a step."""


def understood(case: Case, chosen: Hypothesis) -> tuple[Case, bool] | None:
    """Return `case` with nothing applied before its records, and whether a delay or a lag is then all that was missing.

    Tried beside gain and damping alone, and beside what of `chosen` cannot be mistaken for them. None if nothing speaks
    for it: the records begin at rest, `chosen` explains them without, or better.
    """
    strange = any(name in PASS_FOR_THEM for name in chosen.causes) or not case.is_explained(chosen)
    if not strange or not any(_begins_with_its_step(record) for record in case.records):
        return None
    other = Case.of(_unpowered(case.records), _unpowered(case.heldout), case.priors)
    plants = _without_lateness(chosen.plant)
    best, usual = _slowed(other.trials, plants), _slowed(case.trials, plants)
    if best is None or best.tied:  # tied runs may begin in motion, which is as good as a lag
        return None
    known = min(case.trials.score(h) for h in (chosen, usual) if h is not None)
    return (other, other.is_explained(best)) if other.trials.score(best) < known - WORTH else None


def unpowered_finding(case: Case) -> Finding:
    """Return what is to be said of `case` if nothing was applied before those of its records that begin with a step."""
    names = [record.name for record in (*case.records, *case.heldout) if _begins_with_its_step(record)]
    several, more = len(names) > 1, f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    message = (
        f"{', '.join(names[:NAMED])}{more} {'begin with their' if several else 'begins with its'} step, and"
        f" {'are' if several else 'is'} understood only if no voltage was applied before; state '# voltage_before = 0'"
        " there for identify and predict, or log from before the step."
    )
    return Finding(code="unpowered_before", severity="note", message=message)


def _slowed(trials: Trials, plants: Sequence[Plant]) -> Hypothesis | None:
    """Return the best with a delay or a lag beside one of `plants`."""
    bare = [h for plant in plants if (h := trials.fitted(plant)) is not None]
    begun = [h for one in bare for name in REMEMBER if (h := trials.extended(one, name)) is not None]
    found = [h for one in begun if (h := trials.fitted(one.plant)) is not None]
    return trials.judged(min(found, key=trials.score)) if found else None


def _without_lateness(plant: Plant) -> list[Plant]:
    others = tuple(effect for effect in plant.effects if effect.name not in PASS_FOR_THEM)
    return [replace(plant, effects=effects) for effects in ((others, ()) if others else ((),))]


def _unpowered(records: Sequence[Record]) -> tuple[Record, ...]:
    return tuple(r.with_({"voltage_before": 0.0}) if _begins_with_its_step(r) else r for r in records)


def _begins_with_its_step(record: Record) -> bool:
    if record.voltage_before is not None or initial_motion(record) != 0.0:
        return False
    voltage = np.abs(applied_voltage(record))
    return bool(voltage[0] > CONSIDERABLE * voltage.max())
