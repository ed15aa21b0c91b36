"""From measured records to what the model lacks: show, search, confirm on held-out records, judge."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

import numpy as np

from servolens.diagnosis.effort import EFFORT, SPENT
from servolens.diagnosis.errors import pooled, residual
from servolens.diagnosis.evidence import error_shares
from servolens.diagnosis.in_time import instruments
from servolens.diagnosis.logs import is_blamed, log_findings, lower_limit
from servolens.diagnosis.messages import missed_by_far, said
from servolens.diagnosis.next_experiment import proposed
from servolens.diagnosis.reasons import causes_of, may_be_nothing, own_quantities, rival_plants
from servolens.diagnosis.remainder import evidence_of, held_errors, remainder_of
from servolens.diagnosis.result import Candidate, Diagnosis
from servolens.diagnosis.stepped_voltage import decided_beside_voltage
from servolens.effects import catalogue
from servolens.errors import InputError, NumericalError, as_progress, one_of
from servolens.findings import Finding
from servolens.identification.constant import contradicted
from servolens.identification.fitted import fitted
from servolens.identification.options import NO_FREE_DAMPING, as_priors
from servolens.identification.restricted import counting_followed
from servolens.identification.segments import runs_free
from servolens.inputs import as_groups
from servolens.model_evidence import MATERIAL
from servolens.plant import FREE_DAMPING
from servolens.processors import single_threaded_blas
from servolens.quality.spikes import without_spikes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.decision import Decision
    from servolens.diagnosis.errors import Gains
    from servolens.diagnosis.result import Verdict
    from servolens.diagnosis.search import Search
    from servolens.identification.fitted import Fitted
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.options import Priors
    from servolens.inputs import Records, RecordSettings
    from servolens.model import Model
    from servolens.record import Record

__all__ = ["check_request", "diagnose"]


@single_threaded_blas
def diagnose(
    records: Records,
    *,
    heldout: Records = (),
    priors: Priors | None = None,
    effort: str = "normal",
    progress: Callable[[str, int, int], None] | None = None,
    **settings: Unpack[RecordSettings],
) -> Diagnosis:
    """Find what the model of gain and damping lacks, extend it, and measure the gain on held-out data.

    One pass through the catalogue adds the effect that makes the records likeliest beside their own noise, as long as
    that is more than chance (familywise error rate 0.001); each is then taken out again. The verdict follows from
    whether what is left depends on the inputs. A cause counts only if the records held out agree.

    Parameters
    ----------
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Runs of one axis, from which model and causes are found.
    heldout : the same
        Other runs of it, on which they are tested. Without any, each record in turn is left out of the fit; a single
        one is parted in time.
    priors : mapping of str to Prior or (value, standard deviation), optional
        Knowledge from elsewhere, by qualified parameter name.
    effort : {"quick", "normal", "thorough"}
        How far the search goes; bounds its time by the number of samples that it simulates.
    progress : callable, optional
        Is told (what, done, total).
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

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
    runs, others = as_groups(records, heldout, settings)
    known, progress = as_priors(priors), as_progress(progress)
    check_request(runs, others, known, effort)
    given = (*runs, *others)
    findings = log_findings(given)
    runs, others = (tuple(map(without_spikes, group)) for group in (runs, others))
    try:
        tell = _never_back(progress)
        decision = decided_beside_voltage(runs, others, known, len(catalogue()), EFFORT[effort], tell)
        ticks = [record.ticks for record in (*decision.case.records, *decision.case.heldout)]
        is_whole = len(ticks) == len(given)  # no record is left out, as one that was knocked
        if is_whole and ticks != [record.ticks for record in given]:  # their law, too, ran at the ticks that were found
            findings = log_findings([one.with_ticks(count) for one, count in zip(given, ticks, strict=True)])
        return _diagnosed(decision, effort, findings, progress)
    except NumericalError:
        if not findings or not is_blamed(findings[0]):
            raise
        raise InputError(f"{findings[0].record}: {findings[0].message}") from None  # rather than what comes of it


