"""How far a loop goes beyond what the records of a model showed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.design.settle import closed_loop_gain, evaluate
from servolens.effects import Saturation
from servolens.errors import NumericalError
from servolens.model import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servolens.design.response import Response
    from servolens.design.spec import PDSpec
    from servolens.model import Model
    from servolens.model_evidence import Evidence
    from servolens.plant import Plant

__all__ = ["BEYOND", "FAR", "Extrapolation", "extrapolation", "within"]

BEYOND, FAR = 1.01, 1.5
"""Times the largest value in the records from which on the answer is an extrapolation (a percent is the noise of a
measured step), and from which on it is not to be given."""
LEAST, MOST = BEYOND - 1.0, 0.03
"""Shares by which it may exceed `FAR` times that value however little or much noise there is: the percent counts there
too, and a largest value of many samples is rather raised by noise than lowered."""
HALVED = 8
"""Times that the place where a loop becomes an extrapolation is narrowed down between two gains."""


@final
@dataclass(frozen=True, slots=True)
class Extrapolation:
    """What of a loop lies farthest beyond the records.

    Attributes
    ----------
    ratio : float
        Its size over the largest that the records showed; `FAR` where it is larger only as far as a percent, or noise
        in one sample, may make it.
    sentence : str
        What it is, and what to log; empty where the model brings nothing about its records.
    """

    ratio: float
    sentence: str

    @property
    def is_far(self) -> bool:
        """Whether the answer is not to be given."""
        return self.ratio > FAR


def extrapolation(model: Model, spec: PDSpec, gain: float) -> Extrapolation:
    """Return how far the step of a loop lies beyond what the records of a model showed.

    Parameters
    ----------
    model : Model
        With its evidence; without, nothing is beyond.
    spec : PDSpec
        Of the loop.
    gain : float
        That is sought: kd, or kv of a cascade.

    Raises
    ------
    NumericalError
        If the loop is unstable.
    """
    if model.evidence is None:
        return Extrapolation(0.0, "")
    found = [
        _beyond_range(model, model.evidence, spec, gain),
        _beyond_error(model, model.evidence, spec, gain),
    ]
    return max(found, key=lambda one: one.ratio)


def within(
    models: Sequence[Model], spec: PDSpec, grids: Sequence[NDArray[np.float64]], most: float
) -> list[tuple[float, float]]:
    """Return the intervals of the gains that are no extrapolation beyond `most` on any of the models.

    Parameters
    ----------
    models : sequence of Model
        See :func:`extrapolation`.
    spec : PDSpec
        Of the loop.
    grids : sequence of ndarray
        Gains of each interval of which parts are sought, rising.
    most : float
        Largest ratio.
    """

    def is_within(gain: float) -> bool:
        try:
            return all(extrapolation(model, spec, gain).ratio <= most for model in models)
        except NumericalError:
            return False

    found: list[tuple[float, float]] = []
    for grid in grids:
        inside = [is_within(gain) for gain in grid]
        edges = np.flatnonzero(np.diff([0, *inside, 0]))
        for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
            low, high = float(grid[first]), float(grid[last])
            if first > 0:
                low = _halved(is_within, low, float(grid[first - 1]))
            if last + 1 < len(grid):
                high = _halved(is_within, high, float(grid[last + 1]))
            found.append((low, high))
    return found


def _halved(holds: Callable[[float], bool], inside: float, outside: float) -> float:
    """Return the gain closest to `outside` for which something still holds."""
    for _ in range(HALVED):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside


def _beyond_range(model: Model, evidence: Evidence, spec: PDSpec, gain: float) -> Extrapolation:
    """Judge voltage, speed and amplitude of the step by the largest of the records."""
    shown, unit = evidence.range, model.plant.length_unit
    response = evaluate(model.plant, spec, gain)
    asked = {
        "voltage": (_applied(model.plant, response), shown.voltage, shown.voltage_error, model.plant.command_unit),
        "speed": (response.peak_speed, shown.speed, shown.speed_error, f"{unit}/s"),
        "step": (abs(spec.reference), shown.step, shown.step_error, unit),
    }
    ratios = {name: _ratio(wanted, known, error) for name, (wanted, known, error, _) in asked.items()}
    name = max(ratios, key=ratios.__getitem__)
    wanted, known, error, unit = asked[name]
    noise = f" (± {NORMAL_95 * error:.2g} by noise)" if error > 0.0 and ratios[name] == FAR else ""
    return Extrapolation(
        ratios[name],
        f"An extrapolation: the {name} reaches {wanted:.3g} {unit}, that of the records {known:.3g}{noise}"
        f"{f' (more than {FAR:g} times)' if ratios[name] > FAR else ''}; log a record with a larger {name}.",
    )


def _ratio(wanted: float, known: float, error: float) -> float:
    """Return how many times a measured peak is wanted; noise alone does not make it more than `FAR`.

    Only there noise counts: a peak is the largest of many samples, which noise has raised already.
    """
    ratio = wanted / max(known, 1e-300)
    return min(ratio, max(FAR, ratio / (1.0 + _allowed(known, error))))


def _allowed(known: float, error: float) -> float:
    """Return the share of a measured peak that noise in one sample makes (in 95 of 100), from `LEAST` to `MOST`."""
    return min(max(NORMAL_95 * error / max(known, 1e-300), LEAST), MOST)


def _beyond_error(model: Model, evidence: Evidence, spec: PDSpec, gain: float) -> Extrapolation:
    """Judge what the loop makes of the model's error at each frequency by what the loops of the records made of it.

    Either the records bear it out, whose loops were stable; or the small-gain theorem does, with a reserve of `FAR`.
    Beyond both the loop counts by how much more it may amplify the error: see :func:`_amplified`.
    """
    error = evidence.model_error
    if error is None:
        return Extrapolation(0.0, "")
    size, loop = np.array(error.size), np.array(error.loop)
    asked = closed_loop_gain(model.plant, spec, gain, np.array(error.frequency)) * size
    safe = np.maximum(loop * size, 1.0 / FAR)
    stronger = asked / safe
    ratios = np.where(stronger > BEYOND, _amplified(asked, safe), stronger)
    worst = int(np.argmax(ratios))
    share = float(f"{100 * size[worst]:.2g}")
    known = "" if evidence.range.kd is None else f" (largest so far: {evidence.range.kd:.3g})"
    return Extrapolation(
        float(ratios[worst]),
        f"An extrapolation: the records do not show that the loop is stable with {spec.free} = {gain:.3g}: near"
        f" {error.frequency[worst]:.3g} Hz the model's error may be {share:g} %, and the loop answers there"
        f" {stronger[worst]:.3g} times as strongly as is known to be safe"
        f"{f', by which it may amplify the error more than {FAR:g} times' if ratios[worst] > FAR else ''}; log a"
        f" record with a {spec.free} nearer to it{known}.",
    )


def _amplified(asked: NDArray[np.float64], safe: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much more a loop may amplify a model's error Δ than one in which |TΔ| is `safe`.

    The axis answers as the model does times (1 + Δ)/(1 + TΔ), and |1 + TΔ| is at least 1 − |TΔ|: what the loop makes of
    the error is |TΔ|/(1 − |TΔ|) at most, and from |TΔ| = 1 on it may be unstable.
    """
    more = np.full(asked.shape, np.inf)
    stable = asked < 1.0
    asked, safe = asked[stable], safe[stable]
    more[stable] = asked * (1.0 - safe) / (safe * (1.0 - asked))
    return more


def _applied(plant: Plant, response: Response) -> float:
    """Return the largest voltage behind the amplifier's limit, where the plant has one."""
    limit = plant.effect(Saturation.name)
    return min(response.peak_voltage, limit.limit if isinstance(limit, Saturation) else np.inf)
