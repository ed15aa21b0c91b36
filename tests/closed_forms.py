"""Sticking and sliding in closed form: a mass with Coulomb friction, spring and push, phase after phase.

The cases are those of Code_Aster's manual of validation (V5.01.100, SDND100: released on a spring; V5.01.104, SDND104:
on a plane that shakes), of Rabinowicz' test, by which Pennestrì, Rossi, Salvini and Valentini compare models of
friction (2016, doi:10.1007/s11071-015-2485-3: pulled through a spring at constant speed), and of Den Hartog (1931:
shaken on a spring, with stops). Each phase has a closed form; the instants at which one ends are bracketed roots.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from servolens.effects import ConstantForce, CoulombFriction, GainDrift, PeriodicDisturbance, ReturnSpring
from servolens.plant import Plant
from servolens.simulation import simulate_voltage

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servolens.effects import Effect

__all__ = ["CASES", "MICROSECONDS", "Rubbing", "exact", "relative_error"]

LOOK = 1e-3
"""[s] between the places at which the end of a phase is looked for."""
MICROSECONDS = 1000
"""Steps of a sample of 1 ms."""


@dataclass(frozen=True, kw_only=True)
class Rubbing:
    """From rest at `y`: ÿ = ramp·t − stiffness·y − damping·ẏ − amplitude·sin(2π·frequency·t) − level·sgn ẏ."""

    name: str
    level: float
    stiffness: float = 0.0
    damping: float = 0.0
    ramp: float = 0.0
    amplitude: float = 0.0
    frequency: float = 1.0
    y: float = 0.0
    duration: float

    @property
    def plant(self) -> Plant:
        """The same axis made of effects; the ramp is a gain that drifts, less what it is at the beginning."""
        effects: list[Effect] = [CoulombFriction(level=self.level), ReturnSpring(stiffness=self.stiffness)]
        effects.append(PeriodicDisturbance(amplitude=self.amplitude, frequency=self.frequency, phase=0.0))
        if self.ramp:
            effects += [GainDrift(rate=1.0), ConstantForce(acceleration=self.ramp)]
        return Plant(gain=self.ramp or 1.0, damping=self.damping, effects=tuple(effects))

    def push(self, t: float, y: float) -> float:
        """Return the acceleration at rest, friction apart."""
        return float(self.ramp * t - self.stiffness * y - self.amplitude * np.sin(2 * np.pi * self.frequency * t))


CASES = (
    Rubbing(name="released on a spring (SDND100)", level=1.0, stiffness=1e4, y=0.85e-3, duration=0.2),
    Rubbing(name="shaking plane, sticks (SDND104)", level=1.0, amplitude=0.95, frequency=2.0, duration=2.0),
    Rubbing(name="shaking plane, sticks and slips (SDND104)", level=1.0, amplitude=1.3, frequency=2.0, duration=2.0),
    Rubbing(name="shaking plane, slips only (SDND104)", level=1.0, amplitude=5.0, frequency=2.0, duration=2.0),
    Rubbing(
        name="shaken on a spring, with stops (Den Hartog)",
        level=1.0,
        stiffness=400.0,
        amplitude=1.6,
        frequency=1.1,
        duration=3.0,
    ),
    Rubbing(name="pulled through a spring", level=1.0, stiffness=400.0, ramp=20.0, duration=1.0),
    Rubbing(
        name="pulled, friction weaker with speed (Rabinowicz)",
        level=1.0,
        stiffness=400.0,
        damping=-3.0,
        ramp=20.0,
        duration=3.0,
    ),
)


def relative_error(case: Rubbing, substeps: int | None = None) -> float:
    """Return the largest error of the simulated position at samples of 1 ms, as a share of the travel."""
    time = 1e-3 * np.arange(round(1e3 * case.duration) + 1)
    voltage = np.full(time.size, 1.0 if case.ramp else 0.0)
    run = simulate_voltage(case.plant, time, voltage, start=(case.y, 0.0), substeps=substeps)
    position, _ = exact(case, time)
    return float(np.abs(run.position - position).max() / (np.ptp(position) or 1.0))


def exact(case: Rubbing, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[float]]:
    """Return the position at the `times` in closed form, and how long each phase of rest between two slides lasts."""
    found, rests = np.full(times.size, case.y), []
    t, y, end = 0.0, case.y, float(times[-1])
    while t < end:
        begin = t
        if abs(case.push(t, y)) < case.level:
            t = _first(lambda s, y=y: abs(case.push(s, y)) - case.level, t, end)
        rests.append(t - begin)
        direction = float(np.sign(case.push(t, y)))
        position, velocity = _slide(case, t, y, direction)
        until = _first(lambda s, d=direction, v=velocity: -d * v(s), t, end)
        sliding = (times >= t) & (times <= until)
        found[sliding] = position(times[sliding])
        t, y = until, float(position(until))
        found[times > t] = y
    return found, rests


def _first(function: Callable[[float], float], begin: float, end: float) -> float:
    """Return where `function`, negative after `begin`, first becomes positive; the end where it does not."""
    places = np.append(np.arange(begin + LOOK, end, LOOK), end)
    for low, high in pairwise(places):
        if function(high) > 0.0 >= function(low):
            return float(brentq(function, low, high, xtol=1e-16, rtol=1e-15))
    return end


def _slide(
    case: Rubbing, begin: float, y: float, direction: float
) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """Return position and velocity over time of what leaves rest at `y` in this direction.

    A particular solution, α + β s + Im(z e^{iωs}) of the time s since then, or their integrals where there is no
    spring, and the free motion that makes up for what it is at the beginning.
    """
    k, c, omega = case.stiffness, case.damping, 2 * np.pi * case.frequency
    constant = case.ramp * begin - direction * case.level
    wave = -case.amplitude * np.exp(1j * omega * begin)
    if k == 0.0:  # nor damping, nor a ramp
        swing, rise = -wave / omega**2, 0.5 * constant
        away, speed = -swing.imag, -(1j * omega * swing).imag
        return (
            lambda t: y + away + speed * (t - begin) + rise * (t - begin) ** 2 + _turned(swing, omega, t - begin),
            lambda t: speed + 2.0 * rise * (t - begin) + _turned(1j * omega * swing, omega, t - begin),
        )
    swing, slope = wave / (k - omega**2 + 1j * c * omega), case.ramp / k
    middle = (constant - c * slope) / k
    away, speed = y - middle - swing.imag, -slope - (1j * omega * swing).imag
    fading, own = -0.5 * c, np.sqrt(k - 0.25 * c**2)
    free = (speed - fading * away) / own + 1j * away  # Im(free e^{(fading + i own) s})
    rate = fading + 1j * own
    return (
        lambda t: (
            middle + slope * (t - begin) + _turned(swing, omega, t - begin) + (free * np.exp(rate * (t - begin))).imag
        ),
        lambda t: (
            slope + _turned(1j * omega * swing, omega, t - begin) + (rate * free * np.exp(rate * (t - begin))).imag
        ),
    )


def _turned(swing: complex, omega: float, s: float) -> float:
    return (swing * np.exp(1j * omega * s)).imag
