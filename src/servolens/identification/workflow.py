"""From records to models: constant, time-varying and speed-dependent damping."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Unpack, final

import numpy as np

from servolens.decoding import fields_of, findings_in
from servolens.errors import InputError, NumericalError, ServolensError, as_number, described, number_within
from servolens.findings import Finding
from servolens.identification.constant import fit_constant
from servolens.identification.damping_law import SHAPE, SIZE, law_from_pieces
from servolens.identification.data_range import data_range
from servolens.identification.fit_findings import FREE_DAMPING_UNKNOWN, LEAST_DAMPING
from servolens.identification.later import Later, known
from servolens.identification.model_error import model_error
from servolens.identification.options import FitOptions, wanted
from servolens.identification.piecewise import varying_residual
from servolens.identification.segments import motion_segments
from servolens.identification.stepped_voltage import are_steps_felt
from servolens.identification.varying import VaryingDamping, fit_varying
from servolens.identification.velocity import fit_velocity, law_left
from servolens.inputs import as_records
from servolens.model import UNDETERMINED, Model, Quantity
from servolens.model_evidence import Evidence
from servolens.plant import FREE_DAMPING, Plant
from servolens.prediction import RecordError, prediction_residual, record_error
from servolens.processors import single_threaded_blas
from servolens.quality.spikes import without_spikes
from servolens.result import Result
from servolens.rounded_voltage import with_exact_voltage

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from servolens.identification.noise import NoiseModel
    from servolens.identification.options import Bounds, Priors
    from servolens.identification.segments import Segment
    from servolens.identification.velocity import VelocityFit
    from servolens.inputs import Records, RecordSettings
    from servolens.record import Record

__all__ = ["Identification", "identify"]

ModelName = Literal["constant", "varying", "velocity", "all"]
Request = tuple[float | None, float | None, FitOptions]
"""Length of a piece, δ of eq. 18, and what is fixed or bounded."""
Judged = tuple["Mapping[str, tuple[RecordError, ...]]", tuple[Finding, ...]]
MOST_SAMPLES = 200_000
"""The errors of models are those of the first samples of a record, up to this many."""
BEYOND_THE_LAW = Finding(
    code="beyond_the_law",
    severity="note",
    message=(
        "this law does not explain the data to noise level: what it leaves depends on the inputs. Do not rely on these "
        "intervals; run `servolens diagnose`."
    ),
)


NOT_JUDGED: Later[Judged] = known(({}, ()))


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Identification(Result):
    """What the records say about the axis.

    Attributes
    ----------
    records : tuple of Record
        What was used; none where the identification was read from a file.
    constant, velocity : Model or None
        Constant damping; damping against speed (the law of eq. 20 in the integral equation, refined).
    varying : VaryingDamping or None
        Damping against time since the step.
    law_from_pieces : Plant or None
        The paper's own route to the law, eqs. 19–22: a start, shown for comparison.
    judged : Later
        Makes the errors and the findings.
    """

    kind: ClassVar[str] = "identification"

    records: tuple[Record, ...]
    constant: Model | None = None
    varying: VaryingDamping | None = None
    velocity: Model | None = None
    law_from_pieces: Plant | None = None
    judged: Later[Judged] = NOT_JUDGED

    @property
    def errors(self) -> Mapping[str, tuple[RecordError, ...]]:
        """Of each model, closed loop on each record; those of the time-varying model alone when first asked for."""
        return self.judged.value[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Warnings and notes; those beside the time-varying model alone when first asked for."""
        return self.judged.value[1]

    @property
    def model(self) -> Model:
        """The richest model with a plant, velocity, else constant, and how far its records reach.

        Raises
        ------
        InputError
            If only the time-varying model was asked for, which holds for its own step alone.
        """
        chosen = self._chosen
        if not self.records:
            return chosen
        error = model_error(chosen.plant, self.records)
        return replace(chosen, evidence=Evidence(range=data_range(self.records), model_error=error))

    @property
    def plant(self) -> Plant:
        """The plant of `model`."""
        return self._chosen.plant

    @property
    def gain_unit(self) -> str:
        """Of the gain, e.g. ``"m/s^2/V"``."""
        about = self.records[0] if self.records else self.plant
        one = Plant(gain=1.0, damping=0.0, length_unit=about.length_unit, command_unit=about.command_unit)
        return one.unit("gain")

    @property
    def _chosen(self) -> Model:
        chosen = self.velocity or self.constant
        if chosen is None:
            raise InputError("time-varying damping predicts no other step; identify 'constant' or 'velocity' as well")
        return chosen

    @property
    def names(self) -> tuple[str, ...]:
        """Of the records that were used."""
        told = next(iter(self.errors.values()), ())
        known = tuple(record.name for record in self.records) or tuple(error.name for error in told)
        return known or self._chosen.identified_from

    def to_json(self) -> dict[str, Any]:
        """Return the fields of ``servolens.identification/1`` without the file's header."""
        models: dict[str, Any] = {}
        for name in ("constant", "velocity"):
            model: Model | None = getattr(self, name)
            if model is not None:
                models[name] = {**model.to_json(), "fit": self._fit(name)}
        if self.varying is not None:
            models["varying"] = {**_varying_json(self.varying, self.gain_unit), "fit": self._fit("varying")}
        if self.law_from_pieces is not None:
            models["velocity"]["law_from_pieces"] = Model(plant=self.law_from_pieces).to_json()
        return {
            "models": models,
            "records": list(self.names),
        }

    @classmethod
    def _read(cls, data: Mapping[str, Any]) -> Identification:
        """Return the result; of the pieces' errors the correlations are not kept."""
        models = data.get("models")
        if not isinstance(models, dict):
            raise InputError("not an identification: 'models' is missing")
        constant, velocity = (Model.from_json(models[n]) if n in models else None for n in ("constant", "velocity"))
        pieces = (models.get("velocity") or {}).get("law_from_pieces")
        errors = {
            name: tuple(RecordError.from_json(one) for one in model["fit"]["records"])
            for name, model in models.items()
            if "records" in (model.get("fit") or {})
        }
        return cls(
            records=(),
            constant=constant,
            velocity=velocity,
            varying=_varying_from(models["varying"]) if "varying" in models else None,
            law_from_pieces=None if pieces is None else Model.from_json(pieces).plant,
            judged=known((errors, findings_in(data))),
        )

    def _fit(self, name: str) -> dict[str, Any]:
        errors = self.errors.get(name, ())
        if not errors:
            return {
                "mean_abs_error": None,
                "percent_error": None,
                "reason": "it could not be simulated; see the findings",
            }
        return {
            "mean_abs_error": float(np.mean([e.mean_abs_error for e in errors])),
            "percent_error": float(np.mean([e.percent_error for e in errors])),
            "records": [e.to_json() for e in errors],
        }


