"""From measured records to what the model lacks: show, search, confirm on held-out records, judge."""

from __future__ import annotations

from dataclasses import replace
from math import erf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.before import Unpowered, unpowered_finding
from servolens.diagnosis.case import Case
from servolens.diagnosis.errors import pooled, residual
from servolens.diagnosis.evidence import error_shares
from servolens.diagnosis.in_time import instruments
from servolens.diagnosis.logs import beyond, is_blamed, log_findings
from servolens.diagnosis.next_experiment import proposed
from servolens.diagnosis.result import Candidate, Cause, Diagnosis
from servolens.diagnosis.search import WORTH, Search, search
from servolens.effects import CATALOGUE, Actuator, Drive
from servolens.errors import InputError, NumericalError
from servolens.findings import Finding
from servolens.identification.door import together
from servolens.plant import Plant
from servolens.quality.spikes import without_spikes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from servolens.diagnosis.case import Gains
    from servolens.diagnosis.result import Verdict
    from servolens.diagnosis.trials import Hypothesis
    from servolens.identification.effects_fit import EffectsFit
    from servolens.identification.integral import Prior
    from servolens.model import Quantity
    from servolens.record import Record

__all__ = ["diagnose"]

PARTLY, PARTLY_OF_LITTLE = 0.7, 0.4
"""Times the error of gain and damping alone up to which causes explain it in part; the same where it is little."""
BORNE_OUT, OF_ALL = 3.0, 0.02
"""Times the noise up to which errors elsewhere bear a verdict out; share of what gain and damping alone leave."""
LITTLE = 0.005
"""Share of the travel up to which an error is little."""
ALIKE = 10.0
"""Difference of scores up to which these data cannot tell two effects apart."""
MOST_CONFIDENT, OF_A_PART = 0.999, 0.9
"""Confidence in a cause at most; in one that explains a part, for which rivals are not weighed."""
KEEP_THE_GAIN = tuple(e.name for e in CATALOGUE.values() if not (e.passes_for_damping or issubclass(e, Drive)))
"""Effects beside which the gain is that of one record as of all."""


