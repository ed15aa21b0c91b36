"""What is asked of every axis of a fleet."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, final

from servolens import __version__
from servolens.errors import InputError

__all__ = ["Request"]

EFFORTS = ("quick", "normal", "thorough")
LIMITS = ("time_limit", "memory_limit")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """The study that each axis gets, and its limits.

    Parameters
    ----------
    spec : mapping
        Fields of :class:`~servolens.PDSpec`, the settling time among them; what is missing is the records'. When empty,
        each axis gets a specification that suits its records.
    settings, columns, units : mapping
        For every record, as in :func:`servolens.read_records`.
    priors : mapping of str to (mean, deviation)
        Data-sheet knowledge by parameter name, as in :func:`servolens.diagnose`.
    effort : {"quick", "normal", "thorough"}
        How far the search for causes goes.
    data_root : str or None
        Folder that axes and the files of campaigns may not leave; by default the fleet's own, and the campaign's.
    time_limit : float
        Longest time for one axis [s]; its process is ended then.
    memory_limit : float
        Largest memory of one axis's process [MiB]; it is ended beyond. Measured where the system has ``/proc``.

    Raises
    ------
    InputError
        If a value is outside its range.
    """

    spec: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    effort: str = "normal"
    data_root: str | None = None
    time_limit: float = 3600.0
    memory_limit: float = 4096.0

    def __post_init__(self) -> None:
        if self.effort not in EFFORTS:
            raise InputError(f"effort is {self.effort!r}; it must be one of {', '.join(EFFORTS)}")
        for name in LIMITS:
            value = getattr(self, name)
            if not value > 0:
                raise InputError(f"{name} must be a positive number, got {value!r}")
        if self.spec and "settling_time" not in self.spec:
            raise InputError(f"{next(iter(self.spec))} needs a settling time; give settling_time too")

    def to_json(self) -> dict[str, Any]:
        """Return the fields, from which a process elsewhere makes the same request."""
        found = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in found.items()}

    @property
    def limits(self) -> dict[str, float]:
        """The limits, which change no result but whether there is one."""
        return {name: getattr(self, name) for name in LIMITS}

    @property
    def digest(self) -> str:
        """What tells whether results are of the same request and version: all but the limits."""
        asked = {name: value for name, value in self.to_json().items() if name not in LIMITS}
        text = json.dumps([__version__, asked], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()
