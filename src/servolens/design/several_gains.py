"""The best of several gains: kp, kd and the derivative's filter, for one of several objectives.

A grid over the free gains is simulated first; where it finds gains that meet everything, CasADi's program
(:mod:`servolens.design.gains_program`) goes on from the best of them, and a finer grid around its optimum tells whether
there is a better one nearby. What the program finds is simulated by the exact sampled
loop and, where it fails there, taken back towards the gains that it began with: whatever is returned was simulated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.cover import SPARE, gain_scale, last_gain
from servolens.design.gain_plane import LEAST_KP, MOST_KP
from servolens.design.gains_program import GAINS, WATCHED, Limits, local_gains
from servolens.design.margins import loop_margins
from servolens.design.settle import evaluate
from servolens.design.wishes import GainWishes
from servolens.errors import InputError
from servolens.inputs import as_models
from servolens.processors import in_parallel

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servolens.design.margins import LoopMargins
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.inputs import Plants
    from servolens.model import Model

__all__ = ["GainsFound", "tune_gains"]

GRID = {"kp": 12, "kd": 24, "derivative_filter": 3}
"""Gains of each kind that are tried first."""
AROUND = {"kp": 15, "kd": 15, "derivative_filter": 3}
"""Gains of each kind that are tried around an optimum."""
LEAST_FILTER = 0.1
"""Smallest derivative filter that is tried: it remembers ten samples."""
GLANCE = 1.25
"""Settling times for which a step is watched at first: most gains that fail do so soon."""
NEAR, ENOUGH = 1.4, 2e-3
"""By which factor gains around an optimum are looked at, lest it is a local one, and the share by which one of them has
to be better for the program to begin anew from it."""
ROUNDS = 4
"""How often it does at most."""
SHORTER, TIMES = 0.93, 6
"""Share of the settling time reached that is asked for next where it is to be least, and how often at most."""
HALVINGS = 8
"""How often the way back from the program's gains to those that it began with is halved."""
WEIGHTS = {"kd": "kd", "noise": "noise", "settling_time": "band", "margin": "peak"}
"""What the program makes least for each objective."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class GainsFound:
    """Gains that meet a spec and its wishes, the best that were found.

    Attributes
    ----------
    spec : PDSpec
        With the kp and the derivative filter that were found; as asked where none were.
    wishes : GainWishes
        What was asked beside it.
    kd : float or None
        Derivative gain [V s/m]; None where no gains meet it all.
    value : float or None
        Of the objective.
    verified : tuple of Response
        Exact simulation with these gains, a model each.
    margins : LoopMargins or None
        Of the linearised loop.
    voltage_noise : float or None
        R.m.s. of the command for the measurement noise [V]; None where that is not known.
    from_program : bool
        Whether they are others than the best of the grid.
    reason : str or None
        Why there are none.
    """

    spec: PDSpec
    wishes: GainWishes
    kd: float | None
    value: float | None = None
    verified: tuple[Response, ...] = ()
    margins: LoopMargins | None = None
    voltage_noise: float | None = None
    from_program: bool = False
    reason: str | None = None

    @property
    def gains(self) -> dict[str, float | None]:
        """The gains by name."""
        found = self.kd is not None
        return {
            "kp": self.spec.kp if found else None,
            "kd": self.kd,
            "derivative_filter": self.spec.derivative_filter if found else None,
        }

    def to_json(self) -> dict[str, Any]:
        """Return what was asked and found."""
        result = {
            **self.gains,
            "wishes": self.wishes.to_json(),
            "value": self.value,
            "models": [response.to_json() for response in self.verified],
            "margins": None if self.margins is None else self.margins.to_json(),
            "voltage_noise": self.voltage_noise,
            "from_program": self.from_program,
        }
        return result if self.reason is None else {**result, "reason": self.reason}


def tune_gains(
    models: Plants,
    spec: PDSpec,
    wishes: GainWishes | None = None,
    *,
    progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
) -> GainsFound:
    """Return the gains that meet `spec` and `wishes` on all `models` and are best by the objective.

    Optima stand at the edge of what is feasible: design the gain to use around them with :func:`servolens.recommend`.

    Parameters
    ----------
    models : Plant, model, fit, diagnosis, path of a model's file, or a sequence of these
        The axis; several must all meet everything.
    spec : PDSpec
        What to reach. Its kp and derivative filter hold where they are not free; a free kp is sought around its kp.
    wishes : GainWishes, optional
        Which gains are free, what is to be best, and what else to keep to.
    progress : callable
        Is told (what, done, total).

    Raises
    ------
    InputError
        If no model is given, their units differ, or a wish cannot be judged.

    Examples
    --------
    >>> from servolens import PDSpec, Plant
    >>> axis, spec = Plant(gain=1.8, damping=6.0), PDSpec(kp=100, settling_time=0.5)
    >>> found = tune_gains(axis, spec, GainWishes(free=("kp", "kd"), objective="noise", peak_sensitivity=1.5))
    >>> found.spec.kp < spec.kp, found.verified[0].meets
    (True, True)
    """
    known = as_models(models)
    wanted = wishes or GainWishes()
    search = _Search(known, spec, wanted)
    progress("Trying gains", 0, 0)
    best = of_grid = search.best(search.grid())
    for _ in range(ROUNDS):
        progress("Solving for the gains", 0, 0)
        found = search.improved(best)
        if found is None:
            break
        around = search.best(search.around(found.gains))
        best, before = min((found, around or found), key=lambda one: one.value), found
        if best.value >= before.value * (1.0 - ENOUGH):
            break
    return search.told(best, from_program=best is not of_grid)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """Gains that were simulated and meet everything."""

    gains: dict[str, float]
    value: float
    verified: tuple[Response, ...]
    margins: LoopMargins


@final
class _Search:
    """Everything that is asked of gains."""

    def __init__(self, models: Sequence[Model], spec: PDSpec, wishes: GainWishes) -> None:
        self.plants = [model.plant for model in models]
        if not self.plants:
            raise InputError("no model was given; a design needs at least one")
        if len({(plant.length_unit, plant.command_unit) for plant in self.plants}) > 1:
            raise InputError("the models have different units; gains cannot hold for all of them")
        if spec.control == "continuous" and ("derivative_filter" in wishes.free or wishes.objective == "noise"):
            raise InputError(
                "an ideal continuous PD has no derivative filter and no finite noise; use control='sampled'"
            )
        self.spec, self.wishes = spec, wishes
        self.noise = wishes.position_noise or _noise_of(models)
        if wishes.voltage_noise is not None and self.noise is None:
            raise InputError("a limit of the voltage's noise needs position_noise: no model states that of its records")
        self.limits = Limits(
            peak_sensitivity=wishes.peak_sensitivity,
            peak_complementary=wishes.peak_complementary,
            delay_margin=wishes.delay_margin,
            noise_gain=None if wishes.voltage_noise is None else wishes.voltage_noise / (self.noise or np.inf),
        )
        self.bounds = self._bounds()

    def _bounds(self) -> dict[str, tuple[float, float]]:
        spec, free = self.spec, self.wishes.free
        kp = (LEAST_KP * spec.kp, MOST_KP * spec.kp) if "kp" in free else (spec.kp, spec.kp)
        last = spec.kd_max or max(last_gain(plant, replace(spec, kp=kp[1])) for plant in self.plants) / SPARE
        share = (LEAST_FILTER, 1.0) if "derivative_filter" in free else (spec.derivative_filter,) * 2
        return {"kp": kp, "kd": (0.0, last), "derivative_filter": share}

    def grid(self) -> list[dict[str, float]]:
        """Return the gains to be tried first; kd evenly where the loop changes evenly with it."""
        scale = min(gain_scale(plant, self.spec) for plant in self.plants)
        axes = []
        for name in GAINS:
            low, high = self.bounds[name]
            count = GRID[name] if high > low else 1
            if name == "kd":
                axes.append(scale * np.sinh(np.linspace(0.0, np.arcsinh(high / scale), count)))
            else:
                axes.append(np.geomspace(low, high, count))
        return [dict(zip(GAINS, map(float, values), strict=True)) for values in product(*axes)]

    def around(self, gains: Mapping[str, float]) -> list[dict[str, float]]:
        """Return gains around others, within the bounds, evenly in their logarithm."""
        axes = []
        for name in GAINS:
            low, high = self.bounds[name]
            if high > low:
                near = gains[name] * np.geomspace(1.0 / NEAR, NEAR, AROUND[name])
                axes.append(np.unique(np.clip(near, low, high)))
            else:
                axes.append(np.array([low]))
        return [dict(zip(GAINS, map(float, values), strict=True)) for values in product(*axes)]

    def best(self, gains: Sequence[dict[str, float]]) -> Candidate | None:
        """Return the best of some gains that meets everything."""
        seen = [one for one in in_parallel(self.tried, gains) if one is not None]
        return min(seen, key=lambda one: one.value, default=None)

    def spec_of(self, gains: Mapping[str, float]) -> PDSpec:
        """Return the spec with these gains."""
        return replace(self.spec, kp=gains["kp"], derivative_filter=min(gains["derivative_filter"], 1.0))

    def tried(self, gains: dict[str, float]) -> Candidate | None:
        """Return the gains if they meet everything when the exact loop is simulated."""
        spec, kd = self.spec_of(gains), gains["kd"]
        glance = GLANCE * spec.settling_time
        if not all(evaluate(plant, spec, kd, duration=glance).meets for plant in self.plants):
            return None
        verified = tuple(evaluate(plant, spec, kd) for plant in self.plants)
        margins = loop_margins(self.plants, spec, kd)
        if not all(response.meets for response in verified) or not self._keeps(margins):
            return None
        value = {
            "kd": kd,
            "noise": margins.noise_gain or 0.0,
            "settling_time": max(response.settling_time or 0.0 for response in verified),
            "margin": margins.peak_sensitivity,
        }[self.wishes.objective]
        return Candidate(gains=gains, value=value, verified=verified, margins=margins)

    def _keeps(self, margins: LoopMargins) -> bool:
        limits = self.limits
        most = (("peak_sensitivity", 1.0), ("peak_complementary", 1.0), ("noise_gain", 1.0), ("delay_margin", -1.0))
        pairs = [(sign, getattr(margins, name), getattr(limits, name)) for name, sign in most]
        return all(limit is None or sign * (value or 0.0) <= sign * limit for sign, value, limit in pairs)

    def improved(self, start: Candidate | None) -> Candidate | None:
        """Return what the program makes of gains, taken back towards them until the exact loop meets everything."""
        if self.wishes.objective == "settling_time" and start is not None:
            return self._faster(start)
        gains = self._solved(start, self.spec, WEIGHTS[self.wishes.objective])
        return self._taken_back(gains, start)

    def _faster(self, start: Candidate) -> Candidate:
        best = start
        for _ in range(TIMES):
            sooner = replace(self.spec, settling_time=max(SHORTER * best.value, 3.0 * self.spec.sample_time))
            found = self._taken_back(self._solved(best, sooner, "band"), best)
            if found is None or found.value >= best.value * (1.0 - 1e-3):
                break
            best = found
        return best

    def _solved(self, start: Candidate | None, spec: PDSpec, weight: str) -> dict[str, float] | None:
        middle = {name: float(np.sqrt(max(low, 1e-3 * high) * high)) for name, (low, high) in self.bounds.items()}
        return local_gains(
            self.plants,
            spec,
            self.limits,
            start=middle if start is None else start.gains,
            bounds=self.bounds,
            weights={weight: 1.0},
            watched=WATCHED * self.spec.settling_time,
        )

    def _taken_back(self, gains: dict[str, float] | None, start: Candidate | None) -> Candidate | None:
        if gains is None:
            return start
        found = self.tried(gains)
        if found is not None or start is None:
            return found
        low, high, best = 0.0, 1.0, start
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            tried = self.tried({name: start.gains[name] + share * (gains[name] - start.gains[name]) for name in GAINS})
            low, high = (low, share) if tried is None else (share, high)
            if tried is not None and tried.value < best.value:
                best = tried
        return best

    def told(self, best: Candidate | None, *, from_program: bool) -> GainsFound:
        """Return the result."""
        if best is None:
            ranges = [f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in self.bounds.items() if high > low]
            reason = f"no gains were found that meet everything, with {' and '.join(ranges)}; ask for less"
            return GainsFound(spec=self.spec, wishes=self.wishes, kd=None, reason=reason)
        gain = best.margins.noise_gain
        return GainsFound(
            spec=self.spec_of(best.gains),
            wishes=self.wishes,
            kd=best.gains["kd"],
            value=best.value,
            verified=best.verified,
            margins=best.margins,
            voltage_noise=None if self.noise is None or gain is None else self.noise * gain,
            from_program=from_program,
        )


def _noise_of(models: Sequence[Model]) -> float | None:
    """Return the largest r.m.s. noise of the records' positions that the models state; None where none does."""
    found = []
    for model in models:
        left = None if model.evidence is None else model.evidence.remainder
        if left is not None and left.times_noise is not None and left.times_noise > 1.0:
            found.append(left.rms / float(np.sqrt(left.times_noise**2 - 1.0)))
    return max(found, default=None)
