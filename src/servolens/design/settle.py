"""What settling time is, and how far a simulated step is from a spec."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import ceil
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servolens.design.response import Response
from servolens.design.rest import Rest, rest_of
from servolens.effects import Saturation
from servolens.errors import NumericalError
from servolens.simulation import Simulation, simulate_continuous
from servolens.simulation.rates import substeps_for
from servolens.simulation.trial import Accuracy, closed_trial

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["BETWEEN", "FEASIBLE", "SensorNoise", "evaluate", "horizon", "settling_time", "step_response"]

FEASIBLE = 1e-9
"""A constraint, as a fraction of the step, may be exceeded by this much: the simulation's own error."""
BETWEEN = 8
"""Parts of a sample at whose ends an axis is seen between samples: of a swing at half the sampling frequency, 98 %."""
RUNS_AWAY = 30.0
"""Pieces of a substep, on average, from which on a loop runs away: one that hunts or sticks needs less than ten."""


def settling_time(
    time: NDArray[np.float64], error: NDArray[np.float64], tolerance: float, *, final: bool = True
) -> float | None:
    """Return when ``|error|`` enters `tolerance` for good [s].

    Between samples the error is taken as linear. The time counts from ``time[0]``.

    Parameters
    ----------
    time, error : ndarray, shape (n,)
        Samples [s], error in the unit of `tolerance`.
    tolerance : float
        Half width of the band, positive.
    final : bool
        Whether the last sample must lie in the band; otherwise None is returned when it does not.

    Returns
    -------
    float or None
        None if the last sample lies outside the band.

    Examples
    --------
    >>> round(settling_time(np.arange(5.0), np.array([4.0, 2.0, 0.5, 0.5, 0.2]), 1.0), 3)
    1.667
    """
    size = np.abs(error)
    outside = np.flatnonzero(size > tolerance)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    if last + 1 == size.size:
        return None if final else float(time[-1] - time[0])
    here, after = error[last], error[last + 1]
    limit = tolerance * np.sign(here)
    share = (here - limit) / (here - after)
    return float(time[last] + share * (time[last + 1] - time[last]) - time[0])


class SensorNoise(NamedTuple):
    """White noise of the position that the loop measures: its standard deviation [m or rad], and the seed of a draw."""

    deviation: float
    seed: int

    def drawn(self, samples: int) -> NDArray[np.float64]:
        """Return it, shape (samples,): of fewer samples the same ones."""
        return self.deviation * np.random.default_rng(self.seed).standard_normal(samples)


def step_response(
    plant: Plant,
    spec: PDSpec,
    kd: float,
    duration: float,
    *,
    back: bool = False,
    noise: SensorNoise | None = None,
    held: bool = True,
    parts: int = 1,
) -> Simulation:
    """Simulate the step of `spec` for `duration` seconds; with `back`, from the reference back to 0.

    Before it the loop holds the axis still: see :func:`servolens.design.rest.rest_of`. An axis that is not `held`
    begins at the reference without a voltage and with an empty integral: what pulls it is let go with the step.
    A loop that is sampled answers to the `noise` of the sensor, if there is some. Each sample of the loop is seen in
    `parts`.
    """
    period = spec.sample_time / parts
    time = _instants(period, parts * ceil(duration / spec.sample_time) + 1)
    begin, end = (spec.reference, 0.0) if back else (0.0, spec.reference)
    reference, loop = np.full(time.size, end), spec.loop(kd)
    rest = rest_of(plant, loop, begin) if held else Rest(begin, 0.0, 0.0)
    start = (rest.position, 0.0)
    if spec.control == "continuous":
        return simulate_continuous(plant, spec.kp, kd, time, reference, start=start, reference_before=begin)
    limit = None if plant.effect(Saturation.name) is not None else np.inf
    error = None if noise is None else noise.drawn(time.size)
    loop = replace(loop, integral_before=rest.integral, control_period=spec.sample_time if parts > 1 else None)
    before = rest.applied
    trial = closed_trial(
        loop, time, reference, before=before, limit=limit, sensor_error=error, accuracy=Accuracy(RUNS_AWAY)
    )
    return trial.simulated(plant, start, substeps_for(plant, period))


@lru_cache(maxsize=64)
def _instants(sample_time: float, count: int) -> NDArray[np.float64]:
    """Return the sampling instants, which many steps share: read-only."""
    time = np.asarray(sample_time * np.arange(count), dtype=np.float64)
    time.setflags(write=False)
    return time


