"""Feedforward from the plant: the voltage with which it would follow a reference by itself, and what that is worth."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.control_arithmetic import LoopSignals, answer
from servolens.controller import Controller
from servolens.design.inverse_dynamics import command_for, inverts, without_swings
from servolens.design.rest import rest_of
from servolens.effects import Saturation
from servolens.errors import InputError, NumericalError, flags, needed
from servolens.inputs import as_plant
from servolens.record_signals import as_finite
from servolens.simulation import simulate_loop

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from servolens.design.scenarios import Scenario
    from servolens.design.spec import PDSpec
    from servolens.inputs import Plants
    from servolens.plant import Plant

__all__ = ["Tracking", "feedforward", "smooth_move", "tracking"]

AFTER = 0.5
"""Durations of a move for which the axis is watched after it."""


def feedforward(
    plant: Plants,
    time: ArrayLike,
    reference: ArrayLike,
    *,
    controller: Controller | None = None,
    velocity: bool = True,
    acceleration: bool = True,
    friction: bool = True,
) -> NDArray[np.float64]:
    """Return the voltage with which `plant` would follow `reference`, so that the controller has nothing left to do.

    The equation of motion is solved for the voltage, at the middle of each sample, for which that is held. Left out is
    what cannot be inverted so: an elastic or loose transmission counts as rigid, a lag as none. A delay is made up for
    by looking ahead, a dead zone is jumped over, and where the plant has a voltage limit the answer keeps it.

    Parameters
    ----------
    plant : Plant, model, fit, diagnosis, or path of a model's file
        The axis.
    time, reference : array_like, shape (n,)
        At least 4 samples, increasing [s]; a trajectory [m or rad]. A reference that jumps asks for a pulse.
    controller : Controller, optional
        The loop that it is added to. One that differentiates the measurement brakes an axis that follows: kd ṙ makes up
        for that, and the set-point weight is made up for likewise. (A cascade has its own feedforward of the speed.)
    velocity, acceleration, friction : bool
        Whether forces that depend on the velocity, the acceleration, and dry friction are made up for. Those of the
        position always are.

    Returns
    -------
    ndarray, shape (n,)
        [V or the plant's command unit], for the column ``feedforward``.

    Raises
    ------
    InputError
        If the samples do not fit together.

    References
    ----------
    .. [1] B. Siciliano et al., *Robotics: Modelling, Planning and Control*, Springer 2009, section 8.5.1.

    Examples
    --------
    >>> from servolens import CoulombFriction, Plant
    >>> axis = Plant(gain=2.0, damping=6.0, effects=(CoulombFriction(level=0.4),))
    >>> feedforward(axis, [0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.1, 0.2, 0.3, 0.4]).round(3).tolist()[1:3]  # 1 m/s
    [3.2, 3.2]
    """
    plant = as_plant(plant)
    flags(velocity=velocity, acceleration=acceleration, friction=friction)
    t, r = as_finite(time, "time"), as_finite(reference, "reference")
    if controller is not None:
        needed(controller, Controller)
    if t.ndim != 1 or t.size < 4 or r.shape != t.shape or not np.all(np.diff(t) > 0):
        raise InputError("a feedforward needs time that increases and a reference of its size, at least 4 samples")
    if plant.delay > 0:
        r = np.interp(t + plant.delay, t, r)
    place, speed, push = _motion(t, r)
    way = np.sign(speed) if friction else np.zeros(t.size)
    rigid = replace(plant, effects=tuple(effect for effect in plant.effects if inverts(effect)))
    wanted = [place, speed if velocity else 0.0 * speed, way, push if acceleration else 0.0 * push, t]
    found = command_for(rigid, np.stack(wanted))
    limit = plant.effect(Saturation.name)
    if isinstance(limit, Saturation):
        found = np.clip(found, -limit.limit, limit.limit)
    return found if controller is None else found - _braking(controller, t, as_finite(reference, "reference"))


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    """What feedforward is worth on a smooth move, simulated.

    Attributes
    ----------
    size, duration : float
        Of the move [m or rad, s].
    without, with_it : float
        Error of tracking, r.m.s. over the move and half as long after it [m or rad].
    worst : float
        With it, the worst of the plants that may be the axis [m or rad].
    """

    size: float
    duration: float
    without: float
    with_it: float
    worst: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def tracking(plant: Plant, spec: PDSpec, gain: float, scenarios: Sequence[Scenario] = ()) -> Tracking | None:
    """Return how a loop tracks a smooth move of the step's size in the settling time, without and with feedforward.

    The feedforward stems from `plant`, in the `scenarios` too; a cascade is given the whole speed of the reference.
    None where a loop is unstable, or ideal and continuous.
    """
    if spec.control == "continuous":
        return None
    time, reference = smooth_move(spec.reference, spec.settling_time, spec.sample_time)
    loop = spec.loop(gain)
    helped = replace(loop, velocity_feedforward=loop.kd) if loop.integral_rate > 0 else loop
    added = feedforward(plant, time, reference, controller=helped)
    still = feedforward(without_swings(plant), time, 0.0 * reference, controller=helped)

    def error(axis: Plant, used: Controller, share: float) -> float:
        voltage = share * added
        limit = None if axis.effect(Saturation.name) is not None else np.inf
        rest = rest_of(axis, used, 0.0, share * float(still[0]))
        used, start = replace(used, integral_before=rest.integral), (rest.position, 0.0)
        run = simulate_loop(
            axis, used, time, reference, feedforward=voltage, start=start, before=rest.applied, limit=limit
        )
        return float(np.sqrt(np.mean((run.position - reference) ** 2)))

    try:
        own, without = error(plant, helped, 1.0), error(plant, loop, 0.0)
        others = [error(s.plant, helped.scaled(s.realised), s.realised) for s in scenarios]
    except NumericalError:
        return None
    return Tracking(
        size=spec.reference, duration=spec.settling_time, without=without, with_it=own, worst=max([own, *others])
    )


def smooth_move(size: float, duration: float, sample_time: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return time and reference of a move with the least jerk, and a rest after it (Flash and Hogan 1985)."""
    time = np.asarray(sample_time * np.arange(round((1.0 + AFTER) * duration / sample_time) + 1), dtype=np.float64)
    s = np.clip(time / duration, 0.0, 1.0)
    return time, size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def _braking(controller: Controller, t: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what a controller without its integral asks for where the axis follows the reference exactly."""
    alone = replace(controller, ki=0.0, integral_rate=0.0, integral_before=0.0)
    seen = LoopSignals(
        time=t, reference=r, position=r, sample_time=float(np.median(np.diff(t))), velocity=_motion(t, r)[1]
    )
    found = answer(alone, seen)
    return found.ahead - controller.kd * found.derivative


def _motion(t: NDArray[np.float64], r: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return position, velocity and acceleration of a reference in the middle between samples; at last those before."""
    slopes = np.diff(r) / np.diff(t)
    middles = 0.5 * (t[1:] + t[:-1])
    bends = np.gradient(slopes, middles)
    return tuple(np.append(x, x[-1]) for x in (0.5 * (r[1:] + r[:-1]), slopes, bends))
