"""A plant, or the effects that it contains, fitted to records beside the noise that these contain."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Unpack, final

import numpy as np

from servolens.decoding import decoded, encoded, fields_of, findings_in, read_fields
from servolens.effects import Effect
from servolens.errors import InputError
from servolens.identification.candidates import Candidates
from servolens.identification.fit_findings import above_noise, findings_of
from servolens.identification.fitted import model_of
from servolens.identification.fitting import check_loops, final_fit, level_of, likelihood_of, simulation_error
from servolens.identification.late_inputs import about
from servolens.identification.noise import NoiseModel
from servolens.identification.options import FitOptions, Prior, wanted
from servolens.identification.refine import AT_NOISE, Refinement
from servolens.identification.segments import motion_segments, moving_parts
from servolens.identification.starting import Screen
from servolens.identification.stepped_voltage import are_steps_felt
from servolens.inputs import as_effects, as_plant, as_records, check_units, is_model
from servolens.model import Model, placed
from servolens.plant import FREE_DAMPING, Plant
from servolens.processors import single_threaded_blas
from servolens.quality.spikes import without_spikes
from servolens.result import Result
from servolens.rounded_voltage import with_exact_voltage

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.findings import Finding
    from servolens.identification.options import Begin, Bounds, Compared, Driven, Fixed, Loss, Priors
    from servolens.inputs import Effects, Plants, Records, RecordSettings
    from servolens.model import Quantity
    from servolens.record import Record

__all__ = ["Fit", "fit"]

SUMMED_UP = (
    "correlation", "colour", "local", "at_bound", "undetermined", "rms_error", "misfit", "weights", "variance",
    "converged", "is_smooth", "status",
)  # fmt: skip
"""What the file of a fit keeps of its search; plant and covariance are the model's."""
OF_PARAMETERS = ("correlation", "colour")
"""What of it has a place for each of the parameters that the file names beside it."""


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Fit(Result):
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
        What was fitted; none where the fit was read from a file.
    options : FitOptions
        How, with what the effects themselves hold.
    """

    kind: ClassVar[str] = "fit"

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

    @property
    def correlations(self) -> dict[tuple[str, str], float]:
        """Correlation of every two estimates, those that are most alike first."""
        names, matrix = list(self.plant.parameters), self.refinement.correlation
        found = {(a, b): float(matrix[i, j]) for i, a in enumerate(names) for j, b in enumerate(names) if i < j}
        known = {pair: value for pair, value in found.items() if np.isfinite(value)}
        return dict(sorted(known.items(), key=lambda item: -abs(item[1])))

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.fit/1`` without the file's header: all but records and residuals."""
        return {
            "model": self.model.to_json(),
            "driven": self.driven,
            "noise": self.noise,
            "rms_error": self.rms_error,
            "at_noise": self.at_noise,
            "noise_model": encoded(replace(self.noise_model, pushed=None)),  # which the model tells
            "refinement": {
                "parameters": list(self.plant.parameters),
                **{name: encoded(getattr(self.refinement, name)) for name in SUMMED_UP},
            },
            "options": encoded(self.options),
        }

    @classmethod
    def _read(cls, data: Mapping[str, Any]) -> Fit:
        model = Model.from_json(data.get("model") or {})
        size = len(model.plant.values)
        covariance = np.full((size, size), np.nan) if model.covariance is None else model.covariance
        known = {"Prior": Prior, "Plant": Plant}
        told = data.get("refinement") or {}
        ended = fields_of(Refinement, told, SUMMED_UP)
        names = decoded(tuple[str, ...] | None, told.get("parameters"), "parameters")
        ended |= {name: placed(model.plant, ended[name], names, name) for name in OF_PARAMETERS}
        noise = read_fields(NoiseModel, data.get("noise_model"), known)
        return cls(
            model=model,
            refinement=Refinement(plant=model.plant, covariance=covariance, residuals=(), starts=(), **ended),
            driven=str(data.get("driven")),
            noise_model=replace(noise, pushed=about(noise, model.plant).pushed),
            noise=decoded(float, data.get("noise"), "noise"),
            findings=findings_in(data),
            records=(),
            options=read_fields(FitOptions, data.get("options"), known),
        )


