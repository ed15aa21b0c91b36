"""The least derivative gain for a spec, and every interval of gains that meets it.

Settling time jumps as a function of the gain, and the feasible set need not be an interval: the whole range is covered
(:mod:`servolens.design.cover`). On request CasADi solves the paper's program (eq. 36) in each interval as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

from servolens.design.cover import Cover, last_gain
from servolens.design.found import Certificate, Design
from servolens.design.infeasible import explain, unanswered
from servolens.design.limit_cycle import hunting, without_hunting
from servolens.design.linear_limits import none_keeps, within_limits
from servolens.design.settle import evaluate, horizon
from servolens.design.spec import PDSpec
from servolens.errors import InputError, as_progress, flags, needed
from servolens.units import readable

if TYPE_CHECKING:
    from collections.abc import Callable

    from servolens.design.limit_cycle import Hunting
    from servolens.plant import Plant

__all__ = ["tune"]


def tune(
    plants: Plant | Sequence[Plant],
    spec: PDSpec,
    *,
    with_program: bool = False,
    certify: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> Design:
    """Return the least Kd that meets `spec` on all `plants`, and every interval of gains that does.

    Parameters
    ----------
    plants : Plant or sequence of Plant
        One model, or several that must all meet the spec.
    spec : PDSpec
        What to reach. Without an end of the search, that follows from the plants.
    with_program : bool
        Whether CasADi and IPOPT solve for the least gain in each interval as well; this takes longer than the search.
    certify : bool
        Whether to prove what the search found, by enclosures of all steps: for smooth plants, in a minute or more. The
        certificate then states the widest stretch of gains that stays open.
    progress : callable, optional
        Called with (description, done, total).

    Returns
    -------
    Design
        ``feasible`` is False, with a reason, where no gain in the range meets the spec.

    Raises
    ------
    InputError
        If no plant is given or their units differ, an enclosure is asked for of a plant that is not smooth, or program
        or enclosure of another loop than PD.

    Examples
    --------
    >>> from servolens import Plant, PDSpec
    >>> design = tune(Plant(gain=1.7866, damping=4.5866), PDSpec(kp=100, settling_time=0.5, control="continuous"))
    >>> round(design.kd, 2)
    6.28
    """
    needed(spec, PDSpec)
    flags(with_program=with_program, certify=certify)
    models, progress = _checked(plants), as_progress(progress)
    if (with_program or certify) and not (spec.is_pd and not spec.limits):
        raise InputError(
            "CasADi's program and the proof by enclosures are for PD of the last difference only, and know no limits of"
            " the linearised loop; leave them out"
        )
    silent = unanswered(models, spec)
    if silent is not None:
        return _unsearched(models, spec, silent)
    stated = spec.kd_max
    top = stated or max(last_gain(model, spec) for model in models)
    spec = replace(spec, kd_max=top)
    cover = Cover(models, spec, progress)
    settling = cover.intervals()
    kept = within_limits(models, spec, settling, cover.gap, cover.scale)
    intervals = kept if spec.hunting else without_hunting(models, spec, kept, cover.gap)
    certificate = Certificate(
        searched=(0.0, top),
        gap=cover.gap,
        kind="sensitivity",
        horizon=max(horizon(model, spec) for model in models),
        end_from_plant=stated is None,
    )
    design = Design(plants=models, spec=spec, kd=None, intervals=intervals, certificate=certificate)
    if kept and not intervals:
        worst = hunting(models, spec, kept[0][0])
        design = replace(design, reason=_all_hunt(kept, spec, worst, models[0].length_unit), conflict=("hunting",))
    elif settling and not intervals:
        reason, conflict, nearest = none_keeps(models, spec, settling)
        design = replace(design, reason=reason, conflict=conflict, nearest=nearest)
    elif not intervals:
        reason, conflict, nearest = explain(models, spec, cover.grid())
        design = replace(design, reason=reason, conflict=conflict, nearest=nearest)
    else:
        kd = intervals[0][0]
        verified = tuple(evaluate(model, spec, kd) for model in models)
        design = replace(design, kd=kd, verified=verified, hunting={"least": hunting(models, spec, kd)})
    if with_program:
        design = _with_program(models, design)
    return _certified(models, design, cover.scale, progress) if certify else design


def _checked(plants: Plant | Sequence[Plant]) -> tuple[Plant, ...]:
    """Return the plants; refuse none, and such of different units."""
    models = tuple(plants) if isinstance(plants, Sequence) else (plants,)
    if not models:
        raise InputError("no model was given; a design needs at least one")
    if len({(m.length_unit, m.command_unit) for m in models}) > 1:
        raise InputError("the models have different units; a gain cannot hold for all of them")
    return models


def _unsearched(models: tuple[Plant, ...], spec: PDSpec, reason: str) -> Design:
    """Return a design of plants for which no gain needs to be looked for, with the reason."""
    watched = max(horizon(model, spec) for model in models)
    certificate = Certificate(searched=(0.0, 0.0), gap=0.0, kind="sensitivity", horizon=watched)
    return Design(plants=models, spec=spec, kd=None, intervals=(), certificate=certificate, reason=reason)


def _all_hunt(settling: Sequence[tuple[float, float]], spec: PDSpec, worst: Hunting | None, unit: str) -> str:
    low, high = settling[0][0], settling[-1][1]
    found = worst is not None and isfinite(worst.amplitude)
    size = f" (with {spec.free} = {low:.4g} by ±{readable(worst.amplitude, unit)})" if worst and found else ""
    less = "less integral action" if spec.ki or spec.kiv else "a smaller kp"
    return (
        f"every {spec.free} that meets the spec otherwise, {low:.4g} to {high:.4g}, hunts from some starts{size};"
        f" choose {less}, or admit hunting"
    )


def _certified(
    models: tuple[Plant, ...], design: Design, scale: float, progress: Callable[[str, int, int], None] | None
) -> Design:
    """Return the design with a proof, or with what contradicts it."""
    from servolens.design.certify import proven_gap

    gap, disagreement = proven_gap(models, design, scale, progress)
    if disagreement is not None:
        return replace(design, disagreement=disagreement)
    return replace(design, certificate=replace(design.certificate, kind="enclosure", gap=gap))


def _with_program(models: tuple[Plant, ...], design: Design) -> Design:
    """Return the design with what CasADi finds in each interval, and where the two disagree."""
    from servolens.design.program import local_optimum

    spec, gap = design.spec, design.certificate.gap
    candidates: list[float | None] = []
    differences = []
    for low, high in design.intervals:
        found = [local_optimum(model, spec, (low, high)) for model in models]
        best = max((kd for kd in found if kd is not None), default=None)
        fits = best is not None and all(evaluate(model, spec, best).meets for model in models)
        candidates.append(best if fits else None)
        if best is None or None in found:
            differences.append(f"it found none from {low:.5g} on")
        elif abs(best - low) > gap:
            differences.append(f"it found {best:.5g} where the search found {low:.5g}")
    disagreement = f"CasADi's program disagrees with the search: {'; '.join(differences)}" if differences else None
    return replace(design, candidates=tuple(candidates), disagreement=disagreement)
