"""Plants with given effects, fitted to records beside the noise that these contain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from servolens.errors import InputError
from servolens.identification.candidates import Candidates
from servolens.identification.door import check_names
from servolens.identification.fit_findings import above_noise, findings_of
from servolens.identification.fitting import (
    check_loops,
    final_fit,
    level_of,
    likelihood_of,
    simulation_error,
)
from servolens.identification.options import FitOptions
from servolens.identification.refine import AT_NOISE, Refinement
from servolens.identification.segments import motion_segments, moving_parts
from servolens.identification.starting import Screen
from servolens.inputs import as_records
from servolens.model import Model
from servolens.plant import BASE_PARAMETERS, Plant
from servolens.processors import single_threaded_blas

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.effects import Effect
    from servolens.findings import Finding
    from servolens.identification.integral import Prior
    from servolens.identification.noise import NoiseModel
    from servolens.model import Quantity
    from servolens.record import Record

__all__ = ["EffectsFit", "fit_effects"]


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EffectsFit:
    """A fitted plant and how far it can be trusted.

    Attributes
    ----------
    model : Model
        Plant and covariance, the latter allowing for coloured residuals.
    refinement : Refinement
        Where the search ended: residuals, correlations, parameters of each record's own, status.
    driven : {"closed_loop", "voltage"}
        How the final runs were simulated: in closed loop, or driven by the voltage. An observer corrects the latter
        where ``noise_model.rate`` is not 0.
    noise_model : NoiseModel
        Of what was compared, as this plant leaves it.
    noise : float
        Standard deviation of the noise in what was compared: position [m or rad], or the command.
    findings : tuple of Finding
        A fit that does not reach the noise; parameters at a bound, not determined, or not to be told apart; a search
        that did not end.
    records : tuple of Record
        What was fitted.
    options : FitOptions
        How, with what the effects themselves hold.
    """

    model: Model
    refinement: Refinement
    driven: str
    noise_model: NoiseModel
    noise: float
    findings: tuple[Finding, ...]
    records: tuple[Record, ...]
    options: FitOptions

    @property
    def plant(self) -> Plant:
        """The best plant."""
        return self.model.plant

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Every parameter with its error, by qualified name."""
        return self.model.quantities

    @property
    def rms_error(self) -> float:
        """Root mean square of what was compared: position [m or rad], or the command where that was asked for."""
        return self.refinement.rms_error

    @property
    def at_noise(self) -> bool:
        """Whether the residual is explained by the noise."""
        return self.rms_error <= AT_NOISE * self.noise


@single_threaded_blas
def fit_effects(
    records: Record | Sequence[Record],
    effects: Sequence[Effect],
    *,
    priors: Mapping[str, Prior] | None = None,
    options: FitOptions | None = None,
) -> EffectsFit:
    """Fit gain, damping and the parameters of `effects` to `records`.

    The search begins at the values given, at those that the effects propose themselves, at the priors, and at several
    gains; parameters in which a force is linear are solved for in the integral equation. What is minimised are the
    prediction errors of an observer under the applied voltage, whitened: its rate, and the colour of the sensor's
    noise, are those that make the records likeliest. Error bars follow from the curvature there and allow for what
    colour is left. A model that does not reach the noise is fitted in closed loop instead, where that can be simulated:
    what it lacks moves the measured voltage as well.

    Parameters
    ----------
    records : Record or sequence of Record
        Runs of the same axis.
    effects : sequence of Effect
        What the plant contains, e.g. ``[CoulombFriction(level=1.0)]``, with values of the right order.
    priors : mapping of str to Prior, optional
        By qualified parameter name; those of `options` where it is None.
    options : FitOptions, optional
        What else is wanted.

    Raises
    ------
    InputError
        If there is no record or no motion, or a name in the options is no parameter.
    NumericalError
        If no start can be simulated on the records.

    Examples
    --------
    >>> from servolens.effects import CoulombFriction
    >>> from servolens.lab import Truth, step_record
    >>> cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    >>> fit = fit_effects(step_record(cart, kp=60), [CoulombFriction(level=1.0)])
    >>> round(fit.plant.effect("coulomb_friction").level, 2)
    0.3
    """
    runs = as_records(records)
    asked = options or FitOptions()
    if priors is not None:
        asked = replace(asked, priors=priors)
    plant = Plant(
        gain=1.0,
        damping=0.0,
        effects=tuple(effects),
        length_unit=runs[0].length_unit,
        command_unit=runs[0].command_unit,
    )
    check_names((*asked.priors, *asked.bounds, *asked.held, *asked.local), plant.parameters)
    _check_free(plant, asked)
    held = [f"{effect.name}.{name}" for effect in effects for name in effect.found_last]
    asked = replace(asked, held=tuple(dict.fromkeys([*asked.held, *held])))
    check_loops(runs, asked)
    screen = Screen.of(moving_parts(motion_segments(runs)))
    likelihood = likelihood_of(runs, screen.solve(())[0], asked)
    found = final_fit(likelihood, Candidates(plant, screen, likelihood, asked).found(), asked)
    refined, level = found.refinement, level_of(found.noise, runs, asked)
    return EffectsFit(
        model=Model(
            plant=refined.plant,
            covariance=refined.covariance,
            identified_from=tuple(record.name for record in runs),
            reasons=_reasons(refined, asked),
        ),
        refinement=refined,
        driven=found.driven,
        noise_model=found.noise,
        noise=level,
        findings=(*above_noise(simulation_error(found, asked), level), *findings_of(refined)),
        records=found.records,
        options=asked,
    )


def _check_free(plant: Plant, options: FitOptions) -> None:
    """Refuse to hold what no effect gives a value to, and to ask anything of what follows from other parameters."""
    for name in (*options.priors, *options.bounds, *options.held, *options.local):
        if name in plant.derived:
            raise InputError(f"{name} follows from other parameters of this model; ask it of those")
    for name in options.held:
        if name in [spec.name for spec in BASE_PARAMETERS]:
            raise InputError(f"{name} cannot be held, for no effect gives its value; give it a tight prior")


def _reasons(refined: Refinement, options: FitOptions) -> dict[str, str]:
    reasons = dict.fromkeys(refined.plant.parameters, "its error could not be estimated")
    reasons |= dict.fromkeys(refined.undetermined, "the data do not determine it")
    reasons |= dict.fromkeys(refined.at_bound, "it ended at the end of its range")
    reasons |= dict.fromkeys(refined.plant.derived, "it follows from other parameters")
    return reasons | dict.fromkeys(options.held, "given, not estimated")