@single_threaded_blas
def identify(
    records: Records,
    *,
    model: ModelName = "all",
    delta: float | None = None,
    piece: float | None = None,
    fixed: Mapping[str, float] | None = None,
    bounds: Bounds | None = None,
    priors: Priors | None = None,
    **settings: Unpack[RecordSettings],
) -> Identification:
    """Identify the axis from measured steps by the integral method.

    Parameters
    ----------
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Runs of the same axis, in the same units.
    model : {"all", "constant", "varying", "velocity"}
        What to fit.
    delta : float, optional
        δ of eq. 18 [1/s] for the time-varying damping; unconstrained when None.
    piece : float, optional
        Length of its pieces [s]; half the smallest interval between velocity zeros when None.
    fixed : mapping of str to float, optional
        Values of parameters that are known: ``"gain"``, ``"damping"``, ``"velocity_decay_damping.alpha1"``,
        ``"velocity_decay_damping.alpha2"`` and, where the axis moves while its motor is off, ``"free_damping"``.
    bounds : mapping of str to (least, largest), optional
        Of the same parameters; that of damping, which is not negative, holds for each piece too.
    priors : mapping of str to Prior or (value, standard deviation), optional
        Data-sheet knowledge by parameter name, e.g. ``{"gain": (45.0, 2.0)}``; for the constant and the velocity model.
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        If the records hold no motion, mix units, or a prior names no parameter.
    NumericalError
        If the data do not determine the parameters.

    Examples
    --------
    >>> from servolens.lab import NLM3, step_record
    >>> fit = identify(step_record(NLM3, kp=100, encoder=1e-5, noise=1e-5, seed=1))
    >>> round(fit.velocity.plant.gain, 2)
    1.91
    """
    logged = tuple(map(without_spikes, as_records(records, settings)))
    _check(model, delta)
    piece = None if piece is None else number_within(piece, -np.inf, np.inf, "piece")
    options = wanted(fixed or {}, bounds, priors)
    _check_names(options, motion_segments(logged))
    runs = _as_applied(logged, options)
    segments = motion_segments(runs)
    if model == "varying":
        return _varying_alone(runs, segments, (piece, delta, options))
    constant = fit_constant(segments, options)
    left, told = constant.left, [*_reconstructed(runs), *constant.findings]
    law = fit_velocity(segments, options, constant.model.plant) if model != "constant" else None
    if law is not None:
        left = law.left
    result = Identification(records=runs, constant=None if model == "velocity" else constant.model)
    if model == "all":
        varying, findings = _varying_beside(segments, (piece, delta, options), left.noise)
        result, told = replace(result, varying=varying), [*told, *findings]
    if law is not None:
        result, told = _with_velocity(result, law), [*told, *law.findings]
    told += _undetermined(result)
    if not left.is_enough:
        told.append(BEYOND_THE_LAW)
    return replace(result, judged=known(_judged(result, told)))


