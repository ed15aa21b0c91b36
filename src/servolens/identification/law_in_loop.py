"""The damping law fitted to the closed-loop response as a whole, for axes that it does not describe exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import VelocityDecayDamping
from servolens.identification.refine import Refinement, closed_loop_rms, refine_closed_loop
from servolens.identification.segments import settled_steps
from servolens.identification.smoothing import smooth

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.identification.integral import Prior
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["MOST_CLOSED", "best_in_closed_loop", "excerpt_of"]

MOST_CLOSED, FEWEST_CLOSED = 20_000, 20
"""Samples of a closed-loop fit, which simulates them a thousand times; least of a step that still counts."""
EXTRA_DAMPING, DECAYS, MOST_GRID_STARTS = (1.0, 10.0, 100.0), (3.0, 10.0, 30.0, 100.0), 3
"""Starts of the closed-loop fit: α₁ over γ and α₂ times the highest speed; and how many of the best are refined."""


def best_in_closed_loop(
    starts: tuple[Plant, ...], runs: tuple[Record, ...], priors: Mapping[str, Prior], noise: float
) -> Refinement:
    """Refine from several starts, for the law's shape is the hard part; the best end counts."""
    ranked = sorted(
        ((closed_loop_rms(plant, runs), shape, plant) for shape in DECAYS for plant in _trials(starts, shape, runs)),
        key=lambda trial: trial[0],
    )
    shapes = list(dict.fromkeys(shape for _, shape, _ in ranked))[:MOST_GRID_STARTS]
    best = [next(plant for _, shape, plant in ranked if shape == wanted) for wanted in shapes]
    found = [refine_closed_loop(plant, runs, noise=noise, priors=priors) for plant in (starts[-1], *best)]
    return min(found, key=lambda refined: refined.rms_error)


def excerpt_of(runs: tuple[Record, ...]) -> tuple[Record, ...]:
    """Return the steps up to so many samples that a fit by simulation takes seconds."""
    kept: list[Record] = []
    left = MOST_CLOSED
    for step in (step for run in runs for step in settled_steps(run)):
        count = min(len(step), left)
        if count < FEWEST_CLOSED:
            break
        kept.append(step if count == len(step) else step.slice(step.time[0], step.time[count - 1]))
        left -= count
    return tuple(kept) or runs


def _trials(starts: tuple[Plant, ...], shape: float, runs: tuple[Record, ...]) -> list[Plant]:
    """Return laws that decay at a share of the highest speed, of several sizes, on the base of each start."""
    fastest = max(float(np.abs(smooth(r.time, r.position, 21)[1]).max()) for r in runs)
    return [
        replace(
            start,
            damping=abs(start.damping),
            effects=(VelocityDecayDamping(alpha1=size * abs(start.damping), alpha2=shape / fastest),),
        )
        for start in starts
        for size in EXTRA_DAMPING
    ]
