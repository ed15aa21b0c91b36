"""Whether what a model leaves depends on the inputs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.instruments import instruments, noise_free, noise_free_run
from servolens.identification.loop_errors import loop_error
from servolens.identification.rounding import is_coarse, law_of_squares
from servolens.identification.score import FALSE_ALARM, ScoreTest, free_of
from servolens.model_evidence import MATERIAL
from servolens.prediction import from_beginning

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood

__all__ = [
    "BLOCKS",
    "FEWEST_BLOCKS",
    "TESTS",
    "Answer",
    "answers",
    "depends_on_inputs",
    "first_samples",
    "is_chance",
    "is_shaking",
    "joint_chance",
    "standing",
]

TOLERATED = 0.05
"""Size of a structure, in standard deviations of the innovation, that no simulation is exact enough to judge."""
TESTS = 15
"""Among which the familywise error rate is shared: six kinds of instruments, of each all together and the strongest;
rest against motion; the kinds and that together; bursts."""
BLOCKS, FEWEST_BLOCKS = (8, 32, 128), 10
"""Samples of a block: a few, as many as a fast loop remembers, and a slow one; blocks of a third that is compared."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Of one test.

    Attributes
    ----------
    chance : float
        Probability of as much by chance.
    together : ndarray, shape (draws + 1,), optional
        The same of draws and, at the end, of the residual, to be taken together with those of other tests. None of a
        test that asks again what another has asked.
    """

    chance: float
    together: NDArray[np.float64] | None = None


def depends_on_inputs(test: ScoreTest) -> bool:
    """Tell whether the residual of a hypothesis depends on the inputs.

    The whitened residual is regressed on instruments, at right angles to what the hypothesis itself explains: what
    forces over velocity, position, voltage, and time, and products of two of these, would do to it, each along the
    simulation of the loop from the reference, which knows nothing of the noise; changes of the reference itself over
    lags from a few samples to half a record; lightly damped modes that the reference sets ringing; and friction,
    damping and gain that act for a part of a record alone. The sum of squares that all of a kind explain is χ², beyond
    what a structure of the tolerated size adds to it, or what draws of the noise explain, if that is more. What one
    instrument alone explains is compared with chance as well: one force that is missing is lost among so many. Then
    motion is compared with rest. At last what each kind explains, and motion against rest, are taken together, as each
    may fall a little short.
    Measured position and voltage are no instruments, for feedback carries the noise into them (Ljung 1999, section
    16.6, and model error modelling; Söderström and Stoica 1989, chapter 11): without a reference products are left out.
    What the hypothesis itself explains is told of the measured signals. Of an instrument that is like one of its own
    parameters, as a force over the velocity is like damping, nothing but the noise in these would be left: so the
    instruments are at right angles to what its parameters do along the noise-free signals, first.
    """
    given = []
    for answer in answers(test):
        if answer.chance < FALSE_ALARM / TESTS:
            return True
        given.append(answer)
    return joint_chance(given) < FALSE_ALARM / TESTS


def joint_chance(given: Sequence[Answer]) -> float:
    """Return the probability of such answers together by chance.

    Of the sum of the logarithms of their probabilities, which of independent ones is χ² (Fisher). These are not, so
    that it spreads farther, as draws of it show (Brown 1975, doi:10.2307/2529826). Draws that have too little power
    make each test a little strict; in the sum that would add up, so there those of the instruments are strong.
    """
    from scipy.stats import chi2

    asked = [answer.together for answer in given if answer.together is not None]
    if len(asked) < 2:
        return 1.0
    *drawn, found = -2.0 * np.sum(np.log(np.maximum(asked, 1e-300)), axis=0)
    return max(float(law_of_squares(np.array(drawn)).sf(found)), float(chi2.sf(found, 2 * len(asked))))


def is_shaking(likelihood: Likelihood, hypothesis: Hypothesis) -> bool:
    """Tell whether what an observer follows knows nothing of the inputs: then its fit is the best there is.

    Asked are its innovations, and the loop simulated from the reference, which no observer corrects. Where there is no
    loop to simulate it is believed as long as it is immaterial.
    """
    try:
        if depends_on_inputs(ScoreTest(likelihood, likelihood.whitened_well(hypothesis))):
            return False
        plants = [hypothesis.plant_of(i) for i in range(len(likelihood.records))]
        simulated = [from_beginning(*pair) for pair in zip(plants, likelihood.records, strict=True)]
    except (InputError, NumericalError):
        return False
    shown = [run.shown(plant) for run, plant in zip(simulated, plants, strict=True)]
    errors = [seen - record.position for seen, record in zip(shown, likelihood.records, strict=True)]
    if not all(record.has_loop for record in likelihood.records):
        most = float(np.hypot(likelihood.white.spread, MATERIAL * likelihood.travel))
        return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) <= most
    return loop_error(plants, likelihood.records, errors, hypothesis.noise, likelihood.rate).is_noise


def answers(test: ScoreTest) -> Iterator[Answer]:
    """Yield what tests say: of each kind of instruments all together, then the strongest; and motion against rest."""
    own = test.own_along([noise_free_run(run, test.hypothesis.plant_of(i)) for i, run in enumerate(test.runs)])
    for columns in instruments(test):
        directions = _unit(test.free_of_own(free_of(own, columns)), columns)
        if directions.shape[1]:
            yield _of_all(test, directions)
            yield _of_strongest(test, directions)
    yield from _in_motion(test)


def _of_all(test: ScoreTest, directions: NDArray[np.float64]) -> Answer:
    """Ask the sum of squares that the `directions` explain.

    An observer that follows a shaken axis follows what a simulation is not exact enough for as well.
    """
    from scipy.stats import chi2, ncx2

    basis = _basis(directions)
    tolerated = TOLERATED**2 * test.left.size if test.hypothesis.noise.rate == 0.0 else 0.0
    found, drawn, strong = (np.sum((basis.T @ one) ** 2, axis=0) for one in (test.left, test.drawn, test.strong))
    chance = float(ncx2.sf(found, basis.shape[1], tolerated))
    if not test.is_drawn:
        return Answer(chance, np.append(chi2.sf(drawn, basis.shape[1]), chance))
    weak, law = law_of_squares(drawn), law_of_squares(strong)
    together = np.append(law.sf(strong), max(chance, float(law.sf(found - tolerated))))
    return Answer(max(chance, float(weak.sf(found - tolerated))), together)


def _of_strongest(test: ScoreTest, directions: NDArray[np.float64]) -> Answer:
    """Ask the largest square that one of the `directions` explains, by what chance explains of it.

    Of so many (Bonferroni); by Student's t where draws tell what chance explains. It needs no tolerance: in as many
    samples as are compared it sees nothing much smaller than the tolerated structure.
    """
    from scipy.stats import norm, t

    found = np.abs(directions.T @ test.left)
    if test.is_drawn:
        spread = np.sqrt(np.mean((directions.T @ test.drawn) ** 2, axis=1))
        chance = t.sf(np.max(found / np.maximum(spread, 1.0)), test.drawn.shape[1])
    else:
        chance = norm.sf(np.max(found))
    return Answer(min(2.0 * found.size * float(chance), 1.0))


def _in_motion(test: ScoreTest) -> Iterator[Answer]:
    """Ask whether the whitened residual goes on from sample to sample otherwise in motion than at rest.

    Noise of a sensor, ripple and shaking are the same at rest; what a model lacks shows in motion. Compared are the
    mean squares of block means, in units of the squared differences within the blocks (which a jittering clock
    enlarges in motion), between the third of the blocks in which the axis is fastest and that in which it is slowest
    (Goldfeld and Quandt 1965, doi:10.1080/01621459.1965.10480811). By an F test, whether they are larger in motion; of
    a shaken axis by draws of its loop, whether they differ, for dry friction and plays hold it at rest. Where rounding
    dominates an axis at rest shows no noise: there the test says nothing.
    """
    from scipy.stats import f, t

    noise = test.hypothesis.noise
    if is_coarse(noise, test.unrounded):
        return
    fast = [np.abs(noise_free(test, i)[1]) for i in range(len(test.runs))]
    fast = [v if run.signals.index is None else v[run.signals.index] for run, v in zip(test.runs, fast, strict=True)]
    every = []
    for size in BLOCKS:
        blocks = _Blocks(fast, [run.samples for run in test.runs], size)
        if blocks.count < FEWEST_BLOCKS:
            continue
        ratios = np.array([blocks.ratio(one) for one in (test.left, *test.drawn.T)])
        if noise.rate == 0.0:
            usual = float(np.mean(ratios[1:])) if test.is_drawn else 1.0
            every.append(f.sf(ratios / usual, blocks.count, blocks.count))
        else:
            away = standing(np.log(ratios), np.log(ratios[1:]))
            every.append(2.0 * t.sf(np.abs(away), ratios.size - 2))
    if every:
        least = np.minimum(len(BLOCKS) * np.min(every, axis=0), 1.0)
        yield Answer(float(least[0]), np.append(least[1:], least[0]))


def standing(value: float | NDArray[np.float64], drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Student's t of one further draw: how far `value` is from the mean of those `drawn`, by their spread."""
    spread = float(np.std(drawn, ddof=1)) * np.sqrt(1.0 + 1.0 / drawn.size)
    return np.asarray((value - np.mean(drawn)) / max(float(spread), 1e-300))


