"""Simulated steps of one gain, and what two neighbouring gains say about all gains between them.

Between two gains every signal of the loop (error, voltage) is taken as linear in the gain, give or take the
*departure*: twice the largest second difference over three equally spaced gains, within a quarter of the settling time
of the instant. It bounds the error of the linear interpolation wherever the signal's curvature is that of the three
gains (with a factor of eight in reserve), and also where its slope changes once, or where it jumps once, between them.
This is a measurement of the modulus of continuity, not a proof.

Where the motion is irregular (play that rattles, a limit cycle) single instants tell nothing, but largest and smallest
values over a quarter of the settling time do: these are held to their limits as well, by the departure that any of them
shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.settle import FEASIBLE, horizon, step_response
from servolens.errors import NumericalError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

    Span = tuple[float, float]

__all__ = ["EMPTY", "LEVELS", "Gain", "Loops", "between"]

EARLY = (1.25, 3.0)
"""Settling times watched at first: most gains that fail do so soon."""
LEVELS = len(EARLY) + 1
"""How often a step may be simulated, each time for longer; at last for the whole horizon."""
WINDOW = 0.25
"""Settling times over which a mean square of the error is taken, and around an instant in which bends are measured."""
CHANGE = 2.0
"""Departure over second difference; see the module."""
EMPTY = (1.0, 0.0)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signal:
    """A signal that has to stay within limits.

    Attributes
    ----------
    values : ndarray, shape (n,)
        From the first instant on that matters.
    lower, upper : float
        Limits.
    before : ndarray
        The signal before these instants.
    window : int
        Instants in a quarter of the settling time.
    only_excludes : bool
        Whether staying within the limits is necessary, but says nothing more.
    """

    values: NDArray[np.float64]
    lower: float
    upper: float
    before: NDArray[np.float64]
    window: int
    only_excludes: bool = False


@final
class Loops:
    """The models of one search, each in its loop."""

    def __init__(self, models: tuple[Plant, ...], spec: PDSpec) -> None:
        self.models, self.spec = models, spec
        self.count = 0

    def signals(self, model: Plant, kd: float, level: int) -> tuple[Signal, ...] | None:
        """Return what the spec watches of one model; None where the loop is unstable."""
        spec = self.spec
        watched = horizon(model, spec)  # in the end no sample more: a loop that swings up would be judged otherwise
        if level < len(EARLY):
            watched = min(EARLY[level] * spec.settling_time + 2.0 * spec.sample_time, watched)
        self.count += 1
        try:
            run = step_response(model, spec, kd, watched)
        except NumericalError:
            return None
        error = (spec.reference - run.position) / abs(spec.reference)
        first = int(np.searchsorted(run.time, spec.settling_time * (1 + 1e-9), side="right")) - 1
        late = error[first:].copy()
        late[0] = np.interp(spec.settling_time, run.time, error)
        before = error[:first]
        size = max(int(WINDOW * spec.settling_time / spec.sample_time), 1)
        found = [Signal(values=late, lower=-spec.band, upper=spec.band, before=before, window=size)]
        blocks = late[1 : 1 + (late.size - 1) // size * size].reshape(-1, size)
        means = np.sqrt(np.mean(blocks**2, axis=1))
        found.append(
            Signal(values=means, lower=-np.inf, upper=spec.band, before=means[:0], window=1, only_excludes=True)
        )
        if spec.overshoot is not None:
            beyond = -error * np.sign(spec.reference)
            found.append(Signal(values=beyond, lower=-np.inf, upper=spec.overshoot, before=error[:0], window=size))
        if spec.voltage_limit is not None:
            asked = run.voltage / spec.voltage_limit
            found.append(Signal(values=asked, lower=-1.0, upper=1.0, before=error[:0], window=size))
        return tuple(found)


@final
class Gain:
    """One gain, simulated as far as it was asked for."""

    __slots__ = ("_loops", "_unstable", "kd", "level", "signals", "worst")

    def __init__(self, kd: float, loops: Loops) -> None:
        self.kd = kd
        self.level = -1
        self.signals: tuple[tuple[Signal, ...], ...] = ()
        self.worst = np.inf
        self._unstable = LEVELS
        self._loops = loops

    def to(self, level: int) -> Gain:
        """Simulate for as long as `level` asks for.

        Of a loop that grows beyond all bounds only later, what was seen before that is kept.
        """
        if self.level < level < self._unstable:
            found = [self._loops.signals(model, self.kd, level) for model in self._loops.models]
            stable = tuple(one for one in found if one is not None)
            if len(stable) < len(found):
                self._unstable, self.worst = level, np.inf
            else:
                self.level, self.signals = level, stable
                self.worst = max(map(_excess, stable)) if self._unstable == LEVELS else np.inf
        return self

    def is_stable(self, level: int) -> bool:
        """Whether every loop stays within all bounds for as long as `level` asks for, as far as it was simulated."""
        return level < self._unstable

    @property
    def is_feasible(self) -> bool:
        """Whether the spec holds on all models as far as they were simulated."""
        return self.worst <= FEASIBLE


def _excess(signals: Sequence[Signal]) -> float:
    return max(
        float(max(np.max(s.values) - s.upper, s.lower - np.min(s.values))) for s in signals if not s.only_excludes
    )


def between(low: Gain, middle: Gain, high: Gain) -> tuple[list[Span], list[Span]]:
    """Return between which gains the spec may hold, and between which it does, by what three stable gains show.

    The three are equally spaced. They are compared as long as all of them were simulated.
    """
    may, does = [(0.0, 1.0), (0.0, 1.0)], [(0.0, 1.0), (0.0, 1.0)]
    for one, two, three in zip(low.signals, middle.signals, high.signals, strict=True):
        for signals in zip(one, two, three, strict=True):
            for half, (excluded, shown) in enumerate(_halves(*_cut(*signals))):
                may[half] = _common(may[half], excluded)
                does[half] = _common(does[half], shown)
    ends = ((low.kd, middle.kd), (middle.kd, high.kd))
    return _gains(may, ends), _gains(does, ends)


def _gains(shares: Sequence[Span], ends: Sequence[Span]) -> list[Span]:
    """Return the gains at `shares` of the ways between `ends`; the ends themselves exactly."""
    return [
        (p + s * (q - p) if s > 0.0 else p, p + t * (q - p) if t < 1.0 else q)
        for (s, t), (p, q) in zip(shares, ends, strict=True)
        if s <= t
    ]


def _halves(a: Signal, m: Signal, b: Signal) -> list[tuple[Span, Span]]:
    """Return for each half where the signal may be within its limits, and where it is."""
    departure = _departure(a, m, b)
    envelopes = [_envelope(signal) for signal in (a, m, b)]
    swing = _swing(*envelopes)
    found = []
    for p, q, first, last in ((a, m, *envelopes[:2]), (m, b, *envelopes[1:])):
        may = _common(_admissible(p, q, -departure), _admissible(first, last, -swing))
        does = max(_admissible(p, q, departure), _admissible(first, last, swing), key=_width)
        found.append((may, (0.0, 1.0) if a.only_excludes else does))
    return found


def _cut(a: Signal, m: Signal, b: Signal) -> tuple[Signal, Signal, Signal]:
    """Return the signals as long as the shortest of them."""
    size = min(a.values.size, m.values.size, b.values.size)
    one, two, three = (s if s.values.size == size else replace(s, values=s.values[:size]) for s in (a, m, b))
    return one, two, three


def _departure(a: Signal, m: Signal, b: Signal) -> NDArray[np.float64]:
    """Return by how much the signal may depart from straight lines, at each instant."""
    size = a.window
    bends = np.abs(m.values - 0.5 * (a.values + b.values))
    blocks = np.zeros(-(-bends.size // size) * size)
    blocks[: bends.size] = bends
    largest = blocks.reshape(-1, size).max(axis=1)
    before = np.abs(m.before[-size:] - 0.5 * (a.before[-size:] + b.before[-size:])).max(initial=0.0)
    around = np.maximum(largest, np.concatenate([[before], largest[:-1]]))
    around[:-1] = np.maximum(around[:-1], largest[1:])
    found: NDArray[np.float64] = CHANGE * np.repeat(around, size)[: bends.size]
    return found


def _envelope(signal: Signal) -> Signal:
    """Return the largest and the smallest value in each window, as a signal of its own."""
    size = signal.window
    values = np.append(signal.values, np.full(-signal.values.size % size, signal.values[-1])).reshape(-1, size)
    return replace(signal, values=np.concatenate([values.max(axis=1), values.min(axis=1)]))


def _swing(a: Signal, m: Signal, b: Signal) -> NDArray[np.float64]:
    bend = np.abs(m.values - 0.5 * (a.values + b.values)).max()
    return np.full(m.values.size, CHANGE * bend)


def _width(span: Span) -> float:
    return span[1] - span[0]


def _common(one: Span, other: Span) -> Span:
    return max(one[0], other[0]), min(one[1], other[1])


def _admissible(p: Signal, q: Signal, reserve: NDArray[np.float64]) -> Span:
    """Return on which part of the way from `p` to `q` the straight line is within its limits, less the `reserve`."""
    upper, lower = p.upper + FEASIBLE - reserve, p.lower - FEASIBLE + reserve
    binds = (p.values > upper) | (q.values > upper) | (p.values < lower) | (q.values < lower)
    if not binds.any():
        return 0.0, 1.0
    start, change = p.values[binds], q.values[binds] - p.values[binds]
    above, below = upper[binds] - start, lower[binds] - start
    if np.any(above < below):
        return EMPTY
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = below / change, above / change
    return float(np.max(np.fmin(one, other), initial=0.0)), float(np.min(np.fmax(one, other), initial=1.0))
