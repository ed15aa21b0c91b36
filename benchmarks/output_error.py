"""An output-error fit of five parameters, against python-control with SciPy and against CasADi with IPOPT.

Gain, damping, the level of Coulomb friction, and α₁ and α₂ of a damping that fades with speed, from four records of
3 000 samples: digital PD loops at 1 kHz visit three levels for a second each, noise 10 µm, encoder 10 µm. The axis
reverses and sticks. The laboratory of servolens logs them; it shares no equation with the simulator.

All start from the solution of the integral equation, but for ``fit``, which finds its start itself. Times of
ours are warm, the best of five; ratios are taken of their median.

* python-control: ``least_squares`` (trf, bounds, x_scale) on the ideal continuous loop by ``input_output_response``,
  friction smoothed over 1 mm/s, as the bridge makes it. With the defaults of both; with the bridge's solver settings;
  with those and differences over 1e-3 of each parameter, for those of ``least_squares`` are smaller than what solvers
  leave. Once each.
* python-control, the voltage held sample by sample, as ours has it: one residual is timed on one record, and counted
  four times as often as the same ``least_squares`` asks for it with the simulator of servolens.
* CasADi: multiple shooting over 50 samples, Runge–Kutta over each, driven by the logged voltage; friction as a tanh
  over 1 mm/s; IPOPT with the Gauss–Newton Hessian. Time to solve, without that to build.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import control as ct
import numpy as np
from harness import Figure
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from servolens import lab
from servolens.bridge import SOLVER, closed_loop, held_response, to_control
from servolens.effects import CoulombFriction, VelocityDecayDamping
from servolens.identification import fit
from servolens.identification.fitting import final_fit, likelihood_of
from servolens.identification.options import FitOptions
from servolens.identification.segments import motion_segments
from servolens.identification.starting import Screen
from servolens.simulation import simulate_voltage

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.plant import Plant
    from servolens.record import Record

GAIN, DAMPING, FRICTION, ALPHA1, ALPHA2 = TRUTH = (1.9165, 5.9986, 0.2, 17.3264, 13.1068)
"""The paper's NLm1 with Coulomb friction, SI."""
RUNS = (
    (40.0, 0.0, (0.1, 0.0, 0.1)),
    (60.0, 0.0, (0.1, 0.0, -0.1)),
    (80.0, 2.0, (0.05, 0.1, 0.0)),
    (100.0, 5.0, (0.1, 0.0, 0.1)),
)
"""Kp, Kd, and the levels that are visited [m]."""
EACH, NOISE, PERIOD = 1000, 1e-5, 1e-3
GUESS = (CoulombFriction(level=1.0), VelocityDecayDamping(alpha1=10.0, alpha2=10.0))
INTERVAL, WIDTH = 50, 1e-3
DIFFERENCES = 1e-3


@dataclass(frozen=True, slots=True)
class Answer:
    """What a rival found, and the seconds it took; no answer where that was only estimated."""

    name: str
    seconds: float
    found: NDArray[np.float64] | None


def figures() -> list[Figure]:
    """Measure."""
    runs = records()
    start, _ = Screen.of(motion_segments(runs)).solve(GUESS)
    whole = _timed(lambda: fit(GUESS, runs).plant)
    alone = _timed(lambda: _refined(start, runs))
    ours = np.array(fit(GUESS, runs).plant.values)
    name, rival = "output-error fit", "least_squares + python-control"
    targeted = [
        by_control(f"{rival}, defaults", start, runs, {}),
        by_control(f"{rival}, bridge's settings", start, runs, SOLVER),
    ]
    others = [
        by_control(f"{rival}, bridge's, wider differences", start, runs, SOLVER, DIFFERENCES),
        Answer(f"{rival}, voltage held (estimated)", held_by_hand(start, runs), None),
        by_casadi("CasADi multiple shooting + IPOPT", start, runs),
    ]
    found = [_seconds(f"{name}, 5 parameters, 4 × 3 000 samples: time, warm", min(whole), 0.5)]
    found += [_seconds(f"{name}, refinement alone: time", min(alone))]
    found += [_ratio(f"{name}: faster than {r.name}", r.seconds, whole, 500.0) for r in targeted]
    found += [_ratio(f"{name}: faster than {r.name}", r.seconds, whole) for r in others]
    found += [_ratio(f"{name}, refinement alone: faster than {r.name}", r.seconds, alone) for r in targeted + others]
    found += [_seconds(f"{name}: time, {r.name}", r.seconds) for r in targeted + others]
    return found + _errors(name, [Answer("ours", min(whole), ours), *targeted, *others])


