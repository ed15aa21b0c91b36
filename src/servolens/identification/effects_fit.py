"""Plants with given effects: their sizes as columns of the integral equation, then refined."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.effects import Actuator
from servolens.identification.door import check_priors, together
from servolens.identification.integral import assemble, solve_integral
from servolens.identification.refine import AT_NOISE, Refinement, refine, refine_closed_loop
from servolens.identification.regressors import regressor
from servolens.identification.segments import motion_segments
from servolens.identification.smoothing import smooth, smoothing_window
from servolens.identification.varying import piece_duration
from servolens.model import Model
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.identification.integral import Prior
    from servolens.identification.segments import Segment
    from servolens.record import Record

__all__ = ["fit_effects"]


def fit_effects(
    records: Record | Sequence[Record], effects: Sequence[Effect], *, priors: Mapping[str, Prior] | None = None
) -> Model:
    """Fit gain, damping and the parameters of `effects` to `records`.

    Sizes (parameters in which a force is linear) start from the integral equation, where each is one more column, and
    once more from the values given; shapes from the values given. All are then refined, in closed loop where reference
    and gains are known, else driven by the logged voltage, and the better end counts. Where the model reaches the noise
    the voltage has the last word, for it contains what the controller made of the noise.

    Parameters
    ----------
    records : Record or sequence of Record
        Runs of the same axis.
    effects : sequence of Effect
        What the plant contains, e.g. ``[CoulombFriction(level=1.0)]``, with values of the right order.
    priors : mapping of str to Prior, optional
        By qualified parameter name.

    Raises
    ------
    InputError
        If there is no record or no motion.

    Examples
    --------
    >>> from servolens.effects import CoulombFriction
    >>> from servolens.lab import Truth, step_record
    >>> cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    >>> model = fit_effects(step_record(cart, kp=60), [CoulombFriction(level=1.0)])
    >>> round(model.plant.effect("coulomb_friction").level, 2)
    0.3
    """
    runs = together(records)
    check_priors(priors or {}, Plant(gain=1.0, damping=0.0, effects=tuple(effects)).parameters)
    segments = motion_segments(runs)
    starts = [
        replace(start, length_unit=runs[0].length_unit, command_unit=runs[0].command_unit)
        for start in (_start(segments, tuple(effects)), replace(_start(segments, ()), effects=tuple(effects)))
    ]
    closed = all(run.reference is not None and run.controller is not None for run in runs)
    noise = max(s.noise for s in segments)
    found = [
        refine_closed_loop(start, runs, noise=noise, priors=priors)
        if closed
        else refine(start, segments, priors=priors)
        for start in starts
    ]
    refined = min(found, key=lambda refinement: refinement.rms_error)
    if closed:
        refined = _sharpened(refined, segments, noise, priors)
    return Model(
        plant=refined.plant,
        covariance=refined.covariance,
        identified_from=tuple(run.name for run in runs),
        reasons=dict.fromkeys(refined.plant.parameters, "the data do not determine it"),
    )


def _sharpened(
    refined: Refinement, segments: Sequence[Segment], noise: float, priors: Mapping[str, Prior] | None
) -> Refinement:
    """Refine once more by the voltage where that reaches the noise: it contains what the controller made of it."""
    by_voltage = refine(refined.plant, segments, priors=priors)
    return by_voltage if by_voltage.rms_error <= AT_NOISE * noise else refined


def _start(segments: Sequence[Segment], effects: tuple[Effect, ...]) -> Plant:
    window = smoothing_window(piece_duration(segments), segments[0].record.sample_time)
    forces = [effect for effect in effects if not isinstance(effect, Actuator)]
    columns = [_columns(segment, forces, window) for segment in segments]
    damping, gain, *sizes = (float(v) for v in solve_integral(assemble(segments, forces=columns)).x)
    found: list[Effect] = []
    for effect in effects:
        if effect in forces:
            names = regressor(type(effect)).sizes
            specs = {spec.name: spec for spec in effect.parameters()}
            values = {n: float(np.clip(v, specs[n].low, specs[n].high)) for n, v in zip(names, sizes, strict=False)}
            sizes = sizes[len(names) :]
            found.append(replace(effect, **values))
        else:
            found.append(effect)
    return Plant(gain=gain, damping=damping, effects=tuple(found))


def _columns(segment: Segment, forces: Sequence[Effect], window: int) -> NDArray[np.float64]:
    velocity = smooth(segment.time, segment.position, window)[1]
    rows = []
    for effect in forces:
        law = regressor(type(effect))
        shapes = [getattr(effect, name) for name in law.shapes]
        rows.append(law.columns(segment.time, segment.position, velocity, *shapes))
    return np.vstack(rows) if rows else np.empty((0, segment.time.size))