def _as_applied(logged: tuple[Record, ...], options: FitOptions) -> tuple[Record, ...]:
    """Return the records with the voltage that moved the axis, as gain and damping have it, where it is in steps."""
    exact = tuple(map(with_exact_voltage, logged))
    if exact != logged:
        with suppress(NumericalError):  # where the data do not determine these, others may be asked for
            plant = fit_constant(motion_segments(exact), options).model.plant
            return logged if are_steps_felt(logged, exact, plant, options) else exact
    return exact


def _check(model: str, delta: float | None) -> None:
    if model not in ("all", "constant", "varying", "velocity"):
        raise InputError(f"model must be 'all', 'constant', 'varying' or 'velocity', got {model!r}")
    if delta is not None and not as_number(delta) >= 0:
        given = described(delta)
        raise InputError(
            f"delta must be a number of at least 0, got {given}; damping may fall by at most delta [1/s] a piece"
        )


def _check_names(options: FitOptions, segments: Sequence[Segment]) -> None:
    """Refuse what is asked of no parameter, and names without values."""
    options.check((*segments[0].plant(gain=1.0, damping=0.0).parameters, SIZE, SHAPE))
    if set(options.held) - set(options.values):
        raise InputError(f"fixed must give values, such as {{{options.held[0]!r}: 1.9}}: nothing else gives them here")


def _undetermined(result: Identification) -> list[Finding]:
    """Say that the free damping is not determined, where it is an unknown and a model says so."""
    models = [model for model in (result.constant, result.velocity) if model and FREE_DAMPING.name in model.quantities]
    if not any(model.quantities[FREE_DAMPING.name].reason == UNDETERMINED for model in models):
        return []
    return [Finding(code="not_determined", severity="note", message=FREE_DAMPING_UNKNOWN)]


def _varying_alone(runs: tuple[Record, ...], segments: Sequence[Segment], request: Request) -> Identification:
    """Return the time-varying model; the noise beside it, a hundred times the work, is looked for when asked for."""
    options = request[2]
    constant = Later(lambda: fit_constant(segments, options))
    left = Later(lambda: found if (found := constant.value.left).is_enough else law_left(segments, options))
    varying = _varying(segments, request, lambda: left.value.noise)
    result = Identification(records=runs, varying=varying)

    def judged() -> Judged:
        beyond = () if left.value.is_enough else (BEYOND_THE_LAW,)
        return _judged(result, (*_reconstructed(runs), *constant.value.findings, *_vague(varying), *beyond))

    return replace(result, judged=Later(judged))


def _varying_beside(
    segments: Sequence[Segment], request: Request, noise: NoiseModel
) -> tuple[VaryingDamping | None, tuple[Finding, ...]]:
    """Return the time-varying model and findings; it was not asked for by name, so that its failure is one of these."""
    try:
        varying = _varying(segments, request, lambda: noise)
    except ServolensError as error:
        if request[0] is not None or request[1] is not None:
            raise
        message = f"time-varying damping: {error}."
        return None, (Finding(code="varying_not_determined", severity="note", message=message),)
    return varying, _vague(varying)


def _varying(segments: Sequence[Segment], request: Request, noise: Callable[[], NoiseModel]) -> VaryingDamping:
    piece, delta, options = request
    within, gain = options.range_of("damping", low=0.0), options.range_of("gain")
    if "damping" in options.values:
        raise InputError("damping is fixed, so it cannot vary; leave it free, or bound it")
    return fit_varying(segments, duration=piece, delta=delta, bounds=within, gain=gain, noise=noise)


