"""The whole chain: check, identify, diagnose, take the model that the data support best, design on it, and judge."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar, Unpack

import numpy as np

from servolens.checking import contradictions
from servolens.design import compare, recommend
from servolens.design.spec import PDSpec
from servolens.diagnosis import diagnose
from servolens.diagnosis.workflow import check_request
from servolens.errors import InputError, NumericalError, ServolensError, as_progress, flags, needed
from servolens.findings import together
from servolens.identification import as_priors, identify
from servolens.identification.damping_law import SHAPE, SIZE
from servolens.inputs import as_groups
from servolens.model_evidence import Evidence
from servolens.plant import FREE_DAMPING
from servolens.processors import single_threaded_blas
from servolens.quality import assess, fatal
from servolens.study.amplifier import with_amplifier
from servolens.study.lights import data_light, is_fit, study_lights
from servolens.study.result import Study
from servolens.study.spec import design_notes, suggested_spec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from servolens.diagnosis import Diagnosis
    from servolens.findings import Finding
    from servolens.identification import Identification, Prior, Priors
    from servolens.inputs import Records, RecordSettings
    from servolens.model import Model
    from servolens.quality import RecordQuality
    from servolens.record import Record

    Progress = Callable[[str, int, int], None]

__all__ = ["study_records"]

Made = TypeVar("Made")

OF_THE_LAW = ("gain", "damping", SIZE, SHAPE, FREE_DAMPING.name)
"""Parameters of the models of constant and of speed-dependent damping."""
OF_SIMPLER_MODELS = frozenset(
    {
        "beyond_the_law",
        "not_determined",
        "no_velocity_dependence",
        "not_simulated",
        "pieces_not_determined",
        "prior_contradicts_data",
        "varying_not_determined",
    }
)
"""Findings of the identification on models in whose place a diagnosis puts its own."""
UNANSWERED = "the plant does not answer to the voltage in these records, so no gain follows from them"
WRONG = "the data are wrong"
SEVERITIES = ("error", "warning", "note")


@single_threaded_blas
def study_records(
    records: Records,
    spec: PDSpec | None = None,
    *,
    references: float | Sequence[float] = (),
    heldout: Records = (),
    priors: Priors | None = None,
    effort: str = "normal",
    force: bool = False,
    progress: Progress | None = None,
    **settings: Unpack[RecordSettings],
) -> Study:
    """Go the whole way from records to a gain.

    Parameters
    ----------
    records : Record, path, DataFrame, TimeResponseData, or a sequence of these
        Runs of one axis.
    spec : PDSpec, optional
        What to reach; when None, a spec that suits the records is chosen.
    references : float or sequence of float
        Sizes of further steps that the recommended gain has to meet [m or rad].
    heldout : the same
        Other runs of it that only test what was found.
    priors : mapping of str to Prior or (value, standard deviation), optional
        Data-sheet knowledge by qualified parameter name.
    effort : {"quick", "normal", "thorough"}
        How far the search for causes goes.
    force : bool
        Whether to give a gain that is to be withheld, and to seek causes in data whose sign or unit is wrong.
    progress : callable, optional
        Is told (what, done, total).
    **settings
        ``kp``, ``kd`` … of tables and files (:class:`servolens.inputs.RecordSettings`).

    Raises
    ------
    InputError
        If there is no record, records of different kinds are mixed, or what is asked for does not exist.
    NumericalError
        If records that are fit for it do not determine gain and damping.

    Examples
    --------
    >>> from servolens import PDSpec, lab
    >>> runs = [lab.step_record(lab.NLM3, kp=kp, noise=1e-5, seed=kp) for kp in (80, 100)]
    >>> found = study_records(runs, PDSpec(kp=100, settling_time=0.5), effort="quick")
    >>> [light.light for light in found.lights.values()], [cause.effect for cause in found.diagnosis.causes]
    (['green', 'green', 'green'], ['velocity_decay_damping'])
    """
    if spec is not None:
        needed(spec, PDSpec)
    runs, others = as_groups(records, heldout, settings)
    known = as_priors(priors)
    check_request(runs, others, known, effort)
    flags(force=force)
    tell = as_progress(progress)
    tell("Checking the records", 0, 100)
    check = tuple(assess(record) for record in (*runs, *others))
    fit_ones = [record for record, quality in zip((*runs, *others), check, strict=True) if is_fit(quality)]
    train, tests = ([r for r in group if any(r is one for one in fit_ones)] for group in (runs, others))
    begun = Study(
        records=runs,
        heldout=others,
        check=check,
        fit=None,
        diagnosis=None,
        why_undiagnosed="",
        model=None,
        comparison=None,
        design=None,
        why_none="no model was found",
        lights={},
        forced=False,
        suggested=spec is None,
        findings=(*contradictions((*runs, *others), check), *design_notes(train)),
    )
    is_sought = force or not fatal(_findings(check))
    modelled = _modelled(begun, train, tests, known, effort, tell, is_sought=is_sought)
    found = _designed(modelled, train, spec, references, tell)
    return _judged(found, force=force)


def _modelled(
    found: Study,
    records: Sequence[Record],
    heldout: Sequence[Record],
    priors: Mapping[str, Prior],
    effort: str,
    progress: Progress,
    *,
    is_sought: bool,
) -> Study:
    """Add the models and, if causes are to be sought, what the diagnosis says of them."""
    if not records:
        return replace(found, why_undiagnosed="no record is fit for it")
    progress("Fitting models of gain and damping", 2, 100)
    law = {name: prior for name, prior in priors.items() if name in OF_THE_LAW}

    def searched() -> Diagnosis:
        if not is_sought:  # no gain is given of them: nobody should wait for a search
            raise InputError(WRONG)
        return diagnose(
            records,
            heldout=heldout,
            priors=priors,
            effort=effort,
            progress=lambda what, done, _: progress(what, 10 + round(0.7 * done), 100),
        )

    fit, diagnosis = _side_by_side(lambda: identify(records, priors=law), searched)
    if isinstance(fit, ServolensError):
        if not fatal(_findings(found.check)):
            raise fit
        return replace(found, why_undiagnosed=f"{fit}")
    if isinstance(diagnosis, ServolensError):
        why = f"{diagnosis}"
        return replace(found, fit=fit, why_undiagnosed=why, model=_in_doubt(fit.model, why))
    return replace(found, fit=fit, diagnosis=diagnosis, model=diagnosis.model)


def _side_by_side(
    one: Callable[[], Identification], other: Callable[[], Diagnosis]
) -> tuple[Identification | ServolensError, Diagnosis | ServolensError]:
    """Return what both make, or why they do not, one on each processor."""
    with ThreadPoolExecutor(1) as pool:
        second = pool.submit(_attempted, other)
        return _attempted(one), second.result()


def _attempted(job: Callable[[], Made]) -> Made | ServolensError:
    try:
        return job()
    except ServolensError as error:
        return error


def _in_doubt(model: Model, why: str) -> Model:
    """Return a model of which nobody can tell what it misses: no gain is to be designed on it."""
    evidence = model.evidence
    assert isinstance(evidence, Evidence)  # noqa: S101 - an identification's model has it
    return replace(model, evidence=replace(evidence, fatal=(f"what it misses is unknown: {why}.",)))


def _designed(
    found: Study,
    records: Sequence[Record],
    spec: PDSpec | None,
    references: float | Sequence[float],
    progress: Progress,
) -> Study:
    """Add the designs on the linear, the speed-dependent and the diagnosed model."""
    fit = found.fit
    if found.model is None or fit is None:
        return found
    if found.diagnosis is not None and any(known.code == "gain_not_shown" for known in found.diagnosis.findings):
        return replace(found, why_none=UNANSWERED)
    progress("Searching for the least gains", 80, 100)
    model = with_amplifier(found.model, records)
    found = replace(found, model=model)
    wanted = spec or suggested_spec(records, model.plant)
    if wanted is None:
        has_loop = any(record.controller is not None and record.controller.kp > 0 for record in records)
        why = "the model settles with none that was tried" if has_loop else "the records state no loop"
        return replace(found, why_none=f"{why}; give kp and a settling time")
    linear, nonlinear = (with_amplifier(one, records).plant for one in (fit.constant, fit.velocity) if one)
    diagnosed = None if found.diagnosis is None else model.plant
    try:
        comparison = compare(linear, nonlinear, wanted, diagnosed=diagnosed)
        progress("Simulating gains on uncertain plants", 90, 100)
        design = recommend(model, comparison.diagnosed or comparison.nonlinear, references=references)
    except (NumericalError, np.linalg.LinAlgError) as error:
        return replace(found, why_none=f"{error}")
    return replace(found, comparison=comparison, design=design, why_none="")


def _judged(found: Study, *, force: bool) -> Study:
    """Add the lights, and withhold the gain where they say so; of wrong data, tell nothing that only comes of them."""
    design, comparison = found.design, found.comparison
    answered = frozenset() if found.diagnosis is None else OF_SIMPLER_MODELS
    of_models = [] if found.fit is None else [known for known in found.fit.findings if known.code not in answered]
    of_models += [] if found.diagnosis is None else found.diagnosis.findings
    of_all = together(found.findings, of_models)
    checked = _findings(found.check)
    lights = study_lights(data_light(found.check, of_all), found.model, design, found.why_none, checked)
    red = lights["gain"].light == "red" and design is not None and design.feasible
    if red and not force and design is not None:
        design = design.withhold(lights["gain"].sentence)
    is_wrong = not force and bool(fatal(checked))
    if is_wrong and design is not None and not design.feasible:
        design = replace(design, reason=lights["gain"].sentence, conflict=(), nearest=())
    if design is not None:
        design = replace(design, lights=lights, check=found.check, diagnosis=found.diagnosis)
    if comparison is not None and comparison.diagnosed is not None:
        comparison = replace(comparison, diagnosed=design)
    told = together(checked, [] if is_wrong else of_all)
    return replace(
        found, lights=lights, design=design, comparison=comparison, forced=red and force, findings=_sorted(told)
    )


def _findings(check: Sequence[RecordQuality]) -> list[Finding]:
    return [finding for quality in check for finding in quality.findings]


def _sorted(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return each finding once, the worst first."""
    told = {(finding.code, finding.message, finding.record): finding for finding in findings}
    return tuple(sorted(told.values(), key=lambda finding: SEVERITIES.index(finding.severity)))