def _refined(start: Plant, runs: tuple[Record, ...]) -> Plant:
    """Fit from `start` alone."""
    likelihood = likelihood_of(runs, start, FitOptions())
    found = likelihood.judged(start)
    assert found is not None
    return final_fit(likelihood, [found], FitOptions()).refinement.plant


def records() -> tuple[Record, ...]:
    """Return what all fit."""
    effects = {"coulomb_friction": {"level": FRICTION}, "velocity_decay_damping": {"alpha1": ALPHA1, "alpha2": ALPHA2}}
    truth = lab.Truth(gain=GAIN, damping=DAMPING, effects=effects)
    return tuple(
        lab.step_record(
            truth,
            kp,
            kd,
            sample_time=PERIOD,
            noise=NOISE,
            encoder=1e-5,
            seed=seed,
            setup=lab.Setup(trajectory=np.repeat(levels, EACH)),
        )
        for seed, (kp, kd, levels) in enumerate(RUNS)
    )


def by_control(
    name: str, start: Plant, runs: tuple[Record, ...], solver: dict[str, Any], differences: float | None = None
) -> Answer:
    """Fit as python-control and SciPy are put together."""
    names = list(start.parameters)
    loops = [closed_loop(start, run.controller.kp, run.controller.kd) for run in runs if run.controller]

    def misfit(x: NDArray[np.float64]) -> Any:
        params = dict(zip(names, x.tolist(), strict=True))
        return np.concatenate([
            ct.input_output_response(loop, run.time, run.reference, params=params, solve_ivp_kwargs=solver).states[0]
            - run.position
            for loop, run in zip(loops, runs, strict=True)
        ])  # fmt: skip

    begun = time.perf_counter()
    found = _least_squares(misfit, start, differences)
    return Answer(name, time.perf_counter() - begun, np.asarray(found.x))


def held_by_hand(start: Plant, runs: tuple[Record, ...]) -> float:
    """Estimate the time of a fit with python-control that is driven by the voltage, held sample by sample [s]."""
    asked = 0

    def misfit(x: NDArray[np.float64]) -> Any:
        nonlocal asked
        asked += 1
        plant = start.with_values(x.tolist())
        return np.concatenate([simulate_voltage(plant, r.time, _voltage(r)).position - r.position for r in runs])

    _least_squares(misfit, start, None)
    begun = time.perf_counter()
    held_response(to_control(start), runs[0].time, _voltage(runs[0]))
    return (time.perf_counter() - begun) * len(runs) * asked


