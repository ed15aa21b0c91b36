"""A hypothesis fitted to its optimum, with error bars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.fit_findings import findings_of
from servolens.identification.refine import Refinement, minimise_error
from servolens.model import Model

if TYPE_CHECKING:
    from servolens.findings import Finding
    from servolens.identification.likelihood import Hypothesis, Likelihood
    from servolens.plant import Plant

__all__ = ["Fitted", "fitted"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Model and refinement of a hypothesis, and what the fit itself says against it."""

    model: Model
    refinement: Refinement
    findings: tuple[Finding, ...]

    @property
    def plant(self) -> Plant:
        """The best plant."""
        return self.model.plant


def fitted(likelihood: Likelihood, hypothesis: Hypothesis, allowance: float = np.inf) -> Fitted:
    """Return `hypothesis` at its optimum beside its own noise, with error bars.

    Parameters
    ----------
    likelihood : Likelihood
        Of the records.
    hypothesis : Hypothesis
        Where to begin.
    allowance : float
        Samples times substeps after which no further minimum is looked for.
    """
    runs = likelihood.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
    plant = hypothesis.plant
    refined = minimise_error(
        plant,
        runs,
        likelihood.options(plant),
        noise=1.0,
        local_minima=plant.has_contacts,
        allowance=allowance,
    )
    names = dict.fromkeys(refined.undetermined, "the data do not determine it")
    names |= dict.fromkeys(refined.at_bound, "it ended at the end of its range")
    names |= dict.fromkeys(likelihood.options(plant).held, "it is held")
    model = Model(
        plant=refined.plant,
        covariance=refined.covariance,
        identified_from=tuple(record.name for record in likelihood.records),
        reasons=names,
    )
    return Fitted(model, refined, findings_of(refined))
