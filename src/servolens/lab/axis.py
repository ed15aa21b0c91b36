"""The equations of a virtual axis: motor and load, what they remember, and which side of each edge they are on.

Everything that is not smooth is an *edge* of a mode: the direction of motion (or rest), the limit of the motor's force,
the contact at the ends of lost motion or of the travel. While the mode stays, all is smooth, and
:mod:`servolens.lab.motion` may take steps of fourth order; where a guard runs through zero, it stops and asks for the
mode beyond.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, final

from servolens.lab.laws import EXTERNAL, FADED, LAWS, LOAD_DRAG, Instant, across, contact_pace

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.lab.command import Signal
    from servolens.lab.truth import Truth
    from servolens.lab.unmodelled import UnmodelledEffect

    State = tuple[Any, ...]

__all__ = ["DIRECTION", "Axis", "Body", "Mode"]

DIRECTION, LIMIT, CONTACT, STOP = 0, 1, 2, 3
"""Numbers of the guards."""
LOOK_AHEAD = 1e-7
"""How far one looks ahead [s] for the side on which an axis breaks away: a push through zero has no side yet."""


SETTLED = 1e-3
"""Speed in an end stop [m/s or rad/s] below which longer steps err by nanometres."""


class Mode(NamedTuple):
    """Direction of motion ±1, 0 at rest; force limit reached ±1 or 0; flank in contact ±1 or 0; end stop ±1 or 0."""

    direction: Any
    limit: Any
    contact: Any
    stop: Any


class Body(NamedTuple):
    """An axis at one instant; every number is a float, or an array with one element a run.

    Attributes
    ----------
    state : tuple
        Position and velocity of the motor; of the load, if it moves apart; the speed servo's ∫(sV − v)dt, if any.
    mode : Mode
    anchor : tuple
        Position at the last reversal, and the presliding force there.
    shown : float or ndarray
        What the position sensor shows, before noise and quantisation.
    """

    state: State
    mode: Mode
    anchor: State
    shown: Any


@final
class Axis:
    """The equations of a truth.

    Parameters
    ----------
    truth : Truth
    m : namespace
        ``FLOATS`` or ``ARRAYS`` of :mod:`servolens.lab.laws`.
    longest : float
        Longest integration step [s].
    angle : float
        Largest product of step and quickest rate.
    unmodelled : UnmodelledEffect, optional
        What the axis does beyond the effects of the truth.
    shaken : bool
        Whether commands carry what shakes the axis.
    """

    def __init__(
        self,
        truth: Truth,
        m: Any,
        longest: float,
        angle: float,
        unmodelled: UnmodelledEffect | None = None,
        shaken: bool = False,
    ) -> None:
        own = {name: LAWS[name].numbers(values) for name, values in truth.effects.items()}
        self.m, self._gain, self._damping, self._angle = m, truth.gain, truth.damping, angle
        self._load_friction = own["load_friction"].share if "load_friction" in own else 0.0
        transmitted = EXTERNAL if self._load_friction else frozenset()
        self._external = _functions(own, "force", only=transmitted)
        self._forces, self._frictions = _functions(own, "force", but=transmitted), _functions(own, "friction")
        if unmodelled is not None:
            self._forces += [(unmodelled.force, SimpleNamespace())]
            self._frictions += [(unmodelled.friction, SimpleNamespace())]
        self._servo, self._limit = own.get("speed_servo"), own.get("force_limit")
        self._dahl, self._stop = own["presliding"] if _slips(own) else None, own.get("end_stop")
        self._joint, self._load_share = _joint(own)
        self._drag = LOAD_DRAG if "backlash" in own else 0.0
        self._share = 1.0 - self._load_share
        self.lag = own["sensor_lag"].time_constant if "sensor_lag" in own else 0.0
        self.has_load, self.has_contact = self._joint is not None, "backlash" in own
        moving_in_time = {"actuator_lag", "gain_drift", "periodic_disturbance", "sensor_lag", "speed_servo"}
        self.evolves_at_rest = self.has_load or not moving_in_time.isdisjoint(own) or unmodelled is not None or shaken
        paces = [pace(p) for name, p in own.items() if (pace := LAWS[name].pace) is not None]
        quickest = max([abs(truth.damping), *paces]) / self._share
        self._step = min(longest, angle / quickest) if quickest > 0.0 else longest
        self._hastes = [(haste, p) for name, p in own.items() if (haste := LAWS[name].haste) is not None]
        self.minds_motion = bool(self._hastes) or self._dahl is not None or self._stop is not None

    def body(self, position: Any, place: float = 0.0) -> Body:
        """Return the axis at rest at `position`, an array for many runs; its motor at this place within a gap."""
        zero = 0.0 * position
        ahead = place * self._joint.half_gap if self._joint is not None else 0.0
        load = (position, zero) if self.has_load else ()
        servo = (zero,) if self._servo is not None else ()
        return Body((position + ahead, zero, *load, *servo), Mode(zero, zero, zero, zero), (position, zero), position)

    def output(self, state: State) -> tuple[Any, Any]:
        """Return position and velocity of what is measured: the load, where there is one."""
        return (state[2], state[3]) if self.has_load else (state[0], state[1])

    def rates(self, t: Any, state: State, body: Body, u: Signal) -> State:
        """Return the time derivative of `state`, with mode and anchor of `body`."""
        d = body.mode.direction
        push, level, joint = self._push(t, state, d, body, u)
        acceleration = (push - d * level) * (d != 0.0)
        rates = [state[1], acceleration]
        if self.has_load:
            rates += [state[3], joint / self._load_share - self._drag * state[3]]
        if self._servo is not None:
            rates.append(self._servo.speed_per_volt * u(t) - state[1])
        return tuple(rates)

    def longest(self, t: Any, body: Body, u: Signal) -> Any:
        """Return the longest step that the physics allows from here [s]."""
        step = u.longest(t, self._step)
        if not self.minds_motion:
            return step
        m, state = self.m, body.state
        speed, acceleration = abs(state[1]), abs(self.rates(t, state, body, u)[1])
        for haste, p in self._hastes:
            rate = haste(p, abs(state[0]), speed, acceleration, m)
            step = m.minimum(step, self._angle / m.maximum(rate, 1e-9))
        if self._stop is not None:
            rate = contact_pace(self._stop)
            moves = m.maximum(speed, acceleration / rate) > SETTLED
            pressed = m.where(moves, 0.6, 2.5) * self._angle / rate
            step = m.where(body.mode.stop != 0.0, m.minimum(step, pressed), step)
        if self._dahl is not None:
            length = self._dahl.level / self._dahl.stiffness
            bends = abs(state[0] - body.anchor[0]) < FADED * length
            rate = 0.4 * across(length, speed, acceleration, m) * bends
            step = m.minimum(step, self._angle / m.maximum(rate, 1e-9))
        return step

    def guards(self, t: Any, state: State, body: Body, u: Signal) -> State:
        """Return what stays positive as long as the mode of `body` holds, in the order of the guards' numbers."""
        m, mode = self.m, body.mode
        d = mode.direction
        resting = d == 0.0
        guard = d * state[1]
        if m.any(resting):
            up, down = self._holds(t, state, body, u)
            guard = m.where(resting, m.minimum(up, down), guard)
        guards = [guard]
        if self._limit is not None:
            asked, most = self._motor(t, state, u), self._limit.acceleration
            guards.append(m.where(mode.limit == 0.0, most - abs(asked), mode.limit * asked - most))
        elif self.has_contact or self._stop is not None:
            guards.append(1.0)
        if self.has_contact:
            guards.append(self._contact_guard(state, mode.contact))
        elif self._stop is not None:
            guards.append(1.0)
        if self._stop is not None:
            guards.append(self._stop_guard(state, mode.stop))
        return tuple(guards)

    def enter(self, t: Any, body: Body, u: Signal) -> Body:
        """Return `body` with the mode that belongs to a command that has just jumped."""
        m, (state, mode, anchor, shown) = self.m, body
        if self._limit is not None:
            asked = self._motor(t, state, u)
            mode = mode._replace(limit=m.sign(asked) * (abs(asked) > self._limit.acceleration))
        d = m.sign(state[1])
        if m.any(d == 0.0):
            d = m.where(d == 0.0, self._departure(t, state, body._replace(mode=mode), u), d)
        return Body(state, mode._replace(direction=d), anchor, shown)

    def cross(self, t: Any, body: Body, u: Signal, fired: Any) -> Body:
        """Return `body`, which stands on an edge, with the mode beyond; `fired` is the number of the guard."""
        m, (state, mode, anchor, shown) = self.m, body
        d = mode.direction
        turned = (fired == DIRECTION) & (d != 0.0)
        if m.any(turned):
            x, velocity = state[0], m.where(turned, 0.0, state[1])
            anchor = (m.where(turned, x, anchor[0]), m.where(turned, self._bent(x, d, anchor), anchor[1]))
            state = (x, velocity, *state[2:])
        if self._limit is not None:
            side = m.where(mode.limit == 0.0, m.sign(self._motor(t, state, u)), 0.0)
            mode = mode._replace(limit=m.where(fired == LIMIT, side, mode.limit))
        if self.has_contact:
            side = m.where(mode.contact == 0.0, m.sign(state[0] - state[2]), 0.0)
            mode = mode._replace(contact=m.where(fired == CONTACT, side, mode.contact))
        if self._stop is not None:
            side = m.where(mode.stop == 0.0, m.sign(2.0 * state[0] - self._stop.low - self._stop.high), 0.0)
            mode = mode._replace(stop=m.where(fired == STOP, side, mode.stop))
        body = Body(state, mode, anchor, shown)
        if m.any(turned):
            d = m.where(turned, self._departure(t, state, body, u), d)
        broken = (fired == DIRECTION) & (mode.direction == 0.0)
        if m.any(broken):
            up, down = self._holds(t + LOOK_AHEAD, state, body, u)
            d = m.where(broken, m.where(up < down, 1.0, -1.0), d)
        return body._replace(mode=mode._replace(direction=d))

    def _departure(self, t: Any, state: State, body: Body, u: Signal) -> Any:
        """Return the direction in which an axis at rest leaves, 0 where dry friction holds it."""
        up, down = self._holds(t, state, body, u)
        return self.m.where(up < 0.0, 1.0, self.m.where(down < 0.0, -1.0, 0.0))

    def _holds(self, t: Any, state: State, body: Body, u: Signal) -> tuple[Any, Any]:
        """Return by how much dry friction exceeds a push upwards and one downwards."""
        push, level, _ = self._push(t, state, 1.0, body, u)
        down, level_down, _ = self._push(t, state, -1.0, body, u)
        return level - push, level_down + down

    def _push(self, t: Any, state: State, d: Any, body: Body, u: Signal) -> tuple[Any, Any, Any]:
        """Return the motor's acceleration without dry friction, the level of that, and the force in the joint."""
        mode = body.mode
        push = self._motor(t, state, u)
        if self._limit is not None:
            push = push * (mode.limit == 0.0) + mode.limit * self._limit.acceleration
        level, joint = 0.0, 0.0
        instant = Instant(state[0], state[1], d * state[1], d, t)
        if self._load_friction:
            external = self._sum(self._external, instant)
            level = self._load_friction * abs(push + self._damping * state[1] + external)
            push = push - external
        push = self._without_forces(push, instant, state, body)
        if u.shaking is not None:
            push = push + u.shaking.at(t)
        for function, p in self._frictions:
            level = level + function(instant, p, self.m)
        if self._joint is None:
            return push, level, joint
        joint = self._joint(state, mode.contact)
        return (push - joint) / self._share, level / self._share, joint

    def _without_forces(self, push: Any, instant: Instant, state: State, body: Body) -> Any:
        """Return the push without the forces that no gear transmits, or without all where it does not matter."""
        for function, p in self._forces:
            push = push - function(instant, p, self.m)
        if self._dahl is not None:
            push = push - self._bent(state[0], body.mode.direction, body.anchor)
        if self._stop is not None:
            push = push - self._stop_force(state, body.mode.stop)
        return push

    def _sum(self, functions: list[tuple[Callable[..., Any], SimpleNamespace]], instant: Instant) -> Any:
        total = 0.0
        for function, p in functions:
            total = total + function(instant, p, self.m)
        return total

    def _motor(self, t: Any, state: State, u: Signal) -> Any:
        """Return the acceleration asked of the motor, back-EMF and damping included, before its limit."""
        servo = self._servo
        if servo is None:
            return self._gain * u(t) - self._damping * state[1]
        error = servo.speed_per_volt * u(t) - state[1]
        return servo.proportional * error + servo.integral * state[-1] - self._damping * state[1]

    def _bent(self, x: Any, d: Any, anchor: State) -> Any:
        """Return Dahl's force after a monotone move from the anchor to `x`, which has a closed form."""
        if self._dahl is None:
            return 0.0 * x
        slips = d * self._dahl.level
        travel = self.m.maximum(d * (x - anchor[0]), 0.0)
        return slips + (anchor[1] - slips) * self.m.exp(-self._dahl.stiffness / self._dahl.level * travel)

    def _stop_force(self, state: State, side: Any) -> Any:
        """Return the force of the end stop that is pressed, 0 where none is."""
        assert self._stop is not None  # noqa: S101 - asked for only where there is one
        edge = self.m.where(side > 0.0, self._stop.high, self._stop.low)
        rate, ratio = 2.0 * math.pi * self._stop.contact_frequency, self._stop.contact_damping
        return (rate * (state[0] - edge) + 2.0 * ratio * state[1]) * rate * (side != 0.0)

    def _stop_guard(self, state: State, side: Any) -> Any:
        """Return what is positive while a pressed stop presses, or while an axis between the stops touches neither."""
        m, stop = self.m, self._stop
        assert stop is not None  # noqa: S101 - asked for only where there is one
        up, down = self._stop_force(state, 1.0 + 0.0 * side), -self._stop_force(state, -1.0 + 0.0 * side)
        free = m.minimum(m.maximum(stop.high - state[0], -up), m.maximum(state[0] - stop.low, -down))
        return m.where(side == 0.0, free, m.where(side > 0.0, up, down))

    def _contact_guard(self, state: State, contact: Any) -> Any:
        """Return what is positive while a pressed flank presses, or while a free load stays free of both."""
        m, joint = self.m, self._joint
        assert joint is not None  # noqa: S101 - only lost motion has flanks
        ahead = state[0] - state[2]
        up, down = joint(state, 1.0), -joint(state, -1.0)
        free = m.minimum(
            m.maximum(joint.half_gap - ahead, -up),
            m.maximum(joint.half_gap + ahead, -down),
        )
        return m.where(contact == 0.0, free, m.where(contact > 0.0, up, down))


