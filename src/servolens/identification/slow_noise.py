"""Noise that changes slowly beside white noise or rounding: two time constants at most, by their spectrum.

An autoregressive process plus white noise is none itself: beside rounding, slow noise of one time constant asks for a
long filter, whose many coefficients the data give only roughly, most of all at low frequencies, where a model's motion
is. Its spectrum has two or three parameters. They are found by Whittle's likelihood, which compares the periodogram
with the spectrum (Whittle 1953, doi:10.1007/BF02590998).
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["FREQUENCIES", "LONGEST", "filters_of", "slow_filters", "spectra"]

SLOW_PARAMETERS = (2, 3)
"""Beside its size: time constant and share of white noise; two time constants and that share."""
BANDS, FREQUENCIES = 120, 4096
"""Bands of the periodogram, evenly in the logarithm of frequency; frequencies at which a spectrum becomes a filter."""
LONGEST, TIMES, SHARES = 2000.0, 24, 14
"""Longest time constant [samples], and numbers of those and of shares of white noise that are compared first."""
FINER = 3
"""Times that the grid about the likeliest is made finer by half."""


def slow_filters(
    signals: Sequence[NDArray[np.float64]], most: int
) -> list[tuple[int, tuple[NDArray[np.float64], ...], NDArray[np.float64]]]:
    """Return, with one time constant and with two, how many parameters that is, and the process' prediction errors.

    Of those: the filters of order 0 … `most`, and the standard deviations that each leaves.

    Parameters
    ----------
    signals : sequence of ndarray
        Realisations of one process with mean 0.
    most : int
        Highest order of a filter.
    """
    bands = _bands(tuple(signal.size for signal in signals))
    power = bands.power(signals)
    if power.size == 0 or not power.min() > 0.0:
        return []
    found = []
    for parameters in SLOW_PARAMETERS:
        place = bands.likeliest(power, parameters)
        filters, scales = filters_of(spectra(place, np.linspace(0.0, np.pi, FREQUENCIES + 1))[0], most)
        size = np.sqrt(_left(filters[-1], signals)) / scales[-1]
        found.append((parameters, filters, size * scales))
    return found


@final
class _Bands:
    """Bands of the periodogram of signals of these sizes, and the spectra of a first grid in them."""

    def __init__(self, sizes: tuple[int, ...]) -> None:
        edges = np.geomspace(np.pi / 4096.0, np.pi * (1.0 + 1e-9), BANDS + 1)
        counts, sums, self._places = np.zeros(BANDS), np.zeros(BANDS), {}
        for size in sizes:
            frequencies = np.arange(1, size // 2 + 1) * (2.0 * np.pi / size)
            band = self._places[size] = np.clip(np.searchsorted(edges, frequencies) - 1, 0, BANDS - 1)
            counts += np.bincount(band, minlength=BANDS)
            sums += np.bincount(band, frequencies, BANDS)
        self._kept = counts > 0
        self.counts = counts[self._kept]
        self.frequencies = sums[self._kept] / self.counts
        self._first = {parameters: self._compared(_first_grid(parameters)) for parameters in SLOW_PARAMETERS}

    def power(self, signals: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the mean periodogram of `signals` in each band."""
        sums = np.zeros(BANDS)
        for signal in signals:
            sums += np.bincount(self._places[signal.size], np.abs(np.fft.rfft(signal)[1:]) ** 2 / signal.size, BANDS)
        return sums[self._kept] / self.counts

    def likeliest(self, power: NDArray[np.float64], parameters: int) -> NDArray[np.float64]:
        """Return the logarithms of time constants and share of white noise that make the periodogram likeliest."""
        steps = np.array([np.log(LONGEST) / (TIMES - 1)] * (parameters - 1) + [np.log(1e5) / (SHARES - 1)])
        grid, compared = _first_grid(parameters), self._first[parameters]
        for finer in range(FINER + 1):
            best = grid[int(np.argmin(self._misfits(compared, power)))]
            if finer < FINER:
                steps = 0.5 * steps
                axes = [value + step * np.array([-1.0, 0.0, 1.0]) for value, step in zip(best, steps, strict=True)]
                grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, parameters)
                compared = self._compared(grid)
        return np.asarray(best[None, :])

    def _compared(self, grid: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse of each spectrum of `grid`, shape (rows, bands), and the logarithm of its determinant."""
        found = spectra(grid, self.frequencies)
        return 1.0 / found, np.log(found) @ self.counts

    def _misfits(
        self, compared: tuple[NDArray[np.float64], NDArray[np.float64]], power: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return −2 log-likelihood of the periodogram beside each spectrum, the size of each the likeliest."""
        inverse, determinants = compared
        total = self.counts.sum()
        return np.asarray(total * np.log(inverse @ (self.counts * power) / total) + determinants)


_bands = lru_cache(maxsize=8)(_Bands)


@cache
def _first_grid(parameters: int) -> NDArray[np.float64]:
    times = np.linspace(0.0, np.log(LONGEST), TIMES)
    shares = np.log(1e-2) + np.linspace(0.0, np.log(1e5), SHARES)
    chosen = [times] if parameters == SLOW_PARAMETERS[0] else [times, times[: TIMES // 2]]
    return np.stack(np.meshgrid(*chosen, shares, indexing="ij"), axis=-1).reshape(-1, parameters)


def spectra(grid: NDArray[np.float64], frequencies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of each row of `grid` in units of its innovation's, shape (rows, frequencies)."""
    found = np.ones((grid.shape[0], frequencies.size))
    cosine = np.cos(frequencies)
    for times in grid[:, :-1].T:
        pole = np.exp(-np.exp(-times))[:, None]
        found /= 1.0 + pole * pole - 2.0 * pole * cosine
    return np.asarray(found + np.exp(grid[:, -1:]))


def filters_of(spectrum: NDArray[np.float64], most: int) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Return the prediction-error filters of order 0 … `most`, and what each leaves (Levinson 1946)."""
    covariance = np.fft.irfft(spectrum)[: most + 1]
    filters, powers = [np.ones(1)], [float(covariance[0])]
    for order in range(1, most + 1):
        last = filters[-1]
        reflection = -float(last @ covariance[order:0:-1]) / powers[-1]
        longer = np.append(last, 0.0)
        filters.append(longer + reflection * longer[::-1])
        powers.append(powers[-1] * max(1.0 - reflection**2, 1e-12))
    return tuple(filters), np.sqrt(powers)


def _left(filter_: NDArray[np.float64], signals: Sequence[NDArray[np.float64]]) -> float:
    """Return the mean square of what the filter leaves of the signals, but for their first samples."""
    begun = filter_.size - 1
    squares = [np.convolve(signal, filter_)[begun : signal.size] ** 2 for signal in signals if signal.size > begun]
    return max(float(np.mean(np.concatenate(squares))), 1e-300) if squares else 1e-300
