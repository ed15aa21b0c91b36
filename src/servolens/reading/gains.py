"""The gains of a loop whose reference, position and command are logged: the PD law that explains the command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.reading.guess import Guess
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.record import Record

    Values = NDArray[np.float64]

__all__ = ["LoggedGains", "guessed_gains"]

FEWEST_SAMPLES = 50
"""Samples below which two gains can fit anything."""
LARGEST_MISFIT = 5e-3
"""Share of the command that a law may leave unexplained (r.m.s.): what logs print has three digits or more."""
ODD = 0.05
"""Share of the samples that may be off: edges that ring, samples that were lost."""
LESS = 0.2
"""Share of what is left that rounding of a gain may add: in quadrature that is 2 %."""
CLIPPED = 1 - 1e-9


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedGains:
    """A PD law found in a log.

    Parameters
    ----------
    controller : Controller
        With its gains.
    settings : mapping of str to object
        That state the law.
    guesses : tuple of Guess
        With the evidence.
    """

    controller: Controller
    settings: Mapping[str, object]
    guesses: tuple[Guess, ...]


def guessed_gains(record: Record) -> LoggedGains | None:
    """Return the P or PD law that explains the logged command, None where none does.

    Of ``V = kp e``, ``V = kp e − kd (y[k] − y[k−w])/(w h)`` with w = 1 and 2, and with a logged velocity
    ``V = kp e − kd v``, the first that explains the command: by least squares over the samples at which it is not at
    its largest value, twice, the second time without the samples that are farthest off.
    """
    r, v = record.reference, record.voltage
    if r is None or v is None or v.size < FEWEST_SAMPLES:
        return None
    y, error = record.position, r - record.position
    inside = np.abs(v) < CLIPPED * np.max(np.abs(v))
    inside[:2] = False
    if np.count_nonzero(inside) < FEWEST_SAMPLES or not np.ptp(v[inside]) > 0:
        inside = np.arange(v.size) > 1
    laws: list[tuple[dict[str, object], list[Values]]] = [({}, [error])]
    for window in (1, 2):
        slope = np.zeros_like(y)
        slope[window:] = (y[window:] - y[:-window]) / (window * record.sample_time)
        laws.append(({"derivative_window": window} if window > 1 else {}, [error, -slope]))
    if record.velocity is not None:
        laws.append(({"derivative": "velocity"}, [error, -record.velocity]))
    found = [_fitted(terms, v, inside) for _, terms in laws]
    for (words, terms), law in zip(laws, found, strict=True):
        if law is not None and law[1] <= _admissible(record, law[0], v[inside]) and law[0][0] > 0:
            gains = [_short(float(gain), term[inside], law[1]) for gain, term in zip(law[0], terms, strict=True)]
            return _found(record, words, gains, law[1] / float(np.sqrt(np.mean(v**2))))
    return None


def _fitted(terms: list[Values], v: Values, inside: NDArray[np.bool_]) -> tuple[Values, float] | None:
    """Return gains and what they leave of the command (r.m.s.), None where the terms do not vary."""
    matrix, target = np.column_stack(terms)[inside], v[inside]
    if not np.all(np.ptp(matrix, axis=0) > 0) or not np.any(target):
        return None
    gains = np.linalg.lstsq(matrix, target, rcond=None)[0]
    left = np.abs(target - matrix @ gains)
    kept = left <= np.quantile(left, 1 - ODD)
    if not np.all(np.ptp(matrix[kept], axis=0) > 0):
        return None
    gains = np.linalg.lstsq(matrix[kept], target[kept], rcond=None)[0]
    return gains, float(np.sqrt(np.mean((target - matrix @ gains)[kept] ** 2)))


def _admissible(record: Record, gains: Values, v: Values) -> float:
    """Return what a law may leave of the command (r.m.s.): its share, and what rounding of the position makes."""
    steps = np.abs(np.diff(record.position))
    smallest = float(np.min(steps[steps > 0], initial=np.inf))
    rounding = abs(float(gains[0])) * smallest / np.sqrt(12) if np.isfinite(smallest) else 0.0
    return float(np.hypot(LARGEST_MISFIT * np.sqrt(np.mean(v**2)), rounding))


def _short(gain: float, term: Values, left: float) -> float:
    """Return a gain with the fewest digits, up to four, that change the command by less than the law leaves of it."""
    size = float(np.sqrt(np.mean(term**2)))
    shorter = (float(f"{gain:.{digits}g}") for digits in range(1, 5))
    return next((value for value in shorter if abs(value - gain) * size <= LESS * left), float(f"{gain:.4g}"))


def _found(record: Record, words: Mapping[str, object], gains: Sequence[float], share: float) -> LoggedGains:
    kp, kd = gains[0], gains[1] if len(gains) > 1 else 0.0
    length, command = record.length_unit, record.command_unit
    named = {"derivative": "the logged velocity", "derivative_window": "differences over two samples"}
    how = "".join(f" with {named[word]}" for word in words)
    why = f"explains the logged command to {max(100 * share, 0.01):.2g} %{how}"
    window = int(str(words.get("derivative_window", 1)))
    return LoggedGains(
        controller=Controller(
            kp=kp, kd=kd, derivative="velocity" if "derivative" in words else "position", derivative_window=window
        ),
        settings={"kp": f"{kp!r} {command}/{length}", "kd": f"{kd!r} {command} s/{length}", **words},
        guesses=tuple(
            Guess(quantity=key, source="the logged command", value=f"{value:g} {unit}", evidence=why)
            for key, value, unit in (("kp", kp, f"{command}/{length}"), ("kd", kd, f"{command} s/{length}"))
        ),
    )
