"""Velocity from measured position by a short local cubic."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["slope_noise", "smooth", "smoothing_window", "speed_of", "value_weights"]

SPEED_WINDOW = 21
"""Samples of the derivative by which the jitter of sampling instants is weighed."""


def smooth(
    time: NDArray[np.float64], signal: NDArray[np.float64], window: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the value and the derivative of a cubic fitted to the `window` samples around each sample.

    Savitzky and Golay (1964), doi:10.1021/ac60214a047; at the ends the outermost cubic is evaluated off its centre.

    Parameters
    ----------
    time, signal : ndarray, shape (n,)
        Samples; local spacing may drift slowly, not jump.
    window : int
        Odd number of samples, at least 5; a longer one than the signal is shortened.

    Returns
    -------
    value, derivative : ndarray, shape (n,)
    """
    n = signal.size
    window = min(window, n if n % 2 else n - 1)
    half = window // 2
    value_weights, slope_weights = _weights(window)
    value, slope = np.empty(n), np.empty(n)
    value[half : n - half] = np.convolve(signal, value_weights[half][::-1], mode="valid")
    slope[half : n - half] = np.convolve(signal, slope_weights[half][::-1], mode="valid")
    value[:half], slope[:half] = value_weights[:half] @ signal[:window], slope_weights[:half] @ signal[:window]
    tail = signal[n - window :]
    value[n - half :], slope[n - half :] = value_weights[half + 1 :] @ tail, slope_weights[half + 1 :] @ tail
    return value, slope / np.gradient(time)


def speed_of(time: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return |velocity|, shape (n,) [m/s or rad/s]."""
    return np.abs(smooth(time, position, min(SPEED_WINDOW, time.size))[1])


def smoothing_window(duration: float, sample_time: float) -> int:
    """Return the window for motion whose quarter period is `duration` [s]: a seventh of it, 5 to 101 samples, odd."""
    return int(np.clip(round(duration / 7.0 / sample_time), 5, 101)) // 2 * 2 + 1


def value_weights(window: int) -> NDArray[np.float64]:
    """Return the weights that give the fitted cubic's value at each place of the window, shape (window, window)."""
    return _weights(window)[0]


def slope_noise(window: int) -> float:
    """Return the standard deviation of the derivative at the window's middle, per sample, for unit white noise."""
    return float(np.linalg.norm(_weights(window if window % 2 else window - 1)[1][window // 2]))


@lru_cache(maxsize=64)
def _weights(window: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of value and slope (per sample) at each place in the window, shape (window, window)."""
    place = np.arange(window) - window // 2
    powers = min(3, window - 1)
    basis = np.vander(place.astype(np.float64), powers + 1, increasing=True)
    fit = np.linalg.pinv(basis)
    slopes = np.column_stack([np.zeros(window), *(k * basis[:, k - 1] for k in range(1, powers + 1))])
    return basis @ fit, slopes @ fit
