"""The gains of a loop whose reference, position and command are logged: the PD law that explains the command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.reading.guess import Guess
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servolens.record import Record

    Values = NDArray[np.float64]

__all__ = ["LoggedGains", "guessed_gains"]

FEWEST = 50
"""Samples below which two gains can fit anything."""
UNEXPLAINED = 5e-3
"""Share of the command that a law may leave unexplained (r.m.s.): what logs print has three digits or more."""
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
    """Return the P or PD law that explains the logged command, None where none does or gains are known.

    Of the laws ``V = kp e``, ``V = kp e − kd Δy/h`` and, with a logged velocity, ``V = kp e − kd v`` the first that
    leaves at most half a per cent of the command (r.m.s.) unexplained, by least squares over the samples at which the
    command is not at its largest value.
    """
    r, v = record.reference, record.voltage
    if r is None or v is None or v.size < FEWEST:
        return None
    error = r - record.position
    inside = np.abs(v) < CLIPPED * np.max(np.abs(v))
    inside[0] = False
    if np.count_nonzero(inside) < FEWEST or not np.ptp(v[inside]) > 0:
        inside = np.arange(v.size) > 0
    slope = np.diff(record.position, prepend=record.position[0]) / record.sample_time
    laws: list[tuple[str, list[Values]]] = [("", [error]), ("position", [error, -slope])]
    if record.velocity is not None:
        laws.append(("velocity", [error, -record.velocity]))
    power = float(np.sqrt(np.mean(v[inside] ** 2)))
    for derivative, terms in laws:
        matrix = np.column_stack(terms)
        if power == 0 or not np.all(np.ptp(matrix[inside], axis=0) > 0):
            continue
        gains = np.linalg.lstsq(matrix[inside], v[inside], rcond=None)[0]
        left = float(np.sqrt(np.mean((v - matrix @ gains)[inside] ** 2))) / power
        if left <= UNEXPLAINED and gains[0] > 0:
            return _found(record, derivative, gains, left)
    return None


def _found(record: Record, derivative: str, gains: Values, left: float) -> LoggedGains:
    kp, kd = float(f"{gains[0]:.4g}"), float(f"{gains[1]:.4g}") if derivative else 0.0
    length, command = record.length_unit, record.command_unit
    settings: dict[str, object] = {"kp": f"{kp!r} {command}/{length}", "kd": f"{kd!r} {command} s/{length}"}
    if derivative == "velocity":
        settings["derivative"] = "velocity"
    why = f"explains the logged command to {100 * left:.2g} %"
    return LoggedGains(
        controller=Controller(kp=kp, kd=kd, derivative="velocity" if derivative == "velocity" else "position"),
        settings=settings,
        guesses=tuple(
            Guess(quantity=key, source="the logged command", value=f"{value:g} {unit}", evidence=why)
            for key, value, unit in (("kp", kp, f"{command}/{length}"), ("kd", kd, f"{command} s/{length}"))
        ),
    )
