"""Error bars where instants are not those stated, which allow for what a late voltage does to the whole axis.

The observer assumes that a voltage which comes late changes the velocity and nothing else, and that the damping alone
lets that fade. But a flexible coupling rings for it, a drive's integral remembers it, and behind a delay or a lag it
comes later. What is missed is then no longer white; and as only a few jumps of the voltage are large, parameters and
initial states take it up, so that no residual shows it. Each of the large jumps is therefore simulated a sample later,
with the plant and with the plant that the observer assumes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.error_problem import Problem
from servolens.identification.late_inputs import jumps_of
from servolens.identification.observed import ObservedRun
from servolens.identification.restricted import SEEN, parts_at
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import NoiseModel
    from servolens.identification.refine import Refinement

__all__ = ["counting_late_inputs"]

COUNTED, MOST = 0.999, 48
"""Share of the squared jumps of a record that are simulated, the largest first, and how many at most."""


def counting_late_inputs(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with error bars that allow for late jumps of the voltage.

    Where the instants of the noise are those stated, or its input is on time, nothing changes. Parameters and result
    are those of :func:`~servolens.identification.fitted.with_error_bars`.
    """
    if noise.jitter == 0.0 or noise.gain == 0.0:
        return refined
    problem = Problem(
        refined.plant, likelihood.runs(noise, unpowered=unpowered), likelihood.options(refined.plant), None
    )
    errors = np.nan_to_num(np.sqrt(np.diag(refined.covariance)))[problem.free]
    more = np.zeros((errors.size, errors.size))
    with suppress(InputError, NumericalError):
        for moved, assumed in _moved(problem, refined, noise, errors):
            values, vectors = np.linalg.eigh(np.outer(moved, moved) - np.outer(assumed, assumed))
            more += (vectors * np.maximum(values, 0.0)) @ vectors.T
    likelihood.tally.add(problem.simulated)
    covariance = refined.covariance.copy()
    columns = problem.free[::-1]  # of parameters of the records' own the first
    covariance[np.ix_(columns, columns)] += (np.outer(errors, errors) * more)[::-1, ::-1]
    return replace(refined, covariance=covariance)


def _moved(
    problem: Problem, refined: Refinement, noise: NoiseModel, errors: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield by how much the free parameters move, shape (k,), for each jump that comes a standard deviation late.

    In units of their `errors`; those without one are not moved. First as the plant answers to it, then as the observer
    assumes.
    """
    point, parts = parts_at(problem, refined)
    units = np.ones(parts[0].sensitivity.shape[1])
    units[: errors.size] = errors
    sensitivity = np.vstack([part.sensitivity for part in parts]) * units
    lengths = np.linalg.norm(sensitivity, axis=0)
    lengths[lengths == 0.0] = 1.0
    answers = np.linalg.pinv(sensitivity / lengths, rcond=SEEN**0.5) / lengths[:, None]
    ends = np.cumsum([0, *(part.left.size for part in parts)])
    assumed = Plant(gain=noise.gain, damping=noise.damping)
    for i, run in enumerate(problem.runs):
        if not isinstance(run, ObservedRun):
            continue
        own = answers[: problem.free.size, ends[i] : ends[i + 1]]
        plant, start, substeps = problem.plant_at(point.values, i), point.starts[i], problem.substeps[i]
        as_is = [run.missed(one, start, substeps) for one in (plant, assumed)]
        for push, as_assumed, share in _late_jumps(run, noise):
            pushed = [run.missed(one, start, substeps, push=by) for one, by in ((plant, push), (assumed, as_assumed))]
            problem.simulated += 2 * run.simulated
            moved, thought = (own @ run.whiten(share * (late - same)) for late, same in zip(pushed, as_is, strict=True))
            yield moved, thought


def _late_jumps(
    run: ObservedRun, noise: NoiseModel
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], float]]:
    """Yield, for each large jump, what two plants are pushed by when it comes a sample late, and how late it is.

    The voltages [V], shape (n,), of the plant with its effects and of one without; and in samples.
    """
    signals = run.signals
    voltage = signals.voltage
    jumps = jumps_of(noise, signals.time, signals.speed_on_grid, voltage)
    asked = np.maximum(np.abs(jumps), np.abs(noise.gain * np.diff(voltage, prepend=voltage[0])))
    largest = np.argsort(-asked, kind="stable")
    squares = np.cumsum(asked[largest] ** 2)
    count = min(int(np.searchsorted(squares, COUNTED * squares[-1])) + 1, MOST)
    for k in largest[:count]:
        if 0 < k < voltage.size - 1 and asked[k] > 0.0:
            push, plain = np.zeros(voltage.size), np.zeros(voltage.size)
            push[k], plain[k] = voltage[k - 1] - voltage[k], -jumps[k] / noise.gain
            yield push, plain, noise.jitter / float(signals.time[k + 1] - signals.time[k])
