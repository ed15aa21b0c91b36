"""Every interval of gains that meets the spec, between 0 and the end of the search.

The range is divided into cells, finer where the loop changes faster with the gain. In each, three simulated gains tell
where the spec holds, where it does not, and what remains open (:mod:`servolens.design.trials`); what remains open is
divided further, down to a stated width.
"""

from __future__ import annotations

from heapq import heappop, heappush
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.trials import LEVELS, Gain, Loops, between

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

    Span = tuple[float, float]

__all__ = ["SPARE", "Cover", "gain_scale", "last_gain"]

CELLS = 8
"""Cells that the search begins with, for each unit of asinh(kd / scale)."""
FINEST = 2.0**-12
"""Gap over the scale of the loop; beyond eight scales the gap grows with the gain."""
EDGE = 2.0**-5
"""Width over the gap within which the end of an interval is located where the signals are smooth."""
EFFORT = 1000
"""After so many simulations of each model nothing is divided any more: an irregular motion has no end of detail."""
SPARE = 2.0
"""How far beyond the largest gain that a linear loop could use the search goes, where its end is not given."""


def gain_scale(plant: Plant, spec: PDSpec) -> float:
    """Return the change of Kd over which the loop changes within the settling time [V s/m].

    A pole moves by about gain/2 per unit of Kd, and the loop's own frequency is ω = √(gain·kp), of a cascade kp: the
    smaller of ω/gain and 2/(gain·settling time).
    """
    return float(min(spec.rate(plant.gain), 2.0 / spec.settling_time) / abs(plant.gain))


def last_gain(plant: Plant, spec: PDSpec) -> float:
    """Return a Kd beyond which the loop cannot be fast enough, rounded up to two digits.

    An overdamped loop creeps with exp(−kp t/(Kd + damping/gain)): Kd may be no larger than kp·t/ln(1/band), or than
    about twice ω/gain, where the poles of a linear loop meet. The search goes twice as far. A cascade does not become
    slow with Kv: there it ends where the speed loop alone is unstable, at 2/(gain·h), for its speed is the mean over
    the last sample.
    """
    gain = abs(plant.gain)
    if spec.controller == "cascade":
        return _rounded_up(2.0 / (gain * spec.sample_time))
    creeping = spec.kp * spec.settling_time / np.log(1.0 / spec.band)
    meeting = 2.0 * np.sqrt(spec.kp / gain)
    return _rounded_up(SPARE * max(creeping, meeting))


def _rounded_up(last: float) -> float:
    """Return the number with two digits."""
    digits = 10.0 ** (np.floor(np.log10(last)) - 1)
    return float(f"{np.ceil(last / digits - 1e-9) * digits:.6g}")


