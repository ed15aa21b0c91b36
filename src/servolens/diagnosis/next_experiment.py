"""The experiment that best tells rivals apart."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from servolens.diagnosis.logged import Logged
from servolens.record import Controller, Record
from servolens.simulation import Simulation, simulate_many
from servolens.simulation.rates import substeps_for

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.errors import ServolensError
    from servolens.plant import Plant

__all__ = ["Experiment", "next_experiment", "proposed"]

GAINS, DAMPINGS = 6, 4
"""How many kp and kd are tried."""
SLOWER, FASTER = 0.5, 2.0
"""Times the logged gains between which those proposed lie."""
LARGEST = math.sqrt(sys.float_info.max)
"""Gain from which on its products are no numbers: none is proposed, for no loop had it."""
MOST_SAMPLES = 3000
"""Of one level: a longer one adds rest and no knowledge."""
MOST_RIVALS = 4
BEYOND = 0.1
"""Share of the logged travel by which a proposed experiment may leave it."""
CALM = 0.5
"""Share of the step within which the last quarter of a level must stay: else the loop is too close to unstable."""
RETURN = 1.5
"""Times what a single step separates that one with a return must, to be worth the longer experiment."""
LEAST_SEPARATION = 0.3
"""Separation [noise] that an experiment must reach: less may come from errors of the parameters. Two that none parts so
far do not rule the choice."""
FINE = 8
"""Substeps at least: what the simulation itself gets wrong must not part rivals."""
REST = 5
"""Samples before the step: what the axis remembers is that of rest."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """A step to log next.

    Attributes
    ----------
    kp, kd : float
        Gains.
    start, reference : float
        Where the axis rests before, and the set point of the step [m or rad].
    back : bool
        Whether the reference goes back to the start afterwards.
    duration : float
        Time for each of the levels [s].
    sample_time : float
        Of the loop and the log [s].
    separates : tuple of str
        The two effects whose responses differ least, so that all others are told apart as well.
    separation : float
        R.m.s. difference of their responses in units of the noise.
    """

    kp: float
    kd: float
    start: float
    reference: float
    back: bool
    duration: float
    sample_time: float
    separates: tuple[str, str]
    separation: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``next_experiment``."""
        return {
            "kp": self.kp,
            "kd": self.kd,
            "start": self.start,
            "reference": self.reference,
            "back": self.back,
            "duration": self.duration,
            "sample_time": self.sample_time,
            "separates": list(self.separates),
            "separation": self.separation,
        }


def next_experiment(
    plants: Mapping[str, Plant], logged: Sequence[Record | Logged], *, noise: float
) -> Experiment | None:
    """Return the step in whose response the plants differ most, as far as it is safe; None if none parts any.

    It keeps to what was logged: gains from half to twice those used, kd from none to twice, a step as large or half as
    large, no more voltage, no place where the axis has not been, and loops that are calm whichever plant is right. Of
    the pairs of plants the one told apart least decides. Nothing is fitted anew.

    Parameters
    ----------
    plants : mapping of str to Plant
        Rivals by name.
    logged : sequence of Record or Logged
        Experiments of the axis so far, at least one.
    noise : float
        R.m.s. of the position's noise [m or rad].
    """
    if len(plants) < 2:
        return None
    before = [one if isinstance(one, Logged) else Logged.of(one) for one in logged]
    largest = max(before, key=lambda one: one.amplitude)
    trials = _trials(largest, before, next(iter(plants.values())))
    finest = max(FINE, *(substeps_for(plant, largest.sample_time) for plant in plants.values()))
    answers = simulate_many(plants.values(), trials, substeps=finest)
    bounds = _Bounds.of(before)
    pairs = [*combinations(range(len(plants)), 2)]
    options = []
    for i, trial in enumerate(trials):
        for back in (False, True):
            runs = [_kept(plant[i], trial, bounds, back) for plant in answers]
            safe = [run for run in runs if run is not None]
            if len(safe) == len(plants):
                apart = np.array([_rms(safe[a] - safe[b]) for a, b in pairs])
                options.append(_Option(trial, back, apart / max(noise, 1e-300)))
    best, least = _best(options) if options else (None, 0)
    if best is None:
        return None
    names = [*plants]
    return best.experiment((names[pairs[least][0]], names[pairs[least][1]]), float(best.apart[least]))


