"""What a verdict alone does not say: the noise, what shakes the axis, records that contradict each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.errors import pooled
from servolens.diagnosis.logs import apart, beyond
from servolens.diagnosis.remainder import held_errors
from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.fit_findings import assumed_damping
from servolens.identification.likelihood import SOME
from servolens.identification.repeats import repeats, spread_of
from servolens.identification.rounding import dominates
from servolens.identification.segments import begins_with_its_step
from servolens.model_evidence import MATERIAL
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.decision import Decision
    from servolens.diagnosis.errors import Gains
    from servolens.diagnosis.result import Verdict
    from servolens.identification.hypothesis import Hypothesis
    from servolens.model_evidence import Remainder
    from servolens.record import Record

__all__ = ["missed_by_far", "said"]

FARTHER = 3.0
"""Times the fitted records' error from which on a held-out one is held to be of another axis, load or unit."""
MOVES = 1.5
"""Times the noise from which on what the noise does to the loop is worth a sentence."""
NAMED = 4
"""Records that are named in a sentence."""


def said(
    case: Case, decision: Decision, chosen: Hypothesis, gains: Gains, verdict: Verdict, remainder: Remainder
) -> list[Finding]:
    """Return the findings of a diagnosis beside those of its logs and its fit."""
    told = [*_noise(case, chosen, gains), *beyond(case.records, case.heldout), *_strangers(case, chosen, gains)]
    told += assumed_damping(chosen.plant, case.heldout)
    ripple = case.ripple_beside(chosen)
    if ripple:
        lines = " and ".join(f"{f:g}" for f in ripple.frequencies)
        message = (
            f"the sensor shows a ripple of the mains at {lines} Hz, amplitude"
            f" {readable(ripple.amplitude, case.records[0].length_unit)}; it counts as noise. Check shielding and"
            " grounding."
        )
        told.append(Finding(code="mains_ripple", severity="note", message=message))
    if chosen.noise.rate > 0.0 and not remainder.depends_on_inputs:
        told.append(_shaken(case, remainder, gains.noise))
    told += _bursts(case, chosen)
    in_loop = case.noise_in_loop(chosen)
    if in_loop > MOVES * gains.noise:
        told.append(_noise_in_loop(case, in_loop, gains.noise))
    if chosen.unpowered:
        told.append(_unpowered(case))
    if decision.found.ended_early and remainder.depends_on_inputs:  # else nothing is left that a cause could explain
        message = "the search ended when its effort was spent; a thorough one (--effort thorough) may find more."
        told.append(Finding(code="effort_spent", severity="note", message=message))
    if verdict in ("partly_explained", "unexplained") and not remainder.material:
        message = (
            f"what is left has no known cause, but is immaterial: {100 * remainder.of_travel:.2g} % of the travel."
        )
        told.append(Finding(code="immaterial_remainder", severity="note", message=message))
    if verdict in ("partly_explained", "unexplained"):
        contradiction = decision.contradiction or _contradiction(case, chosen)
        told += [contradiction] if contradiction is not None else []
    return told


def _noise(case: Case, chosen: Hypothesis, gains: Gains) -> Iterator[Finding]:
    """Tell the size of the noise, then what it is made of where that is known."""
    noise, unit, size = chosen.noise, case.records[0].length_unit, gains.noise
    is_random = noise.is_fitted and noise.spread > 0.0 and not dominates(noise)
    error = size * noise.spread_error(case.likelihood.samples) / noise.spread if is_random else 0.0
    of_what = "r.m.s."
    if not case.is_enough(chosen):  # what the model leaves is more than noise
        is_fast = size <= case.likelihood.floor
        of_what += " of its fast part" if is_fast else " while the axis rests, without what changes more slowly"
    message = f"the sensor's noise is {readable(size, unit, error)} ({of_what})."
    yield Finding(code="noise_model", severity="note", message=message)
    parts = []
    if noise.rate == 0.0 and noise.memory() > 2.0 and not dominates(noise):
        slow = size * float(np.sqrt(max(1.0 - (noise.innovation / noise.spread) ** 2, 0.0)))
        if slow > error:  # less is within the error of the noise itself
            lasts = readable(noise.time_constant() * case.likelihood.every * case.records[0].sample_time, "s")
            parts.append(f"{readable(slow, unit)} of the sensor's noise change slowly ({lasts})")
    if dominates(noise):
        parts.append(
            f"rounding to {readable(noise.rounding, unit)}, by the encoder or in the log, is most of the noise"
        )
    groups = repeats(case.records)
    if groups:
        spread = readable(spread_of(case.records, groups), unit)
        parts.append(f"{sum(len(g) for g in groups)} runs repeat others and differ from them by {spread}")
    yield from (Finding(code="noise_parts", severity="note", message=f"{part}.") for part in parts)


