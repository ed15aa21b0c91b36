"""One verb for a gain: from a plant, a model, a fit, a diagnosis, or from records by the whole chain."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

from servolens import design as designing
from servolens.design.spec import PDSpec
from servolens.errors import InputError, flags, needed
from servolens.inputs import as_model, as_records, is_model, listed
from servolens.plant import Plant
from servolens.study.workflow import study_records

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from servolens.design import Design
    from servolens.identification import Priors
    from servolens.inputs import Plants, Records, RecordSettings
    from servolens.model import Model

__all__ = ["tune"]


def tune(  # noqa: PLR0913 - what may be asked of a gain, all by keyword
    source: Plants | Records,
    spec: PDSpec,
    *,
    references: float | Sequence[float] = (),
    heldout: Records = (),
    priors: Priors | None = None,
    effort: str | None = None,
    force: bool = False,
    with_program: bool = False,
    certify: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    **settings: Unpack[RecordSettings],
) -> Design:
    """Return the least Kd that meets `spec`, every interval of gains that does, and the gain to use.

    Parameters
    ----------
    source : Plant, model, fit, diagnosis, or records; one or several
        What to design on. Several plants or models must all meet the spec; a path that ends in ``.json`` is a model's.
        From records (Record, file, folder, campaign, DataFrame, TimeResponseData) the whole chain is gone first: check,
        identify, diagnose (:func:`servolens.study_records`).
    spec : PDSpec
        What to reach.
    references : float or sequence of float
        Sizes of further steps that the recommended gain has to meet [m or rad].
    heldout, priors, effort
        For records alone, as in :func:`servolens.diagnose`.
    force : bool
        Whether to give a gain that is to be withheld. Of plants no gain is withheld: nothing speaks against them.
    with_program, certify : bool
        For plants and models, as in :func:`servolens.design.tune`.
    progress : callable, optional
        Is told (what, done, total).
    **settings
        ``kp``, ``kd`` … that made the records, where tables and files do not state them
        (:class:`servolens.inputs.RecordSettings`). The gain to design for stands in `spec`.

    Returns
    -------
    Design
        With ``recommended`` and ``lights``, from records also ``check`` and ``diagnosis``. ``kd`` is None, with a
        ``reason``, where no gain meets the spec or the gain is withheld.

    Raises
    ------
    InputError
        If `source` is none of these or cannot be read, a record is unfit, or models have different units.

    Examples
    --------
    >>> from servolens import Plant, PDSpec
    >>> design = tune(Plant(gain=1.7866, damping=4.5866), PDSpec(kp=100, settling_time=0.5))
    >>> round(design.kd, 1), design.recommended.kd > design.kd
    (6.3, True)
    """
    needed(spec, PDSpec)
    flags(force=force)
    given = listed(source)
    kinds = {is_model(one) for one in given}
    if len(kinds) > 1:
        raise InputError("records and models cannot be mixed; give tune either records or models")
    if kinds == {True}:
        as_records((), settings, least=0)  # tells a misspelt one
        asked = {"heldout": listed(heldout) or None, "priors": priors or None, "effort": effort, **settings}
        of_records = ", ".join(name for name, value in asked.items() if value is not None)
        if of_records:
            raise InputError(f"{of_records} cannot be given for plants and models; they are for records")
        models = [as_model(one) for one in given]
        plants = [model.plant for model in models]
        found = designing.tune(plants, spec, with_program=with_program, certify=certify, progress=progress)
        may_withhold = not (force or all(isinstance(one, Plant) for one in given))
        return _judged(models, designing.recommend(models, found, references=references), may_withhold=may_withhold)
    if with_program or certify:
        raise InputError("with_program and certify are for plants and models; give tune the model of a diagnosis")
    runs, tests = as_records(given, settings), as_records(heldout, settings, least=0)
    done = study_records(
        runs,
        spec,
        references=references,
        heldout=tests,
        priors=priors,
        effort="normal" if effort is None else effort,
        force=force,
        progress=progress,
    )
    if done.design is None:
        why = done.lights["data"].sentence if done.model is None else done.why_none
        raise InputError(f"no gain can be designed: {why}")
    return done.design


def _judged(models: Sequence[Model], design: Design, *, may_withhold: bool) -> Design:
    """Return the design with its lights, without its gains where these are to be withheld."""
    of_model, of_gain = designing.trust(models, design)
    if may_withhold and of_gain.light == "red" and design.feasible:
        design = design.withhold(of_gain.sentence)
    return replace(design, lights={"model": of_model, "gain": of_gain})
