"""One verb for a gain: from a plant, a model, a fit, a diagnosis, or from records by the whole chain."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from servolens import design as designing
from servolens.errors import InputError
from servolens.model import Model, read_model
from servolens.plant import Plant
from servolens.study.sources import are_records, listed, records_from
from servolens.study.workflow import study_records

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from servolens.design import Design, PDSpec
    from servolens.identification import Prior
    from servolens.record import Record

    Source: TypeAlias = "Plant | Model | Modelled | Record | str | os.PathLike[str] | Any"
    """DataFrames and time responses are known by what they hold: neither library is imported."""

__all__ = ["tune"]


class Modelled(Protocol):
    """A fit, an identification or a diagnosis."""

    @property
    def model(self) -> Model:
        """The model that was found."""


def tune(  # noqa: PLR0913 - what may be asked of a gain, all by keyword
    source: Source | Iterable[Source],
    spec: PDSpec,
    *,
    heldout: Source | Iterable[Source] = (),
    priors: Mapping[str, Prior] | None = None,
    effort: str = "normal",
    force: bool = False,
    with_program: bool = False,
    certify: bool = False,
    progress: Callable[[str, int, int], None] = lambda _what, _done, _total: None,
    **settings: float | str,
) -> Design:
    """Return the least Kd that meets `spec`, every interval of gains that does, and the gain to use.

    Parameters
    ----------
    source : Plant, Model, fit, identification, diagnosis, Record, path, DataFrame, or a sequence
        What to design on. Several plants or models must all meet the spec; a path that ends in ``.json`` is a model's.
        From records the whole chain is gone first: check, identify, diagnose (:func:`servolens.study_records`). They
        may be given as files, folders or campaigns (:func:`servolens.read_records`), as pandas DataFrames or as time
        responses of python-control.
    spec : PDSpec
        What to reach.
    heldout, priors, effort
        For records, as in :func:`servolens.diagnose`.
    force : bool
        Whether to give a gain that is to be withheld. Of plants no gain is withheld: nothing speaks against them.
    with_program, certify : bool
        For plants and models, as in :func:`servolens.design.tune`.
    progress : callable
        Is told (what, done, total).
    **settings : float or str
        Of records that are still to be read, as in :func:`servolens.read_record`: ``kp`` and ``kd`` that made them,
        ``encoder_resolution`` and so on. The gain to design for stands in `spec`.

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
    given = listed(source)
    if not any(are_records(one) for one in given):
        if settings:
            raise InputError(f"{', '.join(settings)} cannot be given for plants and models; they are for records")
        models = [_known(one) for one in given]
        plants = [model.plant for model in models]
        found = designing.tune(plants, spec, with_program=with_program, certify=certify, progress=progress)
        may_withhold = not (force or all(isinstance(one, Plant) for one in given))
        return _judged(models, designing.recommend(models, found), may_withhold=may_withhold)
    if not all(are_records(one) for one in given):
        raise InputError("records and models cannot be mixed; give tune the ones or the others")
    if with_program or certify:
        raise InputError("with_program and certify are for plants and models; give tune the model of a diagnosis")
    runs = records_from(given, settings)
    tests = records_from(listed(heldout), settings)
    done = study_records(runs, spec, heldout=tests, priors=priors, effort=effort, force=force, progress=progress)
    if done.design is None:
        why = done.lights["data"].sentence if done.model is None else done.why_none
        raise InputError(f"no gain can be designed: {why}")
    return done.design


def _known(source: object) -> Model:
    """Return a source as a model."""
    if isinstance(source, Plant):
        return Model(plant=source)
    if isinstance(source, str | os.PathLike):
        return read_model(Path(source))
    model = source if isinstance(source, Model) else getattr(source, "model", None)
    if isinstance(model, Model):
        return model
    what = type(source).__name__
    raise InputError(f"a gain is tuned on a plant, a model, a fit, a diagnosis or records; got {what}")


def _judged(models: Sequence[Model], design: Design, *, may_withhold: bool) -> Design:
    """Return the design with its lights, without its gains where these are to be withheld."""
    of_model, of_gain = designing.trust(models, design)
    if may_withhold and of_gain.light == "red" and design.feasible:
        design = design.withhold(of_gain.sentence)
    return replace(design, lights={"model": of_model, "gain": of_gain})
