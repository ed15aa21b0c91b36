"""Whether what a model leaves depends on the inputs."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError, ServolensError
from servolens.identification.loop_errors import loop_error, shifted
from servolens.identification.rounding import dominates, limit_of
from servolens.identification.score import FALSE_ALARM, ScoreTest
from servolens.simulation.loop import simulate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.observed import ObservedRun, SimulatedRun

__all__ = [
    "BLOCKS",
    "FEWEST_BLOCKS",
    "TESTS",
    "depends_on_inputs",
    "first_samples",
    "forces_along",
    "is_chance",
    "is_shaking",
    "standing",
]

TOLERATED = 0.05
"""Size of a structure, in standard deviations of the innovation, that no simulation is exact enough to judge."""
TESTS = 8
"""Among which the familywise error rate is shared: forces, changes of the reference, and ringing, of each all together
and the strongest; rest against motion; bursts."""
BLOCKS, FEWEST_BLOCKS = (8, 32, 128), 10
"""Samples of a block: a few, as many as a fast loop remembers, and a slow one; blocks of a third that is compared."""
SMALL = 1e-3
"""Share of the largest voltage with which the axis is pushed to see what a force would do."""
SPEEDS = np.array([-1.0, -0.3, -0.1, -0.03, 0.0, 0.03, 0.1, 0.3, 1.0])
"""Knots of a force over velocity or voltage, in units of the largest: dense where friction and dead zones act."""
PLACES = np.linspace(0.0, 1.0, 7)
"""Knots of a force over the travel and over time."""
RINGING_DAMPING = 0.1
RINGING = np.geomspace(0.25, 32.0, 24)
"""Damping ratio and frequencies of modes that the inputs may set ringing, in units of the loops' rate: a quarter apart,
about the width of such a mode, so that none falls between two."""
LAGS = 2
"""Ratio of one lag of an instrument to the one before."""


def depends_on_inputs(test: ScoreTest) -> bool:
    """Tell whether the residual of a hypothesis depends on the inputs.

    The whitened residual is regressed on instruments, at right angles to what the hypothesis itself explains: what
    forces over velocity, position, voltage, and time, and products of two of these, would do to it, each along the
    simulation of the loop from the reference, which knows nothing of the noise; changes of the reference itself over
    lags from a few samples to half a record; and lightly damped modes that the reference sets ringing. The sum of
    squares that all of a kind explain is χ², beyond what a structure of the tolerated size adds to it, or what draws of
    the noise explain, if that is more. What one instrument alone explains is compared with chance as well: one force
    that is missing is lost among so many. Then motion is compared with rest.
    Measured position and voltage are no instruments, for feedback carries the noise into them (Ljung 1999, section
    16.6, and model error modelling; Söderström and Stoica 1989, chapter 11): without a reference products are left out.
    """
    tests = statistics(test)
    return any(statistic > limit for statistic, limit in tests) or _differs_in_motion(test)


def is_shaking(likelihood: Likelihood, hypothesis: Hypothesis) -> bool:
    """Tell whether what an observer follows knows nothing of the inputs: then its fit is the best there is.

    Asked are its innovations, and the loop simulated from the reference, which no observer corrects.
    """
    try:
        if depends_on_inputs(ScoreTest(likelihood, likelihood.whitened_well(hypothesis))):
            return False
        plants = [hypothesis.plant_of(i) for i in range(len(likelihood.records))]
        simulated = [simulate(plant, record) for plant, record in zip(plants, likelihood.records, strict=True)]
    except (InputError, NumericalError):
        return False
    shown = [run.shown(plant) for run, plant in zip(simulated, plants, strict=True)]
    errors = [seen - record.position for seen, record in zip(shown, likelihood.records, strict=True)]
    return loop_error(plants, likelihood.records, errors, hypothesis.noise, likelihood.rate).is_noise


def statistics(test: ScoreTest) -> list[tuple[float, float]]:
    """Return what forces, the reference, and ringing explain, with limits: of each kind all, then the strongest."""
    found = []
    for columns in (forced(test), _instruments(test), _ringing(test)):
        directions = _unit(test.free_of_own(columns), columns)
        if directions.shape[1]:
            found += [_of_all(test, directions), _of_strongest(test, directions)]
    return found


def _of_all(test: ScoreTest, directions: NDArray[np.float64]) -> tuple[float, float]:
    """Return the sum of squares that the `directions` explain, and its limit."""
    from scipy.stats import ncx2

    basis = _basis(directions)
    tolerated = TOLERATED**2 * test.left.size
    limit = float(ncx2.isf(FALSE_ALARM / TESTS, basis.shape[1], tolerated))
    if test.is_drawn:
        drawn = basis.T @ test.drawn
        limit = max(limit, tolerated + limit_of(np.sum(drawn**2, axis=0), FALSE_ALARM / TESTS))
    along = basis.T @ test.left
    return float(along @ along), limit


def _of_strongest(test: ScoreTest, directions: NDArray[np.float64]) -> tuple[float, float]:
    """Return the largest square that one of the `directions` explains, by what chance explains of it, and its limit.

    Of so many (Bonferroni); by Student's t where draws tell what chance explains. It needs no tolerance: in as many
    samples as are compared it sees nothing much smaller than the tolerated structure.
    """
    from scipy.stats import norm, t

    level, spread = 0.5 * FALSE_ALARM / TESTS / directions.shape[1], np.ones(directions.shape[1])
    limit = float(norm.isf(level))
    if test.is_drawn:
        drawn = directions.T @ test.drawn
        spread = np.maximum(np.sqrt(np.mean(drawn**2, axis=1)), 1.0)
        limit = float(t.isf(level, drawn.shape[1]))
    return float(np.max((directions.T @ test.left / spread) ** 2)), limit**2


def _differs_in_motion(test: ScoreTest) -> bool:
    """Tell whether the whitened residual goes on from sample to sample otherwise in motion than at rest.

    Noise of a sensor, ripple and shaking are the same at rest; what a model lacks shows in motion. Compared are the
    mean squares of block means, in units of the squared differences within the blocks (which a jittering clock
    enlarges in motion), between the third of the blocks in which the axis is fastest and that in which it is slowest
    (Goldfeld and Quandt 1965, doi:10.1080/01621459.1965.10480811). By an F test, whether they are larger in motion; of
    a shaken axis by draws of its loop, whether they differ, for dry friction and plays hold it at rest. Where rounding
    dominates an axis at rest shows no noise: there the test says nothing.
    """
    from scipy.stats import f, t

    noise = test.hypothesis.noise
    if dominates(noise):
        return False
    fast = [np.abs(_noise_free(test, i)[1]) for i in range(len(test.runs))]
    fast = [v if run.signals.index is None else v[run.signals.index] for run, v in zip(test.runs, fast, strict=True)]
    level = FALSE_ALARM / TESTS / len(BLOCKS)
    for size in BLOCKS:
        blocks = _Blocks(fast, [run.samples for run in test.runs], size)
        if blocks.count < FEWEST_BLOCKS:
            continue
        ratio = blocks.ratio(test.left)
        if noise.rate == 0.0:
            usual = float(np.mean([blocks.ratio(one) for one in test.drawn.T])) if test.is_drawn else 1.0
            if f.sf(ratio / usual, blocks.count, blocks.count) < level:
                return True
            continue
        away = standing(float(np.log(ratio)), np.log([blocks.ratio(one) for one in test.drawn.T]))
        if 2.0 * t.sf(abs(away), test.drawn.shape[1] - 1) < level:
            return True
    return False


def standing(value: float, drawn: NDArray[np.float64]) -> float:
    """Return Student's t of one further draw: how far `value` is from the mean of those `drawn`, by their spread."""
    spread = float(np.std(drawn, ddof=1)) * np.sqrt(1.0 + 1.0 / drawn.size)
    return (value - float(np.mean(drawn))) / max(float(spread), 1e-300)


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


