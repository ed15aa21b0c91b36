"""How fast a plant is, and so how many substeps a sample needs."""

from __future__ import annotations

from functools import lru_cache
from math import ceil, isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = [
    "MOST_SUBSTEPS",
    "contact_rate",
    "fixed_substeps_for",
    "least_substeps",
    "pieces_for",
    "rate_of",
    "rate_within",
    "step_times_rate",
    "substeps_for",
    "work_of",
]

STEP_TIMES_RATE = 0.05
"""Largest product of substep and the plant's fastest rate: about 20 nm on a 0.1 m step. Where a force changes faster
than that, as a damping that hangs on the speed does, a step is halved; see :mod:`servolens.simulation.motion`."""
FINE_STEP_TIMES_RATE = 0.02
"""The same of steps that are never halved, and beside a state that relaxes: what that errs by is not seen."""
RAMPED = 1.0 / 15.0
"""Share of √(damping × rate at which a state relaxes) that counts: about 20 nm on a 0.1 m step as well, measured."""
FINE_SUBSTEPS = 8
STIFF_STEP_TIMES_RATE = 0.25
"""The same where more than eight substeps would be needed: so fast a mode dies out within the sample."""
STAMP_ROUNDING = 1e-9
"""Of a substep: what rounding makes of differences between the instants of a log asks for no further one."""
MOST_SUBSTEPS = 400
"""What needs more is simulated with as many, and no longer exactly."""
CONTACT_SUBSTEPS = 4
"""Of a sample in which contacts may close, at least; where one does, steps are halved as well. Within 20 nm on a 0.1 m
step with a load of a third, a micrometre with a light one; an axis that hunts in its gap multiplies that."""
BESIDE_SUBSTEPS = 2
"""Substeps that take as long as all else that is done for a sample, whitening and sums of squares most of it: measured
over diagnoses, 28 ns each beside 56 ns."""
CLOSED_STEP_TIMES_RATE = 0.5
"""Product of a piece into which closed contacts split a step and their rate without damping, measured."""
IN_CONTACTS = 2
"""A piece of a substep that contacts may split takes as long as so many substeps of others: 60 ns."""
PROBES = (
    *((0.0, speed, 0.0) for speed in (0.0, 0.01, 0.1, 1.0)),
    *((0.1, 1.0, 0.0), (1.0, 0.0, 1.0), (-1.0, 0.0, -1.0)),
)
"""Positions, speeds and values of the states at which the rates are looked at, SI."""


class _Rates(NamedTuple):
    """Fastest rate, with closed contacts, the same without damping, largest damping, and how far that differs [1/s]."""

    fastest: float
    undamped: float
    damping: float
    differs: float


def substeps_for(plant: Plant, step: float, extra: float = 0.0) -> int:
    """Return how many substeps a sample of `step` seconds needs; `extra` [1/s] is a rate beside the plant's own.

    Contacts ask for a few: where one closes, a step is split, and is halved until it is short enough for the contact.
    """
    substeps = _substeps(step, rate_of(plant) + extra, step_times_rate(plant.structure))
    return min(max(substeps, least_substeps(plant, step)), MOST_SUBSTEPS)


def least_substeps(plant: Plant, step: float) -> int:
    """Return how many substeps contacts ask for: none is longer than they take to open; 1 if there are none."""
    rate = contact_rate(plant.structure)
    return max(CONTACT_SUBSTEPS, ceil(step * rate - STAMP_ROUNDING)) if rate > 0.0 else 1


def pieces_for(plant: Plant, step: float, substeps: int) -> int:
    """Return into how many pieces contacts split a sample of `step` seconds and so many `substeps` while they push."""
    if contact_rate(plant.structure) == 0.0:
        return substeps
    pieces = step * _rates(plant.structure)(plant.driven_values).undamped / CLOSED_STEP_TIMES_RATE
    return max(substeps, ceil(pieces) if pieces < MOST_SUBSTEPS else MOST_SUBSTEPS)


def fixed_substeps_for(plant: Plant, step: float) -> int:
    """Return how many substeps it takes where none is split, and damping is no matter of the step's formula."""
    rates = _rates(plant.structure)(plant.driven_values)
    return _substeps(
        step, max(rates.fastest, rates.differs, contact_rate(plant.structure)) + rates.damping, FINE_STEP_TIMES_RATE
    )


def _substeps(step: float, rate: float, most: float) -> int:
    if not isfinite(step * rate):
        return MOST_SUBSTEPS
    fine, coarse = (ceil(step * rate / each - STAMP_ROUNDING) for each in (most, STIFF_STEP_TIMES_RATE))
    return min(max(min(fine, FINE_SUBSTEPS), coarse, 1), MOST_SUBSTEPS)


def rate_within(substeps: float, step: float) -> float:
    """Return the fastest rate [1/s] that so many `substeps` of a sample of `step` seconds allow, eight or more."""
    return substeps * STIFF_STEP_TIMES_RATE / step