def _functions(
    own: dict[str, SimpleNamespace], kind: str, *, only: frozenset[str] | None = None, but: frozenset[str] = frozenset()
) -> list[tuple[Callable[..., Any], SimpleNamespace]]:
    """Return the functions of the effects of a kind, in the order of the table; only some, or all but some."""
    names = [name for name in LAWS if name in own and name not in but and (only is None or name in only)]
    found = [(LAWS[name].function, own[name]) for name in names if LAWS[name].kind == kind]
    return [(function, p) for function, p in found if function is not None]


def _slips(own: dict[str, SimpleNamespace]) -> bool:
    return "presliding" in own and own["presliding"].level > 0.0 and own["presliding"].stiffness > 0.0


class _Joint:
    """Spring and damper between motor and load, per unit of total mass; with lost motion, one flank of it."""

    def __init__(self, rate: float, damping_ratio: float, load_share: float, gap: float | None) -> None:
        reduced = load_share * (1.0 - load_share)
        self.stiffness, self.damper = rate * rate * reduced, 2.0 * damping_ratio * rate * reduced
        self.half_gap, self.always = (0.0, True) if gap is None else (0.5 * gap, False)

    def __call__(self, state: State, contact: Any) -> Any:
        force = self.stiffness * (state[0] - state[2]) + self.damper * (state[1] - state[3])
        if self.always:
            return force
        return force * (contact != 0.0) - contact * (self.stiffness * self.half_gap)


def _joint(own: dict[str, SimpleNamespace]) -> tuple[_Joint | None, float]:
    """Return what joins motor and load, and the load's share of the mass; (None, 0) for one mass."""
    if "flexible_coupling" in own:
        p = own["flexible_coupling"]
        return _Joint(2.0 * math.pi * p.frequency, p.damping_ratio, p.load_ratio, None), p.load_ratio
    if "backlash" in own:
        p = own["backlash"]
        return _Joint(2.0 * math.pi * p.contact_frequency, p.contact_damping, p.load_share, p.gap), p.load_share
    return None, 0.0
