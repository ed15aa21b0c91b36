"""From measured records to what the model lacks: show, search, confirm on held-out records, judge."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.case import Case
from servolens.diagnosis.doubts import missed_by_far, said
from servolens.diagnosis.errors import residual
from servolens.diagnosis.evidence import error_shares
from servolens.diagnosis.in_time import instruments
from servolens.diagnosis.logs import is_blamed, log_findings
from servolens.diagnosis.next_experiment import proposed
from servolens.diagnosis.reasons import causes_of, rival_plants
from servolens.diagnosis.remainder import MATERIAL, Remainder, unexplained_acceleration
from servolens.diagnosis.result import Candidate, Diagnosis
from servolens.diagnosis.search import EFFORT, Search, search
from servolens.effects import catalogue
from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.door import together
from servolens.identification.fitted import fitted
from servolens.identification.refine import AT_NOISE
from servolens.identification.segments import applied_voltage
from servolens.processors import single_threaded_blas
from servolens.quality.spikes import without_spikes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from servolens.diagnosis.errors import Gains
    from servolens.diagnosis.result import Verdict
    from servolens.diagnosis.search import Effort
    from servolens.identification.integral import Prior
    from servolens.identification.likelihood import Hypothesis
    from servolens.record import Record

__all__ = ["diagnose"]

CONTENDERS = 6
"""Hypotheses, the likeliest, that are compared on records to which they were not fitted."""
SECOND = 0.5
"""Of the effort of the first search, what a second one by simulations may take: it knows where the first one ended."""


@single_threaded_blas
def diagnose(
    records: Record | Sequence[Record],
    *,
    heldout: Record | Sequence[Record] = (),
    priors: Mapping[str, Prior] | None = None,
    effort: str = "normal",
    progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
) -> Diagnosis:
    """Find what the model of gain and damping lacks, extend it, and measure the gain on held-out data.

    One pass through the catalogue adds the effect that makes the records likeliest beside their own noise, as long as
    that is more than chance (familywise error rate 0.001); each is then taken out again. The verdict follows from
    whether what is left depends on the inputs. A cause counts only if the records held out agree.

    Parameters
    ----------
    records : Record or sequence of Record
        Runs of one axis, from which model and causes are found.
    heldout : Record or sequence of Record
        Other runs of it, on which they are tested. Without any, each record in turn is left out of the fit; a single
        one is parted in time.
    priors : mapping of str to Prior, optional
        Knowledge from elsewhere, by qualified parameter name.
    effort : {"quick", "normal", "thorough"}
        How far the search goes; bounds its time by the number of samples that it simulates.
    progress : callable
        Is told (what, done, total).

    Raises
    ------
    InputError
        If there is no record, none moves, one is unfit, they are of different kinds of axes, or a prior is on what no
        plant has.
    NumericalError
        If gain and damping alone cannot be fitted.

    Examples
    --------
    >>> from servolens import lab
    >>> cart = lab.Truth(gain=1.9, damping=6.0, effects={"coulomb_friction": {"level": 0.3}})
    >>> runs = [lab.step_record(cart, kp=kp, noise=1e-5, seed=kp) for kp in (40, 80)]
    >>> diagnosis = diagnose(runs)
    >>> diagnosis.verdict, [cause.effect for cause in diagnosis.causes]
    ('explained', ['coulomb_friction'])
    """
    runs = together(records)
    others = () if isinstance(heldout, tuple | list) and not heldout else together(heldout)
    together((*runs, *others))
    _check_priors(priors or {})
    _check_copies(runs, others)
    if effort not in EFFORT:
        raise InputError(f"effort must be one of {', '.join(EFFORT)}; got {effort!r}")
    findings = log_findings((*runs, *others))
    runs, others = (tuple(without_spikes(record) for record in group) for group in (runs, others))
    try:
        return _diagnosed(Case(runs, others, dict(priors or {}), len(catalogue())), effort, findings, progress)
    except NumericalError:
        if not findings or not is_blamed(findings[0]):
            raise
        raise InputError(f"{findings[0].record}: {findings[0].message}") from None  # rather than what comes of it


def _diagnosed(
    case: Case, effort: str, findings: Sequence[Finding], progress: Callable[[str, int, int], None]
) -> Diagnosis:
    furthest = 0

    def tell(what: str, share: float) -> None:
        nonlocal furthest  # fits that run side by side report out of turn
        furthest = max(furthest, min(round(90 * share), 90))
        progress(what, furthest, 100)

    case, found, path, doubts = _searched(case, EFFORT[effort], tell)
    progress("measuring the gain", 90, 100)
    gains = case.gains(path)
    verdict = _verdict(case, path, gains)
    if verdict in ("unexplained", "healthy"):
        path = path[:1]
        gains = case.gains(path)
    fits = [fitted(case.likelihood, h) for h in (path[0], path[-1])][: len(path)]
    remainder = _remainder(case, path[-1], gains)
    model = fits[-1].model
    causes = causes_of(case, found, path, fits[-1], gains, verdict)
    rivals = {cause.effect: rival_plants(found, path[-1], cause) for cause in causes if cause.rivals}
    sure = {cause.effect: cause.confidence for cause in causes}
    diagnosis = Diagnosis(
        verdict=verdict,
        causes=causes,
        baseline=gains.errors(0),
        extended=gains.errors(-1),
        noise_floor=gains.noise,
        remainder=remainder,
        where=error_shares(case.records, [residual(fits[0].plant, record) for record in case.records]),
        instruments=instruments(case.trials.screen, fits[0].plant),
        gains=gains.by_record(),
        candidates=_candidates(case, found),
        linear=fits[0].model,
        model=model,
        rival_plants=rivals,
        next_experiment=proposed(model.plant, rivals, sure, case.records, noise=gains.noise),
        findings=(*findings, *doubts, *fits[-1].findings, *said(case, found, path[-1], gains, verdict, remainder)),
        records=case.records,
        heldout=case.heldout,
    )
    progress("measuring the gain", 100, 100)
    return diagnosis


def _check_copies(records: Sequence[Record], heldout: Sequence[Record]) -> None:
    for other in heldout:
        for record in records:
            if len(other) == len(record) and np.array_equal(other.position, record.position):
                same = f"{other.name}, held out, has the very samples of {record.name}, which is fitted"
                raise InputError(f"{same}; hold out another run")


def _check_priors(names: Iterable[str]) -> None:
    known = {f"{effect.name}.{spec.name}" for effect in catalogue().values() for spec in effect.parameters()}
    for name in names:
        if name not in known | {"gain", "damping"}:
            raise InputError(
                f"a prior on {name[:40]!r} is not possible; there are gain, damping and EFFECT.PARAMETER,"
                " such as coulomb_friction.level"
            )


def _confirmed(found: Search, case: Case) -> tuple[list[Hypothesis], list[Finding]]:
    """Take the last causes off the path that records to which they were not fitted do not confirm."""
    path, doubts = list(found.path), []
    while len(path) > 1 and not _is_confirmed(case, path):
        lost = ", ".join(name for name in path[-1].causes if name not in path[-2].causes)
        message = f"{lost} explains the training records only, not those held out; it is left out."
        doubts.append(Finding(code="not_confirmed", severity="note", message=message))
        path.pop()
    return path, doubts


def _is_confirmed(case: Case, path: Sequence[Hypothesis]) -> bool:
    """Tell whether records to which they were not fitted are likelier beside the last of `path` than the one before.

    An observer that follows a shaken axis may follow what a wrong cause does: there the simulation must miss less than
    that of any simpler model, too.
    """
    if not case.misfit(path[-1]) < case.misfit(path[-2]):
        return False
    gains = case.gains(path)
    return path[-1].noise.rate == 0.0 or gains.tested(-1) < min(gains.tested(i) for i in range(len(path) - 1))


def _searched(
    case: Case, effort: Effort, tell: Callable[[str, float], None]
) -> tuple[Case, Search, list[Hypothesis], list[Finding]]:
    """Return what was found and confirmed, and on which case: by prediction errors, or by simulations."""
    if case.contradiction() is not None:  # no effect makes one axis of two
        return case, Search((case.base,), (case.base,), (), ended_early=False), [case.base], []
    found = search(case.trials, case.base, effort, tell)
    path, doubts = _confirmed(found, case)
    if case.is_enough(path[-1]):
        return case, found, path, doubts
    return _simulated(case, found, path, doubts, effort)


def _simulated(
    case: Case, found: Search, path: list[Hypothesis], doubts: list[Finding], effort: Effort
) -> tuple[Case, Search, list[Hypothesis], list[Finding]]:
    """Return what a search by simulations finds instead, where that predicts records better that were not fitted.

    A model that is not the axis predicts the next sample best by one set of parameters, and a whole step by another;
    who tunes wants the step. What the first search has found is where the second one begins: in closed loop effects
    hide each other, such as friction that damps and a delay that does the contrary.
    """
    try:
        simulating = case.simulating()
        base = simulating.base
        if _is_immaterial(simulating, base) and not _is_near(case, path[-1]):
            return simulating, Search((base,), (base,), found.singles, ended_early=found.ended_early), [base], doubts
        known = simulating.fitted_to_simulations([h.plant for h in found.path[1:]])
        other = search(simulating.trials, simulating.base, replace(effort, work=SECOND * effort.work), known=known)
    except NumericalError:
        return case, found, path, doubts
    other = _cross_validated(simulating, other)
    steps = list(other.path)
    again = [h for h in (case.likelihood.judged(step.plant) for step in steps) if h is not None]
    if len(again) == len(steps) and again[-1].total < path[-1].total and case.is_enough(again[-1]):
        return case, replace(found, path=tuple(again)), again, doubts
    if case.gains([path[-1]]).tested(-1) <= simulating.gains([steps[-1]]).tested(-1):
        return case, found, path, doubts
    return simulating, other, steps, []


def _is_immaterial(case: Case, hypothesis: Hypothesis) -> bool:
    """Tell whether what a hypothesis leaves is too little to name causes that would take most of it.

    Of the travel, and of what the motor gives: a stiff loop hides in its position what its voltage shows.
    """
    left = _remainder(case, hypothesis, case.gains([hypothesis]))
    return not left.material and left.of_motor <= MATERIAL


def _is_near(case: Case, hypothesis: Hypothesis) -> bool:
    """Tell whether simulations with the causes of a hypothesis are about as close as the noise lets them be."""
    gains = case.gains([hypothesis])
    return bool(hypothesis.causes) and gains.train(0) <= AT_NOISE * gains.noise


def _cross_validated(case: Case, found: Search) -> Search:
    """Return `found` with those that were likeliest weighed by records to which they were not fitted.

    Of models that are all wrong, the likelihood of what was fitted favours the most flexible. What each predicts of the
    other records does not (Yao et al. 2018, doi:10.1214/17-BA1091).
    """
    others = [h for h in found.judged if h.causes][:CONTENDERS]
    contenders = list({h.causes: h for h in (*found.path, *others)}.values())
    weighed = sorted((replace(h, total=case.misfit(h)) for h in contenders), key=lambda h: h.total)
    base, best = next(h for h in weighed if not h.causes), weighed[0]
    between = [h for h in weighed if h.causes and set(h.causes) < set(best.causes)][:1]
    path = [base, *between, best] if best.causes else [base]
    return replace(found, path=tuple(path), judged=tuple(weighed))


def _verdict(case: Case, path: Sequence[Hypothesis], gains: Gains) -> Verdict:
    """Judge what is left in the training records, and whether those held out are of the same axis."""
    if case.contradiction() is not None:
        return "unexplained"
    chosen = path[-1]
    fails = any(missed_by_far(case, gains)) and gains.tested(-1) > MATERIAL * case.travel
    if case.is_enough(chosen) and not fails:
        return "explained" if chosen.causes else "healthy"
    return "partly_explained" if chosen.causes else "unexplained"


def _remainder(case: Case, chosen: Hypothesis, gains: Gains) -> Remainder:
    error, noise = gains.train(-1), gains.noise
    travel = case.travel
    push = max(float(np.abs(applied_voltage(record)).max()) for record in case.records) * abs(chosen.plant.gain)
    missed = unexplained_acceleration(case.records, gains.trained[-1], case.likelihood.rate, noise)
    missed = missed if np.isfinite(error) else error
    rms = float(np.sqrt(max(error**2 - noise**2, 0.0))) if np.isfinite(error) else error
    return Remainder(
        rms=rms,
        times_noise=error / noise if noise > 0.0 else None,
        of_travel=rms / max(travel, 1e-300),
        acceleration_rms=missed,
        of_motor=missed / max(push, 1e-300),
        depends_on_inputs=not case.is_enough(chosen),
        material=rms > MATERIAL * travel,
    )


def _candidates(case: Case, found: Search) -> tuple[Candidate, ...]:
    """Return what each single effect leaves, driven by the voltage beside its own noise."""
    return tuple(
        Candidate(effects=h.causes, error=h.noise.spread, likelihood=case.base.total - h.total) for h in found.singles
    )
