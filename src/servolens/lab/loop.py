"""The digital PD loop around a virtual axis, for one run in plain floats or for many in arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from servolens.errors import NumericalError
from servolens.lab.axis import Axis
from servolens.lab.command import Chain
from servolens.lab.laws import ARRAYS, FLOATS
from servolens.lab.motion import advance_many, advance_one
from servolens.lab.pd import DigitalPD
from servolens.lab.truth import Truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.lab.oddity import Oddity
    from servolens.record import Controller

__all__ = ["Bench", "Run", "run_many", "run_one"]

SUBSTEP = 2.5e-4
"""Longest integration step [s]; what it costs in accuracy is in the tests."""
ANGLE = 0.1
"""Largest product of a step and the quickest rate of the physics; shorter steps than SUBSTEP where that asks for it."""
BOUNDS = 1e6
"""A position beyond this [m or rad] is a loop that has run away."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """What surrounds the axis: the loop, its reference and feedforward at each sample, the sensor, a stated limit.

    And how finely it is integrated, where that is not as usual: see :data:`SUBSTEP` and :data:`ANGLE`.
    """

    controller: Controller
    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    feedforward: NDArray[np.float64] | None
    start: float
    encoder: float
    voltage_limit: float | None
    substep: float | None = None
    angle: float | None = None


class Run(NamedTuple):
    """Measured position, asked voltage and true velocity of the load; shape (n,), or (runs, n) for many runs."""

    position: NDArray[np.float64]
    voltage: NDArray[np.float64]
    velocity: NDArray[np.float64]


def run_one(truth: Truth, bench: Bench, noises: NDArray[np.float64] | None, oddity: Oddity | None = None) -> Run:
    """Return one run; `noises` of shape (n,). An oddity is what no effect of the truth does."""
    each = [0.0] * bench.time.size if noises is None else noises.tolist()
    signals = _close(truth, bench, each, bench.start, FLOATS, advance_one, oddity)
    return Run(*(np.array(signal) for signal in signals))


def run_many(truth: Truth, bench: Bench, noises: NDArray[np.float64]) -> Run:
    """Return all runs; `noises` of shape (n, runs)."""
    start = np.full(noises.shape[1], bench.start)
    with np.errstate(over="ignore", invalid="ignore"):  # a loop that runs away is named below
        signals = _close(truth, bench, noises, start, ARRAYS, advance_many)
    return Run(*(np.stack(signal, axis=1) for signal in signals))


def _close(
    truth: Truth,
    bench: Bench,
    noises: Any,
    start: Any,
    m: Any,
    advance: Callable[..., Any],
    oddity: Oddity | None = None,
) -> tuple[list[Any], list[Any], list[Any]]:
    """Run the loop through its samples; a sample is a float for one run, an array for many."""
    truth, time, step = _limited(truth, bench), bench.time.tolist(), bench.encoder
    h = time[1] - time[0]
    axis, chain, controller = (
        Axis(truth, m, bench.substep or SUBSTEP, bench.angle or ANGLE, oddity),
        Chain(truth, m, h),
        DigitalPD(bench.controller, h),
    )
    reference = bench.reference.tolist()
    added = [0.0] * len(time) if bench.feedforward is None else bench.feedforward.tolist()
    body = axis.body(start)
    position: list[Any] = []
    voltage: list[Any] = []
    velocity: list[Any] = []
    for k, (t, noise) in enumerate(zip(time, noises, strict=True)):
        place, moving = axis.output(body.state)
        shown = body.shown if oddity is None else oddity.shows(t, body.shown, place, moving)
        seen = shown + noise
        if step:
            seen = m.floor(seen / step + 0.5) * step
        asked = controller.ask(k, reference[k], seen, moving) + added[k]
        position.append(seen)
        velocity.append(moving)
        voltage.append(asked)
        felt = asked if oddity is None else oddity.turns(t, asked, place)
        try:
            for since, length, signal in chain.apply(t, felt):
                body = advance(axis, since, length, body, signal)
        except (OverflowError, ValueError):  # sin(inf) and exp(1e3) of plain floats
            _check_bounds(np.inf, t)
        _check_bounds(axis.output(body.state)[0], t)
    return position, voltage, velocity


def _check_bounds(position: Any, t: float) -> None:
    if not np.all(np.abs(position) < BOUNDS):
        raise NumericalError(f"the virtual axis has run away after {t:g} s: with these gains the loop is unstable")


def _limited(truth: Truth, bench: Bench) -> Truth:
    """Return the truth with the amplifier's stated limit, or its own where that is lower."""
    if bench.voltage_limit is None:
        return truth
    own = truth.effects.get("saturation", {"limit": bench.voltage_limit})["limit"]
    saturation = {"saturation": {"limit": min(own, bench.voltage_limit)}}
    return Truth(gain=truth.gain, damping=truth.damping, effects={**truth.effects, **saturation})
