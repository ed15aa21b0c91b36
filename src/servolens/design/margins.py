"""What the linearised loop says: peaks of sensitivity, delay margin, and how much noise reaches the command."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.dynamics import dynamics
from servolens.effects import Backlash, DeadZone
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servolens.design.spec import PDSpec
    from servolens.effects import Effect

    Complex = NDArray[np.complex128]
    Floats = NDArray[np.float64]

__all__ = [
    "POINTS",
    "LinearLoops",
    "LoopMargins",
    "controller_responses",
    "frequencies",
    "loop_margins",
    "plant_responses",
]

LOWEST = 1e-2
"""Share of the undamped frequency of the loop at which its frequency response begins."""
POINTS = 400
"""Frequencies, evenly in their logarithm."""
FASTEST = 100.0
"""Times the undamped frequency at which that of a continuous loop ends."""
WITHOUT_SLOPE = (Backlash, DeadZone)
"""Effects that let no small signal through at rest; a linearisation goes without them, as without dry friction."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class LoopMargins:
    """Of the linearised loop; of several plants and speeds the worst.

    Attributes
    ----------
    peak_sensitivity : float
        Ms, the largest |S|: 1/Ms is the distance of the Nyquist curve from −1.
    peak_complementary : float
        Mt, the largest |T|.
    delay_margin : float
        By how much the command may come later before the loop is unstable [s]; infinite where the gain never is 1.
    noise_gain : float or None
        R.m.s. of the command for white measurement noise of r.m.s. 1 [V/m]; None for a continuous loop.
    """

    peak_sensitivity: float
    peak_complementary: float
    delay_margin: float
    noise_gain: float | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields; an infinite delay margin is null with a reason."""
        result = {f.name: getattr(self, f.name) for f in fields(self)}
        if not np.isfinite(self.delay_margin):
            result |= {"delay_margin": None, "reason": "the loop's gain never is 1: no delay makes it unstable"}
        return result


@final
class LinearLoops:
    """The loops of a spec with each of some plants, linearised at rest and at the step's speed.

    Parameters
    ----------
    plants : sequence of Plant
        Of which the worst counts.
    spec : PDSpec
        The loop but for the gain that is sought.
    realised : sequence of float, optional
        What the gain of the loop is multiplied by, one a plant.
    """

    def __init__(self, plants: Sequence[Plant], spec: PDSpec, realised: Sequence[float] = ()) -> None:
        self._spec, self._omega = spec, frequencies(plants, spec)
        factors = np.repeat(np.asarray(realised, dtype=np.float64), 2) if realised else np.ones(2 * len(plants))
        answers = _responses(plants, spec, self._omega)
        self._plants = [factor * answer for factor, answer in zip(factors, answers, strict=True)]

    def margins(self, gain: float, spec: PDSpec | None = None) -> LoopMargins:
        """Return the margins with the gain that is sought, perhaps with a `spec` that has another ki or filter."""
        spec = spec or self._spec
        of_position, of_velocity = controller_responses(spec, gain, self._omega)
        loops = [position * of_position + velocity * of_velocity for position, velocity in self._plants]
        found = [_margins(loop, of_position, self._omega, spec) for loop in loops]
        noise = [one.noise_gain for one in found if one.noise_gain is not None]
        return LoopMargins(
            peak_sensitivity=max(one.peak_sensitivity for one in found),
            peak_complementary=max(one.peak_complementary for one in found),
            delay_margin=min(one.delay_margin for one in found),
            noise_gain=max(noise) if noise else None,
        )


def loop_margins(plants: Sequence[Plant], spec: PDSpec, gain: float) -> LoopMargins:
    """Return the margins of the loop with the gains of `spec` and the one that is sought; see :class:`LinearLoops`."""
    return LinearLoops(plants, spec).margins(gain)


def frequencies(plants: Sequence[Plant], spec: PDSpec) -> Floats:
    """Return the frequencies [rad/s] at which loops are looked at, up to half the sampling frequency."""
    natural = [spec.rate(plant.gain) for plant in plants]
    last = FASTEST * max(natural) if spec.control == "continuous" else np.pi / spec.sample_time
    return np.asarray(np.geomspace(LOWEST * min(*natural, last), last, POINTS), dtype=np.float64)


def controller_responses(spec: PDSpec, gain: float, omega: Floats) -> tuple[Complex, Complex]:
    """Return the controller's responses from position and velocity signal to the command, without its sign."""
    s = 1j * omega
    if spec.control == "continuous":
        return np.asarray(spec.kp + gain * s), np.zeros(omega.size, dtype=np.complex128)
    back = np.exp(-s * spec.sample_time)
    share, step, window = spec.derivative_filter, spec.sample_time, spec.derivative_window
    filtered, summed = share / (1.0 - (1.0 - share) * back), step / (1.0 - back)
    has_signal = spec.derivative == "velocity"
    slope = 0.0 if has_signal else filtered * (1.0 - back**window) / (window * step)
    signal = filtered if has_signal else np.zeros(omega.size)
    if spec.controller == "cascade":
        speed_loop = gain + spec.kiv * summed
        return np.asarray(speed_loop * (spec.kp + slope)), np.asarray(speed_loop * signal)
    return np.asarray(spec.kp + gain * slope + spec.ki * summed), np.asarray(gain * signal)


