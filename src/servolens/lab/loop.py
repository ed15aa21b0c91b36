"""The digital PD loop around a virtual axis, for one run in plain floats or for many in arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from servolens.errors import NumericalError
from servolens.lab.axis import Axis
from servolens.lab.command import Chain, Shake
from servolens.lab.digital import DigitalController
from servolens.lab.laws import ARRAYS, FLOATS
from servolens.lab.motion import advance_many, advance_one
from servolens.lab.truth import Truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.lab.disturbances import Drawn
    from servolens.lab.unmodelled import UnmodelledEffect
    from servolens.record import Controller

__all__ = ["Bench", "BenchRun", "run_many", "run_one"]

SUBSTEP = 2.5e-4
"""Longest integration step [s]; what it costs in accuracy is in the tests."""
STEP_TIMES_QUICKEST_RATE = 0.1
"""Largest product of a step and the quickest rate of the physics; shorter steps than SUBSTEP where that asks for it."""
BOUNDS = 1e6
"""A position beyond this [m or rad] is a loop that has run away."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bench:
    """What surrounds the axis: the loop, its reference and feedforward at each sample, the sensor, a stated limit.

    And where it starts, its motor at a place from -1 to 1 within the gap of a backlash; and how finely it is
    integrated, where that is not as usual: see :data:`SUBSTEP` and :data:`ANGLE`.
    """

    controller: Controller
    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    feedforward: NDArray[np.float64] | None
    start: float
    encoder: float
    voltage_limit: float | None
    place: float = 0.0
    substep: float | None = None
    angle: float | None = None


class BenchRun(NamedTuple):
    """Measured position, asked voltage and true velocity of the load; shape (n,), or (runs, n) for many runs."""

    position: NDArray[np.float64]
    voltage: NDArray[np.float64]
    velocity: NDArray[np.float64]


def run_one(truth: Truth, bench: Bench, drawn: Drawn, unmodelled: UnmodelledEffect | None = None) -> BenchRun:
    """Return one run; what is drawn has shape (n,). An unmodelled effect is what no effect of the truth does."""
    noises, shaking, instants = drawn
    plain = None if shaking is None else shaking.tolist()
    each = _Each(noises.tolist(), plain, (bench.time if instants is None else instants).tolist())
    signals = _close(truth, bench, each, bench.start, FLOATS, advance_one, unmodelled)
    return BenchRun(*(np.array(signal) for signal in signals))


def run_many(truth: Truth, bench: Bench, drawn: Drawn) -> BenchRun:
    """Return all runs; noise and shaking of shape (n, runs), all at the nominal instants."""
    noises, shaking, _ = drawn
    start = np.full(noises.shape[1], bench.start)
    each = _Each(noises, shaking, bench.time.tolist())
    with np.errstate(over="ignore", invalid="ignore"):  # a loop that runs away is named below
        signals = _close(truth, bench, each, start, ARRAYS, advance_many)
    return BenchRun(*(np.stack(signal, axis=1) for signal in signals))


class _Each(NamedTuple):
    """Noise, shaking and instant of each sample; noise and shaking are floats for one run, arrays for many."""

    noises: Any
    shaking: Any
    instants: list[float]

    def lengths(self, h: float) -> list[float]:
        """Return the time to the next sample, the nominal one where samples are taken on time."""
        ahead = [*self.instants[1:], self.instants[-1] + h]
        steps = [b - a for a, b in zip(self.instants, ahead, strict=True)]
        return [h if abs(step - h) < 1e-9 * h else step for step in steps]

    def shake(self, k: int, t: float, length: float) -> Shake | None:
        """Return what shakes the axis from sample `k` to the next."""
        if self.shaking is None:
            return None
        now, ahead = self.shaking[k], self.shaking[min(k + 1, len(self.shaking) - 1)]
        return Shake(t, now, (ahead - now) / length)


def _close(
    truth: Truth,
    bench: Bench,
    each: _Each,
    start: Any,
    m: Any,
    advance: Callable[..., Any],
    unmodelled: UnmodelledEffect | None = None,
) -> tuple[list[Any], list[Any], list[Any]]:
    """Run the loop through its samples; a sample is a float for one run, an array for many."""
    truth, step = _limited(truth, bench), bench.encoder
    h = float(bench.time[1] - bench.time[0])
    axis, chain, controller = (
        Axis(
            truth,
            m,
            bench.substep or SUBSTEP,
            bench.angle or STEP_TIMES_QUICKEST_RATE,
            unmodelled,
            shaken=each.shaking is not None,
        ),
        Chain(truth, m, h),
        DigitalController(bench.controller, h, bench.voltage_limit, m),
    )
    reference = bench.reference.tolist()
    added = [0.0] * len(reference) if bench.feedforward is None else bench.feedforward.tolist()
    body = axis.body(start, bench.place)
    signals: tuple[list[Any], list[Any], list[Any]] = ([], [], [])
    for k, (t, length, noise) in enumerate(zip(each.instants, each.lengths(h), each.noises, strict=True)):
        place, moving = axis.output(body.state)
        shown = body.shown if unmodelled is None else unmodelled.shows(t, body.shown, place, moving)
        seen = shown + noise
        if step:
            seen = m.floor(seen / step + 0.5) * step
        asked = controller.ask(k, t, reference[k], seen, moving, added[k])
        for signal, value in zip(signals, (seen, asked, moving), strict=True):
            signal.append(value)
        felt = asked if unmodelled is None else unmodelled.turns(t, asked, place)
        try:
            for since, stretch, command in chain.apply(t, length, felt, each.shake(k, t, length)):
                body = advance(axis, since, stretch, body, command)
        except (OverflowError, ValueError):  # sin(inf) and exp(1e3) of plain floats
            _check_bounds(np.inf, t)
        _check_bounds(axis.output(body.state)[0], t)
    return signals


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