def proposed(
    plant: Plant,
    rivals: Mapping[str, Sequence[Plant]],
    confidence: Mapping[str, float],
    logged: Sequence[Record | Logged],
    *,
    noise: float,
) -> Experiment | None:
    """Return the experiment about the cause that is the least certain among those with rivals.

    Parameters
    ----------
    plant : Plant
        With all causes.
    rivals : mapping of str to sequence of Plant
        By cause, plants with another effect in its place, the best first.
    confidence : mapping of str to float
        In each cause.
    logged, noise
        As in :func:`next_experiment`.
    """
    doubtful = [cause for cause, plants in rivals.items() if plants]
    if not doubtful:
        return None
    cause = min(doubtful, key=lambda name: confidence.get(name, 1.0))
    known = {effect.name for effect in plant.effects}
    named = {cause: plant}
    for rival in rivals[cause][:MOST_RIVALS]:
        others = [effect.name for effect in rival.effects if effect.name not in known]
        named.setdefault(" + ".join(others) or f"without {cause}", rival)
    return next_experiment(named, logged, noise=noise)


class _Option(NamedTuple):
    """A safe experiment, and how far apart each pair of plants is in it [noise]."""

    trial: Record
    back: bool
    apart: NDArray[np.float64]

    def experiment(self, separates: tuple[str, str], separation: float) -> Experiment:
        trial = self.trial
        controller, reference = trial.controller, trial.reference
        assert controller is not None and reference is not None  # noqa: S101, PT018 - _trials gives both
        return Experiment(
            kp=controller.kp,
            kd=controller.kd,
            start=float(reference[0]),
            reference=float(reference[REST]),
            back=self.back,
            duration=_digits(0.5 * (len(trial) - REST) * trial.sample_time, 4),
            sample_time=_digits(trial.sample_time, 4),
            separates=separates,
            separation=separation,
        )


@final
@dataclass(frozen=True, slots=True)
class _Bounds:
    """What an experiment may do to the axis: as much as was done before, hardly more."""

    low: float
    high: float
    voltage: float

    @classmethod
    def of(cls, logged: Sequence[Logged]) -> _Bounds:
        low = min(one.position_range[0] for one in logged)
        high = max(one.position_range[1] for one in logged)
        margin = BEYOND * (high - low)
        return cls(low - margin, high + margin, _most_voltage(logged))

    def hold(self, position: NDArray[np.float64], voltage: NDArray[np.float64]) -> bool:
        return bool(
            position.min() >= self.low and position.max() <= self.high and np.abs(voltage).max() <= 1.001 * self.voltage
        )


def _trials(largest: Logged, logged: Sequence[Logged], plant: Plant) -> list[Record]:
    """Return candidates as records without measurements: a step and the way back, each for one level's time."""
    most = _most_voltage(logged)
    gains = _gains(logged, most / max(largest.amplitude, 1e-300), plant)
    count = round(min(max(largest.duration / largest.sample_time, 4.0), MOST_SAMPLES))
    index = np.arange(REST + 2 * count)
    travel = _digits(largest.reference - largest.start, 3)
    if not gains or not math.isfinite(travel) or not math.isfinite(float(index[-1]) * largest.sample_time):
        return []  # what was logged is beyond all numbers
    known = next((one.controller for one in (largest, *logged) if one.controller), Controller(kp=gains[0]))
    time = index.astype(np.float64) * largest.sample_time
    away = (index >= REST) & (index < REST + count)
    start = round(largest.start, max(2 - math.floor(math.log10(abs(travel) or 1.0)), 0)) + 0.0
    limits = [one.voltage_limit for one in logged if one.voltage_limit is not None]
    return [
        Record(
            time=time,
            position=np.full(time.size, start),
            reference=np.where(away, _digits(start + share * travel, 6), start),
            controller=replace(known, kp=kp, kd=kd),
            voltage_limit=min(limits, default=None),
            length_unit=plant.length_unit,  # type: ignore[arg-type] # a plant has checked its own
            command_unit=plant.command_unit,
        )
        for kp, kd, share in product(gains, _dampings(logged, gains, plant), (1.0, 0.5))
        if abs(kp * share * travel) <= 1.001 * most
    ]


