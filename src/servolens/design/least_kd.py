"""The least derivative gain for a spec: every feasible interval, then CasADi in each, then the exact loop.

Settling time jumps as a function of the gain, and the feasible set need not be an interval. The constraints themselves
are continuous in the gain, so they are followed over the whole range: a cell between two gains is closed only when its
ends are further from the limit than the constraints can have moved in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.program import local_optimum
from servolens.design.settle import FEASIBLE, constraint_signals, evaluate
from servolens.design.spec import Design
from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["tune"]

CELLS = 256
"""Cells that the search begins with."""
NARROWEST = 2.0**-14
"""Share of the range below which a cell is not divided further: the certificate's gap."""
CURVATURE = 1.5
"""How much further than its ends tell the constraints may have moved inside a cell."""
LATE = "the gains that meet the spec at first leave the band again later"
EDGE = 1e-6
"""Share of the range within which an interval's end is located."""


def tune(
    plants: Plant | Sequence[Plant], spec: PDSpec, *, progress: Callable[[str, int, int], None] | None = None
) -> Design:
    """Return the least Kd that meets `spec` on all `plants`, and every interval of gains that does.

    Parameters
    ----------
    plants : Plant or sequence of Plant
        One model, or several that must all meet the spec.
    spec : PDSpec
        What to reach.
    progress : callable, optional
        Called with (description, done, total).

    Returns
    -------
    Design
        ``feasible`` is False, with a reason, where no gain in the range meets the spec.

    Raises
    ------
    InputError
        If no plant is given or their units differ.

    Examples
    --------
    >>> from servolens import Plant, PDSpec
    >>> design = tune(Plant(gain=1.7866, damping=4.5866), PDSpec(kp=100, settling_time=0.5, control="continuous"))
    >>> round(design.kd, 2)
    6.28
    """
    models = tuple(plants) if isinstance(plants, Sequence) else (plants,)
    if not models:
        raise InputError("no model was given; a design needs at least one")
    if len({(m.length_unit, m.command_unit) for m in models}) > 1:
        raise InputError("the models have different units; a gain cannot hold for all of them")
    search = _Search(models, spec, progress)
    intervals = search.intervals()
    gap = spec.kd_max * NARROWEST
    if not intervals:
        return Design(spec=spec, kd=None, intervals=(), gap=gap, reason=search.reason())
    checked = [(interval, tuple(evaluate(model, spec, interval[0]) for model in models)) for interval in intervals]
    kept = [(interval, seen) for interval, seen in checked if all(response.meets for response in seen)]
    if not kept:
        return Design(spec=spec, kd=None, intervals=(), gap=gap, reason=LATE)
    intervals = tuple(interval for interval, _ in kept)
    return Design(
        spec=spec,
        kd=intervals[0][0],
        intervals=intervals,
        gap=gap,
        candidates=tuple(_candidate(models, spec, interval) for interval in intervals),
        verified=kept[0][1],
    )


@final
class _Search:
    """Follows all constraints over the range of gains."""

    def __init__(
        self, models: tuple[Plant, ...], spec: PDSpec, progress: Callable[[str, int, int], None] | None
    ) -> None:
        self.models, self.spec, self.progress = models, spec, progress
        self.worst: dict[float, float] = {}

    def signals(self, kd: float) -> NDArray[np.float64]:
        """All constraints of all models at `kd`; infinite where a loop is unstable."""
        parts = []
        for model in self.models:
            try:
                parts.append(constraint_signals(model, self.spec, kd))
            except NumericalError:
                parts.append(np.array([np.inf]))
        together = np.concatenate(parts)
        self.worst[kd] = float(together.max())
        return together

    def intervals(self) -> tuple[tuple[float, float], ...]:
        """Return the feasible intervals, their ends located from inside."""
        top = self.spec.kd_max
        grid = np.linspace(0.0, top, CELLS + 1)
        before = self.signals(0.0)
        for i in range(CELLS):
            after = self.signals(float(grid[i + 1]))
            self._divide(float(grid[i]), float(grid[i + 1]), before, after)
            before = after
            if self.progress is not None:
                self.progress("searching gains", i + 1, CELLS)
        gains = np.array(sorted(self.worst))
        inside = np.array([self.worst[g] <= FEASIBLE for g in gains])
        starts = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
        stops = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]]))
        return tuple(
            (self._edge(gains, int(a), -1), self._edge(gains, int(b), 1)) for a, b in zip(starts, stops, strict=True)
        )

    def reason(self) -> str:
        """Say why nothing is feasible, with the gain that comes closest."""
        if any(model.gain < 0 for model in self.models):
            return "the plant's gain is negative, so a positive kp drives the axis away; invert the command"
        best = min(self.worst, key=lambda kd: self.worst[kd])
        response = evaluate(self.models[0], self.spec, best) if np.isfinite(self.worst[best]) else None
        if response is None:
            return f"the loop is unstable for every kd in [0, {self.spec.kd_max:g}]"
        settled = "does not settle" if response.settling_time is None else f"settles in {response.settling_time:.4g} s"
        return (
            f"no kd in [0, {self.spec.kd_max:g}] meets the spec; the closest, kd = {best:.4g}, {settled}, "
            f"overshoots by {100 * response.overshoot:.3g} % and asks for {response.peak_voltage:.4g} V"
        )

    def _divide(self, low: float, high: float, at_low: NDArray[np.float64], at_high: NDArray[np.float64]) -> None:
        """Close the cell, or halve it."""
        if high - low <= self.spec.kd_max * NARROWEST:
            return
        a, b = self.worst[low], self.worst[high]
        if at_low.size == at_high.size and np.isfinite(a) and np.isfinite(b):
            moved = CURVATURE * float(np.abs(at_high - at_low).max())
            if (a > 0) == (b > 0) and abs(a) + abs(b) > moved:
                return
        elif not (np.isfinite(a) or np.isfinite(b)):
            return
        middle = 0.5 * (low + high)
        between = self.signals(middle)
        self._divide(low, middle, at_low, between)
        self._divide(middle, high, between, at_high)

    def _edge(self, gains: NDArray[np.float64], index: int, side: int) -> float:
        """Bisect between a feasible gain and its infeasible neighbour; the range's own end has none."""
        other = index + side
        good = float(gains[index])
        if not 0 <= other < gains.size:
            return good
        bad = float(gains[other])
        while abs(good - bad) > self.spec.kd_max * EDGE:
            middle = 0.5 * (good + bad)
            self.signals(middle)
            good, bad = (middle, bad) if self.worst[middle] <= FEASIBLE else (good, middle)
        return good


def _candidate(models: tuple[Plant, ...], spec: PDSpec, interval: tuple[float, float]) -> float | None:
    """Local optimum of the nonlinear programs in `interval`: the largest over the models, which all must hold."""
    found = [local_optimum(model, spec, interval) for model in models]
    return None if any(kd is None for kd in found) else max(kd for kd in found if kd is not None)