def by_casadi(name: str, start: Plant, runs: tuple[Record, ...]) -> Answer:
    """Fit by multiple shooting; parameters are scaled by their start, residuals by the noise."""
    scale, per_run = np.array(start.values), len(runs[0]) // INTERVAL
    count = per_run * len(runs)
    voltage = np.concatenate([_voltage(run) for run in runs])
    position = np.concatenate([run.position for run in runs])
    speed = np.concatenate([savgol_filter(run.position, 21, 2, deriv=1, delta=PERIOD) for run in runs])
    q, nodes = ca.MX.sym("q", 5), ca.MX.sym("nodes", 2, count)
    shown, ends = _stretch().map(count)(nodes, ca.DM(voltage).T, ca.repmat(q * scale, 1, count))
    residual = (ca.vec(shown) - ca.DM(position)) / NOISE
    joined = [i for i in range(count - 1) if (i + 1) % per_run]
    gaps = ca.vec(ends[:, joined] - nodes[:, [i + 1 for i in joined]])
    unknowns = ca.veccat(q, nodes)
    options = {
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": False,
        "hess_lag": _gauss_newton(residual, unknowns, gaps.numel()),
    }
    problem = {"x": unknowns, "f": 0.5 * ca.dot(residual, residual), "g": gaps}
    solver = ca.nlpsol("solver", "ipopt", problem, options)
    first = np.concatenate([np.ones(5), np.stack([position, speed])[:, ::INTERVAL].T.ravel()])
    low = np.r_[np.zeros(5), np.full(2 * count, -np.inf)]
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        solved = solver(x0=first, lbx=low, lbg=0.0, ubg=0.0)
        times.append(time.perf_counter() - begun)
    assert solver.stats()["success"], solver.stats()["return_status"]
    return Answer(name, min(times), np.array(solved["x"]).ravel()[:5] * scale)


def _stretch() -> Any:
    """Return (state, voltage, parameters) → (positions at the samples of an interval, state at its end)."""
    x, u, p, h = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 5), PERIOD

    def rate(x: Any) -> Any:
        v, (gain, damping, level, alpha1, alpha2) = x[1], ca.vertsplit(p)
        drag = (damping + alpha1 * ca.exp(-alpha2 * ca.fabs(v))) * v
        return ca.vertcat(v, gain * u - drag - level * ca.tanh(v / WIDTH))

    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    step = ca.Function("step", [x, u, p], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    begin, held, parameters = ca.MX.sym("x", 2), ca.MX.sym("u", 1, INTERVAL), ca.MX.sym("p", 5)
    states = step.mapaccum(INTERVAL)(begin, held, ca.repmat(parameters, 1, INTERVAL))
    shown = ca.horzcat(begin[0], states[0, :-1]).T
    return ca.Function("stretch", [begin, held, parameters], [shown, states[:, -1]])


def _gauss_newton(residual: Any, unknowns: Any, constraints: int) -> Any:
    slopes = ca.jacobian(residual, unknowns)
    weight, multipliers, nothing = ca.MX.sym("s"), ca.MX.sym("l", constraints), ca.MX.sym("p", 0)
    return ca.Function(
        "hessian",
        [unknowns, nothing, weight, multipliers],
        [weight * ca.triu(slopes.T @ slopes)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def _least_squares(misfit: Callable[[NDArray[np.float64]], Any], start: Plant, differences: float | None) -> Any:
    x = np.array(start.values)
    return least_squares(misfit, x, bounds=(0.0, np.inf), x_scale=x, diff_step=differences)


def _voltage(record: Record) -> NDArray[np.float64]:
    assert record.voltage is not None
    return record.voltage


def _timed(function: Callable[[], Any]) -> list[float]:
    function()
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        function()
        times.append(time.perf_counter() - begun)
    return times


def _seconds(name: str, value: float, target: float | None = None) -> Figure:
    return Figure(name=name, value=value, unit="s", target=target, better="lower")


def _ratio(name: str, theirs: float, ours: list[float], target: float | None = None) -> Figure:
    return Figure(name=name, value=theirs / statistics.median(ours), unit="times", target=target, better="higher")


def _errors(name: str, answers: list[Answer]) -> list[Figure]:
    """Return the largest error of each answer, and print the error of each parameter."""
    figures = []
    for answer in answers:
        if answer.found is None:
            continue
        errors = 100.0 * (answer.found / TRUTH - 1.0)
        listed = ", ".join(f"{n} {e:+.4f} %" for n, e in zip(("β", "c", "F", "α₁", "α₂"), errors, strict=True))
        print(f"  {answer.name}: {answer.seconds:.3g} s; errors {listed}")
        worst, title = float(np.abs(errors).max()), f"{name}: largest error of a parameter, {answer.name}"
        figures.append(Figure(name=title, value=worst, unit="%", target=None, better="lower"))
    return figures
