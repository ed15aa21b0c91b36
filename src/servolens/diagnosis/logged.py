"""What was done in an experiment, without its measurements: enough to propose others of its kind."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from servolens.decoding import fields_of, part, read_fields
from servolens.errors import InputError
from servolens.identification.segments import applied_voltage
from servolens.record import Controller

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servolens.record import Record

__all__ = ["Logged"]

POSITIVE = ("duration", "sample_time", "voltage_limit")


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
            return cls._from_json(data)
        except InputError as error:
            raise InputError(f"an experiment: {error}") from None

    @classmethod
    def _from_json(cls, data: Mapping[str, Any]) -> Logged:
        loop = data["controller"]
        if loop is not None:
            own = part(data, "controller", lambda one: {"kp": data["kp"], "kd": data["kd"], **one})
            strange = next((name for name in own if name not in Controller.__slots__), None)
            if strange is not None:
                raise InputError(f"a controller has no setting {strange[:40]!r}")
            loop = read_fields(Controller, own)
        plain = [name for name in cls.__slots__ if name != "controller"]
        found = cls(**fields_of(cls, data, plain), controller=loop)
        for name in plain[1:]:
            value = getattr(found, name)
            if value is not None and not np.isfinite(value).all():
                raise InputError(f"{name} must be finite")
            if name in POSITIVE and value is not None and value <= 0:
                raise InputError(f"{name} must be positive, got {value:g}")
        return found