@single_threaded_blas
def fit(  # noqa: PLR0913 - what may be asked of a fit, all by keyword
    plant: Plants | Effects,
    records: Records,
    *,
    fixed: Fixed = (),
    bounds: Bounds | None = None,
    priors: Priors | None = None,
    driven: Driven = "auto",
    local: Sequence[str] = (),
    loss: Loss = "squares",
    compared: Compared = "position",
    begin: Begin = "rest",
    **settings: Unpack[RecordSettings],
) -> Fit:
    """Fit gain, damping and the parameters of effects to `records`.

    The search begins at the values given, at those that the effects propose themselves, at the priors, and at several
    gains; parameters in which a force is linear are solved for in the integral equation. What is minimised are the
    prediction errors of an observer under the applied voltage, whitened: its rate, and the colour of the sensor's
    noise, are those that make the records likeliest. Error bars follow from the curvature there and allow for what
    colour is left; in closed loop beside noise alone, for what the loop makes of that noise. A model that does not
    reach the noise is fitted in closed loop instead, where that can be simulated: what it lacks moves the measured
    voltage as well.

    Parameters
    ----------
    plant : Plant, model, fit, path of a model's file, or effects
        What is fitted. Effects, one or several, are instances with values of the right order, e.g.
        ``CoulombFriction(level=1.0)``, or classes or names, whose values are then guessed from the records.
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Runs of the same axis.
    fixed : name, sequence of names, or mapping of names to values
        Parameters that are not fitted: gain, damping, ``"effect.parameter"``.
    bounds : mapping of str to (least, largest), optional
        Within what the effects admit; None for no bound.
    priors : mapping of str to Prior or (value, standard deviation), optional
        Knowledge from elsewhere, e.g. a data sheet.
    driven : {"auto", "closed_loop", "voltage"}
        Whether runs are simulated in closed loop from the reference, or driven by the voltage. ``"auto"`` takes the
        closed loop where a model does not reach the noise.
    local : name or sequence of names
        Parameters that each record has of its own, e.g. ``"periodic_disturbance.phase"``.
    loss : {"squares", "huber"}
        Whether outliers count as squares or linearly.
    compared : {"position", "voltage"}
        What of a closed loop is compared. A stiff loop hides in its position what its voltage shows.
    begin : {"rest", "motion"}
        Whether the records begin at rest; with ``"motion"`` initial position and velocity of each are free.
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

    Raises
    ------
    InputError
        If there is no record or no motion, something named is no parameter, or choices do not go together.
    NumericalError
        If no start can be simulated on the records.

    Examples
    --------
    >>> from servolens.lab import Truth, step_record
    >>> cart = Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    >>> found = fit("coulomb_friction", step_record(cart, kp=60))
    >>> round(found.plant.effect("coulomb_friction").level, 2)
    0.3
    """
    asked = wanted(fixed, bounds, priors, driven=driven, local=local, loss=loss, compared=compared, begin=begin)
    effects, start = _given(plant)
    logged = tuple(map(without_spikes, as_records(records, settings)))
    exact = tuple(map(with_exact_voltage, logged))
    found = _fitted(effects, start, exact, asked)
    is_as_logged = are_steps_felt(logged, exact, found.plant, found.options)
    return _fitted(effects, start, logged, asked) if is_as_logged else found


def _fitted(
    effects: Sequence[Effect | type[Effect]], start: Plant | None, runs: tuple[Record, ...], asked: FitOptions
) -> Fit:
    """Return the plant, or these effects, fitted as asked."""
    screen = Screen.of(moving_parts(motion_segments(runs)))
    bare, _ = screen.solve(())
    start = _guessed(effects, bare, screen, asked) if start is None else _as_records_tell(start, bare)
    _check(start, asked, runs[0])
    held = [f"{effect.name}.{name}" for effect in start.effects for name in effect.found_last]
    held += [FREE_DAMPING.name] if bare.free_damping is None else []  # no record shows it
    start, asked = start.with_named(asked.values), asked.holding(*held)
    check_loops(runs, asked)
    likelihood = likelihood_of(runs, bare, asked)
    found = final_fit(likelihood, Candidates(start, screen, likelihood, asked).found(), asked)
    refined, level = found.refinement, level_of(found, runs, asked)
    return Fit(
        model=model_of(refined, runs, asked.held),
        refinement=refined,
        driven=found.driven,
        noise_model=found.noise,
        noise=level,
        findings=(*above_noise(simulation_error(found, asked), level), *findings_of(refined)),
        records=found.records,
        options=asked,
    )


def _given(source: Any) -> tuple[tuple[Effect | type[Effect], ...], Plant | None]:
    """Return the effects that were given, or a whole plant."""
    if is_model(source) or isinstance(source, os.PathLike):
        return (), as_plant(source)
    return as_effects(source), None


def _guessed(effects: Sequence[Effect | type[Effect]], bare: Plant, screen: Screen, options: FitOptions) -> Plant:
    """Return a plant with the effects, of classes with what they propose, and gain and damping of the records."""
    for name in bare.parameters:
        if name in options.held and name not in options.values:
            raise InputError(f"{name} has no value to be fixed at; write fixed={{'{name}': value}}, or give a Plant")
    made = [one if isinstance(one, Effect) else screen.proposals_of(bare, one)[0] for one in effects]
    for one in effects:
        if isinstance(one, type):
            for spec in one.parameters():
                name = f"{one.name}.{spec.name}"
                if name in options.held and name not in options.values:
                    raise InputError(f"{name} has no value to be fixed at; write fixed={{'{name}': value}}")
    return screen.segments[0].plant(bare.gain, max(bare.damping, 0.0), made)


def _as_records_tell(start: Plant, bare: Plant) -> Plant:
    """Return `start` for the records' own inertia, as an estimate is, and with a free damping where they show one."""
    if start.inertia is None:
        start = replace(start, inertia=bare.inertia)
    if start.free_damping is None and bare.free_damping is not None:
        start = replace(start, free_damping=start.damping)
    return start


def _check(plant: Plant, options: FitOptions, record: Record) -> None:
    """Refuse what is asked of no parameter, of what follows from others, or in other units than the records'."""
    options.check(plant.parameters)
    for name in options.names:
        if name in plant.derived:
            raise InputError(f"{name} follows from other parameters of this model; ask it of those")
        if name in plant.usual and name not in options.held:
            raise InputError(
                f"{name} has its usual value, and is not fitted from there; give the effect with another one"
            )
    for name, (low, high) in options.bounds.items():
        spec = plant.parameters[name]
        if high < spec.low or low > spec.high:
            raise InputError(
                f"the bounds of {name}, {low:g} to {high:g}, admit no value: it lies in [{spec.low:g}, {spec.high:g}]"
            )
    check_units(plant, record)
