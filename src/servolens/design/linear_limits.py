"""What a spec asks of the linearised loop: which gains keep to it, and what is said where none does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servolens.design.found import Relaxed
from servolens.design.margins import LinearLoops
from servolens.design.parts import parts_where
from servolens.processors import single_threaded_blas

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.design.margins import LoopMargins
    from servolens.design.spec import PDSpec
    from servolens.plant import Plant

    Span = tuple[float, float]

__all__ = ["keeps", "none_keeps", "within_limits"]

TRIED = 65
"""Gains at which each interval is tried."""
WORDS = {
    "peak_sensitivity": "Ms",
    "peak_complementary": "Mt",
    "delay_margin": "delay margin",
    "noise_gain": "noise gain",
}


def keeps(margins: LoopMargins, spec: PDSpec) -> bool:
    """Tell whether a loop keeps to the limits of a spec."""
    return all(_ratio(margins, name, limit) <= 1.0 for name, limit in spec.limits.items())


@single_threaded_blas
def within_limits(
    plants: Sequence[Plant], spec: PDSpec, spans: Sequence[Span], gap: float, scale: float
) -> tuple[Span, ...]:
    """Return what is left of intervals of gains without those that miss a limit; borders are located within `gap`."""
    if not spec.limits or not spans:
        return tuple(spans)
    loops = LinearLoops(plants, spec)
    return parts_where(lambda gain: keeps(loops.margins(gain), spec), spans, gap, TRIED, scale)


@single_threaded_blas
def none_keeps(
    plants: Sequence[Plant], spec: PDSpec, spans: Sequence[Span]
) -> tuple[str, tuple[str, ...], tuple[Relaxed, ...]]:
    """Return why no gain of these intervals keeps to all limits, which are missed, and limits that can be kept."""
    loops = LinearLoops(plants, spec)
    gains = np.concatenate([np.linspace(low, high, TRIED) for low, high in spans])
    found = [loops.margins(float(gain)) for gain in gains]
    worst = [max(_ratio(one, name, limit) for name, limit in spec.limits.items()) for one in found]
    best = int(np.argmin(worst))
    missed = tuple(name for name, limit in spec.limits.items() if _ratio(found[best], name, limit) > 1.0)
    changes = tuple((name, _rounded(getattr(found[best], name), up=name != "delay_margin")) for name in missed)
    units = {"delay_margin": " s", "noise_gain": f" {plants[0].command_unit}/{plants[0].length_unit}"}
    reached = " and ".join(f"a {WORDS[name]} of {value:g}{units.get(name, '')}" for name, value in changes)
    asked = " and ".join(f"the {WORDS[name]} of {limit:g}{units.get(name, '')}" for name, limit in spec.limits.items())
    reason = (
        f"no {spec.free} that meets the spec otherwise, {gains[0]:.4g} to {gains[-1]:.4g}, keeps to {asked};"
        f" {reached} can be met ({spec.free} = {gains[best]:.4g})"
    )
    return reason, missed, (Relaxed(changes=changes, kd=float(gains[best])),)


def _ratio(margins: LoopMargins, name: str, limit: float) -> float:
    """Return by which factor a margin misses its limit; above 1 it does."""
    value = float(getattr(margins, name) or 0.0)
    return limit / max(value, 1e-300) if name == "delay_margin" else value / limit


def _rounded(value: float, *, up: bool) -> float:
    """Round to three digits, to the side on which the limit is kept."""
    digits = 10.0 ** (np.floor(np.log10(value)) - 2)
    count = np.ceil(value / digits - 1e-9) if up else np.floor(value / digits + 1e-9)
    return float(f"{count * digits:.6g}")