def forced(test: ScoreTest) -> NDArray[np.float64]:
    """Return what each force of a general kind would do to the whitened residual, shape (n, k).

    Without those under which an axis that sticks would chatter so fast that it cannot be simulated.

    Raises
    ------
    NumericalError
        If that is true of all.
    """
    laws = _laws(test)
    size = SMALL * max(float(np.abs(run.signals.voltage).max()) for run in test.runs)
    columns = []
    for k in range(laws[0].shape[0]):
        with suppress(NumericalError):
            columns.append(test.pushed([law[k] for law in laws], size))
    if not columns:
        raise NumericalError("the axis cannot be simulated with any force beside it")
    return np.column_stack(columns)


def _laws(test: ScoreTest) -> list[NDArray[np.float64]]:
    """Return, for each record, forces of all kinds along the simulation that knows no noise, shape (k, n)."""
    records = [run.signals.record for run in test.runs]
    closed = all(record.reference is not None and record.controller is not None for record in records)
    # without a reference the motion is a measured one, and so are its products with the noise
    return forces_along([_noise_free(test, i) for i in range(len(test.runs))], with_products=closed)


def forces_along(
    found: Sequence[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]],
    *,
    with_products: bool = False,
) -> list[NDArray[np.float64]]:
    """Return forces of all kinds along position, velocity and voltage of each record, shape (k, n)."""
    fastest = max(float(np.abs(v).max()) for _, v, _ in found)
    low, high = min(float(y.min()) for y, _, _ in found), max(float(y.max()) for y, _, _ in found)
    most = max(float(np.abs(u).max()) for _, _, u in found)
    laws = []
    for y, v, u in found:
        rows = [*_hats(v / max(fastest, 1e-300), SPEEDS), *_hats((y - low) / max(high - low, 1e-300), PLACES)]
        rows += [*_hats(u / max(most, 1e-300), SPEEDS), *_hats(np.linspace(0.0, 1.0, y.size), PLACES)]
        rows += [np.diff(v, prepend=v[0]), np.diff(u, prepend=u[0]), v * (y - low), np.sign(v) * (y - low)]
        rows += _products(y - low, v, u) if with_products else ()
        laws.append(np.array([row / max(float(np.abs(row).max()), 1e-300) for row in rows]))
    return laws


