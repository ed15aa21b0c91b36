"""What an encoder's rounding does to whitened residuals, simulated: it is not Gaussian, and does not average out.

Where rounding is a good part of the noise, what is compared with chance is compared with such draws (parametric
bootstrap: Efron and Tibshirani 1993, chapter 6).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servolens.effects import Sensor
from servolens.errors import NumericalError
from servolens.identification.runs import place_of
from servolens.identification.segments import applied_voltage
from servolens.identification.uncertainty import MOST_SAMPLES
from servolens.prediction import Beginning
from servolens.processors import in_parallel, in_processes
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel, Whitener
    from servolens.identification.observed import ObservedRun, SimulatedRun
    from servolens.plant import Plant

__all__ = [
    "DRAWS",
    "FEW_DRAWS",
    "LOOPS",
    "about_mean",
    "before_rounding",
    "dominates",
    "drawn_noise",
    "draws_for",
    "has_mean",
    "is_coarse",
    "is_rounded",
    "law_of_squares",
    "logged",
    "own_spectra",
    "parted",
    "rounded",
    "spectrum_of",
]

DOMINATES = 0.5
"""Share of rounding in the noise's variance from which on it is what decides: an axis at rest shows no noise."""

DITHERED = 0.5
"""Standard deviation of quick noise, in steps of the encoder, from which on rounding is one more white noise: its mean,
wherever the axis is, is less than exp(−2π²/4)/π of a step, 0.2 % (Widrow and Kollár, *Quantization Noise*, 2008)."""

DRAWS, OFTENER = 40, 4
"""Draws of a noise that is rounded: its variance in a direction is then known to 20 %. Times as many for error bars,
which are then known to 6 %."""
FREQUENCIES, BAND = 1024, 5
"""Frequencies of a spectrum; of them, those over which one of draws is smoothed."""
FEW_DRAWS = 8
"""Draws of each size of quick noise that is looked at."""
HALF_DECADE = 10.0**0.5
SHARES = (0.0, *(HALF_DECADE**power for power in range(-6, 1)))
"""Standard deviations of quick noise that are looked at first, in steps of the encoder: a loop with a derivative, which
goes to and fro over a step at rest, shows a thousandth of it."""
FINER = tuple(HALF_DECADE**0.5**power for power in (1, 2, 3, 4))
"""Factors by which the likeliest one is changed: records of some thousand samples know it to a few per cent."""
LOOPS = 2 * DRAWS + (len(SHARES) + 2 * len(FINER)) * FEW_DRAWS
"""Loops that are simulated in all, of each record, at most."""


def is_rounded(noise: NoiseModel) -> bool:
    """Tell whether an encoder's rounding is a part of the noise of a simulation that is not white itself.

    Quick noise makes it so: the floor of the spectrum holds that noise and the rounding's own. White noise that is
    larger because something slow was left is taken for such.
    """
    if noise.rate != 0.0 or noise.share == 0.0 or noise.rounding == 0.0:
        return False
    return bool(np.min(spectrum_of(noise)) < (DITHERED**2 + 1.0 / 12.0) * noise.rounding**2)


def dominates(noise: NoiseModel) -> bool:
    """Tell whether rounding is most of the noise."""
    return noise.share > DOMINATES


def is_coarse(noise: NoiseModel, unrounded: NDArray[np.float64] | None = None) -> bool:
    """Tell whether rounding is most of what the sensor adds, beside an axis that is observed too.

    Where the spectrum `unrounded` is known, by that: an axis that rests is up to half a step away all the time, so that
    rounding may look larger than it is on average.
    """
    own = max(noise.spread, noise.floor) ** 2 - noise.rounding**2 / 12.0 if unrounded is None else np.mean(unrounded)
    return bool(noise.rounding**2 / 12.0 * (1.0 - DOMINATES) > DOMINATES * own)


def has_mean(runs: Sequence[ObservedRun | SimulatedRun]) -> bool:
    """Tell whether rounding may leave much of simulations on average: of a loop that seeks one side of a step.

    An axis that rests there is half a step away all the time: thrice the mean square of one that moves. Without a loop
    there is no mean, but where rounding dominates the draws are its chance.
    """
    noise, in_loop = runs[0].noise, any(run.signals.record.has_loop for run in runs)
    share = 3.0 * noise.share if in_loop else noise.share
    return is_rounded(noise) and share > DOMINATES and not noise.is_model_error


def draws_for(samples: int) -> int:
    """Return how many draws error bars of so many `samples` are made of: those of few cost little."""
    return int(DRAWS * np.clip(MOST_SAMPLES / samples, 1.0, OFTENER))