def diagnose(
    records: Record | Sequence[Record],
    *,
    heldout: Record | Sequence[Record] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
) -> Diagnosis:
    """Find what the model of gain and damping lacks, extend it, and measure the gain on held-out data.

    Every effect of the catalogue is tried beside gain and damping, then beside the best of them, until what is left is
    noise; each is taken out again, and replaced by every other. A cause counts only if the records held out agree.

    Parameters
    ----------
    records : Record or sequence of Record
        Runs of one axis, from which model and causes are found.
    heldout : Record or sequence of Record
        Other runs of it, on which they are tested. Without any, each record in turn is left out of the fit; a single
        one is parted in time.
    priors : mapping of str to Prior, optional
        Knowledge from elsewhere, by qualified parameter name.
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
    findings = log_findings((*runs, *others))
    runs, others = (tuple(without_spikes(record) for record in group) for group in (runs, others))
    try:
        return _diagnosed(Case.of(runs, others, dict(priors or {})), findings, progress)
    except NumericalError:
        if not findings or not is_blamed(findings[0]):
            raise
        raise InputError(f"{findings[0].record}: {findings[0].message}") from None  # rather than what comes of it


def _diagnosed(case: Case, findings: Sequence[Finding], progress: Callable[[str, int, int], None]) -> Diagnosis:
    contradiction = case.contradiction()
    if contradiction is not None:  # nothing that one axis has can explain two
        found = Search((case.base,), (), ())
    else:
        other, found = _searched(case, progress)
        if other is not case:
            case, findings = other, [*findings, unpowered_finding(case)]
    progress("Measuring the gain", 0, 0)
    runs, others = case.records, case.heldout
    path, doubts = _confirmed(found.path, case)
    fits = [case.fitted(hypothesis.plant) for hypothesis in (path[0], path[-1])][: len(path)]
    gains = case.gains([fits[0].plant, *(h.plant for h in path[1:-1]), *(fit.plant for fit in fits[1:])])
    verdict = _verdict(case, path[-1], gains)
    if verdict in ("unexplained", "healthy"):
        path, fits, gains = path[:1], fits[:1], case.gains([fits[0].plant])
    causes = _causes(case, found, path, fits[-1], gains, verdict)
    diagnosis = Diagnosis(
        verdict=verdict,
        causes=causes,
        baseline=gains.errors(0),
        extended=gains.errors(-1),
        noise_floor=case.trials.noise,
        remainder=case.left(path[-1]),
        where=error_shares(runs, [residual(fits[0].plant, run) for run in runs]),
        instruments=instruments(case.trials.screen, fits[0].plant),
        gains=gains.by_record(),
        candidates=tuple(Candidate(effects=h.causes, error=h.error, by_run=h.by_run) for h in found.singles),
        linear=fits[0].model,
        model=fits[-1].model,
        rival_plants={cause.effect: _rival_plants(case, found, path[-1], cause) for cause in causes if cause.rivals},
        next_experiment=None,
        findings=(*findings, *doubts, *fits[-1].findings, *_said(case, path[-1], gains, verdict, contradiction)),
        records=runs,
        heldout=others,
    )
    sure = {cause.effect: cause.confidence for cause in causes}
    proposal = proposed(diagnosis.plant, diagnosis.rival_plants, sure, runs, noise=diagnosis.noise_floor)
    return replace(diagnosis, next_experiment=proposal)


def _searched(case: Case, progress: Callable[[str, int, int], None]) -> tuple[Case, Search]:
    """Return what was found, with nothing applied before the records if that explains more."""
    unpowered, is_it = Unpowered(case), None

    def is_better(chosen: Hypothesis) -> bool:
        nonlocal is_it
        is_it = unpowered.understands(chosen)
        return bool(is_it)

    def tell(what: str, share: float) -> None:
        progress(what, int(100 * share), 100)

    found = search(case.trials, case.base, case.is_explained, tell, is_better)
    gave_up = bool(is_it)
    if not gave_up:
        is_better(found.chosen)
    if is_it is None:
        return case, found
    other = unpowered.case
    again = search(other.trials, other.base, other.is_explained, tell)
    if _is_better(other, again.chosen, case, found.chosen):
        return other, again
    return case, search(case.trials, case.base, case.is_explained, tell) if gave_up else found


def _is_better(case: Case, chosen: Hypothesis, than: Case, other: Hypothesis) -> bool:
    return not chosen.tied and case.trials.score(chosen) < than.trials.score(other) - WORTH


def _check_copies(records: Sequence[Record], heldout: Sequence[Record]) -> None:
    for other in heldout:
        for record in records:
            if len(other) == len(record) and np.array_equal(other.position, record.position):
                same = f"{other.name}, held out, has the very samples of {record.name}, which is fitted"
                raise InputError(f"{same}; hold out another run")


def _check_priors(names: Iterable[str]) -> None:
    known = {f"{effect.name}.{spec.name}" for effect in CATALOGUE.values() for spec in effect.parameters()}
    for name in names:
        if name not in known | {"gain", "damping"}:
            raise InputError(
                f"a prior on {name[:40]!r} is not possible; there are gain, damping and EFFECT.PARAMETER,"
                " such as coulomb_friction.level"
            )


def _confirmed(path: tuple[Hypothesis, ...], case: Case) -> tuple[tuple[Hypothesis, ...], list[Finding]]:
    """Take the last causes off the path that do not lower the error where they were not fitted."""
    doubts = []
    while len(path) > 1:
        with_it, without = case.tested(path[-1].plant), case.tested(path[-2].plant)
        if with_it < without or not np.isfinite(without):
            break
        lost = next(name for name in path[-1].causes if name not in path[-2].causes)
        message = f"{lost} lowers the error of the training records only, not of those held out; it is left out."
        doubts.append(Finding(code="not_confirmed", severity="note", message=message))
        path = path[:-1]
    return path, doubts


def _verdict(case: Case, chosen: Hypothesis, gains: Gains) -> Verdict:
    is_curve = sum(effect.bends_with_speed for effect in chosen.plant.effects) > 1
    if case.is_explained(chosen) and not is_curve and _is_borne_out(case, chosen, gains):
        return "explained" if chosen.causes else "healthy"
    little = gains.of_travel(0) <= LITTLE
    if chosen.causes and gains.tested(-1) <= (PARTLY_OF_LITTLE if little else PARTLY) * gains.tested(0):
        return "partly_explained"
    return "healthy" if little else "unexplained"


def _is_borne_out(case: Case, chosen: Hypothesis, gains: Gains) -> bool:
    """Tell whether other simulations agree that nothing is left: in closed loop, and of the records held out."""
    if not chosen.causes and gains.of_travel(-1) <= LITTLE:
        return True
    worst = max(gains.train(-1), gains.tested(-1))
    return worst <= max(BORNE_OUT * case.trials.noise, OF_ALL * gains.tested(0))


def _causes(
    case: Case, found: Search, path: Sequence[Hypothesis], fit: EffectsFit, gains: Gains, verdict: Verdict
) -> tuple[Cause, ...]:
    """Return the causes in the order of the path, each with what it gained."""
    chosen, causes = path[-1], []
    explained = 1.0 - min(case.left(chosen) / max(case.base.error, 1e-300), 1.0) ** 2
    for name in _in_order(path):
        rivals = _rivals(case, found, chosen, name)
        quantities, twin = _own(fit, name), _twin(chosen, name)
        odds = sum(float(np.exp(-0.5 * max(case.trials.score(h) - case.trials.score(chosen), 0.0))) for h in rivals)
        if twin and not any(twin in h.causes for h in rivals):
            odds += 1.0
        most = MOST_CONFIDENT if verdict == "explained" else OF_A_PART
        there = _stands_out(chosen.plant, name, quantities)
        at = next(i for i, h in enumerate(path) if name in h.causes and all(name in g.causes for g in path[i:]))
        causes.append(
            Cause(
                effect=name,
                quantities=quantities,
                confidence=round(min(there * explained / (1.0 + odds), most), 4),
                rivals=_names(rivals, chosen, name, twin),
                train=(gains.train(at - 1), gains.train(at)),
                heldout=(gains.tested(at - 1), gains.tested(at)),
            )
        )
    return tuple(causes)


def _rival_plants(case: Case, found: Search, chosen: Hypothesis, cause: Cause) -> tuple[Plant, ...]:
    """Return the plants with a rival in the place of `cause`; of a twin that was not tried, with the same values."""
    plants = [h.plant for h in _rivals(case, found, chosen, cause.effect)]
    effect = chosen.plant.effect(cause.effect)
    if effect is not None and effect.twin in cause.rivals and not any(p.effect(effect.twin) for p in plants):
        values = {spec.name: getattr(effect, spec.name) for spec in effect.parameters()}
        plants.append(chosen.plant.without_effect(cause.effect).with_effect(Plant.effect_from(effect.twin, values)))
    return tuple(plants)


def _names(rivals: Sequence[Hypothesis], chosen: Hypothesis, cause: str, twin: str) -> tuple[str, ...]:
    """Return the names of the rivals of `cause`, of what it unites, and of its `twin` if it has one."""
    names = [name for h in rivals for name in h.causes if name not in chosen.causes]
    names += [name for effect in chosen.plant.effects if effect.name == cause for name in effect.unites]
    return tuple(dict.fromkeys([*names, twin] if twin else names))


def _twin(chosen: Hypothesis, cause: str) -> str:
    """Return what does the same elsewhere in the loop, where all that lies between is linear; else nothing."""
    effect = chosen.plant.effect(cause)
    if effect is None or not effect.twin or effect.twin in chosen.causes:
        return ""
    places = [cls.stage for name in (cause, effect.twin) if issubclass(cls := CATALOGUE[name], Actuator)]
    between = [e for e in chosen.plant.effects if not (isinstance(e, Actuator) and e.stage < min(places, default=0))]
    return effect.twin if all(e.linear for e in between) else ""


def _stands_out(plant: Plant, cause: str, quantities: Mapping[str, Quantity]) -> float:
    """Return with what confidence the cause's size differs from nothing by its error bar; 1 where it has none."""
    effect = plant.effect(cause)
    sizes = [(quantities[name], nothing) for name, nothing in (effect.absent_at if effect else {}).items()]
    if sizes and all(q.value == nothing for q, nothing in sizes):
        return 0.0
    far = [abs(q.value - nothing) / q.stderr for q, nothing in sizes if q.stderr is not None and q.stderr > 0.0]
    return erf(max(far) / sqrt(2.0)) if far else 1.0


