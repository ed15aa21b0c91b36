"""Slow noise beside white noise, as the residual of a fit shows it: the fit has followed a part of it.

What parameters and initial states have taken up of slow noise is missing from the residual: a spectrum that is read
off it is too small at low frequencies, where a model's motion is, and so are error bars beside it. The restricted
likelihood knows what they can take up (Patterson and Thompson 1971, doi:10.1093/biomet/58.3.545; Harville 1977,
doi:10.2307/2286796). Few time constants of the noise fit into a record, so that many spectra are about as likely. The
variance of an estimate is linear in the spectrum, so that their mean stands for them all, as closely as a filter of
finite order has it: beside much white noise, of very long time constants, within a factor of about two.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.errors import NumericalError
from servolens.identification.autoregression import burg
from servolens.identification.error_problem import COARSE, Problem
from servolens.identification.noise import MOST_ORDER, NoiseModel
from servolens.identification.rounding import has_mean
from servolens.identification.slow_noise import FREQUENCIES, LONGEST, filters_of, spectra

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.identification.error_problem import Point
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import Whitener
    from servolens.identification.refine import Refinement

__all__ = [
    "SEEN",
    "Estimate",
    "Part",
    "counting_followed",
    "estimated",
    "mean_spectrum",
    "parts_at",
    "parts_of",
    "with_followed",
]

TIMES = 14
"""Time constants of slow noise that are compared, evenly in their logarithms."""
RATIOS, ROUNDS = np.geomspace(1e-2, 1e4, 7), 4
"""Ratios of the variances of white noise and of what drives the slow one, to begin with; times that the step between
them is halved about the likeliest, and that a filter is renewed."""
SEEN = 1e-12
"""Share of the largest eigenvalue of the information, its diagonal 1, below which nothing is said."""
SLOW = 2
"""Parameters of that noise beside its size."""


class Part(NamedTuple):
    """Of one record what a fit has left, shape (n,), and how that answers to parameters and initial state, (n, p)."""

    left: NDArray[np.float64]
    sensitivity: NDArray[np.float64]


def counting_followed(likelihood: Likelihood, hypothesis: Hypothesis) -> Hypothesis:
    """Return the hypothesis beside the noise for error bars: of slow noise, what the fit has followed is part of it."""
    if likelihood.simulates or hypothesis.noise.is_model_error:  # what a model lacks is no noise
        return hypothesis
    found = likelihood.whitened_well(hypothesis)
    noise = found.noise
    if noise.is_observed or noise.order == 0:
        return found
    white = replace(NoiseModel.white(1.0), lines=noise.lines)
    problem = Problem(
        found.plant, likelihood.runs(white, unpowered=found.unpowered), likelihood.options(found.plant), None
    )
    parts = parts_of(problem, problem.at(found.starts, found.local))
    if sum(part.left.size for part in parts) <= parts[0].sensitivity.shape[1]:
        return found
    spectrum, slow = mean_spectrum(parts, FREQUENCIES + 1)
    runs = likelihood.runs(noise)
    whiteners = [run.whiten for run in runs]
    if has_mean(runs):  # what an encoder's rounding adds to slow noise is not white
        noise = with_followed(noise, parts, whiteners)
        whiteners = [w.beside(noise) for w in whiteners]
    whitened = [Part(w(p.left), w(p.sensitivity)) for w, p in zip(whiteners, parts, strict=True)]
    filtered = estimated(whitened, sum(w.log_determinant for w in whiteners)).misfit + 2.0 * noise.parameters
    is_slow = noise.order == 1 or noise.parameters == SLOW < noise.order  # of the same kind, of one time constant only
    if not is_slow and filtered < slow + 2.0 * SLOW:
        return replace(found, noise=with_followed(noise, parts, whiteners))
    filters, scales = filters_of(spectrum, MOST_ORDER)
    scales = np.maximum(scales, noise.least)
    spread = float(scales[0])
    counted = replace(
        noise, filters=filters, scales=scales, spread=spread, parameters=SLOW, is_fitted=True, counts_followed=True
    )
    return replace(found, noise=counted)


def with_followed(noise: NoiseModel, parts: Sequence[Part], whiteners: Sequence[Whitener]) -> NoiseModel:
    """Return the noise whose filter suits what `parts` have left and what their fit has followed.

    What it has followed is not known, but its covariance is: that of the estimates. So its squares are added to those
    of the residual as they are expected beside the filter, and the filter is renewed (expectation and maximisation of
    the restricted likelihood: Laird and Ware 1982, doi:10.2307/2529876).
    """
    left = [w.weighed(w.steady(part.left)) for w, part in zip(whiteners, parts, strict=True)]
    for _ in range(ROUNDS):
        white = [Part(w(part.left), w(part.sensitivity)) for w, part in zip(whiteners, parts, strict=True)]
        root = estimated(white, 0.0).root
        followed = [w.weighed(part.sensitivity @ root).T for w, part in zip(whiteners, parts, strict=True)]
        filters, scales = burg(left, MOST_ORDER, 2.0, [column for rows in followed for column in rows])
        scales = np.maximum(scales, noise.least)
        spread, order = float(scales[0]), len(filters) - 1
        noise = replace(noise, filters=filters, scales=scales, spread=spread, parameters=order, counts_followed=True)
        whiteners = [w.beside(noise) for w in whiteners]
    return noise


def parts_of(
    problem: Problem, point: Point, widths: NDArray[np.float64] | None = None, *, whole: bool = False
) -> list[Part]:
    """Return what `problem` leaves of each run at `point`, as far as it is compared with measurements.

    Or the `whole` residual, with what holds the initial states. The columns of the sensitivity are the parameters, of
    differences at least these `widths`, then the initial states of all runs.
    """
    sets = problem.differences(point, widths)
    states = np.cumsum([0, *(initial.shape[1] for _, _, initial in sets)])
    parts = []
    for i, (run, (residual, jacobian, initial)) in enumerate(zip(problem.runs, sets, strict=True)):
        count = residual.size if whole else run.samples
        own = np.zeros((count, states[-1]))
        own[:, states[i] : states[i + 1]] = initial[:count]
        parts.append(Part(residual[:count], np.hstack([jacobian[:count], own])))
    return parts


def parts_at(problem: Problem, refined: Refinement, *, whole: bool = False) -> tuple[Point, list[Part]]:
    """Return the optimum that was `refined` as a point of `problem`, and its parts there, priors after the records.

    See :func:`parts_of`. Parameters at the end of their range do not answer.

    Raises
    ------
    NumericalError
        If the plant cannot be simulated, or there are no more samples than unknowns.
    """
    point = problem.at(refined.starts, refined.local)
    problem.choose_substeps(point)
    parts, k = parts_of(problem, point, _widths(problem, point, refined), whole=whole), problem.free.size
    free = np.ones(parts[0].sensitivity.shape[1])
    if sum(part.left.size for part in parts) <= free.size:
        raise NumericalError("there are no more samples than unknowns")
    free[:k] = (point.values > problem.low) & (point.values < problem.high)
    parts = [part._replace(sensitivity=part.sensitivity * free) for part in parts]
    for index, prior in problem.priors:
        said = np.zeros((1, free.size))
        said[0, index] = free[index] / prior.deviation
        parts.append(Part(np.array([(point.values[index] - prior.value) / prior.deviation]), said))
    return point, parts


def _widths(problem: Problem, point: Point, refined: Refinement) -> NDArray[np.float64]:
    """Return how far to look for slopes, as for the error bars: dry friction and contacts leave small ones rough."""
    errors = np.nan_to_num(np.sqrt(np.diag(refined.covariance))[problem.free])
    narrow = np.minimum(errors, 0.1 * np.abs(point.values))
    is_rough = problem.touched if not refined.is_smooth else np.zeros_like(problem.touched)
    return np.where(is_rough, problem.share_of(point, COARSE), narrow)


def mean_spectrum(parts: Sequence[Part], frequencies: int) -> tuple[NDArray[np.float64], float]:
    """Return the mean spectrum of the noise at even frequencies up to half, shape (m,), and the least of all misfits.

    In variance a sample. Noise of one time constant beside white noise, their ratio the likeliest of each. Beforehand
    a time constant is as likely as the reference prior of a first-order process has it (Berger and Yang 1994,
    doi:10.1017/S0266466600008690).

    Parameters
    ----------
    parts : sequence of Part
        One of each record.
    frequencies : int
        How many.
    """
    times = np.geomspace(1.0, LONGEST, TIMES)
    poles = np.exp(-1.0 / times)
    ratios, misfits, sizes = _likeliest_ratios(poles, parts)
    weights = np.exp(-0.5 * (misfits - misfits.min())) / np.sqrt(times)
    weights *= sizes / weights.sum()
    grid = np.column_stack([np.log(times), np.log(ratios)])
    return np.asarray(weights @ spectra(grid, np.linspace(0.0, np.pi, frequencies))), float(misfits.min())


class Estimate(NamedTuple):
    """What parts say of their parameters beside one noise, and of that.

    −2 restricted log-likelihood; the change of each column's parameter that leaves least, shape (p,), and a root R of
    their covariance R Rᵀ, shape (p, p). Both are 0 where nothing is said of a parameter.
    """

    misfit: float
    change: NDArray[np.float64]
    root: NDArray[np.float64]

    @property
    def variances(self) -> NDArray[np.float64]:
        """Of the parameters, shape (p,)."""
        return np.asarray(np.sum(self.root**2, axis=1))


def estimated(parts: Sequence[Part], determinant: float) -> Estimate:
    """Return the estimate of `parts` that a filter has whitened up to their size.

    Parameters
    ----------
    parts : sequence of Part
        Whitened.
    determinant : float
        Of the filter: −2 log of its Jacobian.
    """
    rows = [np.column_stack([part.left, part.sensitivity]) for part in parts]
    squares = np.asarray(sum(one.T @ one for one in rows))
    misfits, sizes = _restricted(squares[None], np.array([determinant]), sum(map(len, rows)))
    inner, along = squares[1:, 1:], squares[1:, 0]
    scale = np.sqrt(np.diag(inner))
    scale[scale == 0.0] = np.inf
    values, vectors = np.linalg.eigh(inner / np.outer(scale, scale))
    seen = values > SEEN * values[-1]
    root = vectors / np.sqrt(np.where(seen, values, np.inf)) / scale[:, None]
    return Estimate(float(misfits[0]), -(root @ (root.T @ along)), np.sqrt(float(sizes[0])) * root)


def _likeliest_ratios(poles: NDArray[np.float64], parts: Sequence[Part]) -> tuple[NDArray[np.float64], ...]:
    """Return for each of the `poles` the likeliest ratio, the misfit there, and the size of the noise."""
    ratios, step = np.broadcast_to(RATIOS, (poles.size, RATIOS.size)), float(RATIOS[1] / RATIOS[0])
    for _ in range(ROUNDS + 1):
        shape = ratios.shape
        found = _compared(np.repeat(poles, shape[1]), ratios.ravel(), parts)
        misfits, sizes = (one.reshape(shape) for one in found)
        best = np.arange(poles.size), np.argmin(misfits, axis=1)
        step = float(np.sqrt(step))
        likeliest = ratios[best]
        ratios = likeliest[:, None] * np.array([1.0 / step, 1.0, step])
    return likeliest, misfits[best], sizes[best]


def _compared(
    poles: NDArray[np.float64], ratios: NDArray[np.float64], parts: Sequence[Part]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return −2 restricted log-likelihood of the parts beside each noise, and its size."""
    rows = [np.column_stack([part.left, part.sensitivity]) for part in parts]
    size = rows[0].shape[1]
    squares, determinants = np.zeros((poles.size, size, size)), np.zeros(poles.size)
    for one in rows:
        answers = np.flatnonzero(one.any(axis=0))  # no record answers to the initial state of another
        own = np.ascontiguousarray(one[:, answers])
        for k, (pole, ratio) in enumerate(zip(poles.tolist(), ratios.tolist(), strict=True)):
            products, determinant = _squares(pole, ratio, own)
            squares[k][np.ix_(answers, answers)] += products
            determinants[k] += determinant
    return _restricted(squares, determinants, sum(map(len, rows)))


