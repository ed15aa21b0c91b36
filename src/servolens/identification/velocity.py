"""Damping against speed, from start to error bars: the law in the integral equation, then its likelihood."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.effects import VelocityDecayDamping
from servolens.errors import NumericalError
from servolens.findings import Finding
from servolens.identification.damping_law import SHAPE, SIZE, fit_law
from servolens.identification.explained import Explained, excerpt_of, explained
from servolens.identification.fitted import model_of
from servolens.identification.refine import minimise_error
from servolens.identification.runs import ClosedRun, VoltageRun
from servolens.identification.segments import motion_segments, settled_steps
from servolens.identification.smoothing import smoothing_window
from servolens.identification.varying import piece_duration
from servolens.model import UNDETERMINED
from servolens.simulation.rates import rate_within, substeps_for

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from servolens.identification.options import FitOptions
    from servolens.identification.refine import Refinement
    from servolens.identification.segments import Segment
    from servolens.model import Model
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["SHAPE", "SIZE", "VelocityFit", "first_samples", "fit_velocity", "law_left", "records_of"]

SIGNIFICANT = 3.0
"""Standard errors that the extra damping must be away from zero."""
MOST_SAMPLES, MOST_CLOSED, FEWEST = 64_000, 20_000, 20
"""Samples of the last descent of the likelihood, and of a fit to the closed loop, which take seconds; the fewest of a
part that still counts."""
EXTRA, DECAY = 10.0, 10.0
"""Another start of the closed-loop fit: an extra damping at rest of so many times γ, e^−10 of it at top speed."""
NO_DEPENDENCE = "damping does not depend on speed within its error, so the rate of decay is not determined"


@final
@dataclass(frozen=True, slots=True, eq=False)
class VelocityFit:
    """The model, the stretches of motion it began from, what is left beside it, and findings."""

    model: Model
    segments: tuple[Segment, ...]
    left: Explained
    findings: tuple[Finding, ...]


def fit_velocity(segments: Sequence[Segment], options: FitOptions, constant: Plant) -> VelocityFit:
    """Fit the law of eq. 20 by the likelihood of the records, from its solution in the integral equation.

    Where it does not explain the records, it is fitted to the closed loop as a whole: then it describes them as well as
    such a law can.

    Parameters
    ----------
    segments : sequence of Segment
        Stretches of motion.
    options : FitOptions
        What is fixed or bounded, and priors.
    constant : Plant
        The axis with constant damping.
    """
    used, is_all = first_samples(segments)
    start = _start(used, options)
    left, refined = _by_likelihood(start, used, options)
    depends = _depends_on_speed(refined)
    findings = [] if is_all else [_shortened(used)]
    steps = () if left.is_enough or not all(s.record.has_loop for s in used) else _first_steps(records_of(used))
    if steps:
        most = left.likelihood.most_substeps
        refined = _in_closed_loop((constant, start, refined.plant), used, steps, options, most) or refined
    elif not depends:
        findings.append(Finding(code="no_velocity_dependence", severity="note", message=f"{NO_DEPENDENCE}."))
    if not refined.converged:
        findings.append(Finding(code="not_converged", severity="warning", message=f"velocity model: {refined.status}."))
    model = model_of(refined, [s.record for s in segments], options.held)
    if SHAPE not in options.held:
        why = UNDETERMINED if depends else NO_DEPENDENCE
        model = replace(model, reasons={**model.reasons, SHAPE: why})
    return VelocityFit(model, used, left, tuple(findings))


def law_left(segments: Sequence[Segment], options: FitOptions) -> Explained:
    """Return what the law leaves of the records, without error bars."""
    used, _ = first_samples(segments)
    return explained(_start(used, options), excerpt_of(used)[0], options)


def _start(segments: Sequence[Segment], options: FitOptions) -> Plant:
    """Return the law as it solves the integral equation, with what is fixed beside it."""
    window = smoothing_window(piece_duration(segments), min(s.record.sample_time for s in segments))
    return fit_law(segments, window, options).with_named(options.values)


def _by_likelihood(start: Plant, segments: Sequence[Segment], options: FitOptions) -> tuple[Explained, Refinement]:
    """Return what the law leaves and its optimum; its rate of decay is free if damping depends on speed at all."""
    excerpt, _ = excerpt_of(segments)
    held = explained(start, excerpt, options.holding(SHAPE))
    refined = _optimum(held, start, segments, options)
    if SHAPE in options.held or (held.is_enough and not _depends_on_speed(refined)):
        return held, refined
    free = explained(refined.plant, excerpt, options, like=held)
    found = _optimum(free, refined.plant, segments, options)
    return (free, found) if _depends_on_speed(found) else (held, refined)


def _optimum(left: Explained, start: Plant, segments: Sequence[Segment], options: FitOptions) -> Refinement:
    """Return the optimum on all records of `segments`; of stretches of motion, where whole ones cannot be simulated."""
    if left.hypothesis is not None or left.loop is not None:
        with suppress(NumericalError):
            return left.optimum(records_of(segments))
    runs = [VoltageRun(segment, 0) for segment in segments]
    return minimise_error(start, runs, options.holding(SHAPE), noise=max(s.noise for s in segments))


def _depends_on_speed(refined: Refinement) -> bool:
    index = list(refined.plant.parameters).index(SIZE)
    spread = np.nan_to_num(np.sqrt(refined.covariance[index, index]))  # none of what is fixed
    return bool(refined.plant.values[index] > SIGNIFICANT * spread)


def records_of(segments: Sequence[Segment]) -> tuple[Record, ...]:
    """Return the records that `segments` are of, each once."""
    return tuple({id(s.record): s.record for s in segments}.values())


def _in_closed_loop(
    starts: tuple[Plant, ...], segments: Sequence[Segment], records: Sequence[Record], options: FitOptions, most: float
) -> Refinement | None:
    """Fit the law to whole steps in closed loop, from where it errs least.

    Begun from what needs no more than so many substeps a sample as are the `most`; None where each of them does, or its
    loop is unstable. Nor does its damping at rest become faster than that: no sample would show it.
    """
    noise = max(s.noise for s in segments)
    fastest = max(float(np.abs(np.diff(s.position) / np.diff(s.time)).max()) for s in segments)
    steep = VelocityDecayDamping(alpha1=EXTRA * abs(starts[0].damping), alpha2=DECAY / max(fastest, 1e-12))
    trials = [*starts[1:], replace(starts[0], damping=abs(starts[0].damping), effects=(steep,))]
    trials = [trial.with_named(options.values) for trial in trials]
    step = max(record.sample_time for record in records)
    slow = [trial for trial in trials if substeps_for(trial, step) <= most]
    if SIZE not in {*options.held, *options.bounds}:
        options = replace(options, bounds={**options.bounds, SIZE: (0.0, rate_within(most, step))})
    runs = [ClosedRun(one, 0) for record in records for one in settled_steps(record)]
    found = []
    for trial in slow:
        with suppress(NumericalError):  # another start may be a loop that is stable
            found.append(minimise_error(trial, runs, options, noise=noise))
    return min(found, key=lambda refined: refined.rms_error, default=None)


def first_samples(segments: Sequence[Segment]) -> tuple[tuple[Segment, ...], bool]:
    """Return `segments` up to so many samples that the likelihood takes seconds, and whether that is all of them."""
    records = tuple({id(s.record): s.record for s in segments}.values())
    if sum(map(len, records)) <= MOST_SAMPLES:
        return tuple(segments), True
    kept, left = [], MOST_SAMPLES
    for record in records:
        count = min(len(record), left)
        if count < FEWEST:
            break
        first = next(s.first for s in segments if s.record is record)
        begin = 0 if count == len(record) else min(first, len(record) - count)
        kept.append(record.slice(float(record.time[begin]), float(record.time[begin + count - 1])))
        left -= count
    return motion_segments(kept), False


def _first_steps(records: Iterable[Record]) -> tuple[Record, ...]:
    """Return the steps up to so many samples that a fit by simulation takes seconds."""
    kept: list[Record] = []
    left = MOST_CLOSED
    for step in (step for record in records for step in settled_steps(record)):
        count = min(len(step), left)
        if count < FEWEST:
            break
        kept.append(step if count == len(step) else step.slice(step.time[0], step.time[count - 1]))
        left -= count
    return tuple(kept)


def _shortened(segments: Sequence[Segment]) -> Finding:
    seconds = sum(record.duration for record in {id(s.record): s.record for s in segments}.values())
    message = f"the velocity model uses the first {seconds:.4g} s of motion."
    return Finding(code="not_all_data_used", severity="note", message=message)
