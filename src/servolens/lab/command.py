"""From the held command to what the motor feels: limit, dead band, delay, lag and drift, in closed form.

Beside the command a signal carries what shakes the axis, for both are given sample by sample.
"""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, final

from servolens.lab.laws import LAWS

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.truth import Truth

__all__ = ["Chain", "Segment", "Shake", "Signal"]

SAME_INSTANT = 1e-9
"""Share of the sample time below which a delayed command arrives at the sample itself."""


class Shake(NamedTuple):
    """A random acceleration during one sample: its value at the sample at `since`, and how it changes."""

    since: float
    value: Any
    slope: Any

    def at(self, t: Any) -> Any:
        """Return the acceleration at `t`."""
        return self.value + self.slope * (t - self.since)

    def take(self, lanes: Any) -> Shake:
        """Return that of some of many runs."""
        return Shake(self.since, self.value[lanes], self.slope[lanes])


@final
class Signal:
    """The effective command after its level has jumped: a lag that is solved exactly, times a drift."""

    __slots__ = ("drift", "initial", "lag", "level", "m", "shaking", "since")

    def __init__(
        self, level: Any, initial: Any, since: float, lag: float, drift: float, m: Any, shaking: Shake | None = None
    ) -> None:
        self.level, self.initial, self.since, self.lag, self.drift, self.m = level, initial, since, lag, drift, m
        self.shaking = shaking

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
        shaking = None if self.shaking is None else self.shaking.take(lanes)
        return Signal(self.level[lanes], self.initial[lanes], self.since, self.lag, self.drift, self.m, shaking)


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
        self._m = m
        self._held: list[tuple[Callable[..., Any], SimpleNamespace]] = [
            (law.function, own[name])
            for name, law in LAWS.items()
            if law.kind == "command" and name in own and law.function is not None
        ]
        self._delay, self._least = own["delay"].time if "delay" in own else 0.0, SAME_INSTANT * sample_time
        self._lag = own["actuator_lag"].time_constant if "actuator_lag" in own else 0.0
        self._drift = own["gain_drift"].rate if "gain_drift" in own else 0.0
        self._coming: deque[tuple[float, Any]] = deque()
        self._level: Any = None
        self._felt: Any = None

    def apply(self, t: float, length: float, asked: Any, shaking: Shake | None = None) -> list[Segment]:
        """Return what is felt from `t` to the next sample, `length` later, once `asked` has been asked for."""
        for function, p in self._held:
            asked = function(asked, p, self._m)
        if self._felt is None:
            self._felt = self._level = asked
        self._coming.append((t + self._delay, asked))
        segments, start, end = [], t, t + length
        while self._coming and self._coming[0][0] < end - self._least:
            arrival, level = self._coming.popleft()
            if arrival > start + self._least:
                segments.append(self._segment(start, arrival - start, shaking))
                start = arrival
            self._level = level
        segments.append(self._segment(start, length if start == t else end - start, shaking))
        return segments

    def _segment(self, start: float, length: float, shaking: Shake | None) -> Segment:
        signal = Signal(self._level, self._felt, start, self._lag, self._drift, self._m, shaking)
        self._felt = signal.lagged(start + length)
        return Segment(start, length, signal)
