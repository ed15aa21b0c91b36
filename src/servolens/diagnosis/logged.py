"""What was done in an experiment, without its measurements: enough to propose others of its kind."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.errors import InputError
from servolens.identification.segments import applied_voltage
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.record import Record

__all__ = ["Logged"]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Logged:
    """An experiment that was logged.

    Attributes
    ----------
    name : str
        Of the record.
    controller : Controller or None
        Of the loop, where it is known.
    start, reference : float
        Where the axis began, and the set point farthest from there [m or rad].
    duration : float
        Longest time that the reference stayed the same [s].
    sample_time : float
        [s].
    position_range, voltage_range : tuple of float
        Lowest and highest that were seen.
    voltage_limit : float or None
        Of the amplifier, where it is known.
    """

    name: str
    controller: Controller | None
    start: float
    reference: float
    duration: float
    sample_time: float
    position_range: tuple[float, float]
    voltage_range: tuple[float, float]
    voltage_limit: float | None

    @property
    def amplitude(self) -> float:
        """Size of the largest step [m or rad]."""
        return abs(self.reference - self.start)

    @classmethod
    def of(cls, record: Record) -> Logged:
        """Return what was done in `record`; where no reference is logged, the position stands for it."""
        start = float(record.position[0])
        levels = record.position if record.reference is None else record.reference
        edges = np.concatenate(([0], record.edges(), [len(record) - 1]))
        voltage = applied_voltage(record)
        return cls(
            name=record.name,
            controller=record.controller,
            start=start,
            reference=float(levels[np.argmax(np.abs(levels - start))]),
            duration=float(np.max(np.diff(record.time[edges]))),
            sample_time=record.sample_time,
            position_range=(float(record.position.min()), float(record.position.max())),
            voltage_range=(float(voltage.min()), float(voltage.max())),
            voltage_limit=record.voltage_limit,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the fields of an entry of ``experiments``."""
        settings = None if self.controller is None else asdict(self.controller)
        return {
            "name": self.name,
            "kp": None if settings is None else settings.pop("kp"),
            "kd": None if settings is None else settings.pop("kd"),
            "start": self.start,
            "reference": self.reference,
            "duration": self.duration,
            "sample_time": self.sample_time,
            "position_range": list(self.position_range),
            "voltage_range": list(self.voltage_range),
            "voltage_limit": self.voltage_limit,
            "controller": settings,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Logged:
        """Build it from what :meth:`to_json` returned.

        Raises
        ------
        InputError
            If a field is missing or no number.
        """
        try:
            loop = data["controller"]
            given = None if loop is None else Controller(kp=data["kp"], kd=data["kd"], **loop)
            limit = data["voltage_limit"]
            return cls(
                name=str(data["name"]),
                controller=given,
                start=_number(data["start"]),
                reference=_number(data["reference"]),
                duration=_number(data["duration"], positive=True),
                sample_time=_number(data["sample_time"], positive=True),
                position_range=_range(data["position_range"]),
                voltage_range=_range(data["voltage_range"]),
                voltage_limit=None if limit is None else _number(limit, positive=True),
            )
        except KeyError as error:
            raise InputError(f"an experiment lacks {str(error.args[0])[:40]!r}") from None
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError("a field of an experiment has the wrong type") from None


def _range(values: Any) -> tuple[float, float]:
    low, high = values
    return _number(low), _number(high)


def _number(value: Any, *, positive: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"a number of an experiment must be finite, got {str(value)[:40]!r}")
    if positive and value <= 0:
        raise InputError(f"a time or limit of an experiment must be positive, got {value:g}")
    return float(value)
