"""Whether what shakes an axis is as strong all the time, as the noise model has it, or comes in bursts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.score import FALSE_ALARM
from servolens.identification.structure import BLOCKS, TESTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.identification.score import ScoreTest

__all__ = ["Burst", "burst_of"]


@final
@dataclass(frozen=True, slots=True)
class Burst:
    """Where what shakes an axis is strongest: number of the record, and time of its log [s]."""

    record: int
    time: float


def burst_of(test: ScoreTest) -> Burst | None:
    """Return the strongest burst of what shakes the axis; None where it is as strong all the time.

    Knocks, a friction that comes and goes, and counts that an encoder loses leave innovations most of which are small
    and a few large. Compared is the kurtosis of the sums over blocks of samples, which is 3 for steady noise (Anscombe
    and Glynn 1983, doi:10.1093/biomet/70.1.227), with that of draws of the same loop: there as well an axis that sticks
    is shaken less while it rests.

    Parameters
    ----------
    test : ScoreTest
        Of an axis that is shaken.
    """
    from scipy.stats import t

    level = FALSE_ALARM / TESTS / len(BLOCKS)
    ends = np.cumsum([0, *(run.samples for run in test.runs)])
    for size in BLOCKS:
        firsts = np.concatenate([np.arange(a, b - size + 1, size) for a, b in pairwise(ends)])
        if firsts.size < 2:
            continue
        sums = _sums(test.left, firsts, size)
        drawn = np.array([_log_kurtosis(_sums(one, firsts, size)) for one in test.drawn.T])
        away = (_log_kurtosis(sums) - np.mean(drawn)) / (np.std(drawn, ddof=1) * np.sqrt(1.0 + 1.0 / drawn.size))
        if t.sf(away, drawn.size - 1) < level:
            first = int(firsts[np.argmax(np.abs(sums))])
            record = int(np.searchsorted(ends, first, side="right")) - 1
            return Burst(record, float(test.runs[record].instants[first - ends[record]]))
    return None


def _sums(residual: NDArray[np.float64], firsts: NDArray[np.intp], size: int) -> NDArray[np.float64]:
    return np.asarray(np.sum(residual[firsts[:, None] + np.arange(size)], axis=1))


def _log_kurtosis(sums: NDArray[np.float64]) -> float:
    return float(np.log(float(np.mean(sums**4)) / max(float(np.mean(sums**2)) ** 2, 1e-300)))
