"""What was applied before the records began: their first voltage, as is taken for granted, or none."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.diagnosis.case import Case
from servolens.diagnosis.search import WORTH
from servolens.diagnosis.threads import in_parallel
from servolens.effects import ActuatorLag, Backlash, Delay, FlexibleCoupling, SensorLag
from servolens.findings import Finding
from servolens.identification.segments import applied_voltage
from servolens.quality.beginning import initial_motion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.diagnosis.trials import Hypothesis, Trials
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["Unpowered", "unpowered_finding"]

REMEMBER = (Delay.name, ActuatorLag.name)
"""Effects by which the voltage before a record still shows in it."""
PASS_FOR_THEM = (*REMEMBER, SensorLag.name, FlexibleCoupling.name, Backlash.name)
NAMED = 4
"""Records that are named in a sentence."""
CONSIDERABLE = 0.1
"""Share of a record's largest voltage from which on its first one is the onset of a step."""


@final
class Unpowered:
    """The records of a case with nothing applied before them, made when they are first asked for.

    Parameters
    ----------
    case : Case
        The records, with their first voltage held before them.
    """

    def __init__(self, case: Case) -> None:
        self._held = case
        self._slowed: dict[tuple[bool, Plant], list[Hypothesis]] = {}

    @cached_property
    def case(self) -> Case:
        """Those records."""
        held = self._held
        return Case.of(_unpowered(held.records), _unpowered(held.heldout), held.priors)

    def understands(self, chosen: Hypothesis) -> bool | None:
        """Tell whether a delay or a lag is all that was missing once nothing was applied before.

        Tried beside gain and damping alone, and beside what of `chosen` cannot be mistaken for them. None if nothing
        speaks for it: the records begin at rest, `chosen` explains them without, or better.
        """
        held = self._held
        strange = any(name in PASS_FOR_THEM for name in chosen.causes) or not held.is_explained(chosen)
        if not strange or not any(_begins_with_its_step(record) for record in held.records):
            return None
        best = self._best(self.case, chosen.plant)
        if best is None or best.tied:  # tied runs may begin in motion, which is as good as a lag
            return None
        usual = self._best(held, chosen.plant)
        known = min(held.trials.score(h) for h in (chosen, usual) if h is not None)
        return self.case.is_explained(best) if self.case.trials.score(best) < known - WORTH else None

    def _best(self, case: Case, plant: Plant) -> Hypothesis | None:
        """Return the best with a delay or a lag beside gain and damping, or beside what of `plant` is no lateness."""
        others = tuple(effect for effect in plant.effects if effect.name not in PASS_FOR_THEM)
        found: list[Hypothesis] = []
        for start in (case.base.plant, *([replace(plant, effects=others)] if others else [])):
            key = (case is self._held, start)
            if key not in self._slowed:
                self._slowed[key] = _slowed(case.trials, start)
            found += self._slowed[key]
        return case.trials.judged(min(found, key=case.trials.score)) if found else None


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


def _slowed(trials: Trials, plant: Plant) -> list[Hypothesis]:
    """Return `plant` with a delay and with a lag, fitted."""
    bare = trials.fitted(plant)
    if bare is None:
        return []
    begun = in_parallel(partial(trials.extended, bare), REMEMBER)
    return [h for h in in_parallel(lambda h: trials.fitted(h.plant), [h for h in begun if h]) if h]


def _unpowered(records: Sequence[Record]) -> tuple[Record, ...]:
    return tuple(r.with_({"voltage_before": 0.0}) if _begins_with_its_step(r) else r for r in records)


def _begins_with_its_step(record: Record) -> bool:
    if record.voltage_before is not None or initial_motion(record) != 0.0:
        return False
    voltage = np.abs(applied_voltage(record))
    return bool(voltage[0] > CONSIDERABLE * voltage.max())
