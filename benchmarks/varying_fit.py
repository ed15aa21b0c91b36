"""The time-varying damping fit against output-error fitting by SciPy, as it stands in textbooks.

Both fit the same nine numbers, c₁ … c₆, β, y₀ and v₀, to the same 900 samples of the virtual cart NLm1 at Kp 60 with a
25 µm encoder. The rival simulates the closed-loop error equation ``ë + c(t) ė + β Kp e = 0`` (the paper's eq. 13) by
``solve_ivp`` and lets ``least_squares`` minimise its distance to the measured error, both with their defaults; it
starts at c = 6 and β = 1.8, within a tenth of the truth. A second rival integrates to 1e-8, without which the
differences that ``least_squares`` takes are rough. Ours is linear and needs no start.

The errors are those of both answers in the same simulation: the loop as it ran, sampled at 1 kHz with its encoder,
started from each fit's own y₀ and v₀, by a kernel that neither fit has used. The rival's own criterion, the ideal
continuous loop, is shown beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from harness import Figure, alternate
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from servolens import identify, lab
from servolens.identification.integral import Pieces
from servolens.identification.piecewise import piecewise_damping
from servolens.identification.segments import motion_segments
from servolens.identification.varying import PieceFit, fit_pieces, ordering
from servolens.plant import Plant
from servolens.simulation import simulate_continuous, simulate_loop
from servolens.solving import Constraint

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.record import Record

KP, ENCODER, PIECES, LENGTH = 60.0, 25e-6, 6, 0.15
START = np.array([*[6.0] * PIECES, 1.8, 0.0, 0.0])


def figures() -> list[Figure]:
    """Measure."""
    record = lab.step_record(lab.NLM1, KP, duration=0.899, encoder=ENCODER)
    segments = motion_segments([record])
    assert len(record) == segments[0].time.size == 900
    starts = np.arange(PIECES + 1) * 150
    pieces = [Pieces(edges=starts, groups=np.arange(PIECES))]
    limits = [*ordering(PIECES, 0.5), *(_at_most(i, 12.0) for i in range(PIECES))]
    runs = [
        lambda: fit_pieces(segments, pieces),
        lambda: fit_pieces(segments, pieces, limits),
        lambda: rival(record),
        lambda: rival(record, rtol=1e-8, atol=1e-10),
    ]
    free, constrained, plain, careful = alternate(runs, seconds=20.0, least=9)
    whole, judged = alternate(
        [lambda: identify(record, model="varying"), lambda: identify(record, model="varying").findings], seconds=6.0
    )
    held = fit_pieces(segments, pieces, limits)
    print(f"  active constraints: {', '.join(held.active)}")
    assert any(name.startswith("c2 − c3") for name in held.active)
    ours, theirs, theirs_careful = _ours(fit_pieces(segments, pieces)), rival(record), rival(record, 1e-8, 1e-10)
    sampled = [_error(record, x, continuous=False) for x in (ours, theirs, theirs_careful)]
    ideal = [_error(record, x, continuous=True) for x in (ours, theirs, theirs_careful)]
    name = "varying-damping fit"
    return [
        Figure(
            name=f"{name}: faster than least_squares + solve_ivp",
            value=plain / free,
            unit="times",
            target=7800,
            better="higher",
        ),
        Figure(
            name=f"{name}: simulation error relative to rival's",
            value=sampled[0] / sampled[1],
            unit="",
            target=1,
            better="lower",
        ),
        Figure(
            name=f"{name}: faster than the rival at rtol 1e-8",
            value=careful / free,
            unit="times",
            target=None,
            better="higher",
        ),
        Figure(
            name=f"{name}: simulation error relative to that rival's",
            value=sampled[0] / sampled[2],
            unit="",
            target=None,
            better="lower",
        ),
        Figure(
            name="constrained fit (eq. 18, δ = 0.5): faster than least_squares + solve_ivp",
            value=plain / constrained,
            unit="times",
            target=500,
            better="higher",
        ),
        Figure(name=f"{name}: time", value=free * 1e6, unit="µs", target=None, better="lower"),
        Figure(name='identify(model="varying"): time', value=whole * 1e3, unit="ms", target=0.5, better="lower"),
        Figure(
            name='identify(model="varying"), asked for its error bars and findings: time',
            value=judged * 1e3,
            unit="ms",
            target=None,
            better="lower",
        ),
        Figure(name="constrained fit: time", value=constrained * 1e6, unit="µs", target=None, better="lower"),
        Figure(name="rival: time", value=plain * 1e3, unit="ms", target=None, better="lower"),
        *_errors("sampled loop", sampled),
        *_errors("rival's own ideal loop", ideal),
    ]


def rival(record: Record, rtol: float = 1e-3, atol: float = 1e-6) -> NDArray[np.float64]:
    """Return [c₁ … c₆, β, y₀, v₀] by output-error fitting; the tolerances are those of ``solve_ivp``."""
    time, reference = record.time, 0.1
    measured = reference - record.position
    span = (time[0], time[-1])

    def misfit(x: NDArray[np.float64]) -> Any:
        damping, gain, position, velocity = x[:PIECES], x[PIECES], x[-2], x[-1]

        def rate(t: float, state: NDArray[np.float64]) -> list[float]:
            e, de = state
            return [de, -damping[min(int(t / LENGTH), PIECES - 1)] * de - gain * KP * e]

        start = [reference - position, -velocity]
        return solve_ivp(rate, span, start, t_eval=time, rtol=rtol, atol=atol).y[0] - measured

    return np.asarray(least_squares(misfit, START).x)


def _at_most(index: int, limit: float) -> Constraint:
    return Constraint(name=f"c{index + 1} < {limit:g}", coefficients={index: 1.0}, upper=limit)


def _ours(fit: PieceFit) -> NDArray[np.float64]:
    return np.array([*fit.damping, fit.gain, *fit.starts[0]])


def _error(record: Record, x: NDArray[np.float64], *, continuous: bool) -> float:
    """Return the root mean square of simulated minus measured position [m]."""
    edges = (LENGTH * np.arange(PIECES + 1)).tolist()
    plant = Plant(gain=float(x[PIECES]), damping=0.0, effects=(piecewise_damping(edges, x[:PIECES].tolist()),))
    assert record.reference is not None
    assert record.controller is not None
    start = (float(x[-2]), float(x[-1]))
    if continuous:
        found = simulate_continuous(plant, KP, 0.0, record.time, record.reference, start=start)
    else:
        found = simulate_loop(
            plant, record.controller, record.time, record.reference, start=start, resolution=ENCODER, substeps=8
        )
    return float(np.sqrt(np.mean((found.position - record.position) ** 2)))


def _errors(what: str, values: list[float]) -> list[Figure]:
    names = ("ours", "rival", "rival at rtol 1e-8")
    return [
        Figure(name=f"simulation error, {what}: {who}", value=v * 1e6, unit="µm", target=None, better="lower")
        for who, v in zip(names, values, strict=True)
    ]
