"""A hypothesis fitted to its optimum, with error bars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from servolens.identification.error_problem import Known
from servolens.identification.fit_findings import findings_of, is_beyond, not_determined
from servolens.identification.late_errors import counting_late_inputs
from servolens.identification.least_determined import of_flattest_place
from servolens.identification.refine import Refinement, minimise_error
from servolens.identification.shaken_errors import counting_answers_to_shaking
from servolens.identification.shaking_spectra import counting_all_spectra
from servolens.identification.unsteady import counting_unsteadiness
from servolens.model import NOT_REACHED, UNDETERMINED, Model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servolens.findings import Finding
    from servolens.identification.hypothesis import Hypothesis
    from servolens.identification.likelihood import Likelihood
    from servolens.identification.noise import NoiseModel
    from servolens.plant import Plant
    from servolens.record import Record

__all__ = ["AT_BOUND", "GIVEN", "Fitted", "fitted", "model_of", "with_error_bars"]

AT_BOUND, GIVEN = "it ended at the end of its range", "given, not estimated"
"""Why a parameter has no standard error."""


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
        Work after which no further minimum is looked for, see :func:`~servolens.simulation.rates.work_of`.
    """
    runs = likelihood.runs(hypothesis.noise, unpowered=hypothesis.unpowered)
    plant = hypothesis.plant
    refined = minimise_error(
        plant,
        runs,
        likelihood.options(plant),
        noise=likelihood.weighed_by(hypothesis.noise),
        local_minima=plant.has_contacts,
        known=Known(hypothesis.starts, hypothesis.local),
        allowance=allowance,
    )
    refined = with_error_bars(likelihood, refined, hypothesis.noise, unpowered=hypothesis.unpowered)
    held = likelihood.options(plant).held
    return Fitted(model_of(refined, likelihood.records, held), refined, findings_of(refined))


def with_error_bars(
    likelihood: Likelihood, refined: Refinement, noise: NoiseModel, *, unpowered: bool = False
) -> Refinement:
    """Return what was `refined` beside `noise`, with error bars that allow for what its residual does not show.

    Flatter places beside the optimum, an axis that slides off by itself, late jumps of the voltage, how a coupling or a
    stop answers to shaking, and all spectra that may shake it.

    Parameters
    ----------
    likelihood : Likelihood
        Of the records.
    refined : Refinement
        The optimum.
    noise : NoiseModel
        Beside which it is one.
    unpowered : bool
        Whether nothing was applied before records that begin with their step.
    """
    for counting in (
        of_flattest_place,
        counting_unsteadiness,
        counting_late_inputs,
        counting_answers_to_shaking,
        counting_all_spectra,
    ):
        refined = counting(likelihood, refined, noise, unpowered=unpowered)
    return refined


def model_of(refined: Refinement, records: Sequence[Record], held: Sequence[str]) -> Model:
    """Return the model that a search ended with, and why parameters have no error bar: those `held` were given."""
    plant, unknown, covariance = refined.plant, not_determined(refined), refined.covariance.copy()
    reasons = dict.fromkeys(plant.parameters, "its error could not be estimated")
    reasons |= {name: NOT_REACHED if is_beyond(refined, name) else UNDETERMINED for name in unknown}
    lost = np.array([name in unknown for name in plant.parameters])
    covariance[lost], covariance[:, lost] = np.nan, np.nan
    reasons |= dict.fromkeys(refined.at_bound, AT_BOUND)
    reasons |= dict.fromkeys(plant.derived, "it follows from other parameters")
    return Model(
        plant=plant,
        covariance=covariance,
        identified_from=tuple(dict.fromkeys(record.name for record in records)),
        reasons=reasons | dict.fromkeys(held, GIVEN),
    )
