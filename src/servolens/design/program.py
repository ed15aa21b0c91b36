"""The nonlinear program: least Kd subject to the band at every instant after the settling time."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from servolens.design.settle import design_horizon
from servolens.dynamics import dynamics, ideal_pd
from servolens.simulation.loop import substeps_for
from servolens.solving import NonlinearProgram, minimise

if TYPE_CHECKING:
    from servolens.design.spec import PDSpec
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["local_optimum"]

MOST_INSTANTS = 500
"""At so many instants the band is asked for; the exact loop, sample by sample, then has the last word."""
FRICTION_WIDTH = 1e-3
"""Speed over which dry friction changes sign in the program [m/s or rad/s]; the exact loop then decides."""


def local_optimum(plant: Plant, spec: PDSpec, interval: tuple[float, float]) -> float | None:
    """Return the least Kd that CasADi and IPOPT find from inside `interval`, or None if they find none."""
    samples = int(np.ceil(design_horizon(plant, spec) / spec.sample_time))
    first = int(np.ceil(spec.settling_time / spec.sample_time * (1 - 1e-9)))
    stride = max((samples - first) // MOST_INSTANTS, 1)
    substeps = min(substeps_for(plant, spec.sample_time), 16)
    program = _program(
        plant.structure,
        spec.control == "continuous",
        (samples, first, stride, substeps),
        (spec.overshoot is not None, spec.voltage_limit is not None),
    )
    width = interval[1] - interval[0]
    parameters = [*plant.values, spec.kp, spec.reference, spec.sample_time, spec.derivative_filter]
    late = (samples - first) // stride + 1
    lower, upper = [-spec.band] * late, [spec.band] * late
    if spec.overshoot is not None:
        lower, upper = lower + [-np.inf] * samples, upper + [spec.overshoot] * samples
    if spec.voltage_limit is not None:
        lower, upper = lower + [-spec.voltage_limit] * samples, upper + [spec.voltage_limit] * samples
    result = minimise(
        program,
        np.array([interval[0] + 0.2 * width]),
        bounds=(max(interval[0] - 0.1 * width, 0.0), interval[1]),
        constraint_bounds=(np.array(lower), np.array(upper)),
        parameters=np.array(parameters),
    )
    return float(result.x[0]) if result.success else None


@lru_cache(maxsize=32)
def _program(
    structure: tuple[type[Effect], ...],
    continuous: bool,
    grid: tuple[int, int, int, int],
    limits: tuple[bool, bool],
) -> NonlinearProgram:
    import casadi as ca

    samples, first, stride, substeps = grid
    overshoot, voltage = limits

    step = _sample(structure, continuous, substeps)
    kd = ca.MX.sym("kd")
    given = ca.MX.sym("given", step.size1_in(1) - 1)
    settings = ca.vertcat(given, kd)
    states = step.mapaccum(samples)(ca.DM.zeros(4), ca.repmat(settings, 1, samples))
    reference = given[-3]
    error = (reference - states[0, :].T) / ca.fabs(reference)
    constraints = [error[first - 1 :: stride]]
    if overshoot:
        constraints.append(-error * ca.sign(reference))
    if voltage:
        seen, slope = (states[0, :], states[1, :]) if continuous else (states[2, :], states[3, :])
        constraints.append(given[-4] * (reference - seen.T) - kd * slope.T)
    return NonlinearProgram(x=kd, f=kd, g=ca.vertcat(*constraints), p=given)


def _sample(structure: tuple[type[Effect], ...], continuous: bool, substeps: int) -> Any:
    """Return one sample of the loop: (y, v, last y, derivative) and [plant, kp, r, h, filter, kd] to the next state."""
    import casadi as ca

    d = dynamics(structure)
    acceleration = ca.Function("acceleration", d.inputs, [d.acceleration])
    state, count = ca.SX.sym("state", 4), d.parameters.numel()
    settings = ca.SX.sym("settings", count + 5)
    kp, reference, h, share, kd = (settings[count + i] for i in range(5))
    y, v, last, derivative = ca.vertsplit(state)
    slope = derivative + share * ((y - last) / h - derivative)
    held = kp * (reference - y) - kd * slope

    def rate(position: Any, velocity: Any, time: Any) -> Any:
        direction = ca.tanh(velocity / FRICTION_WIDTH)
        asked = ideal_pd(kp, kd, reference, position, velocity) if continuous else held
        return acceleration(position, velocity, time, asked, direction, settings[:count])

    k = h / substeps
    p, q = y, v
    for _ in range(substeps):
        a1 = rate(p, q, 0)
        a2 = rate(p + k / 2 * q, q + k / 2 * a1, 0)
        a3 = rate(p + k / 2 * q + k * k / 4 * a1, q + k / 2 * a2, 0)
        a4 = rate(p + k * q + k * k / 2 * a2, q + k * a3, 0)
        p, q = p + k * q + k * k / 6 * (a1 + a2 + a3), q + k / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return ca.Function("sample", [state, settings], [ca.vertcat(p, q, y, slope)])
