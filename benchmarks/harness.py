"""What the benchmarks share: figures, fair timing, the table and its file."""

from __future__ import annotations

import gc
import json
import os
import statistics
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

__all__ = ["Figure", "alternate", "median_time", "processor_time", "table", "write"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One measured number; `target` is None where none was set and the number is there to be compared with."""

    name: str
    value: float
    unit: str
    target: float | None
    better: Literal["higher", "lower"]

    @property
    def verdict(self) -> str:
        """Whether the target is met."""
        if self.target is None:
            return ""
        met = self.value >= self.target if self.better == "higher" else self.value <= self.target
        return "met" if met else "MISSED"


def processor_time() -> float:
    """Return the time [s] of all processors that this process and those it began, and that are over, have taken."""
    return sum(os.times()[:4])


def median_time(function: Callable[[], Any], seconds: float = 0.5, least: int = 5) -> float:
    """Return the median time of a call [s], warmed up, the collector off, over `seconds` and `least` calls."""
    return alternate([function], seconds, least)[0]


def alternate(functions: Iterable[Callable[[], Any]], seconds: float = 1.0, least: int = 5) -> list[float]:
    """Return the median time of a call [s] of each, called in turn so that a busy machine troubles all alike."""
    functions = list(functions)
    for function in functions:
        function()
    batches = [max(1, round(2e-2 / max(_clock(function, 1), 1e-9))) for function in functions]
    times: list[list[float]] = [[] for _ in functions]
    end = time.perf_counter() + seconds
    gc.disable()
    try:
        while time.perf_counter() < end or len(times[0]) < least:
            for found, function, batch in zip(times, functions, batches, strict=True):
                found.append(_clock(function, batch))
    finally:
        gc.enable()
    return [statistics.median(found) for found in times]


def table(figures: Iterable[Figure]) -> str:
    """Return the figures as text."""
    figures = list(figures)
    width = max(len(f.name) for f in figures)
    lines = [f"{'figure':<{width}}{'measured':>12} {'unit':<8}{'target':>10}"]
    for f in figures:
        bound = "" if f.target is None else f"{'≥' if f.better == 'higher' else '≤'} {f.target:g}"
        lines.append(f"{f.name:<{width}}{f.value:>12.4g} {f.unit:<8}{bound:>10}  {f.verdict}".rstrip())
    return "\n".join(lines)


def write(figures: Iterable[Figure], path: Path) -> None:
    """Write the figures as JSON."""
    path.write_text(json.dumps([asdict(f) for f in figures], indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _clock(function: Callable[[], Any], batch: int) -> float:
    start = time.perf_counter()
    for _ in range(batch):
        function()
    return (time.perf_counter() - start) / batch