def _most_voltage(logged: Sequence[Logged]) -> float:
    return max(max(-one.voltage_range[0], one.voltage_range[1], one.voltage_limit or 0.0) for one in logged)


def _gains(logged: Sequence[Logged], usual: float, plant: Plant) -> list[float]:
    """Return kp from half the least to twice the largest; without any, around the one that asks for all voltage."""
    used = [abs(one.controller.kp) for one in logged if one.controller and one.controller.kp] or [usual]
    sign = np.sign(next((one.controller.kp for one in logged if one.controller and one.controller.kp), plant.gain))
    low, high = SLOWER * min(used), FASTER * max(used)
    if high > LARGEST:
        return []
    return [float(sign * kp) for kp in _rounded(np.geomspace(low, high, GAINS)) if low <= kp <= high]


def _dampings(logged: Sequence[Logged], gains: Sequence[float], plant: Plant) -> list[float]:
    """Return kd from none to twice the largest; where none was used, up to that which just avoids an overshoot."""
    used = [one.controller.kd for one in logged if one.controller and one.controller.kd]
    top = FASTER * max(used, key=abs) if used else _avoiding_overshoot(gains, plant)
    if abs(top) > LARGEST:
        return [0.0]
    sizes = _rounded(abs(top) * np.linspace(0.0, 1.0, DAMPINGS))
    return [0.0, *(float(np.sign(top) * kd) for kd in sizes if kd <= abs(top))]


def _avoiding_overshoot(gains: Sequence[float], plant: Plant) -> float:
    stiffness = abs(plant.gain) * float(np.median(np.abs(gains)))
    return float(max(2.0 * np.sqrt(stiffness) - plant.damping, 0.0)) / plant.gain


def _rounded(values: NDArray[np.float64]) -> list[float]:
    """Return the positive values as people set them, with two digits, each once."""
    return sorted({_digits(float(value), 2) for value in values if value > 0})


def _digits(value: float, digits: int) -> float:
    return float(f"{value:.{digits - 1}e}")


def _kept(
    answer: Simulation | ServolensError, trial: Record, bounds: _Bounds, back: bool
) -> NDArray[np.float64] | None:
    """Return the response as measured if the experiment is safe, with or without the way back."""
    if not isinstance(answer, Simulation):
        return None
    level = (len(trial) - REST) // 2
    ends = (REST + level, len(trial)) if back else (REST + level,)
    position = answer.position[: ends[-1]]
    calm = CALM * float(np.ptp(trial.reference)) if trial.reference is not None else 0.0
    settled = all(np.ptp(position[end - level // 4 : end]) <= calm for end in ends)
    safe = settled and bounds.hold(position, answer.voltage[: ends[-1]])
    return answer.measured[: ends[-1]] if safe else None


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _best(options: Sequence[_Option]) -> tuple[_Option | None, int]:
    """Return the option whose least separation is the largest, a single step if it does; and which pair that is."""
    parted = np.max([option.apart for option in options], axis=0) >= LEAST_SEPARATION
    if not parted.any():
        return None, 0

    def least(option: _Option) -> float:
        return float(option.apart[parted].min()) / (RETURN if option.back else 1.0)

    best = max(options, key=least)
    return best, int(np.argmin(np.where(parted, best.apart, np.inf)))