def _diagnosed(
    decision: Decision, effort: str, findings: Sequence[Finding], progress: Callable[[str, int, int], None]
) -> Diagnosis:
    """Test what was decided on records held out, and say it."""
    case, found = decision.case, decision.found
    progress("Comparing errors with and without the causes", 90, 100)
    path, fits, sizeless = _as_far_as_shown(case, decision.path, work := SPENT * EFFORT[effort].work)
    found = replace(found, path=tuple(path)) if sizeless else found
    gains = case.gains(path, [fit.plant for fit in fits])
    powerless = [*_powerless([fit.model for fit in fits])]
    verdict = "unexplained" if decision.contradiction or powerless else _verdict(case, path, gains)
    if verdict in ("unexplained", "healthy"):
        path, fits = path[:1], fits[:1]
        gains = case.gains(path, [fits[0].plant])
    remainder = remainder_of(case, path[-1], gains)
    priors = _contradicted_priors(case, path[-1], fits[-1].model, work)
    told = (*findings, *powerless, *decision.findings, *sizeless, *fits[-1].findings, *priors)
    causes = causes_of(case, found, path, fits[-1], gains, verdict)
    told = (*told, *said(case, decision, path[-1], gains, verdict, remainder), *lower_limit(case.records, causes))
    model = replace(fits[-1].model, evidence=evidence_of(case, path[-1], gains, verdict, remainder, told))
    rivals = {cause.effect: rival_plants(found, path[-1], cause) for cause in causes if cause.rivals}
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
        missed=gains.missed(),
        candidates=_candidates(case, found),
        linear=fits[0].model,
        model=model,
        rival_plants=rivals,
        next_experiment=proposed(
            model.plant, rivals, {c.effect: c.confidence for c in causes}, case.records, noise=gains.noise
        ),
        findings=told,
        records=case.records,
        heldout=case.heldout,
    )
    progress("Diagnosis done", 100, 100)
    return diagnosis


def _never_back(progress: Callable[[str, int, int], None]) -> Callable[[str, float], None]:
    """Return what tells `progress` the share of the searches that is done: nine tenths of the whole."""
    furthest = 0

    def tell(what: str, share: float) -> None:
        nonlocal furthest  # fits that run side by side report out of turn
        furthest = max(furthest, min(round(90 * share), 90))
        progress(what, furthest, 100)

    return tell


def _as_far_as_shown(
    case: Case, path: Sequence[Hypothesis], work: float
) -> tuple[list[Hypothesis], list[Fitted], list[Finding]]:
    """Return `path`, its first and its last fitted, without last causes that may be nothing, and a note on these.

    The 95 % intervals of their sizes include nothing, and they are not what leaves nothing that depends on the inputs.
    The likelihood of contacts is ragged: that it is higher beside a further cause may be for another optimum of those
    before. A model that is not the axis has wide intervals, and a cause that they do not tell from none explains
    nothing.
    """
    path, told = list(path), list[Finding]()
    base = fitted(case.likelihood, counting_followed(case.likelihood, path[0]), work)
    while len(path) > 1:
        fit = fitted(case.likelihood, counting_followed(case.likelihood, path[-1]), work)
        added = [name for name in path[-1].causes if name not in path[-2].causes]
        is_shown = any(not may_be_nothing(path[-1].plant, name, own_quantities(fit, name)) for name in added)
        if not added or is_shown:
            return path, [base, fit], told
        is_rest_enough = case.is_enough_everywhere(path[-2]) and case.explains(path[-2])
        if case.explains(path[-1]) and not is_rest_enough:
            return path, [base, fit], told
        why = "the rest explains the records, so it is left out" if is_rest_enough else "it is left out"
        message = f"{', '.join(added)} may be of no size at all; {why}."
        told.append(Finding(code="not_confirmed", severity="note", message=message))
        path.pop()
    return path, [base], told


def _contradicted_priors(case: Case, chosen: Hypothesis, model: Model, work: float) -> tuple[Finding, ...]:
    """Name the priors that the records contradict: a fit without them, beside the same causes, is far from these.

    So is a fit with them that ends as far from a prior as it may.
    """
    if not case.trials.priors:
        return ()
    free = case.likelihood.without_priors()
    found = free.judged(chosen.plant, chosen, allowance=work)
    case.likelihood.tally.add(free.work)
    return () if found is None else contradicted(fitted(free, found, work).model, case.trials.priors, model)


