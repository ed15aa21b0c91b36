"""Whether a parameter of one axis drifts over the dates on which it was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from servolens.fleet.rows import parameters_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.fleet.rows import Row

    Values = NDArray[np.float64]

__all__ = ["Drift", "Trend", "drifts_of", "trend"]

FALSE_DISCOVERIES = 0.05
"""Share of false alarms among the drifts that are told (Benjamini and Hochberg 1995)."""
FEWEST_DATES = 3
DAY = 86400.0
BISECTIONS = 60


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """A straight line through measurements with error bars.

    Attributes
    ----------
    slope, stderr : float
        Change per unit of time, and its standard error.
    level : float
        The line at the mean of the times.
    scatter : float
        Standard deviation from day to day beyond the error bars.
    p : float
        Probability of such a slope, or a larger one, where nothing drifts.
    """

    slope: float
    stderr: float
    level: float
    scatter: float
    p: float


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drift:
    """One parameter of one axis over the dates.

    Attributes
    ----------
    axis, parameter, unit : str
        What drifts.
    measured : tuple of str
        Dates, in order.
    values, errors : tuple of float
        Of the parameter; an error that is not known is None.
    trend : Trend
        Per day.
    drifts : bool
        Whether the trend is significant among all that were tested in the fleet.
    """

    axis: str
    parameter: str
    unit: str
    measured: tuple[str, ...]
    values: tuple[float, ...]
    errors: tuple[float | None, ...]
    trend: Trend
    drifts: bool

    def to_json(self) -> dict[str, Any]:
        """Return the drift as it stands in ``servolens.fleet/1``."""
        slope = {"value": self.trend.slope, "stderr": self.trend.stderr, "unit": f"{self.unit} per day".strip()}
        return {
            "axis": self.axis,
            "parameter": self.parameter,
            "measured": list(self.measured),
            "values": list(self.values),
            "errors": list(self.errors),
            "unit": self.unit,
            "slope": slope,
            "scatter": self.trend.scatter,
            "p": self.trend.p,
            "drifts": self.drifts,
        }


def drifts_of(rows: Sequence[Row]) -> tuple[Drift, ...]:
    """Return the trends of all parameters that an axis has on three dates or more, the most significant first."""
    found = []
    for (parameter, unit), those in parameters_of(rows).items():
        axes: dict[str, list[tuple[str, float, float | None]]] = {}
        for row, value, error in those:
            if row["measured"]:
                axes.setdefault(str(row["axis"]), []).append((str(row["measured"]), value, error))
        for axis, points in axes.items():
            times, values, errors = zip(*sorted(points), strict=True)
            if len(set(times)) >= FEWEST_DATES:
                line = trend(days(times), np.array(values), np.array([e or 0.0 for e in errors]))
                found.append((line, axis, parameter, unit, times, values, errors))
    found.sort(key=lambda one: (one[0].p, one[1], one[2]))
    limit = _limit([one[0].p for one in found])
    return tuple(
        Drift(
            axis=axis, parameter=name, unit=unit, measured=times, values=values, errors=errors, trend=line,
            drifts=line.p <= limit,
        )
        for line, axis, name, unit, times, values, errors in found
    )  # fmt: skip


def days(measured: Sequence[str]) -> Values:
    """Return the days since the first of these dates, shape (n,)."""
    moments = [datetime.fromisoformat(text) for text in measured]
    return np.array([(moment - moments[0]).total_seconds() / DAY for moment in moments])


def trend(time: Values, value: Values, error: Values) -> Trend:
    """Fit a line to values with error bars and test its slope.

    The values scatter about the line by more than their error bars: an axis is not the same every day. The variance of
    that scatter is estimated (Paule and Mandel 1982) and added; the standard error of the slope follows from the
    weighted residuals, and its test is Student's (Knapp and Hartung 2003, DOI 10.1002/sim.1482), never narrower than
    the error bars alone allow.

    Parameters
    ----------
    time, value, error : ndarray, shape (n,)
        Times, two of them different, n ≥ 3; values; standard errors ≥ 0.

    Examples
    --------
    >>> line = trend(np.arange(6.0), np.array([1.0, 1.1, 1.21, 1.29, 1.42, 1.5]), np.full(6, 0.01))
    >>> round(line.slope, 3), line.p < 1e-4
    (0.101, True)
    """
    from scipy.stats import t as student

    unit = float(np.ptp(value)) or 1.0
    y, s = (value - value.mean()) / unit, error / unit
    scatter = _scatter(time, y, s)
    variance = s**2 + scatter
    if not variance.any():
        variance = np.ones_like(y)  # no errors known and all on one line
    weight = 1.0 / np.maximum(variance, np.finfo(float).tiny)
    line = _line(time, y, weight)
    freedom = len(y) - 2
    stderr = math.sqrt(max(line.excess / freedom, 1.0 if error.any() else 0.0) / line.spread)
    p = 2.0 * float(student.sf(abs(line.slope) / stderr, freedom)) if stderr > 0 else float(line.slope == 0)
    return Trend(
        slope=line.slope * unit, stderr=stderr * unit, level=line.level * unit + float(value.mean()),
        scatter=math.sqrt(scatter) * unit, p=p,
    )  # fmt: skip


class _Line(NamedTuple):
    """A line through weighted points: its value at the mean time, the weighted sums of squares of times and errors."""

    slope: float
    level: float
    spread: float
    excess: float


def _line(time: Values, y: Values, weight: Values) -> _Line:
    centre = float(np.average(time, weights=weight))
    spread = float(np.sum(weight * (time - centre) ** 2))
    middle = float(np.average(y, weights=weight))
    slope = float(np.sum(weight * (time - centre) * y)) / spread
    rest = y - middle - slope * (time - centre)
    at_mean = middle + slope * (float(time.mean()) - centre)
    return _Line(slope=slope, level=at_mean, spread=spread, excess=float(np.sum(weight * rest**2)))


def _scatter(time: Values, y: Values, error: Values) -> float:
    """Return the variance beyond the error bars with which the weighted sum of squares is what it should be."""
    freedom = len(y) - 2
    plain = _line(time, y, np.ones_like(y)).excess / freedom
    if not np.all(error > 0):
        return plain
    if _line(time, y, 1.0 / error**2).excess <= freedom:
        return 0.0
    low, high = 0.0, 10.0 * plain + float(np.max(error)) ** 2
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _line(time, y, 1.0 / (error**2 + middle)).excess > freedom:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _limit(probabilities: Sequence[float]) -> float:
    """Return the largest p that counts as a discovery among these, which are sorted; −1 for none."""
    count = len(probabilities)
    good = [p for rank, p in enumerate(probabilities, start=1) if p <= FALSE_DISCOVERIES * rank / count]
    return good[-1] if good else -1.0
