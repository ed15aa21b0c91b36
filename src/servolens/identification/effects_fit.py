"""Plants with given effects: their sizes as columns of the integral equation, then refined by simulation."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.door import check_names, together
from servolens.identification.doubts import doubts
from servolens.identification.options import FitOptions
from servolens.identification.refine import AT_NOISE, DOWN_TO_NOISE, Refinement, error_of, lead, minimise_error
from servolens.identification.regressors import regressor
from servolens.identification.runs import closed_runs, voltage_runs
from servolens.identification.segments import motion_segments, noise_level, white_noise
from servolens.identification.starting import Screen
from servolens.model import Model
from servolens.plant import BASE_PARAMETERS, Plant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.effects import Effect
    from servolens.findings import Finding
    from servolens.identification.integral import Prior
    from servolens.identification.runs import Run
    from servolens.model import Quantity
    from servolens.record import Record

__all__ = ["EffectsFit", "fit_effects", "fit_runs", "last_word"]

STARTS, SHORT = 3, 6
"""Starts of each effect that are tried by simulation, and with how many iterations."""
NEAR = 20.0
"""Times the noise from which on a start is refined only if no other leads further: it may be in the wrong valley."""
MOST_TRIED = 16_000
"""Samples on which starts are tried."""


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
    driven : {"closed_loop", "voltage", "stretches"}
        How the final runs were simulated: in closed loop, driven by the voltage from the record's beginning, or so in
        stretches of motion with initial states of their own.
    noise : float
        Standard deviation of the noise in what was compared: position [m or rad], or the command.
    findings : tuple of Finding
        Parameters at a bound, not determined, or not to be told apart; a search that did not end.
    records : tuple of Record
        What was fitted.
    options : FitOptions
        How.
    """

    model: Model
    refinement: Refinement
    driven: str
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


