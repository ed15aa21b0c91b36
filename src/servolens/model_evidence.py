"""What is known of a model beside its parameters: the diagnosis's verdict, what it misses, and what records showed."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, final, get_args

import numpy as np

from servolens.errors import InputError
from servolens.results import to_finite

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["MATERIAL", "UNRELIABLE", "DataRange", "Evidence", "How", "Missed", "ModelError", "Remainder"]

How = Literal["held_out", "left_out", "end"]
MATERIAL = 0.005
"""Share of the travel from which on a remainder matters to whoever tunes: half the usual band of 1 %."""
UNRELIABLE = (
    "This model does not explain the data to noise level: the error bars hold only if it is right. Do not rely on them."
)
"""What stands beside the error bars of a model that leaves more than noise."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """What the chosen model misses beyond the noise.

    Attributes
    ----------
    rms : float
        R.m.s. of the simulation's error beyond the noise, in quadrature [m or rad].
    times_noise : float or None
        The simulation's error over the noise floor; None without noise.
    of_travel : float
        `rms` over the range of the position.
    acceleration_rms : float
        R.m.s. of the acceleration that nothing explains: the force, per unit of moving mass, that would make up the
        simulation's error [m/s² or rad/s²].
    correlation_time : float
        How slowly that acceleration changes: its r.m.s. over that of its rate of change [s].
    of_motor : float
        `acceleration_rms` over the largest acceleration that the motor gives.
    depends_on_inputs : bool
        Whether it depends on reference, feedforward or a column of the catalogue; else it is noise or shaking.
    material : bool
        Whether `of_travel` exceeds half a percent.
    heldout : bool
        Whether these are errors on records that were held out, which miss more than those that were fitted.
    """

    rms: float
    times_noise: float | None
    of_travel: float
    acceleration_rms: float
    correlation_time: float
    of_motor: float
    depends_on_inputs: bool
    material: bool
    heldout: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: getattr(self, name) for name in self.__slots__}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Remainder:
        """Build the remainder from what :meth:`to_json` returned; a number that is null was not finite."""

        def size(name: str) -> float:
            return _size(data[name], f"remainder.{name}")

        return cls(
            rms=size("rms"),
            times_noise=None if data.get("times_noise") is None else size("times_noise"),
            of_travel=size("of_travel"),
            acceleration_rms=size("acceleration_rms"),
            correlation_time=size("correlation_time"),
            of_motor=size("of_motor"),
            depends_on_inputs=bool(data["depends_on_inputs"]),
            material=bool(data["material"]),
            heldout=bool(data.get("heldout", False)),
        )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class DataRange:
    """The largest that the records showed.

    Attributes
    ----------
    voltage : float
        |V| that the controller asked for [V].
    speed : float
        [m/s or rad/s].
    step : float
        Step of the reference, or travel where none was logged [m or rad].
    kp, kd : float or None
        Gains of the loops [V/m, V s/m]; None where no record states them.
    """

    voltage: float
    speed: float
    step: float
    kp: float | None = None
    kd: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: getattr(self, name) for name in self.__slots__}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> DataRange:
        """Build the range from what :meth:`to_json` returned."""
        given = {f.name: data[f.name] for f in fields(cls) if f.default is MISSING or data.get(f.name) is not None}
        return cls(**{name: _size(value, f"range.{name}") for name, value in given.items()})


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class ModelError:
    """What the records say of a model's relative error at each frequency.

    Attributes
    ----------
    frequency : tuple of float
        Rising [Hz].
    size : tuple of float
        |Δ| where the axis answers a command as the model does times 1 + Δ; where noise hides it, as much as noise may
        hide, but no more than 1.
    loop : tuple of float
        Largest complementary sensitivity |T| of the loops that made the records: they are stable with T·Δ.
    """

    frequency: tuple[float, ...]
    size: tuple[float, ...]
    loop: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: list(getattr(self, name)) for name in self.__slots__}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ModelError:
        """Build it from what :meth:`to_json` returned."""
        columns = {f.name: tuple(_size(v, f"model_error.{f.name}") for v in data[f.name]) for f in fields(cls)}
        if len({len(column) for column in columns.values()}) != 1 or not columns["frequency"]:
            raise InputError("model_error must hold frequency, size and loop, as many of each")
        return cls(**columns)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Missed:
    """What a model misses of one record that it was not fitted to.

    Attributes
    ----------
    record : str
        Its name.
    how : {"held_out", "left_out", "end"}
        A record that took no part; one that is fitted too, by a fit to the others; or the last part of one, by a fit
        without it.
    rms : float
        Of the simulation's error there [m or rad].
    step : float
        Of the record [m or rad].
    """

    record: str
    how: How
    rms: float
    step: float

    @property
    def of_step(self) -> float:
        """`rms` over the step."""
        return self.rms / self.step

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: getattr(self, name) for name in self.__slots__}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Missed:
        """Build it from what :meth:`to_json` returned."""
        how, step = data["how"], _size(data["step"], "missed.step")
        if how not in get_args(How) or step == 0:
            raise InputError("missed must say how each record was left out of the fit, and its step")
        return cls(record=str(data["record"]), how=how, rms=_size(data["rms"], "missed.rms"), step=step)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """How far the records support a model.

    Attributes
    ----------
    range : DataRange
        What the records showed, those held out included.
    verdict : str or None
        Of the diagnosis; None where there was none.
    remainder : Remainder or None
        What the model misses; None where nobody looked.
    heldout_of_step : float or None
        R.m.s. of the simulation's error on records that took no part in the fit, over the step: the worst of them.
    fatal : tuple of str
        Sentences of the findings for which the model is worthless.
    model_error : ModelError or None
        Its relative error at each frequency; None where no loop of the records can be simulated.
    noise : float or None
        Standard deviation of the sensor's noise from sample to sample [m or rad]; None where nobody looked.
    missed : tuple of Missed
        What `heldout_of_step` is the largest of; empty in older files.
    """

    range: DataRange
    verdict: str | None = None
    remainder: Remainder | None = None
    heldout_of_step: float | None = None
    fatal: tuple[str, ...] = ()
    model_error: ModelError | None = None
    noise: float | None = None
    missed: tuple[Missed, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the fields that stand beside those of the plant in ``servolens.model/1``; finite numbers only."""
        result: dict[str, Any] = to_finite(
            {
                "verdict": self.verdict,
                "remainder": None if self.remainder is None else self.remainder.to_json(),
                "range": self.range.to_json(),
                "heldout_of_step": self.heldout_of_step,
                "fatal": self.fatal,
                "model_error": None if self.model_error is None else self.model_error.to_json(),
                "noise": self.noise,
                "missed": [missed.to_json() for missed in self.missed],
            }
        )
        return result

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Evidence | None:
        """Build the evidence from a model's fields; None of a model that says nothing of the records' range.

        Raises
        ------
        InputError
            If a field is missing or no number.
        """
        if data.get("range") is None:
            return None
        verdict, remainder = data.get("verdict"), data.get("remainder")
        heldout, noise = data.get("heldout_of_step"), data.get("noise")
        return cls(
            range=DataRange.from_json(data["range"]),
            verdict=None if verdict is None else str(verdict),
            remainder=None if remainder is None else Remainder.from_json(remainder),
            heldout_of_step=None if heldout is None else _size(heldout, "heldout_of_step"),
            fatal=tuple(str(sentence) for sentence in data.get("fatal") or ()),
            model_error=None if data.get("model_error") is None else ModelError.from_json(data["model_error"]),
            noise=None if noise is None else _size(noise, "noise"),
            missed=tuple(Missed.from_json(one) for one in data.get("missed") or ()),
        )


def _size(value: Any, name: str) -> float:
    if value is None:
        return float("inf")
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value) or value < 0:
        raise InputError(f"{name} must be a number that is not negative, got {str(value)[:40]!r}")
    return float(value)