def _squares(pole: float, ratio: float, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the products of `rows`, shape (n, k), as white as this noise makes them, and the log of its determinant.

    By the steady Kalman filter of the slow noise. That this is stationary before the first sample, and so less known
    than later, is a random start of it.
    """
    from scipy.signal import lfilter

    b = ratio * (1.0 - pole**2) - 1.0
    variance = 0.5 * (np.sqrt(b**2 + 4.0 * ratio) - b)
    expected = variance + ratio
    forgets = pole * ratio / expected
    white = lfilter([1.0, -pole], [1.0, -forgets], rows, axis=0) / np.sqrt(expected)
    start = forgets ** np.arange(rows.shape[0]) / np.sqrt(expected)
    seen, more = float(start @ start), max(1.0 / (1.0 - pole**2) - variance, 0.0)
    along = start @ white
    squares = white.T @ white - np.outer(along, along) * (more / (1.0 + more * seen))
    return squares, rows.shape[0] * float(np.log(expected)) + float(np.log1p(more * seen))


def _restricted(
    squares: NDArray[np.float64], determinants: NDArray[np.float64], samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return −2 restricted log-likelihood, and the size of the noise, of sums of squares, shape (k, 1 + p, 1 + p)."""
    inner, along = squares[:, 1:, 1:], squares[:, 1:, 0]
    scale = np.sqrt(np.einsum("kii->ki", inner))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(inner / scale[:, :, None] / scale[:, None, :])
    seen = values > SEEN * values[:, -1:]
    moved = np.einsum("kij,ki->kj", vectors, along / scale)
    explained = np.sum(np.where(seen, moved**2 / np.maximum(values, 1e-300), 0.0), axis=1)
    left = np.maximum(squares[:, 0, 0] - explained, 1e-300)
    freedom = samples - np.sum(seen, axis=1)
    information = np.sum(np.where(seen, np.log(np.maximum(values, 1e-300)), 0.0), axis=1) + 2.0 * np.sum(
        np.log(scale), axis=1
    )
    return freedom * np.log(left / freedom) + determinants + information, left / freedom
