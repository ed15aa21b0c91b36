"""Everything that is asked of several gains: a grid of them, what CasADi's program makes of one, exact simulations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.controller import Controller
from servolens.design.cover import SPARE, gain_scale, last_gain
from servolens.design.gain_plane import LEAST_KP, MOST_KP
from servolens.design.gains_found import GainsFound
from servolens.design.gains_program import GAINS, WATCHED, Limits, local_gains
from servolens.design.linear_limits import keeps
from servolens.design.margins import LinearLoops
from servolens.design.rest import rest_of
from servolens.design.scenarios import counted, drawn, missed_share, without_force
from servolens.design.settle import evaluate
from servolens.errors import InputError
from servolens.processors import in_parallel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.design.margins import LoopMargins
    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.design.wishes import GainWishes
    from servolens.model import Model
    from servolens.plant import Plant

__all__ = ["Candidate", "GainsSearch"]

NAMES = (*GAINS, "ki")
"""Gains that can be free; with an integral the program, which is of PD only, is left out."""
OF_CASCADE = {"kv": "kd", "kiv": "ki"}
"""Gains of a cascade, by those whose places they take here."""
GRID = {"kp": 12, "kd": 24, "derivative_filter": 3, "ki": 8}
"""Gains of each kind that are tried first."""
AROUND = {"kp": 15, "kd": 15, "derivative_filter": 3, "ki": 7}
"""Gains of each kind that are tried around an optimum."""
LEAST_FILTER = 0.1
"""Smallest derivative filter that is tried: it remembers ten samples."""
LEAST_KI, MOST_KI = 0.03, 1.0
"""Smallest and largest integral gain that is tried, in kp times the undamped frequency of the loop [rad/s]; of a
cascade, whose kp is that frequency, in kp² over the plant's gain."""
GLANCE = 1.25
"""Settling times for which a step is watched at first: most gains that fail do so soon."""
NEAR = 1.4
"""By which factor gains around an optimum are looked at, lest it is a local one."""
SEED = 2
"""Of the scenarios; those of :func:`servolens.recommend` are others."""
SHORTER, TIMES = 0.93, 6
"""Share of the settling time reached that is asked for next where it is to be least, and how often at most."""
TIGHTEST, FRESH = 3, 200
"""Scenarios that the program knows, and those in which gains that were found are counted."""
HALVINGS = 8
"""How often the way back from the program's gains to those that it began with is halved."""
WEIGHTS = {"kd": "kd", "noise": "noise", "settling_time": "band", "margin": "peak"}
"""What the program makes least for each objective."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """Gains that were simulated and meet everything."""

    gains: dict[str, float]
    value: float
    verified: tuple[Response, ...]
    margins: LoopMargins


@final
class GainsSearch:
    """Everything that is asked of gains."""

    def __init__(self, models: Sequence[Model], spec: PDSpec, wishes: GainWishes) -> None:
        self.plants = [model.plant for model in models]
        if not self.plants:
            raise InputError("no model was given; a design needs at least one")
        if len({(plant.length_unit, plant.command_unit) for plant in self.plants}) > 1:
            raise InputError("the models have different units; gains cannot hold for all of them")
        self.free = {OF_CASCADE.get(name, name) for name in wishes.free}
        if spec.controller == "pd" and set(OF_CASCADE) & set(wishes.free):
            raise InputError("kv and kiv are gains of a cascade; ask for a cascade, or leave kd and ki free")
        if spec.control == "continuous" and ("derivative_filter" in wishes.free or wishes.objective == "noise"):
            raise InputError(
                "an ideal continuous PD has no derivative filter and no finite noise; use control='sampled'"
            )
        if "ki" in wishes.free and (spec.controller != "pd" or spec.control == "continuous"):
            raise InputError("ki is a gain of a sampled PID; leave it out of the free gains")
        self.wishes = wishes
        self.noise = wishes.position_noise or _noise_of(models)
        if wishes.voltage_noise is not None and self.noise is None:
            raise InputError("a limit of the voltage's noise needs position_noise: no model states that of its records")
        self.spec = _limited(spec, wishes, self.noise)
        self.limits = Limits(**self.spec.limits)
        self.bounds = self._bounds()
        self.models = models
        self.tightest: list[Plant] = []
        self.scenarios = tuple(drawn(models, [self.spec], wishes.scenarios, np.random.default_rng([SEED, 0])))
        self.in_turn = self.scenarios
        pulled = any(rest_of(plant, Controller(kp=1.0, ki=1.0), 0.0).applied for plant in self.plants)
        self._begins_released = "ki" in self.free and pulled
        self._loops: dict[float, LinearLoops] = {}
        self._own: dict[float, LinearLoops] = {}

    def _bounds(self) -> dict[str, tuple[float, float]]:
        spec, free = self.spec, self.free
        kp = (LEAST_KP * spec.kp, MOST_KP * spec.kp) if "kp" in free else (spec.kp, spec.kp)
        last = spec.kd_max or max(last_gain(plant, replace(spec, kp=kp[1])) for plant in self.plants) / SPARE
        share = (LEAST_FILTER, 1.0) if "derivative_filter" in free else (spec.derivative_filter,) * 2
        ki = self._integrals(kp) if "ki" in free else (spec.ki or spec.kiv,) * 2
        return {"kp": kp, "kd": (0.0, last), "derivative_filter": share, "ki": ki}

    def _integrals(self, kp: tuple[float, float]) -> tuple[float, float]:
        """Return the ends of the integral gain; that of a cascade goes with the square of its kp."""
        if self.spec.controller == "cascade":
            most = 1.0 / min(abs(plant.gain) for plant in self.plants)
            return LEAST_KI * kp[0] ** 2 * most, MOST_KI * kp[1] ** 2 * most
        rate = self.spec.kp * max(self.spec.rate(plant.gain) for plant in self.plants)
        return LEAST_KI * rate, MOST_KI * rate

    def grid(self) -> list[dict[str, float]]:
        """Return the gains to be tried first; kd evenly where the loop changes evenly with it."""
        scale = min(gain_scale(plant, self.spec) for plant in self.plants)
        axes = []
        for name in NAMES:
            low, high = self.bounds[name]
            count = GRID[name] if high > low else 1
            if name == "kd":
                axes.append(scale * np.sinh(np.linspace(0.0, np.arcsinh(high / scale), count)))
            else:
                axes.append(np.geomspace(low, high, count) if count > 1 else np.array([low]))
        return [dict(zip(NAMES, map(float, values), strict=True)) for values in product(*axes)]

    def around(self, gains: Mapping[str, float]) -> list[dict[str, float]]:
        """Return gains around others, within the bounds, evenly in their logarithm."""
        axes = []
        for name in NAMES:
            low, high = self.bounds[name]
            if high > low:
                near = gains[name] * np.geomspace(1.0 / NEAR, NEAR, AROUND[name])
                axes.append(np.unique(np.clip(near, low, high)))
            else:
                axes.append(np.array([low]))
        return [dict(zip(NAMES, map(float, values), strict=True)) for values in product(*axes)]

    def best(self, gains: Sequence[dict[str, float]]) -> Candidate | None:
        """Return the best of some gains that meets everything: those that cannot be the best are not simulated."""
        likely = sorted(((self._at_least(one), i) for i, one in enumerate(gains)))
        least = np.inf

        def seen(pair: tuple[float, int]) -> Candidate | None:
            nonlocal least
            found = self.tried(gains[pair[1]]) if pair[0] <= least else None
            least = least if found is None else min(least, found.value)
            return found

        return min(filter(None, in_parallel(seen, likely)), key=lambda one: one.value, default=None)

    def _at_least(self, gains: Mapping[str, float]) -> float:
        """Return a value that the objective is not below: that of the models, where no step has to be simulated."""
        objective = self.wishes.objective
        if objective in ("kd", "settling_time"):
            return gains["kd"] if objective == "kd" else 0.0
        spec = self.spec_of(gains)
        if spec.kp not in self._own:
            self._own[spec.kp] = LinearLoops(self.plants, spec)
        margins = self._own[spec.kp].margins(gains["kd"], spec)
        return margins.peak_sensitivity if objective == "margin" else margins.noise_gain or 0.0

    def spec_of(self, gains: Mapping[str, float]) -> PDSpec:
        """Return the spec with these gains."""
        share = min(gains["derivative_filter"], 1.0)
        if self.spec.controller == "cascade":
            return replace(self.spec, kp=gains["kp"], derivative_filter=share, kiv=gains["ki"])
        return replace(self.spec, kp=gains["kp"], derivative_filter=share, ki=gains["ki"])

    def tried(self, gains: dict[str, float]) -> Candidate | None:
        """Return the gains if they meet everything when the exact loop is simulated.

        What a free integral gain is worth shows where its integral is empty: the models, not the scenarios, have to
        meet the spec also when what pulls is let go with the step.
        """
        spec, kd = self.spec_of(gains), gains["kd"]
        glance, begun = GLANCE * spec.settling_time, (True, False) if self._begins_released else (True,)
        if not all(evaluate(p, spec, kd, duration=glance, held=held).meets for held in begun for p in self.plants):
            return None
        if self._seen(spec, kd, glance) is None:
            return None
        margins = self._margins(spec, kd)
        if not keeps(margins, spec):
            return None
        verified = tuple(evaluate(plant, spec, kd, held=held) for held in begun for plant in self.plants)
        if not all(response.meets for response in verified):
            return None
        seen = self._seen(spec, kd, None)
        if seen is None:
            return None
        value = {
            "kd": kd,
            "noise": margins.noise_gain or 0.0,
            "settling_time": max(response.settling_time or 0.0 for response in (*verified, *seen)),
            "margin": margins.peak_sensitivity,
        }[self.wishes.objective]
        return Candidate(gains=gains, value=value, verified=verified, margins=margins)

    def _seen(self, spec: PDSpec, kd: float, duration: float | None) -> list[Response] | None:
        """Return the steps of all scenarios; None if one of them misses the spec.

        That one is tried first from then on: the next gains fail there too, as a rule.
        """
        found: list[Response] = []
        for scenario in self.in_turn:
            found.append(scenario.in_loop(spec).response(kd, duration))
            if not found[-1].meets:
                self.in_turn = (scenario, *(one for one in self.scenarios if one is not scenario))
                return None
        return found

    def _margins(self, spec: PDSpec, kd: float) -> LoopMargins:
        """Return the worst margins of models and scenarios, whose plants answer alike to all gains with the same kp."""
        if spec.kp not in self._loops:
            plants = [*self.plants, *(one.plant for one in self.scenarios)]
            realised = [*(1.0 for _ in self.plants), *(one.realised for one in self.scenarios)]
            self._loops[spec.kp] = LinearLoops(plants, spec, realised)
        return self._loops[spec.kp].margins(kd, spec)

    def watch(self, best: Candidate | None) -> None:
        """Let the program know the plants of those scenarios that settle last with the gains of the grid."""
        if best is None:
            return
        spec, kd = self.spec_of(best.gains), best.gains["kd"]
        late = sorted(self.scenarios, key=lambda one: -(one.in_loop(spec).response(kd).settling_time or 0.0))
        others = [plant for one in late if (plant := without_force(one.plant)) not in self.plants]
        self.tightest = others[:TIGHTEST]

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
        if not spec.is_pd or "ki" in self.free:
            return None
        middle = {name: float(np.sqrt(max(low, 1e-3 * high) * high)) for name, (low, high) in self.bounds.items()}
        found = local_gains(
            [*self.plants, *self.tightest],
            spec,
            self.limits,
            start=middle if start is None else start.gains,
            bounds=self.bounds,
            weights={weight: 1.0},
            watched=WATCHED * self.spec.settling_time,
        )
        return None if found is None else {**found, "ki": 0.0}

    def _taken_back(self, gains: dict[str, float] | None, start: Candidate | None) -> Candidate | None:
        if gains is None:
            return start
        found = self.tried(gains)
        if found is not None or start is None:
            return found
        low, high, best = 0.0, 1.0, start
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            tried = self.tried({name: start.gains[name] + share * (gains[name] - start.gains[name]) for name in NAMES})
            low, high = (low, share) if tried is None else (share, high)
            if tried is not None and tried.value < best.value:
                best = tried
        return best

    @property
    def beyond_band(self) -> str:
        """Say that the model's own error may fill the band, so that no gains can be promised; empty if it cannot."""
        missed = max(map(missed_share, self.models)) if self.scenarios else 0.0
        if missed < self.spec.band:
            return ""
        return (
            f"simulations of the model may miss up to {100 * missed:.2g} % of the step, as much as the band of"
            f" {100 * self.spec.band:.2g} % or more; ask for a wider band, or find what the model lacks"
        )

    def told(self, best: Candidate | None, *, from_program: bool) -> GainsFound:
        """Return the result."""
        if best is None:
            called = {ours: name for name, ours in OF_CASCADE.items()} if self.spec.controller == "cascade" else {}
            ranges = [
                f"{called.get(name, name)} from {low:.4g} to {high:.4g}"
                for name, (low, high) in self.bounds.items()
                if high > low
            ]
            count = len(self.scenarios)
            where = f" on the model and in {count} scenarios of what may be otherwise" if count else ""
            where += ", also when the axis is let go with the step" if self._begins_released else ""
            reason = self.beyond_band or (
                f"no gains were found that meet everything{where}, with {' and '.join(ranges)}; ask for less"
            )
            return GainsFound(spec=self.spec, wishes=self.wishes, kd=None, reason=reason)
        gain, spec = best.margins.noise_gain, self.spec_of(best.gains)
        probability, interval = self._counted(spec, best.gains["kd"])
        return GainsFound(
            spec=spec,
            wishes=self.wishes,
            kd=best.gains["kd"],
            value=best.value,
            verified=best.verified,
            margins=best.margins,
            probability=probability,
            interval=interval,
            voltage_noise=None if self.noise is None or gain is None else self.noise * gain,
            from_program=from_program,
        )

    def _counted(self, spec: PDSpec, kd: float) -> tuple[float | None, tuple[float, float] | None]:
        """Return in which share of fresh scenarios gains meet the spec, and the interval of that probability."""
        if not self.scenarios:
            return None, None
        fresh = drawn(self.models, [spec], FRESH, np.random.default_rng([SEED, 1]))
        return counted(in_parallel(lambda one: one.response(kd), fresh))


def _limited(spec: PDSpec, wishes: GainWishes, noise: float | None) -> PDSpec:
    """Return the spec with the limits of the wishes too, the tighter where both state one."""
    wanted = {name: getattr(wishes, name) for name in ("peak_sensitivity", "peak_complementary", "delay_margin")}
    wanted["noise_gain"] = None if wishes.voltage_noise is None else wishes.voltage_noise / (noise or np.inf)
    tighter = {name: max if name == "delay_margin" else min for name in wanted}
    known = spec.limits
    asked = {name: value for name, value in wanted.items() if value is not None}
    return replace(spec, **{name: tighter[name](value, known.get(name, value)) for name, value in asked.items()})


def _noise_of(models: Sequence[Model]) -> float | None:
    """Return the largest noise of the records' positions that the models state; None where none does."""
    found = (model.evidence.noise for model in models if model.evidence is not None)
    return max((noise for noise in found if noise is not None), default=None)