def _products(y: NDArray[np.float64], v: NDArray[np.float64], u: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield forces of second order: place, speed, its sign and voltage, each changing over another, time or path."""
    time, path = np.linspace(0.0, 1.0, y.size), np.cumsum(np.abs(v))
    for along in (time, path):
        for force in (v, np.sign(v), u):
            yield force * (along - np.mean(along))
    for force in (y * u, v * u, np.sign(v) * u, y * time, y * path):
        yield force - np.mean(force)


def _noise_free(test: ScoreTest, i: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return position, velocity and voltage that know nothing of the noise, on the grid that is simulated."""
    signals, record = test.runs[i].signals, test.runs[i].signals.record
    run = None
    if record.reference is not None and record.controller is not None:
        with suppress(ServolensError):
            run = simulate(test.hypothesis.plant_of(i), record)
    if run is None:
        from servolens.identification.smoothing import smooth

        value, slope = smooth(signals.time, signals.position, min(41, signals.time.size))
        return value, slope, np.concatenate([signals.voltage[:1], signals.voltage[:-1]])
    at = [np.interp(signals.time, record.time, signal) for signal in (run.position, run.velocity, run.voltage)]
    return at[0], at[1], at[2]


def _hats(values: NDArray[np.float64], knots: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the piecewise linear functions that are 1 at one of the `knots` and 0 at the others."""
    return [np.interp(values, knots, row) for row in np.eye(knots.size)]


def _instruments(test: ScoreTest) -> NDArray[np.float64]:
    """Return the instruments of all records, whitened, shape (n, k): those of each record are 0 in the others."""
    found = [(run, _of_run(run)) for run in test.runs]
    blocks = [run.whiten(columns) if columns.shape[1] else columns for run, columns in found]
    columns = np.zeros((test.residual.size, sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        columns[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return columns


def _of_run(run: ObservedRun | SimulatedRun) -> NDArray[np.float64]:
    signals = _driving(run)
    found = []
    for signal in signals:
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(signal)))])
        for one in (signal, way) if np.any(np.diff(signal) < 0.0) and np.any(np.diff(signal) > 0.0) else (signal,):
            found += _lagged(one)
    return np.column_stack(found) if found else np.empty((run.samples, 0))


def _driving(run: ObservedRun | SimulatedRun) -> list[NDArray[np.float64]]:
    """Return what drives the record and knows nothing of the noise, on the samples that are simulated."""
    record, signals = run.signals.record, run.signals
    at = np.searchsorted(record.time, signals.time[slice(None) if signals.index is None else signals.index] + 1e-12)
    at = np.clip(at - 1, 0, len(record) - 1)
    if record.reference is None:
        voltage = signals.voltage if signals.index is None else signals.voltage[signals.index]
        return [np.concatenate([voltage[:1], voltage[:-1]])]
    return [record.reference[at], *([] if record.feedforward is None else [record.feedforward[at]])]


def _ringing(test: ScoreTest) -> NDArray[np.float64]:
    """Return what lightly damped modes that the inputs set ringing would add to the residual, shape (n, k)."""
    from scipy.signal import lfilter

    parts = []
    for run in test.runs:
        step = float(np.median(np.diff(run.instants)))
        kicks = [np.diff(signal, prepend=signal[0]) for signal in _driving(run)]
        poles = np.exp(test.rate * RINGING * (1j - RINGING_DAMPING) * step)
        rung = [lfilter([1.0], [1.0, -pole], np.asarray(kick, dtype=complex)) for kick in kicks for pole in poles]
        parts.append(run.whiten(np.column_stack([part for one in rung for part in (one.real, one.imag)])))
    return np.concatenate(parts)


def _lagged(signal: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return by how much `signal` changed between lags that grow geometrically."""
    found, early = [], 0
    padded = signal - signal[0]
    while early < signal.size // LAGS:
        late = max(LAGS * early, early + 4)
        column = shifted(padded, early) - shifted(padded, late)
        if np.any(column != 0.0):
            found.append(column)
        early = late
    return found