def check_request(records: Sequence[Record], heldout: Sequence[Record], priors: Iterable[str], effort: str) -> None:
    """Refuse what cannot be asked of a diagnosis, whatever the records hold.

    Raises
    ------
    InputError
        If a prior is on what no plant has, a held-out record is a copy of one that is fitted, or there is no such
        effort.
    """
    _check_priors(priors, records)
    _check_copies(records, heldout)
    one_of(effort, EFFORT, "effort")


def _check_copies(records: Sequence[Record], heldout: Sequence[Record]) -> None:
    for other in heldout:
        for record in records:
            if len(other) == len(record) and np.array_equal(other.position, record.position):
                same = f"{other.name}, held out, has the very samples of {record.name}, which is fitted"
                raise InputError(f"{same}; hold out another run")


def _check_priors(names: Iterable[str], records: Sequence[Record]) -> None:
    known = {f"{effect.name}.{spec.name}" for effect in catalogue().values() for spec in effect.parameters()}
    for name in names:
        if name not in known | {"gain", "damping", FREE_DAMPING.name}:
            raise InputError(
                f"a prior on {name[:40]!r} is not possible; there are gain, damping, {FREE_DAMPING.name} and"
                " EFFECT.PARAMETER, such as coulomb_friction.level"
            )
        if name == FREE_DAMPING.name and not any(map(runs_free, records)):
            raise InputError(NO_FREE_DAMPING)


def _verdict(case: Case, path: Sequence[Hypothesis], gains: Gains) -> Verdict:
    """Judge what is left in the training records, and whether those held out are of the same axis.

    What comes in bursts is no noise that a model claims, whether or not it depends on the inputs.
    """
    chosen = path[-1]
    is_far = any(missed_by_far(case, chosen, gains))
    fails = is_far and pooled(held_errors(case, chosen, gains)) > MATERIAL * case.travel
    if case.is_enough_everywhere(chosen) and case.explains(chosen) and not fails:
        return "explained" if chosen.causes else "healthy"
    return "partly_explained" if chosen.causes else "unexplained"


def _powerless(models: Sequence[Model]) -> Iterator[Finding]:
    """Yield a finding where nothing shows that the command moves the axis: the gain may as well be 0.

    Without the causes and with them: a limit of the force alone leaves a gain undetermined that is large.
    """
    gains = [model.quantities["gain"] for model in models]
    ends = [gain.interval for gain in gains]
    if all(end is not None and end[0] <= 0.0 <= end[1] for end in ends) and ends[0] is not None:
        low, high = ends[0]
        message = (
            "nothing in the records shows that the command moves the axis: its gain may be anything between"
            f" {low:.2g} and {high:.2g} {gains[0].unit}. Check that the right column is read as the command, its unit"
            " and sign, and that the drive was on."
        )
        yield Finding(code="gain_not_shown", severity="warning", message=message)


def _candidates(case: Case, found: Search) -> tuple[Candidate, ...]:
    """Return what each single effect leaves, the likeliest first.

    Driven by the voltage beside its own noise; where an observer follows a shaken axis, of a simulation as `predict`
    has it.
    """
    tried = [*found.singles, *(h for h in found.judged if len(h.causes) == 1)]
    best = {h.causes: h for h in sorted(tried, key=lambda h: -h.total)}
    return tuple(
        Candidate(
            effects=h.causes,
            error=_simulated_error(case, h) if h.noise.rate > 0.0 else h.noise.spread,
            likelihood=case.base.total - h.total,
            shaken=h.noise.rate > 0.0,
        )
        for h in sorted(best.values(), key=lambda h: h.total)
    )


def _simulated_error(case: Case, hypothesis: Hypothesis) -> float:
    error = pooled([residual(hypothesis.plant_of(i), record) for i, record in enumerate(case.records)])
    return error if np.isfinite(error) else hypothesis.noise.spread
