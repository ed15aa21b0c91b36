"""Whether what shakes an axis is as strong all the time, as the noise model has it, or comes in bursts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.score import FALSE_ALARM
from servolens.identification.structure import BLOCKS, FEWEST_BLOCKS, TESTS, first_samples, standing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.identification.score import ScoreTest

__all__ = ["Burst", "burst_of", "knock_of"]


@final
@dataclass(frozen=True, slots=True)
class Burst:
    """Where what shakes an axis is strongest: number of the record, and time since that began [s]."""

    record: int
    time: float


def burst_of(test: ScoreTest) -> Burst | None:
    """Return the strongest burst of what shakes the axis; None where it is as strong all the time.

    Knocks, a friction that comes and goes, and counts that an encoder loses leave innovations most of which are small
    and a few large. Compared is the kurtosis of the sums over blocks of samples, which is 3 for steady noise, as the
    normal variable that Anscombe and Glynn make of it (1983, doi:10.1093/biomet/70.1.227), with that of draws of the
    same loop: there as well an axis that sticks is shaken less while it rests.

    Parameters
    ----------
    test : ScoreTest
        Of an axis that is shaken.
    """
    from scipy.stats import kurtosistest, t

    level = FALSE_ALARM / TESTS / len(BLOCKS)
    samples = [run.samples for run in test.runs]
    found: list[tuple[float, int]] = []
    for size in BLOCKS:
        firsts = np.concatenate(first_samples(samples, size))
        if firsts.size < FEWEST_BLOCKS:
            continue
        sums = _sums(test.left, firsts, size)
        drawn = np.array([kurtosistest(_sums(one, firsts, size)).statistic for one in test.drawn.T])
        chance = float(t.sf(standing(float(kurtosistest(sums).statistic), drawn), drawn.size - 1))
        if chance < level:
            found.append((chance, int(firsts[np.argmax(np.abs(sums))])))
    return _at(test, min(found)[1]) if found else None


def knock_of(test: ScoreTest) -> Burst | None:
    """Return where most of all that a model leaves comes from, if it is one place; None where it is not.

    That is more than half of the squares of the sums over blocks, within two of the longest blocks. The shortest, which
    the sensor's noise fills, are not asked. It takes records of 1280 samples together to tell.

    Parameters
    ----------
    test : ScoreTest
        Of a model that does not explain the records.
    """
    samples = [run.samples for run in test.runs]
    number = np.repeat(np.arange(len(samples)), samples)
    found = []
    for size in BLOCKS[1:]:
        firsts = np.concatenate(first_samples(samples, size))
        if firsts.size < FEWEST_BLOCKS:
            return None
        power = _sums(test.left, firsts, size) ** 2
        strongest = int(firsts[np.argmax(power)])
        near = (np.abs(firsts - strongest) <= 2 * BLOCKS[-1]) & (number[firsts] == number[strongest])
        if not np.sum(power[near]) > 0.5 * np.sum(power):
            return None
        found.append(strongest)
    return _at(test, found[0])


def _at(test: ScoreTest, first: int) -> Burst:
    """Return the place of a sample, counted over all records."""
    ends = np.cumsum([0, *(run.samples for run in test.runs)])
    number = int(np.searchsorted(ends, first, side="right")) - 1
    instants = test.runs[number].instants
    return Burst(number, float(instants[first - ends[number]] - instants[0]))


def _sums(residual: NDArray[np.float64], firsts: NDArray[np.intp], size: int) -> NDArray[np.float64]:
    return np.asarray(np.sum(residual[firsts[:, None] + np.arange(size)], axis=1))
