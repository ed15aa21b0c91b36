"""An identified plant with its uncertainty, and its file."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from servolens.decoding import decoded, listed, part, read_fields, read_json, whole
from servolens.errors import InputError, by_name, names_like, needed
from servolens.model_evidence import Evidence
from servolens.plant import FREE_DAMPING, Plant
from servolens.record_signals import as_numbers
from servolens.results import with_reasons
from servolens.units import COMMAND_UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.effects import Effect

__all__ = ["NOT_REACHED", "UNDETERMINED", "Model", "Quantity", "placed", "read_model"]

NORMAL_95 = 1.959963984540054
SCHEMA = "servolens.model/1"
HOLDERS = ("servolens.fit/1", "servolens.diagnosis/1", "servolens.identification/1")
"""Results whose files hold a model."""
UNDETERMINED = "the data do not determine it"
"""Reason for which a number has no standard error, and tells nothing."""
NOT_REACHED = "the records do not reach it"
"""The same of a limit: where it lies beyond is not known."""
LARGEST = 1e150
"""Standard error whose square is still a number."""
SYMMETRIC = 1e-6
"""Share of its size by which a covariance may miss its symmetry, and its correlations their bounds, by rounding."""
ROUNDED = 0.05
"""Relative difference of numbers that are the same but rounded to two digits, as people write errors."""
OPTIONAL = ("inertia", FREE_DAMPING.name)
"""Numbers of a plant that stand in its file where they are known."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """A number with its unit and what is known of its error.

    Parameters
    ----------
    value : float
        SI.
    unit : str
        As people write it, e.g. ``"m/s^2/V"``.
    stderr : float or None
        Standard error; None if it is not known, then `reason` says why.
    reason : str or None
        Why there is no standard error.
    """

    value: float
    unit: str
    stderr: float | None = None
    reason: str | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % confidence interval."""
        if self.stderr is None:
            return None
        return (self.value - NORMAL_95 * self.stderr, self.value + NORMAL_95 * self.stderr)

    def __float__(self) -> float:
        return self.value

    def __format__(self, spec: str) -> str:
        """Return the value as `spec` has it; without one, value ± standard error and unit."""
        return format(self.value, spec) if spec else str(self)

    def __str__(self) -> str:
        error = "" if self.stderr is None else f" ± {self.stderr:.2g}"
        return f"{self.value:.6g}{error} {self.unit}".rstrip()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Quantity:
        """Build the quantity from what :meth:`to_json` returned.

        Raises
        ------
        InputError
            If a field is no number or the value is missing.
        """
        return read_fields(cls, data)

    def to_json(self) -> dict[str, Any]:
        """Return ``{"value", "stderr", "interval", "unit"}``, and ``"reason"`` where the error is not known."""
        interval = self.interval
        result: dict[str, Any] = {
            "value": self.value,
            "stderr": self.stderr,
            "interval": None if interval is None else list(interval),
            "unit": self.unit,
        }
        if self.stderr is None and self.reason:
            result["reason"] = self.reason
        return result


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Model:
    """A plant, how well its parameters are known, and what it was identified from.

    Parameters
    ----------
    plant : Plant
        The estimates.
    covariance : ndarray, shape (k, k), optional
        Of ``plant.values``; NaN rows for parameters without a standard error.
    identified_from : tuple of str
        Names of the records.
    reasons : mapping of str to str
        By qualified name, why a parameter has no standard error.
    evidence : Evidence, optional
        How far the records support it; None where that is not known.
    """

    plant: Plant
    covariance: NDArray[np.float64] | None = None
    identified_from: tuple[str, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)
    evidence: Evidence | None = None

    def __post_init__(self) -> None:
        needed(self.plant, Plant)
        object.__setattr__(self, "reasons", by_name("reasons", self.reasons, {"gain": "given, not estimated"}))
        if self.covariance is not None:
            covariance, size = as_numbers(self.covariance, "covariance"), len(self.plant.values)
            if covariance.shape != (size, size):
                raise InputError(f"covariance must have shape ({size}, {size}), got {covariance.shape}")
            object.__setattr__(self, "covariance", covariance)

    def __repr__(self) -> str:
        """Return one line: every parameter with its error."""
        return f"<Model: {', '.join(f'{name} {quantity}' for name, quantity in self.quantities.items())}>"

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Every parameter by qualified name, but for those that have their usual values."""
        usual = self.plant.usual
        variances = np.full(len(self.plant.values), np.nan) if self.covariance is None else np.diag(self.covariance)
        known = np.isfinite(variances) & (variances >= 0)
        return _Quantities(
            (
                name,
                Quantity(
                    value=value,
                    unit=self.plant.unit(name),
                    stderr=float(np.sqrt(variances[i])) if known[i] else None,
                    reason=None if known[i] else self.reasons.get(name, "given, not estimated"),
                ),
            )
            for i, (name, value) in enumerate(zip(self.plant.parameters, self.plant.values, strict=True))
            if name not in usual
        )

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.model/1`` without the file's header."""
        quantities = self.quantities
        effects = [
            {
                "effect": effect.name,
                "parameters": {
                    spec.name: quantities[f"{effect.name}.{spec.name}"].to_json()
                    for spec in effect.parameters()
                    if spec.name not in effect.usual
                },
            }
            for effect in self.plant.effects
        ]
        fields = {
            "gain": quantities["gain"].to_json(),
            "damping": quantities["damping"].to_json(),
            "effects": effects,
            "length_unit": self.plant.length_unit,
            "command_unit": self.plant.command_unit,
            **({} if self.plant.inertia is None else {"inertia": self.plant.inertia}),
            **{name: quantities[name].to_json() for name in quantities if name == FREE_DAMPING.name},
            "covariance": None if self.covariance is None else _named_matrix(self.covariance, quantities, self.plant),
            "identified_from": list(self.identified_from),
            **({} if self.evidence is None else self.evidence.to_json()),
        }
        return with_reasons(fields, {"covariance": "the errors of the parameters are not known"})

    @classmethod
    def from_json(cls, data: Mapping[str, Any], effects: Sequence[type[Effect]] = ()) -> Model:
        """Build the model from what :meth:`to_json` returned; `effects` are classes beside those of the catalogue.

        Raises
        ------
        InputError
            If fields are missing or no numbers.
        """
        with whole(f"not a model of schema {SCHEMA}"):
            known = {cls.name: cls for cls in effects}
            given = {"effects": [], **data}
            found = listed(given, "effects", lambda item: Plant.effect_from(*_effect(item), known))
            plant = Plant(
                gain=_value(data["gain"]),
                damping=_value(data["damping"]),
                effects=found,
                length_unit=str(data.get("length_unit") or _length_unit(data)),
                command_unit=str(data.get("command_unit") or _command_unit(data)),
                **{name: _value(_as_quantity(data[name])) for name in OPTIONAL if data.get(name) is not None},
            )
            _check_units(data, plant)
            _check_intervals(data)
            covariance = _covariance(data, plant)
            names = decoded(tuple[str, ...], data.get("identified_from", []), "identified_from")
            reasons = {name: str(why) for name, q in _quantities(data).items() if (why := q.get("reason"))}
            evidence = Evidence.from_json(data)
        return cls(plant=plant, covariance=covariance, identified_from=names, reasons=reasons, evidence=evidence)