def _shaken(case: Case, remainder: Remainder, noise: float) -> Finding:
    """Tell how strongly the axis is shaken; what to do where that is material.

    In the position, or in the command of a stiff loop, which hides it from the position.
    """
    size, lasts = remainder.acceleration_rms, remainder.correlation_time
    lasts *= float(np.sqrt(np.pi))  # the integral of the squared correlation
    independent = sum(record.duration for record in case.records) / max(lasts, 1e-9)
    told = readable(size, f"{case.records[0].length_unit}/s^2", size * float(np.sqrt(0.5 / max(independent, 1.0))))
    share = f"{100 * remainder.of_motor:.2g} % of what the motor gives at most"
    message = f"something shakes the axis irregularly, by about {told} (r.m.s.), {share}"
    if not remainder.material and remainder.of_motor <= MATERIAL:
        hidden = "it moves the axis by less than the sensor's noise, and " if remainder.rms < noise else ""
        message += f": {hidden}nothing need be done."
    else:
        message += (
            ". It does not depend on the reference: it is no cause of the catalogue, and no gain designed from a model"
            " removes it. Look for vibration, cables or a machine nearby."
        )
    if any(record.ticks > 1 for record in case.records):
        message += (
            " Between the samples the loop also answered sensor noise that was not logged; that counts as shaking too."
        )
    return Finding(code="shaken_axis", severity="note", message=message)


def _bursts(case: Case, chosen: Hypothesis) -> Iterator[Finding]:
    burst = case.burst(chosen)
    if burst is not None:
        what = "what shakes the axis" if chosen.noise.rate > 0.0 else "the slow noise of the position"
        message = (
            f"{what} comes in bursts, the strongest {readable(burst.time, 's')} into"
            f" {case.records[burst.record].name}: look for knocks, for a contact or friction that comes and goes, and"
            " for counts that the encoder loses."
        )
        yield Finding(code="bursts", severity="note", message=message)


def _noise_in_loop(case: Case, missed: float, noise: float) -> Finding:
    unit = case.records[0].length_unit
    message = (
        f"through the gains the sensor's noise, {readable(noise, unit)}, moves the axis: {readable(missed, unit)}"
        " (r.m.s.) of its motion no simulation can foretell. A better sensor, or a filter of the derivative, helps."
    )
    return Finding(code="noise_in_loop", severity="note", message=message)


def _unpowered(case: Case) -> Finding:
    names = [record.name for record in (*case.records, *case.heldout) if begins_with_its_step(record)]
    several, more = len(names) > 1, f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    message = (
        f"{', '.join(names[:NAMED])}{more} {'begin with their' if several else 'begins with its'} step, and"
        f" {'are' if several else 'is'} understood only if no voltage was applied before; state '# voltage_before = 0'"
        " there for identify and predict, or log from before the step."
    )
    return Finding(code="unpowered_before", severity="note", message=message)


def missed_by_far(case: Case, chosen: Hypothesis, gains: Gains) -> Iterator[tuple[Record, float]]:
    """Yield each held-out record that is missed by far more than those that were fitted, and by how much (r.m.s.).

    Each with the phases of its own, if any: another one says nothing of the axis.
    """
    limit = FARTHER * max(pooled(gains.fitted[-1]), gains.noise)
    for record, error in zip(case.heldout, held_errors(case, chosen, gains), strict=False):
        size = pooled([error])
        if size > limit:
            yield record, size


def _strangers(case: Case, chosen: Hypothesis, gains: Gains) -> Iterator[Finding]:
    """Yield a finding for each held-out record that is missed by far, and that is no extrapolation."""
    known = {finding.record for finding in beyond(case.records, case.heldout)}
    for record, size in missed_by_far(case, chosen, gains):
        if record.name not in known:
            unit = record.length_unit
            message = (
                f"held out, the simulation misses it by {readable(size, unit)} (r.m.s.), the records that were fitted"
                f" by {readable(pooled(gains.fitted[-1]), unit)}; is it of the same axis, load and"
                " units?"
            )
            yield Finding(code="heldout_contradicts", severity="warning", message=message, record=record.name)


def _contradiction(case: Case, chosen: Hypothesis) -> Finding | None:
    """Return a finding if each record by itself gives the plant, but with gains that no single axis has."""
    if len(case.records) < 2:
        return None
    plants = []
    for i, record in enumerate(case.records):
        likelihood, like = case.likelihood.on([record]), chosen.of([i])
        try:
            found = likelihood.tried(chosen.plant, chosen.noise, SOME, like=like, unpowered=chosen.unpowered)
        except (InputError, NumericalError):
            return None
        if found is None or found.noise.spread > 0.5 * chosen.noise.spread:
            return None
        plants.append(found.plant)
    return apart(plants, [record.name for record in case.records])