def _in_order(path: Sequence[Hypothesis]) -> list[str]:
    """Return the causes of the last hypothesis, those first that came first."""
    seen = [name for hypothesis in path for name in hypothesis.causes if name in path[-1].causes]
    return list(dict.fromkeys(seen))


def _own(fit: EffectsFit, name: str) -> dict[str, Quantity]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): q for key, q in fit.quantities.items() if key.startswith(prefix)}


def _rivals(case: Case, found: Search, chosen: Hypothesis, cause: str) -> list[Hypothesis]:
    """Return what stands as well with another effect in the place of `cause`, but for one that contains it."""
    score = case.trials.score
    return [
        h
        for h in found.rivals_of(cause)
        if len(h.causes) == len(chosen.causes)  # none of a longer hypothesis that was not confirmed
        and score(h) <= score(chosen) + ALIKE
        and not any(cause in effect.generalises for effect in h.plant.effects)
    ]


def _strangers(case: Case, chosen: Hypothesis, gains: Gains) -> Iterator[Finding]:
    """Yield a finding for each record held out that is far off although those that were fitted are not."""
    noise = case.trials.noise
    fitted = max(gains.train(-1), noise)
    for record, miss in zip(case.heldout, gains.held[-1], strict=False):
        error = pooled([miss])
        little = 0.0 if chosen.causes else LITTLE * float(np.ptp(record.position))
        if error > max(BORNE_OUT * fitted, little):
            message = (
                f"held out, it is {error / noise:.0f} times the noise off, the records that were fitted"
                f" {fitted / noise:.1f} times; is it of the same axis, load and units?"
            )
            yield Finding(code="heldout_contradicts", severity="warning", message=message, record=record.name)


def _said(
    case: Case, chosen: Hypothesis, gains: Gains, verdict: Verdict, contradiction: Finding | None
) -> list[Finding]:
    """Return what the verdict alone does not say: what is left, what contradicts itself, what was never tried."""
    said = [*beyond(case.records, case.heldout), *_strangers(case, chosen, gains)]
    if verdict == "healthy" and not case.is_explained(case.base):
        share = f"{100 * gains.of_travel(0):.2g} %"
        message = (
            f"gain and damping leave {share} of the travel, little but more than the noise, and nothing in the"
            " catalogue explains it; for tuning they will do."
        )
        said.append(Finding(code="small_remainder", severity="note", message=message))
    if contradiction is None and verdict not in ("healthy", "explained") and len(case.records) > 1:
        contradiction = case.apart(case.base, KEEP_THE_GAIN) or case.apart(chosen)
    return said if contradiction is None else [*said, contradiction]
