"""What a fit says: how well, which parameters with which errors, and which of them the data hardly tell apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servolens.identification.fitted import AT_BOUND, GIVEN
from servolens.summaries.names import spoken
from servolens.summaries.wording import capital, interval, length, listed, number, plus_minus, prefixed, unit
from servolens.summary import Summary, Table

if TYPE_CHECKING:
    from servolens.identification import Fit
    from servolens.model import Quantity

__all__ = ["fit_summary"]

LEAST_CORRELATION, MOST_PAIRS = 0.1, 8
"""Correlations that are shown, the largest first."""
OF_THE_ERRORS = ("above_noise",)
"""Findings that stand directly under the error bars that they are about."""


def fit_summary(fit: Fit) -> Summary:
    """Tell how well a fit explains its records, then its parameters and their correlations.

    Parameters
    ----------
    fit : Fit
        Of one axis.
    """
    parts = ["gain", "damping", *(spoken(effect.name) for effect in fit.plant.effects)]
    parameters = Table(
        title="Parameters",
        columns=("Parameter", "Value ± standard error", "95 % interval", "Unit"),
        rows=tuple((name, *_row(quantity)) for name, quantity in fit.quantities.items()),
        note=" ".join(capital(finding.message) for finding in fit.findings if finding.code in OF_THE_ERRORS),
    )
    pairs = _correlations(fit)
    return Summary(
        title=f"Fit of {listed(parts, most=8)} to {listed(fit.model.identified_from)}",
        sentences=(_accuracy(fit), _how(fit)),
        tables=(parameters, *([pairs] if pairs else [])),
        findings=tuple(finding for finding in fit.findings if finding.code not in OF_THE_ERRORS),
    )


def _accuracy(fit: Fit) -> str:
    error, noise = fit.rms_error, fit.noise
    if fit.options.compared == "voltage":
        factor, shown = prefixed([error], fit.plant.command_unit)
        sizes = [f"{number(factor * value, 2)} {shown}" for value in (error, noise)]
    else:
        sizes = [length(value, fit.plant.length_unit, beside=error) for value in (error, noise)]
    level = "explained down to the noise" if fit.at_noise else "not explained down to the noise"
    return f"The records are {level}: what is left is {sizes[0]} (r.m.s.), the noise {sizes[1]}."


def _how(fit: Fit) -> str:
    driven = "in closed loop from the reference" if fit.driven == "closed_loop" else "driven by the voltage"
    plant = fit.plant
    held = {*fit.options.held, *plant.derived, *plant.usual, *fit.refinement.at_bound}
    count = len(plant.parameters) - len(held)
    return f"Simulated {driven}; {count} parameters fitted. {fit.refinement.status.rstrip('.').capitalize()}."


def _row(quantity: Quantity) -> tuple[str, str, str]:
    if quantity.stderr is not None:
        return plus_minus(quantity), interval(quantity), unit(quantity.unit)
    state = {GIVEN: "fixed", AT_BOUND: "at its bound"}.get(quantity.reason or "", quantity.reason or "")
    return f"{number(quantity.value)} ({state})", "–", unit(quantity.unit)


def _correlations(fit: Fit) -> Table | None:
    found = [(pair, value) for pair, value in fit.correlations.items() if abs(value) >= LEAST_CORRELATION]
    rows = [(f"{first}, {second}", f"{value:+.2f}") for (first, second), value in found[:MOST_PAIRS]]
    if not rows:
        return None
    return Table(
        title=f"Correlations of at least {LEAST_CORRELATION:g}",
        columns=("Parameters", "Correlation"),
        rows=tuple(rows),
        note=f"{len(found) - len(rows)} more are smaller." if len(found) > len(rows) else "",
    )
