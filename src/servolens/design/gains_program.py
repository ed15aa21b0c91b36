"""The nonlinear program with several unknown gains: multiple shooting over the sampled loop, in CasADi.

Unknown are the gains, the half width of the band, the peak of sensitivity, and the states of the loop at the ends of
the shooting intervals. What is to be least is a weighted sum of kd, the noise of the command, the band and the peak;
what is not asked for has infinite bounds: one program serves all objectives. Dry friction is smoothed; the width of its
change of sign is reduced from one solution to the next, each of which starts where the last one ended.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.margins import POINTS, frequencies, plant_responses
from servolens.design.program import Loop
from servolens.design.rest import NOT_HELD, held_by
from servolens.effects import DryFriction
from servolens.simulation.rates import fixed_substeps_for
from servolens.solving import NonlinearProgram, minimise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.effects import Effect
    from servolens.plant import Plant

    Array = NDArray[np.float64]

__all__ = ["GAINS", "Limits", "local_gains"]

GAINS = ("kp", "kd", "derivative_filter")
"""Gains that can be free."""
WATCHED = 3.0
"""Settling times for which the band is asked for; the exact loop is then watched for the whole horizon."""
INTERVALS = 8
"""Of the shooting."""
INSIDE = 1e-3
"""Share of the limits that is kept in reserve: integrator and friction here are not those of the exact loop."""
WIDTHS = (3e-2, 1e-2, 3e-3)
"""Speeds over which dry friction changes sign, one after the other, as shares of step over settling time."""
SLOWEST = 16
"""Most substeps a sample."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What the linearised loop and the noise must keep to, beside the spec; None is no limit.

    Attributes
    ----------
    peak_sensitivity, peak_complementary : float or None
        Largest Ms and Mt.
    delay_margin : float or None
        Least delay margin [s].
    noise_gain : float or None
        Largest r.m.s. of the command for white measurement noise of r.m.s. 1 [V/m].
    """

    peak_sensitivity: float | None = None
    peak_complementary: float | None = None
    delay_margin: float | None = None
    noise_gain: float | None = None


def local_gains(
    plants: Sequence[Plant],
    spec: PDSpec,
    limits: Limits,
    *,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    weights: Mapping[str, float],
    watched: float | None = None,
) -> dict[str, float] | None:
    """Return the gains to which CasADi and IPOPT come from `start`; None if they find no optimum.

    Parameters
    ----------
    plants : sequence of Plant
        All of them have to meet the spec.
    spec : PDSpec
        What to reach.
    limits : Limits
        What else to keep to.
    start, bounds : mapping
        Of each of :data:`GAINS`; where the bounds coincide, the gain is not free.
    weights : mapping
        What is to be least: ``"kd"``, ``"noise"``, ``"band"``, ``"peak"``; the band is free only where it is weighted.
    watched : float, optional
        How long the band is asked for [s]; by default for `WATCHED` settling times.
    """
    plants = [replace(plant, effects=tuple(e for e in plant.effects if not e.absent)) for plant in plants]
    grid = [_grid(plant, spec) for plant in plants]
    count = int(np.ceil((watched or WATCHED * spec.settling_time) / spec.sample_time / INTERVALS))
    made = _program(tuple(p.structure for p in plants), tuple(grid), spec.control == "continuous", count)
    scales = np.array([max(start[name], 1e-3 * bounds[name][1], 1e-12) for name in GAINS])
    begin = np.array([start[name] for name in GAINS]) / scales
    speed = abs(spec.reference) / spec.settling_time
    is_rough = any(issubclass(cls, DryFriction) for plant in plants for cls in plant.structure)
    found = None
    for width in WIDTHS if is_rough else WIDTHS[-1:]:
        given = _parameters(plants, spec, limits, scales, width * speed, weights)
        states = made.states(begin, given)
        x = np.concatenate([begin, [spec.band, limits.peak_sensitivity or 2.0], states])
        result = minimise(
            made.program,
            x,
            bounds=_bounds(bounds, scales, spec, weights, states.size),
            constraint_bounds=_constraints(spec, limits, made, len(plants)),
            parameters=given,
        )
        if not result.success:
            break
        begin = found = result.x[: len(GAINS)]
    return None if found is None else dict(zip(GAINS, (found * scales).tolist(), strict=True))


def _grid(plant: Plant, spec: PDSpec) -> tuple[int, int, bool]:
    """Return substeps, whole samples of delay, and whether it ends within a sample."""
    late, due = divmod(plant.delay / spec.sample_time, 1.0)
    return min(fixed_substeps_for(plant, spec.sample_time), SLOWEST), int(late), due > 0.0


def _bounds(
    bounds: Mapping[str, tuple[float, float]], scales: Array, spec: PDSpec, weights: Mapping[str, float], states: int
) -> tuple[Array, Array]:
    low, high = (np.array([bounds[name][end] for name in GAINS]) / scales for end in (0, 1))
    band = (0.0, 1.0) if weights.get("band") else (spec.band * (1.0 - INSIDE),) * 2
    free = np.full(states, np.inf)
    return np.concatenate([low, [band[0], 1.0], -free]), np.concatenate([high, [band[1], np.inf], free])


def _constraints(spec: PDSpec, limits: Limits, made: _Made, plants: int) -> tuple[Array, Array]:
    """Return the bounds of the rows, plant by plant, in the order of :func:`_program`."""
    instants = spec.sample_time * np.arange(1, made.samples + 1)
    late = np.where(instants >= spec.settling_time * (1 - 1e-9), 0.0, np.inf)
    asked = np.full(made.samples, np.inf if spec.voltage_limit is None else spec.voltage_limit * (1.0 - INSIDE))
    beyond = np.inf if spec.overshoot is None else spec.overshoot * (1.0 - INSIDE)
    size = made.points
    noise = np.inf if limits.noise_gain is None else 1.0 - INSIDE
    complementary = np.inf if limits.peak_complementary is None else (limits.peak_complementary * (1.0 - INSIDE)) ** 2
    later = np.inf if limits.delay_margin is None else 1.0
    upper = [np.zeros(made.closing), late, late, np.full(made.samples, beyond), asked]
    upper += [np.zeros(size), np.full(size, complementary), np.full(size, later), np.array([noise])]
    lower = [np.zeros(made.closing), *(np.full(part.size, -np.inf) for part in upper[1:])]
    lower[4] = -asked
    peak = np.array([np.inf if limits.peak_sensitivity is None else limits.peak_sensitivity * (1.0 - INSIDE)])
    ends = [
        np.concatenate([*(part for _ in range(plants) for part in side), last])
        for side, last in ((lower, np.array([-np.inf])), (upper, peak))
    ]
    return ends[0], ends[1]


def _parameters(
    plants: Sequence[Plant],
    spec: PDSpec,
    limits: Limits,
    scales: Array,
    width: float,
    weights: Mapping[str, float],
) -> Array:
    """Return what the program is told, in the order of :func:`_program`."""
    omega = frequencies(plants, spec)
    later = (2.0 * np.sin(np.minimum(0.5 * omega * (limits.delay_margin or 0.0), 0.5 * np.pi))) ** 2
    share = np.gradient(omega) * spec.sample_time / np.pi
    common = [spec.reference, spec.sample_time, width, limits.noise_gain or 1.0]
    common += [weights.get(name, 0.0) for name in ("kd", "noise", "band", "peak")]
    parts = [np.array(common), scales, omega, later, share]
    answers = plant_responses(plants, spec, omega)
    for i, plant in enumerate(plants):
        due = divmod(plant.delay / spec.sample_time, 1.0)[1]
        parts += [np.array([*plant.driven_values, due, *(held_by(plant, spec.loop(0.0), 0.0) or NOT_HELD)])]
        parts += [part for answer in answers[2 * i : 2 * i + 2] for part in (answer.real, answer.imag)]
    return np.concatenate(parts)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Made:
    """A program, and what its vectors hold."""

    program: NonlinearProgram
    simulated: Any
    samples: int
    points: int
    closing: int

    def states(self, gains: Array, parameters: Array) -> Array:
        """Return the states at the ends of the shooting intervals of a loop with these gains."""
        return np.asarray(self.simulated(gains, parameters).full().ravel(order="F"), dtype=np.float64)


@lru_cache(maxsize=16)
def _program(
    structures: tuple[tuple[type[Effect], ...], ...],
    grids: tuple[tuple[int, int, bool], ...],
    continuous: bool,
    count: int,
) -> _Made:
    import casadi as ca

    gains, band, peak = ca.MX.sym("gains", 3), ca.MX.sym("band"), ca.MX.sym("peak")
    common, scales = ca.MX.sym("common", 8), ca.MX.sym("scales", 3)
    omega, later, share = (ca.MX.sym(name, POINTS) for name in ("omega", "later", "share"))
    reference, h, width, most_noise, *weights = ca.vertsplit(common)
    kp, kd, filtered = ca.vertsplit(gains * scales)
    told: list[Any] = [common, scales, omega, later, share]
    nodes, rows, begun, noises = [], [], [], []
    control = _controller(kp, kd, filtered, omega, h, continuous)
    for i, (structure, (substeps, late, split)) in enumerate(zip(structures, grids, strict=True)):
        loop = Loop(structure, continuous, substeps, (late, split))
        values, due, held = ca.MX.sym(f"values{i}", loop.parameters), ca.MX.sym(f"due{i}"), ca.MX.sym(f"held{i}", 2)
        answers = [(ca.MX.sym(f"re{i}{k}", POINTS), ca.MX.sym(f"im{i}{k}", POINTS)) for k in range(2)]
        told += [values, due, held, *(part for answer in answers for part in answer)]
        settings = ca.vertcat(values, width, held, kp, reference, h, filtered, due, kd)
        first = loop.beginning(settings)
        node = ca.MX.sym(f"node{i}", first.numel(), INTERVALS - 1)
        shoot = loop.step.mapaccum(count)
        whole = [shoot(state, ca.repmat(settings, 1, count)) for state in (first, *ca.horzsplit(node))]
        states = ca.horzcat(*whole)
        gaps = [part[:, -1] - node[:, k] for k, part in enumerate(whole[:-1])]
        error = (reference - states[0, :].T) / ca.fabs(reference)
        curves = [_peaks(answer, control) for answer in answers]
        most_s, most_t = (ca.fmax(curves[0][k], curves[1][k]) for k in range(2))
        noise = ca.sqrt(ca.fmax(*(ca.sum1(share * curve[2]) for curve in curves))) / most_noise
        noises.append(noise)
        rows += [ca.vertcat(*gaps) if gaps else ca.MX(0, 1), error - band, -error - band]
        rows += [-error * ca.sign(reference), states[1, :].T, most_s - peak**2, most_t, most_t * later, noise]
        nodes.append(ca.vec(node))
        one = loop.step.mapaccum(count * INTERVALS)(first, ca.repmat(settings, 1, count * INTERVALS))
        begun.append(ca.vec(one[:, count - 1 : -1 : count]))
    costs = (kd / scales[1], noises[0], band, peak)
    cost = sum(weight * value for weight, value in zip(weights, costs, strict=True))
    p = ca.vertcat(*told)
    return _Made(
        program=NonlinearProgram(x=ca.vertcat(gains, band, peak, *nodes), f=cost, g=ca.vertcat(*rows, peak), p=p),
        simulated=ca.Function("simulated", [gains, p], [ca.vertcat(*begun)]),
        samples=count * INTERVALS,
        points=POINTS,
        closing=nodes[0].numel(),
    )


def _controller(kp: Any, kd: Any, share: Any, omega: Any, h: Any, continuous: bool) -> tuple[Any, Any]:
    """Return real and imaginary part of the PD's response."""
    import casadi as ca

    if continuous:
        return kp + 0.0 * omega, kd * omega
    cos, sin = ca.cos(omega * h), ca.sin(omega * h)
    rest = 1.0 - share
    size = (1.0 - rest * cos) ** 2 + (rest * sin) ** 2
    factor = kd * share / h / size
    return kp + factor * ((1.0 - cos) * (1.0 - rest * cos) + rest * sin**2), factor * (
        sin * (1.0 - rest * cos) - rest * sin * (1.0 - cos)
    )


def _peaks(answer: tuple[Any, Any], control: tuple[Any, Any]) -> tuple[Any, Any, Any]:
    """Return |S|², |T|² and |C S|² at each frequency."""
    (a, b), (c, d) = answer, control
    real, imaginary = a * c - b * d, a * d + b * c
    below = (1.0 + real) ** 2 + imaginary**2
    return 1.0 / below, (real**2 + imaginary**2) / below, (c**2 + d**2) / below