@final
class Cover:
    """The search.

    Parameters
    ----------
    models : tuple of Plant
        All of them have to meet the spec.
    spec : PDSpec
        With an end of the search.
    progress : callable, optional
        Called with (description, done, total).
    """

    def __init__(
        self, models: tuple[Plant, ...], spec: PDSpec, progress: Callable[[str, int, int], None] | None = None
    ) -> None:
        assert spec.kd_max is not None  # noqa: S101 - stated by the caller
        self.top = spec.kd_max
        self.loops = Loops(models, spec)
        self.scale = min(*(gain_scale(model, spec) for model in models), self.top)
        self._found: list[Span] = []
        self._sure: list[Span] = []
        self._coarser = 1.0
        self._open: list[tuple[float, int, tuple[Gain, Gain, Gain]]] = []
        self._count = 0
        self._progress = progress

    @property
    def gap(self) -> float:
        """The largest width of what is left open so far [V s/m]."""
        return self._gap(self.top)

    def grid(self) -> list[float]:
        """Return the ends of the cells that the search begins with."""
        reach = float(np.arcsinh(self.top / self.scale))
        count = int(np.ceil(CELLS * max(reach, 1.0)))
        inner = self.scale * np.sinh(np.linspace(0.0, reach, count + 1)[1:-1])
        return [0.0, *(float(kd) for kd in inner), self.top]

    def intervals(self) -> tuple[Span, ...]:
        """Return the feasible intervals; their ends were simulated and meet the spec."""
        ends = [self._gain(kd) for kd in self.grid()]
        for low, high in pairwise(ends):
            self._divide(low, high)
        effort = EFFORT * len(self.loops.models)
        while self._open:
            width, _, three = heappop(self._open)
            if self.loops.count > effort:
                self._coarser = max(self._coarser, -width)
            self._resolve(three)
            if self._progress is not None:
                self._progress("searching gains", min(self.loops.count, effort), effort)
        found = [self._ends(span) for span in self._merged()]
        return tuple(span for span in found if span is not None)

    def _gain(self, kd: float) -> Gain:
        return Gain(kd, self.loops)

    def _gap(self, kd: float) -> float:
        return FINEST * self._coarser * max(self.scale, 0.125 * kd)

    def _divide(self, low: Gain, high: Gain) -> None:
        """Leave open what lies between two gains."""
        three = (low, self._gain(0.5 * (low.kd + high.kd)), high)
        width = (high.kd - low.kd) / (FINEST * max(self.scale, 0.125 * low.kd))
        self._count += 1
        heappush(self._open, (-width, self._count, three))

    def _resolve(self, three: tuple[Gain, Gain, Gain]) -> None:
        """Note where in a cell the spec holds, and leave open where that is not known."""
        low, middle, high = three
        width = high.kd - low.kd
        if width <= EDGE * self._gap(low.kd):
            self._sample(three)
            return
        left: list[Span] = [(low.kd, high.kd)]
        known: list[Span] = []
        for level in range(LEVELS):
            stable = [gain.to(level).is_stable(level) for gain in three]
            if not any(stable):
                return
            if not all(stable):
                break
            may, does = between(*three)
            known = does if level == LEVELS - 1 else []
            left = _without(may, known)
            if _length(left) <= 0.5 * width or not any(gain.is_feasible for gain in three):
                break
        self._found += known
        self._sure += known
        if _length(left) > 0.5 * width and width <= self._gap(low.kd):
            self._sample(three)
        elif _length(left) > 0.5 * width:
            self._divide(low, middle)
            self._divide(middle, high)
        else:
            for span in left:
                self._resolve_between(span, three, known)

    def _resolve_between(self, span: Span, three: tuple[Gain, ...], known: list[Span]) -> None:
        """Leave open what is left of a cell, unless it is narrow and beside gains that are `known` to do."""
        touches = any(a <= span[1] and span[0] <= b for a, b in known)
        narrow = span[1] - span[0] <= EDGE * self._gap(span[0])
        is_hole = any(b == span[0] for _, b in known) and any(a == span[1] for a, _ in known)
        if touches and narrow and not is_hole:
            return
        low, high = (next((g for g in three if g.kd == kd), None) or self._gain(kd) for kd in span)
        self._divide(low, high)

    def _sample(self, three: tuple[Gain, ...]) -> None:
        """Decide a cell that is as narrow as the gap by its three gains."""
        fits = [gain.to(LEVELS - 1).is_feasible for gain in three]
        self._found += [(gain.kd, gain.kd) for gain, fit in zip(three, fits, strict=True) if fit]
        for i in range(2):
            if fits[i] and fits[i + 1]:
                self._found.append((three[i].kd, three[i + 1].kd))

    def _merged(self) -> list[Span]:
        """Return the intervals; of those that only samples tell of, not what is narrower than the gap, if others do."""
        merged: list[Span] = []
        for low, high in sorted(self._found):
            if merged and low <= merged[-1][1]:
                merged[-1] = (merged[-1][0], max(merged[-1][1], high))
            else:
                merged.append((low, high))
        ends = {low for low, _ in self._sure}
        solid = [(a, b) for a, b in merged if b - a > self._gap(a) or any(a <= low <= b for low in ends)]
        return solid or merged

    def _ends(self, span: Span) -> Span | None:
        """Return the interval with ends that were simulated for the whole horizon."""
        inner = 0.5 * (span[0] + span[1])
        low, high = self._end(span[0], inner), self._end(span[1], inner)
        return None if low is None or high is None else (low, high)

    def _end(self, kd: float, inner: float) -> float | None:
        """Return the gain nearest to `kd` that meets the spec, on the way to one inside."""
        if self._fits(kd):
            return kd
        if not self._fits(inner):
            return None
        while abs(inner - kd) > 0.01 * self._gap(kd):
            middle = 0.5 * (kd + inner)
            kd, inner = (kd, middle) if self._fits(middle) else (middle, inner)
        return inner

    def _fits(self, kd: float) -> bool:
        return self._gain(kd).to(LEVELS - 1).is_feasible


def _length(spans: list[Span]) -> float:
    return sum(high - low for low, high in spans)


def _without(spans: list[Span], taken: list[Span]) -> list[Span]:
    """Return what is left of `spans` without the inside of those `taken`, pieces that touch joined."""
    left = spans
    for low, high in taken:
        left = [piece for a, b in left for piece in ((a, min(b, low)), (max(a, high), b)) if piece[0] < piece[1]]
    joined: list[Span] = []
    for a, b in left:
        if joined and joined[-1][1] == a:
            joined[-1] = (joined[-1][0], b)
        else:
            joined.append((a, b))
    return joined