def plant_responses(plants: Sequence[Plant], spec: PDSpec, omega: Floats) -> list[Complex]:
    """Return the response from command to position of each linearised plant, at rest and at the speed of the step."""
    return [position for position, _ in _responses(plants, spec, omega)]


def _responses(plants: Sequence[Plant], spec: PDSpec, omega: Floats) -> list[Complex]:
    """Return the same from command to position and velocity, shape (2, n) each."""
    speeds = (0.0, 2.0 * spec.reference / spec.settling_time)
    return [_response(plant, spec, omega, speed) for plant in plants for speed in speeds]


def _response(plant: Plant, spec: PDSpec, omega: Floats, speed: float) -> Complex:
    effects = tuple(effect for effect in plant.effects if not isinstance(effect, WITHOUT_SLOPE))
    smooth = Plant(gain=plant.gain, damping=plant.damping, effects=effects)
    slopes, resting = _slopes(smooth.structure)
    values = list(smooth.values)
    begin = resting(spec.reference, values)
    a, b, c = (matrix.full() for matrix in slopes(spec.reference, speed, float(np.sign(speed)), values, begin))
    late = np.exp(-1j * omega * plant.delay)
    if spec.control == "continuous":
        return np.asarray(late * _resolved(a, b, c, 1j * omega), dtype=np.complex128)
    a, b = _held(a, b, spec.sample_time)
    return np.asarray(late * _resolved(a, b, c, np.exp(1j * omega * spec.sample_time)), dtype=np.complex128)


@lru_cache(maxsize=256)
def _slopes(structure: tuple[type[Effect], ...]) -> tuple[Any, Any]:
    """Return functions of an axis without dry friction: its A, B and C in a motion, and its states at rest.

    C has a row for the position and one for the velocity.
    """
    import casadi as ca

    d = dynamics(structure)
    state = ca.vertcat(d.position, d.velocity, d.states)
    flow = ca.vertcat(d.velocity, d.push, d.rates)
    outputs = ca.vertcat(d.shown, d.output_velocity)
    found = [ca.jacobian(flow, state), ca.jacobian(flow, d.command), ca.jacobian(outputs, state)]
    still = ca.substitute([*found, d.beginning], [d.time, d.command], [ca.SX(0.0), ca.SX(0.0)])
    motion = [d.position, d.velocity, d.direction, d.parameters, d.states]
    return ca.Function("slopes", motion, still[:3]), ca.Function("resting", [d.position, d.parameters], still[3:])


def _held(a: Floats, b: Floats, step: float) -> tuple[Floats, Floats]:
    """Return the matrices of a plant whose input is held from sample to sample (Van Loan's exponential)."""
    from scipy.linalg import expm

    n = a.shape[0]
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n:] = a, b
    whole = expm(step * block)
    return whole[:n, :n], whole[:n, n:]


def _resolved(a: Floats, b: Floats, c: Floats, points: NDArray[Any]) -> Complex:
    """Return C (z − A)⁻¹ B at each of the points, shape (rows of C, points)."""
    matrices = points[:, None, None] * np.eye(a.shape[0]) - a
    return np.asarray((c @ np.linalg.solve(matrices, np.broadcast_to(b, (points.size, *b.shape))))[:, :, 0].T)


def _margins(loop: Complex, controller: Complex, omega: Floats, spec: PDSpec) -> LoopMargins:
    sensitivity = 1.0 / (1.0 + loop)
    noise = None
    if spec.control == "sampled":
        made = np.abs(controller * sensitivity) ** 2
        noise = float(np.sqrt(np.trapezoid(made, omega) * spec.sample_time / np.pi))
    return LoopMargins(
        peak_sensitivity=float(np.abs(sensitivity).max()),
        peak_complementary=float(np.abs(loop * sensitivity).max()),
        delay_margin=_delay_margin(loop, omega),
        noise_gain=noise,
    )


def _delay_margin(loop: Complex, omega: Floats) -> float:
    """Return the least phase margin over its frequency, at all frequencies where the gain is 1."""
    gain, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    crossings = np.flatnonzero(np.sign(gain[1:]) != np.sign(gain[:-1]))
    if crossings.size == 0:
        return float("inf")
    share = gain[crossings] / (gain[crossings] - gain[crossings + 1])
    at = omega[crossings] * (omega[crossings + 1] / omega[crossings]) ** share
    turned = phase[crossings] + share * (phase[crossings + 1] - phase[crossings])
    return float(np.min(np.mod(turned + np.pi, 2.0 * np.pi) / at))
