"""Autoregressive noise: the filters that whiten it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["burg"]


def burg(
    signals: Sequence[NDArray[np.float64]], most: int, price: float, unseen: Sequence[NDArray[np.float64]] = ()
) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Return the prediction-error filters of order 0 … p of an autoregressive process, and what each leaves.

    Burg's method over all `signals` together; p makes the likelihood, its price paid, largest.

    Parameters
    ----------
    signals : sequence of ndarray
        Realisations of one process with mean 0.
    most : int
        Highest order.
    price : float
        Of an order, in −2 log-likelihood.
    unseen : sequence of ndarray
        What else the process is expected to have, in parts whose squares add up, such as what a fit has taken off it:
        it counts, but is no further sample.

    References
    ----------
    J. P. Burg, *Maximum entropy spectral analysis*, PhD thesis, Stanford, 1975.
    """
    samples = sum(signal.size for signal in signals)
    forward, backward = [*signals, *unseen], [*signals, *unseen]
    power = max(sum(float(s @ s) for s in forward) / samples, 1e-300)
    filters, powers = [np.ones(1)], [power]
    for _ in range(min(most, min(signal.size for signal in signals) // 4)):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True)]
        both = sum(float(f @ b) for f, b in pairs)
        reflection = 2.0 * both / max(sum(float(f @ f + b @ b) for f, b in pairs), 1e-300)
        forward = [f - reflection * b for f, b in pairs]
        backward = [b - reflection * f for f, b in pairs]
        longer = np.append(filters[-1], 0.0)
        filters.append(longer - reflection * longer[::-1])
        powers.append(max(powers[-1] * (1.0 - reflection**2), 1e-300))
    costs = price * np.arange(len(powers))
    order = int(np.argmin(samples * np.log(powers) + costs))
    return tuple(filters[: order + 1]), np.sqrt(powers[: order + 1])
