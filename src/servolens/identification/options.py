"""What is wanted of a fit: what is fixed, bounded or known, and how runs are simulated and compared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final, get_args

import numpy as np

from servolens.errors import InputError, as_number, by_name, described, mapped, names_like
from servolens.plant import FREE_DAMPING

__all__ = [
    "NO_FREE_DAMPING",
    "Begin",
    "Bounds",
    "Compared",
    "Driven",
    "FitOptions",
    "Fixed",
    "Loss",
    "Prior",
    "Priors",
    "as_priors",
    "wanted",
]


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Knowledge from elsewhere, e.g. a data sheet: `value` with standard deviation `deviation`, SI."""

    value: float
    deviation: float

    def __post_init__(self) -> None:
        value, deviation = as_number(self.value), as_number(self.deviation)
        if not (np.isfinite(value) and np.isfinite(deviation) and deviation > 0):
            given = f"{described(self.value)} and {described(self.deviation)}"
            raise InputError(f"a prior needs a finite value and a positive standard deviation, got {given}")
        object.__setattr__(self, "value", value)
        object.__setattr__(self, "deviation", deviation)


Loss = Literal["squares", "huber"]
Driven = Literal["auto", "closed_loop", "voltage"]
Compared = Literal["position", "voltage"]
Begin = Literal["rest", "motion"]
CHOICES = {"loss": Loss, "driven": Driven, "compared": Compared, "begin": Begin}
Fixed = str | Sequence[str] | Mapping[str, float]
"""Names of parameters that stay as they are, or names with their values."""
Bounds = Mapping[str, tuple[float | None, float | None]]
"""Least and largest value by name; None for no bound."""
Priors = Mapping[str, Prior | tuple[float, float]]
"""Value and standard deviation by name."""
NO_FREE_DAMPING = (
    f"{FREE_DAMPING.name} is the damping while the motor is off, and in none of the records that are fitted does the"
    " axis move while `enabled` is 0; leave it out, or add such a record"
)
"""Why nothing can be asked of it."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """How a plant is fitted, checked and in one form.

    Parameters
    ----------
    held : tuple of str
        Qualified names of parameters that stay as given.
    values : mapping of str to float
        Of parameters that are held, where no plant gives them.
    local : tuple of str
        Parameters that each record has of its own, e.g. ``"periodic_disturbance.phase"``.
    priors : mapping of str to Prior
        Knowledge from elsewhere, by qualified name.
    bounds : mapping of str to tuple of float
        Least and largest value of parameters, by qualified name, within what their effects admit.
    loss : {"squares", "huber"}
        Whether outliers count as squares or linearly.
    driven : {"auto", "closed_loop", "voltage"}
        Whether the runs are simulated in closed loop from the reference, or driven by the voltage; ``"auto"`` begins
        in closed loop where it can, but for contacts, and lets the voltage have the last word where the model then
        reaches the noise.
    compared : {"position", "voltage"}
        What of a closed loop is compared. A stiff loop hides in its position what its voltage shows; with ``"voltage"``
        all runs are simulated in closed loop.
    begin : {"rest", "motion"}
        Whether the records begin at rest; where the logged voltage drives them, but for what a loop that already works
        makes of the sensor's noise. With ``"motion"`` each record's initial position and velocity are free, and the
        controller's memory of the time before is read off the logged voltage.

    Raises
    ------
    InputError
        If a choice is none of these, choices do not go together, or a bound is no range.
    """

    held: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    local: tuple[str, ...] = ()
    priors: Mapping[str, Prior] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    loss: Loss = "squares"
    driven: Driven = "auto"
    compared: Compared = "position"
    begin: Begin = "rest"

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value, known = getattr(self, name), get_args(choices)
            if value not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}; got {value!r}")
        for name, (low, high) in self.bounds.items():
            if not low < high:
                raise InputError(f"the bounds of {name} must be a least and a larger value; got {low} and {high}")
        if self.compared == "voltage" and self.driven == "voltage":
            raise InputError(
                "a run that is driven by the voltage cannot be compared by it; choose driven='closed_loop'"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Every parameter that something is asked of."""
        return tuple(dict.fromkeys((*self.held, *self.local, *self.priors, *self.bounds)))

    def check(self, parameters: Iterable[str]) -> None:
        """Refuse what is asked of no parameter of the model.

        Raises
        ------
        InputError
            With the names that are.
        """
        known = list(parameters)
        for name in self.names:
            if name not in known:
                if name == FREE_DAMPING.name:
                    raise InputError(NO_FREE_DAMPING)
                raise InputError(f"{name[:40]!r} is no parameter of this model; {names_like(name, known, 'those are')}")

    def of(self, parameters: Iterable[str]) -> FitOptions:
        """Return the options without what is asked of other parameters than these."""
        names = set(parameters)
        return replace(
            self,
            held=tuple(name for name in self.held if name in names),
            values={name: value for name, value in self.values.items() if name in names},
            local=tuple(name for name in self.local if name in names),
            priors={name: prior for name, prior in self.priors.items() if name in names},
            bounds={name: bound for name, bound in self.bounds.items() if name in names},
        )

    def holding(self, *names: str) -> FitOptions:
        """Return the options with further parameters held."""
        return replace(self, held=tuple(dict.fromkeys([*self.held, *names])))

    def range_of(self, name: str, low: float = -np.inf, high: float = np.inf) -> tuple[float, float]:
        """Return where a parameter may lie: its fixed value, or its bounds within `low` and `high`."""
        if name in self.values:
            return self.values[name], self.values[name]
        least, most = self.bounds.get(name, (-np.inf, np.inf))
        return max(low, least), min(high, most)


