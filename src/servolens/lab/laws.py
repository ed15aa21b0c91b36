"""What a virtual axis can do, each effect as a function of one instant.

A law is written with operators and the functions of the namespace ``m`` (``math`` for one run, ``numpy`` for many at
once). The names and parameters are those of the toolbox; the physics is this module's own.

To add an effect: write its function, add its line to :data:`LAWS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["LAWS", "Instant", "Law"]


class Instant(NamedTuple):
    """Position, velocity, speed |v|, direction of motion ±1 (at rest that of the push) and time, SI."""

    position: Any
    velocity: Any
    speed: Any
    direction: Any
    time: Any


class Law(NamedTuple):
    """One effect: where it acts, the names of its numbers, its function.

    ``force``: (instant, p, m) → acceleration that is subtracted. ``friction``: (instant, p, m) → level of dry friction.
    ``command``: (command, p, m) → what is left of the held command; commands act in the order of :data:`LAWS`.
    """

    kind: Literal["force", "friction", "command"]
    parameters: tuple[str, ...]
    function: Callable[[Any, Any, Any], Any]


def _saturation(command: Any, p: Any, m: Any) -> Any:
    over = abs(command) - p.limit
    return command - (over > 0.0) * m.copysign(over, command)


def _velocity_decay_damping(instant: Instant, p: Any, m: Any) -> Any:
    return p.alpha1 * m.exp(-p.alpha2 * instant.speed) * instant.velocity


def _coulomb_friction(instant: Instant, p: Any, m: Any) -> Any:
    return p.level


LAWS = {
    "saturation": Law("command", ("limit",), _saturation),
    "velocity_decay_damping": Law("force", ("alpha1", "alpha2"), _velocity_decay_damping),
    "coulomb_friction": Law("friction", ("level",), _coulomb_friction),
}