class _Quantities(dict[str, Quantity]):
    """Quantities by name, which answer a misspelt one with those that there are."""

    def __missing__(self, name: object) -> Quantity:
        raise KeyError(f"{name} is no parameter of this model; {names_like(str(name), self, 'those are')}")


def read_model(path: str | os.PathLike[str], *, effects: Sequence[type[Effect]] = ()) -> Model:
    """Read a ``servolens.model/1`` file, or the model of a fit, a diagnosis or an identification.

    A file with a gain that states no schema is taken for a model's.

    Parameters
    ----------
    path : str or path
        The file.
    effects : sequence of type
        Classes of effects beside those of the catalogue and of installed packages.

    Raises
    ------
    InputError
        If the file cannot be read or is none.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"the path of a model's file is needed; got {type(path).__name__}")
    path = Path(path)
    try:
        data = read_json(path, "; give a file that `servolens identify --out` wrote")
        schema = data.get("schema", SCHEMA if "gain" in data else None) if isinstance(data, dict) else None
        if schema not in (SCHEMA, *HOLDERS):
            raise InputError(f"is not a model (schema {str(schema)[:40]!r}, wanted {SCHEMA!r})")
        return Model.from_json(data if schema == SCHEMA else _held(data), effects)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def placed(plant: Plant, numbers: Any, names: Sequence[str] | None, what: str) -> NDArray[np.float64]:
    """Return an array of a file with a place for each parameter of `plant`, NaN for those that the file does not name.

    A file of an earlier version does not know the parameters that an effect was given later: these have their usual
    values.

    Parameters
    ----------
    plant : Plant
        Whose parameters it is about.
    numbers : array_like, shape (k,) or (k, k)
        As the file holds them.
    names : sequence of str or None
        Of which parameters, in that order; None where the file does not tell: of all of them, or of all that have not
        their usual values.
    what : str
        What it is, for a refusal.

    Raises
    ------
    InputError
        If names are missing, unknown or double, or the numbers are not as many as they.
    """
    every, usual = list(plant.parameters), plant.usual
    fitted = [name for name in every if name not in usual]
    older = [name for name in fitted if name != FREE_DAMPING.name]  # while that was never estimated
    array = np.asarray(numbers, dtype=np.float64)
    if names is None:
        names = next((one for one in (every, fitted, older) if len(array) == len(one)), fitted)
    if array.shape not in ((len(names),), (len(names),) * 2):
        raise InputError(f"{what} has shape {array.shape}; it must have a place for each of {', '.join(names)}")
    if len(set(names)) < len(names) or not set(older) <= set(names) <= set(every):
        raise InputError(f"{what} must name {', '.join(fitted)}; got {', '.join(map(str, names))[:40]!r}")
    place = [every.index(name) for name in names]
    found = np.full((len(every),) * array.ndim, np.nan)
    found[np.ix_(*(place,) * array.ndim)] = array
    return found


def _held(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the model that a result's file holds; of an identification the richest."""
    models = data.get("models")
    among = [models.get("velocity"), models.get("constant")] if isinstance(models, dict) else [data.get("model")]
    found = next((model for model in among if isinstance(model, dict)), None)
    if found is None:
        raise InputError("holds no model of a plant")
    return found