def rounded(
    runs: Sequence[ObservedRun | SimulatedRun],
    plants: Sequence[Plant],
    starts: Sequence[NDArray[np.float64]],
    spectra: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """Return draws of each run's whitened residual if its plant is the axis, shape (n, draws).

    The position, with noise of these `spectra`, rounded as the encoder does. In closed loop the position is that of a
    loop with this encoder, begun anywhere within one of its steps: an axis comes to rest where the command vanishes,
    which is where the encoder shows the next step, and so at one side of it. While it rests against a stop, the encoder
    shows one value: where the stop lies within that step is unknown, and drawn. Else the position is the run's own, and
    the encoder's steps lie anywhere.

    Parameters
    ----------
    runs : sequence of ObservedRun or SimulatedRun
        Without an observer's correction.
    plants, starts : sequence
        The plant of each run and its initial state.
    spectra : ndarray, shape (draws, m)
        See :func:`own_spectra`.
    """
    return [
        np.column_stack([one.whiten(one.error) for one in draws]) for draws in _of_each(runs, plants, starts, spectra)
    ]


def logged(
    runs: Sequence[ObservedRun | SimulatedRun],
    plants: Sequence[Plant],
    starts: Sequence[NDArray[np.float64]],
    spectra: NDArray[np.float64],
) -> Iterator[list[ObservedRun | SimulatedRun]]:
    """Yield the runs as each of the draws would be logged, position and voltage, of records with a loop.

    Parameters are those of :func:`rounded`. Draws that have no simulation are left out.
    """
    for draws in zip(*_of_each(runs, plants, starts, spectra), strict=True):
        found = [run.measured_as(*one.log) for run, one in zip(runs, draws, strict=True) if one.log is not None]
        if len(found) == len(runs):
            yield found


def _of_each(
    runs: Sequence[ObservedRun | SimulatedRun],
    plants: Sequence[Plant],
    starts: Sequence[NDArray[np.float64]],
    spectra: NDArray[np.float64],
) -> list[list[_Draw]]:
    """Return the draws of each run."""
    stream = np.random.default_rng(0)
    return [
        [*_drawn(run, (plant, start), position, spectra, stream, len(spectra))]
        for run, plant, start, position in zip(runs, plants, starts, _whole(runs, plants, starts), strict=True)
    ]


class _Draw(NamedTuple):
    """What an encoder would show: the error, shape (n,), the filter that whitens it, and position and voltage in all.

    The error is the position less what is shown. The log, shape (n,) each, is None without a loop.
    """

    whiten: Whitener
    error: NDArray[np.float64]
    log: tuple[NDArray[np.float64], ...] | None


def _whole(
    runs: Sequence[ObservedRun | SimulatedRun], plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return the position of each run's plant, as no encoder has rounded it."""
    return [
        run.whiten.position + run.missed(plant, start, substeps_for(plant, run.sample_time))
        for run, plant, start in zip(runs, plants, starts, strict=True)
    ]


def parted(run: ObservedRun | SimulatedRun, drawn: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the mean of a run's draws, shape (n,), and what else is in each, shape (n, draws).

    As large as a further draw is about that mean. Without a loop that is simulated the mean is 0: steps lie anywhere.
    """
    return about_mean(drawn) if run.signals.record.has_loop else (np.zeros(drawn.shape[0]), drawn)


def about_mean(drawn: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of draws, shape (n,), and the rest of each, as large as of a further draw, shape (n, draws)."""
    mean, count = np.mean(drawn, axis=1), drawn.shape[1]
    return mean, (drawn - mean[:, None]) * np.sqrt((count + 1.0) / (count - 1.0))


def own_spectra(
    runs: Sequence[ObservedRun | SimulatedRun], plants: Sequence[Plant], starts: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return spectra of the sensor's noise before the encoder rounds it, of each draw, at even frequencies up to half.

    Their quick part is white. How large it is, each record tells by how often it turns back and how quickly its error
    changes: an encoder shows noise far smaller than its step only where the axis is between two steps, and a loop may
    go to and fro over a step by itself, less so beside some noise. Draws have each size as often as it is likely
    (synthetic likelihood: Wood 2010, doi:10.1038/nature09319). What the records have more of in all is slow, with the
    spectrum of the noise model (indirect inference: Gourieroux et al. 1993, doi:10.1002/jae.3950080507). A
    resting axis shows the same step for long, a constant error; beside slow noise it crosses many steps, and has no
    such error. So the draws are made once more, beside the slow noise that was found, and correct it.

    Parameters
    ----------
    runs, plants, starts
        As of :func:`rounded`.

    Returns
    -------
    ndarray, shape (DRAWS, m)
        In variance a sample.
    """
    positions, shown = _whole(runs, plants, starts), spectrum_of(runs[0].noise)
    of_runs = list(zip(runs, plants, starts, positions, strict=True))
    step, samples = runs[0].noise.rounding, sum(position.size for position in positions)

    def looked(own: NDArray[np.float64], draws: int) -> tuple[float, NDArray[np.float64]]:
        """Return how likely the records are beside noise of a spectrum, or of one a draw, and what that leaves."""
        chance, power, stream = 0.0, np.zeros(shown.size), np.random.default_rng(1)
        for run, plant, start, position in of_runs:
            drawn = [*_drawn(run, (plant, start), position, own, stream, draws)]
            power += sum(_power(one.whiten.steady(one.error)) for one in drawn) / samples / draws
            seen = _quickness(run.whiten.position, position - run.whiten.position, step)
            chance += _chance(seen, np.array([_quickness(one.whiten.position, one.error, step) for one in drawn]))
        return chance, power

    def beside(share: float) -> tuple[float, NDArray[np.float64]]:
        return looked(np.full(shown.size, (share * step) ** 2), FEW_DRAWS)

    found = dict(zip(SHARES, in_processes(beside, SHARES), strict=True))
    for finer in FINER:
        likeliest = max(found, key=lambda share: found[share][0])
        between = [likeliest / finer, likeliest * finer] if likeliest else []
        found |= dict(zip(between, in_processes(beside, between), strict=True))
    seen = sorted(found)
    shares = [seen[i] for i in _likely(seen, [found[share][0] for share in seen])]
    quick = np.square(np.array(shares) * step)[:, None]
    slow = np.array([_with_more(np.zeros(shown.size), shown - found[share][1]) for share in shares])
    if slow.any():
        _, left = looked(quick + slow, DRAWS)
        slow = np.array([_with_more(one, shown - left) for one in slow])
    return np.asarray(quick + slow)


def _with_more(slow: NDArray[np.float64], more: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a spectrum with so much `more`, shape (m,): nowhere less than none, and in all as much as that makes."""
    found, total = np.maximum(slow + more, 0.0), max(float(np.mean(slow + more)), 0.0)
    return np.asarray(found * (total / max(float(np.mean(found)), 1e-300)))


def _likely(shares: Sequence[float], chances: Sequence[float]) -> NDArray[np.intp]:
    """Return which of the sorted `shares` each draw has, as often as these log-likelihoods say, shape (DRAWS,).

    Beforehand all magnitudes are alike, and none at all is as likely as a coarse step of them.
    """
    widths = np.array([np.log(HALF_DECADE), *np.gradient(np.log(shares[1:]))])
    likely = np.cumsum(np.exp(np.array(chances) - max(chances)) * widths)
    return np.asarray(np.searchsorted(likely, (np.arange(DRAWS) + 0.5) / DRAWS * likely[-1]), dtype=np.intp)


def _chance(seen: NDArray[np.float64], drawn: NDArray[np.float64]) -> float:
    """Return the log density of what was `seen`, shape (k,), if it is one more of those `drawn`, shape (draws, k).

    Student's, without its constant. A twelfth is added to both variances, as of what is rounded to whole numbers: draws
    may all be alike.
    """
    draws, kinds = drawn.shape
    covariance = (1.0 + 1.0 / draws) * (np.cov(drawn, rowvar=False) + np.eye(kinds) / 12.0)
    away = seen - np.mean(drawn, axis=0)
    missed = float(away @ np.linalg.solve(covariance, away)) / (draws - 1)
    size = np.linalg.slogdet(covariance)[1]
    return float(-0.5 * (size + draws * np.log1p(missed)))


def _quickness(position: NDArray[np.float64], error: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return how often a rounded `position` turns back from one change to the next, and how quick its `error` is.

    The latter by squared third differences, in units of what one sample leaves of them that is one step off.
    """
    changes = np.sign(np.rint(np.diff(position) / step))
    changes = changes[changes != 0.0]
    turns = np.count_nonzero(changes[1:] != changes[:-1])
    return np.array([turns, np.sum(np.diff(error / step, 3) ** 2) / 20.0])


def _drawn(
    run: ObservedRun | SimulatedRun,
    begun: tuple[Plant, NDArray[np.float64]],
    position: NDArray[np.float64],
    spectrum: NDArray[np.float64],
    stream: np.random.Generator,
    draws: int,
) -> Iterator[_Draw]:
    """Yield what the encoder would make of draws of noise of this `spectrum`, of a plant that has `begun`."""
    step, record = run.noise.rounding, run.signals.record
    places = stream.uniform(-0.5 * step, 0.5 * step, draws)
    stops = np.random.default_rng(2).uniform(-0.5 * step, 0.5 * step, draws)  # the same in all records
    (plant, start), closed = begun, record.has_loop
    own_start = beginning_of(run, start)
    instants = record.time if closed else run.instants
    ripple = run.whiten.ripple(run.whiten.position - position, instants)
    own = ripple[:, None] + drawn_noise(spectrum, instants.size, stream, draws)
    at = None if not closed else _compared(run, position.size)

    def one(k: int) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[NDArray[np.float64], ...] | None]:
        if at is not None:
            loop = replace(record, position=record.position + places[k], encoder_resolution=step)
            with suppress(NumericalError):
                axis = replace(plant, effects=tuple(effect.shifted(stops[k]) for effect in plant.effects))
                moved = own_start.simulated(axis, loop, sensor_error=own[:, k])
                there = moved.position
                if any(isinstance(effect, Sensor) for effect in plant.effects):
                    driven = replace(loop, voltage=moved.voltage, encoder_resolution=None)
                    there = own_start.simulated(axis, driven, voltage_driven=True).measured
                log = moved.measured, applied_voltage(replace(record, voltage=moved.voltage))
                return there[at], moved.measured[at], log
            return position, step * np.round((position + own[at, k]) / step), None
        return position, step * np.round((position + own[:, k] + places[k]) / step) - places[k], None

    for there, shown, log in in_parallel(one, range(draws)):
        yield _Draw(run.whiten.of(shown), there - shown, log)


def beginning_of(run: ObservedRun | SimulatedRun, start: NDArray[np.float64]) -> Beginning:
    """Return how a draw of a run's record begins: as its first samples show, the motor where the run begins."""
    return Beginning(run.signals.record, float(run.signals.initial.mean[1]), place_of(start))


def _compared(run: ObservedRun | SimulatedRun, size: int) -> NDArray[np.intp]:
    """Return which samples of its record a run compares, shape (size,)."""
    signals = run.signals
    time = signals.time if signals.index is None else signals.time[signals.index]
    at = np.searchsorted(signals.record.time, time[:size])
    return np.clip(at, 0, len(signals.record) - 1)


def spectrum_of(noise: NoiseModel) -> NDArray[np.float64]:
    """Return the spectrum of a noise model at even frequencies up to half, in variance a sample, shape (m,)."""
    response = np.abs(np.fft.rfft(noise.filters[-1], 2 * FREQUENCIES))
    return np.asarray((noise.innovation / np.maximum(response, 1e-12)) ** 2)


def before_rounding(noise: NoiseModel) -> NDArray[np.float64]:
    """Return about the spectrum that the noise has before an encoder rounds it, in variance a sample, shape (m,).

    Of rounding that is white itself exactly that; else as large a share of every frequency, see :func:`own_spectra`.
    """
    shown = spectrum_of(noise)
    if is_rounded(noise) or noise.share == 0.0:
        return shown * (1.0 - noise.share)
    return np.asarray(np.maximum(shown - noise.rounding**2 / 12.0, 0.0))


def drawn_noise(
    spectrum: NDArray[np.float64], samples: int, stream: np.random.Generator, draws: int = DRAWS
) -> NDArray[np.float64]:
    """Return draws of noise of a `spectrum`, shape (m,), or one each, shape (draws, m), at even frequencies.

    Returns
    -------
    ndarray, shape (samples, draws)
    """
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(2 * samples, real=True)
    at = np.linspace(0.0, spectrum.shape[-1] - 1.0, size // 2 + 1)
    even = [np.interp(at, np.arange(one.size), one) for one in np.atleast_2d(spectrum)]
    response = np.sqrt(np.column_stack(even))
    waves = rfft(stream.standard_normal((size, draws)), axis=0)
    return np.asarray(irfft(response * waves, size, axis=0)[:samples])


def _power(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return n times the spectrum of `signal`, shape (n,), smoothed over neighbouring frequencies."""
    from scipy.ndimage import uniform_filter1d

    found = np.abs(np.fft.rfft(signal, max(signal.size, 2 * FREQUENCIES))) ** 2
    found = uniform_filter1d(found, max(found.size // FREQUENCIES, 1) * BAND)
    return np.asarray(np.interp(np.linspace(0.0, found.size - 1.0, FREQUENCIES + 1), np.arange(found.size), found))


def law_of_squares(draws: NDArray[np.float64]) -> Any:  # a frozen distribution of SciPy, which has no types
    """Return the distribution of a sum of squares, of which there are `draws`.

    A multiple of χ² with their mean and variance (Satterthwaite 1946, doi:10.2307/3002019).
    """
    from scipy.stats import chi2

    mean, variance = float(np.mean(draws)), float(np.var(draws))
    scale = max(variance / (2.0 * mean), 1e-300) if mean > 0.0 else 1e-300
    return chi2(max(mean / scale, 1e-3), scale=scale)
