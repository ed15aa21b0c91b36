"""Why no gain meets a spec: which of its wishes conflict, and which spec nearby can be met."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.design.found import Relaxed
from servolens.design.settle import FEASIBLE, horizon, settling_time, step_response
from servolens.design.spec import MOST_SAMPLES
from servolens.errors import InputError, NumericalError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

__all__ = ["explain", "unanswered"]

ZOOMS, PARTS = 4, 8
"""How often the scan looks closer around the best gain, and at how many gains."""
WORDS = {
    "settling_time": "settling time",
    "overshoot": "overshoot limit",
    "voltage_limit": "voltage limit",
    "band": "band",
}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    """What one gain does, the worst over all models: the value that each wish would need to be met."""

    kd: float
    settling_time: float
    band: float
    overshoot: float
    voltage_limit: float


def explain(
    models: tuple[Plant, ...], spec: PDSpec, gains: Sequence[float]
) -> tuple[str, tuple[str, ...], tuple[Relaxed, ...]]:
    """Return a sentence, the wishes that conflict, and specs that can be met.

    Parameters
    ----------
    models : tuple of Plant
        Those that were designed for.
    spec : PDSpec
        One that no gain meets.
    gains : sequence of float
        Where to look, in increasing order.
    """
    searched = f"no {spec.free} in [0, {spec.kd_max:g}]"
    if any(model.gain < 0 for model in models):
        reason = "the plant's gain is negative, so a positive kp drives the axis away; invert the command"
        return reason, ("kp",), ()
    if spec.controller == "pd" and spec.ki == 0 and abs(1.0 - spec.setpoint_weight) > spec.band:
        reason = (
            f"without an integral a loop with setpoint_weight = {spec.setpoint_weight:g} goes to that share of its"
            " reference, outside the band; give ki, or a weight of 1"
        )
        return reason, ("setpoint_weight",), ()
    steps = _steps(models, spec, gains)
    without = _steps(models, replace(spec, ki=0.0, anti_windup="none"), gains) if spec.ki else []
    if not steps:
        cause = "ki" if without else "kp"
        with_ki = f" and ki = {spec.ki:g}" if spec.ki else ""
        return f"{searched} stabilises the loop with kp = {spec.kp:g}{with_ki}; choose a smaller {cause}", (cause,), ()
    integral_keeps = any(_holds(spec, step, _stated(spec)) for step in without)
    conflict = ("ki",) if integral_keeps else _conflict(spec, steps)
    nearest = _nearest(models, spec, steps, gains, conflict)
    text = (
        f"the integral keeps the loop from it: without ki = {spec.ki:g} a gain meets it; choose a smaller ki"
        if integral_keeps
        else _conflict_text(spec, conflict, models[0].command_unit)
    )
    reason = f"{searched} meets the spec; {text}"
    unit = models[0].command_unit
    step = None
    if nearest:
        changes: dict[str, Any] = dict(nearest[0].changes)
        step = _step(models, replace(spec, **changes), nearest[0].kd)
    if step is None:
        closest = _closest(spec, steps)
        reason += f"; {spec.free} = {closest.kd:.4g} misses the spec least: it {_does(closest, unit)}"
    else:
        offer = _offer(nearest[0], unit)
        reason += f"; {offer} can be met: {spec.free} = {nearest[0].kd:.4g} {_does(step, unit)}"
    return reason, conflict, nearest


def unanswered(models: Iterable[Plant], spec: PDSpec) -> str | None:
    """Return a sentence if a model does not answer to the voltage: the loop moves it by no more than simulations err.

    Of a cascade none is judged: the gain that is sought there multiplies that of the plant.
    """
    for model in models:
        share = 0.5 * (spec.rate(model.gain) * spec.settling_time) ** 2  # of the step, by all of the command from rest
        if share < FEASIBLE:
            return (
                f"the plant does not answer to the voltage: with a gain of {model.gain:.2g}"
                f" {model.length_unit}/s²/{model.command_unit} and kp = {spec.kp:.2g} it stays where it is, and no gain"
                " of a loop follows"
            )
    return None


def _steps(models: Sequence[Plant], spec: PDSpec, gains: Iterable[float]) -> list[_Step]:
    """Return what those gains do with which all loops are stable."""
    return [step for step in (_step(models, spec, kd) for kd in gains) if step is not None]


def _step(models: Iterable[Plant], spec: PDSpec, kd: float) -> _Step | None:
    """Return what the gain does; None where a loop is unstable."""
    found = []
    for model in models:
        try:
            run = step_response(model, spec, kd, _watched(model, spec))
        except NumericalError:
            return None
        error = (spec.reference - run.position) / abs(spec.reference)
        settled = settling_time(run.time, error, spec.band + FEASIBLE)
        late = np.append(error[run.time >= spec.settling_time], np.interp(spec.settling_time, run.time, error))
        found.append(
            (
                np.inf if settled is None else settled,
                float(np.abs(late).max()),
                float(np.max(-error * np.sign(spec.reference))),
                float(np.abs(run.voltage).max()),
            )
        )
    worst = [max(values) for values in zip(*found, strict=True)]
    return _Step(kd=kd, settling_time=worst[0], band=worst[1], overshoot=worst[2], voltage_limit=worst[3])


def _watched(model: Plant, spec: PDSpec) -> float:
    """Return how long a step is watched [s]: as long as the loop may take, however soon it is asked to have settled."""
    periods = spec.settling_time + 6.0 * np.pi / max(spec.rate(model.gain), 1e-6)
    return max(horizon(model, spec), min(periods, MOST_SAMPLES * spec.sample_time))


def _stated(spec: PDSpec) -> list[str]:
    return [wish for wish in WORDS if wish != "band" and getattr(spec, wish) is not None]


def _holds(spec: PDSpec, step: _Step, wishes: Iterable[str]) -> bool:
    return all(getattr(step, wish) <= getattr(spec, wish) * (1 + 1e-9) + FEASIBLE for wish in wishes)


def _conflict(spec: PDSpec, steps: Sequence[_Step]) -> tuple[str, ...]:
    """Return the smallest set of wishes that none of the gains meets together."""
    wishes = _stated(spec)
    for size in range(1, len(wishes) + 1):
        for chosen in combinations(wishes, size):
            if not any(_holds(spec, step, chosen) for step in steps):
                return chosen
    return tuple(wishes)


def _conflict_text(spec: PDSpec, conflict: Sequence[str], command_unit: str) -> str:
    names = [f"the {_told(wish, getattr(spec, wish), command_unit)}" for wish in conflict]
    if len(names) == 1:
        return f"{names[0]} cannot be met with kp = {spec.kp:g}"
    return f"{', '.join(names[:-1])} and {names[-1]} cannot be met together with kp = {spec.kp:g}"


def _closest(spec: PDSpec, steps: Sequence[_Step]) -> _Step:
    """Return the gain whose worst wish is missed by the least share."""

    def missed(step: _Step) -> float:
        shares = [step.band / spec.band]
        if spec.overshoot is not None:
            shares.append((step.overshoot - spec.overshoot) / max(spec.overshoot, spec.band) + 1.0)
        if spec.voltage_limit is not None:
            shares.append(step.voltage_limit / spec.voltage_limit)
        return max(shares)

    return min(steps, key=missed)


def _nearest(
    models: tuple[Plant, ...], spec: PDSpec, steps: Sequence[_Step], gains: Sequence[float], conflict: Sequence[str]
) -> tuple[Relaxed, ...]:
    """Return specs that can be met with as few fields changed as possible, those of wishes that conflict first.

    Of these the smallest change is the first.
    """
    wishes = [*_stated(spec), "band"]
    for size in range(1, len(wishes) + 1):
        options = [_relaxed(models, spec, chosen, steps, gains) for chosen in combinations(wishes, size)]
        found = [option for option in options if option is not None]
        if found:
            changed = [{wish for wish, _ in option.changes} for option in found]
            sizes = [max(_ratio(spec, *change) for change in option.changes) for option in found]
            ranks = [(not wish <= {*conflict}, size) for wish, size in zip(changed, sizes, strict=True)]
            return tuple(found[i] for i in sorted(range(len(found)), key=ranks.__getitem__))
    return ()


def _relaxed(
    models: tuple[Plant, ...], spec: PDSpec, wishes: Sequence[str], steps: Sequence[_Step], gains: Sequence[float]
) -> Relaxed | None:
    """Return the least change of some wishes with which a gain meets them and the others; None where there is none."""
    others = [w for w in _stated(spec) if w not in wishes and not ("band" in wishes and w == "settling_time")]
    width = max(np.diff(gains), default=0.0)
    known = list(steps)

    def change(step: _Step) -> float:
        return max(_ratio(spec, wish, getattr(step, wish)) for wish in wishes)

    best = None
    for _ in range(ZOOMS):
        able = [step for step in known if _holds(spec, step, others) and np.isfinite(change(step))]
        if not able:
            return None
        best = min(able, key=change)
        around = np.clip(best.kd + width * np.linspace(-1.0, 1.0, PARTS + 1), 0.0, spec.kd_max)
        known += [step for step in (_step(models, spec, float(kd)) for kd in around) if step is not None]
        width *= 2.0 / PARTS
    assert best is not None  # noqa: S101 - set in the first zoom
    changes = tuple((wish, max(_round_up(getattr(best, wish)), getattr(spec, wish))) for wish in wishes)
    try:
        changed = replace(spec, **dict(changes))
    except InputError:
        return None
    step = _step(models, changed, best.kd)
    fits = step is not None and _holds(changed, step, _stated(changed))
    return Relaxed(changes=changes, kd=best.kd) if fits else None


def _ratio(spec: PDSpec, wish: str, value: float) -> float:
    return float(value / max(getattr(spec, wish), spec.band))


def _told(wish: str, value: float, command_unit: str) -> str:
    units = {"settling_time": "s", "voltage_limit": command_unit}
    return f"{WORDS[wish]} of {value:g} {units.get(wish, 'of the step')}"


def _offer(found: Relaxed, command_unit: str) -> str:
    parts = [
        f"{'an' if wish == 'overshoot' else 'a'} {_told(wish, value, command_unit)}" for wish, value in found.changes
    ]
    return " with ".join(parts)


def _does(step: _Step, command_unit: str) -> str:
    """Say what a gain does, as the end of a sentence."""
    settles = f"settles in {step.settling_time:.4g} s"
    if not np.isfinite(step.settling_time):
        settles = f"does not settle (up to {100 * step.band:.3g} % of the step are left)"
    overshoot = 100 * max(step.overshoot, 0.0)
    return f"{settles}, overshoots by {overshoot:.3g} % and asks for {step.voltage_limit:.4g} {command_unit}"


def _round_up(value: float) -> float:
    """Round up to three digits."""
    if value <= 0:
        return 0.0
    digits = 10.0 ** (np.floor(np.log10(value)) - 2)
    return float(f"{np.ceil(value / digits - 1e-9) * digits:.6g}")
