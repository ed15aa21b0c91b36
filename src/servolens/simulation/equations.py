"""The expressions behind each function that the stepping rule calls, in its own layout of numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

import casadi as ca

from servolens.dynamics import dynamics, ideal_pd
from servolens.effects import Transmission

if TYPE_CHECKING:
    from servolens.dynamics import Dynamics
    from servolens.effects import Effect

__all__ = ["Equations"]

SWITCHES = (ca.OP_LT, ca.OP_LE, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FABS, ca.OP_SIGN)
"""Operations that have a kink where their arguments are equal, or their argument 0."""


@final
class Equations:
    """The equations of motion of a structure, for :mod:`servolens.simulation.stepping`.

    Parameters
    ----------
    structure : tuple of type of Effect
        Of the plant.
    continuous : bool
        Whether an ideal PD acts inside the step; then the command stands for its reference, and kp and kd are appended
        to the parameters.

    Attributes
    ----------
    inputs : list of casadi.SX
        The axis ``[y, v, t, u, d, moving, shaking, smooth states, relaxing states, their ramps]``, and the parameters.
    smooth, relaxing : list of int
        Which of ``Dynamics.states`` are stepped by a series, and which relax.
    """

    def __init__(self, structure: tuple[type[Effect], ...], continuous: bool) -> None:
        self.d = d = dynamics(structure)
        self.smooth = [i for i, relaxes in enumerate(d.relaxing) if not relaxes]
        self.relaxing = [i for i, relaxes in enumerate(d.relaxing) if relaxes]
        self.moving, self.shaking = ca.SX.sym("moving"), ca.SX.sym("shaking")
        self.ramps = ca.SX.sym("ramps", len(self.relaxing))
        states = [d.states[i] for i in (*self.smooth, *self.relaxing)]
        axis = [d.position, d.velocity, d.time, d.command, d.direction, self.moving, self.shaking]
        x = ca.vertcat(*axis, *states, self.ramps)
        gains = ca.SX.sym("gains", 2 if continuous else 0)
        self.inputs = [x, ca.vertcat(d.parameters, gains)]
        found, beginning = [d.push + self.shaking, d.level, d.rates], d.beginning
        if continuous:
            found = ca.substitute(found, [d.command], [_asked(d, gains, d.shown, d.output_velocity)])
            beginning = ca.substitute(beginning, d.command, _asked(d, gains, d.position, 0.0))
        self.push, self.level, self.rates = found
        self.beginning = beginning
        self.acceleration = self.push - self.level * d.direction
        self.motion = ca.vertcat(d.position, d.velocity, d.time, d.states)
        kinds = [(cls, state.name) for cls in structure for state in cls.states]
        self._carried = [
            i for i, (cls, name) in enumerate(kinds) if issubclass(cls, Transmission) and name == "velocity"
        ]
        self.edges = self._edges()
        self.contacts = sum(cls.contact_rate > 0.0 for cls in structure)

    def functions(self) -> dict[str, list[Any]]:
        """Return what the stepping rule calls by these names, and ``slopes``."""
        d = self.d
        state = ca.vertcat(d.position, d.velocity, d.states)
        flow = ca.vertcat(d.velocity, self.acceleration, self.rates)
        return {
            "taylor": self._taylor(),
            "breakaway": [self.push, self.level],
            "relaxation": self._relaxation(),
            "kinked": self.edges,
            "shown": [d.shown, d.output_velocity, d.output],
            "beginning": [self.beginning[i] for i in (*self.smooth, *self.relaxing)],
            "slopes": [ca.vec(ca.densify(ca.jacobian(flow, state)))],
        }

    def numbers(self) -> dict[str, int]:
        """Return the constants that the stepping rule asks for by these names."""
        drifts = ca.depends_on(ca.vertcat(0, *self._relaxation()), self.motion)
        return {
            "parameters": self.inputs[1].numel(),
            "smooth": len(self.smooth),
            "relaxing": len(self.relaxing),
            "drifts": int(drifts),
            "kinks": len(self.edges),
            "contacts": self.contacts,
        }

    def _edges(self) -> list[Any]:
        """Return functions of the motion whose changes of sign are kinks of the acceleration or of a rate."""
        found: dict[int, Any] = {}
        waiting = [*ca.vertsplit(ca.vertcat(self.acceleration, *(self.rates[i] for i in self.smooth)))]
        seen = set()
        while waiting:
            element = waiting.pop()
            if element.__hash__() in seen or element.is_constant() or element.is_symbolic():
                continue
            seen.add(element.__hash__())
            parts = [element.dep(i) for i in range(element.n_dep())]
            waiting += parts
            if element.op() in SWITCHES:
                edge = parts[0] - parts[1] if len(parts) > 1 else parts[0]
                if ca.depends_on(edge, self.motion):
                    found[element.__hash__()] = edge
        return list(found.values())

    def _taylor(self) -> list[Any]:
        """Return acceleration, jerk, snap, damping, and the smooth states' derivatives; relaxing states are ramps.

        The damping is that of the motion of the whole axis: a load behind a transmission takes part in it.

        Jerk and snap come from the gradient and the Hessian, which do not wait for the acceleration: a processor
        works them out beside it.
        """
        d = self.d
        moving = self.moving if d.state_names else 1.0  # what remembers nothing is not stepped at rest
        smooth = [self.rates[i] for i in self.smooth]
        along = ca.vertcat(d.position, d.velocity, d.time, *(d.states[i] for i in (*self.smooth, *self.relaxing)))
        firsts = [moving * self.acceleration, *smooth]
        flow = ca.vertcat(d.velocity, firsts[0], 1.0, *smooth, self.ramps)
        gradients = [ca.gradient(first, along) for first in firsts]
        seconds = [ca.dot(gradient, flow) for gradient in gradients]
        bend = ca.vertcat(firsts[0], seconds[0], 0.0, *seconds[1:], ca.SX(len(self.relaxing), 1))
        thirds = [ca.dot(gradient, bend) + ca.bilin(ca.jacobian(gradient, along), flow, flow) for gradient in gradients]
        series = [value for three in zip(firsts, seconds, thirds, strict=True) for value in three]
        damping = -sum((gradients[0][3 + self.smooth.index(i)] for i in self._carried), gradients[0][1])
        return [*series[:3], ca.fmax(damping, 0.0), *series[3:]]

    def _relaxation(self) -> list[Any]:
        """Return A and B of each relaxing state's ż = A − B z."""
        found = []
        for i in self.relaxing:
            rate, state = self.rates[i], self.d.states[i]
            found += [ca.substitute(rate, state, 0.0), -ca.gradient(rate, state)]
        return found


def _asked(d: Dynamics, gains: Any, position: Any, velocity: Any) -> Any:
    """Return what an ideal PD asks for; the input stands for its reference."""
    return ideal_pd(gains[0], gains[1], d.command, position, velocity)
