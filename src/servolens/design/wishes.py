"""What is asked of several gains beside a spec."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from math import inf
from typing import Any, ClassVar, Literal, final

from servolens.errors import InputError, number_within, one_of, whole_number

__all__ = ["GainWishes"]

LAWS = (("kd", "kp", "derivative_filter", "ki"), ("kv", "kp", "derivative_filter", "kiv"))
"""Gains of a PD or PID, and of a cascade; the first has to be free."""
OBJECTIVES = ("kd", "noise", "settling_time", "margin")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class GainWishes:
    """Which gains are free, what is to be best, and what else they must keep to.

    Parameters
    ----------
    free : tuple of str
        Of ``"kp"``, ``"kd"``, ``"derivative_filter"``, ``"ki"``, kd among them; of a cascade ``"kp"``, ``"kv"``,
        ``"derivative_filter"``, ``"kiv"``, kv among them, for which kd may stand.
    objective : {"noise", "kd", "settling_time", "margin"}
        What is to be least: the noise of the command, kd, the settling time, or the peak of sensitivity, whose inverse
        is the margin.
    peak_sensitivity, peak_complementary : float, optional
        Largest Ms and Mt of the linearised loop, above 1 and positive.
    delay_margin : float, optional
        By how much the command must be able to come later [s], positive.
    voltage_noise : float, optional
        Largest r.m.s. of the command for the measurement noise [V], positive.
    position_noise : float, optional
        R.m.s. of that noise, white [m or rad], positive; by default that of the records, which model files remember.
    scenarios : int
        In how many scenarios, drawn as :func:`servolens.recommend` does, the spec and all limits have to hold too, and
        the worst of which the objective is; 0 for the models alone.

    Raises
    ------
    InputError
        If a value is outside its range.
    """

    example: ClassVar[str] = "GainWishes(free=('kp', 'kd'))"

    free: tuple[str, ...] = ("kp", "kd")
    objective: Literal["kd", "noise", "settling_time", "margin"] = "noise"
    peak_sensitivity: float | None = None
    peak_complementary: float | None = None
    delay_margin: float | None = None
    voltage_noise: float | None = None
    position_noise: float | None = None
    scenarios: int = 100

    def __post_init__(self) -> None:
        free = (self.free,) if isinstance(self.free, str) else self.free
        object.__setattr__(self, "free", tuple(free) if isinstance(free, Iterable) else (free,))
        if not any(law[0] in self.free and all(one in law for one in self.free) for law in LAWS):
            raise InputError(
                "free gains are kd and perhaps kp, derivative_filter and ki, of a cascade kv and perhaps kp,"
                f" derivative_filter and kiv, got {', '.join(map(str, self.free))[:80]}"
            )
        one_of(self.objective, OBJECTIVES, "objective")
        for name in ("peak_sensitivity", "peak_complementary", "delay_margin", "voltage_noise", "position_noise"):
            value, least = getattr(self, name), 1.0 if name == "peak_sensitivity" else 0.0
            if value is not None:
                object.__setattr__(self, name, number_within(value, least, inf, name, above=True))
        object.__setattr__(self, "scenarios", whole_number(self.scenarios, 0, "scenarios"))

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {**{f.name: getattr(self, f.name) for f in fields(self)}, "free": list(self.free)}