def evaluate(
    plant: Plant,
    spec: PDSpec,
    kd: float,
    *,
    back: bool = False,
    duration: float | None = None,
    noise: SensorNoise | None = None,
    held: bool = True,
    parts: int = 1,
) -> Response:
    """Simulate the step and measure it against the spec.

    Parameters
    ----------
    plant : Plant
        The axis.
    spec : PDSpec
        What to reach.
    kd : float
        Derivative gain [V s/m].
    back : bool
        Whether the step is the one back, from the reference to 0.
    duration : float, optional
        How long the step is watched [s]; None for as long as :func:`horizon` tells.
    noise : SensorNoise, optional
        Of the position that the loop measures; it is the axis itself that has to settle.
    held : bool
        Whether the loop holds the axis before the step; else it is released with it.
    parts : int
        Into how many each sample is divided at whose ends the axis is seen; 1 for the samples alone.
    """
    watched = duration or horizon(plant, spec)
    try:
        run = step_response(plant, spec, kd, watched, back=back, noise=noise, held=held, parts=parts)
    except NumericalError:
        nothing = {"overshoot": np.inf, "peak_voltage": np.inf, "peak_speed": np.inf, "final_error": np.inf}
        return Response(kd=kd, settling_time=None, meets=False, stable=False, **nothing)
    return measured(run, spec, kd, back=back)


def measured(run: Simulation, spec: PDSpec, kd: float, *, back: bool = False) -> Response:
    """Measure a simulated step with the derivative gain `kd` against the spec; see :func:`evaluate`."""
    step = -spec.reference if back else spec.reference
    left = ((0.0 if back else spec.reference) - run.position) / step
    overshoot = max(0.0, float(-left.min()))
    settled = settling_time(run.time, left, spec.band + FEASIBLE)
    peak = float(np.abs(run.voltage).max())
    meets = settled is not None and settled <= spec.settling_time * (1 + 1e-9)
    meets = meets and (spec.overshoot is None or overshoot <= spec.overshoot + FEASIBLE)
    meets = meets and (spec.voltage_limit is None or peak <= spec.voltage_limit * (1 + FEASIBLE))
    return Response(
        kd=kd,
        settling_time=settled,
        overshoot=overshoot,
        peak_voltage=peak,
        peak_speed=float(np.abs(run.velocity).max()),
        final_error=float(left[-1] * np.sign(step)),
        meets=bool(meets),
    )


def closed_loop_gain(plant: Plant, spec: PDSpec, kd: float, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the complementary sensitivity |T| at each `frequency` [Hz], of a step as large as the spec's.

    With the loop's drive g, the command at a position that stands still, T is 1 − u/g; as the spectrum of the simulated
    step has it, so that it holds for plants that are not linear.

    Raises
    ------
    NumericalError
        If the loop is unstable.
    """
    run, loop = step_response(plant, spec, kd, horizon(plant, spec)), spec.loop(kd)
    changes = np.diff(run.voltage, prepend=rest_of(plant, loop, 0.0).applied)
    drive = spec.reference * loop.reference_path(frequency, spec.sample_time)
    found: NDArray[np.float64] = np.abs(1.0 - _spectrum(changes, frequency * spec.sample_time) / drive)
    return found


def _spectrum(values: NDArray[np.float64], frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the Fourier sum of evenly spaced values at each `frequency` [1/sample].

    In blocks, as exp(−2πjf(pq + r)) is a product: waves have to be computed for twice √n instants only.
    """
    size = ceil(np.sqrt(values.size))
    blocks = np.append(values, np.zeros(-values.size % size)).reshape(-1, size)
    turn = -2j * np.pi * frequency[:, None]
    within = np.exp(turn * np.arange(size)) @ blocks.T
    found: NDArray[np.complex128] = np.sum(within * np.exp(turn * size * np.arange(blocks.shape[0])), axis=1)
    return found


def horizon(plant: Plant, spec: PDSpec) -> float:
    """Return how long a step is watched [s]: ten settling times, or three periods of the undamped loop after one.

    Of a slow loop no more than twenty settling times are watched after the first.
    """
    period = 2.0 * np.pi / max(spec.rate(plant.gain), 1e-6)
    return float(spec.settling_time * max(10.0, 1.0 + min(3.0 * period / spec.settling_time, 20.0)))
