"""Responses of python-control, held against the kernel's."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.bridge.system import PlantSystem
from servolens.effects import DryFriction
from servolens.errors import InputError, NumericalError, described, number_within
from servolens.simulation.loop import simulate_continuous, simulate_voltage
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servolens.plant import Plant

__all__ = ["TOLERANCE", "ResponseWarning", "check_response", "judge"]

TOLERANCE = 1e-3
"""Distance from the kernel's response that may pass, as a share of its travel: what a plot shows."""

CREEP = 5.0
"""Speed of smoothed friction's creep in widths under a push of 0.9999 of the level: atanh 0.9999."""
AWAY = 1.0
"""Distance from the kernel, in travels, from which on an answer counts as nonsense."""
MOMENT = 1e-9
"""Time [s] that stands for the past of an axis whose first input came as a jump."""
NOTHING = 1e-9
"""Distance [m or rad] that solvers leave where nothing moves."""
KERNEL_STEP = 5e-5
"""Substep of the kernel [s], finer than it needs, so that what is found is python-control's."""


class ResponseWarning(UserWarning):
    """A response of python-control is not what the axis does."""


def check_response(system: PlantSystem, response: Any, *, tolerance: float = TOLERANCE) -> float:
    """Simulate with the kernel what `response` shows, and warn if the two are apart.

    A solver may return nonsense as success; this tells. The kernel holds the inputs from sample to sample, lets dry
    friction stick, and delays by the very time: what smoothing, interpolation and Padé's approximation cost counts.

    Parameters
    ----------
    system : PlantSystem
        Of :func:`to_control` or :func:`closed_loop`.
    response : TimeResponseData
        Of that system: of :func:`held_response` or ``input_output_response``, with the states. It must begin at rest,
        under its first input or under 0 (with a delay: under its first input), see :meth:`PlantSystem.at_rest`; without
        effects that have states it may begin anyhow.
    tolerance : float
        Largest distance that passes without a warning, as a share of the kernel's travel.

    Returns
    -------
    float
        Largest distance of the positions shown [m or rad]; infinite if either is not bounded.

    Warns
    -----
    ResponseWarning
        How far apart they are, when, the likely cause, and what to do.

    Raises
    ------
    InputError
        If the system is not one plant or loop, the response is not its own, or the kernel cannot begin as it does.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> from servolens.bridge import SOLVER, check_response, closed_loop
    >>> from servolens.plant import Plant
    >>> loop = closed_loop(Plant(gain=1.9, damping=6.0), kp=60)
    >>> time = np.linspace(0.0, 1.0, 501)
    >>> response = ct.input_output_response(loop, time, np.full(501, 0.1), solve_ivp_kwargs=SOLVER)
    >>> check_response(loop, response) < 1e-7
    True
    """
    return judge(system, response, number_within(tolerance, 0.0, np.inf, "tolerance"), held=False)


def judge(system: Any, response: Any, tolerance: float, *, held: bool) -> float:
    """Do what :func:`check_response` does; `held` says that the response is of :func:`held_response`."""
    case = _case(system, response)
    try:
        exact = case.kernel()
    except NumericalError as failure:
        return _warn(float("inf"), f"there is no response to trust: {failure}")
    if not np.isfinite(case.shown).all():
        return _warn(float("inf"), f"the response is not finite from {case.first_lost:g} s on: {NONSENSE}")
    apart = np.abs(case.shown - exact)
    at, distance = int(apart.argmax()), float(apart.max())
    travel = float(np.ptp(exact))
    if distance <= tolerance * travel + NOTHING:
        return distance
    share = f"{distance / travel:.2g} of its travel" if travel > 0 else "where the axis stays at rest"
    return _warn(
        distance,
        f"the response is {distance:.3g} {case.plant.length_unit} off the kernel's at {case.time[at]:g} s "
        f"({share}), most likely because {case.cause(distance, travel, held)}",
    )


