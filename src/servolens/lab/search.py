"""How much of an effect there must be for it to stand out as asked: sizes, tried on one scene."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from servolens.errors import NumericalError
from servolens.lab.disturbances import SensorNoise, Surroundings
from servolens.lab.foreign import FOREIGN
from servolens.lab.linear_view import LoggedLoop, linear_error
from servolens.lab.loop import run_one
from servolens.lab.sizes import SIZES, dice_number
from servolens.lab.truth import Truth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from servolens.lab.disturbances import Drawn
    from servolens.lab.loop import Bench, BenchRun
    from servolens.lab.scene import Scene
    from servolens.lab.unmodelled import UnmodelledEffect

__all__ = ["Found", "Look", "SizeSearch", "heard", "law", "missed", "sane_run"]

CLOSE_VISIBILITY = 0.12
"""Distance of the logarithm of visibility at which the search for a size ends."""
MOST_SIZES = 8
"""Sizes that are tried."""
REACH, UNREST, MOTION = 3.0, 0.15, 0.4
"""A run is no use beyond so many steps, with so large a standing oscillation, with so small a share of its travel."""
MOST_LEVELS = 20
"""Changes of the reference beyond which it is no staircase."""


class Look(NamedTuple):
    """How visible effects of some sizes are, and the training runs that show it."""

    sizes: dict[str, float]
    visibility: float
    runs: tuple[BenchRun, ...]


class Found(NamedTuple):
    """What was settled on, the visibility of each effect by itself, and how far those are from what was wanted."""

    look: Look
    shares: dict[str, float]
    distance: float


@final
class SizeSearch:
    """The search for the sizes of effects on one scene, each by itself."""

    def __init__(self, scene: Scene, key: tuple[int, int], closed: bool) -> None:
        self._scene, self._key, self._closed = scene, key, closed

    def hide(self, names: Sequence[str], wanted: Sequence[float]) -> Found | None:
        """Return the scene with the effects as visible as wanted, or as near as it gets; None if it is no use.

        Nor is one on which the others keep an effect from showing at all.
        """
        looks = [self._turn(name, target) for name, target in zip(names, wanted, strict=True)]
        good = [look for look in looks if look is not None]
        if len(good) < len(names):
            return None
        sizes = {name: size for look in good for name, size in look.sizes.items()}
        joint = good[0] if len(names) == 1 else self._look(sizes)
        if joint is None or not all(self._shows(name, joint) for name in names if len(names) > 1):
            return None
        distances = [abs(_gap(look, target)) for look, target in zip(good, wanted, strict=True)]
        shares = {name: look.visibility for name, look in zip(names, good, strict=True)}
        return Found(joint, shares, max(distances, default=0.0))

    def _shows(self, name: str, joint: Look) -> bool:
        """Tell whether the axis moves otherwise without one of several effects, by more than a healthy one misses.

        Friction may hold an axis off a stop that it reaches without.
        """
        without = self._look({other: size for other, size in joint.sizes.items() if other != name})
        if without is None:
            return True
        moved = [one.position - other.position for one, other in zip(joint.runs, without.runs, strict=True)]
        return float(np.sqrt(np.mean(np.concatenate(moved) ** 2))) > self._scene.floor

    def _turn(self, name: str, target: float) -> Look | None:
        """Return the size at which an effect is as visible as wanted, or nearest to it; None if the loop bears none."""
        table = FOREIGN if name in FOREIGN else SIZES
        limits = low, high = table[name].low, table[name].high
        guess = table[name].per_mille * target * self._scene.floor / (1e-3 * self._scene.step)
        size = min(max(guess, low), high)
        best: Look | None = None
        below: tuple[float, float | None] = (low, None)
        above: tuple[float, float | None] = (high, None)
        for _ in range(MOST_SIZES):
            look = self._look({name: size})
            if look is None:  # the loop does not bear so much of it
                above, size = (size, None), math.sqrt(below[0] * size)
                continue
            gap = _gap(look, target)
            best = look if best is None or abs(gap) < abs(_gap(best, target)) else best
            if abs(gap) < CLOSE_VISIBILITY:
                break
            below, above = ((size, gap), above) if gap < 0.0 else (below, (size, gap))
            before, size = size, _next_size(below, above, size, gap, limits)
            if abs(math.log(size / before)) < 0.01:
                break
        return best

    def _look(self, sizes: dict[str, float]) -> Look | None:
        """Measure the training runs, with white noise; None if one is of no use."""
        scene = self._scene
        white = Surroundings(noise=SensorNoise(deviation=scene.noise), encoder=scene.encoder)
        truth, odd = law(scene, self._key, sizes)
        runs = []
        for i, bench in enumerate(scene.training):
            drawn = white.drawn(bench.time, np.random.default_rng([*self._key, 2, i]))
            run = sane_run(heard(truth, self._key, i), bench, drawn, odd(i), scene.step)
            if run is None:
                return None
            runs.append(run)
        rms = missed(scene, zip(scene.training, runs, strict=True), self._closed)
        return Look(sizes, math.sqrt(max(rms**2 - scene.floor**2, 0.0)) / scene.floor, tuple(runs))


def missed(scene: Scene, measured: Iterable[tuple[Bench, BenchRun]], closed: bool) -> float:
    """Return the r.m.s. error that the best model of gain and damping leaves in some runs."""
    seen = [
        LoggedLoop(
            bench.controller, scene.sample_time, run.position, bench.reference if closed else run.voltage, closed
        )
        for bench, run in measured
    ]
    return linear_error(seen, scene.gain, scene.damping)[0]


def _gap(look: Look, target: float) -> float:
    """Return the distance from a visibility, as a logarithm; one below the noise is too small by much."""
    return math.log(max(look.visibility, 0.1 * target) / target)


def _next_size(
    below: tuple[float, float | None],
    above: tuple[float, float | None],
    size: float,
    gap: float,
    limits: tuple[float, float],
) -> float:
    """Return the size to try next: between two by their errors, else as if the error grew with the size."""
    (low, under), (high, over) = below, above
    if under is not None and over is not None:
        share = min(max(under / (under - over), 0.1), 0.9)
        return float(low * (high / low) ** share)
    new = min(max(size * math.exp(-gap), limits[0]), limits[1])
    return math.sqrt(low * high) if not low <= new <= high else new


def law(
    scene: Scene, key: tuple[int, int], sizes: Mapping[str, float]
) -> tuple[Truth, Callable[[int], UnmodelledEffect | None]]:
    """Return the truth with effects of these sizes, and run → the foreign law of that run."""
    values, odd = {}, None
    for name, size in sizes.items():
        if name in FOREIGN:
            odd = name
            continue
        dice = np.random.default_rng([*key, 1, dice_number(name)])
        values[name] = SIZES[name].shape(scene, dice)(size)
    damping = scene.damping - (values["speed_servo"]["proportional"] if "speed_servo" in values else 0.0)
    truth = Truth(gain=scene.gain, damping=damping, effects=values)
    if odd is None:
        return truth, lambda _: None
    law, size = FOREIGN[odd], sizes[odd]
    return truth, lambda i: law.make(scene, size, np.random.default_rng([*key, 3]), np.random.default_rng([*key, 4, i]))


def heard(truth: Truth, key: tuple[int, int], i: int) -> Truth:
    """Return `truth` as run `i` meets it: what swings nearby does so with another phase in every run but the first."""
    own = truth.effects.get("periodic_disturbance")
    if own is None or i == 0:
        return truth
    phase = float(np.random.default_rng([*key, 5, i]).uniform(-math.pi, math.pi))
    return replace(truth, effects={**truth.effects, "periodic_disturbance": {**own, "phase": phase}})


def sane_run(
    truth: Truth, bench: Bench, drawn: Drawn, unmodelled: UnmodelledEffect | None, step: float
) -> BenchRun | None:
    """Return a run of an axis that moved, rested before each new level if it steps, and did not run away; else None."""
    try:
        run = run_one(truth, bench, drawn, unmodelled)
    except NumericalError:
        return None
    position = run.position
    if not np.abs(position).max() < REACH * step or np.ptp(position) < MOTION * np.ptp(bench.reference):
        return None
    ends = [*(np.flatnonzero(np.diff(bench.reference)) + 1).tolist(), position.size]
    if len(ends) > MOST_LEVELS:  # no steps: the reference itself never rests
        return run
    last = [position[end - max(end // 20, 20) : end] for end in ends if end > 200]
    return run if all(np.ptp(part) < UNREST * step for part in last) else None
