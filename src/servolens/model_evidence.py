"""What is known of a model beside its parameters: the diagnosis's verdict, what it misses, and what records showed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar, final

from servolens.decoding import fields_of, read_fields
from servolens.errors import InputError
from servolens.results import to_finite, with_reasons

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["MATERIAL", "UNRELIABLE", "DataRange", "Evidence", "How", "Missed", "ModelError", "Remainder", "Verdict"]

T = TypeVar("T")
Verdict = Literal["healthy", "explained", "partly_explained", "unexplained"]
How = Literal["held_out", "left_out", "end"]
MATERIAL = 0.005
"""Share of the travel from which on a remainder matters to whoever tunes: half the usual band of 1 %."""
UNRELIABLE = (
    "This model does not explain the data to noise level. Do not rely on the error bars: they hold only if it is right."
)
"""What stands beside the error bars of a model that leaves more than noise."""


REASONS = {
    "verdict": "no diagnosis was made",
    "remainder": "no diagnosis was made",
    "heldout_of_step": "the model was not simulated on data that it was not fitted to",
    "model_error": "no loop of the records can be simulated",
    "noise": "it was not estimated",
}
"""Why a field of the evidence is null."""


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
        return _sizes(read_fields(cls, {"times_noise": None, **data}))


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
    voltage_error, speed_error, step_error : float
        Standard deviation that the sensor's noise gives each of the three; 0 where it is not known.
    """

    voltage: float
    speed: float
    step: float
    kp: float | None = None
    kd: float | None = None
    voltage_error: float = 0.0
    speed_error: float = 0.0
    step_error: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the fields."""
        return {name: getattr(self, name) for name in self.__slots__}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> DataRange:
        """Build the range from what :meth:`to_json` returned; an error that is null is not known."""
        known = {name: one for name, one in data.items() if one is not None or not name.endswith("_error")}
        return _sizes(read_fields(cls, known))


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
        found = _sizes(read_fields(cls, data))
        if not len(found.frequency) == len(found.size) == len(found.loop) > 0:
            raise InputError("model_error must hold frequency, size and loop, as many of each")
        return found


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
        found = _sizes(read_fields(cls, data))
        if found.step == 0:
            raise InputError("step must not be 0")
        return found


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """How far the records support a model.

    Attributes
    ----------
    range : DataRange
        What the records showed, those held out included.
    verdict : {"healthy", "explained", "partly_explained", "unexplained"} or None
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
    verdict: Verdict | None = None
    remainder: Remainder | None = None
    heldout_of_step: float | None = None
    fatal: tuple[str, ...] = ()
    model_error: ModelError | None = None
    noise: float | None = None
    missed: tuple[Missed, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the fields that stand beside those of the plant in ``servolens.model/1``; finite numbers only."""
        fields: dict[str, Any] = to_finite(
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
        return with_reasons(fields, REASONS)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Evidence | None:
        """Build the evidence from a model's fields; None of a model that says nothing of the records' range.

        Raises
        ------
        InputError
            If a field has the wrong type, or is missing within one.
        """
        given = {field.name: data[field.name] for field in fields(cls) if data.get(field.name) is not None}
        found = fields_of(cls, given, list(given))
        return _sizes(cls(**found)) if "range" in found else None


def _sizes(found: T) -> T:
    """Return a dataclass of which no number, nor one in its tuples, is negative."""
    for field in fields(found):  # type: ignore[arg-type] # a dataclass
        value = getattr(found, field.name)
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, float) and not one >= 0.0:
                raise InputError(f"{field.name} must be a number that is not negative, got {one:g}")
    return found