NONSENSE = (
    "the solver returned nonsense as success; use held_response or SOLVER, a larger friction_width, "
    "or servolens.simulation"
)


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Case:
    """What was simulated: samples, the input, the position shown, and how it began."""

    system: PlantSystem
    plant: Plant
    gains: list[float]
    time: NDArray[np.float64]
    held: NDArray[np.float64]
    shown: NDArray[np.float64]
    start: tuple[float, float]
    before: float

    @property
    def first_lost(self) -> float:
        """Time of the first sample that is not finite."""
        return float(self.time[int(np.argmin(np.isfinite(self.shown)))])

    def kernel(self) -> NDArray[np.float64]:
        """Return the position that the sensor shows, by the kernel."""
        time, held = self.time, self.held
        jumped = self.before != held[0]
        if jumped:
            moment = max(MOMENT, 4 * float(np.spacing(np.abs(time[0]))))
            time, held = np.r_[time[0] - moment, time], np.r_[self.before, held]
        step = float(np.diff(time).max())
        if self.gains:
            kp, kd = self.gains
            loop = np.sqrt(abs(self.plant.gain * kp)) + abs(self.plant.gain * kd)
            count = max(substeps_for(self.plant, step, extra=float(loop)), int(np.ceil(step / KERNEL_STEP)))
            found = simulate_continuous(self.plant, kp, kd, time, held, start=self.start, substeps=count)
        else:
            count = max(substeps_for(self.plant, step), int(np.ceil(step / KERNEL_STEP)))
            found = simulate_voltage(self.plant, time, held, start=self.start, substeps=count)
        return found.measured[int(jumped) :]

    def cause(self, distance: float, travel: float, held: bool) -> str:
        """Return the likely cause of a distance, and what to do."""
        elapsed = float(self.time[-1] - self.time[0])
        width = self.system.updfcn.width
        dry = any(issubclass(cls, DryFriction) for cls in self.plant.structure)
        if dry and distance <= CREEP * width * elapsed:
            return (
                f"smoothed friction creeps (friction_width {width:g}); make friction_width smaller, "
                "or simulate an axis that sticks with servolens.simulation"
            )
        if travel > 0 and distance > AWAY * travel:
            return NONSENSE
        if not held and np.any(np.diff(self.held[:-1])):
            return "the inputs were interpolated, or stepped over; use held_response"
        if self.plant.delay > 0:
            return "Padé's approximation of the delay is too coarse; use a larger delay_order"
        if not held:
            return "the solver's tolerances are loose; pass solve_ivp_kwargs=SOLVER or use held_response"
        return "contacts or an instability magnify what the solver leaves; trust servolens.simulation more"


def _case(system: Any, response: Any) -> _Case:
    if not isinstance(system, PlantSystem):
        raise InputError(f"only systems of to_control and closed_loop can be checked, got {type(system).__name__}")
    equations = system.updfcn
    time, shown, states, inputs = (np.asarray(a, dtype=np.float64) for a in _raw(system, response))
    params = {**system.params, **(response.params or {})}
    numbers = equations.numbers(params)
    count = len(equations.plant.values)
    plant = equations.plant.with_values(numbers[:count])
    if plant.delay > 0 and equations.closed:
        raise InputError("a loop with a delay cannot be checked: the kernel's ideal continuous loop holds none")
    return _Case(
        system=system,
        plant=plant,
        gains=numbers[count:],
        time=time,
        held=np.ascontiguousarray(inputs[0]),
        shown=shown[0],
        start=(float(states[0, 0]), float(states[1, 0])),
        before=_before(system, states[:, 0], float(inputs[0, 0]), float(time[0]), params, plant.delay),
    )


def _raw(system: PlantSystem, response: Any) -> tuple[Any, Any, Any, Any]:
    """Return time, outputs, states and inputs, or refuse a response that is not the system's."""
    if not all(hasattr(response, part) for part in "tyxu"):
        raise InputError(f"a response of python-control is needed, such as of held_response; got {described(response)}")
    time, outputs, states, inputs = response.t, response.y, response.x, response.u
    if states is None or np.shape(states) != (system.nstates, len(time)) or np.shape(inputs) != (1, len(time)):
        raise InputError(
            f"the response is not one of {system.name}: it needs {system.nstates} states and 1 input of "
            f"{len(time)} samples, got shapes {np.shape(states)} and {np.shape(inputs)}"
        )
    return time, outputs, states, inputs


def _before(
    system: PlantSystem, begun: NDArray[np.float64], first: float, time: float, params: dict[str, float], delay: float
) -> float:
    """Return the input under which the axis was at rest before it began as it does in `begun`."""
    for before in (first,) if delay > 0 else (first, 0.0):
        rest = system.at_rest(float(begun[0]), before, time=time, params=params)
        if np.allclose(begun[2:], rest[2:], rtol=1e-9, atol=1e-12):
            return before
    raise InputError(
        "the kernel cannot begin as this response does: begin at rest, for example with "
        'held_response(..., initial_state="at rest")'
    )


def _warn(distance: float, sentence: str) -> float:
    warnings.warn(sentence, ResponseWarning, stacklevel=4)
    return distance
