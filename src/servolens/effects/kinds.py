"""The kinds of effects: where in the axis one acts, and so what its physics takes and gives.

Per unit of moving mass, from the command V to the measured position::

    V → saturation, dead zone → delay → lag → drift → a      actuators
    β·a or a drive's own force, less c·v, limited             drive, motor force
    ÿ = motor − Σ forces − D·sgn v                            forces, dry friction
    two masses: (1 − μ)ẍ = … − F,  μÿ = F − …                 transmission
    measured = sensor(position of the load)                   sensor

An effect with ``states`` also has `rates`, with the arguments of its physics, and finds the states in ``axis.state``.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from servolens.effects.base import Effect

if TYPE_CHECKING:
    from servolens.effects.base import Axis

__all__ = ["Actuator", "Drive", "DryFriction", "Force", "MotorForce", "Sensor", "TimeShift", "Transmission"]

SX = Any


class Force(Effect):
    """A force per unit of moving mass that is smooth while the direction of motion stays the same."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(axis: Axis, p: Any) -> SX:
        """Return the acceleration that is *subtracted* [x/s²]."""

    @staticmethod
    def rates(axis: Axis, p: Any) -> tuple[SX, ...]:
        """Return the time derivatives of the states."""
        return ()


class DryFriction(Effect):
    """Set-valued friction: opposes motion with its level, holds the axis at rest up to it."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(axis: Axis, p: Any) -> SX:
        """Return the level, not negative [x/s²]; at rest `axis.direction` is that of the push.

        `axis.load` is the force that the motor transmits.
        """


class Actuator(Effect):
    """What becomes of the command before it pushes the axis."""

    __slots__ = ()
    stage: ClassVar[int]
    """Order in the chain; smaller acts first. A :class:`TimeShift` stands between 20 and 40."""

    @staticmethod
    @abstractmethod
    def physics(command: SX, axis: Axis, p: Any) -> SX:
        """Return the effective command, in the command's unit."""

    @staticmethod
    def rates(command: SX, axis: Axis, p: Any) -> tuple[SX, ...]:
        """Return the time derivatives of the states."""
        return ()


class TimeShift(Effect):
    """The held command reaches the actuator later."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(p: Any) -> SX:
        """Return by how much [s], not negative."""


class Drive(Effect):
    """A drive with a loop of its own: its force takes the place of β·a."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(command: SX, axis: Axis, p: Any) -> SX:
        """Return the acceleration that it gives [x/s²]."""

    @staticmethod
    @abstractmethod
    def rates(command: SX, axis: Axis, p: Any) -> tuple[SX, ...]:
        """Return the time derivatives of the states."""

    @property
    @abstractmethod
    def gain(self) -> float:
        """Acceleration per unit of command, from rest: what the plant's `gain` then is."""

    @property
    def damping(self) -> float:
        """Force per speed that its loop adds to the plant's damping [1/s], before it has summed any error."""
        return 0.0


class MotorForce(Effect):
    """What the motor makes of the force asked of it, back-EMF included."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(push: SX, axis: Axis, p: Any) -> SX:
        """Return the acceleration by the motor, of `push`, the β·a − c·v asked for [x/s²]."""


class Transmission(Effect):
    """Splits the axis into a motor and a load, which is measured."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(axis: Axis, p: Any) -> SX:
        """Return the force F from motor to load, per unit of total mass [x/s²]."""

    @staticmethod
    @abstractmethod
    def rates(axis: Axis, p: Any) -> tuple[SX, ...]:
        """Return the time derivatives of the states ``position`` and ``velocity``, the load's."""

    @staticmethod
    @abstractmethod
    def share(p: Any) -> SX:
        """Return the load's share μ of the moving mass, in (0, 1)."""

    @property
    def play(self) -> float:
        """How far the motor can be from the load without touching it [m or rad]; 0 where they are joined."""
        return 0.0


class Sensor(Effect):
    """What the sensor shows of the position; to it ``axis`` is the load, which is where the sensor is."""

    __slots__ = ()

    @staticmethod
    @abstractmethod
    def physics(position: SX, axis: Axis, p: Any) -> SX:
        """Return the position shown [x]."""

    @staticmethod
    def rates(position: SX, axis: Axis, p: Any) -> tuple[SX, ...]:
        """Return the time derivatives of the states."""
        return ()