def fit_effects(
    records: Record | Sequence[Record],
    effects: Sequence[Effect],
    *,
    priors: Mapping[str, Prior] | None = None,
    options: FitOptions | None = None,
) -> EffectsFit:
    """Fit gain, damping and the parameters of `effects` to `records`.

    Each effect starts from the values given and from those it proposes itself; parameters in which a force is linear
    are solved for in the integral equation. The best starts are refined, in closed loop where reference and gains are
    known, else driven by the logged voltage. Where the model reaches the noise the voltage has the last word, for it
    contains what the controller made of the noise; with contacts, which rattle in closed loop, it has the first.

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
    runs = together(records)
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
    check_names((*asked.priors, *asked.held, *asked.local), plant.parameters)
    _check_free(plant, asked)
    trial = _Trial.of(runs, asked)
    joint, least = _all_at_once(plant, trial)
    fit = last_word(joint, runs, asked) if least <= NEAR * trial.noise or not effects else None
    if fit is not None and (not effects or fit.rms_error <= DOWN_TO_NOISE * fit.noise):
        return fit
    one_by_one, error = _one_by_one(plant, trial)
    if error >= (least if fit is None else min(least, error_of(fit.plant, trial.runs))):
        return fit or last_word(joint, runs, asked)
    other = last_word(one_by_one, runs, asked)
    return other if fit is None or _better(other, fit) else fit


def _check_free(plant: Plant, options: FitOptions) -> None:
    """Refuse to hold what no effect gives a value to, and to ask anything of what follows from other parameters."""
    for name in (*options.priors, *options.held, *options.local):
        if name in plant.derived:
            raise InputError(f"{name} follows from other parameters of this model; ask it of those")
    for name in options.held:
        if name in [spec.name for spec in BASE_PARAMETERS]:
            raise InputError(f"{name} cannot be held, for no effect gives its value; give it a tight prior")


def _noise(records: Sequence[Record], options: FitOptions) -> float:
    """Return the standard deviation of the noise in what is compared."""
    if options.compared == "voltage":
        return max((white_noise(r.voltage) for r in records if r.voltage is not None), default=0.0)
    return max(noise_level(record) for record in records)


def fit_runs(records: Sequence[Record], driven: str, options: FitOptions) -> list[Run]:
    """Return the runs to which a plant is fitted: ``"closed_loop"``, ``"voltage"`` or ``"stretches"``."""
    if driven == "closed_loop":
        return [*closed_runs(records, options)]
    return [*voltage_runs(records, stretches=driven == "stretches")]


def last_word(start: Plant, records: tuple[Record, ...], options: FitOptions) -> EffectsFit:
    """Refine `start`, in closed loop where that can be, and by the voltage where that reaches the noise."""
    noise = _noise(records, options)
    driven: str = first_choice(records, options)
    if options.driven == "auto" and driven == "closed_loop" and options.compared == "position":
        refined, driven = _either_way(start, records, options, noise)
    else:
        refined = _refined(start, records, options, driven, noise)
    return EffectsFit(
        model=Model(
            plant=refined.plant,
            covariance=refined.covariance,
            identified_from=tuple(record.name for record in records),
            reasons=_reasons(refined, options),
        ),
        refinement=refined,
        driven=driven,
        noise=noise,
        findings=doubts(refined),
        records=records,
        options=options,
    )


def first_choice(records: Sequence[Record], options: FitOptions) -> Literal["closed_loop", "voltage"]:
    """Return how the runs are simulated at first.

    Raises
    ------
    InputError
        If a closed loop is asked for and a record has no reference or no gains.
    """
    lacking = [record.name for record in records if record.reference is None or record.controller is None]
    if (options.driven == "closed_loop" or options.compared == "voltage") and lacking:
        raise InputError(f"{lacking[0]}: closing the loop needs reference, kp and kd")
    return "voltage" if lacking or options.driven == "voltage" else "closed_loop"


def _either_way(start: Plant, records: tuple[Record, ...], options: FitOptions, noise: float) -> tuple[Refinement, str]:
    """Return the refinement in closed loop, or driven by the voltage where that reaches the noise, and which it is.

    Contacts crumple the error in closed loop most, or rattle there so that nothing can be followed: with them the
    voltage comes first. Stretches follow the data closer than whole records in any case: they count only if they alone
    get down to the noise.
    """
    first = None
    if start.has_contacts:
        with suppress(InputError, NumericalError):
            first = _refined(start, records, options, "voltage", noise)
            if first.rms_error <= DOWN_TO_NOISE * noise:
                return first, "voltage"
    try:
        best, driven = _refined(start, records, options, "closed_loop", noise), "closed_loop"
    except NumericalError:
        if first is None and start.has_contacts:
            raise
        return first or _refined(start, records, options, "voltage", noise), "voltage"
    for way, enough in (("voltage", AT_NOISE), ("stretches", DOWN_TO_NOISE)):
        with suppress(InputError, NumericalError):
            found = _refined(best.plant, records, options, way, noise)
            if way == "voltage" and first is not None and first.rms_error < found.rms_error:
                found = first
            if found.rms_error <= enough * noise:
                best, driven = found, way
        if best.rms_error <= DOWN_TO_NOISE * noise:
            break
    return best, driven


def _refined(start: Plant, records: tuple[Record, ...], options: FitOptions, driven: str, noise: float) -> Refinement:
    """Refine; once more with coarse sensitivities where that does not reach the noise, or with contacts."""
    runs = fit_runs(records, driven, options)
    return minimise_error(start, runs, options, noise=noise, coarse=True, valleys=driven != "closed_loop")


def _better(fit: EffectsFit, other: EffectsFit) -> bool:
    """Tell whether `fit` explains the data better; one that reaches the noise driven by the voltage always does."""
    at_noise = (fit.driven != "closed_loop", other.driven != "closed_loop")
    return fit.rms_error < other.rms_error if at_noise[0] == at_noise[1] else at_noise[0]


def _all_at_once(wanted: Plant, trial: _Trial) -> tuple[Plant, float]:
    """Return where the plant with all effects as given leads, and the error there."""
    bare, _ = trial.screen.solve(())
    given = replace(wanted, gain=bare.gain, damping=max(bare.damping, 0.0))
    return trial.led_furthest(given, [given, *_solved(given, trial.screen)])


def _one_by_one(wanted: Plant, trial: _Trial) -> tuple[Plant, float]:
    """Return where the plant leads if its effects take their best starts one after the other.

    The first ones were chosen beside less than all: where that falls short, each is chosen anew beside all others.
    """
    bare, _ = trial.screen.solve(())
    plant = replace(wanted, gain=bare.gain, damping=max(bare.damping, 0.0), effects=())
    error = np.inf
    for effect in wanted.effects:
        plant, error = _added(plant, effect, trial)
    if len(wanted.effects) > 1:
        for effect in plant.effects:
            if error <= AT_NOISE * trial.noise:
                break
            again, less = _added(plant, plant.effect(effect.name) or effect, trial)
            if less < error:
                plant, error = again, less
    order = [effect.name for effect in wanted.effects]
    return replace(plant, effects=tuple(sorted(plant.effects, key=lambda effect: order.index(effect.name)))), error


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """What starts are tried on: part of the data, a few steps of refinement."""

    records: tuple[Record, ...]
    runs: Sequence[Run]
    screen: Screen
    options: FitOptions
    noise: float

    @classmethod
    def of(cls, records: tuple[Record, ...], options: FitOptions) -> _Trial:
        part = _excerpt(records)
        return cls(
            records=part,
            runs=fit_runs(part, first_choice(part, options), options),
            screen=Screen.of(motion_segments(records)),
            options=options,
            noise=_noise(records, options),
        )

    def led_furthest(self, given: Plant, starts: Sequence[Plant], *, coarse: bool = False) -> tuple[Plant, float]:
        """Return where a few steps lead furthest, and the error there; parameters that are held stay as in `given`."""
        best, least = given, np.inf
        for start in starts:
            try:
                found, error, _ = lead(
                    self._held(start, given),
                    self.runs,
                    self._known(given),
                    noise=self.noise,
                    iterations=SHORT,
                    coarse=coarse,
                )
            except (InputError, NumericalError):
                continue
            if error < least:
                best, least = found, error
            if least <= self.noise:
                break
        return best, least

    def _known(self, plant: Plant) -> FitOptions:
        """Return the options as far as they are about `plant`."""
        names = plant.parameters
        held = tuple(name for name in self.options.held if name in names)
        priors = {name: prior for name, prior in self.options.priors.items() if name in names}
        return replace(self.options, held=held, local=(), priors=priors)

    def _held(self, start: Plant, given: Plant) -> Plant:
        names = list(given.parameters)
        values = list(start.values)
        for i, name in enumerate(names):
            if name in self.options.held:
                values[i] = given.values[i]
        return start.with_values(values)


def _excerpt(records: tuple[Record, ...]) -> tuple[Record, ...]:
    """Return the beginnings of long records: enough to tell a good start from a bad one."""
    most = max(MOST_TRIED // len(records), 2)
    return tuple(r if len(r) <= most else r.slice(float(r.time[0]), float(r.time[most - 1])) for r in records)


def _added(plant: Plant, effect: Effect, trial: _Trial) -> tuple[Plant, float]:
    """Return `plant` with `effect` at the start from which a few steps of refinement lead furthest."""
    smooth = bool(regressor(type(effect)).sizes)
    return trial.led_furthest(plant.with_effect(effect), _candidates(plant, effect, trial), coarse=not smooth)


def _candidates(plant: Plant, effect: Effect, trial: _Trial) -> list[Plant]:
    """Return the likeliest plants to start from: by the integral equation where it holds the effect, else simulated."""
    if regressor(type(effect)).sizes:
        starts = [plant.with_effect(start) for start in trial.screen.best_starts(plant, effect, STARTS)]
        return [candidate for start in starts for candidate in (start, *_solved(start, trial.screen))]
    trials = [plant.with_effect(start) for start in trial.screen.proposals(plant, effect)]
    ranked = sorted(((error_of(plant, trial.runs, fine=False), i) for i, plant in enumerate(trials)))
    return [trials[i] for _, i in ranked[:STARTS]]


def _solved(plant: Plant, screen: Screen) -> list[Plant]:
    """Return `plant` with what the integral equation says, if it says something."""
    try:
        solved, _ = screen.solve(plant.effects)
    except (InputError, NumericalError):
        return []
    return [replace(plant, gain=solved.gain, damping=max(solved.damping, 0.0), effects=solved.effects)]


def _reasons(refined: Refinement, options: FitOptions) -> dict[str, str]:
    reasons = dict.fromkeys(refined.plant.parameters, "the data do not determine it")
    reasons |= dict.fromkeys(refined.at_bound, "it ended at the end of its range")
    reasons |= dict.fromkeys(refined.plant.derived, "it follows from other parameters")
    return reasons | dict.fromkeys(options.held, "given, not estimated")