def work_of(plant: Plant, samples: int, step: float, substeps: int) -> int:
    """Return the cost of simulating and comparing samples of `step` seconds; 1 is a sample with one substep."""
    price = IN_CONTACTS if contact_rate(plant.structure) > 0.0 else 1
    steps = price * pieces_for(plant, step, substeps)
    return samples * (BESIDE_SUBSTEPS + steps) // (BESIDE_SUBSTEPS + 1)


def rate_of(plant: Plant) -> float:
    """Return the fastest rate [1/s] of what a step of a plant does not solve exactly or split, or one beyond it.

    That is the rate without its contacts.
    """
    structure, places = _without_contacts(plant.structure)
    return _rates(structure)(tuple(plant.driven_values[i] for i in places) if places else plant.driven_values).fastest


@lru_cache(maxsize=256)
def step_times_rate(structure: tuple[type[Effect], ...]) -> float:
    """Return the largest product of substep and fastest rate of a structure, less where one of its states relaxes."""
    relaxes = any(state.relaxes for cls in structure for state in cls.states)
    return FINE_STEP_TIMES_RATE if relaxes else STEP_TIMES_RATE


@lru_cache(maxsize=256)
def contact_rate(structure: tuple[type[Effect], ...]) -> float:
    """Return the rate [1/s] of the usual contact of what a structure may close; 0 if it closes none."""
    return max((cls.contact_rate for cls in structure), default=0.0)


@lru_cache(maxsize=256)
def _without_contacts(
    structure: tuple[type[Effect], ...],
) -> tuple[tuple[type[Effect], ...], tuple[int, ...]]:
    """Return a structure without effects that close contacts, and where its own are among a plant's values.

    No places where it has none of these.
    """
    if contact_rate(structure) == 0.0:
        return structure, ()
    kept, places, at = [], [0, 1], 2  # gain and damping come first
    for cls in structure:
        end = at + len(cls.parameters())
        if cls.contact_rate == 0.0:
            kept.append(cls)
            places += range(at, end)
        at = end
    return tuple(kept), tuple(places)


@lru_cache(maxsize=256)
def _rates(structure: tuple[type[Effect], ...]) -> Callable[[tuple[float, ...]], _Rates]:
    """Return a function of the parameters: the rates of the axis."""
    from servolens.simulation.native import native

    code = native(structure)
    quick = contact_rate(structure) == 0.0
    smooth, relaxing = code.sizes
    n = 2 + smooth + relaxing
    probes = [_probe(n + relaxing, *probe) for probe in PROBES]
    exact = np.array([2 + i for i, place in enumerate(code.order) if place >= smooth], dtype=np.intp)

    def jacobian(x: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.empty(n * n)
        code.slopes(x.ctypes.data, p.ctypes.data, out.ctypes.data)
        return out.reshape(n, n).T

    @lru_cache(maxsize=1024)
    def rates(values: tuple[float, ...]) -> _Rates:
        p = np.array(values)
        slopes = np.array([jacobian(probe, p) for probe in probes])
        slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
        damping = -slopes[:, 1, 1]
        differs = float(np.ptp(damping)) if damping.size else 0.0
        return _Rates(*_rate(slopes, exact, quick=quick), float(np.max(damping, initial=0.0)), differs)

    return rates


def _probe(size: int, position: float, velocity: float, state: float) -> NDArray[np.float64]:
    """Return the kernel's [y, v, t, u, d, moving, shaking, states, ramps]."""
    return np.array([position, velocity, 0.0, 0.0, 1.0, 1.0, 0.0, *([state] * (size - 2))])


def _rate(slopes: NDArray[np.float64], exact: NDArray[np.intp], *, quick: bool) -> tuple[float, float]:
    """Return the fastest rate of the Jacobians `slopes`, shape (k, n, n), of what a step does not solve exactly.

    And that without damping. A step solves a damping and how relaxing states forget, and is halved where the damping
    changes. Of it there counts,
    beside a spring, a mean with the spring's rate, where that is less than the rate of both together; and a share of
    the geometric mean with the rate of a relaxing state, which a step sees as a ramp. With `quick` a bound of a
    spring's rate does, which is three times too large for a critically damped contact.
    """
    slope, left = slopes[:, 1, 1], slopes.copy()
    damping = float(np.max(-slope, initial=0.0))
    forgets = float(np.max(np.abs(slopes[:, exact, exact]) * (slopes[:, 1, exact] != 0.0), initial=0.0))
    left[:, exact, exact] = 0.0
    together = _largest(left, quick)
    left[:, 1, 1] = 0.0
    rest = _largest(left, quick)
    beside = min(together, float(np.cbrt(rest * rest * damping)))
    return max(rest, beside, float(RAMPED * np.sqrt(damping * forgets))), rest


def _largest(slopes: NDArray[np.float64], quick: bool) -> float:
    """Return the largest eigenvalue in size, or a bound of it; 0 where there is no Jacobian."""
    if quick and slopes.shape[1] == 2:
        return float(np.max(np.abs(slopes[:, 1, 1]) + np.sqrt(np.abs(slopes[:, 1, 0])), initial=0.0))
    return float(np.max(np.abs(np.linalg.eigvals(slopes)), initial=0.0))