def wanted(fixed: Fixed, bounds: Bounds | None, priors: Priors | None, **choices: Any) -> FitOptions:
    """Return what public functions were asked for as options.

    Raises
    ------
    InputError
        If something is not of the form that it must have.
    """
    fixed = mapped(fixed)
    held = _names("fixed", fixed)
    values = {name: _number(name, value) for name, value in fixed.items()} if isinstance(fixed, Mapping) else {}
    return FitOptions(
        held=held,
        values=values,
        local=_names("local", choices.pop("local", ())),
        bounds={name: _bounds(name, bound) for name, bound in by_name("bounds", bounds, {"gain": (1.0, 3.0)}).items()},
        priors=as_priors(priors),
        **choices,
    )


def as_priors(priors: Priors | None) -> dict[str, Prior]:
    """Return priors by name, of values with their standard deviations too."""
    return {name: _prior(name, prior) for name, prior in by_name("priors", priors, {"gain": (1.9, 0.1)}).items()}


def _names(what: str, given: Any) -> tuple[str, ...]:
    """Return the parameters that are named one by one, together, or as the keys of a mapping; None names none."""
    names = (given,) if isinstance(given, str) else tuple(given) if isinstance(given, Iterable) else given or ()
    if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{what} must name parameters, such as 'damping'; got {described(given)}")
    return names


def _number(name: str, value: Any) -> float:
    number = as_number(value)
    if not np.isfinite(number):
        raise InputError(f"{name} must be fixed at a finite number, got {described(value)}")
    return number


def _bounds(name: str, bound: Any) -> tuple[float, float]:
    low, high = _pair(bound, f"the bounds of {name} must be a least and a larger value, such as (1.0, 3.0)", None)
    return (-np.inf if low is None else low), (np.inf if high is None else high)


def _prior(name: str, prior: Any) -> Prior:
    if isinstance(prior, Prior):
        return prior
    wanted = f"the prior on {name} must be a value and its standard deviation, such as (1.9, 0.1)"
    value, deviation = _pair(prior, wanted)
    return Prior(value=value, deviation=deviation)


def _pair(given: Any, wanted: str, *others: Any) -> Any:
    """Return the two numbers that are `given`, of which each may be one of the `others` instead; else say `wanted`."""
    pair = () if isinstance(given, str | Set | Mapping) or not isinstance(given, Iterable) else tuple(given)
    found = [one if any(one is other for other in others) else as_number(one) for one in pair]
    if len(found) != 2 or any(one is not None and np.isnan(one) for one in found):
        raise InputError(f"{wanted}; got {described(given)}")
    return found
