"""The nonlinear program: least Kd subject to the band at every instant after the settling time."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.rest import NOT_HELD, held_by
from servolens.design.settle import horizon
from servolens.dynamics import dynamics, ideal_pd
from servolens.simulation.rates import fixed_substeps_for
from servolens.solving import NonlinearProgram, minimise

if TYPE_CHECKING:
    from servolens.design.spec import PDSpec
    from servolens.effects import Effect
    from servolens.plant import Plant

__all__ = ["local_optimum"]

WATCHED, MOST_INSTANTS = 3.0, 2000
"""For so many settling times the band is asked for, and at no more instants; the exact loop then has the last word."""
INSIDE = 1e-4
"""Share of the limits that is kept in reserve: the integrator here is not that of the exact loop."""
FRICTION_WIDTH = 1e-3
"""Speed over which dry friction changes sign in the program [m/s or rad/s]; the exact loop then decides."""


def local_optimum(plant: Plant, spec: PDSpec, interval: tuple[float, float]) -> float | None:
    """Return the least Kd that CasADi and IPOPT find from inside `interval`, or None if they find none."""
    samples = int(np.ceil(min(WATCHED * spec.settling_time, horizon(plant, spec)) / spec.sample_time))
    first = int(np.ceil(spec.settling_time / spec.sample_time * (1 - 1e-9)))
    stride = max((samples - first) // MOST_INSTANTS, 1)
    plant = replace(plant, effects=tuple(effect for effect in plant.effects if not effect.absent))
    substeps = min(fixed_substeps_for(plant, spec.sample_time), 16)
    late, due = divmod(plant.delay / spec.sample_time, 1.0)
    program = _program(
        plant.structure,
        spec.control == "continuous",
        (samples, first, stride, substeps, int(late)),
        due > 0.0,
        (spec.overshoot is not None, spec.voltage_limit is not None),
    )
    width = interval[1] - interval[0]
    loop = [spec.kp, spec.reference, spec.sample_time, spec.derivative_filter, due]
    parameters = [*plant.driven_values, FRICTION_WIDTH, *(held_by(plant, spec.loop(0.0), 0.0) or NOT_HELD), *loop]
    late = (samples - first) // stride + 1
    lower, upper = [-spec.band * (1.0 - INSIDE)] * late, [spec.band * (1.0 - INSIDE)] * late
    if spec.overshoot is not None:
        lower, upper = lower + [-np.inf] * samples, upper + [spec.overshoot * (1.0 - INSIDE)] * samples
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
    grid: tuple[int, int, int, int, int],
    split: bool,
    limits: tuple[bool, bool],
) -> NonlinearProgram:
    import casadi as ca

    samples, first, stride, substeps, late = grid
    overshoot, voltage = limits

    loop = Loop(structure, continuous, substeps, (late, split))
    kd = ca.MX.sym("kd")
    given = ca.MX.sym("given", loop.settings - 1)
    settings = ca.vertcat(given, kd)
    states = loop.step.mapaccum(samples)(loop.beginning(settings), ca.repmat(settings, 1, samples))
    reference = given[-4]
    error = (reference - states[0, :].T) / ca.fabs(reference)
    constraints = [error[first - 1 :: stride]]
    if overshoot:
        constraints.append(-error * ca.sign(reference))
    if voltage:
        constraints.append(states[1, :].T)
    return NonlinearProgram(x=kd, f=kd, g=ca.vertcat(*constraints), p=given)


@final
class Loop:
    """One sample of the loop as CasADi functions.

    The state is [output, asked, last shown, derivative, time, axis, asked before, …]; the settings are the plant's
    parameters and [width, held, slope, kp, r, h, filter, due, kd]: `width` is the speed over which dry friction changes
    sign, `held` and `slope` are those of :class:`servolens.design.rest.Held`, `due` is the share of a sample that the
    command is late beyond `late` samples.
    """

    def __init__(
        self, structure: tuple[type[Effect], ...], continuous: bool, substeps: int, delay: tuple[int, bool]
    ) -> None:
        import casadi as ca

        d = dynamics(structure)
        self.axis = ca.vertcat(d.position, d.velocity, d.states)
        self._continuous, self._substeps = continuous, substeps
        self._late, self._split = delay
        width = ca.SX.sym("width")
        direction = ca.tanh(d.velocity / width)
        flow = ca.substitute(ca.vertcat(d.velocity, d.acceleration, d.rates), d.direction, direction)
        inputs = [self.axis, d.time, d.command, ca.vertcat(d.parameters, width)]
        self._flow = ca.Function("flow", inputs, [flow])
        self._seen = ca.Function("seen", [self.axis, d.parameters], [d.shown, d.output_velocity, d.output])
        resting = ca.vertcat(d.position, 0.0, d.beginning)
        self._resting = ca.Function("resting", [d.position, d.time, d.command, d.parameters], [resting])
        self.parameters = d.parameters.numel()
        self.settings = self.parameters + 9
        self.step = self._sample()

    def beginning(self, settings: Any) -> Any:
        """Return the state of the loop that holds the axis at 0, before its first command; see :mod:`.rest`."""
        import casadi as ca

        p = settings[: self.parameters]
        held, slope, kp, reference = (settings[self.parameters + 1 + k] for k in range(4))
        at = -held / (kp + slope)
        axis = self._resting(at, 0.0, -kp * at, p)
        shown, _, output = self._seen(axis, p)
        asked = kp * (reference - shown)
        return ca.vertcat(output, asked, shown, 0.0, 0.0, axis, ca.repmat(-kp * at, self._late + 1, 1))

    def _sample(self) -> Any:
        import casadi as ca

        size = self.axis.numel()
        state, settings = ca.SX.sym("state", 5 + size + self._late + 1), ca.SX.sym("settings", self.settings)
        _, _, _, kp, reference, h, share, due, kd = ca.vertsplit(settings[self.parameters :])
        p, axis, before = settings[: self.parameters], state[5 : 5 + size], state[5 + size :]
        shown, velocity, _ = self._seen(axis, p)
        slope = state[3] + share * ((shown - state[2]) / h - state[3])
        asked = kp * (reference - shown) - kd * slope
        if self._continuous:
            asked = ideal_pd(kp, kd, reference, shown, velocity)
        row, time = ca.vertcat(asked, before), state[4]
        parts = [(due, row[self._late + 1]), (1 - due, row[self._late])] if self._split else [(1, row[self._late])]
        for part, held in parts:
            step = part * h / self._substeps
            for _ in range(self._substeps):
                axis = self._runge_kutta(axis, time, step, held, (kp, kd, reference), settings)
                time += step
        output = self._seen(axis, p)[2]
        after = ca.vertcat(output, asked, shown, slope, time, axis, row[: self._late + 1])
        return ca.Function("sample", [state, settings], [after])

    def _runge_kutta(
        self, axis: Any, time: Any, step: Any, held: Any, gains: tuple[Any, Any, Any], settings: Any
    ) -> Any:
        p, known = settings[: self.parameters], settings[: self.parameters + 1]

        def rate(x: Any, t: Any) -> Any:
            shown, velocity, _ = self._seen(x, p)
            command = ideal_pd(*gains, shown, velocity) if self._continuous else held
            return self._flow(x, t, command, known)

        k1 = rate(axis, time)
        k2 = rate(axis + step / 2 * k1, time + step / 2)
        k3 = rate(axis + step / 2 * k2, time + step / 2)
        k4 = rate(axis + step * k3, time + step)
        return axis + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
