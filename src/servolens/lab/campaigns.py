"""Whole measuring campaigns on one virtual axis: those of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.lab.bench import step_record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.lab.truth import Truth
    from servolens.record import Record

__all__ = ["TABLE_ONE_GAINS", "paper_campaign", "table_one"]

TABLE_ONE_GAINS = ((60, 0), (60, 5), (80, 0), (80, 5), (80, 10), (100, 0), (100, 5), (100, 10))
"""(Kp, Kd) of the eight experiments of Table I."""


def paper_campaign(truth: Truth, seed: int, *, noise: float = 1e-5, encoder: float = 1e-5) -> tuple[Record, ...]:
    """Log the three proportional steps to 0.1 m that the paper identifies from: Kp 60, 80 and 100, 1.5 s at 1 kHz.

    Parameters
    ----------
    truth : Truth
        The axis.
    seed : int
        Of the sensor's noise; each record has a stream of its own.
    noise, encoder : float
        Standard deviation and resolution of the sensor [m].

    Returns
    -------
    tuple of Record, length 3

    Examples
    --------
    >>> from servolens import lab
    >>> [record.name for record in lab.paper_campaign(lab.NLM1, seed=1)]
    ['kp 60, kd 0', 'kp 80, kd 0', 'kp 100, kd 0']
    """
    return _steps(truth, ((60, 0), (80, 0), (100, 0)), seed, noise, encoder)


def table_one(truth: Truth, seed: int, *, noise: float = 1e-5, encoder: float = 1e-5) -> tuple[Record, ...]:
    """Log the eight PD steps of Table I, in its order; parameters as in :func:`paper_campaign`.

    Examples
    --------
    >>> from servolens import lab
    >>> len(lab.table_one(lab.NLM1, seed=1))
    8
    """
    return _steps(truth, TABLE_ONE_GAINS, seed, noise, encoder)


def _steps(
    truth: Truth, gains: Sequence[tuple[float, float]], seed: int, noise: float, encoder: float
) -> tuple[Record, ...]:
    streams = np.random.default_rng(seed).spawn(len(gains))
    return tuple(
        step_record(truth, kp, kd, noise=noise, encoder=encoder, seed=stream)
        for (kp, kd), stream in zip(gains, streams, strict=True)
    )
