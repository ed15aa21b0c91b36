"""From the held command to what the motor feels: limit, dead band, delay, lag and drift, in closed form."""

from __future__ import annotations

import math
from collections import deque
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, final

from servolens.lab.laws import LAWS

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.truth import Truth

__all__ = ["Chain", "Segment", "Signal"]


@final
class Signal:
    """The effective command after its level has jumped: a lag that is solved exactly, times a drift."""

    __slots__ = ("drift", "initial", "lag", "level", "m", "since")

    def __init__(self, level: Any, initial: Any, since: float, lag: float, drift: float, m: Any) -> None:
        self.level, self.initial, self.since, self.lag, self.drift, self.m = level, initial, since, lag, drift, m

    def __call__(self, t: Any) -> Any:
        """Return the command felt at `t`, not before the jump."""
        value = self.lagged(t) if self.lag else self.level
        return value * (1.0 + self.drift * t) if self.drift else value

    def lagged(self, t: Any) -> Any:
        """Return the command behind the lag, before the drift."""
        if not self.lag:
            return self.level
        return self.level + (self.initial - self.level) * self.m.exp((self.since - t) / self.lag)

    def longest(self, t: Any, step: float) -> Any:
        """Return the longest step from `t` that follows the lag; short ones, but never more than a few dozen."""
        m, lag = self.m, self.lag
        passed = t - self.since
        if not lag or lag > 5.0 * step:
            return step + 0.0 * passed
        near = 0.2 * lag + passed * passed / (60.0 * lag)
        return m.where(self.initial == self.level, step, m.minimum(near, step))

    def take(self, lanes: Any) -> Signal:
        """Return the signal of some of many runs."""
        return Signal(self.level[lanes], self.initial[lanes], self.since, self.lag, self.drift, self.m)


class Segment(NamedTuple):
    """A stretch of a sample with one level of the command."""

    start: float
    length: float
    signal: Signal


@final
class Chain:
    """The actuator chain of one axis; remembers what is on its way.

    Before the record the first voltage was applied for ever: nothing else is on its way, and a lag has settled.
    """

    def __init__(self, truth: Truth, m: Any, sample_time: float) -> None:
        own = {name: SimpleNamespace(**values) for name, values in truth.effects.items()}
        self._m, self._h = m, sample_time
        self._held: list[tuple[Callable[..., Any], SimpleNamespace]] = [
            (law.function, own[name])
            for name, law in LAWS.items()
            if law.kind == "command" and name in own and law.function is not None
        ]
        late = own["delay"].time / sample_time if "delay" in own else 0.0
        self._late = math.floor(late + 1e-9)
        self._within = max(late - self._late, 0.0) if late - self._late > 1e-9 else 0.0
        self._lag = own["actuator_lag"].time_constant if "actuator_lag" in own else 0.0
        self._drift = own["gain_drift"].rate if "gain_drift" in own else 0.0
        self._past: deque[Any] = deque(maxlen=self._late + 2)
        self._felt: Any = None

    def apply(self, t: float, asked: Any) -> list[Segment]:
        """Return what is felt from `t` to the next sample, once `asked` has been asked for."""
        for function, p in self._held:
            asked = function(asked, p, self._m)
        if self._felt is None:
            self._felt = asked
            self._past.extend([asked] * (self._late + 2))
        self._past.append(asked)
        before, after = self._past[0], self._past[1]
        if not self._within:
            return [self._segment(t, self._h, after)]
        first = self._within * self._h
        return [self._segment(t, first, before), self._segment(t + first, self._h - first, after)]

    def _segment(self, start: float, length: float, level: Any) -> Segment:
        signal = Signal(level, self._felt, start, self._lag, self._drift, self._m)
        self._felt = signal.lagged(start + length)
        return Segment(start, length, signal)
