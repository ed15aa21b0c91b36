"""The causes of a diagnosis: how sure each is, and what these data cannot tell from it."""

from __future__ import annotations

from math import erf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from servolens.diagnosis.result import Cause
from servolens.effects import Actuator, catalogue
from servolens.plant import Plant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servolens.diagnosis.case import Case
    from servolens.diagnosis.errors import Gains
    from servolens.diagnosis.result import Verdict
    from servolens.diagnosis.search import Search
    from servolens.identification.fitted import Fitted
    from servolens.identification.hypothesis import Hypothesis
    from servolens.model import Quantity

__all__ = [
    "MOST_CONFIDENT",
    "causes_of",
    "distinctness",
    "may_be_nothing",
    "own_quantities",
    "rival_plants",
    "twins_of",
]

MOST_CONFIDENT = 0.999
OF_A_PART = 0.5
"""Confidence in a cause beside which something is left that nothing explains: it may stand for that. Chosen from how
often such causes are right (table of reliability)."""


def causes_of(
    case: Case, found: Search, path: Sequence[Hypothesis], fit: Fitted, gains: Gains, verdict: Verdict
) -> tuple[Cause, ...]:
    """Return the causes in the order of the path, each with what it gained."""
    chosen, causes = path[-1], []
    for name in _in_order(path):
        quantities, twins = own_quantities(fit, name), twins_of(chosen.plant, name)
        sure = _posterior(found, chosen, name) * distinctness(chosen.plant, name, quantities)
        sure /= 1.0 + sum(twin not in (n for h in found.rivals_of(name) for n in h.causes) for twin in twins)
        sure *= 1.0 if verdict == "explained" else OF_A_PART
        at = next(i for i, h in enumerate(path) if name in h.causes and all(name in g.causes for g in path[i:]))
        causes.append(
            Cause(
                effect=name,
                quantities=quantities,
                confidence=round(min(sure, MOST_CONFIDENT), 4),
                rivals=_rivals(found, chosen, name, twins),
                train=(gains.train(at - 1), gains.train(at)),
                heldout=(gains.tested(at - 1), gains.tested(at)),
            )
        )
    return tuple(causes)


def rival_plants(found: Search, chosen: Hypothesis, cause: Cause) -> tuple[Plant, ...]:
    """Return the plants with a rival in the place of `cause`; of a twin that was not tried, with the same values."""
    plants = [h.plant for h in found.rivals_of(cause.effect)]
    effect = chosen.plant.effect(cause.effect)
    if effect is not None and effect.twin in cause.rivals and not any(p.effect(effect.twin) for p in plants):
        values = {spec.name: getattr(effect, spec.name) for spec in effect.parameters()}
        plants.append(chosen.plant.without_effect(cause.effect).with_effect(Plant.effect_from(effect.twin, values)))
    return tuple(plants)


def _posterior(found: Search, chosen: Hypothesis, cause: str) -> float:
    """Return the share of the likelihood, prices paid, of the hypotheses that contain `cause`, or a general form."""
    known = sorted((*found.judged, chosen), key=lambda h: -h.total)  # of several fits of the same causes the best
    least = min(h.total for h in known)
    weights = {h.causes: (h, float(np.exp(-0.5 * (h.total - least)))) for h in known}
    having = sum(w for h, w in weights.values() if _contains(h, cause))
    return having / max(sum(w for _, w in weights.values()), 1e-300)


def _contains(hypothesis: Hypothesis, cause: str) -> bool:
    return any(cause in (effect.name, *effect.generalises) for effect in hypothesis.plant.effects)


def _rivals(found: Search, chosen: Hypothesis, cause: str, twins: Sequence[str]) -> tuple[str, ...]:
    """Return what these data cannot tell from `cause`: names of effects, or of two together."""
    told = []
    for hypothesis in found.rivals_of(cause):
        if _contains(hypothesis, cause):
            continue
        instead = [name for name in hypothesis.causes if name not in chosen.causes]
        told += [" + ".join(instead)] if instead else []
    effect = chosen.plant.effect(cause)
    if effect is not None and effect.unites:
        told.append(" + ".join(effect.unites))
    told += [cls.name for cls in catalogue().values() if cause in cls.unites and set(cls.unites) <= set(chosen.causes)]
    return tuple(dict.fromkeys([*told, *twins]))


def twins_of(plant: Plant, cause: str) -> list[str]:
    """Return what does the same elsewhere in the loop, where all that lies between is linear, or in structure."""
    effect, causes = plant.effect(cause), [effect.name for effect in plant.effects]
    if effect is None:
        return []
    same = [name for name in getattr(effect, "same_structure", ()) if name not in causes]
    if not effect.twin or effect.twin in causes:
        return same
    places = [cls.stage for name in (cause, effect.twin) if issubclass(cls := catalogue()[name], Actuator)]
    between = [e for e in plant.effects if not (isinstance(e, Actuator) and e.stage < min(places, default=0))]
    return [effect.twin, *same] if all(e.linear for e in between) else same


def distinctness(plant: Plant, cause: str, quantities: Mapping[str, Quantity]) -> float:
    """Return with what confidence the cause's size differs from nothing by its error bar; a half where it has none."""
    sizes = _sizes(plant, cause, quantities)
    if not sizes:
        return 1.0
    if all(q.value == nothing for q, nothing in sizes):
        return 0.0
    far = [abs(q.value - nothing) / q.stderr for q, nothing in sizes if q.stderr is not None and q.stderr > 0.0]
    return erf(max(far) / sqrt(2.0)) if far else 0.5


def may_be_nothing(plant: Plant, cause: str, quantities: Mapping[str, Quantity]) -> bool:
    """Tell whether the 95 % intervals of all sizes of a cause include nothing; not where one is unknown."""
    ends = [(q.interval, nothing) for q, nothing in _sizes(plant, cause, quantities)]
    return bool(ends) and all(end is not None and end[0] <= nothing <= end[1] for end, nothing in ends)


def _sizes(plant: Plant, cause: str, quantities: Mapping[str, Quantity]) -> list[tuple[Quantity, float]]:
    """Return the sizes of a cause, each with the value at which it is absent."""
    effect = plant.effect(cause)
    return [(quantities[name], nothing) for name, nothing in (effect.absent_at if effect else {}).items()]


def _in_order(path: Sequence[Hypothesis]) -> list[str]:
    """Return the causes of the last hypothesis, those first that came first."""
    seen = [name for hypothesis in path for name in hypothesis.causes if name in path[-1].causes]
    return list(dict.fromkeys(seen))


def own_quantities(fit: Fitted, name: str) -> dict[str, Quantity]:
    """Return the fitted parameters of one cause, by name."""
    prefix = f"{name}."
    return {key.removeprefix(prefix): q for key, q in fit.model.quantities.items() if key.startswith(prefix)}
