"""Plants with given effects: their sizes as columns of the integral equation, then refined by simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from servolens.errors import InputError, NumericalError
from servolens.identification.door import check_names, together
from servolens.identification.doubts import doubts
from servolens.identification.options import FitOptions
from servolens.identification.refine import AT_NOISE, DOWN_TO_NOISE, Refinement, error_of, minimise_error
from servolens.identification.regressors import regressor
from servolens.identification.runs import closed_runs, voltage_runs
from servolens.identification.segments import motion_segments, noise_level
from servolens.identification.starting import Screen
from servolens.model import Model
from servolens.plant import Plant

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
        Standard deviation of the position's noise [m or rad].
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
        """Root mean square of simulated minus measured position [m or rad]."""
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
    contains what the controller made of the noise.

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
    check_names((*(asked.priors or {}), *asked.held, *asked.local), plant.parameters)
    start = _start(runs, plant, asked)
    return last_word(start, runs, asked)


def fit_runs(records: Sequence[Record], driven: str) -> list[Run]:
    """Return the runs to which a plant is fitted: ``"closed_loop"``, ``"voltage"`` or ``"stretches"``."""
    if driven == "closed_loop":
        return [*closed_runs(records)]
    return [*voltage_runs(records, stretches=driven == "stretches")]


def last_word(start: Plant, records: tuple[Record, ...], options: FitOptions) -> EffectsFit:
    """Refine `start`, first in closed loop where that can be, then by the voltage where that reaches the noise."""
    noise = max(noise_level(record) for record in records)
    driven: str = first_choice(records, options)
    refined = _refined(start, records, options, driven, noise)
    if options.driven == "auto" and driven == "closed_loop":
        refined, driven = _by_voltage(refined, records, options, noise)
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
    if options.driven == "closed_loop" and lacking:
        raise InputError(f"{lacking[0]}: closing the loop needs reference, kp and kd")
    return "voltage" if lacking or options.driven == "voltage" else "closed_loop"


def _by_voltage(
    refined: Refinement, records: tuple[Record, ...], options: FitOptions, noise: float
) -> tuple[Refinement, str]:
    """Return the refinement driven by the voltage where it reaches the noise, and how it was driven.

    Stretches follow the data closer than whole records in any case: they count only if they alone get down to it.
    """
    best, driven = refined, "closed_loop"
    for way, enough in (("voltage", AT_NOISE), ("stretches", DOWN_TO_NOISE)):
        try:
            found = _refined(best.plant, records, options, way, noise)
        except (InputError, NumericalError):
            continue
        if found.rms_error <= enough * noise:
            best, driven = found, way
        if best.rms_error <= DOWN_TO_NOISE * noise:
            break
    return best, driven


def _refined(start: Plant, records: tuple[Record, ...], options: FitOptions, driven: str, noise: float) -> Refinement:
    """Refine; once more with coarse sensitivities where that does not reach the noise."""
    runs = fit_runs(records, driven)
    found = minimise_error(start, runs, options, noise=noise)
    if found.rms_error <= DOWN_TO_NOISE * noise:
        return found
    again = minimise_error(start, runs, options, noise=noise, coarse=True)
    return again if again.rms_error < found.rms_error else found


def _start(records: tuple[Record, ...], wanted: Plant, options: FitOptions) -> Plant:
    """Return the plant from which the final search begins: effects take their best starts one after the other."""
    screen = Screen.of(motion_segments(records))
    bare, _ = screen.solve(())
    plant = replace(wanted, gain=bare.gain, damping=bare.damping, effects=())
    for effect in wanted.effects:
        plant = _added(plant, effect, screen, records, options)
    return plant


def _added(plant: Plant, effect: Effect, screen: Screen, records: tuple[Record, ...], options: FitOptions) -> Plant:
    """Return `plant` with `effect` at the start from which a few steps of refinement lead furthest."""
    noise = max(noise_level(record) for record in records)
    runs = fit_runs(records, first_choice(records, options))
    smooth = bool(regressor(type(effect)).sizes)
    names = set(plant.with_effect(effect).parameters)
    known = replace(
        options,
        held=tuple(name for name in options.held if name in names),
        local=(),
        priors={name: prior for name, prior in (options.priors or {}).items() if name in names},
    )
    kept = {name: getattr(effect, name.partition(".")[2]) for name in known.held if name.startswith(effect.name)}
    best, least = plant.with_effect(effect), np.inf
    for start in _candidates(plant, effect, screen, runs):
        values = {name.partition(".")[2]: value for name, value in kept.items()}
        trial = replace(start, effects=(*start.effects[:-1], replace(start.effects[-1], **values)))
        try:
            found = minimise_error(trial, runs, known, noise=noise, iterations=SHORT, coarse=not smooth)
        except (InputError, NumericalError):
            continue
        if found.rms_error < least:
            best, least = found.plant, found.rms_error
        if least <= noise:
            break
    return best


def _candidates(plant: Plant, effect: Effect, screen: Screen, runs: Sequence[Run]) -> list[Plant]:
    """Return the likeliest plants to start from: by the integral equation where it holds the effect, else simulated."""
    if regressor(type(effect)).sizes:
        found = []
        for start in screen.best_starts(plant, effect, STARTS):
            found.append(plant.with_effect(start))
            try:
                solved, _ = screen.solve(found[-1].effects)
            except (InputError, NumericalError):
                continue
            found.append(replace(found[-1], gain=solved.gain, damping=max(solved.damping, 0.0)))
        return found
    trials = [plant.with_effect(start) for start in screen.proposals(plant, effect)]
    ranked = sorted(((error_of(trial, runs), i) for i, trial in enumerate(trials)))
    return [trials[i] for _, i in ranked[:STARTS]]


def _reasons(refined: Refinement, options: FitOptions) -> dict[str, str]:
    reasons = dict.fromkeys(refined.plant.parameters, "the data do not determine it")
    reasons |= dict.fromkeys(refined.at_bound, "it ended at the end of its range")
    reasons |= dict.fromkeys(refined.plant.derived, "it follows from other parameters")
    return reasons | dict.fromkeys(options.held, "given, not estimated")