def _effect(item: Mapping[str, Any]) -> tuple[str, dict[str, float]]:
    """Return name and parameters of an effect of a file."""
    values = part(item, "parameters", lambda one: {name: _value(quantity) for name, quantity in one.items()})
    return decoded(str, item["effect"], "effect"), values


def _value(quantity: Mapping[str, Any]) -> float:
    if not isinstance(quantity, dict):
        raise InputError(f'a quantity must be an object such as {{"value": 1.9}}, got {str(quantity)[:40]!r}')
    value = quantity["value"]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"a value must be a number, got {str(value)[:40]!r}")
    return float(value)


def _as_quantity(given: Any) -> Mapping[str, Any]:
    """Return what a file states as an object, or as a number without error."""
    return given if isinstance(given, dict) else {"value": given}


def _quantities(data: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return all quantities that a file states, by qualified name."""
    found = {"gain": data["gain"], "damping": data["damping"]}
    for item in data.get("effects", ()):
        found |= {f"{item['effect']}.{name}": quantity for name, quantity in item["parameters"].items()}
    free = data.get(FREE_DAMPING.name)
    return found if free is None else {**found, FREE_DAMPING.name: _as_quantity(free)}


def _check_units(data: Mapping[str, Any], plant: Plant) -> None:
    """Refuse units other than those that servolens writes: a value in other units would be taken for SI."""
    for name, quantity in _quantities(data).items():
        stated, expected = quantity.get("unit"), plant.unit(name)
        if stated is not None and stated != expected:
            raise InputError(f"{name} is in {str(stated)[:40]!r}; models are kept in SI, here {expected!r}")


def _length_unit(data: Mapping[str, Any]) -> str:
    return "rad" if str(data["gain"].get("unit", "")).startswith("rad") else "m"


def _command_unit(data: Mapping[str, Any]) -> str:
    """Return the command's unit as the gain's tells it, such as "m/s^2/A"; volts where that tells none."""
    _, _, told = str(data["gain"].get("unit") or "").partition("/s^2/")
    told = told.removeprefix("(").removesuffix(")")
    return told if told in COMMAND_UNITS else "V"


def _covariance(data: Mapping[str, Any], plant: Plant) -> NDArray[np.float64] | None:
    """Return the covariance of all parameters, that of their standard errors alone where no more is stated."""
    alone, held = _of_errors(data, plant), data.get("covariance")
    if held is None:
        return alone
    names, numbers = part(data, "covariance", _named) if isinstance(held, dict) else (None, held)
    found = placed(plant, decoded(NDArray[np.float64], numbers, "covariance"), names, "covariance")
    if not _is_covariance(found):
        raise InputError("covariance must be symmetric and positive semidefinite; state standard errors alone instead")
    if alone is not None:
        _check_errors(plant, np.sqrt(np.diag(alone)), np.sqrt(np.diag(found)))
    return found


def _check_errors(plant: Plant, stated: NDArray[np.float64], held: NDArray[np.float64]) -> None:
    """Refuse standard errors that are not those of the covariance beside them: one of the two was changed."""
    for name, error, other in zip(plant.parameters, stated, held, strict=True):
        if np.isfinite(error) and not abs(error - other) <= ROUNDED * max(error, other):
            says = f"has {other:.3g}" if np.isfinite(other) else "does not know it"
            raise InputError(
                f"stderr of {name} is {error:.3g}, and the covariance {says}; change both, or leave out the covariance"
            )


def _check_intervals(data: Mapping[str, Any]) -> None:
    """Refuse an interval that ends below its beginning, and a value outside its own: one of the two was changed."""
    for name, quantity in _quantities(data).items():
        if quantity.get("interval") is None:
            continue
        low, high = decoded(tuple[float, float], quantity["interval"], f"interval of {name}")
        if low > high:
            raise InputError(
                f"interval of {name} is from {low:.6g} to {high:.6g}, its ends in the wrong order; begin with the lower"
            )
        value, slack = _value(quantity), ROUNDED * (high - low)
        if not low - slack <= value <= high + slack:
            raise InputError(
                f"{name} is {value:.6g}, outside its interval from {low:.6g} to {high:.6g}; where the value was changed"
                " by hand, leave out its interval and the covariance: they were the old one's"
            )


def _named(held: Mapping[str, Any]) -> tuple[tuple[str, ...], Any]:
    return decoded(tuple[str, ...], held["names"], "names of covariance"), held["matrix"]


def _is_covariance(matrix: NDArray[np.float64]) -> bool:
    """Tell whether errors can have a covariance, but for its rounding; what is not known (NaN) may be anything."""
    known = ~np.isnan(np.diag(matrix))
    spread = np.nan_to_num(matrix[np.ix_(known, known)], posinf=np.inf, neginf=np.inf)
    if not spread.size:
        return True
    if not np.isfinite(spread).all():
        return False
    size = np.sqrt(np.abs(np.diag(spread)))
    scale = np.where(size > 0.0, size, 1.0)
    correlation = spread / np.outer(scale, scale)
    is_symmetric = np.abs(correlation - correlation.T).max() <= SYMMETRIC
    return bool(is_symmetric and np.linalg.eigvalsh(correlation).min() >= -SYMMETRIC)


def _of_errors(data: Mapping[str, Any], plant: Plant) -> NDArray[np.float64] | None:
    """Return the covariance of parameters whose standard errors alone are stated; None where none is."""
    errors = {name: quantity.get("stderr") for name, quantity in _quantities(data).items()}
    if all(error is None for error in errors.values()):
        return None
    return np.diag([np.nan if (e := errors.get(name)) is None else _error(e, name) ** 2 for name in plant.parameters])


def _error(stated: Any, name: str) -> float:
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0.0 <= stated <= LARGEST:
        raise InputError(f"stderr of {name} must lie in [0, {LARGEST:g}], or be null; got {str(stated)[:40]!r}")
    return float(stated)


def _named_matrix(matrix: NDArray[np.float64], quantities: Mapping[str, Quantity], plant: Plant) -> dict[str, Any]:
    """Return the covariance with its names, without those of usual values, and why rows of it are null."""
    kept = [i for i, name in enumerate(plant.parameters) if name in quantities]
    rows = [[float(v) if np.isfinite(v) else None for v in row] for row in matrix[np.ix_(kept, kept)]]
    why = [f"{name}: {quantity.reason}" for name, quantity in quantities.items() if quantity.stderr is None]
    return {"names": list(quantities), "matrix": rows, **({"reason": "; ".join(why)} if why else {})}