def _vague(varying: VaryingDamping) -> tuple[Finding, ...]:
    errors = np.sqrt(np.diag(varying.covariance)[:-1])
    vague = int(np.sum(~(errors < np.maximum(varying.damping, LEAST_DAMPING))))
    if not vague:
        return ()
    message = f"time-varying damping: the data hardly determine {vague} of its {errors.size} pieces."
    return (Finding(code="pieces_not_determined", severity="note", message=message),)


def _with_velocity(result: Identification, law: VelocityFit) -> Identification:
    """Add the damping law, and what the paper's own route would make of it."""
    try:
        pieces = result.varying or fit_varying(law.segments)
        by_pieces = _in_units(result.records, law_from_pieces(pieces))
    except (InputError, NumericalError):
        by_pieces = None
    velocity = replace(law.model, plant=_in_units(result.records, law.model.plant))
    return replace(result, velocity=velocity, law_from_pieces=by_pieces)


def _judged(result: Identification, told: Sequence[Finding]) -> Judged:
    """Return the errors of the models, and what was `told` with what is to be said of these."""
    residuals: dict[str, Callable[[Record], NDArray[np.float64]]] = {}
    for name in ("constant", "velocity"):
        model: Model | None = getattr(result, name)
        if model is not None:
            residuals[name] = partial(prediction_residual, model.plant)
    if result.varying is not None:
        residuals["varying"] = partial(varying_residual, result.varying)
    shown, findings = _beginnings(result.records)
    errors = {}
    for name, residual in residuals.items():
        try:
            errors[name] = tuple(record_error(record, residual(record)) for record in shown)
        except NumericalError as error:
            findings.append(Finding(code="not_simulated", severity="warning", message=f"{name} model: {error}."))
    return errors, (*told, *findings)


def _beginnings(runs: tuple[Record, ...]) -> tuple[list[Record], list[Finding]]:
    """Return what of each record the models are compared with."""
    shown, findings = [], []
    for run in runs:
        if len(run) > MOST_SAMPLES:
            end = float(run.time[MOST_SAMPLES - 1])
            message = f"the errors are those of its first {end - run.time[0]:.4g} s, of {run.duration:.4g} s."
            findings.append(Finding(code="not_all_data_used", severity="note", message=message, record=run.name))
            run = run.slice(float(run.time[0]), end)
        shown.append(run)
    return shown, findings


def _in_units(runs: tuple[Record, ...], plant: Plant) -> Plant:
    return replace(plant, length_unit=runs[0].length_unit, command_unit=runs[0].command_unit)


def _reconstructed(runs: tuple[Record, ...]) -> tuple[Finding, ...]:
    return tuple(
        Finding(
            code="voltage_reconstructed",
            severity="note",
            message="no voltage is logged; it was computed from reference, position and the controller's gains.",
            record=run.name,
        )
        for run in runs
        if run.voltage is None
    )


def _varying_json(varying: VaryingDamping, gain_unit: str) -> dict[str, Any]:
    errors = np.sqrt(np.maximum(np.diag(varying.covariance), 0.0))
    pieces = [
        Quantity(value=float(c), stderr=float(e), unit="1/s") for c, e in zip(varying.damping, errors, strict=False)
    ]
    return {
        "gain": Quantity(value=varying.gain, stderr=float(errors[-1]), unit=gain_unit).to_json(),
        "edges": varying.edges.tolist(),
        "damping": varying.damping.tolist(),
        "pieces": [q.to_json() for q in pieces],
        "speed": varying.speed.tolist(),
        "active": list(varying.active),
        **({} if varying.inertia is None else {"inertia": varying.inertia}),
    }


def _varying_from(data: Mapping[str, Any]) -> VaryingDamping:
    gain = Quantity.from_json(data.get("gain") or {})
    pieces = [Quantity.from_json(one) for one in data.get("pieces") or ()]
    errors = [np.nan if one.stderr is None else one.stderr for one in (*pieces, gain)]
    names = ("gain", "edges", "damping", "speed", "active", "inertia")
    fields = fields_of(VaryingDamping, {**data, "gain": gain.value}, names)
    return VaryingDamping(**fields, spread=known(np.diag(np.square(errors))))