def first_samples(samples: Sequence[int], size: int) -> list[NDArray[np.intp]]:
    """Return where each whole block of `size` samples begins, record by record, counted over all records."""
    return [np.arange(begin, end - size + 1, size) for begin, end in pairwise(np.cumsum([0, *samples]))]


class _Blocks:
    """Blocks of samples in which the axis is slowest and fastest: a third of all each.

    Parameters
    ----------
    speeds : sequence of ndarray, shape (n,)
        Of each record.
    samples : sequence of int
        That are compared of each.
    size : int
        Samples of a block.
    """

    def __init__(self, speeds: Sequence[NDArray[np.float64]], samples: Sequence[int], size: int) -> None:
        firsts = first_samples(samples, size)
        energy = [
            np.sum(v[: size * at.size].reshape(at.size, size) ** 2, axis=1)
            for v, at in zip(speeds, firsts, strict=True)
        ]
        order = np.concatenate(firsts)[np.argsort(np.concatenate(energy), kind="stable")]
        self.size, self.count = size, order.size // 3
        self._slow, self._fast = order[: self.count], order[order.size - self.count :]

    def ratio(self, residual: NDArray[np.float64]) -> float:
        """Return how much smoother `residual`, shape (n,), is where the axis is fast than where it is slow."""
        fast, slow = (self._smoothness(residual, firsts) for firsts in (self._fast, self._slow))
        return max(fast, 1e-300) / max(slow, 1e-300)

    def _smoothness(self, residual: NDArray[np.float64], firsts: NDArray[np.intp]) -> float:
        rows = residual[firsts[:, None] + np.arange(self.size)]
        smooth = self.size * float(np.mean(np.mean(rows, axis=1) ** 2))
        return smooth / max(0.5 * float(np.mean(np.diff(rows, axis=1) ** 2)), 1e-300)


def is_chance(columns: NDArray[np.float64], own: NDArray[np.float64], residual: NDArray[np.float64]) -> bool:
    """Tell whether `columns` explain no more of a whitened residual, beside its `own` directions, than chance does."""
    from scipy.stats import ncx2

    basis, _ = np.linalg.qr(own / np.maximum(np.linalg.norm(own, axis=0), 1e-300))
    directions = _unit(columns - basis @ (basis.T @ columns), columns)
    if directions.shape[1] == 0:
        return True
    along = _basis(directions).T @ (residual - basis @ (basis.T @ residual))
    return float(along @ along) <= float(ncx2.isf(FALSE_ALARM, along.size, TOLERATED**2 * residual.size))


def _unit(free: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what is `free` of the `columns`, each of length 1, without those of which nothing is."""
    sizes = np.linalg.norm(free, axis=0)
    is_more = sizes > 1e-6 * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(free[:, is_more] / sizes[is_more])


def _basis(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis of the directions."""
    left, singular, _ = np.linalg.svd(directions, full_matrices=False)
    return np.asarray(left[:, singular > 1e-4 * singular[0]])
